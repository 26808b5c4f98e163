"""Mistakes of hand-eye data that the data themselves show: conventions, rows that are swapped, one cloud twice."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from grindvision.calibration.hand_eye import HandEye, carriers, quick_rms_mm, rotation_rms_of
from grindvision.calibration.pose_conventions import PoseConvention, makers_of, other_conventions, poses_from
from grindvision.errors import GrindvisionError, InputError

Floats = NDArray[np.float64]

#: A fit that leaves less (mm rms) gives no reason to look for mistakes; one that leaves more is no arm's error.
GOOD_MM, IMPLAUSIBLE_MM = 2.0, 5.0

#: A fit that leaves more rotation (deg rms) is no arm's error.
IMPLAUSIBLE_DEG = 3.0

#: A target that turns by less than this fraction of the arm's turns rests with the camera.
STILL = 0.2

#: Another reading of the data is named where it leaves so many times less.
MUCH_BETTER = 3.0

#: Poses up to which all pairs of rows are tried for a swap.
MAX_SWAPPED = 14


def check_repeated(points: Sequence[ArrayLike], names: Sequence[str]) -> None:
    """Refuse clouds, or rows of a table, that are the same measurement.

    Raises:
        InputError: two have the same points.
    """
    for (a, first), (b, second) in combinations(zip(names, points, strict=True), 2):
        if np.shape(first) == np.shape(second) and np.array_equal(first, second):
            raise InputError(
                f"{b} has the same numbers as {a}: one cloud or row twice; every pose needs a measurement of its own"
                " (leave one of the two and its pose out)"
            )


def check_pose_rows(poses: Floats) -> list[str]:
    """In words, poses (N, 4, 4) that stand in the table twice."""
    told = []
    for i, j in combinations(range(len(poses)), 2):
        if np.abs(poses[i] - poses[j]).max() < 1e-6:
            told.append(
                f"poses {i + 1} and {j + 1} are the same: a pose copied twice, or taken twice? It counts as one"
            )
    return told[:3]


def refuse_still_views(poses: Floats, target: Floats) -> None:
    """Refuse poses of the target (N, 4, 4) that hardly turn while the arm does: A X = X B turns both by the same angle.

    Raises:
        InputError: with both angles.
    """
    if target.ndim != 3:
        return
    arm, seen = (float(np.degrees(np.median(rotations_between(one)))) for one in (poses, target))
    if seen < STILL * arm:
        raise InputError(
            f"between two poses the arm turns by {arm:.0f} deg in the median, what the camera sees by {seen:.1f} deg:"
            " do the clouds show a background that rests with the camera? Crop it away; or are the clouds copies?"
        )


def rotations_between(poses: Floats) -> Floats:
    """Angles (K,) in rad by which every pair of poses (N, 4, 4) is turned against each other."""
    first, second = np.triu_indices(len(poses), 1)
    relative = poses[first, :3, :3].swapaxes(1, 2) @ poses[second, :3, :3]
    return Rotation.from_matrix(relative).magnitude()


def refuse_better_reading(
    rows: Floats,
    stated: PoseConvention,
    target: Floats,
    mounted: str,
    names: Sequence[str],
    target_readings: Sequence[tuple[str, Floats]] = (),
) -> None:
    """Refuse data that fit badly as stated where another common reading of them fits much better, and name it.

    Args:
        rows: numbers of the poses (N, C).
        stated: how they are said to be read.
        target: points (N, 3) or poses (N, 4, 4) of the target, camera frame.
        mounted: see ``HandEyeOptions``.
        names: of the clouds, in order.
        target_readings: other readings of a table of the target's poses, each in words and as poses (N, 4, 4).

    Raises:
        InputError: names the other convention, the order of the clouds, or views that rest with the camera.
    """
    poses = poses_from(rows, stated)
    carrier = carriers(poses, mounted)
    left = quick_rms_mm(carrier, target)
    if left <= GOOD_MM:
        return
    best, text = _better_reading(rows, stated, target, mounted, target_readings)
    if best > IMPLAUSIBLE_MM:
        refuse_still_views(poses, target)
    elif best * MUCH_BETTER < left and len(target) > (4 if target.ndim == 2 else 2):
        raise InputError(
            f"with the stated {stated} the target's places differ by {left:.3g} mm rms, with"
            f" {text.format(size=f'{best:.2g} mm: {left / max(best, 1e-9):.0f} times less')}"
        )
    if rotation_rms_of(carrier) is None:
        return
    if len(target) > 5 and (order := _better_order(carrier, target, left, names)):
        raise InputError(order)


def _better_reading(
    rows: Floats,
    stated: PoseConvention,
    target: Floats,
    mounted: str,
    target_readings: Sequence[tuple[str, Floats]],
) -> tuple[float, str]:
    """What the best other reading leaves (mm rms; infinite where there is none), and it in words, with a gap for it."""
    best, text = np.inf, ""
    ranked = rank_conventions(rows, target, mounted, other_conventions(stated, rows))
    if ranked:
        best, other = ranked[0]
        text = f"{other}{makers_of(other)} by {{size}}; is that what the controller shows?"
        if other.inverted != stated.inverted:
            text += " Or is --mounted the other one?"
            text += " Or are the target's poses T_target_camera?" if target_readings else ""
    carrier = carriers(poses_from(rows, stated), mounted)
    if rotation_rms_of(carrier) is not None:
        for words, seen in target_readings:
            if (size := quick_rms_mm(carrier, seen)) < 0.9 * best:
                best, text = size, f"{words} by {{size}}; is that how the target's poses are written?"
    return best, text


def rank_conventions(
    rows: Floats, target: Floats, mounted: str, tried: Iterator[PoseConvention]
) -> list[tuple[float, PoseConvention]]:
    """What each convention leaves, mm rms, the best first; those under which the poses hardly turn take no part."""
    found = []
    for other in tried:
        try:
            carrier = carriers(poses_from(rows, other), mounted)
        except GrindvisionError:
            continue
        if rotation_rms_of(carrier) is not None:
            found.append((quick_rms_mm(carrier, target), other))
    return sorted(found, key=lambda item: (round(item[0], 6), str(item[1])))


def refuse_implausible(found: HandEye, told: Sequence[str] = ()) -> None:
    """Refuse a fit that leaves more than any arm's error; ``told`` is what else is known of the data.

    Raises:
        InputError: with the size, and what may be wrong.
    """
    size = float(np.sqrt(np.average((found.residuals_mm**2).sum(axis=1), weights=found.weights + 1e-12)))
    weights = found.weights + 1e-12
    turn = float(np.degrees(np.sqrt(np.average((found.residuals_rad**2).sum(axis=1), weights=weights))))
    if size > IMPLAUSIBLE_MM or turn > IMPLAUSIBLE_DEG or found.fitting.mean() < 0.75:
        turned = f" and {turn:.2g} deg" if np.isfinite(turn) else ""
        raise InputError(
            f"poses and clouds do not belong together: the target's places differ by {found.rms_mm:.3g} mm{turned} rms,"
            " and no common convention or order of the rows fits; did the target rest, was the arm still, is the"
            f" pose that of the flange (or of one tool) throughout?{''.join(f' Note: {text}' for text in told)}"
        )


def outliers(found: HandEye, names: Sequence[str]) -> list[str]:
    """In words, poses that do not fit the others."""
    return [
        f"pose {row + 1} ({names[row]}) does not fit the others: it puts the target {found.left_out_mm[row]:.1f} mm off"
        " and has almost no weight; wrong row, moved target, arm not at rest?"
        for row in np.flatnonzero(~found.fitting).tolist()
    ]


def natural_order(names: Sequence[str]) -> list[int]:
    """Rows in the order of the numbers in their names: view2 before view10."""

    def key(row: int) -> list[tuple[int, str]]:
        return [(int(part), "") if part.isdigit() else (0, part) for part in re.split(r"(\d+)", names[row]) if part]

    return sorted(range(len(names)), key=key)


def _better_order(carrier: Floats, target: Floats, left: float, names: Sequence[str]) -> str:
    """In words, another order of the clouds under which they fit the poses much better; empty where there is none."""
    n = len(target)
    best, word = left, ""
    for order, text in _orders(n, names):
        size = quick_rms_mm(carrier, target[order])
        if size < best:
            best, word = size, text
    if best * MUCH_BETTER > left or best > IMPLAUSIBLE_MM:
        return ""
    return (
        f"the target's places differ by {left:.3g} mm rms, by {best:.2g} mm {word}; mend the order of poses and clouds"
    )


def _orders(n: int, names: Sequence[str]) -> Iterator[tuple[list[int], str]]:
    plain = list(range(n))
    natural = natural_order(names)
    if natural != plain:
        yield natural, "with the clouds in the order of the numbers in their names"
    yield plain[::-1], "with the clouds in reverse order"
    for shift in (1, -1):
        yield list(np.roll(plain, shift)), "with the clouds shifted by one row against the poses"
    if n <= MAX_SWAPPED:
        for i, j in combinations(plain, 2):
            order = plain.copy()
            order[i], order[j] = j, i
            yield order, f"with {names[i]} and {names[j]} (rows {i + 1} and {j + 1}) swapped"
