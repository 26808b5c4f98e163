"""How exact a field correction is all over its volume, between the plates and in the holes of their scans too."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import InputError
from grindvision.parallel import one_blas_thread
from grindvision.records import by_content
from grindvision.vision.depth_calibration.field_correction import binned_plates, left_out
from grindvision.vision.depth_calibration.grid_smoothing import (
    draw_deviations,
    fitting_stiffness,
    freedom_left,
    on_axes,
    smooth_grid,
    spline_matrix,
)

Floats = NDArray[np.float64]

#: Fields drawn: the rms of so many is known to 9 %, that over the volume far better.
DRAWS = 60

#: Places between two neighbouring plates at which the error is predicted, the second plate's own included.
BETWEEN = 3


@by_content
@dataclass(frozen=True)
class PredictedFieldErrors:
    """Depth error in mm, rms, that a correction is expected to leave: ``rms_mm`` (U, V, E) on a grid over its volume.

    ``slopes`` are x/z (U,) and y/z (V,) of the grid, ``distances_mm`` (E,) its distances along the plate's normal.
    Noise of a single point of a later scan comes on top, and whatever the plates' steps and tilts hide.
    """

    rms_mm: Floats
    slopes: tuple[Floats, Floats]
    distances_mm: Floats

    @property
    def mean_mm(self) -> float:
        """Root mean square over the volume."""
        return float(np.sqrt((self.rms_mm**2).mean()))

    @property
    def p95_mm(self) -> float:
        """What 95 % of the volume stay below."""
        return float(np.quantile(self.rms_mm, 0.95))

    @property
    def worst(self) -> tuple[float, Floats]:
        """The largest error in mm, and the point (3,) of the scanner's frame, mm, that it is expected at."""
        u, v, e = np.unravel_index(int(np.argmax(self.rms_mm)), self.rms_mm.shape)
        distance = self.distances_mm[e]
        return float(self.rms_mm[u, v, e]), distance * np.array([self.slopes[0][u], self.slopes[1][v], 1.0])

    def as_numbers(self) -> dict[str, object]:
        """What report.json says."""
        largest, place = self.worst
        return {"rms": self.mean_mm, "p95": self.p95_mm, "largest": largest, "largest_at_mm": place}

    def __str__(self) -> str:
        largest, place = self.worst
        x, y, z = place
        return (
            f"predicted over the volume, {self.distances_mm[0]:.0f} to {self.distances_mm[-1]:.0f} mm:"
            f" {self.mean_mm:.3f} mm rms (95 % below {self.p95_mm:.3f}, largest {largest:.3f} at x {x:.0f}, y {y:.0f},"
            f" z {z:.0f} mm), if the plates stand as said"
        )


@one_blas_thread()
def predict_field_errors(
    plates: Sequence[ArrayLike], steps_mm: Sequence[float], rng: np.random.Generator, draws: int = DRAWS
) -> PredictedFieldErrors:
    """Predict what ``calibrate_field`` leaves of a scanner's depth error all over the volume, from the scans alone.

    Three parts, each seen in the scans: noise is what the bins of the plates leave beside the field; how far the field
    may be off at the plates with such noise, in holes too, follows from draws of it; how much it bends between two
    plates is told by plates that took no part. Fields whose second derivative along the distance is white noise bend by
    a variance of h^3 t^3 (1 - t)^3 at the fraction t of a gap h, times what the plates left out show.

    Args:
        plates, steps_mm: as ``calibrate_field`` takes them.
        rng: draws the fields.
        draws: how many.

    Raises:
        InputError: fewer than three plates, which cannot tell what lies between them. See also ``calibrate_field``.
    """
    if len(plates) < 3:
        raise InputError(f"{len(plates)} plates; what lies between plates takes at least 3 to tell")
    binned = binned_plates(plates, steps_mm, None)
    stiffness = fitting_stiffness(binned.error_mm, binned.weights, binned.nodes)
    field = smooth_grid(binned.error_mm, binned.weights, binned.nodes, stiffness)
    squares = float((binned.weights * (binned.error_mm - field) ** 2).sum())
    variance = squares / max(freedom_left(binned.weights, binned.nodes, stiffness), 1.0)
    at = binned.nodes[2]
    parts = np.arange(BETWEEN * (len(at) - 1) + 1) / BETWEEN
    places = np.interp(parts, np.arange(len(at)), at)
    across = [np.eye(len(axis)) for axis in binned.nodes[:2]]
    along = spline_matrix(at, places)
    square = np.zeros((*field.shape[:2], len(places)))
    for draw in draw_deviations(binned.weights, binned.nodes, stiffness, draws, rng):
        square += on_axes([*across, along], draw) ** 2 / draws
    _, (after, weight) = left_out(binned, stiffness)
    gaps = np.diff(at)
    spans = at[2:] - at[:-2]
    shapes = _bend(spans, gaps[:-1] / spans)
    own = square[:, :, BETWEEN:-1:BETWEEN].mean(axis=(0, 1))
    excess = after - variance * (1 + own)
    bends = max(float((weight * excess * shapes).sum() / (weight * shapes**2).sum()), 0.0)
    square = variance * square + bends * _bend(np.append(gaps, 0.0)[np.floor(parts).astype(int)], parts % 1.0)
    middle = binned.middle_mm
    return PredictedFieldErrors(np.sqrt(square), (binned.nodes[0] / middle, binned.nodes[1] / middle), places)


def _bend(gap_mm: Floats, fraction: Floats) -> Floats:
    return (gap_mm * fraction * (1 - fraction)) ** 3
