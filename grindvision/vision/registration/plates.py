"""Poses of plates and sheets on their models: nearly all of the surface is a plane on which ICP rests anywhere.

The middles and the axes of the main faces are brought onto each other, and the pose is slid to where the outline, the
holes and the edges contradict it least.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from grindvision.geometry import move_points, rigid, rotate_vectors, rotation_about, small_motion
from grindvision.parallel import parallel_map
from grindvision.vision.registration.plane_icp import MIN_FACING
from grindvision.vision.registration.pose_candidates import Candidate, PoseJudge
from grindvision.vision.registration.rivals import weak_motions

Floats = NDArray[np.float64]

PLANAR, FLAT_POINTS, ROUND = 3, 100, 0.8
"""So many weak motions leave a plane free to slide; a face of fewer samples has no middle; of a face whose variances
along its axes are nearer to each other than this ratio, the axes tell no direction."""

BESIDE = 0.05
"""Fraction of a scan beside the model of a plate from which on its place on the plane is not known."""

FIRST_STEP, SLID_TO_LEAST = 0.04, 4
"""First step along a weak motion, as a fraction of the extent, and how many candidates are slid."""


def plate_poses(judge: PoseJudge, best: Candidate) -> list[Candidate]:
    """Candidates that bring the middle and the in-plane axes of a scan's main face onto those of the model's two sides,
    where the best pose leaves a plane free to slide; none elsewhere."""
    if not judge.whole or weak_motions(judge, best).shape[1] < PLANAR:
        return []
    facing = rotate_vectors(best.pose, judge.normals)
    up = np.linalg.svd(facing, full_matrices=False)[2][0]
    up *= np.sign((facing @ up).sum())
    middle = move_points(best.pose, judge.centre)
    over = rigid(None, middle) @ rigid(rotation_about(np.linalg.svd(up[None])[2][1], np.pi)) @ rigid(None, -middle)
    faces = (best.pose, up), (over @ best.pose, -up)
    poses = [pose for face in faces for pose in _on_face(judge, *face)]
    near = judge.distinct(judge.refined_all(poses, far=True))[:SLID_TO_LEAST]
    return judge.settled(parallel_map(lambda one: _slid_to_least(judge, one), near))


def lies_beside(judge: PoseJudge, best: Candidate) -> str:
    """In words, that much of a scan lies beside the model of a plate, so that its pose is as good as any other that
    slides on it; empty elsewhere."""
    beside = judge.evidence(best.pose, None).beside
    if not judge.whole or beside < BESIDE or weak_motions(judge, best).shape[1] < PLANAR:
        return ""
    return (
        f"nearly all of the part is one plane, and {beside:.0%} of the scan lies beside the model: there is no telling"
        " where on the plane it lies; crop the scan to the part, or scan all of its outline"
    )


def _on_face(judge: PoseJudge, pose: Floats, up: Floats) -> list[Floats]:
    """Poses (4, 4) after which the source's face that looks along ``up`` (3,) lies on the model's that does, middle
    on middle and axis on axis; a round one at every angle."""
    points, normals = move_points(pose, judge.points), rotate_vectors(pose, judge.normals)
    faces = [
        points[normals @ up > MIN_FACING],
        judge.target.points[judge.target.normals @ up > MIN_FACING],
    ]
    if min(len(face) for face in faces) < FLAT_POINTS:
        return []
    near = 3 * judge.fine.grid.size_mm
    faces = [face[np.abs(face @ up - np.median(face @ up)) < near] for face in faces]
    across = np.linalg.svd(up[None])[2][1]
    plane = np.stack([across, np.cross(up, across)])
    (start, end), spreads = zip(*(_middle_and_axis(face, plane) for face in faces), strict=True)
    turns = np.arange(24) * np.pi / 12 if max(spreads) > ROUND else np.array([0.0, np.pi])
    return [
        rigid(None, end[0]) @ rigid(rotation_about(up, float(turn))) @ rigid(None, -start[0]) @ pose
        for turn in turns + (end[1] - start[1])
    ]


def _slid_to_least(judge: PoseJudge, one: Candidate, finest: float = 0.1) -> Candidate:
    """A candidate slid along its weak motions to where least contradicts it, by steps down to ``finest`` of a cell:
    what an outline says pulls at no step of ICP."""
    twists = weak_motions(judge, one).T
    to_centre, back = rigid(None, -one.found.centre_mm), rigid(None, one.found.centre_mm)
    place, step = np.zeros(len(twists)), FIRST_STEP * judge.extent
    pose, least = one.pose, judge.evidence(one.pose, None).cost()
    while step > finest * judge.fine.grid.size_mm:
        before = least
        for axis, sign in product(range(len(twists)), (step, -step)):
            there = place + sign * np.eye(len(twists))[axis]
            tried = back @ small_motion(there @ twists) @ to_centre @ one.pose
            cost = judge.evidence(tried, None).cost()
            if cost < least:
                place, least, pose = there, cost, tried
        step *= 1.0 if least < before else 0.5
    return replace(one, found=replace(one.found, T_target_source=pose), cost=judge.evidence(pose).cost())


def _middle_and_axis(points: Floats, plane: Floats) -> tuple[tuple[Floats, float], float]:
    """Middle (3,) of a face's points (N, 3) and the angle in its ``plane`` (2, 3) of the axis along which they extend
    most; and the ratio of the least variance to the most."""
    variances, axes = np.linalg.eigh(np.cov(plane @ points.T))
    return (points.mean(axis=0), float(np.arctan2(axes[1, 1], axes[0, 1]))), float(variances[0] / variances[1])
