"""Poses of parts with flat faces, where no pose by features fits: faces laid on faces, then moved to where most meet.

On trays, brackets and boxes the features of one edge are those of every other. Two faces that are not parallel give the
rotation for each two of the other scan that stand at the same angle, and for what stands at right angles to them: walls
that the other scanner did not see. Pairs of points with the same normal vote for the translation.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from grindvision.geometry.transforms import rigid
from grindvision.parallel import parallel_map
from grindvision.vision.registration.global_registration import distinct_poses
from grindvision.vision.registration.pose_candidates import PoseJudge

Floats = NDArray[np.float64]

COS_FACE, MIN_FACE = float(np.cos(np.radians(12))), 0.02
"""Samples whose normals lie within that angle look along one direction; fewer than this fraction show no face."""

MOST_FACES = 6
"""So many of the directions with the most samples are asked for."""

MAX_PRODUCTS = 4
"""So many directions at right angles to two faces at right angles are asked for beside those of faces."""

COS_APART, COS_ALIKE = 0.7, 0.1
"""Two faces give a rotation where the cosine of their angle is smaller, and those of the other scan where it differs by
less."""

VOTERS, VOTED_FOR, COS_VOTE = 150, 1500, 0.96
"""Samples of the source and of the target that vote for a translation, where their normals are so near."""

BIN, PEAKS = 0.06, 2
"""Edge of a bin of translations, as a fraction of the extent, and how many of the fullest are tried per rotation."""

KEPT = 16
"""So many of the least contradicted poses are refined."""


def face_poses(judge: PoseJudge) -> Floats:
    """Poses T_target_source (K, 4, 4) that lay two faces of the source on two of the target, the least contradicted
    first; none where either scan shows no two flat faces."""
    ours, theirs = (_directions(one.normals) for one in (judge.source, judge.target))
    # of the walls of a box, each scanner may have seen others
    theirs = np.concatenate([theirs, square_to(theirs)])
    rotations = _distinct_rotations(list(_rotations(ours, np.concatenate([theirs, -theirs]))))
    if not rotations:
        return np.empty((0, 4, 4))
    poses = [pose for found in parallel_map(lambda rotation: _moved(judge, rotation), rotations) for pose in found]
    if not poses:
        return np.empty((0, 4, 4))
    stacked = np.stack(poses)
    rough = judge.rough_fractions(stacked)
    likely = np.argsort(-rough, kind="stable")[: 4 * KEPT]
    return distinct_poses(stacked[likely], rough[likely], judge.centre, 0.05 * judge.extent, np.radians(9), KEPT)[0]


def _directions(normals: Floats) -> Floats:
    """Unit normals (K, 3) of the directions in which most of the samples (N, 3) look, the largest first."""
    rest = normals
    found: list[Floats] = []
    some = normals[:: max(1, len(normals) // 400)]
    while len(found) < MOST_FACES and len(rest):
        alike = some @ rest.T > COS_FACE
        best = int(np.argmax(alike.sum(axis=1)))
        near = alike[best]
        if near.sum() < MIN_FACE * len(normals):
            break
        mean = rest[near].sum(axis=0)
        found.append(mean / np.linalg.norm(mean))
        rest = rest[~near]
    return np.array(found).reshape(-1, 3)


def square_to(faces: Floats) -> Floats:
    """Unit normals (L, 3) of what stands at right angles to two of the faces (K, 3) that do to each other, where none
    of these looks along it, the largest faces first."""
    found: list[Floats] = []
    for a, b in combinations(range(len(faces)), 2):
        across = np.cross(faces[a], faces[b])
        if abs(faces[a] @ faces[b]) < COS_ALIKE and all(abs(across @ one) < COS_FACE for one in (*faces, *found)):
            found.append(across / np.linalg.norm(across))
    return np.array(found[:MAX_PRODUCTS]).reshape(-1, 3)


def _rotations(ours: Floats, theirs: Floats) -> Iterator[Floats]:
    """Rotations (3, 3) that bring two of our directions (K, 3) onto two of theirs (L, 3) at the same angle."""
    cosines, angles = ours @ ours.T, theirs @ theirs.T
    for a in range(len(ours)):
        for b in range(a + 1, len(ours)):
            if abs(cosines[a, b]) > COS_APART:
                continue
            frame = _frame(ours[a], ours[b])
            for c in range(len(theirs)):
                for d in range(len(theirs)):
                    if c != d and abs(angles[c, d] - cosines[a, b]) < COS_ALIKE:
                        yield _frame(theirs[c], theirs[d]) @ frame.T


def _frame(first: Floats, second: Floats) -> Floats:
    """Right-handed unit axes in columns (3, 3): the middle of both directions, their normal, and what is left."""
    middle, across = first + second, np.cross(first, second)
    ahead, up = middle / np.linalg.norm(middle), across / np.linalg.norm(across)
    return np.column_stack([ahead, up, np.cross(ahead, up)])


def _distinct_rotations(rotations: list[Floats]) -> list[Floats]:
    """The rotations less those within 8 degrees of one before."""
    kept: list[Floats] = []
    for one in rotations:
        if all(np.trace(one.T @ other) < 1 + 2 * np.cos(np.radians(8)) for other in kept):
            kept.append(one)
    return kept


def _moved(judge: PoseJudge, rotation: Floats) -> list[Floats]:
    """Poses (4, 4) of one rotation with the translations for which most pairs of samples vote."""
    ours, theirs = judge.source, judge.target
    points, normals = ours.points[:VOTERS] @ rotation.T, ours.normals[:VOTERS] @ rotation.T
    places = theirs.points[:VOTED_FOR]
    one, other = np.nonzero(normals @ theirs.normals[:VOTED_FOR].T > COS_VOTE)
    if len(one) == 0:
        return []
    ways = places[other] - points[one]
    size = BIN * judge.extent
    cells = np.floor(ways / size).astype(np.int64)
    cells -= cells.min(axis=0)
    spots, bins = np.unique(np.ravel_multi_index(tuple(cells.T), tuple(cells.max(axis=0) + 1)), return_inverse=True)
    # a point votes once for a bin, however many of the others lie there: faces would outvote edges
    voters = np.unique(bins * np.int64(VOTERS) + one) // VOTERS
    votes = np.bincount(voters, minlength=len(spots))
    fullest = np.argsort(-votes, kind="stable")[:PEAKS]
    return [rigid(rotation, np.median(ways[bins == spot], axis=0)) for spot in fullest]
