"""The top of every report.png: did it work? In words, on a coloured band, with what the user should know below."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

from grindvision.extras import extra

with extra("plot"):
    from matplotlib.figure import Figure


GOOD, LOOK = "#D8EFE3", "#FCE8B8"
WIDTH = 118
TITLE_INCHES = 0.4


def draw_verdict(figure: Figure, verdict: str, facts: str, warnings: Sequence[str], max_warnings: int = 4) -> None:
    """Write a figure's title: the verdict, the facts, the warnings; green without warnings, yellow with them.

    The figure's layout keeps the room free: a ``constrained`` one, or, where it has none, the top of its axes.
    """
    lines = [facts]
    for text in warnings[:max_warnings]:
        lines += textwrap.wrap(f"Look: {text}", WIDTH, subsequent_indent="    ", max_lines=4, placeholder=" ...")
    if len(warnings) > max_warnings:
        lines.append(f"and {len(warnings) - max_warnings} more in report.json")
    height = 0.42 + 0.19 * len(lines)
    fraction = height / figure.get_figheight()
    if figure.get_layout_engine() is None:
        figure.subplots_adjust(top=1 - fraction - TITLE_INCHES / figure.get_figheight())
    else:
        figure.set_layout_engine("constrained", rect=(0, 0, 1, 1 - fraction))
    band = figure.add_axes((0, 1 - fraction, 1, fraction), zorder=-1)
    band.set_in_layout(False)
    band.set_facecolor(LOOK if warnings else GOOD)
    band.set(xticks=[], yticks=[])
    for spine in band.spines.values():
        spine.set_visible(False)
    band.text(
        0.012,
        1 - 0.08 / height,
        verdict,
        transform=band.transAxes,
        va="top",
        fontsize=14,
        fontweight="bold",
        parse_math=False,
    )
    band.text(
        0.012, 1 - 0.36 / height, "\n".join(lines), transform=band.transAxes, va="top", fontsize=9.5, parse_math=False
    )
