"""``grindvision book``: rebuild chapters, figures and the scoreboard, and the HTML book."""

from __future__ import annotations

import argparse
from pathlib import Path

from grindvision.cli.streams import complain, say
from grindvision.errors import GrindvisionError, InputError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.add_argument("--only", nargs="+", default=[], metavar="NN", help="chapters to run, by number (default: all)")
    parser.add_argument("--fast", action="store_true", help="fewer trials; results go to build/fast, figures/ stays")
    parser.add_argument(
        "--force", action="store_true", help="run chapters also where nothing has changed since the last"
    )
    parser.add_argument("--redraw", action="store_true", help="replace committed figures also where their data agree")
    parser.add_argument(
        "--seeds", type=int, metavar="N", help="run each chapter with N seeds and say for how many its assertions hold"
    )
    parser.add_argument("--site", action="store_true", help="build the HTML book in build/site afterwards")
    parser.add_argument(
        "--in-browser",
        action="store_true",
        help="with --site: build the exercises that run in the browser too (downloads about 80 MB once)",
    )
    parser.add_argument(
        "--pdf", action="store_true", help="with --site: print the whole book as one PDF too (needs Chromium)"
    )
    parser.add_argument(
        "--record-seconds", action="store_true", help="commit what the chapters took, for the time left of later builds"
    )


def run(options: argparse.Namespace) -> int:
    """Run it; returns 1 when a chapter failed."""
    from grindvision_book.machinery.one_at_a_time import only_build
    from grindvision_book.machinery.places import BUILD

    if options.pdf:
        from grindvision_book.site.pdf import find_chromium

        if not options.site:
            raise InputError("--pdf prints the pages of the HTML book; give --site too (./run site --pdf)")
        find_chromium()
    with only_build(BUILD):
        return _build(options)


def _build(options: argparse.Namespace) -> int:
    from grindvision_book.machinery.answers import scoreboard, summary
    from grindvision_book.machinery.chapters import chapters, chosen
    from grindvision_book.machinery.committed import committed_figures
    from grindvision_book.machinery.evidence import count_by_class
    from grindvision_book.machinery.places import BUILD, FAST_FIGURES, FIGURES, ROOT
    from grindvision_book.machinery.progress import Progress
    from grindvision_book.machinery.publishing import told
    from grindvision_book.machinery.reading import ReadingPage, titles
    from grindvision_book.machinery.rebuilding import rebuild
    from grindvision_book.machinery.schedule import record_seconds

    if options.seeds is not None:
        return _with_seeds(options)
    figures = FAST_FIGURES if options.fast else FIGURES
    chosen(options.only)
    page = ReadingPage(BUILD / "reading", titles(chapters()))
    say(f"Read while it is being built: {page.address}")
    with Progress(page, options.fast) as progress:
        outcomes = rebuild(
            options.only, fast=options.fast, watcher=progress, redraw=options.redraw, force=options.force
        )
    if not options.fast:
        published = [file for outcome in outcomes for file in outcome.published]
        say("\n".join(["", *told(published, committed_figures().origin)]))

    table = scoreboard(figures)
    shown = table[["item", "quantity", "unit", "paper", "rebuilt", "verdict"]]
    say("\n" + shown.to_string(index=False, na_rep="", float_format="{:.4g}".format, max_colwidth=60))
    say("\n" + count_by_class(table).to_string(index=False))
    say(f"\n{summary(table)}.\nScoreboard: {(figures / 'scoreboard.md').relative_to(ROOT)}", str(figures))
    site = None
    if options.site:
        from grindvision_book.site import PDF, build_site

        in_browser = _in_browser() if options.in_browser else None
        build = BUILD / "fast" if options.fast else BUILD
        site = build_site(build, figures, in_browser=in_browser, pdf=options.pdf)
        say(f"HTML book: {site}", str(figures))
        if options.pdf:
            say(f"PDF: {site.parent / PDF}", str(figures))
    page.ended(site)

    failed = [outcome for outcome in outcomes if outcome.failure]
    for outcome in failed:
        complain(f"grindvision book: {outcome}")
    if options.record_seconds:
        record_seconds({o.chapter[:2]: o.seconds for o in outcomes if not o.failure}, options.fast)
    return 1 if failed else 0


def _in_browser() -> Path | None:
    """The exercises that run in the browser, or none where they cannot be built: then the pages offer downloads."""
    from grindvision_book.machinery.places import BUILD
    from grindvision_book.site.in_browser import build_in_browser

    try:
        return build_in_browser(BUILD / "lite")
    except GrindvisionError as error:
        complain(f"grindvision book: no exercises in the browser, the pages offer downloads instead: {error}")
        return None


def _with_seeds(options: argparse.Namespace) -> int:
    from grindvision_book.machinery.chapters import chapters, chosen
    from grindvision_book.machinery.places import BUILD
    from grindvision_book.machinery.progress import Progress
    from grindvision_book.machinery.reading import ReadingPage, titles
    from grindvision_book.machinery.seeds import rebuild_with_seeds, told

    chosen(options.only)
    page = ReadingPage(BUILD / "reading", titles(chapters()))
    with Progress(page, options.fast) as progress:
        outcomes = rebuild_with_seeds(options.seeds, options.only, options.fast, watcher=progress)
    page.ended(None)
    say(told(outcomes))
    return int(any(outcome.failure for of_seed in outcomes.values() for outcome in of_seed))
