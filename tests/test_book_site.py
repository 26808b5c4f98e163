"""The HTML book needs nothing from outside its own folder."""

import re
import shutil
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import nbformat
import pandas as pd
import pytest
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook, new_output

from grindvision.book.answers import write_scoreboard
from grindvision.book.places import FIGURES
from grindvision.book.site import build_site

TEXT = "# Where the arm is\n\n![A picture](../figures/arm.svg)\n\nWith $T_{base,tip}$ and\n\n$$x = \\sum_i q_i$$"


class Resources(HTMLParser):
    """Collects what a browser loads for a page: scripts, styles, pictures."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        if tag in ("script", "img", "iframe") and attributes.get("src"):
            self.found.append(attributes["src"])
        if tag == "link" and attributes.get("rel") in ("stylesheet", "preload", "icon"):
            self.found.append(attributes["href"])


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("book")
    shutil.copytree(FIGURES, folder / "figures")  # the front page shows some of them
    (folder / "figures" / "arm.svg").write_text('<svg xmlns="http://www.w3.org/2000/svg" width="9" height="9"/>')
    pd.DataFrame({"x_mm": [1.0]}).to_csv(folder / "figures" / "arm.csv", index=False)
    (folder / "figures" / "poses.md").write_text("| pose |\n| --- |\n| 1 |\n\n*Base frame; printed*\n")
    write_scoreboard(folder / "figures")
    code = new_code_cell("1 + 1")
    code.outputs = [new_output("execute_result", data={"text/plain": "the sum is two"}, execution_count=1)]
    for place, cells in (("notebooks", [new_markdown_cell(TEXT)]), ("executed", [new_markdown_cell(TEXT), code])):
        (folder / place).mkdir()
        nbformat.write(new_notebook(cells=cells), folder / place / "07_arm.ipynb")
    return build_site(folder, folder / "figures", folder / "notebooks", folder / "site").parent


def test_every_resource_of_every_page_is_a_file_of_the_site(site):
    pages = list(site.rglob("*.html"))
    assert {"index.html", "search.html", "07_arm.html", "scoreboard.html"} <= {page.name for page in pages}
    for page in (page for page in pages if "_static" not in page.parts):
        parser = Resources()
        parser.feed(page.read_text(encoding="utf-8"))
        assert parser.found
        for resource in parser.found:
            assert "//" not in resource, f"{page.name} loads {resource}"
            assert (page.parent / unquote(resource.split("?")[0])).exists(), f"{page.name}: {resource} is not there"


def test_styles_fetch_no_font_from_elsewhere(site):
    for style in site.rglob("*.css"):
        text = style.read_text(encoding="utf-8")
        assert not re.search(r"(url\(|@import)\s*[\"']?\s*(https?:)?//", text), style


def test_formulas_are_drawn_by_a_script_of_the_site(site):
    page = (site / "notebooks" / "07_arm.html").read_text(encoding="utf-8")
    assert page.count('class="math') == 2
    assert "mathjax/tex-svg.js" in page and (site / "_static" / "mathjax" / "tex-svg.js").stat().st_size > 1e6


def test_executed_outputs_are_shown_and_searchable(site):
    assert "the sum is two" in (site / "notebooks" / "07_arm.html").read_text(encoding="utf-8")
    assert "notebooks/07_arm" in (site / "searchindex.js").read_text(encoding="utf-8")


def test_the_scoreboard_is_a_page(site):
    assert "not yet" in (site / "figures" / "scoreboard.html").read_text(encoding="utf-8")
