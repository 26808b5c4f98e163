"""Two scans of a workpiece: the good part and the test part, with a bead, with a pit or as good, and the truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from grindvision.cell.grinding_part import STATION_MM, Bead
from grindvision.cell.rays import target_of
from grindvision.cell.scan import NO_SURFACE, Scan
from grindvision.cell.scanners import Scanner, StructuredLightScanner
from grindvision.cell.solids import Solid
from grindvision.cell.views import view_from
from grindvision.cell.workpieces import MARK, Workpiece, workpiece
from grindvision.errors import InputError
from grindvision.geometry import inverse, move_points, rotate_vectors
from grindvision.records import by_content

Floats = NDArray[np.float64]

CHANGES = ("bead", "pit", "none")
"""What the test part differs by."""

DISTANCE_MM = 410.0

ENOUGH = 20
"""A mark that both scans see with fewer points than this fixes no pose."""

SAME_SPOT_MM, COS_SAME = 1.5, 0.9
"""Both scans saw a spot where their true points and normals are so near."""

MIN_FIXED = 0.001
"""A motion is fixed when the mean square of what it moves across the surface is this share of the motion's at least."""


@by_content
@dataclass(frozen=True)
class WorkpieceScene:
    """Scans of the good part, ``sample``, and of the ``test`` part, each in its own scanner frame (mm).

    Truth: ``T_sample_test`` (4, 4); ``ridge_mm`` and ``ridge_normals`` (K, 3) of the bead, or the bottom of the pit, in
    the frame of the test scan, empty where there is none; ``good`` the good part's mesh in the sample's scanner frame;
    ``determined``: both scans show what fixes the pose.
    """

    piece: Workpiece
    change: str
    sample: Scan
    test: Scan
    T_sample_test: Floats
    ridge_mm: Floats
    ridge_normals: Floats
    good: Solid
    determined: bool

    def pose_error_mm(self, T_sample_test: Floats) -> float:
        """Largest distance between a test point's place by this pose and its true place."""
        points = self.test.true_points[::10]
        away = move_points(T_sample_test, points) - move_points(self.T_sample_test, points)
        return float(np.linalg.norm(away, axis=1).max())

    @property
    def seen_by_both(self) -> NDArray[np.bool_]:
        """Of the places (K,) of ``ridge_mm`` those where both scans saw the surface beside it."""
        seen = cKDTree(self.sample.true_points)
        away, _ = seen.query(move_points(self.T_sample_test, self.ridge_mm))
        there, _ = cKDTree(self.test.true_points).query(self.ridge_mm)
        return np.asarray((away < 2.5) & (there < 1.0))

    @property
    def comparable(self) -> float:
        """Fraction of the changed place's length at which both scans saw the surface beside it."""
        return float(np.mean(self.seen_by_both)) if len(self.ridge_mm) else float("nan")

    def __str__(self) -> str:
        return f"{self.piece.kind}, {self.change}: sample {len(self.sample):,} points, test {len(self.test):,} points"


def workpiece_scene(
    kind: str,
    rng: np.random.Generator,
    change: str = "bead",
    apart_deg: tuple[float, float] = (10.0, 60.0),
    scanner: Scanner | None = None,
    every: int = 4,
) -> WorkpieceScene:
    """Scan a good and a changed workpiece from two places whose lines of sight differ by an angle within ``apart_deg``.

    Args:
        kind: one of ``workpieces.WORKPIECES``.
        rng: draws the sizes, the instrument (its serial), the views and the noise.
        change: one of ``CHANGES``; a bead is 20 to 30 mm long, 3 to 5 mm wide and 0.8 to 1.8 mm high, a pit as deep.
        scanner: a structured-light scanner when left out; one that is given keeps its serial.
        every: pixel step; 4 gives points some 0.8 mm apart.

    Raises:
        InputError: unknown kind or change, angles out of range. SightError: the scanner does not reach the part.
    """
    if change not in CHANGES:
        raise InputError(f"no change {change!r}; there are {', '.join(CHANGES)}")
    low, high = apart_deg
    if not 0 <= low <= high <= 90:
        raise InputError(f"apart_deg is {low} to {high}; choose a range within 0 to 90")
    piece = workpiece(kind, rng)
    good = piece.shape.solid()
    bad, ridge, normals = _changed(piece, good, change, rng)
    scanner = scanner or StructuredLightScanner(serial=int(rng.integers(2**31)))
    # both scanners stand as far off the part's own z axis, so that they see its walls
    half = np.radians(rng.uniform(low, high)) / 2
    tilt = rng.uniform(np.radians(38), np.radians(52))
    side = 2 * np.arcsin(np.sin(half) / np.sin(tilt))
    azimuth = rng.uniform(0, 2 * np.pi)
    middle = (good.vertices_mm.min(axis=0) + good.vertices_mm.max(axis=0)) / 2
    poses = [
        view_from(middle + rng.uniform(-4, 4, 3), DISTANCE_MM, tilt, about, rng.uniform(-np.pi / 2, np.pi / 2))
        for about in (azimuth, azimuth + side)
    ]
    sample = scanner.scan(target_of(good), poses[0], rng, every)
    test = scanner.scan(target_of(bad), poses[1], rng, every)
    T_sample_part, T_test_part = inverse(poses[0]), inverse(poses[1])
    return WorkpieceScene(
        piece, change, sample, test, T_sample_part @ poses[1],
        move_points(T_test_part, ridge), rotate_vectors(T_test_part, normals),
        good.moved(T_sample_part), _determined(piece, sample, test),
    )  # fmt: skip


def _changed(piece: Workpiece, good: Solid, change: str, rng: np.random.Generator) -> tuple[Solid, Floats, Floats]:
    """The test part, and the ridge of its bead (or the bottom of its pit) with the surface normals there."""
    if change == "none":
        return good, np.empty((0, 3)), np.empty((0, 3))
    length, width, height = rng.uniform(20, 30), rng.uniform(3, 5), rng.uniform(0.8, 1.8)
    start, end = np.array(piece.seat)
    middle, ahead = (start + end) / 2, (end - start) / np.linalg.norm(end - start)
    s = np.linspace(-length / 2, length / 2, int(length / STATION_MM) + 1)
    bow = rng.uniform(-1 / 60, 1 / 60) * s**2 / 2
    plan = middle + s[:, None] * ahead + bow[:, None] * np.array([-ahead[1], ahead[0]])
    places, normals = _upper_face(good, plan)
    sign = 1.0 if change == "bead" else -1.0
    ridge = places + sign * height * normals
    shape = Bead(ridge, sign * normals, width, height).shape()
    whole = piece.shape + shape if change == "bead" else piece.shape - shape
    return whole.solid(), ridge, normals


def _upper_face(solid: Solid, plan: Floats) -> tuple[Floats, Floats]:
    """Places (K, 3) of the solid's upper face over the plan (K, 2), smoothed, and the unit normals (K, 3) there."""
    target = target_of(solid)
    above = solid.vertices_mm[:, 2].max() + 10.0
    hits = [target.cast(np.array([*place, above]), np.array([[0.0, 0.0, -1.0]])) for place in plan]
    heights = np.array([above - hit.distance[0] for hit in hits])
    normals = np.array([target.normals[hit.triangle[0]] for hit in hits])
    for _ in range(20):  # the facets of a curved face
        for values in (heights, normals):
            values[1:-1] = (values[:-2] + 2 * values[1:-1] + values[2:]) / 4
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return np.column_stack([plan, heights]), normals


def _determined(piece: Workpiece, sample: Scan, test: Scan) -> bool:
    """Whether what both scans saw fixes the pose: no motion slides along all of it, and the mark is among it."""
    spots, facing = (
        [rotate_or_move(scan.T_world_scanner, values) for scan, values in zip((sample, test), pair, strict=True)]
        for rotate_or_move, pair in (
            (move_points, (sample.true_points, test.true_points)),
            (rotate_vectors, (sample.true_normals, test.true_normals)),
        )
    )
    away, near = cKDTree(spots[0]).query(spots[1], distance_upper_bound=SAME_SPOT_MM)
    shared = np.isfinite(away)
    shared[shared] = (facing[0][near[shared]] * facing[1][shared]).sum(axis=1) > COS_SAME
    if shared.sum() < ENOUGH or (piece.marked and (shared & (test.surface_id == _mark_id(test))).sum() < ENOUGH):
        return False
    arms = spots[1][shared] - spots[1][shared].mean(axis=0)
    arms /= np.sqrt((arms**2).sum(axis=1).mean())
    jacobian = np.column_stack([facing[1][shared], np.cross(arms, facing[1][shared])])
    return bool(np.linalg.eigvalsh(jacobian.T @ jacobian / len(jacobian))[0] > MIN_FIXED)


def _mark_id(scan: Scan) -> int:
    return scan.surfaces.index(MARK) if MARK in scan.surfaces else NO_SURFACE - 1
