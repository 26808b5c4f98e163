"""STL and OBJ meshes. Materials and textures that an OBJ names are not looked at."""

from __future__ import annotations

from collections.abc import Sequence
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
Integers = NDArray[np.int64]

STL_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])

#: Stored normals that tell something at least, and the fraction of them that tells that a mesh is mirrored.
FEWEST_NORMALS, NEARLY_ALL = 12, 0.99

#: What a triangle takes while its mesh is read: its bytes, strings, corners, edges, and the sorting of its vertices.
MEMORY_PER_MESH_BYTE = 12.0


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
        return _indexed(table.reshape(-1, 3, 3))
    if len(data) < 84 + 50 * count:
        raise FileError(
            f"{path}: the header announces {count} triangles, the file holds {max(len(data) - 84, 0)} bytes;"
            " it is cut short or damaged"
        )
    records = np.frombuffer(data, STL_RECORD, count, 84)
    return replace(_indexed(records["corners"].astype(float)), note=_inside_out(records))


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
    faces, so_far = [], 0
    try:
        for line in lines:
            if line.startswith(("v ", "v\t")):
                so_far += 1
            elif line.startswith(("f ", "f\t")):
                face = [int(word.split("/", 1)[0]) for word in line.split()[1:]]
                faces.append([at - 1 if at > 0 else so_far + at if at < 0 else -1 for at in face])  # -1 is the last
    except ValueError as error:
        raise FileError(f"{path}: a face is damaged ({error}); export the mesh again") from None
    triangles = fans(path, faces)
    check_faces(path, triangles, len(vertices))
    return Content(vertices, triangles=triangles if len(triangles) else None)


def fans(path: Path, faces: Sequence[Sequence[int]]) -> Integers:
    """Triangles (T, 3) of polygons, each a list of its corners.

    Raises:
        FileError: the number of a corner has more digits than any file has vertices.
    """
    triangles = [(face[0], *face[k : k + 2]) for face in faces for k in range(1, len(face) - 1)]
    try:
        return np.array(triangles, dtype=np.int64).reshape(-1, 3)
    except OverflowError:
        raise FileError(f"{path}: a face names a vertex of more than 18 digits; the file is damaged") from None


def check_faces(path: Path, triangles: Integers, vertices: int) -> None:
    """Refuse triangles (T, 3) that name others than so many vertices.

    Raises:
        FileError: they do.
    """
    if len(triangles) and not (triangles.min() >= 0 and triangles.max() < vertices):
        raise FileError(f"{path}: a face names a vertex that is not among the {vertices}; the file is damaged")


def _indexed(corners: Floats) -> Content:
    """Triangles (T, 3, 3) as vertices, none of them twice, and rows of them."""
    vertices, rows = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    return Content(vertices, triangles=rows.reshape(-1, 3).astype(np.int64))
