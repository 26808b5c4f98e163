"""What a process really takes off: Preston's coefficient and the wheel's offset, learnt from scans before and after.

The coefficient says how much a stroke takes off where force and feed limit it; the offset, how much higher over the
good surface the wheel runs than it is sent, shows where a stroke ended on its path.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from grindvision.errors import InputError
from grindvision.motion.grinding import GrindingPlan
from grindvision.motion.grinding_replay import Replay
from grindvision.records import by_content

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

SMALLEST, LARGEST = 0.05, 4.0
"""Factors of the planned coefficient between which the true one is sought."""

STEP = 0.02
"""Relative step of the slope by the coefficient."""

MIN_USED = 20
"""Fewer nodes tell nothing."""

KNOWN = 0.1
"""Where the wheel is touched off, so much of the level of detection is a lag: there it cannot be an offset."""

MIN_REMOVED = 0.05
"""Less than this fraction of what was planned is nothing taken off."""

BISECTIONS = 8
"""Halvings of the logarithm's range in which the least coefficient is sought: to a hundredth."""

TRIED_FACTORS, TRIED_OFFSETS = 18, 9
"""So many factors, each with so many offsets within three standard deviations, are tried before the best is refined."""

REFINED = 6
"""So many of them are refined where factor and offset are both free: a valley runs between these."""

BEYOND_MISFIT = 2.0
"""A lag must be so many times what the simulated passes miss of the measured heights to be one."""

WHOLE = 2.0
"""With this factor every stroke ends on its path."""

BOUND = 2.0
"""The least coefficient is the one from which the simulated passes miss the measured heights by so many standard
deviations more than at best."""


@by_content
@dataclass(frozen=True)
class LearntRemoval:
    """Preston's coefficient ``k_mm2_n`` with its standard deviation, and the ``factor`` against the planned one.

    ``lag_mm``: by how much the strokes ended above their paths in the mean. Where that is too little to be told,
    the passes cut down to their floors: ``at_least`` is True, and the coefficient is the least that the heights allow.
    ``offset_mm``: how much higher the wheel ran than the plan took it to, with its standard deviation; 0 and 0 where it
    was touched off.
    """

    k_mm2_n: float
    k_sigma_mm2_n: float
    factor: float
    lag_mm: float
    at_least: bool
    offset_mm: float = 0.0
    offset_sigma_mm: float = 0.0

    def __str__(self) -> str:
        ran = f"; the wheel ran {self.offset_mm:+.3f} +- {self.offset_sigma_mm:.2g} mm" if self.offset_sigma_mm else ""
        if self.at_least:
            return f"k is {self.k_mm2_n:.3g} mm2/N or more: the passes cut down to their floors{ran}"
        return f"k = {self.k_mm2_n:.4g} +- {self.k_sigma_mm2_n:.2g} mm2/N, {self.factor:.2f} times the planned one{ran}"


def learn_removal(
    plan: GrindingPlan, after_mm: Floats, sigma_mm: Floats, alike_nodes: float = 1.0, common_sigma_mm: float = 0.0
) -> LearntRemoval:
    """Learn Preston's coefficient from the heights before the passes, which the plan holds, and those after them.

    The passes are simulated with one factor on the depth of all strokes, and one offset of the wheel where the plan
    says that it is not known (``Workpiece.offset_sigma_mm``); those whose outcome is nearest to what was measured are
    they.

    Args:
        plan: what was driven, from the heights that were measured before.
        after_mm: measured heights (R, C) after the passes; NaN where they are not known.
        sigma_mm: standard deviation (R, C) of the change of each node.
        alike_nodes: so many neighbouring nodes share their noise.
        common_sigma_mm: standard deviation of what is common to all nodes.

    Raises:
        InputError: the plan has no passes; too few nodes are measured; nothing was taken off.
    """
    used = _used_nodes(plan, after_mm, sigma_mm)
    replay, after = Replay(plan), after_mm[used]
    sigma = np.hypot(sigma_mm, replay.averaged_mm)[used]
    weights = 1 / np.maximum(sigma, 1e-9) ** 2 / alike_nodes
    prior_sigma = plan.work.offset_sigma_mm

    def left(factor: float, offset_mm: float) -> Floats:
        return replay.left_mm(factor, offset_mm)[used]

    def cost(log_factor: float, deviations: float = 0.0) -> float:
        factor = float(np.exp(np.clip(log_factor, np.log(SMALLEST), np.log(LARGEST))))
        return float((weights * (after - left(factor, deviations * prior_sigma)) ** 2).sum()) + deviations**2

    log_factors = np.linspace(np.log(SMALLEST), np.log(LARGEST), TRIED_FACTORS)
    tried = np.linspace(-3, 3, TRIED_OFFSETS) if prior_sigma else [0.0]
    starts = sorted(((one, other) for one in log_factors for other in tried), key=lambda terms: cost(*terms))
    free = 2 if prior_sigma else 1
    ends = [_best(lambda terms: cost(*terms), np.array(start)[:free]) for start in starts[: REFINED if free > 1 else 1]]
    found = np.append(min(ends, key=lambda terms: cost(*terms)), np.zeros(2 - free))
    factor, offset = float(np.exp(found[0])), float(found[1]) * prior_sigma
    lag = float((left(factor, offset) - left(WHOLE, offset)).mean())
    misfit, misfit_mm = _misfit(after - left(factor, offset), weights, alike_nodes, free)
    at_least = lag < max(plan.work.level_mm * (1.0 if prior_sigma else KNOWN), BEYOND_MISFIT * misfit_mm)
    if at_least and prior_sigma:
        offset = prior_sigma * float(_best(lambda deviations: cost(np.log(WHOLE), *deviations), found[1:])[0])
    weights = weights / misfit**2
    # what the passes as simulated miss beyond noise is no noise: it may lie on one side of all nodes
    common_mm = float(np.hypot(common_sigma_mm, misfit_mm))
    k_sigma, offset_sigma = _sigmas(plan, (factor, offset), at_least, left, weights, common_mm)
    if at_least:
        # a lag too small to be told apart from an offset would pass for one
        offsets = offset / prior_sigma if prior_sigma else 0.0
        factor, k_sigma = _least(lambda log_factor: cost(log_factor, offsets), factor, BOUND * misfit), np.inf
        offset_sigma = min(float(np.hypot(offset_sigma, lag)), prior_sigma)
    planned = plan.options.k_mm2_n
    return LearntRemoval(planned * factor, planned * k_sigma, factor, lag, at_least, offset, offset_sigma)


def _misfit(off_mm: Floats, weights: Floats, alike_nodes: float, free: int) -> tuple[float, float]:
    """What the passes as simulated leave of the measured heights, ``off_mm`` (N,): over their noise, 1 at least, and
    beyond it in mm. On a map that is coarse against the wheel it is more than noise."""
    told = max(len(off_mm) / alike_nodes - free, 1.0)
    noise = len(off_mm) / float((weights * alike_nodes).sum())
    beyond = max(float((off_mm**2).mean()) - noise, 0.0)
    return max(1.0, float(np.sqrt((weights * off_mm**2).sum() / told))), float(np.sqrt(beyond))


def _least(cost: Callable[[float], float], best: float, worse: float) -> float:
    """The factor below the ``best``, and 1, at which the cost has grown by ``worse`` squared; ``SMALLEST`` where it
    nowhere does."""
    high, low = float(np.log(min(best, 1.0))), float(np.log(SMALLEST))
    allowed = min(cost(float(np.log(best))), cost(high)) + worse**2
    if cost(low) <= allowed:
        return SMALLEST
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        low, high = (middle, high) if cost(middle) > allowed else (low, middle)
    return float(np.exp(low))


def _best(cost: Callable[[Floats], float], start: Floats) -> Floats:
    simplex = start + np.vstack([np.zeros(len(start)), 0.1 * np.eye(len(start))])
    search = {"initial_simplex": simplex, "xatol": 1e-3, "fatol": 1e-3}
    return np.asarray(minimize(cost, start, method="Nelder-Mead", options=search).x)


def _used_nodes(plan: GrindingPlan, after_mm: Floats, sigma_mm: Floats) -> Flags:
    """Nodes (R, C) that were cut and are measured.

    Raises:
        InputError: see ``learn_removal``.
    """
    if not plan.passes:
        raise InputError("the plan has no passes; nothing can be learnt from it")
    before = np.where(plan.work.inside, plan.work.heights.heights_mm, np.nan)
    cut = plan.work.inside & (plan.remaining_mm < before - plan.work.level_mm)
    used = cut & np.isfinite(after_mm) & np.isfinite(sigma_mm)
    if used.sum() < MIN_USED:
        raise InputError(f"only {int(used.sum())} nodes of what was ground are measured; scan the place from above")
    removed = float(((before - after_mm) * plan.work.heights.areas_mm2)[used].sum())
    planned = float(sum(one.removed_mm3 for one in plan.passes))
    if removed < MIN_REMOVED * planned:
        raise InputError(
            f"the new scan shows {round(removed, 1) + 0.0:.1f} mm3 taken off where {planned:.1f} mm3 were planned; is"
            " it the scan after the passes?"
        )
    return used


def _sigmas(
    plan: GrindingPlan,
    found: tuple[float, float],
    at_least: bool,
    left: Callable[[float, float], Floats],
    weights: Floats,
    common_sigma_mm: float,
) -> tuple[float, float]:
    """Standard deviations of the factor, unless it is ``at_least``, and of the offset; ``weights`` (N,) of nodes."""
    (factor, offset), prior_sigma = found, plan.work.offset_sigma_mm
    slopes, prior = [], []
    if not at_least:
        slopes.append((left(factor * (1 + STEP), offset) - left(factor * (1 - STEP), offset)) / (2 * STEP * factor))
        prior.append(1e-12)
    if prior_sigma:
        step, there = 0.2 * prior_sigma, WHOLE if at_least else factor
        slopes.append((left(there, offset + step) - left(there, offset - step)) / (2 * step))
        prior.append(1 / prior_sigma**2)
    if not slopes:
        return np.inf, 0.0
    design = np.array(slopes)
    covariance = np.linalg.inv((design * weights) @ design.T + np.diag(prior))
    common = covariance @ (design * weights).sum(axis=1)
    sigmas = np.sqrt(np.diag(covariance + common_sigma_mm**2 * np.outer(common, common)))
    return (np.inf if at_least else float(sigmas[0])), min(float(sigmas[-1]), prior_sigma) if prior_sigma else 0.0
