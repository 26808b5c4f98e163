"""Whether a scan's mirror image fits as well as the scan itself: then an export that is left-handed would not show."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from grindvision.errors import DegenerateError
from grindvision.geometry import inverse, move_points, rigid, rotate_vectors
from grindvision.vision.registration.agreement import Agreement
from grindvision.vision.registration.evidence import LOST
from grindvision.vision.registration.plane_icp import icp_planes
from grindvision.vision.registration.pose_candidates import REFINED, Candidate, PoseJudge, principal_axes
from grindvision.vision.registration.rivals import BOX_ROTATIONS, OVERLAPS

Floats = NDArray[np.float64]

TRIED = 4
"""So many of the likeliest mirror images are refined."""

DECIDED = 9.0
"""Logarithm of the odds from which the scan or its mirror image clearly fits better than the other."""

MUCH_MORE = 1.1
"""A mirror image that fits better is taken for the right one where so many times as much of the scans meets."""

FEW = 100
"""Surfels that bring a mirror image near."""

REFLECTION = np.diag([-1.0, 1.0, 1.0, 1.0])


@dataclass(frozen=True)
class MirrorImage:
    """A mirror image of the source that fits as well as itself: its ``agreement``, whether it is ``better`` by far, and
    by how many mm at most the two poses place a point of the source apart."""

    agreement: Agreement
    better: bool
    apart_mm: float

    def __str__(self) -> str:
        return f"{self.agreement}, points up to {self.apart_mm:.3g} mm from their places by the scan as it is"


def mirrored_fit(judge: PoseJudge, best: Candidate) -> MirrorImage | None:
    """The mirror image that fits best, among those in a box's planes of symmetry; None where the best pose is clearly
    better."""
    mirrored = _refined(judge, best)
    if not mirrored:
        return None
    one = judge.evidence(best.pose, None)
    pose = min(mirrored, key=lambda found: judge.evidence(found).cost())
    other = judge.evidence(pose, None)
    # two scans of a symmetric part from its two sides: the mirror image meets more of it, which decides nothing
    alike = min(one.met, other.met) > OVERLAPS * max(one.met, other.met)
    absent = 0.0 if alike and not judge.whole else LOST
    odds = judge.surfels * (other.cost(absent) - one.cost(absent))
    if odds > DECIDED:
        return None
    places = judge.points
    apart = np.linalg.norm(move_points(pose, places) - move_points(best.pose, places), axis=1).max()
    better = odds < -DECIDED and other.met > MUCH_MORE * one.met
    return MirrorImage(judge.agreement(pose), bool(better), float(apart))


def _refined(judge: PoseJudge, best: Candidate) -> list[Floats]:
    """Poses (4, 4) of determinant -1 that bring the source's mirror image onto the target, after ICP.

    The images start where the best pose puts them, which shows a symmetric part's, and where the principal axes of both
    scans lie on one another, which shows a scan that is mirrored whole.
    """
    about = rigid(judge.axes(), judge.centre)
    images = [about @ REFLECTION @ rigid(turn) @ inverse(about) for turn in (np.eye(3), *BOX_ROTATIONS)]
    across = rigid(principal_axes(judge.target.points), judge.target.points.mean(axis=0)) @ inverse(about)
    poses = [best.pose @ image for image in images]
    poses += [one for image in images if (one := _near(judge, across, image)) is not None]
    rough = judge.rough_fractions(np.stack(poses))
    order = np.argsort(-rough, kind="stable")[:TRIED]
    own = judge.rough_fractions(best.pose[None])[0]
    return [one for at in order[rough[order] > 0.5 * own] if (one := _at_rest(judge, poses[at])) is not None]


def _near(judge: PoseJudge, pose: Floats, image: Floats) -> Floats | None:
    """A mirror image's pose (4, 4) after a few steps of ICP from far."""
    voxel = judge.coarse.grid.size_mm
    points, normals = move_points(image, judge.points[:FEW]), rotate_vectors(image, judge.normals[:FEW])
    try:
        found = icp_planes(points, normals, judge.coarse, pose, 5 * voxel, voxel, iterations=8)
    except DegenerateError:
        return None
    return found.T_target_source @ image


def _at_rest(judge: PoseJudge, mirrored: Floats) -> Floats | None:
    """The same, of a pose (4, 4) of determinant -1, until it rests."""
    image = REFLECTION
    points, normals = move_points(image, judge.points), rotate_vectors(image, judge.normals)
    voxel, size = judge.coarse.grid.size_mm, judge.fine.grid.size_mm
    try:
        found = icp_planes(
            points[:REFINED], normals[:REFINED], judge.coarse, mirrored @ image, 1.5 * voxel, judge.within_mm, 10
        )
        found = icp_planes(
            points, normals, judge.fine, found.T_target_source, 1.5 * size, judge.within_mm / 3, iterations=30
        )
    except DegenerateError:
        return None
    return found.T_target_source @ image
