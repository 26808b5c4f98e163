"""Field calibration of a scanner on a flat plate: what the plate seems to bend is the scanner's, and is taken off."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import map_coordinates

from grindvision.errors import FileError, InputError
from grindvision.files import write_whole
from grindvision.formats.arrays import read_arrays
from grindvision.geometry import check_points
from grindvision.loose_settings import settings_in
from grindvision.parallel import one_blas_thread
from grindvision.records import by_content
from grindvision.vision.depth_calibration.grid_smoothing import fitting_stiffness, on_axes, smooth_grid, spline_matrix
from grindvision.vision.depth_calibration.plate_checks import checked_distance, parallel_planes, without_strays

Floats = NDArray[np.float64]

#: Bins along the longer side of the field, at most, and points of a plate in a bin on average, at least.
MAX_BINS = 64
POINTS_PER_BIN = 9

#: The result's grid is finer than the bins: then straight lines between its nodes follow the spline.
FINER = 2

LARGEST_NODES = 20_000_000

#: Names of the arrays of a correction's file.
FIELD_ARRAYS = ("error_grid_mm", "low", "high", "normal")


@dataclass(frozen=True)
class CalibrateFieldOptions:
    """Settings of ``calibrate_field``: ``distance_mm`` from the scanner's origin to the first plate along its normal,
    where it is known."""

    distance_mm: float | None = None


@by_content
@dataclass(frozen=True)
class FieldCorrection:
    """Depth error over the measured volume, on a regular grid of the slopes x/z and y/z and of the distance.

    ``error_grid_mm`` (U, V, D) from ``low`` (3,) to ``high`` (3,): x/z, y/z, and the distance in mm along ``normal``
    (3,), the normal of the plate that taught it, scanner frame.
    """

    error_grid_mm: Floats
    low: Floats
    high: Floats
    normal: Floats

    def error_mm(self, points: ArrayLike) -> Floats:
        """Expected depth error (N,) at measured points (N, 3), scanner frame; outside the volume as at its rim."""
        return self._interpolated(self._place(points))

    def apply(self, points: ArrayLike) -> Floats:
        """Corrected points (N, 3), each moved along its ray."""
        points = np.asarray(points, dtype=float)
        return points * (1 - self.error_mm(points) / points[:, 2])[:, None]

    def holds(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Marks the points (N, 3) inside the calibrated volume, a single plate's being without end in depth."""
        place, last = self._place(points), 3 if self.high[2] > self.low[2] else 2
        low, high = self.low[:last, None], self.high[:last, None]
        slack = 0.01 * (high - low)
        return np.asarray(((place[:last] >= low - slack) & (place[:last] <= high + slack)).all(axis=0))

    def _place(self, points: ArrayLike) -> Floats:
        points = np.asarray(points, dtype=float)
        return np.stack([points[:, 0] / points[:, 2], points[:, 1] / points[:, 2], points @ self.normal])

    def _interpolated(self, place: Floats) -> Floats:
        intervals = np.subtract(self.error_grid_mm.shape, 1)
        per_unit = intervals / np.where(intervals > 0, self.high - self.low, 1.0)
        nodes = np.clip((place - self.low[:, None]) * per_unit[:, None], 0.0, intervals[:, None])
        return np.asarray(map_coordinates(self.error_grid_mm, nodes, order=1))

    def __str__(self) -> str:
        rms = np.sqrt(np.mean(self.error_grid_mm**2))
        return f"field correction of {rms:.3f} mm rms from {self.low[2]:.0f} to {self.high[2]:.0f} mm"


@by_content
@dataclass(frozen=True)
class BinnedPlates:
    """Binned plates: depth errors (U, V, D) in mm, weights 0 to 1, nodes of the axes in mm at the ``middle_mm``."""

    error_mm: Floats
    weights: Floats
    nodes: list[Floats]
    normal: Floats
    middle_mm: float
    low: Floats
    high: Floats


@settings_in(CalibrateFieldOptions, 2, ("distance_mm",))
@one_blas_thread()
def calibrate_field(
    plates: Sequence[ArrayLike], steps_mm: Sequence[float], options: CalibrateFieldOptions | None = None
) -> FieldCorrection:
    """Learn a scanner's depth error from scans of one flat plate that was moved along its normal by known steps.

    The scans are binned over the field, and a smoothing spline over field and distance goes through the bins, as stiff
    as the data ask for. One plate shows the bend of the field at its distance; two or more also show the scale in
    depth and how the bend changes. Waves along the depth that are shorter than two steps cannot be seen.

    What flat plates cannot show: a tilt of the whole field, which looks like a tilted plate, and, without
    ``distance_mm``, one offset of all depths. The first is a rotation of the scanner frame, the second nearly a shift
    of it; a hand-eye calibration on corrected clouds takes up both. A random error of the steps stays in the correction
    in part: 0.02 mm per step gives about as much.

    Args:
        plates: clouds (N, 3) of the plate in the scanner frame, mm; each should fill the view.
        steps_mm: how much farther than the first each plate stands, along its normal; 0 for the first.
        options: the distance of the first plate, where it is known.

    Returns:
        The depth error over the measured volume of the scanner's frame, mm; ``apply`` takes it off points (N, 3).

    Raises:
        InputError: steps that do not belong to the plates, repeat, or contradict the points; plates tilted against each
            other; a distance that contradicts the points; points behind the scanner.
        DegenerateError: too few points.

    Example:
        >>> import numpy as np
        >>> from grindvision import calibrate_field
        >>> x, y = np.meshgrid(np.linspace(-90, 90, 80), np.linspace(-60, 60, 60))
        >>> steps_mm = [0.0, 20.0, 40.0]
        >>> bent = 2e-5 * (x**2 + y**2)  # what the scanner adds to every depth
        >>> plates = [np.stack([x, y, 400 + step + bent], axis=-1).reshape(-1, 3) for step in steps_mm]
        >>> field = calibrate_field(plates, steps_mm)
        >>> bool(np.ptp(field.apply(plates[1])[:, 2]) < 0.01 < 0.2 < np.ptp(plates[1][:, 2]))
        True
    """
    distance_mm = None if options is None else options.distance_mm
    binned = binned_plates(plates, steps_mm, distance_mm)
    stiffness = fitting_stiffness(binned.error_mm, binned.weights, binned.nodes)
    field = smooth_grid(binned.error_mm, binned.weights, binned.nodes, stiffness)
    at, low, high = binned.nodes[2], binned.low, binned.high
    bins = np.array([*field.shape[:2], 1 + (at[-1] - at[0]) / np.diff(binned.nodes[0]).mean()])
    fine = [
        np.linspace(start, end, int(np.ceil(FINER * count)) if end > start else 1)
        for start, end, count in zip(low, high, bins, strict=True)
    ]
    in_mm = (fine[0] * binned.middle_mm, fine[1] * binned.middle_mm, fine[2])
    grid = on_axes([spline_matrix(nodes, places) for nodes, places in zip(binned.nodes, in_mm, strict=True)], field)
    return _at_measured(FieldCorrection(grid, low, high, binned.normal), fine)


@one_blas_thread()
def held_out_rms_mm(plates: Sequence[ArrayLike], steps_mm: Sequence[float]) -> tuple[float, float]:
    """How well the other plates tell a plate: rms of its bins off flat, before and after a correction without it.

    Every plate but the nearest and the farthest is left out in turn; the noise of a bin is in both numbers.

    Raises:
        InputError: fewer than three plates, and see ``calibrate_field``.
    """
    if len(plates) < 3:
        raise InputError(f"{len(plates)} plates; to leave one out takes at least 3")
    binned = binned_plates(plates, steps_mm, None)
    stiffness = fitting_stiffness(binned.error_mm, binned.weights, binned.nodes)
    before, after = (
        float(np.sqrt(np.average(squares, weights=weight))) for squares, weight in left_out(binned, stiffness)
    )
    return before, after


def left_out(binned: BinnedPlates, stiffness: Floats) -> tuple[tuple[Floats, Floats], tuple[Floats, Floats]]:
    """Mean square (K - 2,) of each inner plate's bins, mm2, and its weight: off flat, and off a field without it."""
    before, after, weight = np.zeros((3, len(binned.nodes[2]) - 2))
    for k in range(1, len(binned.nodes[2]) - 1):
        weights = binned.weights.copy()
        weights[:, :, k] = 0.0
        left = binned.error_mm - smooth_grid(binned.error_mm, weights, binned.nodes, stiffness)
        own = binned.weights[:, :, k]
        weight[k - 1] = own.sum()
        before[k - 1] = (own * binned.error_mm[:, :, k] ** 2).sum() / own.sum()
        after[k - 1] = (own * left[:, :, k] ** 2).sum() / own.sum()
    return (before, weight), (after, weight)


def write_field(correction: FieldCorrection, path: str | Path) -> None:
    """Write a correction as a .npz file.

    Raises:
        FileError: the folder cannot be written to.
    """
    with write_whole(path) as temporary:
        np.savez_compressed(temporary, **dict(zip(FIELD_ARRAYS, astuple(correction), strict=True)))


def read_field(path: str | Path) -> FieldCorrection:
    """Read a correction that ``write_field`` wrote.

    Raises:
        FileError: missing, damaged, or no field correction.
    """
    arrays = read_arrays(path, FIELD_ARRAYS, 8 * LARGEST_NODES)
    grid, low, high, normal = (arrays[name] for name in FIELD_ARRAYS)
    shapes = grid.ndim == 3 and low.shape == high.shape == normal.shape == (3,) and grid.size > 0
    if not (shapes and all(np.isfinite(part).all() for part in (grid, low, high, normal))):
        raise FileError(f"{path}: not a field correction (shapes or numbers do not fit together); make it again")
    if (high < low).any() or low[2] <= 0 or normal[2] <= 0 or not np.isclose(np.linalg.norm(normal), 1):
        raise FileError(f"{path}: not a field correction (its volume or normal is impossible); make it again")
    return FieldCorrection(grid, low, high, normal)


def binned_plates(plates: Sequence[ArrayLike], steps_mm: Sequence[float], distance_mm: float | None) -> BinnedPlates:
    """Bin the scans of ``calibrate_field`` over the field, and say how far each bin lies off its plate.

    Raises:
        InputError, DegenerateError: see ``calibrate_field``.
    """
    steps = np.asarray(steps_mm, dtype=float)
    if len(plates) == 0 or steps.shape != (len(plates),) or len(np.unique(steps)) != len(steps):
        raise InputError(f"{len(plates)} plates need as many different steps, got {steps.tolist()}")
    order = np.argsort(steps)
    clouds = [without_strays(check_points(plates[k], f"points of plate {k + 1}", min_points=100), k + 1) for k in order]
    slopes = [cloud[:, :2] / cloud[:, 2:] for cloud in clouds]
    low = np.min([part.min(axis=0) for part in slopes], axis=0)
    high = np.max([part.max(axis=0) for part in slopes], axis=0)
    fewest = min(len(cloud) for cloud in clouds)
    side = max(np.sqrt(np.prod(high - low) * POINTS_PER_BIN / fewest), (high - low).max() / MAX_BINS)
    shape = np.maximum(np.rint((high - low) / side), 3).astype(int)
    bins = [_bin_means(part, cloud[:, 2], low, high, shape) for part, cloud in zip(slopes, clouds, strict=True)]
    counts, rays, depths = (np.stack(parts) for parts in zip(*bins, strict=True))
    seen = counts > 0
    normal, offset = parallel_planes(rays * depths[..., None], seen, steps[order], order)
    first = checked_distance(distance_mm, offset)
    at = first + steps[order]
    error = np.where(seen, depths - at[:, None] / np.where(seen, rays @ normal, 1.0), 0.0)
    middle = float(at.mean())
    axes = [start + (np.arange(n) + 0.5) * (end - start) / n for n, start, end in zip(shape, low, high, strict=True)]
    weights = np.minimum(counts / np.median(counts[seen]), 1.0)
    error, weights = (np.moveaxis(part.reshape(len(at), *shape), 0, 2) for part in (error, weights))
    return BinnedPlates(
        error,
        weights,
        [axes[0] * middle, axes[1] * middle, at],
        normal,
        middle,
        np.append(low, at[0]),
        np.append(high, at[-1]),
    )


def _bin_means(
    slopes: Floats, depths: Floats, low: Floats, high: Floats, shape: NDArray[np.int64]
) -> tuple[NDArray[np.int64], Floats, Floats]:
    """Count (B,), mean ray (B, 3) with z = 1 and mean depth (B,) of the points in each bin of the field."""
    cell = np.minimum((slopes - low) / (high - low) * shape, shape - 1).astype(int)
    flat, bins = cell[:, 0] * shape[1] + cell[:, 1], int(np.prod(shape))
    counts = np.bincount(flat, minlength=bins)
    u, v, z = (
        np.bincount(flat, part, minlength=bins) / np.maximum(counts, 1) for part in (slopes[:, 0], slopes[:, 1], depths)
    )
    return counts, np.column_stack([u, v, np.ones(bins)]), z


def _at_measured(true: FieldCorrection, fine: Sequence[Floats]) -> FieldCorrection:
    """The correction as a function of the measured place, from one as a function of the true place."""
    place = np.stack(np.meshgrid(*fine, indexing="ij")).reshape(3, -1)
    along = place[0] * true.normal[0] + place[1] * true.normal[1] + true.normal[2]
    error = true.error_grid_mm.ravel()
    for _ in range(2):
        error = true._interpolated(np.stack([place[0], place[1], place[2] - error * along]))
    return FieldCorrection(error.reshape(true.error_grid_mm.shape), true.low, true.high, true.normal)
