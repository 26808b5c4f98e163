"""Coarse calibration: where the scanner sits on a nominal arm, from three spheres (Eq 8) or from all measurements."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.arm import MdhArm, check_angles, forward
from grindvision.calibration.estimate import Sigmas, gauss_newton, residuals_of
from grindvision.calibration.measurements import Measurements
from grindvision.calibration.model import ScannerOnArm
from grindvision.calibration.starts import fixed_base_start, free_base_starts, median_error, touching_start
from grindvision.calibration.unknowns import Unknowns, unknowns_for
from grindvision.errors import DegenerateError, InputError
from grindvision.geometry import (
    check_points,
    inverse,
    rigid,
    vector_angle,
)

Floats = NDArray[np.float64]

#: Three spheres must not stand nearer to a line than this.
SMALLEST_ANGLE_DEG = 3.0

#: What a nominal arm in the right frame leaves at most; a wrong frame or a wrong start leaves far more.
PLAUSIBLE_MM = 10.0


@dataclass(frozen=True)
class CoarseCalibration:
    """The nominal arm with a scanner's and a tracker's place, and the ``rms_mm`` it leaves on the data it came from."""

    cell: ScannerOnArm
    rms_mm: float

    def __str__(self) -> str:
        return f"coarse calibration, rms {self.rms_mm:.3f} mm"


def three_point(arm: MdhArm, q_rad: ArrayLike, scanner_mm: ArrayLike, base_mm: ArrayLike) -> CoarseCalibration:
    """Three-point method, Eqs 7-8: one arm pose (n,), three spheres o, a, b (3, 3) in the scanner's and the base frame.

    Raises:
        InputError: not three spheres. DegenerateError: the spheres lie on one line; the message carries the angle.
    """
    q = check_angles(arm, q_rad)
    frames = []
    for name, points in (("scanner", scanner_mm), ("base", base_mm)):
        points = check_points(points, f"spheres in the {name} frame")
        if len(points) != 3 or q.ndim != 1:
            raise InputError(f"the three-point method takes one pose and three spheres, got {len(points)} spheres")
        frames.append(_workpiece_frame(points, name))
    P_scanner, P_base = frames
    T_joint_scanner = inverse(forward(arm, q)) @ P_base @ inverse(P_scanner)
    cell = ScannerOnArm(arm, T_joint_scanner, np.eye(4))
    error = np.asarray(base_mm, dtype=float) - cell.points_base(np.broadcast_to(q, (3, arm.n)), scanner_mm)
    return CoarseCalibration(cell, _rms(error))


def best_fit(
    measurements: Measurements, arm: MdhArm, base_fixed: bool = False, robust: bool = True, seed: int = 0
) -> CoarseCalibration:
    """Scanner's place (and, unless ``base_fixed``, the tracker's) that fits all measurements best, the arm as it is.

    A linear least squares start, then Gauss-Newton; ``robust`` keeps a few wrong rows from mattering, ``seed``
    chooses the subsets that are tried as starts.

    Raises:
        DegenerateError: too few measurements, or spheres on one line (with the angle).
    """
    if measurements.fixtures or measurements.reflectors:
        return _touching_fit(measurements, arm, base_fixed, robust)
    min_rows = 3 if base_fixed else 4
    if len(measurements) < min_rows:
        raise DegenerateError(f"{len(measurements)} measurements; a coarse calibration needs at least {min_rows}")
    scanner = 3 if measurements.on_tool else 6
    if scanner == 6:
        _refuse_line(measurements.scanner_mm, "scanner")
    unknowns = Unknowns(scanner, (), 0 if base_fixed else 6)
    sigmas = Sigmas(1.0, 0.0, 1.0, 1.0)
    rng = np.random.default_rng(seed)
    starts = [fixed_base_start(measurements, arm, rng)] if base_fixed else free_base_starts(measurements, arm, rng)
    best, smallest = None, np.inf
    for start in starts:
        cell, *_ = gauss_newton(start, arm, unknowns, measurements, sigmas, robust=robust, iterations=20)
        left = median_error(cell, measurements)
        if left < smallest:
            best, smallest = cell, left
        if smallest < PLAUSIBLE_MM:
            break
    assert best is not None
    return CoarseCalibration(best, _rms(residuals_of(best, measurements)))


def _touching_fit(measurements: Measurements, arm: MdhArm, base_fixed: bool, robust: bool) -> CoarseCalibration:
    """Best fit where rows touch sockets or planes, or where several reflectors sit on the tool."""
    unknowns = unknowns_for(measurements, (), base_fixed)
    cells = [touching_start(measurements, arm, base_fixed, seed) for seed in range(3)]
    best, smallest = None, np.inf
    for start in cells:
        cell, *_ = gauss_newton(
            start, arm, unknowns, measurements, Sigmas(1.0, 0.0, 1.0, 1.0), robust=robust, iterations=40
        )
        left = median_error(cell, measurements)
        if left < smallest:
            best, smallest = cell, left
    assert best is not None
    return CoarseCalibration(best, _rms(residuals_of(best, measurements)))


def coarse_start(measurements: Measurements, arm: MdhArm, base_fixed: bool = False, seed: int = 0) -> CoarseCalibration:
    """Coarse calibration to start from: the tracker's frame taken as the base where that is plausible, else both free.

    Plausible means that the nominal arm then leaves at most ``PLAUSIBLE_MM`` in the median.
    """
    if not measurements.tracked.any():
        return best_fit(measurements, arm, base_fixed=True, seed=seed)
    taken = best_fit(measurements, arm, base_fixed=True, seed=seed)
    if base_fixed or median_error(taken.cell, measurements) <= PLAUSIBLE_MM:
        return taken
    return best_fit(measurements, arm, seed=seed)


def _workpiece_frame(points: Floats, name: str) -> Floats:
    """Frame with origin o, x towards a, z normal to the triangle o, a, b."""
    o, a, b = points
    corners = [(a - o, b - o), (o - a, b - a), (o - b, a - b)]
    angle = np.degrees(min(np.nan_to_num(vector_angle(*edges)) for edges in corners))
    if angle < SMALLEST_ANGLE_DEG:
        raise DegenerateError(
            f"the three spheres in the {name} frame lie almost on one line: the triangle's smallest angle is"
            f" {angle:.2g} deg, at least {SMALLEST_ANGLE_DEG:g} deg needed; move one sphere aside"
        )
    x = (a - o) / np.linalg.norm(a - o)
    z = np.cross(x, b - o)
    z /= np.linalg.norm(z)
    return rigid(np.column_stack([x, np.cross(z, x), z]), o)


def _refuse_line(points: Floats, name: str) -> None:
    singular_values = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    angle = np.degrees(np.arctan2(singular_values[1], singular_values[0]))
    if angle < SMALLEST_ANGLE_DEG / 3:
        raise DegenerateError(
            f"the spheres in the {name} frame lie on one line within {angle:.2g} deg; the turn about it is free:"
            " let the sphere appear all over the scanner's field"
        )


def _rms(vectors: Floats) -> float:
    return float(np.sqrt((vectors**2).sum(axis=1).mean()))
