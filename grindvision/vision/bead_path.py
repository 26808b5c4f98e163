"""Path points along the ridge of a bead (ours, in place of section 3.6's boxes).

The bead's rough course comes from ``bead_course``. The ridge is where the height over the good surface is
greatest across the bead: the vertex of a parabola fitted across, which uneven sampling does not pull aside as it does a
centroid.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from grindvision.errors import DegenerateError, InputError
from grindvision.geometry.curves import Curve
from grindvision.vision.bead_course import bead_course
from grindvision.vision.difference import Cluster

Floats = NDArray[np.float64]

CURVATURE_WIDTHS = 5.0
"""Over so many widths to either side a bead keeps its cross-section well enough for its curvature to be averaged."""


@dataclass(frozen=True)
class BeadPath:
    """Path of one bead, frame of the test scan.

    ``points`` (n, 3) on the ridge and unit ``normals`` (n, 3) of the good surface there, pointing off the part;
    ``ridge`` (M, 3) the whole curve; ``closed`` whether it comes back to its start; ``length_mm``, ``width_mm`` at half
    height, ``height_mm`` of the ridge over the good surface (median).
    """

    points: Floats
    normals: Floats
    ridge: Floats
    closed: bool
    length_mm: float
    width_mm: float
    height_mm: float

    def __str__(self) -> str:
        shape = "closed" if self.closed else "open"
        size = f"{self.length_mm:.1f} mm long, {self.width_mm:.1f} wide, {self.height_mm:.2f} high"
        return f"{shape} bead, {size}: {len(self.points)} points"

    def tool_axes(self) -> Floats:
        """Directions (n, 3) in which the tool points: opposite to the normals."""
        return -self.normals


def trace_bead(cluster: Cluster, points: int = 6) -> BeadPath:
    """Follow the ridge of a bead and place ``points`` on it, each in the middle of an equal part of its length.

    An open bead is walked from its end with the smaller x; a closed one from its point of smallest x, counterclockwise
    about its normal.

    Raises:
        InputError: fewer than one point. DegenerateError: the bead branches, or is too small to follow.
    """
    if points < 1:
        raise InputError(f"{points} path points asked for; at least 1 is needed")
    curve, closed, width = bead_course(cluster)
    stations = Curve(curve, closed)
    for _ in range(2):
        stations = Curve(_smoothed(_vertices(cluster, stations, width)[0], closed), closed)
    feet, normals, heights = _vertices(cluster, stations, width)
    ridge = Curve(feet + heights[:, None] * normals, closed)
    start, end = (0.0, ridge.length_mm) if closed else _ends(cluster, ridge)
    at = start + (end - start) * ((np.arange(points) + (0.0 if closed else 0.5)) / points)
    chosen = ridge.at(at)
    up = ridge.smooth(normals, at)
    dense = ridge.at(np.linspace(start, end, max(int((end - start) / (0.1 * width)), 2 * points, 20)))
    across = cluster.area_mm2 / max(end - start, 1e-9)
    return BeadPath(
        chosen, up, dense, closed, float(end - start), float(min(across, 10 * width)), float(np.median(heights))
    )


def _vertices(cluster: Cluster, stations: Curve, width: float) -> tuple[Floats, Floats, Floats]:
    """Ridge over stations along the curve: feet (M, 3) on the good surface, its normals (M, 3), ridge heights (M,).

    Points are taken in the curve's own coordinates: arc length s, distance b across, height h over the good surface.
    Around each station h = c0 + c1 s + c2 s^2 + (c3 + c4 s) b + c5 b^2 is fitted; the ridge lies at b = -c3 / (2 c5).
    Often one flank is in shadow; the slope of the other alone cannot tell a ridge farther off from a rounder one. So
    the curvature c5 is pooled over ``CURVATURE_WIDTHS`` along the bead before the ridge is placed.
    """
    feet = cluster.points - cluster.heights_mm[:, None] * cluster.normals
    s_all = stations.arc_of(feet)
    near = np.clip(s_all, 0, stations.length_mm)
    offsets = feet - stations.at(near)
    sides = np.cross(cluster.normals, stations.tangents(near))
    b_all = (offsets * sides).sum(axis=1) / np.linalg.norm(sides, axis=1)
    step = stations.length_mm / max(int(np.ceil(stations.length_mm / (0.35 * width))), 4)
    arcs = np.arange(0.0 if stations.closed else 0.5 * step, stations.length_mm - 1e-9, step)
    windows = [(arc, used) for arc in arcs if (used := _window(s_all, b_all, arc, stations, width)).sum() >= 12]
    if len(windows) < 2:
        raise DegenerateError("the bead is too small or too thinly sampled to follow its ridge; scan it denser")
    arcs = np.array([arc for arc, _ in windows])
    fits = [
        _Section(_along(s_all[used], arc, stations), b_all[used], cluster.heights_mm[used], 1.2 * width)
        for arc, used in windows
    ]
    curvatures = _pooled_curvatures(fits, arcs, stations, CURVATURE_WIDTHS * width)
    laterals, heights = zip(
        *(fit.vertex(c, 0.36 * width) for fit, c in zip(fits, curvatures, strict=True)), strict=True
    )
    tangents, places = stations.tangents(arcs), stations.at(arcs)
    normals = np.array([fit.weights @ cluster.normals[used] for fit, (_, used) in zip(fits, windows, strict=True)])
    normals -= (normals * tangents).sum(axis=1, keepdims=True) * tangents
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    depths = [
        np.average(offsets[used] @ up, weights=fit.weights)
        for fit, up, (_, used) in zip(fits, normals, windows, strict=True)
    ]
    places = places + np.array(depths)[:, None] * normals + np.array(laterals)[:, None] * np.cross(normals, tangents)
    return places, normals, np.array(heights)


def _along(s: Floats, arc: float, stations: Curve) -> Floats:
    """Arc lengths from a station, the shorter way round where the curve is closed."""
    away = s - arc
    return away - stations.length_mm * np.round(away / stations.length_mm) if stations.closed else away


def _window(s: Floats, b: Floats, arc: float, stations: Curve, width: float) -> NDArray[np.bool_]:
    """The points (N,) that a station's cross-section is fitted to."""
    return (np.abs(_along(s, arc, stations)) < 1.2 * width) & (np.abs(b) < 0.6 * width)


class _Section:
    """The bead's cross-section at one station, fitted to points by their s, b and h (see ``_vertices``)."""

    def __init__(self, s: Floats, b: Floats, h: Floats, reach: float) -> None:
        self.b, self.h = b, h
        self.weights = (1 - (np.abs(s) / reach) ** 3) ** 3
        self.root = np.sqrt(self.weights)
        self.rest = np.column_stack([np.ones_like(s), s, s * s, b, s * b]) * self.root[:, None]

    def curvature(self) -> tuple[float, float]:
        """Curvature c5 and its variance; the variance is infinite where the points do not fix it or it is no ridge."""
        design = np.column_stack([self.rest, self.b**2 * self.root])
        c, left, rank, _ = np.linalg.lstsq(design, self.h * self.root, rcond=1e-9)
        if rank < 6 or c[5] >= 0 or len(left) == 0:
            return 0.0, np.inf
        return float(c[5]), float(left[0] / len(self.h) * np.linalg.inv(design.T @ design)[5, 5]) + 1e-18

    def vertex(self, curvature: float, most: float) -> tuple[float, float]:
        """Where across the ridge lies, at most so far away, and its height, given the curvature (0: not known)."""
        c = np.linalg.lstsq(self.rest, (self.h - curvature * self.b**2) * self.root, rcond=1e-9)[0]
        lateral = -c[3] / (2 * curvature) if curvature < 0 else np.average(self.b, weights=self.weights * self.h)
        lateral = float(np.clip(lateral, -most, most))
        return lateral, float(c[0] + c[3] * lateral + curvature * lateral**2)


def _pooled_curvatures(sections: list[_Section], arcs: Floats, stations: Curve, reach: float) -> Floats:
    """Curvatures (M,) averaged along the bead, each weighted by how well its section knows it; 0 where none does."""
    values, variances = np.array([section.curvature() for section in sections]).T
    away = np.abs(np.array([_along(arcs, arc, stations) for arc in arcs]))
    weights = np.clip(1 - (away / reach) ** 3, 0, None) ** 3 / variances
    return (weights @ values) / np.maximum(weights.sum(axis=1), 1e-300)


def _smoothed(places: Floats, closed: bool) -> Floats:
    """Places (M, 3) averaged with their neighbours in the ratio 1 : 2 : 1; ends of an open curve stay."""
    before, after = np.roll(places, 1, axis=0), np.roll(places, -1, axis=0)
    mean = (before + 2 * places + after) / 4
    if not closed:
        mean[[0, -1]] = places[[0, -1]]
    return mean


def _ends(cluster: Cluster, ridge: Curve) -> tuple[float, float]:
    """Arc lengths between which the bead stands at least half as high as its ridge."""
    high = cluster.heights_mm > 0.5 * cluster.peak_mm
    arcs = ridge.arc_of(cluster.points[high])
    return float(np.quantile(arcs, 0.005)), float(np.quantile(arcs, 0.995))
