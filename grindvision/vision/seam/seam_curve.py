"""A curve along a seam: evenly spaced stations with a frame each, and the cloud laid straight."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_closing

from grindvision.geometry import unit_vectors
from grindvision.kernels import njit
from grindvision.records import by_content

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]


#: Stations that are looked at or passed over together where the nearest one is sought; rounding leaves none out.
BLOCK, ROUNDING = 8, 1 + 1e-9


@by_content
@dataclass(frozen=True)
class SeamCurve:
    """Stations (S, 3) in mm, ``step_mm`` apart, with unit vectors along, across (to the left) and up (S, 3) each."""

    stations: Floats
    step_mm: float
    along: Floats
    across: Floats
    up: Floats

    @property
    def length_mm(self) -> float:
        """Length from the first to the last station."""
        return self.step_mm * (len(self.stations) - 1)

    def part(self, here: slice) -> SeamCurve:
        """Some of its stations, in order."""
        return SeamCurve(self.stations[here], self.step_mm, self.along[here], self.across[here], self.up[here])

    def __len__(self) -> int:
        return len(self.stations)

    def __str__(self) -> str:
        return f"curve of {len(self)} stations, {self.length_mm:.1f} mm long"


@by_content
@dataclass(frozen=True)
class Strip:
    """Points near a curve: ``index`` (K,) into the cloud and, mm, their ``along``, ``across`` and ``up`` (K,)."""

    index: Integers
    along: Floats
    across: Floats
    up: Floats


class _StationRaster(NamedTuple):
    """Index of the nearest station of every cell (R, C), -1 beyond the reach; the raster begins at ``corner`` (2,)."""

    nearest: Integers
    corner: Floats
    cell: float


class _Frames(NamedTuple):
    """A ``SeamCurve`` as kernels take it."""

    stations: Floats
    along: Floats
    across: Floats
    up: Floats
    step: float


def build_curve(path: Floats, up: Floats, step_mm: float) -> SeamCurve:
    """Curve through a smooth path (M, 3), resampled every ``step_mm``.

    Args:
        path: points in order.
        up: (M, 3) or (3,) directions that become ``up`` once turned perpendicular to the path.
    """
    up = np.broadcast_to(up, path.shape)
    lengths = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    count = max(round(lengths[-1] / step_mm), 3) + 1
    at = np.linspace(0, lengths[-1], count)
    stations = np.stack([np.interp(at, lengths, path[:, k]) for k in range(3)], axis=1)
    along = unit_vectors(np.gradient(stations, axis=0))
    rise = np.stack([np.interp(at, lengths, up[:, k]) for k in range(3)], axis=1)
    rise = unit_vectors(rise - along * np.einsum("ij,ij->i", rise, along)[:, None])
    return SeamCurve(stations, float(lengths[-1] / (count - 1)), along, np.cross(rise, along), rise)


def extended(curve: SeamCurve, first_mm: float, last_mm: float, base_mm: float) -> SeamCurve:
    """Curve continued by ``first_mm`` before its start and ``last_mm`` behind its end.

    Each end goes on with the bend that it shows over its last ``base_mm``.
    """
    count = min(len(curve), max(int(base_mm / curve.step_mm), 4))
    head = _continued(curve.stations[:count][::-1], curve.up[:count][::-1], first_mm, curve.step_mm)
    tail = _continued(curve.stations[-count:], curve.up[-count:], last_mm, curve.step_mm)
    stations = np.concatenate([head[0][::-1], curve.stations, tail[0]])
    return build_curve(stations, np.concatenate([head[1][::-1], curve.up, tail[1]]), curve.step_mm)


def _continued(stations: Floats, up: Floats, reach_mm: float, step_mm: float) -> tuple[Floats, Floats]:
    """New stations and up directions (E, 3) behind the last one: a parabola through the stations, up turning evenly."""
    behind = np.arange(1, int(reach_mm / step_mm) + 1) * step_mm
    at = (np.arange(len(stations)) - len(stations) + 1) * step_mm
    bend = np.linalg.lstsq(np.column_stack([at, at**2]), stations - stations[-1], rcond=None)[0]
    turn = np.linalg.lstsq(at[:, None], up - up[-1], rcond=None)[0]
    return stations[-1] + np.column_stack([behind, behind**2]) @ bend, up[-1] + behind[:, None] @ turn


def lay_straight(
    points: Floats, T_field_cloud: Floats, curve: SeamCurve, reach_mm: float, below_mm: float, above_mm: float
) -> Strip:
    """Points (N, 3) within ``reach_mm`` across the curve and ``-below_mm`` to ``above_mm`` of it, in its coordinates.

    The curve is in the field frame. A point belongs to the nearest place of the curve.
    """
    cell = max(curve.step_mm, reach_mm / 12)
    corner = curve.stations[:, :2].min(axis=0) - 1.5 * reach_mm
    shape = np.ceil((curve.stations[:, :2].max(axis=0) + 1.5 * reach_mm - corner) / cell).astype(int) + 1
    nearest = _paint_nearest(curve.stations, corner, cell, shape[0], shape[1], 1.3 * reach_mm)
    index, place = _curve_coordinates(
        np.ascontiguousarray(points, dtype=float),
        np.ascontiguousarray(T_field_cloud, dtype=float),
        _StationRaster(nearest, corner, cell),
        _Frames(curve.stations, curve.along, curve.across, curve.up, curve.step_mm),
        np.array([reach_mm, -below_mm, above_mm]),
    )
    return Strip(index, place[:, 0], place[:, 1], place[:, 2])


def nearest_stations(points: Floats, curve: SeamCurve, reach_mm: float) -> tuple[Integers, Integers, Floats]:
    """Points (K,) within ``reach_mm`` of a curve, the station of each, and its offset (K, 3) across the curve.

    Points before the first or behind the last station are left out.
    """
    return beside_stations(points, curve.stations, curve.along, reach_mm, 0.75 * curve.step_mm)


def beside_stations(
    points: Floats, stations: Floats, along: Floats, reach_mm: float, ahead_mm: float
) -> tuple[Integers, Integers, Floats]:
    """As ``nearest_stations``, of stations (S, 3) with unit directions ``along`` (S, 3); points more than ``ahead_mm``
    before or behind their station are left out."""
    count = len(stations)
    starts = np.arange(0, count, BLOCK)
    middles = np.add.reduceat(stations, starts, axis=0) / np.diff(starts, append=count)[:, None]
    away = np.linalg.norm(stations - np.repeat(middles, BLOCK, axis=0)[:count], axis=1)
    blocks = np.column_stack([middles, np.maximum.reduceat(away, starts)])
    points, stations, along = (np.ascontiguousarray(one, dtype=float) for one in (points, stations, along))
    return _stations_near(points, stations, along, blocks, np.array([reach_mm, ahead_mm]))


def in_frames(points: Floats, station: Integers, stations: Floats, axes: tuple[Floats, ...]) -> Floats:
    """Coordinates (K, A) of points (K, 3) from their ``station`` (K,) among S ``stations`` (S, 3), along each of A axes
    (S, 3) there."""
    return _in_frames(points, station, stations, np.ascontiguousarray(np.stack(axes, axis=1)))


def closed_runs(flags: Flags, size: int) -> Flags:
    """Flags (S,) with gaps shorter than ``size`` filled; the ends stay where they are."""
    return np.asarray(binary_closing(np.pad(flags, size), np.ones(size))[size:-size])


@njit(cache=True, nogil=True)
def _stations_near(
    points: Floats, stations: Floats, along: Floats, blocks: Floats, limits: Floats
) -> tuple[Integers, Integers, Floats]:
    """Points (K,) within reach of stations (S, 3), the nearest station of each and its offset (K, 3) across ``along``.

    ``blocks`` (B, 4) are the middle and the radius of every ``BLOCK`` stations: one that cannot hold a nearer station
    is passed over. ``limits`` (2,) are the reach and how far ahead of its station a point may lie.
    """
    reach, most = limits
    index, nearest = np.empty(len(points), np.int64), np.empty(len(points), np.int64)
    offset, kept = np.empty((len(points), 3)), 0
    away = np.empty(len(blocks))
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for s in range(len(stations)):
        for k in range(3):
            low[k] = min(low[k], stations[s, k] - reach)
            high[k] = max(high[k], stations[s, k] + reach)
    widest = blocks[:, 3].max()
    for p in range(len(points)):
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        if not (low[0] <= x <= high[0] and low[1] <= y <= high[1] and low[2] <= z <= high[2]):
            continue
        for b in range(len(blocks)):
            dx, dy, dz = x - blocks[b, 0], y - blocks[b, 1], z - blocks[b, 2]
            away[b] = dx * dx + dy * dy + dz * dz
        first = int(np.argmin(away))
        if away[first] > (reach + widest) ** 2:
            continue
        best, limit, found = reach * reach, reach * ROUNDING, -1
        for turn in range(len(blocks) + 1):
            b = first if turn == 0 else turn - 1
            if (turn > 0 and b == first) or away[b] > (limit + blocks[b, 3]) ** 2:
                continue
            for s in range(b * BLOCK, min((b + 1) * BLOCK, len(stations))):
                dx, dy, dz = x - stations[s, 0], y - stations[s, 1], z - stations[s, 2]
                squared = dx * dx + dy * dy + dz * dz
                if squared < best or (squared == best and 0 <= s < found):
                    best, found = squared, s
            limit = np.sqrt(best) * ROUNDING
        if found < 0:
            continue
        dx, dy, dz = x - stations[found, 0], y - stations[found, 1], z - stations[found, 2]
        ahead = dx * along[found, 0] + dy * along[found, 1] + dz * along[found, 2]
        if abs(ahead) > most:
            continue
        index[kept], nearest[kept] = p, found
        offset[kept, 0] = dx - ahead * along[found, 0]
        offset[kept, 1] = dy - ahead * along[found, 1]
        offset[kept, 2] = dz - ahead * along[found, 2]
        kept += 1
    return index[:kept].copy(), nearest[:kept].copy(), offset[:kept].copy()


@njit(cache=True, nogil=True)
def _in_frames(points: Floats, station: Integers, stations: Floats, axes: Floats) -> Floats:
    """Coordinates (K, A) of points (K, 3) from their stations, along the axes (S, A, 3) of these."""
    result = np.empty((len(points), axes.shape[1]))
    for p in range(len(points)):
        s = station[p]
        x, y, z = points[p, 0] - stations[s, 0], points[p, 1] - stations[s, 1], points[p, 2] - stations[s, 2]
        for axis in range(axes.shape[1]):
            result[p, axis] = x * axes[s, axis, 0] + y * axes[s, axis, 1] + z * axes[s, axis, 2]
    return result


@njit(cache=True, nogil=True)
def _paint_nearest(stations: Floats, corner: Floats, cell: float, rows: int, columns: int, reach: float) -> Integers:
    """Index of the nearest station (by x and y) of every cell, -1 beyond the reach."""
    nearest = np.full((rows, columns), -1, np.int64)
    distance = np.full((rows, columns), np.inf)
    span = int(reach / cell) + 1
    for k in range(len(stations)):
        x, y = (stations[k, 0] - corner[0]) / cell, (stations[k, 1] - corner[1]) / cell
        for i in range(max(int(x) - span, 0), min(int(x) + span + 1, rows)):
            for j in range(max(int(y) - span, 0), min(int(y) + span + 1, columns)):
                squared = (i + 0.5 - x) ** 2 + (j + 0.5 - y) ** 2
                if squared < distance[i, j] and squared * cell * cell <= reach * reach:
                    distance[i, j] = squared
                    nearest[i, j] = k
    return nearest


@njit(cache=True, nogil=True)
def _curve_coordinates(
    points: Floats, frame: Floats, raster: _StationRaster, curve: _Frames, limits: Floats
) -> tuple[Integers, Floats]:
    """Indices (K,) of the points near the curve, and their places (K, 3) along it, across it and above it, mm.

    ``frame`` (4, 4) takes points to the curve's frame; ``limits`` (3,) are the reach across, the lowest and the highest
    place above the curve.
    """
    nearest, corner, cell = raster
    stations, along, across, up, step = curve
    rows, columns = nearest.shape
    index, place, kept = np.empty(len(points), np.int64), np.empty((len(points), 3)), 0
    for p in range(len(points)):
        px, py, pz = points[p, 0], points[p, 1], points[p, 2]
        x = frame[0, 0] * px + frame[0, 1] * py + frame[0, 2] * pz + frame[0, 3]
        y = frame[1, 0] * px + frame[1, 1] * py + frame[1, 2] * pz + frame[1, 3]
        i, j = int((x - corner[0]) / cell), int((y - corner[1]) / cell)
        if x < corner[0] or y < corner[1] or i >= rows or j >= columns or nearest[i, j] < 0:
            continue
        z = frame[2, 0] * px + frame[2, 1] * py + frame[2, 2] * pz + frame[2, 3]
        k = nearest[i, j]
        for _ in range(100):
            dx, dy, dz = x - stations[k, 0], y - stations[k, 1], z - stations[k, 2]
            ahead = dx * along[k, 0] + dy * along[k, 1] + dz * along[k, 2]
            if ahead > 0.6 * step and k < len(stations) - 1:
                k += 1
            elif ahead < -0.6 * step and k > 0:
                k -= 1
            else:
                break
        side = dx * across[k, 0] + dy * across[k, 1] + dz * across[k, 2]
        rise = dx * up[k, 0] + dy * up[k, 1] + dz * up[k, 2]
        if abs(side) > limits[0] or rise < limits[1] or rise > limits[2] or abs(ahead) > 2 * step:
            continue
        index[kept] = p
        place[kept, 0], place[kept, 1], place[kept, 2] = k * step + ahead, side, rise
        kept += 1
    return index[:kept].copy(), place[:kept].copy()


def around(points: Floats, line: Floats, reach_mm: float) -> Integers:
    """Points (K,) of a cloud (N, 3) in the box around a line (S, 3), ``reach_mm`` larger to all sides."""
    low, high = line.min(axis=0) - reach_mm, line.max(axis=0) + reach_mm
    inside = np.ones(len(points), dtype=bool)
    for axis in range(3):
        inside &= (points[:, axis] >= low[axis]) & (points[:, axis] <= high[axis])
    return np.flatnonzero(inside)
