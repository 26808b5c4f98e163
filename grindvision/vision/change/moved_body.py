"""Whether something in both scans has moved against the rest: a part that was put down anew on a table that both show.

One pose fits one rigid body. Where the scans show two, the pose fits the larger one; the other comes out as stock on
its leading faces and as missing material on its trailing ones. Such a body is known by this: most of the surface that
disagrees at the pose agrees once it is moved by one rigid motion, on faces of two directions or more. A face that is
off as a whole is explained by a motion, too, but faces one way only; a bead has no counterpart in the sample.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from grindvision.errors import DegenerateError
from grindvision.geometry import angle_between, inverse, move_points, rigid, rotate_vectors
from grindvision.records import by_content
from grindvision.vision.change.change_detection import Difference
from grindvision.vision.registration.agreement import agreement
from grindvision.vision.registration.face_offsets import FaceReading
from grindvision.vision.registration.icp import FineRegistration
from grindvision.vision.registration.plane_icp import icp_planes, plane_residuals
from grindvision.vision.registration.relative_scale import relative_scale
from grindvision.vision.surface.scan import Scan
from grindvision.vision.surface.surfels import Surfels

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

SPREADS = 4.0
"""Surfaces that are farther apart than so many standard deviations of the residuals at the pose, and than the level of
detection, disagree."""

REACH_CELLS = 6.0
"""A body is sought within so many cells of where each start puts it."""

START = 1.5
"""A start moves what disagrees by so many of its median distances along and against each of its principal axes."""

MIN_SURFELS, MIN_FRACTION = 100, 0.012
"""Fewer surfels that one motion explains, or a smaller fraction of the scan, may be a bead: of the moved parts tried it
was 0.02 to 0.04, of beads below 0.01."""

MIN_EXPLAINED = 0.65
"""Fraction of the disagreeing surfels that a motion must explain. Of moved bodies it explains 0.7 to 0.9, the rest are
faces that the other scan does not show; of pits and a thick face at most 0.4, of a bead's flat top and sides 0.6."""

MAX_TAKEN = 0.5
"""Where a moved body was, the test scan shows nothing of it. A motion that lays more than this fraction of what it
explains on surface that the test scan shows at its place has found another edge for the flanks of a bead."""

MIN_DIRECTIONS = 0.03
"""Least second eigenvalue of the mean outer product of the explained surfels' normals, which add up to 1: faces of one
direction have none, and are no evidence of a body."""

ALONG_EXPLAINS = 0.7
"""Fraction of a body's surfels that the part of its motion along its largest face must explain where a single face off
as a whole is the other reading: the rest of the motion is then no more than what so small a body leaves open."""

SCALE_EXPLAINS = 0.6
"""Another scale moves one end of a part as a motion does: where it explains so much of what the motion does, it is
that."""


@by_content
@dataclass(frozen=True)
class MovedBody:
    """What has moved between the scans against what fixes the pose, frame of the test scan.

    ``T_now_before`` (4, 4): its motion from where the sample has it, by the pose, to where the test scan has it;
    ``middle_mm`` (3,): of its faces that show the motion; ``surfels``: so many of them; ``explained``: their fraction
    of all surfels that disagree at the pose; ``face_mm`` (3,): the middle of what speaks against the motion being that
    of the whole scan where that faces one way only, else None: then that face may be off instead.
    """

    T_now_before: Floats
    middle_mm: Floats
    surfels: int
    explained: float
    face_mm: Floats | None

    @property
    def motion_mm(self) -> Floats:
        """How its middle has moved (3,)."""
        return self.middle_mm - move_points(inverse(self.T_now_before), self.middle_mm)

    def __str__(self) -> str:
        place = _place(self.middle_mm)
        angle = np.degrees(angle_between(self.T_now_before, np.eye(4)))
        motion = f"about {np.linalg.norm(self.motion_mm):.2g} mm and {angle:.2g} deg"
        return f"what is about {place} mm in the test scan has moved by {motion}"


def find_moved_body(
    source: Scan, target: Scan, registration: FineRegistration, difference: Difference
) -> MovedBody | None:
    """The body that has moved against the rest, None where no motion explains what disagrees.

    ``registration`` is T_target_source; ``difference`` that of the source at this pose.
    """
    surfels, pose, cell = source.surfels, registration.T_target_source, target.surfels.grid.size_mm
    residuals, facing = plane_residuals(surfels.points, surfels.normals, target.surfels, pose, 3 * cell)
    if not facing.any():
        return None
    spread = 1.4826 * float(np.median(np.abs(residuals[facing])))
    within = max(SPREADS * spread, difference.level_of_detection_mm)
    apart = np.abs(difference.signed_mm) > within  # NaN is not
    even = surfels.excess_mm2 <= within**2  # a plane through an edge is none
    disagree = apart & even & ~(facing & (np.abs(residuals) <= within))
    if disagree.sum() < MIN_SURFELS:
        return None
    points, normals = surfels.points[disagree], surfels.normals[disagree]
    best, explained = pose, np.zeros(len(points), dtype=bool)
    for start in _starts(points, pose, START * float(np.median(np.abs(difference.signed_mm[disagree])))):
        try:
            moved = icp_planes(points, normals, target.surfels, start, REACH_CELLS * cell, within, 100)
        except DegenerateError:  # nothing of the target is near
            continue
        rest, met = plane_residuals(points, normals, target.surfels, moved.T_target_source, 3 * cell)
        agree = met & (np.abs(rest) <= within)
        if agree.sum() > explained.sum():
            best, explained = moved.T_target_source, agree
    if explained.sum() < max(MIN_SURFELS, MIN_FRACTION * len(surfels), MIN_EXPLAINED * len(points)):
        return None
    before = inverse(pose) @ best
    there, facing_there = move_points(before, points[explained]), rotate_vectors(before, normals[explained])
    if agreement(there, facing_there, surfels, np.eye(4), within).agreeing > MAX_TAKEN:
        return None
    if _explained_by_scale(source, target, registration, disagree, within) > SCALE_EXPLAINS * explained.mean():
        return None
    if _face_one_way(normals[explained]):
        return None
    body = MovedBody(
        inverse(before), np.median(points[explained], axis=0), int(explained.sum()), float(explained.mean()), None
    )
    agreeing = facing & (np.abs(residuals) <= within) & even
    moving = np.flatnonzero(disagree)[explained]
    return replace(body, face_mm=_face_in_its_place(surfels, target.surfels, pose, body, moving, agreeing, within))


def _face_in_its_place(
    source: Surfels, target: Surfels, pose: Floats, body: MovedBody, moving: Integers, agreeing: Flags, within_mm: float
) -> Floats | None:
    """Middle (3,) of the one face that would be off, had all moved as the body has along its own largest face; None
    where that does not explain the body, or faces of two directions speak against it."""
    up = source.normals[moving]
    along = np.linalg.eigh(up.T @ up)[1][:, -1]
    moved = pose @ rigid(None, -(body.motion_mm @ along) * along)
    residuals, facing = plane_residuals(source.points, source.normals, target, moved, 3 * target.grid.size_mm)
    agree = facing & (np.abs(residuals) <= within_mm)
    against = agreeing & facing & ~agree
    if agree[moving].mean() < ALONG_EXPLAINS or not against.any() or not _face_one_way(source.normals[against]):
        return None
    return np.asarray(np.median(source.points[against], axis=0))


def _face_one_way(normals: Floats) -> bool:
    """Whether normals (N, 3) have one direction."""
    return float(np.linalg.eigvalsh(normals.T @ normals / len(normals))[1]) < MIN_DIRECTIONS


def _place(point_mm: Floats) -> str:
    return f"({', '.join(f'{value:.0f}' for value in point_mm)})"


def _explained_by_scale(
    source: Scan, target: Scan, registration: FineRegistration, chosen: Flags, within_mm: float
) -> float:
    """Fraction of the ``chosen`` surfels (M,) that agree where all are scaled to the target's size and fitted anew."""
    scale, _ = relative_scale(source, target, registration)
    centre = move_points(inverse(registration.T_target_source), registration.centre_mm)
    points, normals = centre + (source.surfels.points - centre) / scale, source.surfels.normals
    try:
        fitted = icp_planes(points, normals, target.surfels, registration.T_target_source)
    except DegenerateError:
        return 0.0
    return agreement(points[chosen], normals[chosen], target.surfels, fitted.T_target_source, within_mm).agreeing


def _starts(points: Floats, pose: Floats, length_mm: float) -> list[Floats]:
    """The pose (4, 4), and the pose after a translation of points (N, 3) along and against each principal axis."""
    axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
    steps = [sign * length_mm * axis for axis in axes for sign in (1, -1)]
    return [pose, *(pose @ rigid(np.eye(3), step) for step in steps)]


def check_one_body(
    source: Scan, target: Scan, registration: FineRegistration, difference: Difference, faces: FaceReading
) -> None:
    """Refuse a comparison of scans that show two bodies, of which one has moved, or a face that is off and may be one.

    Raises:
        DegenerateError: a body has moved; see ``find_moved_body``.
    """
    body = find_moved_body(source, target, registration, difference)
    if body is None or faces.explain(body.motion_mm):
        return
    if body.face_mm is not None:
        raise DegenerateError(
            f"the faces contradict each other: either {body} against the rest, or the face about"
            f" {_place(body.face_mm)} mm is off as a whole by as much; say which faces are right with --datum, or cut"
            " both scans to the part (--sample-box, --test-box) where it was put down anew"
        )
    raise DegenerateError(
        f"the scans show two bodies, and {body} against the rest: one pose fits only one of the two; was the part"
        " put down anew on a table or fixture that both scans show? Then cut both to the part (--sample-box,"
        " --test-box)"
    )
