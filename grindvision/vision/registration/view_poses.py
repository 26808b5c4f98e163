"""Poses of many views from poses between pairs of them: loops that do not close, and what all pairs agree on."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from grindvision.geometry import inverse, move_points, skew, small_motion
from grindvision.records import by_content

Floats = NDArray[np.float64]
Pair = tuple[int, int]


@by_content
@dataclass(frozen=True)
class Tie:
    """A registered pair: the pose between its views, about which place, and how the surfaces resist a motion."""

    T_target_source: Floats
    centre_mm: Floats  # in the target's frame
    information: Floats  # (6, 6) per unit of weight: mm^2 along the normals for a motion in mm and rad


def _pose(ties: dict[Pair, Tie], target: int, source: int) -> Floats:
    """T_target_source of a registered pair, whichever way it was registered."""
    if (target, source) in ties:
        return ties[target, source].T_target_source
    return inverse(ties[source, target].T_target_source)


def open_loops(ties: dict[Pair, Tie], max_mm: float, extent: float, middles: Sequence[Floats]) -> list[Pair]:
    """Pairs most of whose loops of three end farther than ``max_mm`` from where they began, at a part's ``extent``."""
    linked = {frozenset(pair) for pair in ties}
    opened: dict[frozenset[int], list[bool]] = {pair: [] for pair in linked}
    for a, b, c in combinations(sorted({row for pair in ties for row in pair}), 3):
        sides = [frozenset(side) for side in ((a, b), (b, c), (a, c))]
        if not all(side in linked for side in sides):
            continue
        loop = _pose(ties, a, b) @ _pose(ties, b, c) @ _pose(ties, c, a)
        for side in sides:
            opened[side].append(moved_mm(loop, middles[a], extent) > max_mm)
    return [pair for pair in ties if (loops := opened[frozenset(pair)]) and 2 * sum(loops) > len(loops)]


def closed_ties(ties: dict[Pair, Tie], max_mm: float, extent: float, middles: Sequence[Floats]) -> list[Pair]:
    """Ties of at least one loop that ends where it began, within ``max_mm`` for loops of three and as the root of their
    number for more: the shortest way round through the others is asked of each."""
    closed: set[frozenset[int]] = set()
    for a, b in ties:
        way = _shortest_way([pair for pair in ties if pair != (a, b)], a, b)
        if not way:
            continue
        loop = _pose(ties, b, a)
        for row, other in pairwise(way):
            loop = loop @ _pose(ties, row, other)
        if moved_mm(loop, middles[b], extent) <= max_mm * np.sqrt(len(way) / 3):
            closed |= {frozenset(pair) for pair in [(a, b), *pairwise(way)]}
    return [pair for pair in ties if frozenset(pair) in closed]


def _shortest_way(pairs: Sequence[Pair], first: int, last: int) -> list[int]:
    """Views from ``first`` to ``last`` over the fewest pairs; none where none lead there."""
    came_from = {first: first}
    reached = [first]
    for row in reached:
        for a, b in pairs:
            other = b if a == row else a
            if row in (a, b) and other not in came_from:
                came_from[other] = row
                reached.append(other)
    if last not in came_from:
        return []
    way = [last]
    while way[-1] != first:
        way.append(came_from[way[-1]])
    return way[::-1]


def moved_mm(motion: Floats, middle: Floats, extent: float) -> float:
    """How far (mm) a motion takes a part of this extent about its middle (3,)."""
    turned = float(Rotation.from_matrix(motion[:3, :3]).magnitude())
    return float(np.hypot(np.linalg.norm(move_points(motion, middle) - middle), turned * extent))


def triangle_pairs(wanted: Sequence[Pair], views: int) -> list[Pair]:
    """Few of the pairs, so that each view closes a loop of three with two others: 2 N - 3 of N views, where the pairs
    allow it. Pairs early in ``wanted`` are preferred; a view that closes no loop is tied by one pair."""
    rank = {frozenset(pair): at for at, pair in enumerate(wanted)}
    chosen = [frozenset(wanted[0])]
    placed = set(wanted[0])
    while len(placed) < views:
        loops = [
            (max(rank[one], rank[other]), rank[one] + rank[other], row, one, other)
            for row in set(range(views)) - placed
            for a, b in chosen
            if (one := frozenset((row, a))) in rank and (other := frozenset((row, b))) in rank
        ]
        if loops:
            *_, row, one, other = min(loops, key=lambda loop: loop[:3])
            chosen += [one, other]
        else:
            single = [(at, pair) for pair, at in rank.items() if len(pair & placed) == 1]
            if not single:
                break
            pair = min(single, key=lambda one: one[0])[1]
            chosen.append(pair)
            (row,) = pair - placed
        placed.add(row)
    return [wanted[at] for at in sorted(rank[pair] for pair in chosen)]


def largest_group(ties: Iterable[Pair], views: int) -> list[int]:
    """The most views that pairs tie together, in order; of groups of one size the one with the lowest number."""
    group = list(range(views))
    for a, b in ties:
        low, high = sorted((group[a], group[b]))
        group = [low if one == high else one for one in group]
    largest = max(dict.fromkeys(group), key=group.count)
    return [row for row in range(views) if group[row] == largest]


def poses_along_pairs(ties: dict[Pair, Tie], reference: int, views: int) -> Floats:
    """First poses (N, 4, 4) in the frame of view ``reference``, over as few pairs as possible; NaN where none lead."""
    poses = np.full((views, 4, 4), np.nan)
    poses[reference] = np.eye(4)
    reached = [reference]
    for row in reached:
        for a, b in ties:
            other = b if a == row else a
            if row in (a, b) and other not in reached:
                poses[other] = poses[row] @ _pose(ties, row, other)
                reached.append(other)
    return poses


def consistent_poses(
    ties: dict[Pair, Tie], poses: Floats, reference: int, iterations: int = 20, firm: Collection[Pair] = ()
) -> tuple[Floats, Floats]:
    """Poses that all pairs agree on best, view ``reference`` at rest, and what is left of each pair (K,), mm.

    A pair's cost is that of its surfaces: with D the motion that leads from the pair's pose to the views' poses, the
    mean square of the distances along the normals that D makes. Pairs far off lose their weight (Tukey), but those that
    are ``firm``.
    """
    judged = np.array([pair not in firm for pair in ties])
    poses = poses.copy()
    free = [int(row) for row in np.flatnonzero(np.isfinite(poses[:, 0, 0])) if row != reference]
    column = {row: 6 * at for at, row in enumerate(free)}
    left = np.zeros(len(ties))
    for _ in range(iterations):
        linear = [_linearised(tie, poses[a], poses[b]) for (a, b), tie in ties.items()]
        squares = [error @ tie.information @ error for (error, _), tie in zip(linear, ties.values(), strict=True)]
        left = np.sqrt(np.maximum(squares, 0.0))
        cut = 4.685 * 1.4826 * max(float(np.median(left[judged])), 1e-6)
        weights = np.where(judged, np.clip(1 - (left / cut) ** 2, 1e-3, 1.0) ** 2, 1.0)
        matrix, right = np.zeros((6 * len(free), 6 * len(free))), np.zeros(6 * len(free))
        for (pair, tie), (error, jacobian), weight in zip(ties.items(), linear, weights, strict=True):
            pull = weight * jacobian.T @ tie.information
            signed = [(column[row], sign) for row, sign in zip(pair, (-1.0, 1.0), strict=True) if row != reference]
            for at, sign in signed:
                right[at : at + 6] -= sign * pull @ error
                for to, other_sign in signed:
                    matrix[at : at + 6, to : to + 6] += sign * other_sign * pull @ jacobian
        step = np.linalg.solve(matrix, right).reshape(-1, 6)
        for row, change in zip(free, step, strict=True):
            poses[row] = small_motion(change) @ poses[row]
        if np.abs(step[:, :3]).max() < 1e-6 and np.abs(step[:, 3:]).max() < 1e-8:
            break
    return poses, left


def _linearised(tie: Tie, target: Floats, source: Floats) -> tuple[Floats, Floats]:
    """The motion (6,) from a pair's pose to the views' poses, in the target's frame about the pair's place, and its
    Jacobian (6, 6) for a motion of the source's view in the part's frame; for one of the target's its negative."""
    motion = inverse(target) @ source @ inverse(tie.T_target_source)
    turn = Rotation.from_matrix(motion[:3, :3]).as_rotvec()
    error = np.concatenate([move_points(motion, tie.centre_mm) - tie.centre_mm, turn])
    lever = np.eye(6)
    lever[:3, 3:] = -skew(move_points(target, tie.centre_mm))
    return error, np.kron(np.eye(2), target[:3, :3].T) @ lever
