"""The page that shows every figure and table of the book, with its caption, its chapter and its files."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path

from grindvision.parallel import parallel_map
from grindvision_book.site.pictures import Figure, Table

#: Width of the small pictures, in pixels.
SMALL_PX = 520


def gallery_page(
    folder: Path, figures: Mapping[str, Figure], tables: Mapping[str, Table], chapters: Mapping[str, str]
) -> str:
    """Markdown of the page, beside the folder of the figures; small pictures are written into ``folder/small``.

    Args:
        folder: the figures.
        figures, tables: by name.
        chapters: two digits -> Markdown link to the chapter.
    """
    parts = [
        "# Gallery\n",
        f"All {len(figures)} figures and {len(tables)} tables of the book, chapter by chapter, with the files they are "
        "made of: drawings as SVG and PNG, the numbers that are drawn as CSV, tables as CSV and Markdown. Text and "
        "figures are [CC BY 4.0](LICENSE-TEXT). A click on a picture enlarges it.\n",
    ]
    (folder / "small").mkdir(exist_ok=True)
    for number, link in chapters.items():
        of_chapter = [figure for figure in figures.values() if figure.chapter == number]
        listed = [table for table in tables.values() if table.chapter == number]
        if not of_chapter and not listed:
            continue
        parts.append(f"## {link}\n")
        cards = parallel_map(partial(_card, folder), of_chapter)
        if cards:
            parts.append("::::{container} gallery\n" + "\n".join(cards) + "\n::::\n")
        parts += [
            f"- [Table {table.name}](figures/{table.name}.md): {table.caption.rstrip('.')}. "
            f"[csv](figures/{table.name}.csv), {{download}}`md <figures/{table.name}.md>`"
            for table in listed
        ]
        parts.append("")
    return "\n".join(parts)


def _card(folder: Path, figure: Figure) -> str:
    from PIL import Image

    small = f"small/{figure.name}_small.webp"  # no other picture of the site has its name
    with Image.open(folder / f"{figure.name}.png") as picture:
        reduced = picture.convert("RGB")
        reduced.thumbnail((SMALL_PX, SMALL_PX), Image.Resampling.LANCZOS)
        reduced.save(folder / small, quality=70, method=4)
    kinds = [kind for kind in ("svg", "png", "csv", "gif") if (folder / f"{figure.name}.{kind}").exists()]
    links = ", ".join(f"[{kind}](figures/{figure.name}.{kind})" for kind in kinds)
    return (
        f":::{{figure}} figures/{small}\n:alt: {figure.caption or figure.name}\n:name: figure-{figure.name}\n\n"
        f"**{figure.name}**. {figure.caption.rstrip('.')}. {links}\n:::"
    )
