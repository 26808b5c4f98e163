"""Prints the whole HTML book as one PDF by Chromium: links, bookmarks, contents with page numbers, vector figures."""

from __future__ import annotations

import io
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from grindvision.errors import GrindvisionError
from grindvision.files import write_whole
from grindvision_book.site.printed import printed_book

if TYPE_CHECKING:
    from playwright.sync_api import Page

#: Names under which Chromium is looked for on the path.
CHROMIUMS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")

#: Widths of the text on A4 upright and across, in the pixels of a browser (96 an inch): 174 and 261 mm.
UPRIGHT_PX, ACROSS_PX = 658, 986

#: Page numbers in the contents may move the pages behind them; the book is printed until they stand still.
_MOST_PASSES = 4

_READY = """async () => {
    if (window.MathJax) await MathJax.startup.promise;
    await document.fonts.ready;
    await Promise.all([...document.images].map((image) => image.decode().catch(() => {})));
}"""

_NUMBER = """(pages) => {
    for (const link of document.querySelectorAll("nav.contents a")) {
        link.dataset.page = pages[decodeURIComponent(link.hash.slice(1))] ?? "";
    }
}"""


def write_pdf(site: Path, figures: Path, target: Path, edition: str, address: str = "") -> Path:
    """Print the book and return the file.

    Args:
        site: folder of the pages, as ``build_site`` leaves it.
        figures: folder of the drawings as SVG.
        target: the PDF; it appears when it is whole.
        edition: a line on its first page.
        address: as in ``printed_book``.

    Raises:
        FileError: there are no pages in the folder. GrindvisionError: Chromium or a package is missing, the page
            numbers never stand still, or a box is wider than the paper.
    """
    chromium = find_chromium()
    text = printed_book(site, figures, edition, address)
    document = target.with_suffix(".html")
    with write_whole(document) as path:
        path.write_text(text, encoding="utf-8")
    try:
        with _opened(document, chromium) as page:
            if beyond := laid_out(page):
                raise GrindvisionError(
                    f"{len(beyond)} boxes are wider than the paper; the first: {beyond[0]}; shorten its lines"
                )
            content = _numbered(page)
    finally:
        document.unlink(missing_ok=True)
    with write_whole(target) as path:
        path.write_bytes(content)
    return target


def installed_chromium() -> str | None:
    """Path of Chromium or Chrome; None where there is none."""
    return next(filter(None, map(shutil.which, CHROMIUMS)), None)


def find_chromium() -> str:
    """Path of Chromium or Chrome.

    Raises:
        GrindvisionError: there is none, or a package that drives it or reads PDF is not installed.
    """
    if missing := [name for name in ("playwright", "pypdf", "bs4") if find_spec(name) is None]:
        raise GrindvisionError(
            f"the PDF needs {', '.join(missing)}; install what environment.txt pins: ./run site --pdf"
        )
    found = installed_chromium()
    if found is None:
        raise GrindvisionError(
            f"the PDF is printed by Chromium, and none of {', '.join(CHROMIUMS)} is on the path; install Chromium "
            "(Debian, Ubuntu: apt-get install chromium) or build the pages without --pdf"
        )
    return found


@contextmanager
def _opened(document: Path, chromium: str) -> Iterator[Page]:
    from playwright.sync_api import Error, sync_playwright

    with sync_playwright() as playwright:
        try:
            browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        except Error as error:
            raise GrindvisionError(f"{chromium} does not start: {str(error).splitlines()[0]}") from None
        try:
            page = browser.new_page(viewport={"width": UPRIGHT_PX, "height": 1000})
            page.set_default_timeout(600_000)
            page.emulate_media(media="print", color_scheme="light")
            page.goto(document.as_uri())
            page.evaluate(_READY)
            yield page
        finally:
            browser.close()


def laid_out(page: Page) -> list[str]:
    """Make formulas and tables fit the paper; returns the boxes that do not."""
    page.evaluate("([upright, across]) => fitToPaper(upright, across)", [UPRIGHT_PX, ACROSS_PX])
    found: list[str] = page.evaluate(
        "([upright, across]) => boxesBeyondThePaper(upright, across)", [UPRIGHT_PX, ACROSS_PX]
    )
    return found


def _numbered(page: Page) -> bytes:
    """The printed document, its contents with the numbers of the pages that they lead to."""
    numbers: dict[str, int] = {}
    for _ in range(_MOST_PASSES):
        content = page.pdf(prefer_css_page_size=True, print_background=True, outline=True, tagged=True)
        found = page_numbers(content)
        if found == numbers:
            return content
        numbers = found
        page.evaluate(_NUMBER, numbers)
    raise GrindvisionError(f"the page numbers of the contents still move after {_MOST_PASSES} passes")


def page_numbers(content: bytes) -> dict[str, int]:
    """Page, counted from 1, of every place in a PDF that a link leads to, by the id it had in the document."""
    from pypdf import PdfReader

    reader = PdfReader(io.BytesIO(content))
    numbers = {}
    for name, place in reader.named_destinations.items():
        at = reader.get_destination_page_number(place)
        if at is not None:
            numbers[name.removeprefix("/")] = at + 1
    return numbers
