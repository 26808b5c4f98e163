"""The book's figures and tables as the pages show them: captions, and light copies of heavy pictures."""

from __future__ import annotations

import base64
import html
import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from grindvision.parallel import parallel_map

if TYPE_CHECKING:
    from PIL import Image

#: A drawing in SVG that is heavier than this many bytes is shown as a WebP picture instead, unless white text stands on
#: colours in it: of pixels, what is text and what is ground cannot be told for the dark copy.
HEAVY_BYTES = 75_000

#: Widest picture in a page, in pixels: nearly twice the column of text on a desk.
WIDEST_PX = 1200

_QUALITY = 55

#: Brightness of the ground of dark figures, and of what is black in light ones.
DARK, BRIGHT = 20, 222

#: Colours whose channels differ by no more are grey.
_GREY = 24

#: Least luma (weighted mean of the channels, 0 to 255) of a line's colour on the dark ground: three times as bright as
#: the ground, as WCAG asks of what is no text.
LEAST_LUMA = 95

#: The box of a text, as Matplotlib draws it just before the text: what stands behind its outline.
_BOX = re.compile(r'"([^"<>]*)"/>\s*</g>\s*<!--[^>]*-->\s*<g style="fill: $')


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
    heavy = [
        path
        for path in sorted(folder.glob("*.svg"))
        if path.stat().st_size > HEAVY_BYTES and path.with_suffix(".png").exists() and not _white_text_in(path)
    ]
    moving = sorted(folder.glob("*.gif"))
    light = {path.name: f"{path.stem}.webp" for path in heavy} | {
        path.name: f"{path.stem}_moving.webp" for path in moving
    }
    parallel_map(lambda path: _write_picture(path.with_suffix(".png"), folder / light[path.name]), heavy)
    parallel_map(lambda path: _write_animation(path, folder / light[path.name]), moving)
    return light


def dark_copies(folder: Path, target: Path, light: Mapping[str, str]) -> None:
    """Write each drawing as the pages show it, light lines on a dark ground; strong colours stay as they are.

    Args:
        folder: of the figures.
        target: folder for the copies, of the same names.
        light: as ``light_copies`` returns it.
    """
    target.mkdir(parents=True, exist_ok=True)

    def write(path: Path) -> None:
        shown = light.get(path.name, path.name)
        if shown == path.name:
            (target / shown).write_text(dark_svg(path.read_text(encoding="utf-8")), encoding="utf-8")
        else:
            _write_dark_picture(folder / shown, target / shown)

    parallel_map(write, sorted(folder.glob("*.svg")))


def dark_svg(svg: str) -> str:
    """A drawing of Matplotlib with greys from white to black turned into greys from ``DARK`` to light.

    Colours too deep for a dark ground become brighter; white text on a colour stays as it is.
    """

    def turned(match: re.Match[str]) -> str:
        colour = _channels(match[1])
        if match[2] and not _stands_on_ground(match, colour):
            return match[0]
        if _is_grey(colour):
            middle = sum(colour) / 3  # a tint keeps its hue
            return _hex([_on_dark(middle) + channel - middle for channel in colour]) + match[2]
        less = float(_ground()[min(colour)])
        return _hex([channel - less for channel in colour] if less else _bright_enough(colour)) + match[2]

    drawing = re.sub(r'#([0-9a-fA-F]{6})\b((?:" transform=)?)', turned, svg)
    drawing = re.sub(r'(data:image/png;base64,)([^"]+)', _dark_layer, drawing)
    # What has no fill of its own, such as text, is black.
    text = f"{round(_on_dark(0)):02x}"
    return drawing.replace("<svg ", f'<svg fill="#{3 * text}" ', 1)


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


def _white_text_in(path: Path) -> bool:
    return 'fill: #ffffff" transform=' in path.read_text(encoding="utf-8")


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


@cache
def _ground() -> np.ndarray:
    """How much darker a colour with a hue becomes whose least channel is 0 to 255.

    A pale colour is a translucent one on white, its least channel the share of white: on the dark ground that share is
    ``DARK``. A colour with less than half of white is one of its own and stays; in between the share grows evenly.
    """
    least = np.arange(256, dtype=np.float32)
    return least * np.clip((least - 128) / 64, 0, 1) * np.float32((255 - DARK) / 255)


def _on_dark(grey: float) -> float:
    return BRIGHT + (DARK - BRIGHT) * grey / 255


def _channels(code: str) -> list[int]:
    return [int(code[k : k + 2], 16) for k in (0, 2, 4)]


def _hex(colour: Sequence[float]) -> str:
    return "#" + "".join(f"{round(channel):02x}" for channel in colour)


def _is_grey(colour: Sequence[int]) -> bool:
    return max(colour) - min(colour) <= _GREY


def _stands_on_ground(text: re.Match[str], colour: Sequence[int]) -> bool:
    """Whether a text with a colour of its own is turned with the ground, or with a grey box of its own.

    Text that could not be read on white, and text in a box of a colour, was made for what is behind it.
    """
    if box := _BOX.search(text.string, max(text.start() - 1000, 0), text.start()):
        fill = re.search(r"fill: #([0-9a-fA-F]{6})", box[1])
        return fill is None or _is_grey(_channels(fill[1]))
    return _is_grey(colour) and max(colour) < 200


def _bright_enough(colour: Sequence[float]) -> list[float]:
    """A colour mixed with as much white as it needs to be ``LEAST_LUMA``."""
    luma = 0.2126 * colour[0] + 0.7152 * colour[1] + 0.0722 * colour[2]
    white = max((LEAST_LUMA - luma) / (255 - luma), 0.0)
    return [channel + white * (255 - channel) for channel in colour]


def _darkened(picture: Image.Image) -> Image.Image:
    """A picture (RGBA) whose greys are turned, and whose other colours stay, but for the white behind pale ones."""
    from PIL import Image

    pixels = np.array(picture.convert("RGBA"))
    colours = [pixels[..., k] for k in range(3)]
    spread = np.maximum(np.maximum(*colours[:2]), colours[2]) - np.minimum(np.minimum(*colours[:2]), colours[2])
    hue = np.clip(np.arange(256, dtype=np.float32) / (2 * _GREY), 0, 1)
    gain, shift = (hue + (1 - hue) * (DARK - BRIGHT) / 255)[spread], ((1 - hue) * BRIGHT)[spread]
    shift -= hue[spread] * _ground()[np.minimum(np.minimum(*colours[:2]), colours[2])]
    for colour in colours:
        colour[:] = np.clip(np.rint(gain * colour + shift), 0, 255)
    return Image.fromarray(pixels, "RGBA")


def _dark_layer(match: re.Match[str]) -> str:
    from PIL import Image

    layer = io.BytesIO()
    with Image.open(io.BytesIO(base64.b64decode(match[2]))) as picture:
        _darkened(picture).save(layer, format="PNG")
    return match[1] + base64.b64encode(layer.getvalue()).decode()


def _write_dark_picture(light: Path, dark: Path) -> None:
    from PIL import Image

    with Image.open(light) as picture:
        _darkened(picture).convert("RGB").save(dark, quality=_QUALITY)
