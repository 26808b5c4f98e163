"""One detector of weld seams: where two surfaces meet in a line, or where one ends beside or over the other.

Grooves come first, by the valley that they are; what is left of the cloud is searched for creases and steps of pairs
of surfaces, and, where these show nothing, for narrow gaps. Every rough line is fitted along its whole length before
its kind is named.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from grindvision.errors import NoGrooveError
from grindvision.geometry.bounds import diagonal_mm
from grindvision.loose_settings import settings_in
from grindvision.records import by_content
from grindvision.vision.seam.gap_lines import MIN_SPACINGS
from grindvision.vision.seam.groove import GrooveDetection, SeenCloud, grooves_of, seen_cloud
from grindvision.vision.seam.groove_diagnostics import (
    MIN_FILLING,
    MIN_WALL_FRACTION,
    Edge,
    Judged,
    filling_of,
    judge_groove,
    wall_fraction,
)
from grindvision.vision.seam.groove_lines import DetectedGroove
from grindvision.vision.seam.groove_noise import stands_out
from grindvision.vision.seam.joint_names import BEVEL, BUTT, FAMILIES, LAP, OUTSIDE, kinds_of
from grindvision.vision.seam.joints import Seam
from grindvision.vision.seam.point_density import camera_place
from grindvision.vision.seam.seam_kinds import BEVEL_SKEW, groove_seam, skew_of
from grindvision.vision.seam.section_shape import section_shape, with_shape
from grindvision.vision.seam.surface_seams import CELL_SPACINGS, runs_along, surface_seams
from grindvision.vision.seam.viewing_frames import field_frames
from grindvision.words import counted

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

#: A valley with an upright wall is a groove if it is so many widths, and this fraction of the diagonal, long.
BEVEL_ASPECT, BEVEL_FRACTION = 6.0, 0.15
#: A groove is told from a gap between upright faces, which a camera blurs, if it is so many spacings wide.
TOLD_SPACINGS = 6.5
#: A groove whose root lies nearer than this fraction of the width to an edge may have an upright wall there.
SKEWED = 0.3
#: Seams shorter than this fraction of the longest are named with the less certain ones.
SHORT = 0.2
#: So are corners whose turn stands out by fewer standard deviations than this and than this fraction of the surest's.
SURE_DEVIATIONS, SURE_FRACTION = 30.0, 0.5
#: A groove whose surface is seen on both sides along less than this fraction may be a corner between two bodies.
CORNER_RATHER = 0.5


@by_content
@dataclass(frozen=True)
class FindSeamsOptions:
    """Settings of ``find_seams``, in mm and in the cloud's frame.

    ``viewpoint_mm``: the camera (3,). Left out, the origin is taken where a camera could stand there, otherwise the
    place that the density of the points tells (``camera_place``), otherwise for corners the side that looks up, for
    grooves the one with the larger groove. ``joint``: a kind of ``joint_names.KINDS`` or a family of
    ``joint_names.FAMILIES``; others are then left out. ``width_mm``: rough width of grooves; estimated when left out.
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
    found, if it found any; ``judged`` says of each groove among the seams what is seen of its walls and edges.
    """

    seams: tuple[Seam, ...]
    seam_id: Integers
    spacing_mm: float
    weaker: tuple[Seam, ...] = ()
    view_assumed: bool = False
    grooves: GrooveDetection | None = None
    judged: tuple[Judged, ...] = ()

    @property
    def labels(self) -> Flags:
        """True on the points of any seam."""
        return self.seam_id >= 0

    def __str__(self) -> str:
        return f"{counted(len(self.seams), 'seam')}: " + "; ".join(str(seam) for seam in self.seams)


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
    told = camera_place(view.points) if len(view.sides) > 1 else None
    if told is not None:
        view = replace(view, sides=field_frames(view.points, told))
    cloud, valid, sides, spacing = view.points, view.valid, view.sides, view.spacing_mm
    grooves: GrooveDetection | None = None
    sure: list[Judged] = []
    doubtful: list[Judged] = []
    if set(wanted) & set(FAMILIES["groove"]):
        grooves = _grooves(view, width_mm, False)
        sure, doubtful = _sorted_grooves(grooves, cloud, valid)
    if BEVEL in wanted and not sure:
        bevelled = _reshaped(_grooves(view, width_mm, True), cloud, valid, spacing)
        sure, others_doubtful = _sorted_grooves(bevelled, cloud, valid)
        doubtful = [one for one in doubtful if not _is_known(one, sure)]
        doubtful += [one for one in others_doubtful if not sure and not _is_known(one, doubtful)]
        grooves = bevelled if sure else grooves
    elif BEVEL in wanted:
        sure = [_upright(one, cloud, spacing) for one in sure]
    groove_seams = [groove_seam(one.groove) for one in sure]
    others: list[Seam] = []
    assumed = len(sides) > 1 and bool(groove_seams)
    if set(wanted) - set(FAMILIES["groove"]):
        for facing in _facings(viewpoint_mm, told, len(sides)):
            others = surface_seams(cloud, sides[0][0], facing, spacing, groove_seams, wanted)
            if others:
                assumed = assumed or facing is None
                break
    hollows = [one.groove for one in doubtful if joint != "groove" and one.bends_on]
    doubtful = [one for one in doubtful if one.groove not in hollows and not _is_corner(one, others, spacing)]
    scanty = [one.groove for one in doubtful if _is_scanty(one, spacing)]
    groove_seams += [groove_seam(one.groove) for one in doubtful if one.groove not in scanty]
    others = [seam for seam in others if not runs_along(seam.root, groove_seams)]
    classes = _classes([*groove_seams, *others], [groove_seam(groove) for groove in scanty], wanted)
    if not classes:
        raise NoGrooveError(_nothing(len(cloud), spacing, joint, [*groove_seams, *others], hollows))
    at = np.flatnonzero(valid)
    rank = np.full(len(valid), -1)
    judged = [one for seam in classes[0] for one in (*sure, *doubtful) if one.groove is seam.groove]
    seams = [_among(seam, at) for seam in classes[0]]
    for number, seam in reversed(list(enumerate(seams))):
        rank[seam.members] = number
    weaker = tuple(seam for group in classes[1:] for seam in group)
    return SeamDetection(tuple(seams), rank.reshape(view.shape), spacing, weaker, assumed, grooves, tuple(judged))


def _is_known(one: Judged, others: list[Judged]) -> bool:
    """Whether a groove runs along one of the others."""
    return runs_along(one.groove.root, [groove_seam(other.groove) for other in others])


def _among(seam: Seam, at: Integers) -> Seam:
    """A seam whose members are numbers ``at`` (K,) of the whole cloud instead of its finite points'."""
    groove = seam.groove if seam.groove is None else replace(seam.groove, members=at[seam.groove.members])
    return replace(seam, members=at[seam.members], groove=groove)


def _grooves(view: SeenCloud, width_mm: float | None, bevel: bool) -> GrooveDetection | None:
    try:
        return grooves_of(view, width_mm, bevel)
    except NoGrooveError:
        return None


def _sorted_grooves(found: GrooveDetection | None, cloud: Floats, valid: Flags) -> tuple[list[Judged], list[Judged]]:
    """The grooves that are sure and those that are doubtful, their members counted among the finite points.

    What does not stand out of the noise is neither.
    """
    sure: list[Judged] = []
    doubtful: list[Judged] = []
    number = np.cumsum(valid) - 1
    if found is None:
        return sure, doubtful
    for groove in found.grooves:
        one = judge_groove(replace(groove, members=number[groove.members]), cloud)
        if stands_out(one, cloud, found.spacing_mm):
            (sure if one.is_sure else doubtful).append(one)
    return sure, doubtful


def _reshaped(found: GrooveDetection | None, cloud: Floats, valid: Flags, spacing: float) -> GrooveDetection | None:
    """The long ones of grooves that may have an upright wall, their roots where all points together show them."""
    if found is None:
        return None
    number = np.cumsum(valid) - 1
    kept = []
    for groove in found.grooves:
        width = float(np.median(groove.width_mm))
        least = max(BEVEL_ASPECT * width, BEVEL_FRACTION * diagonal_mm(cloud))
        mine = replace(groove, members=number[groove.members])
        resolved = groove.length_mm > least and width > TOLD_SPACINGS * spacing
        if resolved and wall_fraction(mine, cloud) >= MIN_WALL_FRACTION:
            shape = section_shape(groove, cloud, spacing)
            kept.append(groove if shape is None else with_shape(groove, shape))
    return replace(found, grooves=tuple(kept))


def _upright(one: Judged, cloud: Floats, spacing: float) -> Judged:
    """A sure groove whose root lies near one edge, with an upright wall there if all points together show one."""
    if skew_of(one.groove) > SKEWED:
        return one
    shape = section_shape(one.groove, cloud, spacing)
    if shape is None or skew_of(moved := with_shape(one.groove, shape)) > BEVEL_SKEW:
        return one
    return replace(one, groove=moved)


def _facings(viewpoint_mm: ArrayLike | None, told: Floats | None, sides: int) -> list[Floats | None]:
    """Where normals are turned to: a viewpoint (3,), or one that the density of the points ``told``, else None for the
    side that looks up."""
    if viewpoint_mm is not None:
        return [np.asarray(viewpoint_mm, dtype=float)]
    if told is not None:
        return [told, None]
    return [np.zeros(3) if sides == 1 else None]


def _is_corner(one: Judged, others: list[Seam], spacing: float) -> bool:
    """Whether a doubtful groove is better explained by one of the other seams, which runs within it.

    One whose edges are not seen to turn on either side is explained by any corner of the scene.
    """
    groove, edges, walls_seen = one.groove, one.sides, one.on_walls >= MIN_WALL_FRACTION
    if (
        walls_seen
        and not {Edge.ENDS, Edge.UNTOLD} & set(edges)
        and any(seam.kind not in (LAP, BUTT, OUTSIDE) for seam in others)
    ):
        return True
    unsure = groove.edges_seen < CORNER_RATHER or (walls_seen and edges != (Edge.ENDS, Edge.ENDS))
    width, depth = float(np.median(groove.width_mm)), float(np.median(groove.depth_mm))
    for seam in others:
        away = cKDTree(seam.root).query(groove.root)[0]
        meets = (away < width).mean() > 0.3
        # The walls of a groove are no longer than it says; in a corner of two bodies the faces go on.
        longer = seam.kind in FAMILIES["tube"] or np.median(seam.legs_mm, axis=1).max() > 1.3 * np.hypot(
            width / 2, depth
        )
        if meets and (unsure and longer if seam.kind != BUTT else width < TOLD_SPACINGS * spacing or not walls_seen):
            return True
    return False


def _is_scanty(one: Judged, spacing: float) -> bool:
    """Whether hardly more than one side of a groove is seen: any seam whose faces are both seen is surer."""
    return Edge.UNSEEN in one.sides and filling_of(one.groove, spacing) < MIN_FILLING


def _classes(seams: list[Seam], scanty: list[Seam], wanted: tuple[str, ...]) -> list[list[Seam]]:
    """Seams of the kinds wanted: grooves and concave corners, then steps and gaps, outside corners, glancing ones.

    Grooves of which little is seen (``scanty``) count as the second where there are others of the first.
    """
    groups: list[list[Seam]] = [[], [], [], []]
    for seam in seams:
        if seam.kind in wanted:
            rank = 3 if seam.glancing else 2 if seam.kind == OUTSIDE else 1 if seam.kind in (LAP, BUTT) else 0
            groups[rank].append(seam)
    groups[1 if groups[0] else 0] += [seam for seam in scanty if seam.kind in wanted]
    groups[0] = [s for s in groups[0] if s.groove] + sorted(
        (s for s in groups[0] if not s.groove), key=lambda seam: -seam.length_mm
    )
    if groups[0]:
        least = SHORT * max(seam.length_mm for seam in groups[0])
        surest = max(seam.deviations for seam in groups[0])
        weak = [
            seam
            for seam in groups[0]
            if not seam.groove
            and (seam.length_mm < least or (seam.deviations < min(SURE_DEVIATIONS, SURE_FRACTION * surest)))
        ]
        groups[1] += weak
        groups[0] = [seam for seam in groups[0] if seam not in weak]
    for group in groups[1:]:
        group.sort(key=lambda seam: (seam.kind != BUTT, -seam.length_mm))
    return [group for group in groups if group]


def _nothing(count: int, spacing: float, joint: str, others: list[Seam], hollows: list[DetectedGroove]) -> str:
    """Why there is no seam, and what the scan could have shown."""
    if others:
        seen = "; ".join(map(str, others))
        return f"no {joint} in the cloud, but {seen}; leave out --joint to take these"
    if hollows:
        sizes = ", ".join(f"{np.median(hollow.width_mm):.3g} mm wide" for hollow in hollows)
        return (
            f"no seam in the cloud, but a hollow ({sizes}) whose sides bend on instead of ending at edges, like the one"
            " between two tubes: look at it with --joint groove if it is a worn groove, else scan the corner from where"
            " both its faces are seen"
        )
    what = "no groove in the cloud, nor another seam" if joint == "any" else f"no {joint} in the cloud"
    return (
        f"{what} ({count:,} points, {spacing:.2g} mm apart): no place where two surfaces meet or part"
        f" along a line. At this spacing a groove must be {4 * spacing:.2g} mm wide, a corner's faces"
        f" {3 * CELL_SPACINGS * spacing:.2g} mm and a gap {MIN_SPACINGS * spacing:.2g} mm: for smaller ones scan more"
        " densely or from nearer; check the view, and give the viewpoint if the camera does not stand at the origin"
    )
