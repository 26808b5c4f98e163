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

TOUCHED_MM = 0.03
"""Standard deviation of where a wheel runs that was touched off: feeler and paper are 0.03 to 0.1 mm thick, and it
wears and gives way. Taken for exact, a wheel 0.05 mm high that cut to its floors told a coefficient a third too small,
with a stated error of 1 %."""

REFUTED = 3.0
"""So many standard deviations speak against a wheel's running where it was touched off: one in 400 by chance."""

KNOWN = 0.1
"""Where the wheel is touched off, less than this fraction of the level of detection is no lag, nor is less than
``BEYOND_OFFSET`` standard deviations of its offset."""

BEYOND_OFFSET = 2.0

STEEP = 2.0
"""In a hollow so tight that from node to node the ground rises under the wheel's sides by so many depths of cut, the
map does not say where they cut: coefficients came out up to 40 % off there, and within 5 % below it."""

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
    ``offset_mm``: how much higher the wheel ran than the plan took it to, or than it was touched off, with its standard
    deviation.
    """

    k_mm2_n: float
    k_sigma_mm2_n: float
    factor: float
    lag_mm: float
    at_least: bool
    offset_mm: float = 0.0
    offset_sigma_mm: float = 0.0

    @property
    def refuted(self) -> bool:
        """Whether a wheel that was touched off did not run there: worn, bent aside, or touched off elsewhere."""
        return abs(self.offset_mm) > REFUTED * float(np.hypot(TOUCHED_MM, self.offset_sigma_mm))

    def __str__(self) -> str:
        ran = f"; the wheel ran {self.offset_mm:+.3f} +- {self.offset_sigma_mm:.2g} mm" if self.offset_sigma_mm else ""
        if self.at_least:
            floors = "the passes cut down to their floors, as far as the scan tells"
            return f"k is {self.k_mm2_n:.3g} mm2/N or more: {floors}{ran}"
        return f"k = {self.k_mm2_n:.4g} +- {self.k_sigma_mm2_n:.2g} mm2/N, {self.factor:.2f} times the planned one{ran}"


def learn_removal(
    plan: GrindingPlan, after_mm: Floats, sigma_mm: Floats, alike_nodes: float = 1.0, common_sigma_mm: float = 0.0
) -> LearntRemoval:
    """Learn Preston's coefficient from the heights before the passes, which the plan holds, and those after them.

    The passes are simulated with one factor on the depth of all strokes, and one offset of the wheel, which is known to
    the plan's ``Workpiece.offset_sigma_mm``, or to ``TOUCHED_MM`` where it was touched off; those whose outcome is
    nearest to what was measured are they.

    Args:
        plan: what was driven, from the heights that were measured before.
        after_mm: measured heights (R, C) after the passes; NaN where they are not known.
        sigma_mm: standard deviation (R, C) of the change of each node.
        alike_nodes: so many neighbouring nodes share their noise.
        common_sigma_mm: standard deviation of what is common to all nodes.

    Raises:
        InputError: the plan has no passes; too few nodes are measured; nothing was taken off; the map is too coarse for
            the hollow that was ground.
    """
    used = _used_nodes(plan, after_mm, sigma_mm)
    replay, after = Replay(plan), after_mm[used]
    sigma = np.hypot(sigma_mm, replay.averaged_mm)[used]
    weights = 1 / np.maximum(sigma, 1e-9) ** 2 / alike_nodes
    touched = plan.work.offset_sigma_mm == 0

    def left(factor: float, offset_mm: float) -> Floats:
        return replay.left_mm(factor, offset_mm)[used]

    def cost(log_factor: float, offset_mm: float, prior_sigma: float) -> float:
        factor = float(np.exp(np.clip(log_factor, np.log(SMALLEST), np.log(LARGEST))))
        return float((weights * (after - left(factor, offset_mm)) ** 2).sum()) + (offset_mm / prior_sigma) ** 2

    prior_sigma = TOUCHED_MM if touched else plan.work.offset_sigma_mm
    factor, offset = _fitted(cost, prior_sigma)
    if touched and abs(offset) > TOUCHED_MM:  # held back by what was taken to be known of it
        prior_sigma = abs(offset)
        factor, offset = _fitted(cost, prior_sigma)
    if touched:
        allowed = (REFUTED * _misfit(after - left(factor, offset), weights, alike_nodes)[0]) ** 2
        there = float(_best(lambda terms: cost(float(terms[0]), 0.0, prior_sigma), np.log([factor]))[0])
        if cost(there, 0.0, prior_sigma) - cost(float(np.log(factor)), offset, prior_sigma) < allowed:
            factor, offset = float(np.exp(there)), 0.0
    lag = float((left(factor, offset) - left(WHOLE, offset)).mean())
    misfit, misfit_mm = _misfit(after - left(factor, offset), weights, alike_nodes)
    # what the passes as simulated miss beyond noise is no noise: it may lie on one side of all nodes
    common_mm = float(np.hypot(common_sigma_mm, misfit_mm))
    sure = weights / misfit**2
    k_sigma, offset_sigma = _sigmas((factor, offset, prior_sigma), False, left, sure, common_mm)
    level_mm = max(KNOWN * plan.work.level_mm, BEYOND_OFFSET * offset_sigma) if touched else plan.work.level_mm
    at_least = lag < max(level_mm, BEYOND_MISFIT * misfit_mm)
    if at_least:
        factor = _least(lambda log_factor: _slid(cost, log_factor, offset, prior_sigma)[1], factor, BOUND * misfit)
        offset = _slid(cost, float(np.log(WHOLE)), offset, prior_sigma)[0]
        _, offset_sigma = _sigmas((WHOLE, offset, prior_sigma), True, left, sure, common_mm)
        # a lag too small to be told apart from an offset would pass for one
        k_sigma, offset_sigma = np.inf, min(float(np.hypot(offset_sigma, lag)), prior_sigma)
    planned = plan.options.k_mm2_n
    return LearntRemoval(planned * factor, planned * k_sigma, factor, lag, at_least, offset, offset_sigma)


def _fitted(cost: Callable[[float, float, float], float], prior_sigma: float) -> tuple[float, float]:
    """Factor and offset in mm of the least cost."""
    log_factors = np.linspace(np.log(SMALLEST), np.log(LARGEST), TRIED_FACTORS)
    tried = np.linspace(-3, 3, TRIED_OFFSETS)

    def at(terms: Floats) -> float:
        return cost(float(terms[0]), float(terms[1]) * prior_sigma, prior_sigma)

    starts = sorted((np.array([one, other]) for one in log_factors for other in tried), key=at)
    found = min((_best(at, start) for start in starts[:REFINED]), key=at)
    return float(np.exp(found[0])), float(found[1]) * prior_sigma


def _slid(
    cost: Callable[[float, float, float], float], log_factor: float, offset_mm: float, prior_sigma: float
) -> tuple[float, float]:
    """The best offset in mm at a factor, from ``offset_mm`` on, and its cost."""

    def at(deviations: Floats) -> float:
        return cost(log_factor, float(deviations[0]) * prior_sigma, prior_sigma)

    found = _best(at, np.array([offset_mm / prior_sigma]))
    return float(found[0]) * prior_sigma, at(found)


def _misfit(off_mm: Floats, weights: Floats, alike_nodes: float) -> tuple[float, float]:
    """What the passes as simulated leave of the measured heights, ``off_mm`` (N,): over their noise, 1 at least, and
    beyond it in mm. On a map that is coarse against the wheel it is more than noise."""
    told = max(len(off_mm) / alike_nodes - 2, 1.0)
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
    _check_hollow(plan, used)
    return used


def _check_hollow(plan: GrindingPlan, used: Flags) -> None:
    """Refuse a map too coarse to say where a wheel's sides cut in a hollow.

    Raises:
        InputError: the ground rises under them by more than ``STEEP`` depths of cut from node to node.
    """
    normals, spacing = plan.work.heights.normals, plan.work.heights.spacing_mm
    turns = np.stack([np.gradient(normals[..., :2], spacing, axis=axis) for axis in (0, 1)], axis=-1)[used]
    turns = turns[np.isfinite(turns).all(axis=(1, 2))]
    if not len(turns):
        return
    # normals that lean towards one another: the ground is hollow
    bend_per_mm = max(-float(np.median(np.linalg.eigvalsh((turns + turns.transpose(0, 2, 1)) / 2)[:, 0])), 1e-9)
    width, depth = plan.options.contact_width_mm, plan.options.depth_mm
    if spacing * width * bend_per_mm / 2 > STEEP * depth:
        raise InputError(
            f"k is not determined: in a hollow of {1 / bend_per_mm:.2g} mm radius nodes {spacing:.2g} mm apart do not"
            f" say where a tool {width:.2g} mm wide cut {depth:g} mm; scan more densely, or learn k on flatter ground"
        )


def _sigmas(
    found: tuple[float, float, float],
    at_least: bool,
    left: Callable[[float, float], Floats],
    weights: Floats,
    common_sigma_mm: float,
) -> tuple[float, float]:
    """Standard deviations of the factor, unless it is ``at_least``, and of the offset, which are ``found`` with what is
    known of the offset beforehand; ``weights`` (N,) of nodes."""
    factor, offset, prior_sigma = found
    step = 0.2 * prior_sigma
    slopes = [(left(factor, offset + step) - left(factor, offset - step)) / (2 * step)]
    prior = [1 / prior_sigma**2]
    if not at_least:
        slopes.append((left(factor * (1 + STEP), offset) - left(factor * (1 - STEP), offset)) / (2 * STEP * factor))
        prior.append(1e-12)
    design = np.array(slopes)
    covariance = np.linalg.inv((design * weights) @ design.T + np.diag(prior))
    common = covariance @ (design * weights).sum(axis=1)
    sigmas = np.sqrt(np.diag(covariance + common_sigma_mm**2 * np.outer(common, common)))
    return (np.inf if at_least else float(sigmas[1])), min(float(sigmas[0]), prior_sigma)
