"""First alignment, our variant of SAC-IA (section 3.3): likely poses from pairs of oriented points.

Pairs whose distances and angles agree are found by testing hundred thousands before anything is computed; their poses
are scored in batches and the best distinct ones kept. ``verification`` then decides among them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from grindvision.errors import DegenerateError
from grindvision.kernels import njit
from grindvision.parallel import one_blas_thread, parallel_map
from grindvision.vision.surface.keypoints import Keypoints, most_similar

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

COS_AGREE = float(np.cos(np.radians(15)))
"""Cosine of the angle up to which two angles of a pair of correspondences agree."""


class _Round(NamedTuple):
    """Keypoints asked for similar ones, samples in a batch, most batches, and the fraction of agreeing keypoints that
    ends it."""

    queries: int
    batch: int
    batches: int
    enough: float


ROUNDS = (_Round(300, 4_000, 1, 0.45), _Round(1_200, 40_000, 5, 0.1))
"""Few first, which decide where much agrees; many where those leave a doubt."""


@one_blas_thread()
def propose_poses(
    source: Keypoints, target: Keypoints, rng: np.random.Generator, similar: int = 3, kept: int = 40
) -> tuple[Floats, Floats]:
    """Likely poses T_target_source (K, 4, 4), best first, and the fraction of keypoints (K,) that agrees with each.

    Steps 1-3 of section 3.3 made cheap: a sample is two points with their normals, which fix a pose; it is dropped
    unless the two distances agree within two spacings, the angles between normals within 15 degrees, and those of each
    normal to the connecting line too. What is left is scored on a part of the correspondences, the best of it on all.
    Batches of samples are drawn until the best pose has 1.5 times any other's votes (``ROUNDS``).

    Raises:
        DegenerateError: too few keypoints, or no sample survives.
    """
    if len(source) < 20 or len(target) < 20:
        raise DegenerateError(
            f"{len(source)} and {len(target)} keypoints are too few; scan more of the part, or more densely"
        )
    extent = float(np.linalg.norm(np.ptp(target.points, axis=0)))
    centre = source.points.mean(axis=0)
    # the short round draws from a stream of its own: where it decides nothing, all goes on as if it had not been
    for asked, draws in zip(ROUNDS, (rng.spawn(1)[0], rng), strict=True):
        poses, fractions, clear = _sampled(source, target, draws, asked, similar, centre, extent)
        if clear:
            break
    if len(poses) == 0:
        raise DegenerateError(
            "no two points of one scan fit any two of the other: a flat or round part without features, or two parts?"
        )
    return distinct_poses(poses, fractions, centre, 0.03 * extent, np.radians(8), kept)


def distinct_poses(
    poses: Floats, scores: Floats, centre_mm: Floats, apart_mm: float, apart_rad: float, kept: int
) -> tuple[Floats, Floats]:
    """The first ``kept`` of sorted poses, less those within ``apart_mm`` (at a centre) and ``apart_rad`` of another."""
    spots = poses[:, :3, :3] @ centre_mm + poses[:, :3, 3]
    chosen = _distinct(poses, spots, float(apart_mm), float(np.cos(apart_rad)), kept)
    return poses[chosen], scores[chosen]


def _sampled(
    source: Keypoints, target: Keypoints, rng: np.random.Generator, asked: _Round, similar: int,
    centre: Floats, extent: float,
) -> tuple[Floats, Floats, bool]:  # fmt: skip
    """Poses (K, 4, 4) of samples of distinctive keypoints, best first, the fraction (K,) of these keypoints that agrees
    with each, and whether the best is far ahead."""
    chosen = _distinctive(source.features, asked.queries, rng)
    t = most_similar(source.features[chosen], target.features, similar).ravel()
    s = np.repeat(chosen, similar)
    matches = (source.points[s], source.normals[s], target.points[t], target.normals[t])
    part = tuple(column[: len(chosen) // 4 * similar] for column in matches)
    spacing = max(source.spacing_mm, target.spacing_mm)
    poses, fractions = np.empty((0, 4, 4)), np.empty(0)
    for _ in range(asked.batches):
        first, second = _agreeing_pairs(
            *matches,
            rng.integers(len(s), size=(asked.batch, 2)),
            max(0.08 * extent, 4 * spacing),
            2 * spacing,
            COS_AGREE,
        )
        found = _poses_of_pairs(*matches, first[:2000], second[:2000])
        found = found[np.argsort(-_all_votes(found, part, 3 * spacing, similar), kind="stable")[:150]]
        poses = np.concatenate([poses, found])
        fractions = np.concatenate([fractions, _all_votes(found, matches, 3 * spacing, similar) / len(chosen)])
        order = np.argsort(-fractions, kind="stable")
        poses, fractions = poses[order], fractions[order]
        _, best = distinct_poses(poses, fractions, centre, 0.15 * extent, np.radians(20), 2)
        if len(best) and best[0] > max(asked.enough, 1.5 * best[1:].sum()):
            return poses, fractions, True
    return poses, fractions, False


def _distinctive(features: Floats, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Up to ``count`` indices, those with unusual histograms preferred: a flat neighbourhood tells nothing."""
    if len(features) <= count:
        return rng.permutation(len(features))
    unusual = np.linalg.norm(features - np.median(features, axis=0), axis=1)
    weights = unusual + 0.1 * unusual.mean() + 1e-12
    return rng.choice(len(features), count, replace=False, p=weights / weights.sum())


def _all_votes(poses: Floats, matches: tuple[Floats, ...], apart: float, similar: int) -> NDArray[np.int64]:
    """``_votes`` of many poses, in two threads."""
    source, source_normals, target, target_normals = matches

    def votes(half: Floats) -> NDArray[np.int64]:
        return _votes(half, source, source_normals, target, target_normals, apart, similar)

    return np.concatenate(parallel_map(votes, np.array_split(poses, 2)))


@njit(cache=True, nogil=True)
def _distinct(poses: Floats, spots: Floats, apart: float, cosine: float, kept: int) -> Integers:
    """Indices of the first ``kept`` poses (K, 4, 4) that are near no other; they move a centre to ``spots`` (K, 3)."""
    chosen = np.empty(kept, dtype=np.int64)
    count = 0
    for at in range(len(poses)):
        alike = False
        for other in chosen[:count]:
            away, trace = 0.0, 0.0
            for a in range(3):
                away += (spots[at, a] - spots[other, a]) ** 2
                for b in range(3):
                    trace += poses[at, a, b] * poses[other, a, b]
            alike = alike or (away < apart * apart and (trace - 1) / 2 > cosine)
        if not alike and count < kept:
            chosen[count] = at
            count += 1
    return chosen[:count]


@njit(cache=True, nogil=True)
def _dot(a: Floats, b: Floats) -> float:
    """Inner product of two vectors (3,)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True, nogil=True)
def _agreeing_pairs(
    source: Floats,
    source_normals: Floats,
    target: Floats,
    target_normals: Floats,
    draws: Integers,
    least: float,
    apart: float,
    cosine: float,
) -> tuple[Integers, Integers]:
    """Of drawn pairs of correspondences, those whose distances and angles agree: their two correspondences."""
    first, second = np.empty(len(draws), np.int64), np.empty(len(draws), np.int64)
    sine = np.sqrt(1 - cosine * cosine)
    found = 0
    for draw in range(len(draws)):
        i, j = draws[draw, 0], draws[draw, 1]
        a = source[j] - source[i]
        length_a = np.sqrt(_dot(a, a))
        if length_a < least:
            continue
        b = target[j] - target[i]
        length_b = np.sqrt(_dot(b, b))
        if abs(length_a - length_b) > apart:
            continue
        between_a, between_b = _dot(source_normals[i], source_normals[j]), _dot(target_normals[i], target_normals[j])
        if not _angles_agree(between_a, between_b, cosine, sine):
            continue
        if not _angles_agree(
            _dot(source_normals[i], a) / length_a, _dot(target_normals[i], b) / length_b, cosine, sine
        ):
            continue
        if not _angles_agree(
            _dot(source_normals[j], a) / length_a, _dot(target_normals[j], b) / length_b, cosine, sine
        ):
            continue
        first[found], second[found] = i, j
        found += 1
    return first[:found].copy(), second[:found].copy()


@njit(cache=True, nogil=True)
def _angles_agree(a: float, b: float, cosine: float, sine: float) -> bool:
    """Whether two angles, given by their cosines, differ by less than the angle of ``cosine``."""
    a, b = min(max(a, -1.0), 1.0), min(max(b, -1.0), 1.0)
    return a * b + np.sqrt((1 - a * a) * (1 - b * b)) > cosine


@njit(cache=True, nogil=True)
def _frame(origin: Floats, end: Floats, normal_a: Floats, normal_b: Floats, frame: Floats) -> bool:
    """Columns: connecting line, mean normal made perpendicular to it, their cross product; false when undefined."""
    line = end - origin
    line /= np.sqrt(_dot(line, line))
    up = normal_a + normal_b
    up -= _dot(up, line) * line
    length = np.sqrt(_dot(up, up))
    if length < 0.2:
        return False
    up /= length
    frame[:, 0], frame[:, 1] = line, up
    frame[0, 2] = line[1] * up[2] - line[2] * up[1]
    frame[1, 2] = line[2] * up[0] - line[0] * up[2]
    frame[2, 2] = line[0] * up[1] - line[1] * up[0]
    return True


@njit(cache=True, nogil=True)
def _poses_of_pairs(
    source: Floats, source_normals: Floats, target: Floats, target_normals: Floats, first: Integers, second: Integers
) -> Floats:
    """Poses T_target_source (K, 4, 4) of pairs of correspondences, by the frames of their two oriented points."""
    poses = np.zeros((len(first), 4, 4))
    frame_s, frame_t = np.empty((3, 3)), np.empty((3, 3))
    found = 0
    for pair in range(len(first)):
        i, j = first[pair], second[pair]
        if not _frame(source[i], source[j], source_normals[i], source_normals[j], frame_s):
            continue
        if not _frame(target[i], target[j], target_normals[i], target_normals[j], frame_t):
            continue
        pose = poses[found]
        for a in range(3):
            for b in range(3):
                pose[a, b] = (
                    frame_t[a, 0] * frame_s[b, 0] + frame_t[a, 1] * frame_s[b, 1] + frame_t[a, 2] * frame_s[b, 2]
                )
        for a in range(3):
            pose[a, 3] = 0.5 * (target[i, a] + target[j, a])
            for b in range(3):
                pose[a, 3] -= pose[a, b] * 0.5 * (source[i, b] + source[j, b])
        pose[3, 3] = 1.0
        found += 1
    return poses[:found].copy()


@njit(cache=True, nogil=True)
def _votes(
    poses: Floats,
    source: Floats,
    source_normals: Floats,
    target: Floats,
    target_normals: Floats,
    apart: float,
    similar: int,
) -> Integers:
    """Number of source points one of whose ``similar`` partners lies within ``apart`` with its normal within 30 deg."""
    votes = np.zeros(len(poses), dtype=np.int64)
    for pose in range(len(poses)):
        m = poses[pose]
        for group in range(0, len(source), similar):
            s, n = source[group], source_normals[group]
            x = m[0, 0] * s[0] + m[0, 1] * s[1] + m[0, 2] * s[2] + m[0, 3]
            y = m[1, 0] * s[0] + m[1, 1] * s[1] + m[1, 2] * s[2] + m[1, 3]
            z = m[2, 0] * s[0] + m[2, 1] * s[1] + m[2, 2] * s[2] + m[2, 3]
            for at in range(group, group + similar):
                dx, dy, dz = target[at, 0] - x, target[at, 1] - y, target[at, 2] - z
                if dx * dx + dy * dy + dz * dz < apart * apart:
                    t = target_normals[at]
                    facing = 0.0
                    for k in range(3):
                        facing += t[k] * (m[k, 0] * n[0] + m[k, 1] * n[1] + m[k, 2] * n[2])
                    if facing > 0.866:
                        votes[pose] += 1
                        break
    return votes
