"""Stock, passes and the loop against the twin's truth: ``python -m benchmarks.grinding [SEEDS] [EVERY] [FIRST]``.

Each seed is another instrument, another arm and another process. Volume and sigma are held against the solids'
volumes. The passes are driven on the true part three times: with the wheel touched off on the good surface beside the
bead; where the scan says that the surface is, all in one go; and there, in the loop, with scans in between from which
``grind --again`` learns where the wheel runs and Preston's coefficient.
"""

from __future__ import annotations

import sys
import warnings
from dataclasses import dataclass, replace

import numpy as np

from grindvision.cell.grinding_scene import grinding_scene
from grindvision.errors import GrindvisionWarning, InputError
from grindvision.motion.grinding_options import GrindingOptions
from grindvision_book.chapter_16.loop import Job, Shop, first_job, first_plan, jobs, true_volume_mm3

ARM_MM = 0.03
"""Standard deviation of the arm's error along the normal."""

DEEPER = 1.5
"""So much deeper cut the passes of an instrument for which the usual depth is below the level of detection."""

K_FACTORS = 0.6, 1.2
"""The true coefficient is drawn between so many times the planned one."""


@dataclass(frozen=True)
class Outcome:
    """One seed: the volume's relative error and its error in sigmas; the deepest gouge and what 95 % of the bead has
    left at most, in mm, touched off, in one go without, and in the loop; the loop's jobs and passes, its verdict, and
    the relative error of the coefficient where it was told (NaN elsewhere)."""

    volume_off: float
    sigmas_off: float
    touched_gouge_mm: float
    touched_left_mm: float
    blind_gouge_mm: float
    blind_left_mm: float
    loop_gouge_mm: float
    loop_left_mm: float
    loop_jobs: int
    met: bool
    k_off: float


def outcome(seed: int, every: int) -> Outcome:
    """Scan, plan, grind, scan again."""
    scene = grinding_scene(np.random.default_rng(seed), every=every)
    rng = np.random.default_rng([seed, 16])
    arm_mm, k_factor = ARM_MM * float(rng.standard_normal()), float(rng.uniform(*K_FACTORS))
    passes = GrindingOptions()
    try:
        found = first_plan(scene, Shop(touched_off=True, passes=passes))
    except InputError:  # below what this instrument's scans can show: deeper cuts, as the message asks for
        passes = replace(passes, depth_mm=DEEPER * passes.depth_mm)
        found = first_plan(scene, Shop(touched_off=True, passes=passes))
    touched_shop = Shop(touched_off=True, passes=passes)
    blind_shop = Shop(arm_mm=arm_mm, place_sigma_mm=0.0, passes=passes)
    touched, blind = (first_job(scene, shop, found) for shop in (touched_shop, blind_shop))
    loop = list(jobs(scene, Shop(k_factor, arm_mm, passes=passes), seed, every))
    truth = true_volume_mm3(scene)
    piece, last = touched.piece, loop[-1]
    return Outcome(
        piece.volume_mm3 / truth - 1,
        (piece.volume_mm3 - truth) / piece.volume_sigma_mm3,
        touched.gouge_mm,
        touched.left_95_mm,
        blind.gouge_mm,
        blind.left_95_mm,
        last.gouge_mm,
        last.left_95_mm,
        len(loop),
        last.after is not None and last.after.met,
        k_error(loop),
    )


def k_error(loop: list[Job]) -> float:
    """Relative error of the first coefficient that a scan told."""
    for job in loop:
        if job.learnt is not None and not job.learnt.at_least:
            return job.learnt.factor / job.k_factor - 1
    return np.nan


def main() -> None:
    """Print a line per seed and what they say together."""
    seeds, every, first = (int(word) for word in (*sys.argv[1:], *("10", "1", "0")[len(sys.argv) - 1 :]))
    warnings.simplefilter("ignore", GrindvisionWarning)
    rows = []
    for seed in range(first, first + seeds):
        rows.append(outcome(seed, every))
        print(seed, rows[-1], flush=True)
    column = {name: np.array([getattr(row, name) for row in rows], dtype=float) for name in vars(rows[0])}
    print(f"{seeds} seeds, every {every}. pixel")
    off, sigmas = np.abs(column["volume_off"]), np.abs(column["sigmas_off"])
    print(f"volume: median {np.median(off):.2%} off; {np.mean(sigmas < 1):.0%} within sigma")
    for name in ("touched", "blind", "loop"):
        gouge, left = column[f"{name}_gouge_mm"], column[f"{name}_left_mm"]
        held = np.mean((gouge <= 0.05) & (left <= 0.15))
        print(
            f"{name}: {gouge.max():.3f} mm deep and {left.max():.3f} mm left on 95 % at most; both held by {held:.0%}"
        )
    k = np.abs(column["k_off"][np.isfinite(column["k_off"])])
    many, met = column["loop_jobs"], column["met"]
    print(f"loop: {many.mean():.1f} jobs, at most {many.max():.0f}; {met.mean():.0%} met")
    print(f"k: told by {len(k)} seeds, median {np.median(k):.1%} off, at most {k.max():.1%}")


if __name__ == "__main__":
    main()
