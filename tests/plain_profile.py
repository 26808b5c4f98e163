"""The plain twin of the fit of groove sections: all stations at once in NumPy, as the formulas stand."""

import numpy as np

from grindvision.vision.seam.groove_profile import BEND, DEPTH, LEFT, LEVEL, RIGHT, ROOT, TILT, profile_height
from grindvision.vision.seam.profile_fit import ROUNDS, SETTLED


def fit_profiles(sections, start, spread, corners, noise_mm):
    """Parameters (S, 7), their standard deviations (S, 7) and the spread of the profile about them (S,)."""
    prior = 1 / np.broadcast_to(spread, start.shape) ** 2
    data_weight = np.minimum(sections.weight, 4.0 * np.median(sections.weight[sections.weight > 0]))
    data_weight = data_weight / data_weight.max() / noise_mm**2
    theta, damping = start.copy(), np.full(len(start), 1e-2)

    def cost_of(theta):
        off = np.abs(sections.up - profile_height(sections.across, theta, corners)) / noise_mm
        loss = np.where(off < 2.0, off**2, 4.0 * off - 4.0) * noise_mm**2
        return (data_weight * loss).sum(axis=1) + (prior * (theta - start) ** 2).sum(axis=1)

    def equations(theta):
        height, slopes = profile_slopes(sections.across, theta, corners)
        off = sections.up - height
        weight = data_weight / np.maximum(np.abs(off) / (2.0 * noise_mm), 1.0)
        normal = np.einsum("smi,sm,smj->sij", slopes, weight, slopes) + prior[:, :, None] * np.eye(7)
        return normal, np.einsum("smi,sm,sm->si", slopes, weight, off) - prior * (theta - start), off, weight

    cost, active = cost_of(theta), np.ones(len(start), dtype=bool)
    for _ in range(ROUNDS):
        normal, force, _, _ = equations(theta)
        damped = normal * (1 + damping[:, None, None] * np.eye(7))
        trial = theta + np.linalg.solve(damped, force[..., None])[..., 0]
        gap = corners.floor_mm + sections.bin_mm
        trial[:, LEFT] = np.minimum(trial[:, LEFT], trial[:, ROOT] - gap)
        trial[:, RIGHT] = np.maximum(trial[:, RIGHT], trial[:, ROOT] + gap)
        trial[:, DEPTH] = np.maximum(trial[:, DEPTH], 0.0)
        trial_cost = cost_of(trial)
        better = active & (trial_cost < cost)
        settled = (np.abs(cost - trial_cost) <= SETTLED * cost) & (damping < 1)
        theta, cost = np.where(better[:, None], trial, theta), np.where(better, trial_cost, cost)
        damping = np.clip(np.where(better, damping / 5, damping * 5), 1e-7, 1e5)
        active &= ~settled
    normal, _, off, weight = equations(theta)
    deviation = np.sqrt(np.einsum("sii->si", np.linalg.inv(normal)))
    return theta, deviation, np.sqrt((weight * off**2).sum(axis=1) / weight.sum(axis=1))


def profile_slopes(across, parameters, corners):
    """Height (S, M) and its derivatives (S, M, 7) at ``across`` (S, M) for parameters (S, 7)."""
    level, tilt, bend, depth, left, root, right = (parameters[:, k, None] for k in range(7))
    a, b = 1 / (root - corners.floor_mm - left), 1 / (right - root - corners.floor_mm)
    ramp_l, rise_l = _ramp(across - left, corners.edge_mm)
    ramp_a, rise_a = _ramp(across - root + corners.floor_mm, corners.root_mm)
    ramp_b, rise_b = _ramp(across - root - corners.floor_mm, corners.root_mm)
    ramp_r, rise_r = _ramp(across - right, corners.edge_mm)
    fall, climb = (ramp_l - ramp_a) * a, (ramp_b - ramp_r) * b
    inside = (across > left) & (across < right)
    arch = np.where(inside, (left + right) * across - left * right, across**2)
    slopes = np.empty((*across.shape, 7))
    slopes[..., LEVEL], slopes[..., TILT], slopes[..., BEND], slopes[..., DEPTH] = 1, across, arch, climb - fall
    slopes[..., LEFT] = np.where(inside, bend * (across - right), 0) - depth * (fall - rise_l) * a
    slopes[..., ROOT] = -depth * ((rise_a - fall) * a + (rise_b - climb) * b)
    slopes[..., RIGHT] = np.where(inside, bend * (across - left), 0) - depth * (climb - rise_r) * b
    return level + tilt * across + bend * arch - depth * (fall - climb), slopes


def _ramp(x, rounding):
    """max(x, 0) with a rounded corner, and its derivative."""
    root = np.sqrt(x * x + rounding * rounding)
    return (x + root) / 2, (1 + x / root) / 2
