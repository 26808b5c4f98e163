"""Pages to read while a book is being built: each chapter's as soon as it is done, and a list that renews itself.

They are plain files in ``build/reading``: no server, no network. The HTML book with its contents, search and reference
takes their place when everything is done.
"""

from __future__ import annotations

import html
import re
import shutil
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from grindvision.files import write_text
from grindvision_book.machinery.notebook_files import nbformat
from grindvision_book.machinery.places import NOTEBOOKS

if TYPE_CHECKING:
    from grindvision_book.machinery.rebuilding import Outcome

#: Seconds after which a browser reads the list again.
RENEW_S = 5

_STYLE = """
body { font: 16px/1.55 system-ui, sans-serif; max-width: 52rem; margin: 2rem auto; padding: 0 1rem; color: #222; }
img, svg { max-width: 100%; height: auto; } table { border-collapse: collapse; font-size: 0.9em; }
td, th { padding: 0.2rem 0.6rem; border-bottom: 1px solid #ddd; text-align: left; }
pre { background: #f6f6f6; padding: 0.6rem; overflow-x: auto; font-size: 0.85em; } a.anchor-link { display: none; }
@media (prefers-color-scheme: dark) { body { background: #fff; } }
"""


def write_page(notebook: Path, page: Path, title: str) -> None:
    """Write a chapter's executed copy as one file of HTML, pictures inside; nothing where there is no such copy."""
    from nbconvert import HTMLExporter

    if not notebook.exists():
        return
    exporter = HTMLExporter(template_name="basic", embed_images=True)
    content = nbformat.read(notebook, as_version=4)
    body, _ = exporter.from_notebook_node(content, resources={"metadata": {"path": str(NOTEBOOKS)}})
    write_text(page, _document(title, body, _formulas() + _colours()))


class ReadingPage:
    """The list of the chapters with their state, rewritten at every change.

    Args:
        folder: of the list and the pages.
        titles: two digits of each chapter -> its title.
    """

    def __init__(self, folder: Path, titles: Mapping[str, str]) -> None:
        self._folder, self._titles = folder, titles
        self._states: dict[str, str] = {}
        self._left = ""

    @property
    def address(self) -> str:
        """What a browser opens."""
        return (self._folder / "index.html").resolve().as_uri()

    def planned(self, numbers: Sequence[str]) -> None:
        """Chapters of this build; nothing is done yet."""
        shutil.rmtree(self._folder, ignore_errors=True)
        self._states = dict.fromkeys(sorted(numbers), "waits")
        self._write()

    def started(self, number: str) -> None:
        """A chapter is being built."""
        self._states[number] = "is being built"
        self._write()

    def finished(self, number: str, outcome: Outcome, page: Path | None) -> None:
        """A chapter has come to its end."""
        state = "failed: " + html.escape(outcome.failure) if outcome.failure else "done"
        if page is not None:
            shutil.copyfile(page, self._folder / f"{number}.html")
            state = f"<a href='{number}.html'>{'what it shows' if outcome.failure else 'read it'}</a>, {state}"
        self._states[number] = state
        self._write()

    def left(self, text: str) -> None:
        """Say how long the build will take."""
        if text != self._left:
            self._left = text
            self._write()

    def ended(self, site: Path | None) -> None:
        """Everything is done: lead to the HTML book where there is one, and stop to renew the list."""
        link = f"<p><a href='{site.resolve().as_uri()}'>The HTML book</a> is complete.</p>" if site else ""
        self._write(f"<p>Everything is done.</p>{link}", renew=False)

    def stopped(self) -> None:
        """The build was ended before its end: say so, and stop to renew the list."""
        self._write("<p>The build was interrupted; call it again and it goes on with what is left.</p>", renew=False)

    def _write(self, head: str = "", renew: bool = True) -> None:
        rows = "".join(
            f"<tr><td>{number}</td><td>{html.escape(self._titles.get(number, ''))}</td><td>{state}</td></tr>"
            for number, state in self._states.items()
        )
        told = head or f"<p>The chapters are being built. {html.escape(self._left)}</p>"
        refresh = f"<meta http-equiv='refresh' content='{RENEW_S}'>" if renew else ""
        body = f"<h1>grindvision: the book</h1>{told}<table>{rows}</table>"
        write_text(self._folder / "index.html", _document("grindvision: the book", body, refresh))


def titles(chapters: Mapping[str, Path]) -> dict[str, str]:
    """Two digits of each chapter -> the title that stands above it, without them."""
    import json

    found = {}
    for number, path in chapters.items():
        try:
            first = json.loads(path.read_text(encoding="utf-8"))["cells"][0]["source"]
        except (OSError, ValueError, KeyError, IndexError):
            first = ""
        title = re.search(r"^# (?:\d\d )?(.+)$", "".join(first), re.MULTILINE)
        found[number] = title[1] if title else path.stem
    return found


def _document(title: str, body: str, head: str) -> str:
    return (
        "<!doctype html>\n<html lang='en'><head><meta charset='utf-8'>"
        f"<title>{html.escape(title)}</title><style>{_STYLE}</style>{head}</head>\n<body>{body}</body></html>\n"
    )


def _formulas() -> str:
    """What draws formulas: the copy of MathJax that the HTML book brings, read where it is installed."""
    spec = find_spec("sphinx-mathjax-offline")
    script = Path(spec.origin).parent / "static" / "mathjax" / "tex-svg-full.js" if spec and spec.origin else None
    if script is None or not script.is_file():
        return ""
    settings = "MathJax = {tex: {inlineMath: [['$', '$']], processEscapes: true}}"
    return f"<script>{settings}</script><script src='{script.as_uri()}' defer></script>"


def _colours() -> str:
    from pygments.formatters import HtmlFormatter

    return f"<style>{HtmlFormatter().get_style_defs('.highlight')}</style>"
