"""Models: the surface of a good part as triangles, from STL, OBJ and PLY files. Millimetres inside."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from grindvision.clouds import MM_PER, Cloud, cloud_of, extent, read_content
from grindvision.errors import FileError, GrindvisionWarning, InputError
from grindvision.formats.content import Content
from grindvision.records import by_content

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


@by_content
@dataclass(frozen=True)
class Model:
    """A triangle mesh: ``vertices`` (V, 3) in mm and ``triangles`` (T, 3), rows of them, counter-clockwise seen from
    outside.

    It may be open, and hold degenerate triangles or some that are wound the wrong way: who uses it sorts that out.
    ``stated_unit`` is the unit that the file itself names, if it does.
    """

    vertices: Floats
    triangles: Integers
    stated_unit: str | None = None

    def __post_init__(self) -> None:
        vertices, triangles = np.asarray(self.vertices, dtype=float), np.asarray(self.triangles)
        if vertices.ndim != 2 or vertices.shape[1] != 3:
            raise InputError(f"vertices of a model have shape {vertices.shape}; give (V, 3)")
        if triangles.ndim != 2 or triangles.shape[1] != 3 or not np.issubdtype(triangles.dtype, np.integer):
            raise InputError(
                f"triangles of a model have shape {triangles.shape}, type {triangles.dtype}; give whole numbers (T, 3)"
            )
        if len(triangles) == 0 or triangles.min() < 0 or triangles.max() >= len(vertices):
            raise InputError(
                f"a model of {len(triangles)} triangles names vertices that are not among the {len(vertices)}, or none"
            )
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "triangles", triangles.astype(np.int64))

    @property
    def corners(self) -> Floats:
        """Corners (T, 3, 3) of the triangles in mm."""
        return self.vertices[self.triangles]

    def mirrored(self, axis: str) -> Model:
        """The model with its numbers along an axis, x, y or z, counted the other way, and its triangles wound so that
        the outside stays outside."""
        signs = np.where(np.array(["x", "y", "z"]) == axis, -1.0, 1.0)
        return Model(self.vertices * signs, self.triangles[:, ::-1].copy(), self.stated_unit)

    def __len__(self) -> int:
        return len(self.triangles)

    def __str__(self) -> str:
        size = extent(self.vertices[np.unique(self.triangles)])
        return f"model of {len(self):,} triangles over {size[0]:.1f} x {size[1]:.1f} x {size[2]:.1f} mm"


def read_model(path: str | Path, unit: str | None = None) -> Model:
    """Read a triangle mesh, STL, OBJ or PLY with faces, in millimetres.

    Args:
        path: file with faces; polygons become fans of triangles.
        unit: unit of the numbers in the file, ``mm``, ``cm``, ``m`` or ``in``; left out: mm.

    Returns:
        Vertices (V, 3) in mm in the frame of the file, and triangles (T, 3), rows of them.

    Raises:
        FileError: missing, empty, damaged or of an unknown format; the file has no faces. InputError: unknown unit.

    Warns:
        GrindvisionWarning: the normals that a binary STL stores speak of a mirrored export.

    Example:
        >>> from grindvision import read_model
        >>> corners = [(0, 0, 0), (9, 0, 0), (0, 9, 0), (0, 0, 9)]
        >>> lines = ["v {} {} {}".format(*corner) for corner in corners]
        >>> lines += ["f 1 3 2", "f 1 2 4", "f 1 4 3", "f 2 3 4"]
        >>> _ = open("wedge.obj", "w").write("\\n".join(lines))
        >>> print(read_model("wedge.obj"))
        model of 4 triangles over 9.0 x 9.0 x 9.0 mm
    """
    content = read_content(path, unit)
    if content.triangles is None:
        raise FileError(
            f"{path}: no faces in the file, {len(content.points)} points; export a mesh, or read it as a cloud"
        )
    return _model_of(path, content, content.triangles, unit)


def read_cloud_or_model(path: str | Path, unit: str | None = None) -> Cloud | Model:
    """A model where most of the file's points are corners of faces, else a cloud; as ``read_model``, ``read_cloud``."""
    content = read_content(path, unit)
    if content.triangles is None or 2 * len(np.unique(content.triangles)) < len(content.points):
        return cloud_of(path, content, unit)
    return _model_of(path, content, content.triangles, unit)


def _model_of(path: str | Path, content: Content, triangles: Integers, unit: str | None) -> Model:
    if content.note:
        warnings.warn(f"{path}: {content.note}", GrindvisionWarning, stacklevel=3)
    return Model(content.points * MM_PER[unit or content.unit or "mm"], triangles, content.unit)
