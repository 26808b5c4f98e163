"""Valleys of a height field: what a closing fills, cut into connected pieces, each with the path along its bottom."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter
from scipy.spatial import cKDTree

from grindvision.geometry.bounds import bounds_in_frame
from grindvision.geometry.graphs import edge_graph, farthest, shortest_way, walking_distances
from grindvision.parallel import parallel_map
from grindvision.records import by_content
from grindvision.vision.seam.height_field import HeightField, closed, coarser, rasterise, smoothed
from grindvision.vision.seam.valley_parts import cleared, connected_parts, inner_radius

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

#: Gaussian before the closing, as a fraction of the disc's radius.
SMOOTHING_FRACTION = 0.13
#: Cells of the raster per radius of the disc, where the cloud is dense enough: as many as the smallest disc, of eight
#: spacings, has cells of 1.2 spacings.
CELLS_PER_RADIUS = 6.6
#: A valley ends where its depth falls below this fraction of the deepest place.
FLANK_FRACTION = 0.3
#: A groove is at least so deep for its width, and so long for its width; waviness of a plate is far flatter.
MIN_RELIEF, MIN_ASPECT = 0.12, 1.5
#: The middle of a valley is at least so many cells from its rim: what is narrower belongs to a finer raster.
MIN_INNER_CELLS = 2.0
#: A valley must stand out of the residue that noise and waviness leave everywhere.
MIN_CONTRAST = 2.5
#: The smallest disc tried, as a fraction of the part's smaller side; a dense cloud would allow far smaller ones.
MIN_RADIUS_FRACTION = 0.012
#: Valleys below this fraction of the largest one's volume are left out.
MIN_LOOKED_AT = 0.01
#: Valleys looked at, deepest first, in one height field.
MAX_VALLEYS = 6
#: Cells of a valley farther from its path than this fraction of its width belong to a branch.
ARM_FRACTION = 0.75
#: Fraction of the greatest volume at which a smaller disc is preferred to a larger one.
ENOUGH_VOLUME = 0.8


@by_content
@dataclass(frozen=True)
class Valley:
    """One connected valley: its ``path`` (M, 3) along the bottom at the level of the surface around.

    The path is in the field frame, mm. ``depth_mm`` is the depth below the closed surface over most of the valley,
    ``width_mm`` its width between the flanks, ``volume_mm3`` what the closing fills.
    """

    path: Floats
    depth_mm: float
    width_mm: float
    volume_mm3: float

    def __str__(self) -> str:
        return f"valley {self.width_mm:.1f} mm wide, {self.depth_mm:.1f} mm deep, {self.volume_mm3:.0f} mm3"


@by_content
@dataclass(frozen=True)
class _Piece:
    cells: Flags
    depth_mm: float
    width_mm: float
    volume_mm3: float


@by_content
@dataclass(frozen=True)
class _Filling:
    field: HeightField
    surface: Floats
    depth: Floats
    pieces: list[_Piece]

    @property
    def volume_mm3(self) -> float:
        return max((piece.volume_mm3 for piece in self.pieces), default=0.0)


def find_valleys(
    points: Floats, T_field_cloud: Floats, spacing_mm: float, radius_mm: float | None = None
) -> Iterator[tuple[list[Valley], HeightField]]:
    """Valleys of a cloud (N, 3) seen along z of the field frame, largest volume first, and the raster they refer to.

    One pair per disc under which there are any: first the smallest disc that fills the largest valley, then the smaller
    ones, smallest first, for callers that find no groove under the first: in a cluttered scene the largest valley is a
    gap between two things.

    Args:
        points: finite points in mm.
        T_field_cloud: frame whose z axis is the viewing direction.
        spacing_mm: typical distance of neighbouring points.
        radius_mm: radius of the closing's disc, more than half the groove's width; by default it doubles from eight
            spacings on.
    """
    low, high = bounds_in_frame(points, T_field_cloud)
    radii = [radius_mm] if radius_mm else _radii(float((high - low)[:2].min()), spacing_mm)
    finest = rasterise(points, T_field_cloud, max(1.2 * spacing_mm, radii[0] / CELLS_PER_RADIUS), (low, high))
    filled = parallel_map(lambda radius: _fill(finest, radius), radii)
    fillings = [filling for filling in filled if filling.volume_mm3 > 0]
    first, most = 0, 0.0
    for number, filling in enumerate(fillings):
        if most < ENOUGH_VOLUME * filling.volume_mm3:
            first, most = number, filling.volume_mm3
    for filling in (*fillings[first : first + 1], *fillings[:first]):
        yield _valleys(filling), filling.field


def _valleys(filling: _Filling) -> list[Valley]:
    """Valleys of one filling and their arms, largest volume first, with their paths."""
    least, valleys = MIN_LOOKED_AT * filling.volume_mm3, []
    for piece in filling.pieces:
        if piece.volume_mm3 >= least:
            valleys.append(_valley(piece, filling))
            arms = _arms(piece, valleys[-1].path, filling)
            valleys += [_valley(arm, filling) for arm in arms if arm.volume_mm3 >= least]
    return sorted(valleys, key=lambda valley: -valley.volume_mm3)


def _fill(finest: HeightField, radius_mm: float) -> _Filling:
    """What a closing with a disc fills, on the finest raster that it needs."""
    field = coarser(finest, max(round(radius_mm / (CELLS_PER_RADIUS * finest.cell_mm)), 1))
    heights = smoothed(field, SMOOTHING_FRACTION * radius_mm)
    surface = closed(heights, radius_mm / field.cell_mm)
    depth = np.where(field.filled, surface - heights, np.float32(0))
    return _Filling(field, surface, depth, _pieces(depth, field))


def _radii(span_mm: float, spacing_mm: float) -> list[float]:
    """Radii of the discs for a part whose smaller side is ``span_mm``."""
    radii = [max(8 * spacing_mm, MIN_RADIUS_FRACTION * span_mm)]
    while 2 * radii[-1] < span_mm / 3:
        radii.append(2 * radii[-1])
    return radii


def _pieces(depth: Floats, field: HeightField) -> list[_Piece]:
    """Cut the depth map into valleys: take the deepest, mark what belongs to it, go on with the rest."""
    least = MIN_RELIEF * (2 * MIN_INNER_CELLS - 1) * field.cell_mm
    level, depths = least, depth[field.filled]
    if 2 * np.count_nonzero(depths <= least / MIN_CONTRAST) <= len(depths):  # told many times faster than the median
        level = max(MIN_CONTRAST * _median(depths), least)
    left, pieces = depth, []
    for _ in range(MAX_VALLEYS):
        peak = float(left.max())
        if peak <= level:
            break
        names, volumes, boxes = connected_parts(left, np.float32(FLANK_FRACTION * peak))
        for at in np.argsort(-volumes, kind="stable")[:MAX_VALLEYS]:
            box = slice(boxes[at, 0], boxes[at, 1]), slice(boxes[at, 2], boxes[at, 3])
            piece = _piece(names[box] == at + 1, box, depth, field)
            if piece is not None:
                pieces.append(piece)
        left = cleared(left, FLANK_FRACTION * peak)
    return pieces


def _median(values: Floats) -> float:
    """Median of many numbers (N,) without NaN: parted at one place, several times faster than ``np.median`` does."""
    middle = len(values) // 2
    parted = np.partition(values, middle)
    return float(parted[middle] if len(values) % 2 else (parted[:middle].max() + parted[middle]) / 2)


def _piece(inside: Flags, box: tuple[slice, slice], depth: Floats, field: HeightField) -> _Piece | None:
    """Measure the piece that is ``inside`` a ``box`` of the field; nothing where it is no long narrow valley."""
    area = int(inside.sum())
    if area < MIN_ASPECT * (2 * MIN_INNER_CELLS - 1) ** 2:
        return None
    inner = inner_radius(inside)
    if inner < MIN_INNER_CELLS or area < MIN_ASPECT * (2 * inner - 1) ** 2:
        return None
    width, depths = (2 * inner - 1) * field.cell_mm, depth[box][inside]
    deep = float(np.percentile(depths, 75))
    if deep < MIN_RELIEF * width:
        return None
    cells = np.zeros(depth.shape, dtype=bool)
    cells[box] = inside
    return _Piece(cells, deep, width, float(depths.sum()) * field.cell_mm**2)


def _arms(piece: _Piece, path: Floats, filling: _Filling) -> list[_Piece]:
    """What a path (M, 3) through a piece leaves aside: the arms of crossing and branching grooves."""
    depth, field = filling.depth, filling.field
    cells = np.argwhere(piece.cells)
    away = cKDTree((path[:, :2] / field.cell_mm).astype(int)).query(cells)[0] * field.cell_mm
    aside = np.zeros(piece.cells.shape)
    aside[tuple(cells[away > ARM_FRACTION * piece.width_mm].T)] = 1.0
    names, areas, boxes = connected_parts(aside, 0.0)
    arms = []
    for at in np.flatnonzero(areas >= MIN_ASPECT * (2 * MIN_INNER_CELLS) ** 2):
        box = slice(boxes[at, 0], boxes[at, 1]), slice(boxes[at, 2], boxes[at, 3])
        arms.append(_piece(names[box] == at + 1, box, depth, field))
    return [arm for arm in arms if arm is not None]


def _valley(piece: _Piece, filling: _Filling) -> Valley:
    """The piece with its path from one end to the other, which keeps to the deepest cells."""
    depth, field = filling.depth, filling.field
    rows, columns = np.nonzero(piece.cells)
    height, width = piece.cells.shape
    index = np.full((height, width), -1)
    index[rows, columns] = np.arange(len(rows))
    nodes = np.column_stack([field.positions(rows, columns), filling.surface[rows, columns]])
    local = maximum_filter(np.where(piece.cells, depth, 0), size=2 * int(piece.width_mm / field.cell_mm) + 1)
    fraction = (depth / np.maximum(local, 1e-9))[rows, columns]
    starts, ends = [], []
    for step_row, step_column in ((0, 1), (1, 0), (1, 1), (1, -1)):
        to_rows, to_columns = rows + step_row, columns + step_column
        inside = (to_rows < height) & (to_columns >= 0) & (to_columns < width)
        there = np.full(len(rows), -1)
        there[inside] = index[to_rows[inside], to_columns[inside]]
        starts.append(np.flatnonzero(there >= 0))
        ends.append(there[there >= 0])
    start, end = np.concatenate(starts), np.concatenate(ends)
    length = np.linalg.norm(nodes[start] - nodes[end], axis=1)
    cost = length / (0.02 + ((fraction[start] + fraction[end]) / 2) ** 2)

    lengths = edge_graph(start, end, length, len(nodes))
    first = farthest(walking_distances(lengths, 0))
    last = farthest(walking_distances(lengths, first))
    way = shortest_way(edge_graph(start, end, cost, len(nodes)), first, last)
    return Valley(nodes[way], piece.depth_mm, piece.width_mm, piece.volume_mm3)
