"""What a process really takes off: Preston's coefficient learnt from scans before and after the passes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from grindvision.errors import InputError
from grindvision.motion.grinding import GrindingPlan, simulate_passes
from grindvision.records import by_content

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

SMALLEST, LARGEST = 0.05, 4.0
"""Factors of the planned coefficient between which the true one is sought."""

STEP = 0.02
"""Relative step of the slope by the coefficient."""

MIN_TOLD = 20
"""So many nodes must tell the coefficient: elsewhere the tool's own path ended the cut."""


MIN_REMOVED = 0.05
"""Less than this fraction of what was planned is nothing taken off."""


@by_content
@dataclass(frozen=True)
class LearntRemoval:
    """Preston's coefficient ``k_mm2_n`` with its standard deviation, and the ``factor`` against the planned one.

    ``told``: nodes that tell it. Where too few do, the passes cut down to their floors everywhere: ``at_least`` is
    True, and the coefficient is the least with which they would have.
    """

    k_mm2_n: float
    k_sigma_mm2_n: float
    factor: float
    told: int
    at_least: bool

    def __str__(self) -> str:
        if self.at_least:
            return f"k is {self.k_mm2_n:.3g} mm2/N or more: the passes cut down to their floors"
        return f"k = {self.k_mm2_n:.4g} +- {self.k_sigma_mm2_n:.2g} mm2/N, {self.factor:.2f} times the planned one"


def learn_removal(
    plan: GrindingPlan, after_mm: Floats, sigma_mm: Floats, alike_nodes: float = 1.0, common_sigma_mm: float = 0.0
) -> LearntRemoval:
    """Learn Preston's coefficient from the heights before the passes, which the plan holds, and those after them.

    The passes are simulated with one factor on the depth of all strokes; the one whose outcome is nearest to what was
    measured is it.

    Args:
        plan: what was driven, from the heights that were measured before.
        after_mm: measured heights (R, C) after the passes; NaN where they are not known.
        sigma_mm: standard deviation (R, C) of the change of each node.
        alike_nodes: so many neighbouring nodes share their noise.
        common_sigma_mm: standard deviation of what is common to all nodes.

    Raises:
        InputError: the plan has no passes; too few nodes are measured; nothing was taken off.
    """
    if not plan.passes:
        raise InputError("the plan has no passes; nothing can be learnt from it")
    before = np.where(plan.work.inside, plan.work.heights.heights_mm, np.nan)
    cut = plan.work.inside & (plan.remaining_mm < before - plan.work.level_mm)
    used = cut & np.isfinite(after_mm) & np.isfinite(sigma_mm)
    if used.sum() < MIN_TOLD:
        raise InputError(f"only {int(used.sum())} nodes of what was ground are measured; scan the place from above")
    weights = 1 / np.maximum(sigma_mm[used], 1e-9) ** 2
    areas = plan.work.heights.areas_mm2[used]
    removed = float(((before[used] - after_mm[used]) * areas).sum())
    planned = float(sum(one.removed_mm3 for one in plan.passes))
    if removed < MIN_REMOVED * planned:
        raise InputError(
            f"the new scan shows {removed:.3g} mm3 taken off where {planned:.3g} mm3 were planned; is it the scan after"
            " the passes?"
        )

    def left(factor: float) -> Floats:
        for heights in simulate_passes(plan, plan.work.heights.heights_mm, factor):
            last = heights
        return last[used]

    def cost(log_factor: float) -> float:
        return float((weights * (after_mm[used] - left(float(np.exp(log_factor)))) ** 2).sum())

    tried = np.linspace(np.log(SMALLEST), np.log(LARGEST), 18)
    costs = [cost(one) for one in tried]
    best = int(np.argmin(costs))
    low, high = tried[max(best - 1, 0)], tried[min(best + 1, len(tried) - 1)]
    factor = float(np.exp(minimize_scalar(cost, bounds=(low, high), method="bounded", options={"xatol": 1e-4}).x))
    slope = (left(factor * (1 + STEP)) - left(factor * (1 - STEP))) / (2 * STEP * factor)
    telling = np.abs(slope) > 0.05 * plan.options.depth_mm
    planned = plan.options.k_mm2_n
    if telling.sum() < max(MIN_TOLD, 0.02 * used.sum()):
        return LearntRemoval(planned * min(factor, 1.0), np.inf, min(factor, 1.0), int(telling.sum()), True)
    information = float((weights * slope**2).sum())
    common = float((weights * slope).sum() / information) * common_sigma_mm
    sigma = float(np.hypot(np.sqrt(alike_nodes / information), common))
    return LearntRemoval(planned * factor, planned * sigma, factor, int(telling.sum()), False)
