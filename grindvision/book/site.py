"""Builds the HTML book from the executed copies of the chapters; it needs no network to build or to read."""

from __future__ import annotations

import io
import shutil
import sys
from pathlib import Path

from grindvision.book.places import NOTEBOOKS, ROOT, SITE
from grindvision.errors import GrindvisionError

_TEXTS = ("data/README.md", "CHANGELOG.md", "CONTRIBUTING.md")
_LINKED = ("LICENSE", "LICENSE-TEXT", "CITATION.cff", "environment.txt")


def build_site(build: Path, figures: Path, notebooks: Path = NOTEBOOKS, site: Path = SITE) -> Path:
    """Build the pages and return the path of the first one.

    Args:
        build: working folder with ``executed``; a chapter that has no executed copy there is shown without outputs.
        figures: figures and scoreboard that the pages show.
        notebooks: folder of the chapters.
        site: folder of the pages.

    Raises:
        GrindvisionError: Sphinx cannot build them; the message has its reason.
    """
    from sphinx.application import Sphinx
    from sphinx.errors import SphinxError
    from sphinx.util.console import nocolor

    sources = build / "site_sources"
    _gather(sources, build / "executed", figures, notebooks)
    nocolor()
    warnings = io.StringIO()
    try:
        app = Sphinx(
            srcdir=sources,
            confdir=Path(__file__).with_name("site_sources"),
            outdir=site,
            doctreedir=build / "doctrees",
            buildername="html",
            status=None,
            warning=warnings,
        )
        app.build()
    except SphinxError as error:
        raise GrindvisionError(f"the HTML book cannot be built: {error}") from None
    if warnings.getvalue():
        print(warnings.getvalue(), file=sys.stderr, end="")
    return site / "index.html"


def _gather(sources: Path, executed: Path, figures: Path, notebooks: Path) -> None:
    """Lay out the sources like the checkout, so that every relative link means the same in both."""
    shutil.rmtree(sources, ignore_errors=True)
    shutil.copytree(figures, sources / "figures")
    for table in set(sources.glob("figures/*.md")) - {sources / "figures" / "scoreboard.md"}:
        table.write_text("---\norphan: true\n---\n" + table.read_text(encoding="utf-8"), encoding="utf-8")
    (sources / "notebooks").mkdir()
    chapters = sorted(notebooks.glob("[0-9][0-9]_*.ipynb"))
    for chapter in chapters:
        copy = executed / chapter.name
        shutil.copyfile(copy if copy.exists() else chapter, sources / "notebooks" / chapter.name)
    texts = [page for page in _TEXTS if (ROOT / page).exists()]
    for page in (*texts, *(page for page in _LINKED if (ROOT / page).exists())):
        (sources / page).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / page, sources / page)
    front = (ROOT / "README.md").read_text(encoding="utf-8")
    chapter_list = _contents("Chapters", [f"notebooks/{chapter.stem}" for chapter in chapters])
    about = _contents("The book", ["figures/scoreboard", *(text.removesuffix(".md") for text in texts)])
    (sources / "index.md").write_text(f"{front}\n{chapter_list}\n{about}", encoding="utf-8")


def _contents(caption: str, pages: list[str]) -> str:
    return "\n".join(["```{toctree}", ":hidden:", f":caption: {caption}", "", *pages, "```", ""])
