"""The cross-section of a V-groove: a plate, bent at most gently, and two walls that fall towards each other.

Fitted at every station of a seam to the cloud laid straight. In a cross-section the coordinate u runs across the seam
and the height is ``a + b u + c B(u) - d V(u)``: B is u^2 on the plate and its chord between the groove's edges, the
roof V rises from 0 at both edges to 1 at the root, which may be a flat strip; edges and root may be rounded.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from grindvision.kernels import njit
from grindvision.parallel import parallel_map
from grindvision.records import by_content
from grindvision.vision.seam.profile_fit import fit_stations
from grindvision.vision.seam.seam_curve import Strip

Floats = NDArray[np.float64]

LEVEL, TILT, BEND, DEPTH, LEFT, ROOT, RIGHT = range(7)

#: A thread of its own is worth its beginning for so many stations.
STATIONS_PER_THREAD = 100


@by_content
@dataclass(frozen=True)
class Sections:
    """Mean profiles at S stations: ``across``, ``up`` and ``weight`` (S, M) of M bins across the seam."""

    across: Floats
    up: Floats
    weight: Floats
    bin_mm: float


@dataclass(frozen=True)
class Corners:
    """What all sections of a groove share, mm: rounding of edges and of root, half width of a flat root."""

    edge_mm: float
    root_mm: float
    floor_mm: float = 0.0


@by_content
@dataclass(frozen=True)
class ProfileFit:
    """``parameters`` (S, 7): level, tilt, bend, depth, and u of left edge, root and right edge, mm.

    ``deviation`` (S, 7) are their standard deviations, ``noise_mm`` (S,) is the scatter of the profile about the fit.
    """

    parameters: Floats
    deviation: Floats
    noise_mm: Floats
    corners: Corners


def gather_sections(
    strip: Strip, stations: int, step_mm: float, reach_mm: float, bin_mm: float, window_mm: float
) -> Sections:
    """Mean profiles of a straightened cloud, one per station, over a Gaussian window along the seam."""
    bins = 2 * int(np.ceil(reach_mm / bin_mm)) + 1
    sums = _bin_sums(strip.along, strip.across, strip.up, stations, step_mm, bins, bin_mm)
    if window_mm > 0:
        sums = gaussian_filter1d(sums, window_mm / step_mm, axis=1, mode="constant", truncate=3.0)
    weight = sums[0]
    safe = np.maximum(weight, 1e-9)
    return Sections(sums[1] / safe, sums[2] / safe, np.where(weight > 1e-3, weight, 0.0), bin_mm)


def fit_profiles(
    sections: Sections, start: Floats, prior_sigma: Floats, corners: Corners, noise_mm: float
) -> ProfileFit:
    """Fit the groove's cross-section at every station.

    Damped Gauss-Newton with Huber weights and a weak normal prior that keeps what the profile does not show (an edge
    beyond the part's outline).

    Args:
        sections: the mean profiles.
        start: (S, 7) first parameters, the centre of the prior.
        prior_sigma: (7,) or (S, 7) standard deviations of the prior.
        corners: rounding and floor of the groove.
        noise_mm: expected deviation of one bin, which scales data against prior.
    """
    prior = 1 / np.broadcast_to(prior_sigma, start.shape) ** 2
    filled = sections.weight[sections.weight > 0]
    weight = np.minimum(sections.weight, 4.0 * float(np.median(filled)) if len(filled) else 0.0)
    weight = weight / max(float(weight.max()), 1e-9) / noise_mm**2
    shape = np.array([corners.edge_mm, corners.root_mm, corners.floor_mm])
    gap = corners.floor_mm + sections.bin_mm

    def fit_part(
        across: Floats, up: Floats, weight: Floats, start: Floats, prior: Floats
    ) -> tuple[Floats, Floats, Floats]:
        return fit_stations(across, up, weight, start, prior, shape, float(noise_mm), gap)

    parts = 2 if len(start) >= 2 * STATIONS_PER_THREAD else 1
    columns = (np.array_split(column, parts) for column in (sections.across, sections.up, weight, start, prior))
    fitted = zip(*parallel_map(fit_part, *columns), strict=True)
    theta, covariance, residual = (np.concatenate(halves) for halves in fitted)
    return ProfileFit(theta, covariance, residual, corners)


def profile_height(across: Floats, parameters: Floats, corners: Corners) -> Floats:
    """Height (S, M) at ``across`` (S, M) for parameters (S, 7)."""
    level, tilt, bend, depth, left, root, right = (parameters[:, k, None] for k in range(7))
    fall = _ramp(across - left, corners.edge_mm) - _ramp(across - root + corners.floor_mm, corners.root_mm)
    climb = _ramp(across - root - corners.floor_mm, corners.root_mm) - _ramp(across - right, corners.edge_mm)
    roof = fall / (root - corners.floor_mm - left) - climb / (right - root - corners.floor_mm)
    inside = (across > left) & (across < right)
    arch = np.where(inside, (left + right) * across - left * right, across**2)
    return level + tilt * across + bend * arch - depth * roof


def _ramp(x: Floats, rounding: float) -> Floats:
    """max(x, 0) with a rounded corner."""
    return (x + np.sqrt(x * x + rounding * rounding)) / 2


@njit(cache=True, nogil=True)
def _bin_sums(along: Floats, across: Floats, up: Floats, stations: int, step: float, bins: int, width: float) -> Floats:
    """Number of points and sums of their ``across`` and ``up`` (3, S, M) over the bins of every station."""
    sums = np.zeros((3, stations, bins))
    for p in range(len(along)):
        s = int(along[p] / step + 0.5)
        m = int(across[p] / width + bins / 2.0)
        if along[p] > -step / 2 and s < stations and across[p] > -width * bins / 2.0 and m < bins:
            sums[0, s, m] += 1
            sums[1, s, m] += across[p]
            sums[2, s, m] += up[p]
    return sums
