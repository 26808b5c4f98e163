"""The book's figures and tables as the pages show them: captions, and light copies of heavy pictures."""

from __future__ import annotations

import html
import re
from dataclasses import dataclass
from pathlib import Path

#: A drawing in SVG that is heavier than this many bytes is shown as a WebP picture instead.
HEAVY_BYTES = 90_000

#: Widest picture in a page, in pixels: nearly twice the column of text on a desk.
WIDEST_PX = 1200


@dataclass(frozen=True)
class Figure:
    """A figure: ``name`` of its files, ``caption``, two digits of its ``chapter``, ``shown`` file in the pages."""

    name: str
    caption: str
    chapter: str
    shown: str


@dataclass(frozen=True)
class Table:
    """A table: ``name`` of its files, ``caption``, and two digits of its ``chapter``."""

    name: str
    caption: str
    chapter: str


def figures_in(folder: Path) -> dict[str, Figure]:
    """Every figure of a folder, by name; heavy ones get a WebP copy beside them."""
    return {path.stem: _figure(path) for path in sorted(folder.glob("*.svg"))}


def tables_in(folder: Path) -> dict[str, Table]:
    """Every table of a folder (Markdown ending in its caption and chapter), by name."""
    found = {}
    for path in sorted(folder.glob("*.md")):
        if ending := re.search(r"^\*(.+)\* \(chapter (\d\d)\)\s*\Z", path.read_text(encoding="utf-8"), re.MULTILINE):
            found[path.stem] = Table(path.stem, ending[1], ending[2])
    return found


def lightened(text: str, figures: dict[str, Figure]) -> str:
    """Text of a page in which pictures of heavy figures are replaced by their light copies; links to files stay."""

    def lighter(match: re.Match[str]) -> str:
        figure = figures.get(match["name"])
        return match[0] if figure is None else f"{match['before']}{figure.shown}"

    return re.sub(r"(?P<before>(?:!\[[^\]]*\]\(|src=\"|\{figure\} )[^)\"]*figures/)(?P<name>\w+)\.svg", lighter, text)


def _figure(path: Path) -> Figure:
    about = path.read_text(encoding="utf-8")[:4000]
    caption, source = (_metadata(about, tag) for tag in ("description", "source"))
    shown = path.name
    if path.stat().st_size > HEAVY_BYTES and path.with_suffix(".png").exists():
        shown = path.with_suffix(".webp").name
        _write_webp(path.with_suffix(".png"), path.with_suffix(".webp"))
    return Figure(path.stem, caption, source.removeprefix("chapter "), shown)


def _metadata(svg: str, tag: str) -> str:
    found = re.search(rf"<dc:{tag}>(.*?)</dc:{tag}>", svg, re.DOTALL)
    return " ".join(html.unescape(found[1]).split()) if found else ""


def _write_webp(png: Path, webp: Path) -> None:
    from PIL import Image

    with Image.open(png) as picture:
        small = picture.convert("RGB")
        small.thumbnail((WIDEST_PX, 4 * WIDEST_PX), Image.Resampling.LANCZOS)
        small.save(webp, quality=72, method=6)
