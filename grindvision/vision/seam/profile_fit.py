"""Compiled kernel: the cross-section of a groove fitted to the mean profile of each station, one station after another.

Parameters (7,) are level, tilt, bend, depth, and u of left edge, root and right edge; ``shape`` (3,) is the rounding of
the edges, the rounding of the root and half the width of a flat root, mm.

The two kernels that sum in any order are inlined by force: else a process that compiles them and one that finds them in
the cache may run two differently vectorised copies, whose sums differ in the last digits.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from grindvision.kernels import njit

Floats = NDArray[np.float64]

#: Damped Gauss-Newton steps at most; a station whose cost changes by less than ``SETTLED`` of itself is left alone.
ROUNDS, SETTLED = 14, 1e-5
#: Residuals beyond so many times the expected deviation count linearly (Huber).
LINEAR_BEYOND = 2.0
#: Profiles are filled up with bins of no weight to a multiple of this: what wide registers leave over takes as long as
#: all the rest.
LANES = 16


class Profile(NamedTuple):
    """The mean profile of one station: places ``across`` and ``up`` (M,) of M bins, mm, and inverse variances (M,)."""

    across: Floats
    up: Floats
    weight: Floats


@njit(cache=True, nogil=True)
def fit_stations(
    across: Floats, up: Floats, weight: Floats, start: Floats, prior: Floats, shape: Floats, noise: float, gap: float
) -> tuple[Floats, Floats, Floats]:
    """Parameters (S, 7) of S stations, their standard deviations (S, 7) and the scatter of the profile about them (S,).

    Args:
        across: places (S, M) of M bins, mm.
        up: heights (S, M), mm.
        weight: inverse variances (S, M).
        start: first parameters (S, 7), the centre of the prior.
        prior: inverse variances (S, 7) of the prior.
        shape: (3,), see above.
        noise: expected deviation of one bin, mm.
        gap: least distance of edge and root, mm.
    """
    stations, bins = across.shape
    fitted, deviation, scatter = start.copy(), np.empty((stations, 7)), np.empty(stations)
    filled = (bins + LANES - 1) // LANES * LANES
    profile = Profile(np.zeros(filled), np.zeros(filled), np.zeros(filled))
    slopes, off, fraction = np.ones((7, filled)), np.empty(filled), np.empty(filled)
    normal, trial_normal, factor = np.empty((7, 7)), np.empty((7, 7)), np.zeros((7, 7))
    force, trial_force, trial = np.empty(7), np.empty(7), np.empty(7)
    for s in range(stations):
        theta = fitted[s]
        profile.across[:bins], profile.up[:bins], profile.weight[:bins] = across[s], up[s], weight[s]
        slopes[1] = profile.across
        cost = _compare(profile, theta, shape, noise, slopes, off, fraction)
        cost += _equations(slopes, off, fraction, theta, start[s], prior[s], normal, force)
        damping = 1e-2
        for _ in range(ROUNDS):
            _factorise(normal, 1 + damping, factor)
            _solve(factor, force, trial)
            trial += theta
            trial[4] = min(trial[4], trial[5] - gap)
            trial[6] = max(trial[6], trial[5] + gap)
            trial[3] = max(trial[3], 0.0)
            trial_cost = _compare(profile, trial, shape, noise, slopes, off, fraction)
            trial_cost += _equations(slopes, off, fraction, trial, start[s], prior[s], trial_normal, trial_force)
            settled = damping < 1 and abs(cost - trial_cost) <= SETTLED * cost
            if trial_cost < cost:
                theta[:] = trial
                cost, damping = trial_cost, max(damping / 5, 1e-7)
                normal, trial_normal = trial_normal, normal
                force, trial_force = trial_force, force
            else:
                damping = min(damping * 5, 1e5)
            if settled:
                break
        _factorise(normal, 1.0, factor)
        for k in range(7):
            trial_force[:] = 0.0
            trial_force[k] = 1.0
            _solve(factor, trial_force, trial)
            deviation[s, k] = np.sqrt(max(trial[k], 0.0))
        _compare(profile, theta, shape, noise, slopes, off, fraction)
        scatter[s] = np.sqrt((fraction * off * off).sum() / max(fraction.sum(), 1e-12))
    return fitted, deviation, scatter


@njit(cache=True, nogil=True, forceinline=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def _compare(
    profile: Profile, theta: Floats, shape: Floats, noise: float, slopes: Floats, off: Floats, fraction: Floats
) -> float:
    """Huber cost of a profile; writes rows 2 to 6 of ``slopes`` (7, M), and (M,) residuals and their weights."""
    across, up, weight = profile
    level, tilt, bend, depth, left, root, right = theta
    edge, corner, floor = shape
    a, b = 1 / (root - floor - left), 1 / (right - root - floor)
    limit, cost = LINEAR_BEYOND * noise, 0.0
    for m in range(len(across)):
        u = across[m]
        to_left, to_fall, to_climb, to_right = u - left, u - root + floor, u - root - floor, u - right
        at_left, at_right = np.sqrt(to_left * to_left + edge * edge), np.sqrt(to_right * to_right + edge * edge)
        at_fall = np.sqrt(to_fall * to_fall + corner * corner)
        at_climb = np.sqrt(to_climb * to_climb + corner * corner)
        fall = (to_left + at_left - to_fall - at_fall) / 2 * a
        climb = (to_climb + at_climb - to_right - at_right) / 2 * b
        inside = (u > left) & (u < right)
        arch = (left + right) * u - left * right if inside else u * u
        bent = bend if inside else 0.0
        miss = up[m] - (level + tilt * u + bend * arch - depth * (fall - climb))
        size = abs(miss)
        cost += weight[m] * (miss * miss if size < limit else limit * (2 * size - limit))
        off[m] = miss
        fraction[m] = weight[m] / max(size / limit, 1.0)
        slopes[2, m] = arch
        slopes[3, m] = climb - fall
        slopes[4, m] = bent * to_right - depth * (fall - (1 + to_left / at_left) / 2) * a
        slopes[5, m] = -depth * (((1 + to_fall / at_fall) / 2 - fall) * a + ((1 + to_climb / at_climb) / 2 - climb) * b)
        slopes[6, m] = bent * to_left - depth * (climb - (1 + to_right / at_right) / 2) * b
    return cost


@njit(cache=True, nogil=True, forceinline=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def _equations(
    slopes: Floats,
    off: Floats,
    fraction: Floats,
    theta: Floats,
    start: Floats,
    prior: Floats,
    normal: Floats,
    force: Floats,
) -> float:
    """Cost of the prior; writes the normal equations: lower half of the matrix (7, 7), right side (7,)."""
    cost = 0.0
    for j in range(7):
        pull = 0.0
        for m in range(len(off)):
            pull += fraction[m] * slopes[j, m] * off[m]
        away = theta[j] - start[j]
        force[j] = pull - prior[j] * away
        cost += prior[j] * away * away
        for k in range(j + 1):
            total = 0.0
            for m in range(len(off)):
                total += fraction[m] * slopes[j, m] * slopes[k, m]
            normal[j, k] = total
        normal[j, j] += prior[j]
    return cost


@njit(cache=True, nogil=True)
def _factorise(normal: Floats, swelling: float, factor: Floats) -> None:
    """Cholesky factor (7, 7) of a matrix (lower half) whose diagonal is multiplied by ``swelling``."""
    for j in range(7):
        for k in range(j + 1):
            value = normal[j, k] * (swelling if j == k else 1.0)
            for m in range(k):
                value -= factor[j, m] * factor[k, m]
            factor[j, k] = np.sqrt(max(value, 1e-300)) if j == k else value / factor[k, k]


@njit(cache=True, nogil=True)
def _solve(factor: Floats, force: Floats, answer: Floats) -> None:
    """Solve for ``answer`` (7,) by the Cholesky factor (7, 7), lower half, and the right side ``force`` (7,)."""
    for j in range(7):
        value = force[j]
        for m in range(j):
            value -= factor[j, m] * answer[m]
        answer[j] = value / factor[j, j]
    for j in range(6, -1, -1):
        value = answer[j]
        for m in range(j + 1, 7):
            value -= factor[m, j] * answer[m]
        answer[j] = value / factor[j, j]
