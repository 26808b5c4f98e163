"""The HTML book for tests: built once, without executing chapters; their cells show the committed figures instead."""

import re
from html.parser import HTMLParser
from pathlib import Path
from unittest import mock

import nbformat
from nbformat.v4 import new_output

from grindvision_book.machinery.chapters import chapters
from grindvision_book.machinery.places import FIGURES
from grindvision_book.site import build_site, reference

#: What a cell of chapter 07 is made to have printed.
SAID = "the sum is two"


#: The reference of one public module in so many is drawn, unless all are asked for: it takes most of the time.
ONE_MODULE_IN = 5


def build_whole_site(folder: Path, one_module_in: int = ONE_MODULE_IN) -> Path:
    """Build every page into ``folder/site`` and return that folder."""
    (folder / "executed").mkdir(exist_ok=True)
    for chapter in chapters().values():
        notebook = nbformat.read(chapter, as_version=4)
        for cell in notebook.cells:
            if cell.cell_type == "code":
                cell.outputs = drawn_outputs(cell.source)
        if chapter.name.startswith("07"):
            first = next(cell for cell in notebook.cells if cell.cell_type == "code")
            first.outputs = [new_output("stream", name="stdout", text=SAID)]
        nbformat.write(notebook, folder / "executed" / chapter.name)
    every = reference.public_modules_of
    with mock.patch.object(reference, "public_modules_of", lambda room: every(room)[::one_module_in]):
        return build_site(folder, FIGURES, site=folder / "site").parent


def drawn_outputs(source: str) -> list:
    """What a cell that saves figures shows: each drawing, then its caption, as ``book.save_figure`` displays them."""
    names = re.findall(r'"(\w+)"', source) if "book.save_" in source else []
    outputs = []
    for path in (FIGURES / f"{name}.svg" for name in names):
        if path.exists():
            svg = path.read_text(encoding="utf-8")
            caption = re.findall(r"<dc:description>(.*?)</dc:description>", svg, re.DOTALL)[0]
            outputs.append(new_output("display_data", data={"image/svg+xml": svg}))
            outputs.append(new_output("display_data", data={"text/markdown": f"*{caption}*"}))
    return outputs


class Page(HTMLParser):
    """What the tests ask of a page: language, headings in order, pictures, links, targets, and what a browser loads."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path
        self.language = ""
        self.headings: list[int] = []
        self.pictures: list[dict[str, str]] = []
        self.links: list[str] = []
        self.targets: set[str] = set()
        self.resources: list[str] = []
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attrs):
        attributes = {name: value or "" for name, value in attrs}
        self.targets |= {attributes[name] for name in ("id", "name") if name in attributes}
        if tag == "html":
            self.language = attributes.get("lang", "")
        if re.fullmatch(r"h[1-6]", tag):
            self.headings.append(int(tag[1]))
        if tag == "img":
            self.pictures.append(attributes)
        if tag == "a" and attributes.get("href"):
            self.links.append(attributes["href"])
        if tag in ("script", "img", "iframe") and attributes.get("src"):
            self.resources.append(attributes["src"])
        if tag == "link" and attributes.get("rel") in ("stylesheet", "preload", "icon"):
            self.resources.append(attributes["href"])
