"""The tracker's sphere on its nest, and how the robot's scanner measures its centre."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.cell.arms import GrindingRobot
from grindvision.cell.rays import Target
from grindvision.cell.scan import Scan
from grindvision.cell.scanners import Scanner
from grindvision.cell.solids import Shape, Solid
from grindvision.errors import DegenerateError, SightError
from grindvision.extras import extra
from grindvision.geometry import SphereFit, inverse, move_points, rigid
from grindvision.geometry.ransac import ransac_sphere
from grindvision.kernels import njit
from grindvision.records import by_content

with extra("sim"):
    import manifold3d as m3

Floats = NDArray[np.float64]

SPHERE_RADIUS_MM = 19.05
NEST_RADIUS_MM = 12.5

#: Points farther than this from the sphere's surface do not belong to it; six times the scanner's 0.05 mm.
SPHERE_TOLERANCE_MM = 0.3

#: Depressions of the sphere's surface seen from its centre that the nest leaves free: cosine against straight down.
NEST_COSINE = np.sqrt(1 - (NEST_RADIUS_MM / SPHERE_RADIUS_MM) ** 2)


def sphere_on_nest() -> Solid:
    """Tracker sphere (38.1 mm diameter), centre at the origin, on a magnetic nest below; surfaces sphere and nest.

    The mesh deviates from the sphere by about 1 um.
    """
    radius, rim = SPHERE_RADIUS_MM, NEST_RADIUS_MM
    sphere = Shape.named(m3.Manifold.sphere(radius + 0.0017, 320), "sphere")
    seat = -radius * NEST_COSINE
    pillar = m3.Manifold.cylinder(radius, rim, circular_segments=96).translate([0, 0, seat - radius + 0.2])
    foot = m3.Manifold.cylinder(6.0, 2 * rim, circular_segments=96).translate([0, 0, seat - radius - 5.8])
    return (sphere + (Shape.named(pillar + foot, "nest") - sphere)).solid()


@lru_cache(maxsize=1)
def _sphere_target() -> Target:
    return Target(sphere_on_nest())


def scan_sphere(
    robot: GrindingRobot, q_rad: ArrayLike, centre_base_mm: ArrayLike, rng: np.random.Generator, every: int = 1
) -> Scan:
    """Move the true arm and scan the sphere on its nest; only the pixels around its image are read.

    Args:
        robot: arm, scanner and their truth.
        q_rad: commanded joint angles (4,).
        centre_base_mm: true sphere centre (3,) in the base frame; the nest stands upright below it.
        rng: joint and scanner noise.
        every: pixel step.

    Raises:
        SightError: the sphere is outside the field of view or of the measuring range.

    The scan's world frame is the sphere's: its origin in the centre, its axes those of the base.
    """
    T_base_scanner = robot.move(q_rad, rng)
    T_sphere_scanner = inverse(rigid(translation_mm=centre_base_mm)) @ T_base_scanner
    centre = move_points(inverse(T_base_scanner), centre_base_mm)
    if not centre[2] > 2 * SPHERE_RADIUS_MM:
        raise SightError(f"the sphere lies {centre[2]:.0f} mm in front of the scanner; turn the scanner towards it")
    scanner = robot.scanner
    u, v = centre[:2] / centre[2] * scanner.focal_px + [(scanner.columns - 1) / 2, (scanner.rows - 1) / 2]
    reach = 1.5 * SPHERE_RADIUS_MM / centre[2] * scanner.focal_px
    if not (-reach < u < scanner.columns + reach and -reach < v < scanner.rows + reach):
        raise SightError(
            f"the sphere's image lies at column {u:.0f}, row {v:.0f}, outside the image; turn the scanner towards it"
        )
    window = (int(u - reach), int(u + reach), int(v - reach), int(v + reach))
    return scanner.measure(scanner.sight(_sphere_target(), T_sphere_scanner, every, window), rng)


@by_content
@dataclass(frozen=True)
class SphereMeasurement:
    """``centre_mm`` (3,) as fitted in the scanner frame, and the truth: ``T_base_scanner`` (4, 4) after the move."""

    centre_mm: Floats
    fit: SphereFit
    T_base_scanner: Floats

    def __str__(self) -> str:
        return str(self.fit)


def measure_sphere(
    robot: GrindingRobot, q_rad: ArrayLike, centre_base_mm: ArrayLike, rng: np.random.Generator, every: int = 1
) -> SphereMeasurement:
    """Sphere centre in the scanner frame, the whole way: move, scan, cut the nest away, fit with the radius known.

    Arguments as ``scan_sphere``. RANSAC keeps what lies within 0.3 mm of a sphere of 19.05 mm radius, so the nest and
    mixed pixels fall away.

    Raises:
        SightError: the sphere is out of sight. DegenerateError: too little of it was seen.
    """
    scan = scan_sphere(robot, q_rad, centre_base_mm, rng, every)
    if len(scan) < 50:
        raise DegenerateError(f"only {len(scan)} points of the sphere were seen; choose another direction")
    fit = ransac_sphere(scan.points, SPHERE_TOLERANCE_MM, rng, SPHERE_RADIUS_MM)
    return SphereMeasurement(fit.centre_mm, fit, rigid(translation_mm=centre_base_mm) @ scan.T_world_scanner)


def sphere_centre_errors(
    scanner: Scanner, centres_mm: ArrayLike, down: ArrayLike, rng: np.random.Generator, across: int = 24
) -> Floats:
    """Errors (K, 3) of measured sphere centres to first order: the fast twin of ``measure_sphere`` for many trials.

    The seen cap of each sphere is sampled at ``across`` x ``across`` points; the instrument's distortion and scale are
    exact there, its random errors have the standard deviation that the scan's many more pixels leave. A least squares
    fit with known radius is then linear in the errors. Mixed pixels and disparity steps are left out, and no point is
    missing at random. Against ``measure_sphere`` the systematic part agrees to about a micrometre (see the tests).

    Args:
        scanner: the instrument.
        centres_mm: true centres (K, 3) in the scanner frame.
        down: direction (K, 3) of the nest in the scanner frame, unit.
        rng: random errors.
        across: sample points across the sphere's image.

    Raises:
        DegenerateError: so little of a sphere is seen that its centre is free.
    """
    centres, down = np.ascontiguousarray(centres_mm, dtype=float), np.ascontiguousarray(down, dtype=float)
    grid = (np.arange(across) + 0.5) / across * 2 - 1
    a, b = (part.ravel() for part in np.meshgrid(grid, grid))
    disc = np.column_stack([a, b])[a**2 + b**2 < 1]
    errors = scanner.errors
    min_cosine = 0.0 if errors.grazing_deg is None else np.cos(np.radians(errors.grazing_deg))
    points, normals, seen = _caps(centres, down, disc, scanner.baseline_mm, float(min_cosine))
    systematic = scanner.systematic_mm(points.reshape(-1, 3)).reshape(seen.shape)
    z = points[:, :, 2]
    pixels = np.pi * (SPHERE_RADIUS_MM * scanner.focal_px / z) ** 2
    smoothed = max(4 * np.pi * errors.correlation_length_px**2, 1.0)
    disparity = np.sqrt(errors.triangulation_px**2 + smoothed * errors.correlated_px**2)
    sigma = np.hypot(errors.white_mm, scanner.mm_per_px(z) * disparity) * np.sqrt(len(disc) / pixels)
    system, right = _centre_equations(points, normals, seen, systematic + sigma * rng.standard_normal(seen.shape))
    if np.linalg.cond(system).max() > 1e6:
        raise DegenerateError("too little of a sphere is seen to locate its centre; choose another direction")
    moved = np.linalg.solve(system, right[:, :, None])[:, :, 0]
    return np.asarray(moved, dtype=float)


@njit(cache=True)
def _caps(
    centres: Floats, down: Floats, disc: Floats, baseline_mm: float, min_cosine: float
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Points (K, N, 3) of spheres under places (N, 2) of their images, in radii, the normals there, and which of them
    are seen: above the nest, and not too obliquely by camera and projector."""
    shape = len(centres), len(disc)
    points, normals, seen = np.empty((*shape, 3)), np.empty((*shape, 3)), np.empty(shape, np.bool_)
    for k in range(shape[0]):
        centre = centres[k]
        away = np.sqrt(centre[0] ** 2 + centre[1] ** 2 + centre[2] ** 2)
        view = centre / away
        # across the view and the image's y axis, and across both
        length = np.sqrt(view[0] ** 2 + view[2] ** 2)
        side = np.array([-view[2] / length, 0.0, view[0] / length])
        up = np.array([view[1] * side[2], view[2] * side[0] - view[0] * side[2], -view[1] * side[0]])
        # the image of a near sphere is bounded by the cone of tangent rays, a little in front of the great circle
        rim = 1 - (SPHERE_RADIUS_MM / away) ** 2
        for n in range(shape[1]):
            a, b = disc[n]
            depth = np.sqrt(1 - rim * (a * a + b * b))
            below = to_camera = to_projector = way_camera = way_projector = 0.0
            for axis in range(3):
                normal = np.sqrt(rim) * (a * side[axis] + b * up[axis]) - depth * view[axis]
                point = centre[axis] + SPHERE_RADIUS_MM * normal
                points[k, n, axis], normals[k, n, axis] = point, normal
                projector = (baseline_mm if axis == 0 else 0.0) - point
                below += normal * down[k, axis]
                to_camera -= point * normal
                way_camera += point * point
                to_projector += projector * normal
                way_projector += projector * projector
            seen[k, n] = (
                below < NEST_COSINE
                and to_camera > min_cosine * np.sqrt(way_camera)
                and to_projector > min_cosine * np.sqrt(way_projector)
            )
    return points, normals, seen


@njit(cache=True)
def _centre_equations(points: Floats, normals: Floats, seen: NDArray[np.bool_], error: Floats) -> tuple[Floats, Floats]:
    """Matrices (K, 3, 3) and right sides (K, 3) of the least squares for how far errors (K, N) of the depths of those
    points that are seen move the centres."""
    system, right = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
    for k in range(len(points)):
        for n in range(points.shape[1]):
            if not seen[k, n]:
                continue
            normal, point = normals[k, n], points[k, n]
            along = (normal[0] * point[0] + normal[1] * point[1] + normal[2] * point[2]) / point[2] * error[k, n]
            for i in range(3):
                right[k, i] += normal[i] * along
                for j in range(3):
                    system[k, i, j] += normal[i] * normal[j]
    return system, right


def nest_directions(T_base_scanner: ArrayLike) -> Floats:
    """Downward direction (K, 3) in the scanner frames of poses (K, 4, 4)."""
    return -np.asarray(T_base_scanner, dtype=float)[:, 2, :3]
