"""Points sorted into cubic cells that a hash table finds: what searches, surfels and sweeps over a cloud stand on."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import InputError
from grindvision.geometry.bounds import bounds
from grindvision.kernels import njit

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

AXIS_CELLS = 1 << 20
"""Maximum of cells along one axis; three axes share one 63-bit key."""

_BLOCKS = 64
"""Maximum of blocks of cells along one axis."""

_EMPTY = np.int64(-1)
_MIX = np.int64(-7046029254386353131)


class CellGrid(NamedTuple):
    """Points (N, 3) sorted into cubic cells of ``size_mm``; the cells are found through a hash table.

    A named tuple, so that kernels take it whole. Cells are numbered by their coordinates, x slowest, whatever the order
    of the points. ``order`` (N,) lists the points cell by cell; cell c owns ``order[starts[c]:starts[c + 1]]``.
    ``table_keys`` and ``table_cells`` are the open-addressed table from packed cell coordinates to c. ``blocks`` (I, J,
    K) are cubes of ``2**block_bits`` cells on an edge, cut into 64 parts, of which a bit each says whether it holds a
    cell (``in_block``): a search goes round the others, and asks the table only for what may be there.
    """

    points: Floats
    size_mm: float
    origin_mm: Floats
    order: Integers
    starts: Integers
    table_keys: Integers
    table_cells: NDArray[np.int32]
    block_bits: int
    blocks: Integers

    @property
    def keys(self) -> Integers:
        """Key (C,) of every cell: its coordinates packed, x first; they rise from cell to cell."""
        filled = self.table_keys != _EMPTY
        keys = np.empty(len(self.starts) - 1, dtype=np.int64)
        keys[self.table_cells[filled]] = self.table_keys[filled]
        return keys

    def __hash__(self) -> int:
        return id(self)

    def __eq__(self, other: object) -> bool:
        return self is other

    def __str__(self) -> str:
        return f"{len(self.points):,} points in {len(self.starts) - 1:,} cells of {self.size_mm:.3g} mm"


def build_cells(points: ArrayLike, size_mm: float) -> CellGrid:
    """Sort points (N, 3) into cubic cells of edge ``size_mm``.

    Raises:
        InputError: the size is not above zero, or so small that an axis has more than ``AXIS_CELLS`` cells.
    """
    points = np.ascontiguousarray(points, dtype=float)
    origin = cell_origin(points, size_mm)
    cell_of_point, keys, table_keys, table_cells = assign_cells(points, origin, 1.0 / size_mm)
    order, starts = _sorted_by_cell(cell_of_point, len(keys))
    return CellGrid(points, float(size_mm), origin, order, starts, table_keys, table_cells, *blocks_of(keys))


def grid_of_means(
    means: Floats, size_mm: float, origin: Floats, keys: Integers, table: tuple[Integers, NDArray[np.int32]]
) -> CellGrid:
    """Grid of cells with one point each, ``means`` (C, 3) in the order of the ``keys`` (C,) of ``assign_cells``."""
    cells = np.arange(len(keys) + 1)
    return CellGrid(means, float(size_mm), origin, cells[:-1], cells, *table, *blocks_of(keys))


def blocks_of(keys: Integers) -> tuple[int, Integers]:
    """``block_bits`` and ``blocks`` (I, J, K) of cells with the given keys (C,), as ``CellGrid`` has them."""
    if not len(keys):
        return 2, np.zeros((1, 1, 1), dtype=np.int64)
    highest = _highest(keys)
    bits = max(2, int(highest.max() // _BLOCKS).bit_length())
    return bits, _marked(keys, bits, highest)


def cell_origin(points: Floats, size_mm: float) -> Floats:
    """Corner (3,) from which cells are counted; checks that the cells can be keyed.

    It lies a cell and a half below the points: the outermost ones, which define it, then stand in the middle of their
    cell, and rounding moves none of them into another.
    """
    if not size_mm > 0:
        raise InputError(f"the cell size is {size_mm} mm; it must be above zero")
    if len(points) == 0:
        return np.zeros(3)
    low, high = bounds(points)
    cells = float((high - low).max()) / size_mm
    if not cells < AXIS_CELLS - 4:
        raise InputError(
            f"the points span {float((high - low).max()):.3g} mm, {cells:.3g} cells of {size_mm:.3g} mm; drop far"
            " outliers or take larger cells"
        )
    return low - 1.5 * size_mm


@njit(cache=True, nogil=True, inline="always")
def cell_key(i: int, j: int, k: int) -> np.int64:
    """Pack three non-negative cell coordinates into one key."""
    return (np.int64(i) << 42) | (np.int64(j) << 21) | np.int64(k)


def cell_indices(keys: Integers) -> Integers:
    """Indices (C, 3) of cells with the given keys (C,): the inverse of ``cell_key``."""
    axis = (1 << 21) - 1
    return np.column_stack([(keys >> 42) & axis, (keys >> 21) & axis, keys & axis])


@njit(cache=True, nogil=True)
def find_slot(table_keys: Integers, key: np.int64) -> np.int64:
    """Slot of ``key`` in the open-addressed table, or the free slot where it belongs.

    Eight cells in a row along z begin their search in one line of the processor's cache.
    """
    mask = table_keys.size - 1
    slot = ((((key >> 3) * _MIX) >> 30) & ~7 | (key & 7)) & mask
    while table_keys[slot] != _EMPTY and table_keys[slot] != key:
        slot = (slot + 1) & mask
    return slot


@njit(cache=True, nogil=True)
def grown_table(keys: Integers, count: int, size: int) -> tuple[Integers, NDArray[np.int32]]:
    """Fresh table of ``size`` slots (a power of two) holding the first ``count`` keys."""
    table_keys = np.full(size, _EMPTY, dtype=np.int64)
    table_cells = np.empty(size, dtype=np.int32)
    for cell in range(count):
        slot = find_slot(table_keys, keys[cell])
        table_keys[slot] = keys[cell]
        table_cells[slot] = cell
    return table_keys, table_cells


def assign_cells(
    points: Floats, origin: Floats, per_mm: float
) -> tuple[NDArray[np.int32], Integers, Integers, NDArray[np.int32]]:
    """Cell number (N,) of each point, keys (C,) of the cells, in rising order, and the table (``CellGrid``)."""
    cell_of_point, keys, table_keys, table_cells = _numbered(points, origin, per_mm)
    order = np.argsort(keys)
    _renumber(order, cell_of_point, table_keys, table_cells)
    return cell_of_point, keys[order], table_keys, table_cells


def count_cells(points: Floats, origin: Floats, per_mm: float) -> int:
    """How many cells (``assign_cells``) hold a point (N, 3)."""
    return len(_numbered(points, origin, per_mm)[1])


def neighbour_counts(points: Floats, size_mm: float, looked_at: int = 500) -> Integers:
    """How many of the 27 cells of edge ``size_mm`` about some cells of points (N, 3), themselves included, hold points
    (K,); the cells are drawn by where they lie, not by the order of the points."""
    points = np.ascontiguousarray(points, dtype=float)
    _, keys, table_keys, _ = assign_cells(points, cell_origin(points, size_mm), 1.0 / size_mm)
    return _neighbour_counts(keys[:: max(1, len(keys) // looked_at)], table_keys)


def random_order(keys: Integers, rng: np.random.Generator) -> Integers:
    """Indices (N,) of things with different keys (N,), such as cells, in a random order that the keys alone decide.

    It is the same however the things are sorted, and where one is missing the others keep their order.
    """
    mixed = keys.astype(np.uint64) + rng.integers(2**64, dtype=np.uint64)
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):  # SplitMix64 (Steele 2014)
        mixed = (mixed ^ (mixed >> np.uint64(shift))) * np.uint64(factor)
    return np.argsort(mixed ^ (mixed >> np.uint64(31)))


@njit(cache=True, nogil=True)
def _highest(keys: Integers) -> Integers:
    """Maximum (3,) of the coordinates of cells with the given keys (C,)."""
    axis, highest = (1 << 21) - 1, np.zeros(3, dtype=np.int64)
    for key in keys:
        highest[0] = max(highest[0], key >> 42)
        highest[1] = max(highest[1], (key >> 21) & axis)
        highest[2] = max(highest[2], key & axis)
    return highest


@njit(cache=True, nogil=True)
def _marked(keys: Integers, bits: int, highest: Integers) -> Integers:
    """The cubes of ``2**bits`` cells on an edge, with the bits of the parts that hold one of the cells (C,)."""
    axis = (1 << 21) - 1
    marks = np.zeros(((highest[0] >> bits) + 1, (highest[1] >> bits) + 1, (highest[2] >> bits) + 1), dtype=np.int64)
    for key in keys:
        i, j, k = key >> 42, (key >> 21) & axis, key & axis
        marks[i >> bits, j >> bits, k >> bits] |= np.int64(1) << _part(i, j, k, bits)
    return marks


@njit(cache=True, nogil=True, inline="always")
def _part(i: int, j: int, k: int, bits: int) -> int:
    """Which of the 64 parts of its cube a cell lies in: four along each axis."""
    cut = bits - 2
    return (i >> cut & 3) << 4 | (j >> cut & 3) << 2 | (k >> cut & 3)


@njit(cache=True, nogil=True, inline="always")
def in_block(blocks: Integers, bits: int, i: int, j: int, k: int) -> bool:
    """Whether the part of a cube in which a cell lies holds one; the cell must lie in one of the ``blocks``."""
    return (blocks[i >> bits, j >> bits, k >> bits] >> _part(i, j, k, bits)) & 1 != 0


@njit(cache=True, nogil=True)
def any_in_blocks(blocks: Integers, low: tuple[int, int, int], high: tuple[int, int, int]) -> bool:
    """Whether one of the ``blocks`` from ``low`` to ``high``, both included, holds a cell."""
    for i in range(max(low[0], 0), min(high[0] + 1, blocks.shape[0])):
        for j in range(max(low[1], 0), min(high[1] + 1, blocks.shape[1])):
            for k in range(max(low[2], 0), min(high[2] + 1, blocks.shape[2])):
                if blocks[i, j, k] != 0:
                    return True
    return False


@njit(cache=True, nogil=True)
def _neighbour_counts(keys: Integers, table_keys: Integers) -> Integers:
    """``neighbour_counts`` of cells with the given keys (K,)."""
    counts = np.zeros(len(keys), dtype=np.int64)
    for c in range(len(keys)):
        for i in range(-1, 2):
            for j in range(-1, 2):
                for k in range(-1, 2):
                    beside = keys[c] + (np.int64(i) << 42) + (np.int64(j) << 21) + k
                    counts[c] += table_keys[find_slot(table_keys, beside)] != _EMPTY
    return counts


@njit(cache=True, nogil=True)
def _renumber(
    order: Integers, cell_of_point: NDArray[np.int32], table_keys: Integers, table_cells: NDArray[np.int32]
) -> None:
    """Number cells, listed in their new ``order``, anew, in place."""
    rank = np.empty(len(order), dtype=np.int32)
    for cell in range(len(order)):
        rank[order[cell]] = cell
    for p in range(len(cell_of_point)):
        cell_of_point[p] = rank[cell_of_point[p]]
    for slot in range(len(table_keys)):
        if table_keys[slot] != _EMPTY:
            table_cells[slot] = rank[table_cells[slot]]


@njit(cache=True, nogil=True)
def _numbered(
    points: Floats, origin: Floats, per_mm: float
) -> tuple[NDArray[np.int32], Integers, Integers, NDArray[np.int32]]:
    """As ``assign_cells``, the cells in order of first appearance."""
    cell_of_point = np.empty(len(points), dtype=np.int32)
    keys = np.empty(2048, dtype=np.int64)
    table = grown_table(keys, 0, 2 * len(keys))
    done = count = 0
    while True:
        done, count = _enter(points, done, origin, per_mm, keys, count, table, cell_of_point)
        if done == len(points):
            return cell_of_point, keys[:count].copy(), table[0], table[1]
        more = np.empty(2 * len(keys), dtype=np.int64)
        more[:count] = keys
        keys = more
        table = grown_table(keys, count, 2 * len(keys))


@njit(cache=True, nogil=True)
def _enter(
    points: Floats,
    first: int,
    origin: Floats,
    per_mm: float,
    keys: Integers,
    count: int,
    table: tuple[Integers, NDArray[np.int32]],
    cell_of_point: NDArray[np.int32],
) -> tuple[int, int]:
    """Number the cells of points from ``first`` on, while there is room for keys: where it stopped, and how many.

    Arrays that grow are replaced outside: a loop that replaces its arrays counts references in every round. Neighbours
    in a scan's row share a cell: the table is asked when it changes.
    """
    table_keys, table_cells = table
    last, cell = _EMPTY, 0
    for p in range(first, len(points)):
        i = int((points[p, 0] - origin[0]) * per_mm)
        j = int((points[p, 1] - origin[1]) * per_mm)
        k = int((points[p, 2] - origin[2]) * per_mm)
        key = cell_key(i, j, k)
        if key != last:
            slot = find_slot(table_keys, key)
            if table_keys[slot] == _EMPTY:
                if count == len(keys):
                    return p, count
                keys[count] = key
                table_keys[slot] = key
                table_cells[slot] = count
                count += 1
            last, cell = key, table_cells[slot]
        cell_of_point[p] = cell
    return len(points), count


@njit(cache=True, nogil=True)
def _sorted_by_cell(cell_of_point: NDArray[np.int32], cells: int) -> tuple[Integers, Integers]:
    """Points (N,) sorted by their cell, and where each of the ``cells`` begins (a counting sort)."""
    starts = np.zeros(cells + 1, dtype=np.int64)
    for cell in cell_of_point:
        starts[cell + 1] += 1
    for cell in range(cells):
        starts[cell + 1] += starts[cell]
    fill = starts[:-1].copy()
    order = np.empty(len(cell_of_point), dtype=np.int64)
    for p in range(len(cell_of_point)):
        cell = cell_of_point[p]
        order[fill[cell]] = p
        fill[cell] += 1
    return order, starts
