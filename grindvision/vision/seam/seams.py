"""One detector of weld seams: where two surfaces meet in a line, or where one ends beside or over the other.

Grooves come first, by the valley that they are; what is left of the cloud is searched for creases and steps of pairs
of surfaces, and, where these show nothing, for narrow gaps. Every rough line is fitted along its whole length before
its kind is named.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from grindvision.errors import NoGrooveError
from grindvision.geometry import inverse, rotate_vectors
from grindvision.loose_settings import settings_in
from grindvision.records import by_content
from grindvision.vision.seam.gap_lines import MIN_SPACINGS, find_gaps
from grindvision.vision.seam.groove import GrooveDetection, SeenCloud, grooves_of, seen_cloud
from grindvision.vision.seam.groove_diagnostics import LEAST_BOTH_SIDES, LEAST_WALL_SHARE, wall_share
from grindvision.vision.seam.groove_lines import DetectedGroove
from grindvision.vision.seam.height_field import field_bounds
from grindvision.vision.seam.joint_fit import JointFit, Scale, fit_joint
from grindvision.vision.seam.joint_names import BEVEL, BUTT, FAMILIES, LAP, OUTSIDE, kinds_of
from grindvision.vision.seam.joints import Seam
from grindvision.vision.seam.seam_kinds import corner_seam, groove_seam, named_edges, plausible
from grindvision.vision.seam.seam_tracing import trace_curves
from grindvision.vision.seam.step_fit import fit_step
from grindvision.vision.seam.surface_pairs import CONCAVE, CONVEX, STEP, SurfacePairs, find_pairs
from grindvision.vision.surface.normals import seen_along
from grindvision.vision.surface.surfels import Surfels, build_surfels

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

#: Edge of the surfels: so many spacings, so many times the noise, and at least this share of the cloud's diagonal.
CELL_SPACINGS, CELL_NOISE, CELL_SHARE = 4.0, 6.0, 1 / 150
#: Where the finest cells show no seam, coarser ones are tried.
COARSER = (1.0, 1.7)
#: A valley with an upright wall is a groove if it is so many widths, and this share of the diagonal, long.
BEVEL_ASPECT, BEVEL_SHARE = 6.0, 0.15
#: Corners of this share of the diagonal, all together, are enough.
ENOUGH = 0.1
#: Seams shorter than this share of the longest are named with the less certain ones.
SHORT = 0.2
#: A rough line is at least so many cells long; interruptions up to this length are bridged.
TRACED_CELLS, JOIN_CELLS = 3.5, 10.0
#: The highest step that is taken for a plate's edge, mm.
MAX_STEP_MM = 25.0
#: A seam that runs along a known one for this share is that one again.
KNOWN_SHARE = 0.5
#: A groove whose surface is seen on both sides along less than this share may be a corner between two bodies.
CORNER_RATHER = 0.5


@by_content
@dataclass(frozen=True)
class FindSeamsOptions:
    """Settings of ``find_seams``, in mm and in the cloud's frame.

    ``viewpoint_mm``: the camera (3,). Left out, the origin is taken where a camera could stand there, otherwise the
    side that looks up. ``joint``: a kind of ``joint_names.KINDS`` or a family of ``joint_names.FAMILIES``; others are
    then left out. ``width_mm``: rough width of grooves; estimated when left out.
    """

    viewpoint_mm: ArrayLike | None = None
    joint: str = "any"
    width_mm: float | None = None


@by_content
@dataclass(frozen=True)
class SeamDetection:
    """All seams of a cloud of the surest class that it shows, the most certain first.

    ``seam_id`` in the cloud's shape is the number of each point's seam, -1 outside. ``weaker`` are seams of less
    certain classes: steps and gaps where there are corners or grooves, outside corners where there is anything else.
    ``view_assumed`` says that nothing told from which side the scan was taken. ``grooves`` is what ``find_grooves``
    found, if it found any.
    """

    seams: tuple[Seam, ...]
    seam_id: Integers
    spacing_mm: float
    weaker: tuple[Seam, ...] = ()
    view_assumed: bool = False
    grooves: GrooveDetection | None = None

    @property
    def labels(self) -> Flags:
        """True on the points of any seam."""
        return self.seam_id >= 0

    def __str__(self) -> str:
        return f"{len(self.seams)} seam(s): " + "; ".join(str(seam) for seam in self.seams)


@settings_in(FindSeamsOptions, 1, ("viewpoint_mm", "joint", "width_mm"))
def find_seams(points: ArrayLike, options: FindSeamsOptions | None = None) -> SeamDetection:
    """Find the weld seams of a single-view cloud.

    Args:
        points: (N, 3) or organised (R, C, 3), mm; rows with NaN belong to no seam.
        options: viewpoint, kind of joint, width; see ``FindSeamsOptions``.

    Returns:
        The seams, each with its kind and its root (K, 3) in mm in the frame of the points; ``seam_id`` and ``labels``
        in the shape of the cloud.

    Raises:
        InputError: wrong shape, too few points, an unknown kind. UnitError: no part in mm is of this size.
        NoGrooveError: the cloud shows no seam, or none of the kind asked for.
    """
    options = FindSeamsOptions() if options is None else options
    viewpoint_mm, joint, width_mm = options.viewpoint_mm, options.joint, options.width_mm
    wanted = kinds_of(joint)
    view = seen_cloud(points, viewpoint_mm)
    cloud, valid, sides, spacing = view.points, view.valid, view.sides, view.spacing_mm
    grooves: GrooveDetection | None = None
    sure: list[DetectedGroove] = []
    doubtful: list[DetectedGroove] = []
    if set(wanted) & set(FAMILIES["groove"]):
        grooves = _grooves(view, width_mm, False)
        sure, doubtful = _sorted_grooves(grooves, cloud, valid)
    if BEVEL in wanted and not sure:
        bevelled = _grooves(view, width_mm, True)
        diagonal = _diagonal(cloud)
        sure = [
            groove
            for groove in _sorted_grooves(bevelled, cloud, valid)[0]
            if groove.length_mm > max(BEVEL_ASPECT * float(np.median(groove.width_mm)), BEVEL_SHARE * diagonal)
        ]
        grooves = bevelled if sure else grooves
    groove_seams = [groove_seam(groove) for groove in sure]
    others: list[Seam] = []
    if set(wanted) - set(FAMILIES["groove"]):
        for facing in _facings(sides, viewpoint_mm):
            others = _other_seams(cloud, sides[0][0], facing, spacing, groove_seams, wanted)
            if others:
                break
    groove_seams += [groove_seam(groove) for groove in doubtful if not _is_corner(groove, others)]
    others = [seam for seam in others if not _runs_along(seam.root, groove_seams)]
    classes = _classes([*groove_seams, *others], wanted)
    if not classes:
        raise NoGrooveError(_nothing(len(cloud), spacing, joint, [*groove_seams, *others]))
    at = np.flatnonzero(valid)
    rank = np.full(len(valid), -1)
    seams = [replace(seam, members=at[seam.members]) for seam in classes[0]]
    for number, seam in reversed(list(enumerate(seams))):
        rank[seam.members] = number
    weaker = tuple(seam for group in classes[1:] for seam in group)
    return SeamDetection(
        tuple(seams), rank.reshape(view.shape), spacing, weaker, len(sides) > 1 and bool(others), grooves
    )


def _grooves(view: SeenCloud, width_mm: float | None, bevel: bool) -> GrooveDetection | None:
    try:
        return grooves_of(view, width_mm, bevel)
    except NoGrooveError:
        return None


def _sorted_grooves(
    found: GrooveDetection | None, cloud: Floats, valid: Flags
) -> tuple[list[DetectedGroove], list[DetectedGroove]]:
    """The grooves that are sure and those that are doubtful, their members counted among the finite points."""
    sure: list[DetectedGroove] = []
    doubtful: list[DetectedGroove] = []
    number = np.cumsum(valid) - 1
    for groove in found.grooves if found is not None else ():
        mine = replace(groove, members=number[groove.members])
        is_sure = groove.edges_seen >= LEAST_BOTH_SIDES and wall_share(mine, cloud) >= LEAST_WALL_SHARE
        (sure if is_sure else doubtful).append(mine)
    return sure, doubtful


def _facings(sides: list[list[Floats]], viewpoint_mm: ArrayLike | None) -> Iterator[Floats | None]:
    """Where normals are turned to: a viewpoint (3,), or None for the side that looks up and then the other one."""
    if viewpoint_mm is not None or len(sides) == 1:
        yield np.zeros(3) if viewpoint_mm is None else np.asarray(viewpoint_mm, dtype=float)
        return
    yield None


def _turned(surfels: Surfels, towards: Floats | None, T_field_cloud: Floats) -> Floats:
    """Normals (M, 3) of the surfels, facing the scanner."""
    normals = surfels.normals
    if towards is not None:
        sign = np.sign(((towards - surfels.points) * normals).sum(axis=1))
        return normals * np.where(sign == 0, 1.0, sign)[:, None]
    sample = slice(None, None, max(len(surfels) // 2000, 1))
    direction = seen_along(surfels.points[sample], normals[sample], 2.0 * surfels.grid.size_mm)
    if direction is None:
        direction = rotate_vectors(inverse(T_field_cloud), [0.0, 0.0, 1.0])
    # The bulge of a corner tells the wrong side: without a viewpoint, scans look down or away from the frame's origin.
    up = direction[2] if abs(direction[2]) > 0.2 else -float(direction @ surfels.points.mean(axis=0))
    direction = direction if up >= 0 else -direction
    return np.asarray(normals * np.where(normals @ direction < 0, -1.0, 1.0)[:, None])


def _other_seams(
    cloud: Floats,
    T_field_cloud: Floats,
    towards: Floats | None,
    spacing: float,
    known: list[Seam],
    wanted: tuple[str, ...],
) -> list[Seam]:
    """Corners, steps and gaps beside the known grooves."""
    diagonal = _diagonal(cloud)
    noise = float(np.median(build_surfels(cloud, CELL_SPACINGS * spacing).noise_mm)) if not known else 0.0
    base = max(CELL_SPACINGS * spacing, CELL_NOISE * noise, CELL_SHARE * diagonal)
    found: list[Seam] = []
    for factor in COARSER:
        cell = factor * base
        if cell > diagonal / 12:
            break
        surfels = build_surfels(cloud, cell)
        normals = _turned(surfels, towards, T_field_cloud)
        scale = Scale(spacing, cell, float(np.median(surfels.noise_mm)))
        usable = ~_inside(surfels.points, known, 2 * cell)
        pairs = find_pairs(surfels, normals, usable)
        found += _corners(cloud, (surfels, normals, towards), pairs, scale, [*known, *found], factor > 1)
        found += _steps(cloud, pairs.of(STEP), scale, [*known, *found])
        if known or sum(seam.length_mm for seam in found if seam.kind not in (LAP, OUTSIDE)) > ENOUGH * diagonal:
            break
    if BUTT in wanted and not known and not any(seam.kind not in (LAP, OUTSIDE) for seam in found):
        found = [*_gaps(cloud, T_field_cloud, Scale(spacing, base, noise)), *found]
    return found


def _corners(
    cloud: Floats,
    scene: tuple[Surfels, Floats, Floats | None],
    pairs: SurfacePairs,
    scale: Scale,
    known: list[Seam],
    coarse: bool,
) -> list[Seam]:
    """Concave and convex corners: rough lines through the pairs, fitted and named."""
    found: list[Seam] = []
    for kind in (CONCAVE, CONVEX):
        some = pairs.of(kind)
        curves = trace_curves(some.places, some.along, scale.cell, JOIN_CELLS * scale.cell, TRACED_CELLS * scale.cell)
        tree = cKDTree(some.places) if curves else None
        for curve in curves:
            if tree is None or _runs_along(curve, [*known, *found], 1.5 * scale.cell):
                continue
            at = tree.query(curve)[1]
            sides = _consistent(some.first[at], some.second[at])
            fit = fit_joint(cloud, curve, sides, kind == CONCAVE, scale)
            if fit is None or not plausible(fit, scale, kind == CONCAVE, coarse):
                continue
            seam = corner_seam(fit, *scene[:2], kind == CONCAVE, scene[2])
            if seam.kind == LAP:
                seam = _as_step(cloud, fit, scale) or seam
            if not _runs_along(seam.root, [*known, *found], 1.5 * scale.cell):
                found.append(seam)
    return found


def _as_step(cloud: Floats, fit: JointFit, scale: Scale) -> Seam | None:
    """A lap's corner fitted as a step, which holds where its short wall is hardly seen; None where it shows less."""
    legs = np.median(fit.legs_mm[:, fit.shown], axis=1)
    base = int(np.argmax(legs))
    step = fit_step(cloud, fit.root, fit.faces.outward[base], fit.faces.normal[base], float(legs.min()), scale)
    seam = None if step is None else named_edges(step, scale, gap=False)
    return seam if seam is not None and seam.length_mm > 0.9 * fit.length_mm else None


def _consistent(first: Floats, second: Floats) -> tuple[Floats, Floats]:
    """The two normals (M, 3) along a curve, swapped where that keeps each face on its side."""
    first, second = first.copy(), second.copy()
    for k in range(1, len(first)):
        keep = first[k] @ first[k - 1] + second[k] @ second[k - 1]
        swap = first[k] @ second[k - 1] + second[k] @ first[k - 1]
        if swap > keep:
            first[k], second[k] = second[k].copy(), first[k].copy()
    return first, second


def _steps(cloud: Floats, pairs: SurfacePairs, scale: Scale, known: list[Seam]) -> list[Seam]:
    """Steps from one surface down to another that lies side by side with it."""
    low = pairs.step_mm < MAX_STEP_MM
    places, along = pairs.places[low], pairs.along[low]
    found: list[Seam] = []
    curves = trace_curves(places, along, scale.cell, JOIN_CELLS * scale.cell, TRACED_CELLS * scale.cell)
    for curve in curves:
        at = cKDTree(places).query(curve)[1]
        if _runs_along(curve, [*known, *found], 2 * scale.cell):
            continue
        height = float(np.median(pairs.step_mm[low][at]))
        fit = fit_step(cloud, curve, pairs.first[low][at], pairs.second[low][at], height, scale)
        seam = None if fit is None else named_edges(fit, scale, gap=False)
        if seam is not None and not _runs_along(seam.root, [*known, *found], 2 * scale.cell):
            found.append(seam)
    return found


def _gaps(cloud: Floats, T_field_cloud: Floats, scale: Scale) -> list[Seam]:
    """Butt gaps: narrow strips without surface between two surfaces of one level."""
    found: list[Seam] = []
    up = rotate_vectors(inverse(T_field_cloud), [0.0, 0.0, 1.0])
    for gap in find_gaps(cloud, T_field_cloud, scale.spacing, scale.noise, 8 * scale.cell):
        along = np.gradient(gap.path, axis=0)
        way = np.cross(np.broadcast_to(up, along.shape), along)
        fit = fit_step(cloud, gap.path, way, np.broadcast_to(up, along.shape), None, scale)
        seam = None if fit is None else named_edges(fit, scale, gap=True)
        if seam is not None and not _runs_along(seam.root, found, 2 * scale.cell):
            found.append(seam)
    return found


def _diagonal(cloud: Floats) -> float:
    low, high = field_bounds(cloud, np.eye(4))
    return float(np.linalg.norm(high - low))


def _inside(places: Floats, grooves: list[Seam], margin: float) -> Flags:
    """Which places (M, 3) lie in or near the known grooves."""
    inside = np.zeros(len(places), dtype=bool)
    for seam in grooves:
        if seam.groove is not None:
            middle = (seam.groove.left + seam.groove.right) / 2
            width = float(np.median(seam.groove.width_mm))
            reach = 0.75 * width + margin
            inside |= np.isfinite(cKDTree(middle).query(places, distance_upper_bound=reach)[0])
    return inside


def _runs_along(path: Floats, seams: list[Seam], reach: float | None = None) -> bool:
    """Whether most of a path (M, 3) runs along one of the seams."""
    for seam in seams:
        near = reach
        if seam.groove is not None:
            near = max(0.75 * float(np.median(seam.groove.width_mm)), reach or 0.0)
        if (cKDTree(seam.root).query(path)[0] < (near or 3.0)).mean() > KNOWN_SHARE:
            return True
    return False


def _is_corner(groove: DetectedGroove, others: list[Seam]) -> bool:
    """Whether a doubtful groove is better explained by one of the other seams, which runs within it."""
    width, depth = float(np.median(groove.width_mm)), float(np.median(groove.depth_mm))
    for seam in others:
        away = cKDTree(seam.root).query(groove.root)[0]
        meets = (away < width).mean() > 0.3
        # The walls of a groove are no longer than it says; in a corner of two bodies the faces go on.
        longer = seam.kind in FAMILIES["tube"] or np.median(seam.legs_mm, axis=1).max() > 1.3 * np.hypot(
            width / 2, depth
        )
        if meets and ((groove.edges_seen < CORNER_RATHER and longer) or seam.kind == BUTT):
            return True
    return False


def _classes(seams: list[Seam], wanted: tuple[str, ...]) -> list[list[Seam]]:
    """Seams of the kinds wanted: grooves and concave corners, then steps and gaps, then outside corners."""
    groups: list[list[Seam]] = [[], [], []]
    for seam in seams:
        if seam.kind in wanted:
            groups[2 if seam.kind == OUTSIDE else 1 if seam.kind in (LAP, BUTT) else 0].append(seam)
    groups[0] = [s for s in groups[0] if s.groove] + sorted(
        (s for s in groups[0] if not s.groove), key=lambda seam: -seam.length_mm
    )
    if groups[0]:
        least = SHORT * max(seam.length_mm for seam in groups[0])
        groups[1] += [seam for seam in groups[0] if not seam.groove and seam.length_mm < least]
        groups[0] = [seam for seam in groups[0] if seam.groove or seam.length_mm >= least]
    for group in groups[1:]:
        group.sort(key=lambda seam: (seam.kind != BUTT, -seam.length_mm))
    return [group for group in groups if group]


def _nothing(count: int, spacing: float, joint: str, others: list[Seam]) -> str:
    """Why there is no seam, and what the scan could have shown."""
    if others:
        seen = "; ".join(map(str, others))
        return f"no {joint} in the cloud, but {seen}; leave out --joint to take these"
    what = "no groove in the cloud, nor another seam" if joint == "any" else f"no {joint} in the cloud"
    return (
        f"{what} ({count:,} points, {spacing:.2g} mm apart): no place where two surfaces meet or part"
        f" along a line. At this spacing a groove must be {4 * spacing:.2g} mm wide, a corner's faces"
        f" {3 * CELL_SPACINGS * spacing:.2g} mm and a gap {MIN_SPACINGS * spacing:.2g} mm: for smaller ones scan more"
        " densely or from nearer; check the view, and give the viewpoint if the camera does not stand at the origin"
    )
