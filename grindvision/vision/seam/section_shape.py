"""The shape of a groove's cross-section, read from all its points at once: where its walls meet, and on what floor.

Sections fitted station by station give heights over places: an upright wall, which stands at one place with all
heights, spoils them. Here all points of a groove are laid over each other, relative to its edges, and a chain of
straight lines is fitted to them by the points' distances: surface, wall, floor (if there is one), wall, surface.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial import cKDTree

from grindvision.geometry import unit_vectors
from grindvision.records import by_content
from grindvision.vision.seam.groove_lines import DetectedGroove
from grindvision.vision.seam.seam_smoothing import MAD_TO_STD

Floats = NDArray[np.float64]

#: So many points tell the shape; they are looked at so far to both sides of the middle, in widths.
POINTS_FITTED, REACH_WIDTHS = 2500, 1.0
#: Places of the walls' feet from which the fits begin, in widths from the left edge.
SHARP_STARTS, FLOOR_STARTS = (0.03, 0.5, 0.97), ((0.03, 0.2), (0.4, 0.6), (0.8, 0.97))
#: Distances beyond this fraction of the depth, or so many times the usual one, count little: spatter, flying pixels.
SOFT_DEPTHS, SOFT_DEVIATIONS = 0.04, 2.0
#: Errors of neighbouring points are alike over so many points to each side, so that only one of so many tells.
ALIKE = 9
#: A floor is believed at this logarithm of the ratio of likelihoods, and where it is so wide in widths and spacings.
MIN_LOG_RATIO, MIN_FLOOR_WIDTHS, MIN_FLOOR_SPACINGS = 5.0, 0.08, 1.0
#: Steps of the numerical derivatives, relative; evaluations of a fit at most.
STEP, MAX_EVALUATIONS = 1e-4, 30


@by_content
@dataclass(frozen=True)
class SectionShape:
    """A cross-section: places across in mm from the middle between the groove's edges, heights from there.

    ``edges_mm`` (2,) and ``feet_mm`` (2,) are where the walls begin and end; both feet are one in a sharp root.
    ``level_mm`` is the surface's height, ``depth_mm`` the feet's below it. ``misfit_mm`` is the scatter of the points
    about it, and ``floor_log_ratio`` by how much the logarithm of the likelihood of a floor exceeds that of a sharp
    root.
    """

    edges_mm: Floats
    feet_mm: Floats
    level_mm: float
    depth_mm: float
    misfit_mm: float
    floor_log_ratio: float

    @property
    def width_mm(self) -> float:
        """Distance of the edges."""
        return float(self.edges_mm[1] - self.edges_mm[0])

    @property
    def floor_fraction(self) -> float:
        """How much of the width the floor takes."""
        return float(self.feet_mm[1] - self.feet_mm[0]) / self.width_mm


def section_shape(groove: DetectedGroove, cloud: Floats, spacing_mm: float) -> SectionShape | None:
    """The shape that explains the points (N, 3) around a groove best.

    None where hardly any are there, or where no chain of lines among them does: walls of a hollow between round bodies
    never end.
    """
    points = _laid_over(groove, cloud)
    if len(points) < 50:
        return None
    independent = len(points) / ALIKE
    points = points[:: len(points) // POINTS_FITTED + 1]
    width, depth = float(np.median(groove.width_mm)), float(np.median(groove.depth_mm))
    sharp = _best(points, width, depth, [(at, at) for at in SHARP_STARTS])
    floored = _best(points, width, depth, list(FLOOR_STARTS))
    if sharp is None or floored is None:
        return sharp
    ratio = independent * float(np.log(max(sharp.misfit_mm, 1e-9) / max(floored.misfit_mm, 1e-9)))
    wide = floored.floor_fraction * floored.width_mm
    least = max(MIN_FLOOR_WIDTHS * floored.width_mm, MIN_FLOOR_SPACINGS * spacing_mm)
    return replace(floored if ratio > MIN_LOG_RATIO and wide > least else sharp, floor_log_ratio=ratio)


def with_shape(groove: DetectedGroove, shape: SectionShape) -> DetectedGroove:
    """A groove whose edges and root are moved, alike at all stations, to where a shape has them."""
    middle, across, up = _frames(groove)
    root = groove.root - middle
    aside, above = (root * across).sum(axis=1), (root * up).sum(axis=1)
    place, depth = float(shape.feet_mm.mean()), shape.level_mm - shape.depth_mm
    root = groove.root + (place - np.median(aside)) * across + (depth - np.median(above)) * up
    half = float(np.median(groove.width_mm)) / 2
    wider = shape.width_mm / (2 * half)
    left = groove.left + (shape.edges_mm[0] + half) * across + shape.level_mm * up
    right = groove.right + (shape.edges_mm[1] - half) * across + shape.level_mm * up
    deeper = shape.depth_mm - float(np.median(groove.depth_mm))
    return replace(
        groove, root=root, left=left, right=right, width_mm=groove.width_mm * wider,
        depth_mm=np.maximum(groove.depth_mm + deeper, 0.1 * shape.depth_mm), floor_fraction=shape.floor_fraction,
    )  # fmt: skip


def _frames(groove: DetectedGroove) -> tuple[Floats, Floats, Floats]:
    """Middles between the edges and unit directions across and up, (S, 3) each."""
    middle = (groove.left + groove.right) / 2
    along = unit_vectors(np.gradient(middle, axis=0))
    across = groove.right - groove.left
    across = unit_vectors(across - (across * along).sum(axis=1)[:, None] * along)
    up = np.cross(along, across)
    return middle, across, up * np.sign((up * groove.normals).sum(axis=1))[:, None]


def _laid_over(groove: DetectedGroove, cloud: Floats) -> Floats:
    """Places across and heights (K, 2) of the points beside the stations, in an order that is the points' own."""
    middle, across, up = _frames(groove)
    width, depth = float(np.median(groove.width_mm)), float(np.median(groove.depth_mm))
    reach = float(np.hypot(REACH_WIDTHS * width, 1.5 * depth))
    away, station = cKDTree(middle).query(cloud, distance_upper_bound=reach)
    inside = np.isfinite(away)
    if not groove.closed:
        inside &= (station > 0) & (station < len(middle) - 1)
    offset, station = cloud[inside] - middle[station[inside]], station[inside]
    laid = np.stack([(offset * across[station]).sum(axis=1), (offset * up[station]).sum(axis=1)], axis=1)
    laid = laid[np.abs(laid[:, 0]) < REACH_WIDTHS * width]
    return np.asarray(laid[np.lexsort((laid[:, 1], laid[:, 0]))])


def _best(points: Floats, width: float, depth: float, starts: list[tuple[float, float]]) -> SectionShape | None:
    """The best of the fits that begin with the feet at these places, in widths from the left edge.

    Of those that stayed among the points; None where none did.
    """
    sharp = starts[0][0] == starts[0][1]
    soft = SOFT_DEPTHS * depth
    best: tuple[float, Floats] = np.inf, np.zeros(5)
    for first, second in starts:
        start = np.array([-width / 2, width / 2, first, depth, 0.0])
        if not sharp:
            start = np.append(start, (second - first) / (1 - first))
        fit = least_squares(
            lambda q: _distances(points, q), start, loss="soft_l1", f_scale=soft, diff_step=STEP,
            max_nfev=MAX_EVALUATIONS,
        )  # fmt: skip
        if fit.cost < best[0] and _is_among(points, fit.x):
            best = float(fit.cost), fit.x
    if not np.isfinite(best[0]):
        return None
    off = _distances(points, best[1])
    limit = SOFT_DEVIATIONS * max(float(MAD_TO_STD * np.median(off)), soft)
    left, foot, other, right, bottom, level = _places(best[1])
    return SectionShape(
        np.array([left, right]), np.array([foot, other]), level, bottom,
        float(np.sqrt(np.mean(np.minimum(off, limit) ** 2))), 0.0,
    )  # fmt: skip


def _is_among(points: Floats, q: Floats) -> bool:
    """Whether edges in their order and feet below them lie among the points (K, 2), or beyond at most as far again: an
    edge may lie outside the cloud, and a sharp root under a floor."""
    low, high = points.min(axis=0), points.max(axis=0)
    least, most = 2 * low - high, 2 * high - low
    left, _, _, right, depth, level = _places(q)
    return bool(least[0] <= left < right <= most[0] and depth > 0 and least[1] <= level - depth and level <= most[1])


def _places(q: Floats) -> tuple[float, float, float, float, float, float]:
    """Left edge, feet, right edge, depth, level of parameters: edges, first foot, depth, level, second foot."""
    left, right = float(q[0]), float(q[1])
    foot = left + (right - left) * float(np.clip(q[2], 0.0, 1.0))
    other = foot + (right - foot) * float(np.clip(q[5], 0.0, 1.0)) if len(q) > 5 else foot
    return left, foot, other, right, float(q[3]), float(q[4])


def _distances(points: Floats, q: Floats) -> Floats:
    """Distances (K,) of points (K, 2) from the chain of lines."""
    left, foot, other, right, depth, level = _places(q)
    far = 4 * float(np.abs(points[:, 0]).max())
    nodes = np.array([(left - far, 0), (left, 0), (foot, -depth), (other, -depth), (right, 0), (right + far, 0)])
    nearest = np.full(len(points), np.inf)
    x, y = points[:, 0], points[:, 1] - level
    for (x0, y0), (x1, y1) in pairwise(nodes):
        dx, dy = x1 - x0, y1 - y0
        length = dx * dx + dy * dy
        if length > 0:
            t = np.clip(((x - x0) * dx + (y - y0) * dy) / length, 0.0, 1.0)
            nearest = np.minimum(nearest, (x - x0 - t * dx) ** 2 + (y - y0 - t * dy) ** 2)
    return np.sqrt(nearest)
