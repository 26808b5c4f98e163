"""The cross-section of a V-groove: a plate, bent at most gently, and two walls that fall towards each other.

Fitted at every station of a seam to the cloud laid straight. In a cross-section the coordinate u runs across the seam
and the height is ``a + b u + c B(u) - d V(u)``: B is u^2 on the plate and its chord between the groove's edges, the
roof V rises from 0 at both edges to 1 at the root, which may be a flat strip; edges and root may be rounded.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from grindvision.vision.seam_curve import Strip

Floats = NDArray[np.float64]

LEVEL, TILT, BEND, DEPTH, LEFT, ROOT, RIGHT = range(7)
#: Gauss-Newton steps at most; a fit whose cost falls by less than ``_SETTLED`` of itself is left alone.
_ROUNDS, _SETTLED = 14, 1e-4


@dataclass(frozen=True)
class Sections:
    """Mean profiles at S stations: ``across``, ``up`` and ``weight`` (S, M) of M bins across the seam."""

    across: Floats
    up: Floats
    weight: Floats
    bin_mm: float


@dataclass(frozen=True)
class Corners:
    """What all sections of a groove share, mm: rounding of edges and of root, half width of a flat root."""

    edge_mm: float
    root_mm: float
    floor_mm: float = 0.0


@dataclass(frozen=True)
class ProfileFit:
    """``parameters`` (S, 7): level, tilt, bend, depth, and u of left edge, root and right edge, mm.

    ``deviation`` (S, 7) are their standard deviations, ``noise_mm`` (S,) is the spread of the profile about the fit.
    """

    parameters: Floats
    deviation: Floats
    noise_mm: Floats
    corners: Corners


def gather_sections(
    strip: Strip, stations: int, step_mm: float, reach_mm: float, bin_mm: float, window_mm: float
) -> Sections:
    """Mean profiles of a straightened cloud, one per station, over a Gaussian window along the seam."""
    bins = 2 * int(np.ceil(reach_mm / bin_mm)) + 1
    sums = _bin_sums(strip.along, strip.across, strip.up, stations, step_mm, bins, bin_mm)
    if window_mm > 0:
        sums = gaussian_filter1d(sums, window_mm / step_mm, axis=1, mode="constant", truncate=3.0)
    weight = sums[0]
    safe = np.maximum(weight, 1e-9)
    return Sections(sums[1] / safe, sums[2] / safe, np.where(weight > 1e-3, weight, 0.0), bin_mm)


def fit_profiles(sections: Sections, start: Floats, spread: Floats, corners: Corners, noise_mm: float) -> ProfileFit:
    """Fit the groove's cross-section at every station.

    Damped Gauss-Newton over all stations at once, with Huber weights and a weak normal prior that keeps what the
    profile does not show (an edge beyond the part's outline).

    Args:
        sections: the mean profiles.
        start: (S, 7) first parameters, the centre of the prior.
        spread: (7,) or (S, 7) standard deviations of the prior.
        corners: rounding and floor of the groove.
        noise_mm: expected deviation of one bin, which scales data against prior.
    """
    prior = 1 / np.broadcast_to(spread, start.shape) ** 2
    filled = sections.weight[sections.weight > 0]
    data_weight = np.minimum(sections.weight, 4.0 * float(np.median(filled)) if len(filled) else 0.0)
    data_weight = data_weight / max(float(data_weight.max()), 1e-9) / noise_mm**2
    theta, damping = start.copy(), np.full(len(start), 1e-2)
    cost = _cost(theta, start, prior, sections, data_weight, corners, noise_mm)
    for _ in range(_ROUNDS):
        height, jacobian = profile_slopes(sections.across, theta, corners)
        off = sections.up - height
        weight = data_weight * _huber(off / noise_mm)
        normal, slope = _normal_equations(jacobian, weight, off, prior)
        slope -= prior * (theta - start)
        damped = normal.copy()
        np.einsum("sii->si", damped)[:] *= 1 + damping[:, None]
        trial = _in_order(theta + np.linalg.solve(damped, slope[..., None])[..., 0], corners.floor_mm + sections.bin_mm)
        trial_cost = _cost(trial, start, prior, sections, data_weight, corners, noise_mm)
        better = trial_cost < cost
        settled = not (trial_cost < (1 - _SETTLED) * cost).any() and (damping < 1).all()
        theta, cost = np.where(better[:, None], trial, theta), np.where(better, trial_cost, cost)
        damping = np.clip(np.where(better, damping / 5, damping * 5), 1e-7, 1e5)
        if settled:
            break
    height, jacobian = profile_slopes(sections.across, theta, corners)
    weight = data_weight * _huber((sections.up - height) / noise_mm)
    normal, _ = _normal_equations(jacobian, weight, sections.up - height, prior)
    deviation = np.sqrt(np.maximum(np.einsum("sii->si", np.linalg.inv(normal)), 0))
    total = np.maximum(weight.sum(axis=1), 1e-12)
    noise = np.sqrt((weight * (sections.up - height) ** 2).sum(axis=1) / total)
    return ProfileFit(theta, deviation, noise, corners)


def profile_height(across: Floats, parameters: Floats, corners: Corners) -> Floats:
    """Height (S, M) at ``across`` (S, M) for parameters (S, 7)."""
    level, tilt, bend, depth, left, root, right = (parameters[:, k, None] for k in range(7))
    fall = _ramp(across - left, corners.edge_mm) - _ramp(across - root + corners.floor_mm, corners.root_mm)
    climb = _ramp(across - root - corners.floor_mm, corners.root_mm) - _ramp(across - right, corners.edge_mm)
    roof = fall / (root - corners.floor_mm - left) - climb / (right - root - corners.floor_mm)
    inside = (across > left) & (across < right)
    arch = np.where(inside, (left + right) * across - left * right, across**2)
    return level + tilt * across + bend * arch - depth * roof


def profile_slopes(across: Floats, parameters: Floats, corners: Corners) -> tuple[Floats, Floats]:
    """Height (S, M) and its derivatives (S, M, 7) at ``across`` (S, M) for parameters (S, 7)."""
    level, tilt, bend, depth, left, root, right = (parameters[:, k, None] for k in range(7))
    a, b = 1 / (root - corners.floor_mm - left), 1 / (right - root - corners.floor_mm)
    ramp_l, rise_l = _ramp_slope(across - left, corners.edge_mm)
    ramp_a, rise_a = _ramp_slope(across - root + corners.floor_mm, corners.root_mm)
    ramp_b, rise_b = _ramp_slope(across - root - corners.floor_mm, corners.root_mm)
    ramp_r, rise_r = _ramp_slope(across - right, corners.edge_mm)
    fall, climb = (ramp_l - ramp_a) * a, (ramp_b - ramp_r) * b
    roof = fall - climb
    inside = (across > left) & (across < right)
    arch = np.where(inside, (left + right) * across - left * right, across**2)
    jacobian = np.empty((*across.shape, 7))
    jacobian[..., LEVEL] = 1
    jacobian[..., TILT] = across
    jacobian[..., BEND] = arch
    jacobian[..., DEPTH] = -roof
    jacobian[..., LEFT] = -depth * (fall - rise_l) * a
    jacobian[..., LEFT] += np.where(inside, bend * (across - right), 0)
    jacobian[..., ROOT] = -depth * ((rise_a - fall) * a + (rise_b - climb) * b)
    jacobian[..., RIGHT] = -depth * (climb - rise_r) * b
    jacobian[..., RIGHT] += np.where(inside, bend * (across - left), 0)
    return level + tilt * across + bend * arch - depth * roof, jacobian


def _normal_equations(jacobian: Floats, weight: Floats, off: Floats, prior: Floats) -> tuple[Floats, Floats]:
    weighted = (jacobian * weight[..., None]).transpose(0, 2, 1)
    normal = weighted @ jacobian
    np.einsum("sii->si", normal)[:] += prior
    return normal, (weighted @ off[..., None])[..., 0]


def _ramp(x: Floats, rounding: float) -> Floats:
    """max(x, 0) with a rounded corner."""
    return (x + np.sqrt(x * x + rounding * rounding)) / 2


def _ramp_slope(x: Floats, rounding: float) -> tuple[Floats, Floats]:
    root = np.sqrt(x * x + rounding * rounding)
    return (x + root) / 2, (1 + x / root) / 2


def _huber(scaled: Floats) -> Floats:
    return 1 / np.maximum(np.abs(scaled) / 2.0, 1.0)


def _cost(theta, start, prior, sections, data_weight, corners, noise_mm) -> Floats:
    off = np.abs(sections.up - profile_height(sections.across, theta, corners)) / noise_mm
    loss = np.where(off < 2.0, off**2, 4.0 * off - 4.0) * noise_mm**2
    return (data_weight * loss).sum(axis=1) + (prior * (theta - start) ** 2).sum(axis=1)


def _in_order(theta: Floats, gap: float) -> Floats:
    """Keep left edge, root and right edge in this order, at least ``gap`` apart, and the depth positive."""
    theta[:, LEFT] = np.minimum(theta[:, LEFT], theta[:, ROOT] - gap)
    theta[:, RIGHT] = np.maximum(theta[:, RIGHT], theta[:, ROOT] + gap)
    theta[:, DEPTH] = np.maximum(theta[:, DEPTH], 0.0)
    return theta


@njit(cache=True, nogil=True)
def _bin_sums(along, across, up, stations, step, bins, width):
    sums = np.zeros((3, stations, bins))
    for p in range(len(along)):
        s = int(along[p] / step + 0.5)
        m = int(across[p] / width + bins / 2.0)
        if along[p] > -step / 2 and s < stations and across[p] > -width * bins / 2.0 and m < bins:
            sums[0, s, m] += 1
            sums[1, s, m] += across[p]
            sums[2, s, m] += up[p]
    return sums
