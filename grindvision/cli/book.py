"""``grindvision book``: rebuild chapters, figures and the scoreboard, and the HTML book."""

from __future__ import annotations

import argparse
import sys


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.add_argument("--only", nargs="+", default=[], metavar="NN", help="chapters to run, by number (default: all)")
    parser.add_argument("--fast", action="store_true", help="fewer trials; results go to build/fast, figures/ stays")
    parser.add_argument("--redraw", action="store_true", help="replace committed figures also where their data agree")
    parser.add_argument("--site", action="store_true", help="build the HTML book in build/site afterwards")


def run(options: argparse.Namespace) -> int:
    """Run it; returns 1 when a chapter failed."""
    from tqdm import tqdm

    from grindvision_book.answers import scoreboard, summary
    from grindvision_book.chapters import Outcome, chosen, rebuild
    from grindvision_book.places import BUILD, FAST_FIGURES, FIGURES, ROOT
    from grindvision_book.publishing import told

    figures = FAST_FIGURES if options.fast else FIGURES
    total = len(chosen(options.only))
    with tqdm(total=total, desc="chapters", unit="chapter", file=sys.stderr, dynamic_ncols=True) as bar:

        def report(outcome: Outcome) -> None:
            bar.set_postfix_str(outcome.chapter, refresh=False)
            bar.update()

        outcomes = rebuild(options.only, fast=options.fast, report=report, redraw=options.redraw)
    for outcome in outcomes:
        print(outcome)
    if not options.fast:
        print("", *told([file for outcome in outcomes for file in outcome.published]), sep="\n")

    table = scoreboard(figures)
    shown = table[["item", "quantity", "unit", "paper", "rebuilt", "tolerance", "verdict"]]
    print("\n" + shown.to_string(index=False, na_rep="", float_format="{:.4g}".format, max_colwidth=60))
    print(f"\n{summary(table)}.\nScoreboard: {(figures / 'scoreboard.md').relative_to(ROOT)}")
    if options.site:
        from grindvision_book.site import build_site

        page = build_site(BUILD / "fast" if options.fast else BUILD, figures)
        print(f"HTML book: {page}")

    failed = [outcome for outcome in outcomes if outcome.failure]
    for outcome in failed:
        print(f"grindvision book: {outcome}", file=sys.stderr)
    return 1 if failed else 0
