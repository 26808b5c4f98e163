"""Two scans of a grinding part: the good sample and the test part with its bead, and what is true about them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from grindvision.cell.grinding_part import BEAD, LENGTH_MM, GrindingPart, grinding_part
from grindvision.cell.rays import target_of
from grindvision.cell.scan import Scan
from grindvision.cell.scanners import Scanner, StructuredLightScanner
from grindvision.cell.views import view_from
from grindvision.errors import InputError
from grindvision.geometry import angle_between, inverse, move_points, rotate_vectors
from grindvision.records import by_content

Floats = NDArray[np.float64]

#: Two scans see the same spot when their true points there are nearer than this, mm.
SAME_SPOT_MM = 1.0


@by_content
@dataclass(frozen=True)
class GrindingScene:
    """Scans of the sample and of the test part, each in its own scanner frame (mm); the world frame is the part's.

    Truth: ``T_sample_test`` (4, 4) moves points of the test scan into the sample's scanner frame. ``ridge_mm`` and
    ``ridge_normals`` (K, 3) are the bead's ridge and the surface normals under it in the scanner frame of the test
    scan.
    """

    part: GrindingPart
    sample: Scan
    test: Scan
    T_sample_test: Floats
    ridge_mm: Floats
    ridge_normals: Floats

    @cached_property
    def overlap(self) -> float:
        """Share of the test scan's points, bead apart, that the sample scan saw as well; estimated from 5,000."""
        T_part_sample, T_part_test = self.sample.T_world_scanner, self.test.T_world_scanner
        seen = self.test.true_points[~self.on_bead][:: max(1, len(self.test) // 5000)]
        there = cKDTree(move_points(T_part_sample, self.sample.true_points))
        nearest, _ = there.query(move_points(T_part_test, seen), distance_upper_bound=SAME_SPOT_MM)
        return float(np.isfinite(nearest).mean())

    @property
    def on_bead(self) -> NDArray[np.bool_]:
        """Mark the points (N,) of the test scan that lie on the bead."""
        return self.test.on(BEAD)

    def __str__(self) -> str:
        apart_deg = np.degrees(angle_between(np.eye(3), self.T_sample_test))
        return (
            f"{self.part}: sample {len(self.sample):,} points, test {len(self.test):,} points, {apart_deg:.1f} deg"
            f" apart, overlap {self.overlap:.0%}"
        )


def grinding_scene(
    rng: np.random.Generator,
    relief: float = 1.0,
    overlap: float = 1.0,
    rotation_deg: tuple[float, float] = (20.0, 40.0),
    part: GrindingPart | None = None,
    scanner: Scanner | None = None,
    every: int = 1,
) -> GrindingScene:
    """Scan the sample and the test part from two poses that differ by an angle within ``rotation_deg``.

    Args:
        rng: draws the instrument (its serial), both poses and all noise.
        relief: height of the part's features; 0.2 is the hard part. Not used when ``part`` is given.
        overlap: fraction of the part that both scans are to see; below 1 the two views move apart along the plate.
        rotation_deg: smallest and largest rotation between the poses.
        part: made when left out.
        scanner: a structured-light scanner when left out; one that is given keeps its serial.
        every: pixel step; 1 gives about 600,000 points a scan.

    Raises:
        InputError: overlap or rotation out of range. SightError: the scanner does not reach the part.
    """
    if not 0.4 <= overlap <= 1:
        raise InputError(f"overlap is {overlap}; choose 0.4 to 1, so that both scans see the bead")
    low, high = rotation_deg
    if not 0 <= low < high <= 180:
        raise InputError(f"rotation_deg is {low} to {high}; choose a range within 0 to 180")
    part = part or grinding_part(relief)
    serial = int(rng.integers(2**31))
    scanner = scanner or StructuredLightScanner(serial=serial)
    reach = scanner.half_field_mm[0]
    aside = max(0.0, (2 * reach - (reach + LENGTH_MM / 2) * overlap) / (2 - overlap))
    sample_pose = _random_view(rng, -aside, 10.0, 10.0)
    for _ in range(10_000):
        test_pose = _random_view(rng, aside, 14.0, high)
        if low <= np.degrees(angle_between(sample_pose, test_pose)) <= high:
            return scanned_pair(part, scanner, sample_pose, test_pose, rng, every)
    raise InputError(f"no two views of the part differ by {low} to {high} deg; widen rotation_deg")


def scanned_pair(
    part: GrindingPart,
    scanner: Scanner,
    T_part_sample: Floats,
    T_part_test: Floats,
    rng: np.random.Generator,
    every: int = 1,
) -> GrindingScene:
    """Scan the good part from pose ``T_part_sample`` and the one with the bead from ``T_part_test``."""
    sample = scanner.scan(target_of(part.sample), T_part_sample, rng, every)
    test = scanner.scan(target_of(part.test), T_part_test, rng, every)
    T_test_part = inverse(T_part_test)
    return GrindingScene(
        part,
        sample,
        test,
        inverse(T_part_sample) @ T_part_test,
        move_points(T_test_part, part.bead.ridge_mm),
        rotate_vectors(T_test_part, part.bead.normals),
    )


def _random_view(rng: np.random.Generator, x_mm: float, tilt_deg: float, roll_deg: float) -> Floats:
    target = np.array([x_mm, 0.0, 0.0]) + rng.uniform(-3, 3, 3)
    tilt, azimuth = np.radians(rng.uniform(0.3, 1.0) * tilt_deg), rng.uniform(0, 2 * np.pi)
    return view_from(target, 400.0, tilt, azimuth, np.radians(rng.uniform(-roll_deg, roll_deg)))
