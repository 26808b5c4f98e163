"""report.png and report.pdf of ``grindvision grind``: map, section, numbers and verdict of each piece."""

from __future__ import annotations

import platform
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from grindvision import __version__
from grindvision.cli.verdict import draw_verdict
from grindvision.extras import extra
from grindvision.files import write_whole
from grindvision.words import rounded

with extra("plot"):
    import matplotlib
    from matplotlib.axes import Axes
    from matplotlib.backends.backend_pdf import PdfPages
    from matplotlib.figure import Figure

if TYPE_CHECKING:
    from grindvision.motion.grinding import GrindingPlan
    from grindvision.vision.change.remaining import Remaining
    from grindvision.vision.change.stock import StockPiece

BEFORE, AFTER, PATH, GREY = "#D55E00", "#0072B2", "#222222", "#999999"


def draw(
    pieces: Sequence[StockPiece],
    plans: Sequence[GrindingPlan | None],
    judged: Sequence[Remaining] | None,
    message: str,
    warnings: Sequence[str],
    facts: Mapping[str, Any],
    folder: Path,
) -> None:
    """Draw the largest piece as report.png, and a page for each piece as report.pdf."""
    figure = Figure(figsize=(12, 7.5), layout="constrained")
    _draw_piece(figure.subplots(2, 2), pieces[0], plans[0])
    head, *rest = message.split("; ")
    draw_verdict(figure, _cut(head[:1].upper() + head[1:], 105), _cut("; ".join(rest), 150), warnings)
    with write_whole(folder / "report.png") as temporary:
        figure.savefig(temporary, dpi=100)
    with write_whole(folder / "report.pdf") as temporary, PdfPages(temporary, metadata={"CreationDate": None}) as pages:
        for number, (piece, plan) in enumerate(zip(pieces, plans, strict=True), start=1):
            verdict = None if judged is None else judged[number - 1]
            pages.savefig(_page(number, len(pieces), piece, plan, verdict, warnings, facts))


def _cut(text: str, longest: int) -> str:
    """The text, or as many of its words as fit, with the mark of an omission."""
    return text if len(text) <= longest else text[: longest - 1].rsplit(" ", 1)[0] + "…"


def _page(
    number: int,
    count: int,
    piece: StockPiece,
    plan: GrindingPlan | None,
    verdict: Remaining | None,
    warnings: Sequence[str],
    facts: Mapping[str, Any],
) -> Figure:
    """One page of A4."""
    figure = Figure(figsize=(8.27, 11.69))
    figure.set_layout_engine("constrained", rect=(0.02, 0.30, 0.96, 0.62), h_pad=0.08)
    _draw_piece(figure.subplots(2, 2), piece, plan)
    said = (
        "planned" if verdict is None else "met" if verdict.met else "NOT MET" if verdict.judged else "CANNOT BE JUDGED"
    )
    serials = "   ".join(f"{name}: {value}" for name, value in facts["serials"].items())
    figure.text(0.06, 0.965, f"Grinding report, piece {number} of {count}: {said}", fontsize=14, fontweight="bold")
    figure.text(0.06, 0.942, _cut(serials or "no serial numbers given", 105), fontsize=8.5, parse_math=False)
    rows = _rows(piece, plan, verdict)
    for at, (name, value) in enumerate(rows):
        left, up = 0.06 + 0.48 * (at % 2), 0.275 - 0.0165 * (at // 2)
        figure.text(left, up, name, fontsize=8)
        figure.text(left + 0.18, up, value, fontsize=8, parse_math=False)
    lines = [line for text in warnings[:4] for line in textwrap.wrap(_cut(f"Look: {text}", 240), 125)]
    lines += [f"{_cut(Path(path).name, 50)}  sha256 {digest}" for path, digest in facts["inputs"].items()]
    lines.append(f"grindvision {__version__}, Python {platform.python_version()}, Matplotlib {matplotlib.__version__}")
    lines.append("Heights over the good surface along its normals; frame: scanner frame of the last scan; sigma: one.")
    figure.text(0.06, 0.02, "\n".join(lines), fontsize=7, va="bottom", linespacing=1.5, parse_math=False)
    return figure


def _rows(piece: StockPiece, plan: GrindingPlan | None, verdict: Remaining | None) -> list[tuple[str, str]]:
    """Names and values of the table."""
    asked = [] if piece.asked_mm is None else [("layer", f"{piece.asked_mm:g} mm as asked for, not measured")]
    rows = [
        *asked,
        ("volume", f"{piece.volume_mm3:.4g} +- {rounded(piece.volume_sigma_mm3, 2)} mm3"),
        ("area above detection", f"{piece.area_mm2:.4g} +- {rounded(piece.area_sigma_mm2, 2)} mm2"),
        ("greatest height", f"{piece.height_max_mm:.3f} +- {piece.height_max_sigma_mm:.2g} mm"),
        ("mean height there", f"{piece.height_mean_mm:.3f} +- {piece.height_mean_sigma_mm:.2g} mm"),
        ("level of detection", f"{piece.level_mm:.3f} mm"),
        ("hidden / not shown", f"{rounded(piece.hidden_mm2)} / {rounded(piece.unshown_mm2)} mm2"),
    ]
    if verdict is not None:
        rows += [
            ("tolerance", f"{verdict.tolerance_mm:g} mm"),
            ("remains at most", f"{verdict.height_max_mm:.3f} +- {verdict.height_max_sigma_mm:.2g} mm"),
            ("remains in the mean", f"{verdict.height_mean_mm:.3f} +- {verdict.height_mean_sigma_mm:.2g} mm"),
            ("area over tolerance", f"{rounded(verdict.over_mm2)} mm2"),
            ("gouged area, depth", f"{rounded(verdict.gouged_mm2)} mm2, {verdict.gouge_mm:.3f} mm"),
        ]
    if plan is not None:
        options = plan.options
        tool = f"{options.tool}, radius {options.radius_mm:g} mm"
        tool += f", {options.width_mm:g} mm wide" if options.tool == "wheel" else ""
        feeds, forces = ([getattr(one, name) for one in plan.passes] for name in ("feed_mm_s", "force_n"))
        rows += [
            ("tool", tool),
            ("passes", f"{len(plan.passes)} of {options.depth_mm:g} mm, pattern {options.pattern}"),
            ("to be left", f"{plan.leave_mm:.3f} mm"),
            ("wheel", _zeroed(plan)),
            ("feed", f"{min(feeds):.3g} to {max(feeds):.3g} mm/s"),
            ("force", f"{min(forces):.3g} to {max(forces):.3g} N"),
            ("in contact", f"{plan.seconds:.0f} s"),
        ]
    return rows


def _zeroed(plan: GrindingPlan) -> str:
    """How it is known where the wheel meets the surface."""
    work = plan.work
    if work.offset_mm == work.offset_sigma_mm == 0:
        return "to be touched off on the surface"
    return f"{work.offset_mm:+.3f} +- {work.offset_sigma_mm:.2g} mm, not touched off"


def _draw_piece(axes: np.ndarray, piece: StockPiece, plan: GrindingPlan | None) -> None:
    """Height now, height planned, path, and a section."""
    now, planned = axes[0]
    way, section = axes[1]
    top = max(piece.height_max_mm, 2 * piece.level_mm)
    asked = piece.asked_mm is not None
    _map(now, piece, piece.map.heights_mm, top, "layer as asked for" if asked else "measured height")
    _map(planned, piece, piece.map.heights_mm if plan is None else plan.remaining_mm, top, "planned to remain")
    if plan is None:
        planned.set_title("nothing is planned", fontsize=10)
    _map(way, piece, np.where(piece.inside, piece.map.heights_mm, np.nan), top, "lines of the last pass")
    column = _section_at(piece)
    passes = () if plan is None else plan.passes
    for stroke in passes[-1].strokes if passes else ():
        way.plot(stroke.poses[:, 0], stroke.poses[:, 1], color=PATH, lw=0.9)
        way.plot(*stroke.poses[0, :2], ".", color=PATH, ms=4)
    now.axvline(piece.map.x_mm[column], color=GREY, lw=0.8, ls="--")
    y = piece.map.y_mm
    section.fill_between(
        y, piece.map.heights_mm[column] - piece.sigma_mm[column], piece.map.heights_mm[column] + piece.sigma_mm[column],
        color=BEFORE, alpha=0.25, lw=0,
    )  # fmt: skip
    section.plot(y, piece.map.heights_mm[column], color=BEFORE, label="as asked for" if asked else "measured, +- sigma")
    for one in passes:
        last = one is passes[-1]
        label = "after the last pass" if last else None
        left = np.where(piece.inside[column], one.heights_mm[column], np.nan)
        section.plot(y, left, color=AFTER, lw=1.6 if last else 0.5, label=label)
    section.axhline(0, color=GREY, lw=0.8)
    section.set(xlabel="across, mm", ylabel="over the good surface, mm")
    section.set_title(f"section at {piece.map.x_mm[column]:.1f} mm", fontsize=10)
    section.legend(fontsize=8, frameon=False, loc="upper left")
    section.set_ylim(top=1.3 * top)


def _section_at(piece: StockPiece) -> int:
    """The row of nodes across which most stands."""
    return int(np.where(piece.inside, np.nan_to_num(piece.map.heights_mm), 0.0).sum(axis=1).argmax())


def _map(axes: Axes, piece: StockPiece, heights: np.ndarray, top: float, title: str) -> None:
    x, y = piece.map.x_mm, piece.map.y_mm
    half = piece.map.spacing_mm / 2
    shown = axes.imshow(
        heights.T, origin="lower", extent=(-half, x[-1] + half, -half, y[-1] + half), cmap="RdBu_r", vmin=-top, vmax=top
    )
    axes.contour(x, y, piece.inside.T.astype(float), levels=[0.5], colors=GREY, linewidths=0.8)
    bar = axes.figure.colorbar(shown, cax=axes.inset_axes((1.03, 0.0, 0.03, 1.0)))
    bar.ax.set_title("mm", fontsize=8)  # beside it stands the next panel's label
    axes.set(xlabel="along, mm", ylabel="across, mm")
    axes.set_title(title, fontsize=10)
