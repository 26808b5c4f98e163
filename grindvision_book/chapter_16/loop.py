"""The loop on the twin: two scans, passes, what a true wheel makes of them, a new scan, and so on to the verdict.

The wheel follows the planned ways over the true part, not over the scanned one: where the scanner shows the part too
high or too low, and where the arm errs, it cuts too little or too deep.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from grindvision.cell.grinding_scene import GrindingScene, grinding_scene
from grindvision.cell.rays import target_of
from grindvision.cell.scan import Scan
from grindvision.cell.scanners import StructuredLightScanner
from grindvision.cell.solids import Solid
from grindvision.errors import InputError
from grindvision.geometry import inverse, move_points, rotate_vectors
from grindvision.geometry.height_map import HeightMap
from grindvision.grinding import Grinding, GrindOptions, grind
from grindvision.grinding_again import GrindAgainOptions, GroundAgain, grind_again
from grindvision.grinding_files import job_of
from grindvision.motion.grinding import GrindingPlan, simulate_passes
from grindvision.motion.grinding_options import GrindingOptions
from grindvision.motion.removal import LearntRemoval
from grindvision.records import by_content
from grindvision.vision.change.stock import StockPiece
from grindvision_book.chapter_16.ground_scans import finer_plan, lowered

Floats = NDArray[np.float64]

STANDS_MM = 0.05
"""The bead is where the true part stands higher than this above the good surface."""

TOLERANCE_MM = 0.2
"""Nothing of the bead may stand higher for the loop to end."""

FINER = 3
"""The scans of ground parts are made with what was taken off on a map with so many times as many nodes along each side:
between those of the plan it rises over the bead, and straight lines would take off 2 % too little."""

MAX_SCANS = 4
"""The loop ends after so many scans of ground parts."""


@dataclass(frozen=True)
class Shop:
    """What is true in the shop and nobody knows: the process takes off ``k_factor`` times what is planned, and the arm
    runs ``arm_mm`` above where it is sent. ``touched_off``: the wheel is zeroed on the good surface beside the bead.
    ``place_sigma_mm``: what the planner is told of the arm's and the scanner's errors together, where it is not."""

    k_factor: float = 1.0
    arm_mm: float = 0.0
    touched_off: bool = False
    place_sigma_mm: float = 0.1
    passes: GrindingOptions = field(default_factory=GrindingOptions)


@by_content
@dataclass(frozen=True)
class Job:
    """One planned job, driven on the true part: ``left_mm`` (R, C) above its good surface after each pass, and before
    the first; ``bead`` (R, C) where there was one; what the scan after it told, ``after``, and the true factor of the
    coefficient that the job was planned with."""

    piece: StockPiece
    plan: GrindingPlan
    left_mm: tuple[Floats, ...]
    bead: NDArray[np.bool_]
    k_factor: float
    after: GroundAgain | None = None

    @property
    def gouge_mm(self) -> float:
        """How deep the true part was cut below its good surface, 0 where nowhere."""
        return max(0.0, -float(np.nanmin(self.left_mm[-1])))

    @property
    def left_95_mm(self) -> float:
        """What 95 % of the bead has left at most."""
        return float(np.nanquantile(self.left_mm[-1][self.bead], 0.95))

    @property
    def learnt(self) -> LearntRemoval | None:
        """What the scan after it told of process and wheel."""
        return None if self.after is None else self.after.learnt[0]


def volume_mm3(solid: Solid) -> float:
    """Volume of a solid, by its triangles."""
    a, b, c = (solid.vertices_mm[solid.triangles[:, corner]] - solid.vertices_mm.mean(axis=0) for corner in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def true_volume_mm3(scene: GrindingScene) -> float:
    """Volume of the bead."""
    return volume_mm3(scene.part.test) - volume_mm3(scene.part.sample)


def true_heights(solid: Solid, scan: Scan, points: Floats, normals: Floats) -> Floats:
    """Heights (N,) of a solid over points of a scan's frame, along normals (N, 3)."""
    T = scan.T_world_scanner
    return target_of(solid).heights(move_points(T, points), rotate_vectors(T, normals), 5.0)


def true_map(solid: Solid, scan: Scan, over: HeightMap) -> Floats:
    """Heights (R, C) of a solid over the ground of a map, which is where the scan shows it."""
    heights = np.full(over.shape, np.nan)
    shown = over.shown
    heights[shown] = true_heights(solid, scan, *over.in_scan(np.argwhere(shown) * over.spacing_mm))
    return heights


def first_plan(scene: GrindingScene, shop: Shop) -> Grinding:
    """Stock and passes from the two scans of a scene.

    Raises:
        InputError: the bead cannot be ground.
    """
    sigma = 0.0 if shop.touched_off else shop.place_sigma_mm
    return grind(scene.sample.points, scene.test.points, GrindOptions(shop.passes, place_sigma_mm=sigma))


def first_job(scene: GrindingScene, shop: Shop, found: Grinding) -> Job:
    """The passes of ``found`` driven on the true part of a scene."""
    piece, plan = found.stock.pieces[0], found.plans[0]
    if plan is None:
        raise InputError(found.refusals[1])
    good = true_map(scene.part.sample, scene.test, piece.map)
    left = true_map(scene.part.test, scene.test, piece.map) - good
    return _driven(shop, piece, plan, good, left, left > STANDS_MM, shop.k_factor)


def jobs(scene: GrindingScene, shop: Shop, seed: int, every: int = 1) -> Iterator[Job]:
    """Plan, grind, scan, learn, plan the rest, until the scan shows nothing that is left to be ground."""
    first = first_plan(scene, shop)
    job = first_job(scene, shop, first)
    grid = job.piece.map.refined(FINER)
    good = true_map(scene.part.sample, scene.test, grid)
    standing = true_map(scene.part.test, scene.test, grid) - good
    left = _driven_finely(shop, job, good, standing)
    state = job_of(
        first.T_sample_test, (job.piece,), (job.plan,), shop.passes, T_base_scanner=scene.test.T_world_scanner
    )
    serial = int(np.random.default_rng(seed).integers(2**31))
    for number in range(1, MAX_SCANS + 1):
        rng, scanner = np.random.default_rng([seed, number]), StructuredLightScanner(serial=serial)
        fresh = grinding_scene(rng, part=scene.part, scanner=scanner, every=every).test
        T_test_fresh = inverse(scene.test.T_world_scanner) @ fresh.T_world_scanner
        points = lowered(fresh.points, grid, np.nan_to_num(standing - left), T_test_fresh)
        asked = GrindAgainOptions(tolerance_mm=TOLERANCE_MM, T_base_scanner=fresh.T_world_scanner)
        after = grind_again(state, scene.sample.points, points, asked)
        yield replace(job, after=after)
        plan, piece = after.plans[0], after.pieces[0]
        if plan is None:
            return
        T_sample_fresh = after.compared.registration.T_target_source
        state = job_of(T_sample_fresh, (piece,), (plan,), after.passes, T_base_scanner=fresh.T_world_scanner)
        k_factor = job.k_factor * job.plan.options.k_mm2_n / after.passes.k_mm2_n
        good = true_map(scene.part.sample, fresh, piece.map)
        job = _driven(shop, piece, plan, good, job.left_mm[-1], job.bead, k_factor)
        good = true_map(scene.part.sample, fresh, piece.map.refined(FINER))
        left = _driven_finely(shop, job, good, left)


def _driven(
    shop: Shop,
    piece: StockPiece,
    plan: GrindingPlan,
    good: Floats,
    left: Floats,
    bead: NDArray[np.bool_],
    k_factor: float,
) -> Job:
    """A plan driven on a part that stands ``left`` above its good surface, which is ``good`` over the scanned one."""
    high = _high(shop, piece, plan, good)
    steps = [heights + high - good for heights in simulate_passes(plan, good + left - high, k_factor)]
    return Job(piece, plan, (left, *steps), bead, k_factor)


def _driven_finely(shop: Shop, job: Job, good: Floats, left: Floats) -> Floats:
    """What is left after a job, of ``left`` before it, over a map with ``FINER`` times as many nodes along each side.

    ``good``: the good surface over the scanned one there.
    """
    high = _high(shop, job.piece, job.plan, good[::FINER, ::FINER])
    *_, heights = simulate_passes(finer_plan(job.plan, FINER), good + left - high, job.k_factor)
    return heights + high - good


def _high(shop: Shop, piece: StockPiece, plan: GrindingPlan, good: Floats) -> float:
    """How high the wheel runs over the surface that the scan shows, against what the plan has it."""
    return float(np.nanmean(good[piece.unchanged])) if shop.touched_off else shop.arm_mm - plan.work.offset_mm
