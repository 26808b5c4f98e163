"""Grinding passes over a height map: which layer, which lines, how far lifted, how fast, and what they leave.

Each pass takes the stock down to a floor parallel to the good surface, ``depth_mm`` below the one before; the last
floor is what is to be left. The tool is lifted over its floor wherever its body would come below it, so nothing under
the last floor is ever cut by a path that is followed. How deep a pass really cuts follows Preston's equation.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, label

from grindvision.errors import InputError
from grindvision.geometry.height_map import HeightMap
from grindvision.motion.grinding_contact import (
    WHEEL,
    Nodes,
    ToolShape,
    envelope_of,
    lifts_of_sides,
    lifts_over,
    nodes_of,
    tool_shape,
)
from grindvision.motion.grinding_lines import grinding_lines, poses_along, resampled
from grindvision.motion.grinding_options import GrindingOptions
from grindvision.records import by_content
from grindvision.words import counted

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

MAX_PASSES = 500
"""More passes are a wrong unit, not a plan."""

MIN_NODES = 3
"""Patches of fewer nodes above a floor are noise and get no line of their own."""

RELIEF_MM = 2.0
"""The tool is kept off what stands up to so much higher than the stock."""

LEAVE_SIGMAS = 1.5
"""So many standard deviations of the good surface the last pass leaves standing, where nothing else is asked for."""

OFFSET_SIGMAS = 3.0
"""So many standard deviations of the wheel's offset stay standing at least: no path says better where it cuts."""

TOUCH_MM = 1e-6
"""What is cut by less is not touched."""


@by_content
@dataclass(frozen=True)
class Workpiece:
    """What is ground: ``heights`` over the good surface; ``inside`` (R, C) the nodes of the stock.

    ``keep`` (R, C): nodes that must not be touched; ``level_mm``: the level of detection; ``sigma_mm``: standard
    deviation of the good surface under the stock; ``centreline_mm`` (M, 2): the bead's centreline on the map, or None.
    ``offset_mm``: how much higher over the good surface the wheel runs than it is sent, with its standard deviation
    ``offset_sigma_mm``: errors of scanner, hand-eye and arm, which no difference of scans shows; 0 and 0 where it was
    touched off on that surface.
    """

    heights: HeightMap
    inside: Flags
    keep: Flags
    level_mm: float
    sigma_mm: float
    centreline_mm: Floats | None = None
    offset_mm: float = 0.0
    offset_sigma_mm: float = 0.0


@by_content
@dataclass(frozen=True)
class Stroke:
    """One line of the tool over the ground of a map: ``poses`` (K, 12) tip on the ground and axes along the feed,
    across and along the normal, in the map's frame; ``lifts_mm`` (K,) of the tip along the normal; ``leads_mm``:
    lengths of lead-in and lead-out, None for those of the options."""

    poses: Floats
    lifts_mm: Floats
    leads_mm: tuple[float, float] | None = None

    @property
    def length_mm(self) -> float:
        """Length of the way."""
        return float(np.linalg.norm(np.diff(self.poses[:, :3], axis=0), axis=1).sum())


@by_content
@dataclass(frozen=True)
class GrindingPass:
    """All strokes that take the stock down to ``floor_mm``, with the feed and force that Preston's equation asks for to
    cut ``depth_mm``; ``removed_mm3`` and ``heights_mm`` (R, C) after it, as planned."""

    number: int
    floor_mm: float
    depth_mm: float
    strokes: tuple[Stroke, ...]
    feed_mm_s: float
    force_n: float
    removed_mm3: float
    heights_mm: Floats

    def __str__(self) -> str:
        return (
            f"pass {self.number}: {counted(len(self.strokes), 'line')}, down to {self.floor_mm:.3f} mm,"
            f" {self.removed_mm3:.3g} mm3 at {self.feed_mm_s:.3g} mm/s and {self.force_n:.3g} N"
        )


@by_content
@dataclass(frozen=True)
class GrindingPlan:
    """The ``passes`` over a ``work`` piece, in order; ``leave_mm`` is what they leave standing where they reach."""

    work: Workpiece
    options: GrindingOptions
    leave_mm: float
    passes: tuple[GrindingPass, ...]

    @property
    def remaining_mm(self) -> Floats:
        """Heights (R, C) after all passes, as planned."""
        return self.passes[-1].heights_mm if self.passes else self.work.heights.heights_mm

    @property
    def unreached(self) -> Flags:
        """Nodes (R, C) of the stock that stand higher after the last pass than its floor and the level of detection."""
        floor = self.passes[-1].floor_mm if self.passes else self.leave_mm
        return self.work.inside & (np.nan_to_num(self.remaining_mm) > floor + self.work.level_mm)

    @property
    def seconds(self) -> float:
        """Time in contact at the planned feeds."""
        return float(sum(stroke.length_mm / one.feed_mm_s for one in self.passes for stroke in one.strokes))

    def __str__(self) -> str:
        left = np.nan_to_num(self.remaining_mm)[self.work.inside]
        return (
            f"{counted(len(self.passes), 'pass', 'passes')} of {self.options.depth_mm:g} mm, {self.seconds:.0f} s in"
            f" contact, at most {left.max(initial=0.0):.2f} mm planned to stay"
        )


def plan_grinding(work: Workpiece, options: GrindingOptions | None = None) -> GrindingPlan:
    """Plan the passes that take a piece of stock off.

    Args:
        work: heights over the good surface, and what must stay; see ``Workpiece``.
        options: wheel, cut, process and ways; see ``GrindingOptions``.

    Returns:
        Passes with strokes in the map's frame, mm, feeds in mm/s and forces in N.

    Raises:
        InputError: heights that are no numbers; nothing stands above what is to be left; a depth below the level of
            detection; more than ``MAX_PASSES``; what must stay closes the stock on all sides; a wheel that does not
            fit; limits of force and feed that allow no such depth.
    """
    options = GrindingOptions() if options is None else options
    start = _checked_heights(work)
    unknown = OFFSET_SIGMAS * work.offset_sigma_mm
    leave = float(np.hypot(LEAVE_SIGMAS * work.sigma_mm if options.leave_mm is None else options.leave_mm, unknown))
    if options.depth_mm < work.level_mm:
        raise InputError(
            f"a depth of {options.depth_mm:g} mm is below the level of detection of {work.level_mm:.2g} mm: no scan"
            " could show what a pass took; cut deeper, or scan with less noise"
        )
    top = float(start[work.inside].max(initial=-np.inf))
    if not top > leave + TOUCH_MM:
        why = f", as the wheel's offset is known to {work.offset_sigma_mm:.2g} mm only" if unknown else ""
        raise InputError(f"nothing stands above the {leave:.3g} mm that are to be left{why}; there is nothing to grind")
    count = int(np.ceil((top - leave) / options.depth_mm - 1e-9))
    if count > MAX_PASSES:
        raise InputError(
            f"{top:.3g} mm of stock in passes of {options.depth_mm:g} mm are {count} passes; cut deeper ({MAX_PASSES}"
            " at most), or check the unit"
        )
    shape, nodes = tool_shape(options, top + RELIEF_MM), nodes_of(work.heights)
    heights, passes = start, list[GrindingPass]()
    for number in range(1, min(count, options.passes_max or count) + 1):
        floor = max(leave, top - number * options.depth_mm)
        strokes = _strokes(work, options, shape, nodes, heights, floor)
        after = heights
        for stroke in strokes:
            after = _cut(after, _envelope(nodes, stroke, shape), np.inf)
        removed = _volume(work, heights, after)
        if strokes and removed > 0:
            feed, force = _feed_and_force(options, strokes, removed)
            passes.append(GrindingPass(number, floor, options.depth_mm, strokes, feed, force, removed, after))
            heights = after
    plan = GrindingPlan(work, options, leave, tuple(passes))
    _check_reached(plan, shape, nodes, start)
    return plan


def simulate_passes(plan: GrindingPlan, heights_mm: Floats, k_factor: float = 1.0) -> Iterator[Floats]:
    """Heights (R, C) over the plan's ground after each pass, from given ones on, as of the true part.

    Args:
        plan: what is driven; its strokes are followed as planned.
        heights_mm: (R, C) before the first pass.
        k_factor: how many times as much as planned the process takes off: a stroke cuts no deeper than this times the
            pass's depth, nor below the tool.
    """
    shape = tool_shape(plan.options, _top(plan) + RELIEF_MM)
    nodes, heights = nodes_of(plan.work.heights), np.asarray(heights_mm, dtype=float)
    for one in plan.passes:
        for stroke in one.strokes:
            heights = _cut(heights, _envelope(nodes, stroke, shape), k_factor * one.depth_mm)
        yield heights


def preston_depth(options: GrindingOptions, force_n: float, feed_mm_s: float, width_mm: float) -> float:
    """Depth in mm of one pass by Preston's equation, depth = k p v t.

    Pressure p = F / (w L) over a contact of width w and length L, and time t = L / feed: the length drops out.
    """
    return options.k_mm2_n * force_n * 1000.0 * options.surface_speed_m_s / (width_mm * feed_mm_s)


def _checked_heights(work: Workpiece) -> Floats:
    shape = work.heights.shape
    if np.shape(work.inside) != shape or np.shape(work.keep) != shape:
        raise InputError(f"marks of {np.shape(work.inside)} and {np.shape(work.keep)} for a map of {shape} nodes")
    known = work.heights.heights_mm[work.inside & work.heights.shown]
    if (
        np.isnan(known).any()
        or not np.isfinite([work.level_mm, work.sigma_mm, work.offset_mm, work.offset_sigma_mm]).all()
    ):
        raise InputError(
            f"{int(np.isnan(known).sum())} heights of the stock are NaN, level {work.level_mm}, sigma {work.sigma_mm};"
            " fill them or take the nodes out of the piece"
        )
    return np.where(work.inside, work.heights.heights_mm, np.fmin(work.heights.heights_mm, 0.0))


def _strokes(
    work: Workpiece, options: GrindingOptions, shape: ToolShape, nodes: Nodes, heights: Floats, floor: float
) -> tuple[Stroke, ...]:
    """The strokes of one pass that touch anything."""
    region = _without_specks(work.inside & (np.nan_to_num(heights, nan=-np.inf) > floor + TOUCH_MM))
    width = options.contact_width_mm
    lines = grinding_lines(work.heights, region, options.pattern, width, options.overlap, work.centreline_mm)
    floors = _floors(work, options, floor)
    strokes = []
    for poses in (run for line in lines for run in poses_along(work.heights, resampled(line, options.path_step_mm))):
        lifts = lifts_over(nodes, floors, poses, shape)
        if shape.kind == WHEEL:
            lifts = np.maximum(lifts, lifts_of_sides(nodes, floors, poses, shape))
        # the tip goes no lower than the floor, even where the ground falls away beside the map
        lifts = np.maximum(lifts, floor)
        touching = (_envelope(nodes, Stroke(poses, lifts), shape) < heights - TOUCH_MM) & work.inside
        if touching.any():
            strokes.append(Stroke(poses, lifts))
    return tuple(strokes)


def _floors(work: Workpiece, options: GrindingOptions, floor: float) -> Floats:
    """Heights (R, C) below which nothing is cut: the floor, and a distance from what must stay."""
    floors = np.where(work.heights.shown, floor, np.nan)
    if work.keep.any():
        away = np.asarray(distance_transform_edt(~work.keep)) * work.heights.spacing_mm
        stands = np.fmax(np.nan_to_num(work.heights.heights_mm), 0.0) + options.keep_out_mm
        floors = np.where(work.heights.shown & (away <= options.keep_out_mm), np.fmax(floors, stands), floors)
        floors = np.where(work.heights.shown & work.keep, np.fmax(floors, stands), floors)
    return floors


def _without_specks(region: Flags) -> Flags:
    marks, count = label(region, np.ones((3, 3)))
    sizes = np.bincount(marks.ravel(), minlength=count + 1)
    sizes[0] = 0
    kept = np.asarray(sizes[marks] >= MIN_NODES)
    return kept if kept.any() else region


def _envelope(nodes: Nodes, stroke: Stroke, shape: ToolShape) -> Floats:
    return envelope_of(nodes, stroke.poses, stroke.lifts_mm, shape)


def _cut(heights: Floats, envelope: Floats, depth_mm: float) -> Floats:
    """Heights (R, C) after a stroke that cuts no deeper than ``depth_mm``, nor below the tool."""
    return np.where(envelope < heights, np.maximum(envelope, heights - depth_mm), heights)


def _volume(work: Workpiece, before: Floats, after: Floats) -> float:
    return float(np.nansum((before - after) * work.heights.areas_mm2))


def _feed_and_force(options: GrindingOptions, strokes: tuple[Stroke, ...], removed_mm3: float) -> tuple[float, float]:
    """The fastest feed at which the force allows the depth, and the force that this feed asks for."""
    length = sum(stroke.length_mm for stroke in strokes)
    width = min(max(removed_mm3 / (length * options.depth_mm), 0.1), options.contact_width_mm)
    feed = preston_depth(options, options.force_n, 1.0, width) / options.depth_mm
    if feed < options.feed_min_mm_s:
        raise InputError(
            f"{options.force_n:g} N cut {options.depth_mm:g} mm over a width of {width:.2g} mm at {feed:.2g} mm/s,"
            f" slower than the least feed of {options.feed_min_mm_s:g} mm/s; allow more force, or cut less deep"
        )
    kept = min(feed, options.feed_max_mm_s)
    return kept, options.force_n * kept / feed


def _top(plan: GrindingPlan) -> float:
    return float(np.nanmax(np.where(plan.work.inside, plan.work.heights.heights_mm, -np.inf)))


def _check_reached(plan: GrindingPlan, shape: ToolShape, nodes: Nodes, start: Floats) -> None:
    """Refuse a plan whose passes reach nothing.

    Raises:
        InputError: what must stay closes the stock on all sides; the tool does not fit into the place.
    """
    if plan.passes:
        return
    work, options = plan.work, plan.options
    free = replace(work, keep=np.zeros_like(work.keep))
    if work.keep.any() and _strokes(free, options, shape, nodes, start, plan.leave_mm):
        raise InputError(
            f"what must stay, with {options.keep_out_mm:g} mm around it, closes the stock on all sides; no pass reaches"
            " it: allow less distance, or take a narrower wheel"
        )
    wide = options.width_mm if options.tool == "wheel" else 2 * options.radius_mm
    raise InputError(
        f"a {options.tool} {wide:g} mm wide with a radius of {options.radius_mm:g} mm is wider than the place: it would"
        " cut into what stands beside the stock before it reaches it; take a smaller one"
    )
