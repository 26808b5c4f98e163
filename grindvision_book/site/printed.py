"""The pages of the HTML book laid out as one document to print: links lead inside it, what moves is left out."""

from __future__ import annotations

import html
import posixpath
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import unquote, urldefrag

import grindvision
from grindvision.errors import FileError

if TYPE_CHECKING:
    from bs4 import BeautifulSoup, Tag

PRINT = Path(__file__).with_name("print")

#: Pages whose content stands in the chapters or on another page, that move, or that are looked up rather than read.
LEFT_OUT = re.compile(r"(gallery|scenes|figures/scoreboard|api/.*)\.html")

#: What a reader of paper cannot use: buttons, sliders, scenes, downloads, the folded code that draws.
_USELESS = (
    "script, iframe, button, a.headerlink, p.take, a.scene, figure.frames, details.hide, .filters, .toctree-wrapper"
)

_CHAPTER = re.compile(r"notebooks/\d\d_")


@dataclass(frozen=True)
class Line:
    """A line of the contents: the ``part`` of the book, or a page or a section with the id that it leads to."""

    text: str
    kind: str
    target: str = ""


def pages_in_order(site: Path) -> list[tuple[str, str]]:
    """The pages to print as the contents of the first page name them: part of the book, page.

    Raises:
        FileError: there are no pages in the folder.
    """
    first = site / "index.html"
    if not first.is_file():
        raise FileError(f"{first} is not there; build the pages first: ./run site")
    pages, part = [("", "index.html")], ""
    for found in _soup(first).select("nav.bd-links p.caption, nav.bd-links a[href]"):
        page = urldefrag(str(found.get("href", "")))[0]
        if found.name == "p":
            part = found.get_text(" ", strip=True)
        elif page and "://" not in page and not LEFT_OUT.fullmatch(page) and (part, page) not in pages:
            pages.append((part, page))
    return pages


def printed_book(site: Path, figures: Path, edition: str, address: str = "") -> str:
    """HTML of the whole book.

    Args:
        site: folder of the pages, as ``build_site`` leaves it.
        figures: folder of the drawings as SVG; where it has one, it stands in the place of a picture's lighter copy.
        edition: a line on the first page, such as the version.
        address: where the pages stand; links to what is not printed lead there, and are no links without it.
    """
    pages = pages_in_order(site)
    soups = {page: _soup(site / page) for _, page in pages}
    articles = {page: soup.select_one("article.bd-article") for page, soup in soups.items()}
    printed = {page: article for page, article in articles.items() if article}
    targets = {page: {str(tag["id"]) for tag in article.select("[id]")} for page, article in printed.items()}
    contents, sections, part_before = [], [], ""
    for part, page in pages:
        if page not in printed:
            continue
        article = printed[page]
        for tag in article.select(_USELESS):
            tag.decompose()
        _lead_inside(article, page, targets, address)
        _whole_pictures(article, page, site, figures)
        if part != part_before:
            contents.append(Line(part, "part"))
            part_before = part
        contents += _lines_of(article, page)
        sections.append(f'<section class="page" id="{_slug(page)}">{article}</section>')
    with_formulas = next((page for page, soup in soups.items() if soup.select_one(".math")), "index.html")
    scripts = "\n".join(map(str, _mathjax(soups[with_formulas], with_formulas, site)))
    return _DOCUMENT.format(
        styles="\n".join(
            [
                (site / "_static" / "pygments.css").read_text(encoding="utf-8"),
                (site / "_static" / "book.css").read_text(encoding="utf-8"),
                (PRINT / "print.css").read_text(encoding="utf-8"),
            ]
        ),
        scripts=scripts + f"<script>{(PRINT / 'print.js').read_text(encoding='utf-8')}</script>",
        version=grindvision.__version__,
        edition=html.escape(edition),
        contents="\n".join(map(_contents_line, contents)),
        sections="\n".join(sections),
    )


def _soup(path: Path) -> BeautifulSoup:
    from bs4 import BeautifulSoup

    return BeautifulSoup(path.read_text(encoding="utf-8"), "html.parser")


def _slug(page: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", page.removesuffix(".html").lower())


def _from_root(address: str, page: str) -> str:
    """A relative address of a page, as one of the folder of all pages."""
    return posixpath.normpath(posixpath.join(posixpath.dirname(page), unquote(address)))


def _whole_path(address: str, page: str, site: Path) -> Path:
    return (site / _from_root(address, page)).resolve()


def _lead_inside(article: Tag, page: str, targets: dict[str, set[str]], address: str) -> None:
    """Ids carry their page's name, so that none comes twice; links between pages become links in the document."""
    for tag in article.select("[id]"):
        tag["id"] = f"{_slug(page)}--{tag['id']}"
    for link in article.select("a[href]"):
        href = str(link["href"])
        if re.match(r"[a-z]+:", href):
            continue
        name, fragment = urldefrag(href)
        other = _from_root(name, page) if name else page
        if other in targets:
            link["href"] = f"#{_slug(other)}" + (f"--{fragment}" if fragment in targets[other] else "")
        elif address and not other.startswith(".."):
            link["href"] = address + other
        else:
            link.unwrap()
    for fold in article.select("details"):
        fold["open"] = ""


def _whole_pictures(article: Tag, page: str, site: Path, figures: Path) -> None:
    """Pictures by their whole address: the drawing itself where there is one, in place of a lighter copy of it."""
    for picture in article.select("img[src]"):
        source = str(picture["src"])
        if source.startswith("data:"):
            continue
        file = _whole_path(source, page, site)
        drawing = figures / f"{file.stem.removesuffix('_moving')}.svg"
        picture["src"] = (drawing.resolve() if drawing.is_file() else file).as_uri()
        for name in ("data-dark", "loading"):
            del picture[name]


def _lines_of(article: Tag, page: str) -> list[Line]:
    """A page's title and, of a chapter, its sections."""
    levels = "h1, h2" if _CHAPTER.match(page) else "h1"
    lines: list[Line] = []
    for heading in article.select(levels):
        owner = heading.find_parent("section", id=True)
        if owner and not (heading.name == "h1" and lines):
            kind = "page" if heading.name == "h1" else "section"
            target = _slug(page) if kind == "page" else str(owner["id"])
            lines.append(Line(heading.get_text("", strip=False).strip(), kind, target))
    return lines


def _contents_line(line: Line) -> str:
    text = html.escape(line.text)
    return (
        f'<p class="part">{text}</p>'
        if line.kind == "part"
        else f'<a class="{line.kind}" href="#{line.target}">{text}</a>'
    )


def _mathjax(soup: BeautifulSoup, page: str, site: Path) -> list[Tag]:
    """The scripts that set the formulas, by their whole address; a page without formulas may have none."""
    found = []
    for script in soup.select("script"):
        source = str(script.get("src", ""))
        if "mathjax" in source.lower() or "MathJax" in script.get_text():
            if source:
                script["src"] = _whole_path(source.split("?")[0], page, site).as_uri()
            found.append(script)
    return found


_DOCUMENT = """<!DOCTYPE html>
<html lang="en" data-theme="light">
<head><meta charset="utf-8"><title>grindvision {version}</title><style>{styles}</style>{scripts}</head>
<body class="bd-content"><div class="bd-article">
<section class="title">
<h1>grindvision</h1>
<p>Two papers on robot vision, rebuilt by experiment: 3D vision for grinding, groove detection for welding</p>
<p class="edition">{edition}<br>grindvision contributors. Text and figures: CC BY 4.0</p>
<p>Every table and figure says whether its numbers are <em>printed</em> in a paper, <em>synthetic</em> or
<em>measured</em>. The pages of the book hold what is left out here: code that only draws, sliders, turning scenes, the
gallery, and the reference of the package's functions.</p>
</section>
<nav class="contents page"><h2>Contents</h2>
{contents}
</nav>
{sections}
</div></body></html>
"""
