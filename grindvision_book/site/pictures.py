"""The book's figures and tables as the pages show them: captions, and light copies of heavy pictures."""

from __future__ import annotations

import html
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

#: A drawing in SVG that is heavier than this many bytes is shown as a WebP picture instead.
HEAVY_BYTES = 75_000

#: Widest picture in a page, in pixels: nearly twice the column of text on a desk.
WIDEST_PX = 1200

_QUALITY = 55


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


def light_copies(folder: Path) -> dict[str, str]:
    """Write a WebP copy of every heavy drawing and every animation; returns file name -> name of its copy."""
    light = {}
    for path in sorted(folder.glob("*.svg")):
        if path.stat().st_size > HEAVY_BYTES and path.with_suffix(".png").exists():
            light[path.name] = f"{path.stem}.webp"
            _write_picture(path.with_suffix(".png"), folder / light[path.name])
    for path in sorted(folder.glob("*.gif")):
        light[path.name] = f"{path.stem}_moving.webp"
        _write_animation(path, folder / light[path.name])
    return light


def figures_in(folder: Path, light: Mapping[str, str]) -> dict[str, Figure]:
    """Every figure of a folder, by name; ``light`` as ``light_copies`` returns it."""
    found = {}
    for path in sorted(folder.glob("*.svg")):
        about = path.read_text(encoding="utf-8")[:4000]
        chapter = _metadata(about, "source").removeprefix("chapter ")
        found[path.stem] = Figure(path.stem, _metadata(about, "description"), chapter, light.get(path.name, path.name))
    return found


def tables_in(folder: Path) -> dict[str, Table]:
    """Every table of a folder (Markdown ending in its caption and chapter), by name."""
    found = {}
    for path in sorted(folder.glob("*.md")):
        if ending := re.search(r"^\*(.+)\* \(chapter (\d\d)\)\s*\Z", path.read_text(encoding="utf-8"), re.MULTILINE):
            found[path.stem] = Table(path.stem, ending[1], ending[2])
    return found


def lightened(text: str, light: Mapping[str, str]) -> str:
    """Text of a page in which pictures that have a light copy are replaced by it; links to files stay."""

    def lighter(match: re.Match[str]) -> str:
        return match["before"] + light.get(match["file"], match["file"])

    return re.sub(r"(?P<before>(?:!\[[^\]]*\]\(|src=\"|\{figure\} )[^)\"\s]*figures/)(?P<file>[\w.]+)", lighter, text)


def _metadata(svg: str, tag: str) -> str:
    found = re.search(rf"<dc:{tag}>(.*?)</dc:{tag}>", svg, re.DOTALL)
    return " ".join(html.unescape(found[1]).split()) if found else ""


def _write_picture(png: Path, webp: Path) -> None:
    from PIL import Image

    with Image.open(png) as picture:
        small = picture.convert("RGB")
        small.thumbnail((WIDEST_PX, 4 * WIDEST_PX), Image.Resampling.LANCZOS)
        small.save(webp, quality=_QUALITY)


def _write_animation(gif: Path, webp: Path) -> None:
    from PIL import Image, ImageSequence

    with Image.open(gif) as picture:
        duration_ms = picture.info.get("duration", 100)
        first, *others = [frame.convert("RGB") for frame in ImageSequence.Iterator(picture)]
    first.save(webp, save_all=True, append_images=others, duration=duration_ms, loop=0, quality=40)
