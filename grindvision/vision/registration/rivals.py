"""Rivals of a pose, sought on purpose where a part may look the same: the rotational symmetries of a box and of wheels,
steps along the motions that the surface resists least, and full turns about the axes of near symmetries."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import combinations, permutations, product

import numpy as np
from numpy.typing import NDArray

from grindvision.geometry import angle_between, inverse, rigid, rotation_about, rotation_axis, small_motion
from grindvision.parallel import parallel_map
from grindvision.vision.registration.global_registration import distinct_poses
from grindvision.vision.registration.held_motion import SLIDING, weak_motions_of
from grindvision.vision.registration.pose_candidates import Candidate, PoseJudge

Floats = NDArray[np.float64]
Axis = tuple[Floats, Floats]

WEAK = 0.04
"""A motion that so small a part of the surface resists is tried for a rival beside the best pose."""

NEARLY = 0.02
"""A rival whose cost per surfel is larger by no more than so much shows a near symmetry, whose axis is searched."""

MAX_FOLDS, SAME_ROTATION_RAD, COS_SAME_AXIS = 72, np.radians(0.6), float(np.cos(np.radians(2)))
"""Most teeth or holes that are looked for, the angle within which the poses of rivals show them, and the cosine of that
between the axes of rotations that count as one: poses apart by less are the same."""

REPEATED = 4.0
"""So many standard deviations more rivals than by chance must be multiples of one step: of four angles, two are by 3.5
for some step up to ``MAX_FOLDS`` at times."""

CONTRADICTED = 0.0005
"""Fraction of surfels in front of what the other scanner saw above which turns about the principal axes are tried."""

OVERLAPS = 0.6
"""A pose of which a smaller part agrees than this share of what agrees at the best one is no rival: beside each other,
scans never contradict."""

OVERLAPS_LESS = 0.4
"""The same share where something contradicts the best pose: one that turns it out of sight overlaps less."""

SETTLED = 6
"""So many of the rivals that are found at once are brought to rest."""

ROTATED, MEETS_AT_ALL, MEETS_AS_WELL = 6, 0.04, 0.75
"""So many of the rotated poses are refined, of those at which such a share meets of what meets at the best pose. Where
so little meets that only what ICP has brought near tells, the second share has to meet there: blades and quarter turns
of a part itself do, walls that lie on other walls meet in less."""

MOTION_STEPS = 36
"""Poses judged to either side along such a motion: over half a turn, or twice the extent."""

BOX_ROTATIONS = tuple(
    rotation
    for axes in permutations(range(3))
    for signs in product((1.0, -1.0), repeat=3)
    if np.linalg.det(rotation := np.eye(3)[list(axes)] * signs) > 0 and np.trace(rotation) < 3
)
"""The 23 rotations (3, 3) that bring a box back to its axes, but for none at all."""

WHEEL_ROTATIONS = tuple(
    rotation_about(axis, sign * 2 * np.pi / folds) for axis in np.eye(3) for folds in (3, 5, 7) for sign in (1, -1)
)
"""Rotations (3, 3) about the axes that bring wheels with 3, 5, 7 or so many times more spokes back to themselves; those
of 2 and 4 are among the box's."""


def with_rivals(judge: PoseJudge, best: Candidate, known: Sequence[Candidate]) -> list[Candidate]:
    """All distinct candidates at rest, best first: the ``known`` ones and the rivals of the best pose."""
    found = [
        *judge.refined_all(_rotated(judge, best, BOX_ROTATIONS)),
        *judge.refined_all(_rotated(judge, best, WHEEL_ROTATIONS)),
        *judge.refined_all(_stepped(judge, best), free=True),
    ]
    found = [one for one in found if judge.differ(one.pose, best.pose)]
    near = _near(judge, best, (*known, *found))
    turned = judge.refined_all(_turned(judge, best, near), far=True)
    found += turned
    found += judge.refined_all(_repeated(judge, best, _near(judge, best, (*near, *turned))))
    worth = judge.distinct(one for one in found if one.cost < best.cost + 2 * NEARLY)
    if len(worth) > SETTLED:  # by all samples: of a few hundred a small mark holds too few
        worth = judge.ranked(worth)
    return judge.distinct([*known, *judge.settled(worth, SETTLED), *_slid(judge, best)])


def _near(judge: PoseJudge, best: Candidate, candidates: Iterable[Candidate]) -> list[Candidate]:
    """Those of the candidates that show a near symmetry."""
    return [one for one in candidates if one.cost < best.cost + NEARLY and judge.differ(one.pose, best.pose)]


def is_contradicted(judge: PoseJudge, best: Candidate) -> bool:
    """Whether more of the surfels stand in front of what the other scanner saw than at a true pose without a change."""
    return judge.evidence(best.pose).hard > CONTRADICTED


def weak_motions(judge: PoseJudge, best: Candidate, below: float = WEAK) -> Floats:
    """Twists (6, K) about the best pose's centre, mm and rad, that less than this part of the surface resists."""
    return weak_motions_of(best.found, judge.extent, below).twists


def _rotated(judge: PoseJudge, best: Candidate, rotations: Sequence[Floats]) -> Floats:
    """The best few poses (K, 4, 4) after ``rotations`` about the source's principal axes, brought near first: what was
    seen of a part has another middle and other axes than the part."""
    axes = judge.axes()
    to_centre, back = rigid(None, -judge.centre), rigid(None, judge.centre)
    poses = np.stack([best.pose @ back @ rigid(axes @ rotation @ axes.T) @ to_centre for rotation in rotations])
    usual, rough = judge.rough_fractions(best.pose[None])[0], judge.rough_fractions(poses)
    least = (0.25 if judge.is_uncertain(best) else 0.5) * usual
    close = judge.neared_all(poses[rough > least])
    others = judge.neared_all(poses[(rough <= least) & (rough > MEETS_AT_ALL * usual)])
    if not close and not others:
        return np.empty((0, 4, 4))
    poses = np.stack([*close, *others])
    rough = judge.rough_fractions(poses)
    needed = np.where(np.arange(len(poses)) < len(close), least, MEETS_AS_WELL * usual)
    order = np.argsort(-rough, kind="stable")
    order = order[rough[order] > needed[order]]
    return distinct_poses(poses[order], rough[order], judge.centre, np.inf, np.radians(20), ROTATED)[0]


def _stepped(judge: PoseJudge, best: Candidate) -> list[Floats]:
    """Poses a step to either side along the motions that the surface resists least."""
    to_centre, back = rigid(None, -best.found.centre_mm), rigid(None, best.found.centre_mm)
    return [
        back @ small_motion(sign * 0.12 * judge.extent * twist) @ to_centre @ best.pose
        for twist in weak_motions(judge, best).T
        for sign in (1, -1)
    ]


def _turned(judge: PoseJudge, best: Candidate, near: Sequence[Candidate], steps: int = 72) -> Floats:
    """The likeliest poses (K, 4, 4) of full turns about the axes of near symmetries, and of the weakest motions; about
    the source's principal axes, too, where something contradicts the best pose."""
    axes = [*_weak_axes(judge, best), *_axes_between(best, near)]
    if is_contradicted(judge, best):
        axes += [(axis, best.found.centre_mm) for axis in (best.pose[:3, :3] @ judge.axes()).T]
    poses = [_about(axis, 2 * np.pi * k / steps, best) for axis in axes for k in range(1, steps)]
    if not poses:
        return np.empty((0, 4, 4))
    stacked = np.stack(poses)
    stacked = stacked[judge.rough_fractions(stacked) > 0.4 * judge.rough_fractions(best.pose[None])[0]]
    # by what contradicts, not by what overlaps: where the views coincide all turns of a ring do
    costs = np.array(parallel_map(lambda pose: judge.evidence(pose, 400).cost(), stacked))
    order = np.argsort(costs, kind="stable")
    return distinct_poses(stacked[order], costs[order], judge.centre, 0.05 * judge.extent, np.radians(9), 12)[0]


def _repeated(judge: PoseJudge, best: Candidate, near: Sequence[Candidate], kept: int = 6) -> list[Floats]:
    """The likeliest poses a tooth, a hole or several further, where near rivals show that the part repeats itself and
    as much of it overlaps: turned to where hardly anything does, a shaft hides its key."""
    poses = []
    for axis in _axes_between(best, near):
        about = [one.pose for one in near if _is_turned_about(axis, one, best)]
        folds = _folds([angle_between(pose, best.pose) for pose in about])
        poses += [_about(axis, 2 * np.pi * k / folds, best) for k in range(1, folds)]
    seen = parallel_map(lambda pose: judge.evidence(pose, None), poses)
    least = OVERLAPS * judge.evidence(best.pose, None).met
    likely = [at for at in np.argsort([one.cost() for one in seen], kind="stable") if seen[at].met > least]
    return [poses[at] for at in likely[:kept]]


def _about(axis: Axis, turn: float, best: Candidate) -> Floats:
    """The best pose (4, 4) turned by so many radians about an axis in the target's frame."""
    direction, pivot = axis
    return np.asarray(rigid(None, pivot) @ rigid(rotation_about(direction, turn)) @ rigid(None, -pivot) @ best.pose)


def _folds(angles_rad: Sequence[float]) -> int:
    """The equal steps of a full turn, such as teeth, of which more of these angles are multiples than would be by
    chance, the most standard deviations more; 1 where hardly more are multiples of any.

    Rivals rest between the holes of a flange, too, which hardly resist.
    """
    turns = np.array(angles_rad) / (2 * np.pi)
    best, most = 1, REPEATED
    for folds in range(2, MAX_FOLDS + 1):
        within = folds * SAME_ROTATION_RAD / (2 * np.pi)
        hits = int((np.abs(turns * folds - np.round(turns * folds)) < within).sum())
        by_chance = 2 * within * len(turns)
        if hits > 1 and (deviations := (hits - by_chance) / np.sqrt(by_chance)) > most:
            best, most = folds, deviations
    return best


def _slid(judge: PoseJudge, best: Candidate, kept: int = 8) -> list[Candidate]:
    """The likeliest poses all along the motions that next to nothing resists, without ICP, which would slide; but of
    turns, whose axis is known a little wrongly, at rest across these motions.

    Where something contradicts the best pose, poses of less overlap count, too, at which nothing is seen of it.
    """
    to_centre, back = rigid(None, -best.found.centre_mm), rigid(None, best.found.centre_mm)
    held = weak_motions_of(best.found, judge.extent, SLIDING)
    turned: list[Floats] = []
    moved: list[Floats] = []
    for twist in held.twists.T:
        turn = float(np.linalg.norm(twist[3:]))
        if turn * judge.extent > 0.5:
            for step in (np.pi / MOTION_STEPS / turn, -np.pi / MOTION_STEPS / turn):
                motion = back @ small_motion(step * twist) @ to_centre
                turned += judge.stepped_across(best.pose, motion, held, MOTION_STEPS)
        else:
            steps = 2 * judge.extent / MOTION_STEPS * np.arange(-MOTION_STEPS, MOTION_STEPS + 1)
            moved += [back @ small_motion(step * twist) @ to_centre @ best.pose for step in steps if step]
    share = OVERLAPS_LESS if is_contradicted(judge, best) else OVERLAPS
    least, poses = share * judge.evidence(best.pose).met, turned + moved
    seen = parallel_map(judge.evidence, poses)
    likely = [at for at in np.argsort([one.cost() for one in seen], kind="stable") if seen[at].met > least][:kept]
    slid = []
    for at in likely:
        one = Candidate(replace(best.found, T_target_source=poses[at]), seen[at].cost(), free=True)
        rested = judge.at_rest_across(one, held) if at < len(turned) else one
        if rested and judge.evidence(rested.pose).met > least:
            slid.append(rested)
    return slid


def _weak_axes(judge: PoseJudge, best: Candidate) -> list[Axis]:
    """Axis (3,) and a point (3,) on it of the weakest motions that are rotations."""
    return [
        (twist[3:], best.found.centre_mm + np.cross(twist[3:], twist[:3]) / (twist[3:] @ twist[3:]))
        for twist in weak_motions(judge, best).T[:2]
        if np.linalg.norm(twist[3:]) * judge.extent > 0.5
    ]


def _axes_between(best: Candidate, near: Sequence[Candidate]) -> list[Axis]:
    """Axes of the rotations between the best pose and its first two rivals, and between these: a wheel on its model is
    turned over by both, about two axes in its plane, and what leads from one to the other turns it about its own."""
    axes: list[Axis] = []
    for one, other in combinations((best, *near[:2]), 2):
        axis = _axis_between(one, other)
        if axis is not None and all(abs(axis[0] @ known[0]) < COS_SAME_AXIS for known in axes):
            axes.append(axis)
    return axes


def _is_turned_about(axis: Axis, one: Candidate, best: Candidate) -> bool:
    """Whether a rotation about nearly the same direction as an axis leads from the best pose to another."""
    between = _axis_between(best, one)
    return between is not None and abs(float(between[0] @ axis[0])) > COS_SAME_AXIS


def _axis_between(one: Candidate, other: Candidate) -> Axis | None:
    """Axis (3,) and a point (3,) on it of the rotation between two poses; None for hardly any rotation."""
    motion = other.pose @ inverse(one.pose)
    if angle_between(motion, np.eye(4)) < np.radians(4):
        return None
    return rotation_axis(motion[:3, :3]), np.linalg.pinv(np.eye(3) - motion[:3, :3], rcond=1e-6) @ motion[:3, 3]
