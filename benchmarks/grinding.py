"""Stock, passes and the learnt process against the twin's truth: ``python -m benchmarks.grinding [SEEDS] [EVERY]``.

For each seed a scanner of its own scans the good part and the part with its bead; volume and sigma are held against the
solids' volumes, the planned passes are simulated against the true part, once with the wheel touched off on the good
surface beside the bead and once where the scan says it is, and Preston's coefficient is learnt from a third scan of the
part ground with half of it.
"""

from __future__ import annotations

import sys
import warnings
from dataclasses import dataclass

import numpy as np

from grindvision.cell.grinding_scene import GrindingScene, grinding_scene
from grindvision.cell.rays import target_of
from grindvision.cell.scanners import StructuredLightScanner
from grindvision.cell.solids import Solid
from grindvision.errors import GrindvisionWarning
from grindvision.geometry import inverse, move_points, rotate_vectors
from grindvision.grinding import Grinding, GrindOptions, compare, grind
from grindvision.motion.grinding import simulate_passes
from grindvision.motion.grinding_options import GrindingOptions
from grindvision.motion.removal import learn_removal
from grindvision.vision.change.stock import measure_again
from grindvision.vision.registration.scan_registration import StageClock
from tests.ground_scans import ground_points

FACTOR = 0.5
"""The true coefficient, of the planned one, with which the part is ground before the third scan."""


@dataclass(frozen=True)
class Outcome:
    """One seed: volume and its error in sigmas; mm under the good surface at the deepest, and what 95 % of the bead has
    left at most, touched off and not; the learnt factor against the true one."""

    volume_off: float
    sigmas_off: float
    deepest_mm: float
    left_95_mm: float
    untouched_deepest_mm: float
    k_off: float


def volume_mm3(solid: Solid) -> float:
    """Volume of a solid, by its triangles."""
    a, b, c = (solid.vertices_mm[solid.triangles[:, corner]] - solid.vertices_mm.mean(axis=0) for corner in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def outcome(seed: int, every: int) -> Outcome:
    """Scan, plan, grind, scan again."""
    scene = grinding_scene(np.random.default_rng(seed), every=every)
    found = grind(scene.sample.points, scene.test.points, GrindOptions(GrindingOptions(depth_mm=0.1)))
    piece, plan = found.stock.pieces[0], found.plans[0]
    if plan is None:
        raise SystemExit(f"seed {seed}: {found.refusals}")
    truth = volume_mm3(scene.part.test) - volume_mm3(scene.part.sample)
    shown = piece.map.shown
    heights = [np.full(piece.map.shape, np.nan) for _ in range(2)]
    places = np.argwhere(shown) * piece.map.spacing_mm
    for grid, solid in zip(heights, (scene.part.sample, scene.part.test), strict=True):
        grid[shown] = true_heights(scene, solid, *piece.map.in_scan(places))
    good, bead = heights
    off = float(np.nanmean(good[piece.unchanged]))
    results = []
    for touched in (off, 0.0):
        *_, after = simulate_passes(plan, bead - touched)
        left = after - (good - touched)
        results.append((float(-np.nanmin(left)), float(np.quantile(left[bead - good > 0.05], 0.95))))
    (deepest, left_95), (untouched, _) = results
    return Outcome(
        piece.volume_mm3 / truth - 1,
        (piece.volume_mm3 - truth) / piece.volume_sigma_mm3,
        deepest,
        left_95,
        untouched,
        learnt_factor(scene, seed, every, off) / FACTOR - 1,
    )


def true_heights(scene: GrindingScene, solid: Solid, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Heights (N,) of a solid over points of the test scan's frame."""
    T = scene.test.T_world_scanner
    return target_of(solid).heights(move_points(T, points), rotate_vectors(T, normals), 5.0)


def learnt_factor(scene: GrindingScene, seed: int, every: int, off_mm: float) -> float:
    """The factor that a third scan tells, by the same instrument, after five passes of 0.3 mm."""
    found: Grinding = grind(scene.sample.points, scene.test.points, GrindOptions(GrindingOptions(depth_mm=0.3)))
    piece, plan = found.stock.pieces[0], found.plans[0]
    assert plan is not None
    serial = int(np.random.default_rng(seed).integers(2**31))
    third = grinding_scene(
        np.random.default_rng(seed + 10_000), scanner=StructuredLightScanner(serial=serial), every=every
    ).test
    T_test_third = inverse(scene.test.T_world_scanner) @ third.T_world_scanner
    ground = ground_points(
        third.points, plan, FACTOR, T_test_third, lambda p, n: true_heights(scene, scene.part.test, p, n) - off_mm
    )
    again = compare(scene.sample.points, ground, GrindOptions(), StageClock())
    pair = again.registration
    T_third_test = inverse(pair.T_target_source) @ found.T_sample_test
    (after,) = measure_again(pair.source, pair.target, pair.fine, again.difference, [piece.place], T_third_test)
    heights = np.where(after.inside & ~after.hidden, after.map.heights_mm, np.nan)
    return learn_removal(plan, heights, np.hypot(piece.sigma_mm, after.sigma_mm)).factor


def main() -> None:
    """Print a line per seed and what they say together."""
    seeds, every = (int(word) for word in (*sys.argv[1:], *("10", "1")[len(sys.argv) - 1 :]))
    warnings.simplefilter("ignore", GrindvisionWarning)
    rows = []
    for seed in range(seeds):
        rows.append(outcome(seed, every))
        print(seed, rows[-1], flush=True)
    table = np.array([list(vars(row).values()) for row in rows])
    print(f"{seeds} seeds, every {every}. pixel")
    print(
        f"volume: median {np.median(np.abs(table[:, 0])):.2%} off; {np.mean(np.abs(table[:, 1]) < 1):.0%} within sigma"
    )
    print(f"touched off: {table[:, 2].max():.3f} mm deep at most, left on 95 %: {table[:, 3].max():.3f} mm at most")
    print(f"not touched off: {table[:, 4].max():.3f} mm deep at most")
    print(f"k: median {np.median(np.abs(table[:, 5])):.1%} off, at most {np.abs(table[:, 5]).max():.1%}")


if __name__ == "__main__":
    main()
