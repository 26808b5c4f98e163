"""STL and OBJ meshes. Materials and textures that an OBJ names are not looked at."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from grindvision.errors import FileError
from grindvision.formats.content import Content
from grindvision.formats.records import numbers, refuse_binary
from grindvision.input_files import read_rest

Floats = NDArray[np.float64]

STL_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])

#: Stored normals that tell something at least, and the fraction of them that tells that a mesh is mirrored.
FEWEST_NORMALS, NEARLY_ALL = 12, 0.99

#: What a triangle takes while its mesh is read: its bytes, strings, corners, edges, and the sorting of its vertices.
MEMORY_PER_MESH_BYTE = 12.0

#: Vertices stand for the surface where edges longer than this fraction of the diagonal bound little of its area.
LONG_EDGE, MAX_LONG = 0.02, 0.05
#: Distance of samples, fraction of the diagonal, and how many there are at most.
SAMPLE_STEP, MAX_SAMPLES = 1 / 700, 1_000_000


def read_stl(path: Path, file: BinaryIO) -> Content:
    """Read an STL file, text or binary.

    Raises:
        FileError: no STL, or shorter than its header says.
    """
    data = read_rest(path, file, MEMORY_PER_MESH_BYTE)
    count = int(np.frombuffer(data[80:84].ljust(4, b"\0"), dtype="<u4")[0])
    if data.lstrip().startswith(b"solid") and len(data) != 84 + 50 * count:
        lines = [line.strip() for line in data.decode("latin-1").splitlines()]
        corners = [line.removeprefix("vertex") for line in lines if line.startswith("vertex")]
        if len(corners) % 3 or not any(line.startswith("endsolid") for line in lines[-3:]):
            raise FileError(f"{path}: the STL text does not end with endsolid; it is cut short or damaged")
        table = numbers(path, corners)
        if table.shape[1] != 3:
            raise FileError(f"{path}: a corner has {table.shape[1]} numbers instead of 3; export the mesh again")
        return _surface(table.reshape(-1, 3, 3))
    if len(data) < 84 + 50 * count:
        raise FileError(
            f"{path}: the header announces {count} triangles, the file holds {max(len(data) - 84, 0)} bytes;"
            " it is cut short or damaged"
        )
    records = np.frombuffer(data, STL_RECORD, count, 84)
    found = _surface(records["corners"].astype(float))
    return replace(found, note="; ".join(filter(None, (found.note, _inside_out(records)))))


def _inside_out(records: NDArray[np.void]) -> str:
    """In words, where nearly all normals that a binary STL stores point against the order of their corners."""
    corners, stored = records["corners"].astype(float), records["normal"].astype(float)
    with np.errstate(all="ignore"):
        wound = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        along = (wound * stored).sum(axis=1)
    told = np.isfinite(along) & (along != 0)
    if told.sum() < FEWEST_NORMALS or (along[told] < 0).mean() < NEARLY_ALL:
        return ""
    return (
        f"{(along[told] < 0).mean():.0%} of its {told.sum():,} normals point against the order of the corners, as in a"
        " mirrored (left-handed) export; if it is one, say --mirrored x, y or z, the axis that counts the wrong way"
    )


def read_obj(path: Path, file: BinaryIO) -> Content:
    """Read the vertices and faces of an OBJ file; polygons become fans of triangles.

    Raises:
        FileError: text among the numbers, or a face of vertices that are not there.
    """
    refuse_binary(path, file)
    lines = read_rest(path, file, MEMORY_PER_MESH_BYTE).decode("latin-1").splitlines()
    rows = [" ".join(line.split()[1:4]) for line in lines if line.startswith(("v ", "v\t"))]
    vertices = numbers(path, rows)
    if vertices.shape[1] != 3:
        raise FileError(f"{path}: a vertex has {vertices.shape[1]} numbers instead of 3; export the mesh again")
    try:
        faces = [
            [int(word.split("/", 1)[0]) for word in line.split()[1:]]
            for line in lines
            if line.startswith(("f ", "f\t"))
        ]
    except ValueError as error:
        raise FileError(f"{path}: a face is damaged ({error}); export the mesh again") from None
    if any(index == 0 or abs(index) > len(vertices) for face in faces for index in face):
        raise FileError(f"{path}: a face names a vertex that is not among the {len(vertices)}; the file is damaged")
    triangles = np.array([(face[0], *face[k : k + 2]) for face in faces for k in range(1, len(face) - 1)], dtype=int)
    if len(triangles) == 0:
        return Content(vertices)
    at = np.where(triangles > 0, triangles - 1, triangles + len(vertices))
    return _surface(vertices[at], vertices)


def _surface(triangles: Floats, vertices: Floats | None = None) -> Content:
    """The vertices where they stand closely enough for the surface (T, 3, 3), else points sampled evenly on it."""
    if vertices is None:
        vertices = np.unique(triangles.reshape(-1, 3), axis=0)
    triangles = triangles[np.isfinite(triangles).all(axis=(1, 2))]
    edges = np.roll(triangles, -1, axis=1) - triangles
    normals = np.cross(edges[:, 0], edges[:, 1])
    areas = np.linalg.norm(normals, axis=1) / 2
    if len(triangles) == 0 or not 0 < areas.sum() < np.inf:
        return Content(vertices, mesh=True)
    diagonal = float(np.linalg.norm(np.ptp(triangles.reshape(-1, 3), axis=0)))
    long = np.linalg.norm(edges, axis=2).max(axis=1) > LONG_EDGE * diagonal
    if areas[long].sum() <= MAX_LONG * areas.sum():
        return Content(vertices, mesh=True)
    count = int(min(areas.sum() / (SAMPLE_STEP * diagonal) ** 2, MAX_SAMPLES))
    ends = np.round(np.cumsum(areas) / areas.sum() * count).astype(int)
    owner = np.repeat(np.arange(len(triangles)), np.diff(ends, prepend=0))
    return Content(
        _spread(triangles[owner]),
        normals[owner] / (2 * areas[owner, None]),
        note=f"a mesh of {len(triangles):,} triangles too large to stand for its surface by their corners;"
        f" {len(owner):,} points were spread evenly over it",
        mesh=True,
    )


def _spread(triangles: Floats) -> Floats:
    """One point in each of (N, 3, 3) triangles, by the additive sequence that fills a square most evenly."""
    golden = 1.324717957244746
    first, second = (np.arange(len(triangles))[:, None] * [1 / golden, 1 / golden**2] % 1.0).T
    over = first + second > 1
    first, second = np.where(over, 1 - first, first), np.where(over, 1 - second, second)
    corner, one, other = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    return corner + first[:, None] * (one - corner) + second[:, None] * (other - corner)
