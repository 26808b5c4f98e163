"""Which way round a symmetric plate was seen: A X = X B turns arm and plate by the same angle, whatever X is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from grindvision.errors import AmbiguousError
from grindvision.geometry import rigid, rotation_about

Floats = NDArray[np.float64]

#: Sides whose lengths differ by less (share) are taken as equal: a square looks alike after every quarter turn.
SQUARE = 0.06

#: Angles of arm and plate that differ by more (deg) in the median come from poses that are misread.
MISREAD_DEG = 2.0

#: A pair of views tells two ways round apart where its angles differ by more (rad).
MIN_LEAD = 0.06


def fold_of(sides_mm: tuple[float, float]) -> int:
    """How many turns about its normal bring a rectangle of these sides onto itself."""
    return 4 if max(sides_mm) - min(sides_mm) < SQUARE * max(sides_mm) else 2


def upright(plates: Floats, fold: int) -> Floats:
    """Plates (N, 4, 4) turned so that their x axis points to the right in the image as nearly as it can."""
    turned = _all_ways(plates, fold)
    best = np.argmax(turned[:, :, 0, 0] + 1e-9 * turned[:, :, 1, 0], axis=1)
    return turned[np.arange(len(plates)), best]


def resolve(carrier: Floats, plates: Floats, fold: int, names: list[str]) -> Floats:
    """Plates (N, 4, 4), camera frame, turned the way round that agrees with the arm's turns (N, 4, 4).

    The first view says which way round the plate is; the others are tried every way, one view after the other, until
    no change lets the angles between views agree better with those of the arm. Where none agrees, the arm's poses are
    not what they are said to be: the plates are then ``upright``, for the checks that find out why.

    Raises:
        AmbiguousError: a view, or several together, fit as well another way round.
    """
    arm = _angles(carrier[:, None, :3, :3].swapaxes(2, 3) @ carrier[None, :, :3, :3])
    ways = _all_ways(plates, fold)
    best, least = np.zeros(len(plates), dtype=np.int64), np.inf
    for begin in range(min(len(plates), 6)):
        chosen, cost = _descended(arm, ways, begin)
        if cost < least - 1e-12:
            best, least = chosen, cost
    left = np.array([_row_costs(arm, ways, best, row)[best[row]] for row in range(len(ways))])
    if np.degrees(np.median(left)) > MISREAD_DEG:
        return upright(plates, fold)
    groups, group = connected_components(_telling(ways, best), directed=False)
    if groups > 1:
        row = int(np.flatnonzero(group != np.bincount(group).argmax())[0])
        raise AmbiguousError(
            f"{names[row]}: the plate fits as well turned by {360 // fold} deg about its normal; which way round it"
            " lies is not determined: leave the view out, or turn the camera by other angles between the views"
        )
    return ways[np.arange(len(plates)), best]


def _all_ways(plates: Floats, fold: int) -> Floats:
    turns = np.array([rigid(rotation_about([0, 0, 1], 2 * np.pi * k / fold)) for k in range(fold)])
    return np.asarray(plates[:, None] @ turns[None])


def _descended(arm: Floats, ways: Floats, begin: int) -> tuple[NDArray[np.int64], float]:
    """The way round of every view, from the one that suits view ``begin``, and what is left of the angles."""
    chosen = np.zeros(len(ways), dtype=np.int64)
    for row in range(len(ways)):
        if row != begin:
            chosen[row] = int(np.argmin(np.round(np.abs(_seen(ways, chosen, row)[:, begin] - arm[row, begin]), 9)))
    for _ in range(10):
        before = chosen.copy()
        for row in range(len(ways)):
            chosen[row] = int(np.argmin(np.round(_row_costs(arm, ways, chosen, row), 9)))
        if (chosen == before).all():
            break
    return chosen, float(np.sum([_row_costs(arm, ways, chosen, row)[chosen[row]] for row in range(len(ways))]))


def _telling(ways: Floats, chosen: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Pairs of views (N, N) whose angle tells one way round from the others."""
    telling = np.zeros((len(ways), len(ways)), dtype=bool)
    for row in range(len(ways)):
        seen = _seen(ways, chosen, row)
        others = np.delete(seen, chosen[row], axis=0)
        telling[row] = (np.abs(others - seen[chosen[row]]) > MIN_LEAD).all(axis=0)
    return telling


def _row_costs(arm: Floats, ways: Floats, chosen: NDArray[np.int64], row: int) -> Floats:
    """Root mean square (fold,) of a view's angles to all others less the arm's, every way round."""
    others = np.arange(len(ways)) != row
    off = _seen(ways, chosen, row)[:, others] - arm[row, others]
    return np.asarray(np.sqrt(np.mean(np.minimum(np.abs(off), 0.2) ** 2, axis=1)))


def _seen(ways: Floats, chosen: NDArray[np.int64], row: int) -> Floats:
    """Angles (fold, N) by which a view, every way round, is turned against all others as they are chosen."""
    now = ways[np.arange(len(ways)), chosen, :3, :3]
    return _angles(ways[row, :, None, :3, :3] @ now[None].swapaxes(2, 3))


def _angles(rotations: Floats) -> Floats:
    return Rotation.from_matrix(rotations.reshape(-1, 3, 3)).magnitude().reshape(rotations.shape[:2])
