"""Point clouds and their files: PLY, PCD, XYZ/ASC, STL and OBJ in, binary PLY out; millimetres inside."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import FileError, InputError
from grindvision.files import write_whole

Floats = NDArray[np.float64]

FORMATS = (".ply", ".pcd", ".xyz", ".asc", ".txt", ".stl", ".obj")
MM_PER = {"mm": 1.0, "m": 1000.0}


@dataclass(frozen=True)
class Cloud:
    """Points (N, 3) in mm and, where known, unit normals (N, 3)."""

    points: Floats
    normals: Floats | None = None

    def __len__(self) -> int:
        return len(self.points)

    def __str__(self) -> str:
        size = np.ptp(self.points, axis=0) if len(self.points) else np.zeros(3)
        return f"{len(self.points):,} points over {size[0]:.1f} x {size[1]:.1f} x {size[2]:.1f} mm"


def read_cloud(path: str | Path, unit: str = "mm") -> Cloud:
    """Read a cloud file and return it in millimetres; a mesh gives its vertices. NaN points are kept as they are.

    Args:
        path: file with one of the suffixes in ``FORMATS``.
        unit: unit of the numbers in the file, ``mm`` or ``m``.

    Raises:
        FileError: missing, empty, damaged or of an unknown format. InputError: unknown unit.
    """
    path = Path(path)
    if unit not in MM_PER:
        raise InputError(f"unit {unit!r} is unknown; choose one of {', '.join(MM_PER)}")
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise FileError(f"{path}: format {suffix or '(none)'} is not read; use one of {', '.join(FORMATS)}")
    if not path.is_file():
        raise FileError(f"{path}: no such file; check the path")
    if path.stat().st_size == 0:
        raise FileError(f"{path}: the file is empty")
    points, normals = _read_text(path) if suffix in (".xyz", ".asc", ".txt") else _read_open3d(path)
    if len(points) == 0:
        raise FileError(f"{path}: no points could be read; is the file damaged?")
    return Cloud(points * MM_PER[unit], normals)


def write_ply(path: str | Path, points: ArrayLike, normals: ArrayLike | None = None) -> None:
    """Write points (N, 3) and unit normals (N, 3) as a binary little-endian PLY of float32, whole or not at all."""
    points = np.asarray(points)
    columns = [points] if normals is None else [points, np.asarray(normals)]
    names = ["x", "y", "z", "nx", "ny", "nz"][: 3 * len(columns)]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    header += [f"property float {name}" for name in names] + ["end_header", ""]
    with write_whole(path) as temporary, open(temporary, "wb") as file:
        file.write("\n".join(header).encode())
        file.write(np.column_stack(columns).astype("<f4").tobytes())


def _read_text(path: Path) -> tuple[Floats, Floats | None]:
    try:
        text = path.read_text(encoding="utf-8")
        rows = np.array(
            [line.replace(",", " ").replace(";", " ").split() for line in text.splitlines() if line.strip()]
        )
        values = rows.astype(float)
    except (UnicodeDecodeError, ValueError) as error:
        raise FileError(f"{path}: not a table of numbers ({' '.join(str(error).split())})") from None
    if values.ndim != 2 or values.shape[1] < 3:
        raise FileError(f"{path}: rows need at least x y z")
    return values[:, :3], None


def _read_open3d(path: Path) -> tuple[Floats, Floats | None]:
    import open3d as o3d

    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        if path.suffix.lower() in (".stl", ".obj"):
            mesh = o3d.io.read_triangle_mesh(str(path))
            return np.asarray(mesh.vertices), None
        cloud = o3d.io.read_point_cloud(str(path))
    normals = np.asarray(cloud.normals) if cloud.has_normals() else None
    return np.asarray(cloud.points), normals
