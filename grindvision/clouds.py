"""Point clouds and their files: PLY, PCD, XYZ and other text tables, NumPy, STL and OBJ in, binary PLY out.

Millimetres inside. The readers are in ``grindvision.formats``.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import FileError, GrindvisionWarning, InputError, UnitError
from grindvision.files import write_whole
from grindvision.formats.arrays import read_npy, read_npz
from grindvision.formats.content import Content
from grindvision.formats.meshes import read_obj, read_stl
from grindvision.formats.pcd import read_pcd
from grindvision.formats.ply import read_ply
from grindvision.formats.tables import read_table
from grindvision.input_files import bytes_left, open_input
from grindvision.records import by_content
from grindvision.triangles import double_areas, sound, spread_points, vertices_suffice

Floats = NDArray[np.float64]

READERS: dict[str, Callable[[Path, BinaryIO], Content]] = {
    ".ply": read_ply,
    ".pcd": read_pcd,
    **dict.fromkeys((".xyz", ".asc", ".txt", ".pts", ".csv"), read_table),
    ".npy": read_npy,
    ".npz": read_npz,
    ".stl": read_stl,
    ".obj": read_obj,
}
MM_PER = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4}

SMALLEST_MM, LARGEST_MM = 5.0, 20_000.0
"""Diagonals of scans of parts that an arm can work on; outside, the unit is wrong."""

SURE_MM = 20.0
"""Smallest diagonal that is believed to be in millimetres when nobody says so: it could be a hall in metres."""

FARTHEST_MM = 1e6
"""No scanner and no arm's base is farther than this from what was scanned."""

FEW_COPIES = 1e-3
"""Share of points that stand in a file twice without anybody having to know."""

MIN_FILLERS, FILLER_SAMPLE = 5, 2000
"""A point is no measurement where it fills so many rows of a sample of this size."""

SAMPLE_STEP, MAX_SAMPLES = 1 / 700, 1_000_000
"""Distance of the points spread over a mesh, fraction of its diagonal, and how many there are at most."""

FLOAT32_MM = 8192.0
"""Up to here float32 resolves a micrometre."""


@by_content
@dataclass(frozen=True)
class Cloud:
    """Points (N, 3) in mm and, where known, unit normals (N, 3).

    ``grid`` is (rows, columns) of an organised cloud, whose points are stored row by row; None otherwise. ``mesh`` says
    that they are of a surface in the file, a CAD model's or one that software made of scans. ``stated_unit`` is the
    unit that the file itself names, if it does.
    """

    points: Floats
    normals: Floats | None = None
    grid: tuple[int, int] | None = None
    mesh: bool = False
    stated_unit: str | None = None

    def __len__(self) -> int:
        return len(self.points)

    def __str__(self) -> str:
        size = extent(self.points)
        return f"{len(self.points):,} points over {size[0]:.1f} x {size[1]:.1f} x {size[2]:.1f} mm"


def read_cloud(path: str | Path, unit: str | None = None) -> Cloud:
    """Read a cloud file and return it in millimetres. NaN points are kept as they are.

    A mesh gives its vertices where they cover its surface, else points spread evenly over it. ``read_model`` keeps its
    surface.

    Args:
        path: file with one of the suffixes of ``READERS``.
        unit: unit of the numbers in the file, one of ``MM_PER``; left out: what the file says, else mm.

    Returns:
        Points (N, 3) in mm in the frame of the file, normals (N, 3) where it has them, the grid of an organised cloud.

    Raises:
        FileError: missing, empty, damaged, shorter than its header says, or of an unknown format.
        InputError: unknown unit. UnitError: the file says another unit.

    Warns:
        GrindvisionWarning: the reader had to decide something.

    Example:
        >>> from grindvision import read_cloud, write_ply
        >>> write_ply("plate.ply", [(0.0, 0.0, 0.4), (0.1, 0.0, 0.4), (0.0, 0.05, 0.4)])
        >>> print(read_cloud("plate.ply", unit="m"))
        3 points over 100.0 x 50.0 x 0.0 mm
    """
    return cloud_of(path, read_content(path, unit), unit)


def cloud_of(path: str | Path, content: Content, unit: str | None) -> Cloud:
    """The cloud in mm that a file's ``content`` makes; arguments and warnings as in ``read_cloud``."""
    note, mesh = content.note, content.triangles is not None
    if content.triangles is not None:
        content, of_mesh = _points_of_mesh(content, content.triangles)
        note = "; ".join(filter(None, (note, of_mesh)))
    if note:
        warnings.warn(f"{path}: {note}", GrindvisionWarning, stacklevel=3)
    scale = MM_PER[unit or content.unit or "mm"]
    points = content.points if scale == 1.0 else content.points * scale
    return Cloud(points, content.normals, content.grid, mesh, content.unit)


def read_content(path: str | Path, unit: str | None = None) -> Content:
    """What a cloud or mesh file holds, its numbers as they stand in it; arguments and errors as in ``read_cloud``."""
    path = Path(path)
    if unit is not None and unit not in MM_PER:
        raise InputError(f"unit {unit!r} is unknown; choose one of {', '.join(MM_PER)}")
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise FileError(f"{path}: format {path.suffix or '(none)'} is not read; use one of {', '.join(READERS)}")
    with open_input(path) as file, np.errstate(all="ignore"):  # what overflows or is no number is judged later
        if bytes_left(file) == 0:
            raise FileError(f"{path}: the file is empty; export the cloud again")
        content = reader(path, file)
    if len(content.points) == 0:
        raise FileError(f"{path}: no points in the file; export the cloud again")
    if None not in (unit, content.unit) and unit != content.unit:
        raise UnitError(f"{path}: its columns are named in {content.unit}, but unit {unit} was stated; say one of them")
    return content


def _points_of_mesh(content: Content, triangles: NDArray[np.int64]) -> tuple[Content, str]:
    """The vertices of a mesh where they stand closely enough for its surface, else points spread evenly over it; and in
    words what had to be decided. Vertices that no triangle has are left out, where they are few."""
    vertices = content.points
    named = np.zeros(len(vertices), dtype=bool)
    named[triangles] = True
    spare = int((~named).sum())
    if spare > named.sum():
        return content, f"{spare:,} of its {len(named):,} vertices belong to no face: read as a cloud of points"
    note = f"{spare:,} vertices that belong to no face were left out" if spare else ""
    corners = vertices[triangles]
    corners = corners[sound(corners)]
    area = float(np.linalg.norm(double_areas(corners), axis=1).sum()) / 2
    diagonal = float(np.linalg.norm(np.ptp(corners.reshape(-1, 3), axis=0))) if len(corners) else 0.0
    count = area / (SAMPLE_STEP * diagonal) ** 2 if diagonal else 0.0
    if not count >= 1 or vertices_suffice(corners):  # slivers alone, or numbers beyond all counting
        normals = None if content.normals is None else content.normals[named]
        return replace(content, points=vertices[named], normals=normals), note
    points, owner = spread_points(corners, int(min(count, MAX_SAMPLES)))
    normals = double_areas(corners)
    normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True))[owner]
    said = (
        f"a mesh of {len(triangles):,} triangles too large to stand for its surface by their corners; {len(points):,}"
        " points were spread evenly over it"
    )
    return replace(content, points=points, normals=normals), "; ".join(filter(None, (said, note)))


def finite_points(cloud: Cloud, name: str) -> Floats:
    """The points (N, 3) without those that hold NaN or infinity, and none of them twice; see ``usable_rows``."""
    rows, _ = usable_rows(cloud, name)
    return cloud.points if rows.all() else cloud.points[rows]


def usable_rows(cloud: Cloud, name: str) -> tuple[NDArray[np.bool_], tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Which rows (N,) of a cloud are finite, no filler (``filler_point``) and no copy of an earlier one; and the
    copies, see ``find_copies``.

    Raises:
        FileError: no point is left.

    Warns:
        GrindvisionWarning: rows hold NaN or infinity, or a filler; more than a few are copies.
    """
    finite = np.isfinite(cloud.points)
    # the usual case is told many times faster than row by row
    rows = np.ones(len(finite), dtype=bool) if finite.all() else np.asarray(finite.all(axis=1))
    if not rows.any():
        raise FileError(f"{name}: all {len(cloud)} points hold NaN or infinity; scan again or export again")
    if not rows.all():
        text = f"{name}: {int((~rows).sum())} of {len(cloud)} points hold NaN or infinity and were dropped"
        warnings.warn(text, GrindvisionWarning, stacklevel=2)
    filler = filler_point(cloud.points)
    if filler is not None:
        measured = (cloud.points != filler).any(axis=1)
        fills = int((rows & ~measured).sum())
        place = " ".join(f"{value:.6g}" for value in filler)
        if fills == rows.sum():
            raise FileError(f"{name}: all {fills} finite points are {place}; scan again or export again")
        text = f"{name}: {fills} of {len(cloud)} points are {place}, a pixel without depth, and were dropped"
        warnings.warn(text, GrindvisionWarning, stacklevel=2)
        rows = rows & measured
    at = np.flatnonzero(rows)
    copies, originals = find_copies(cloud.points if rows.all() else cloud.points[at])
    if len(copies) > FEW_COPIES * len(cloud):
        text = f"{name}: {len(copies)} of {len(cloud)} points are copies of others and were not counted twice"
        warnings.warn(text, GrindvisionWarning, stacklevel=2)
    rows[at[copies]] = False
    return rows, (at[copies], at[originals])


def filler_point(points: Floats) -> Floats | None:
    """The point (3,) that stands for pixels without depth: one that many rows of (N, 3) repeat exactly, in the camera's
    frame the origin; None where there is none."""
    sample = points[:: max(len(points) // FILLER_SAMPLE, 1)]
    sample = sample[np.isfinite(sample).all(axis=1)]
    first = np.sort(sample[:, 0])
    # No number repeated so often, no point repeated so often: told many times faster.
    if (first[MIN_FILLERS - 1 :] == first[: max(len(first) - MIN_FILLERS + 1, 0)]).any():
        values, counts = np.unique(sample, axis=0, return_counts=True)
        if counts.max() >= MIN_FILLERS:
            return np.asarray(values[counts.argmax()])
    zeros = (points[points[:, 0] == 0] == 0).all(axis=1)
    return np.zeros(3) if zeros.sum() > 1 else None


def find_copies(points: Floats) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows of (N, 3) that repeat an earlier point exactly, and the rows that they repeat; mostly both are empty."""
    keys = points @ np.array([1.0, np.sqrt(2) - 0.9, np.sqrt(3) - 1.1])
    in_order = np.sort(keys)
    if not (in_order[1:] == in_order[:-1]).any():
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    order = np.argsort(keys, kind="stable")
    same = (points[order[1:]] == points[order[:-1]]).all(axis=1)
    starts = np.flatnonzero(np.r_[True, ~same])
    first = np.repeat(np.minimum.reduceat(order, starts), np.diff(np.r_[starts, len(order)]))
    copied = order != first
    return order[copied], first[copied]


def check_unit(points: ArrayLike, name: str, unit: str | None = None) -> None:
    """Refuse a cloud in mm whose size or place says that its file's numbers have another unit than ``unit``.

    Raises:
        UnitError: the diagonal is below ``SMALLEST_MM`` or above ``LARGEST_MM``; below ``SURE_MM`` and no unit was
            stated; the points are farther than ``FARTHEST_MM`` from the origin.
    """
    low, high = _bounds(points)
    diagonal = float(np.linalg.norm(high - low))
    farthest = float(np.abs([low, high]).max())
    if 0 < diagonal < SMALLEST_MM:
        hint = "no part for an arm is so small" if unit == "m" else "the numbers look like metres, say --unit m"
        raise UnitError(f"{name}: only {diagonal:.3g} mm across; {hint}")
    if 0 < diagonal < SURE_MM and unit is None:
        raise UnitError(f"{name}: {diagonal:.3g} across; say --unit mm, cm, m or in, the size leaves it in doubt")
    if not diagonal <= LARGEST_MM:
        hint = "remove far outliers" if unit in (None, "mm") else "the numbers look like millimetres, say --unit mm"
        raise UnitError(f"{name}: {diagonal:.3g} mm across; {hint}")
    if farthest > FARTHEST_MM:
        raise UnitError(
            f"{name}: points {farthest:.3g} mm from the origin; no scanner stands so far away, subtract the offset"
        )


def extent(points: ArrayLike) -> Floats:
    """Size (3,) along x, y, z of the finite points among (N, 3); zeros where there are none."""
    low, high = _bounds(points)
    return high - low


def write_ply(path: str | Path, points: ArrayLike, normals: ArrayLike | None = None, comment: str = "") -> None:
    """Write a cloud as a binary little-endian PLY, whole or not at all.

    The numbers are float32, or float64 where float32 would lose more than a micrometre.

    Args:
        path: file; folders that are missing are made.
        points: (N, 3), mm.
        normals: unit normals (N, 3), where known.
        comment: a line for the header, ASCII.

    Raises:
        FileError: the file cannot be written.

    Example:
        >>> from grindvision import read_cloud, write_ply
        >>> write_ply("edge.ply", [(0, 0, 400), (100, 0, 400)])
        >>> read_cloud("edge.ply").points
        array([[  0.,   0., 400.],
               [100.,   0., 400.]])
    """
    points = np.asarray(points)
    columns = [points] if normals is None else [points, np.asarray(normals)]
    names = ["x", "y", "z", "nx", "ny", "nz"][: 3 * len(columns)]
    wide = len(points) > 0 and np.nanmax(np.abs(points), initial=0.0) > FLOAT32_MM
    header = ["ply", "format binary_little_endian 1.0", *([f"comment {comment}"] if comment else [])]
    header += [f"element vertex {len(points)}"]
    header += [f"property {'double' if wide else 'float'} {name}" for name in names] + ["end_header", ""]
    with write_whole(path) as temporary, open(temporary, "wb") as file:
        file.write("\n".join(header).encode())
        file.write(np.column_stack(columns).astype("<f8" if wide else "<f4").tobytes())


def _bounds(points: ArrayLike) -> tuple[Floats, Floats]:
    """Lowest and highest x, y, z of the finite points; zeros where there are none."""
    finite = np.asarray(points, dtype=float)
    if not np.isfinite(finite).all():
        finite = finite[np.isfinite(finite).all(axis=1)]
    if len(finite) == 0:
        return np.zeros(3), np.zeros(3)
    return np.array([column.min() for column in finite.T]), np.array([column.max() for column in finite.T])
