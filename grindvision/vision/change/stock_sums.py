"""Volume, area and heights of a piece of stock from its height map, each with its standard deviation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, distance_transform_edt, uniform_filter

from grindvision.geometry.height_map import HeightMap
from grindvision.vision.change.height_maps import MeasuredHeights
from grindvision.vision.change.local_datum import LocalDatum

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

FLAT = 1 / np.sqrt(12)
"""Standard deviation of what is known to lie between nothing and one, and no better."""


def piece_sums(
    filled: HeightMap,
    inside: Flags,
    hidden: Flags,
    datum: LocalDatum,
    level_mm: float,
    sigma: Floats,
    sampling_mm6: float,
) -> dict[str, float]:
    """Volume, area, greatest and mean height of a piece, each with its standard deviation."""
    heights = np.where(inside, np.nan_to_num(filled.heights_mm), 0.0)
    areas = np.where(inside, filled.areas_mm2, 0.0)
    opening = _opening(filled)
    volume = float((areas * (heights + 0.5 * opening * heights**2)).sum())
    common = np.einsum("kij,ij->k", datum.terms, areas)
    noise = datum.noise.of_sums(areas[None])[0, 0]
    unseen = FLAT * float((areas * np.abs(heights))[hidden].sum())
    variance = float(common @ datum.covariance @ common) + noise + unseen**2 + sampling_mm6
    above = inside & (heights > level_mm)
    spread = np.nan_to_num(np.sqrt(datum.variances_mm2))
    more, less = (float(areas[inside & (heights > level_mm + sign * spread)].sum()) for sign in (-1, 1))
    rim = binary_dilation(above) & ~above
    jitter = float(areas[rim].mean() * np.sqrt(rim.sum()) / 2) if rim.any() else 0.0
    top = int(heights.argmax())
    area = float(areas[above].sum())
    mean = float((areas * heights)[above].sum()) / area if area else 0.0
    over = datum.noise.of_sums(np.where(above, areas, 0.0)[None])[0, 0] / max(area, 1e-12) ** 2
    mean_datum = float(datum.variances_mm2[above].mean()) if area else 0.0
    return {
        "volume_mm3": volume,
        "volume_sigma_mm3": float(np.sqrt(variance)),
        "area_mm2": area,
        "area_sigma_mm2": float(np.hypot((more - less) / 2, jitter)),
        "height_max_mm": float(heights.ravel()[top]),
        "height_max_sigma_mm": float(np.nan_to_num(sigma.ravel()[top])),
        "height_mean_mm": mean,
        "height_mean_sigma_mm": float(np.sqrt(over + mean_datum)),
    }


def sampling_variance(measured: MeasuredHeights, filled: HeightMap, inside: Flags, usual_square: float) -> float:
    """Variance in mm^6 of a volume because the points are few where heights bend more than the nodes can follow."""
    used = inside & (measured.counts > 0)
    excess = np.maximum(measured.squares_mm2 - usual_square, 0.0)
    return float((filled.areas_mm2**2 * excess / np.maximum(measured.counts, 1.0))[used].sum())


def _opening(filled: HeightMap) -> Floats:
    """How fast (R, C), per mm of height, an area grows along the normals: the divergence of the ground's normals."""
    normals = np.where(np.isfinite(filled.normals), filled.normals, 0.0)
    size = max(3, round(3.0 / filled.spacing_mm))
    x, y = (uniform_filter(normals[..., axis], size) for axis in (0, 1))
    return np.asarray((np.gradient(x, axis=0) + np.gradient(y, axis=1)) / filled.spacing_mm)


def bridged_heights(heights: Floats, inside: Flags) -> Floats:
    """Heights (R, C) with those that are not shown taken from around them: linearly, beyond all that is shown the
    nearest."""
    from scipy.interpolate import LinearNDInterpolator

    known = np.isfinite(heights)
    if known.sum() < 4:
        return np.where(known, heights, 0.0)
    wanted = inside & ~known
    near = known & binary_dilation(wanted, iterations=3)
    near = near if near.sum() >= 4 else known
    nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
    bridged = np.where(known, heights, heights[tuple(nearest)])
    places = np.argwhere(near)
    if np.ptp(places, axis=0).min() > 0:
        linear = LinearNDInterpolator(places, heights[near])(np.argwhere(wanted))
        bridged[wanted] = np.where(np.isfinite(linear), linear, bridged[wanted])
    return bridged
