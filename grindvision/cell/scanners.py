"""Virtual scanners: a structured-light scanner like the EinScan-Pro and a depth camera like the RealSense D415.

The scanner frame has its origin in the camera's pinhole, z forward, x along the pixel columns towards the projector (or
second camera) at ``baseline_mm``. Every error moves a point along the ray of its pixel, as triangulation does.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.cell.rays import Target
from grindvision.cell.scan import NO_SURFACE, Scan, Sighting
from grindvision.cell.scanner_errors import ScannerErrors, distortion
from grindvision.cell.scanner_pixels import correlated, depth_steps, directions, moved, seen
from grindvision.errors import InputError, SightError
from grindvision.geometry import check_rigid, inverse, move_points

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class Scanner:
    """A pinhole camera with a projector (or second camera) at ``baseline_mm`` along x.

    ``serial`` draws what is wrong with this one instrument: the same distortion and scale in every scan it makes.
    """

    columns: int
    rows: int
    focal_px: float
    baseline_mm: float
    near_mm: float
    far_mm: float
    reference_mm: float
    errors: ScannerErrors
    serial: int = 1

    def __post_init__(self) -> None:
        for name in ("columns", "rows", "focal_px", "baseline_mm", "near_mm"):
            if not getattr(self, name) > 0:
                raise InputError(f"scanner: {name} is {getattr(self, name)}; it must be above zero")
        if not self.near_mm < self.reference_mm < self.far_mm:
            raise InputError(
                f"scanner: the range {self.near_mm} to {self.far_mm} mm must hold the reference distance"
                f" {self.reference_mm} mm"
            )

    def with_errors(self, errors: ScannerErrors) -> Scanner:
        """Return the same instrument with another error budget."""
        return replace(self, errors=errors)

    def with_serial(self, serial: int) -> Scanner:
        """Return another instrument of the same type."""
        return replace(self, serial=serial)

    @property
    def half_field_mm(self) -> Floats:
        """Half width and height (2,) of the field of view at the reference distance."""
        return np.array([self.columns, self.rows]) / 2 / self.focal_px * self.reference_mm

    def rays(self, pixels: ArrayLike) -> Floats:
        """Directions (N, 3) with z = 1 of pixels (N, 2), in the scanner frame."""
        pixels = np.asarray(pixels)
        rays = np.ones((len(pixels), 3))
        rays[:, 0] = (pixels[:, 0] - (self.columns - 1) / 2) / self.focal_px
        rays[:, 1] = (pixels[:, 1] - (self.rows - 1) / 2) / self.focal_px
        return rays

    def mm_per_px(self, z_mm: ArrayLike) -> Floats:
        """Depth error per pixel of disparity error, z^2 / (f b), at depths ``z_mm``."""
        return np.asarray(z_mm, dtype=float) ** 2 / (self.focal_px * self.baseline_mm)

    def systematic_mm(self, points: ArrayLike) -> Floats:
        """Depth error (N,) that this instrument always makes at points (N, 3) of its frame: distortion and scale."""
        points = np.asarray(points, dtype=float)
        instrument = np.random.default_rng([self.serial, 20180913])
        scale = self.errors.scale * instrument.standard_normal()
        bent = distortion(points, self.errors, self.half_field_mm, self.reference_mm, instrument)
        return scale * points[:, 2] + bent

    def sight(
        self,
        target: Target,
        T_world_scanner: ArrayLike,
        every: int = 1,
        window: tuple[int, int, int, int] | None = None,
    ) -> Sighting:
        """Trace the rays of every ``every``-th pixel, or of those in ``window`` (first and last column, row).

        Raises:
            SightError: no ray meets the target, or none within ``near_mm``..``far_mm``. NotRigidError: the pose.
        """
        pose = check_rigid(T_world_scanner, "T_world_scanner")
        if every < 1:
            raise InputError(f"every is {every}; use 1 for all pixels, 2 for every second one")
        left, right, top, bottom = window or (0, self.columns - 1, 0, self.rows - 1)
        u = np.arange(max(left, 0), min(right, self.columns - 1) + 1, every)
        v = np.arange(max(top, 0), min(bottom, self.rows - 1) + 1, every)
        x = self.rays(np.column_stack([u, np.zeros_like(u)]))[:, 0]
        y = self.rays(np.column_stack([np.zeros_like(v), v]))[:, 1]
        columns, rows = _around(target.box_mm, pose, x, y)
        hits = target.cast(pose[:3, 3], directions(x[columns], y[rows], pose[:3, :3]))
        inside = (hits.distance >= self.near_mm) & (hits.distance <= self.far_mm)
        if not inside.any():
            if len(hits.ray) == 0:
                raise SightError("the scanner sees nothing: no ray meets the part; turn the scanner towards it")
            raise SightError(
                f"the part lies {hits.distance.min():.0f} to {hits.distance.max():.0f} mm from the scanner, outside its"
                f" measuring range of {self.near_mm:.0f} to {self.far_mm:.0f} mm; move the scanner"
            )
        ray, z, triangle = hits.ray[inside], hits.distance[inside], hits.triangle[inside]
        facing = target.normals.take(triangle, axis=0)
        pixels, points, normals, incidence_rad = seen(
            ray, z, facing, x[columns], y[rows], pose[:3, :3], self.baseline_mm
        )
        pixels += [columns.start, rows.start]
        projector = np.array([self.baseline_mm, 0, 0])
        return Sighting(
            pixels,
            (len(v), len(u)),
            every,
            points,
            normals,
            target.solid.surface_id[triangle],
            target.solid.surfaces,
            target.sees(move_points(pose, points), facing, move_points(pose, projector)),
            incidence_rad,
            pose,
        )

    def measure(self, sighting: Sighting, rng: np.random.Generator) -> Scan:
        """Add this instrument's errors to what it sees.

        Raises:
            SightError: shadow and grazing angles leave no point.
        """
        errors = self.errors
        lost = np.zeros(len(sighting.points), dtype=bool)
        if errors.shadow:
            lost |= ~sighting.in_light
        if errors.grazing_deg is not None:
            lost |= sighting.incidence_rad > np.radians(errors.grazing_deg)
        kept = np.flatnonzero(~lost)
        if len(kept) == 0:
            raise SightError("the scanner sees nothing: all points lie in shadow or at grazing angles; turn it")
        pixels, surface_id = sighting.pixels[kept], sighting.surface_id[kept]
        true_points, normals = sighting.points[kept], sighting.normals[kept]
        z = true_points[:, 2].copy()
        # drawn for all pixels: one that just meets an edge, or just not, changes none of the others
        shape, at = sighting.grid_shape, pixels[:, 1] * sighting.grid_shape[1] + pixels[:, 0]
        if errors.mixed_pixels:
            mixed = self._mix(z, pixels, shape, at, rng)
            surface_id = np.where(mixed, NO_SURFACE, surface_id)
        disparity = np.zeros(len(z))
        if errors.triangulation_px:
            disparity += errors.triangulation_px * rng.standard_normal(shape).take(at)
        if errors.correlated_px:
            noise = correlated(shape, errors.correlation_length_px / sighting.every, rng)
            disparity += errors.correlated_px * noise.take(at)
        white = errors.white_mm * rng.standard_normal(shape).take(at) if errors.white_mm else np.zeros(len(z))
        off = self.systematic_mm(true_points * (z / true_points[:, 2])[:, None]) + self.mm_per_px(z) * disparity
        product = self.focal_px * self.baseline_mm
        return Scan(
            moved(true_points, z, off, white, product, errors.disparity_step_px),
            pixels,
            sighting.grid_shape,
            true_points,
            normals,
            surface_id,
            sighting.surfaces,
            sighting.T_world_scanner,
        )

    def scan(self, target: Target, T_world_scanner: ArrayLike, rng: np.random.Generator, every: int = 1) -> Scan:
        """See and measure in one go.

        Raises:
            SightError: the pose shows nothing, or nothing in range.
        """
        return self.measure(self.sight(target, T_world_scanner, every), rng)

    def _mix(
        self, z: Floats, pixels: Integers, shape: tuple[int, int], at: Integers, rng: np.random.Generator
    ) -> Flags:
        """Move some pixels at depth edges, in place, part of the way to the neighbour's depth; mark them.

        ``at`` (N,) are the places of ``pixels`` (N, 2) in a grid of ``shape``, row by row.
        """
        step = depth_steps(z, pixels, shape)
        edge = np.abs(step) > self.errors.edge_mm
        mixed = edge & (rng.random(shape).take(at) < self.errors.mixed_pixels)
        z[mixed] += rng.random(shape).take(at[mixed]) * step[mixed]
        return mixed


@dataclass(frozen=True)
class StructuredLightScanner(Scanner):
    """EinScan-Pro as diao2018 gives it: 350-450 mm, 210 x 150 mm at 400 mm, 0.05 mm single-shot accuracy.

    Point distance 0.2 mm. The split over the error sources and the 100 mm baseline are our choice: 0.03 mm random and
    0.045 mm distortion make 0.055 mm rms in all, so that the heights of Table 1 are no stroke of bad luck.
    """

    columns: int = 1050
    rows: int = 750
    focal_px: float = 2000.0
    baseline_mm: float = 100.0
    near_mm: float = 350.0
    far_mm: float = 450.0
    reference_mm: float = 400.0
    errors: ScannerErrors = field(
        default=ScannerErrors(
            white_mm=0.02,
            triangulation_px=0.02,
            correlated_px=0.025,
            correlation_length_px=4.0,
            distortion_mm=0.045,
            distortion_length_mm=70.0,
            scale=2e-4,
            grazing_deg=75.0,
            shadow=True,
            mixed_pixels=0.05,
        )
    )


@dataclass(frozen=True)
class DepthCamera(Scanner):
    """RealSense D415: 1280 x 720 pixels, stereo over 55 mm, disparity noise of 0.08 px in all.

    Of it 0.05 px are white and 0.06 px correlated over neighbouring pixels; on top comes a slow waviness that stays the
    same from frame to frame, 0.4 mm rms at 450 mm. Disparity comes in steps of 1/32 px.
    """

    columns: int = 1280
    rows: int = 720
    focal_px: float = 1005.0
    baseline_mm: float = 55.0
    near_mm: float = 300.0
    far_mm: float = 1000.0
    reference_mm: float = 450.0
    errors: ScannerErrors = field(
        default=ScannerErrors(
            triangulation_px=0.05,
            correlated_px=0.06,
            correlation_length_px=3.0,
            distortion_mm=0.4,
            distortion_length_mm=30.0,
            scale=1e-3,
            grazing_deg=80.0,
            shadow=True,
            mixed_pixels=0.3,
            disparity_step_px=1 / 32,
        )
    )


def _around(box_mm: Floats, T_world_scanner: Floats, x: Floats, y: Floats) -> tuple[slice, slice]:
    """Columns and rows whose rays may meet a box with corners (8, 3), one more to each side; all when it is behind.

    ``x`` (C,) and ``y`` (R,) are the rays' first two components where the third is one.
    """
    corners = move_points(inverse(T_world_scanner), box_mm)
    if corners[:, 2].min() <= 0:
        return slice(0, len(x)), slice(0, len(y))
    image = corners[:, :2] / corners[:, 2:]
    bounds = zip((x, y), image.min(axis=0), image.max(axis=0), strict=True)
    columns, rows = (
        slice(max(int(np.searchsorted(at, low)) - 1, 0), int(np.searchsorted(at, high)) + 1) for at, low, high in bounds
    )
    return columns, rows
