"""Point clouds and their files: PLY, PCD, XYZ/ASC/CSV, NPY, STL and OBJ in, binary PLY out; millimetres inside.

Sizes that a header announces are compared with the file's before memory is taken.
"""

from __future__ import annotations

import io
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import FileError, GrindvisionWarning, InputError, UnitError
from grindvision.files import write_whole

Floats = NDArray[np.float64]

TABLES = (".xyz", ".asc", ".txt", ".csv")
MESHES = (".stl", ".obj")
FORMATS = (".ply", ".pcd", *TABLES, ".npy", *MESHES)
MM_PER = {"mm": 1.0, "m": 1000.0}

SMALLEST_MM, LARGEST_MM = 5.0, 20_000.0
"""Diagonals of scans of parts that an arm can work on; outside, the unit is in doubt."""

PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
POINT, NORMAL = ("x", "y", "z"), ("nx", "ny", "nz")
PCD_NORMAL = ("normal_x", "normal_y", "normal_z")


@dataclass(frozen=True)
class Cloud:
    """Points (N, 3) in mm and, where known, unit normals (N, 3).

    ``grid`` is (rows, columns) of an organised cloud, whose points are stored row by row; None otherwise.
    """

    points: Floats
    normals: Floats | None = None
    grid: tuple[int, int] | None = None

    def __len__(self) -> int:
        return len(self.points)

    def __str__(self) -> str:
        size = extent(self.points)
        return f"{len(self.points):,} points over {size[0]:.1f} x {size[1]:.1f} x {size[2]:.1f} mm"


def read_cloud(path: str | Path, unit: str = "mm") -> Cloud:
    """Read a cloud file and return it in millimetres; a mesh gives its vertices. NaN points are kept as they are.

    Args:
        path: file with one of the suffixes in ``FORMATS``.
        unit: unit of the numbers in the file, ``mm`` or ``m``.

    Raises:
        FileError: missing, empty, damaged, shorter than its header says, or of an unknown format.
        InputError: unknown unit.
    """
    path = Path(path)
    if unit not in MM_PER:
        raise InputError(f"unit {unit!r} is unknown; choose one of {', '.join(MM_PER)}")
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise FileError(f"{path}: format {suffix or '(none)'} is not read; use one of {', '.join(FORMATS)}")
    if not path.is_file():
        raise FileError(f"{path}: no such file; check the path")
    try:
        if path.stat().st_size == 0:
            raise FileError(f"{path}: the file is empty")
        cloud = _reader(suffix)(path)
    except OSError as error:
        raise FileError(f"{path}: cannot be read ({error.strerror or error})") from None
    if len(cloud) == 0:
        raise FileError(f"{path}: no points could be read; is the file damaged?")
    return Cloud(cloud.points * MM_PER[unit], cloud.normals, cloud.grid)


def finite_points(cloud: Cloud, name: str) -> Floats:
    """The cloud's points (N, 3) without those that hold NaN or infinity; how many were dropped is a warning.

    Raises:
        FileError: no finite point is left.
    """
    if np.isfinite(cloud.points).all():
        return cloud.points
    finite = np.isfinite(cloud.points).all(axis=1)
    if not finite.any():
        raise FileError(f"{name}: all {len(cloud)} points hold NaN or infinity; scan again or export again")
    warnings.warn(
        f"{name}: {int((~finite).sum())} of {len(cloud)} points hold NaN or infinity and were dropped",
        GrindvisionWarning,
        stacklevel=2,
    )
    return cloud.points[finite]


def check_unit(points: ArrayLike, name: str, unit: str) -> None:
    """Refuse a cloud whose size in mm says that its file's numbers have another unit than ``unit``.

    Raises:
        UnitError: the diagonal is below ``SMALLEST_MM`` or above ``LARGEST_MM``.
    """
    diagonal = float(np.linalg.norm(extent(points)))
    other = {"mm": "m", "m": "mm"}[unit]
    if 0 < diagonal < SMALLEST_MM and unit == "mm":
        raise UnitError(f"{name}: only {diagonal:.3g} mm across; the numbers look like metres, say --unit {other}")
    if diagonal > LARGEST_MM:
        hint = f"the numbers look like millimetres, say --unit {other}" if unit == "m" else "remove far outliers"
        raise UnitError(f"{name}: {diagonal:.3g} mm across; {hint}")


def extent(points: ArrayLike) -> Floats:
    """Size (3,) along x, y, z of the finite points among (N, 3); zeros where there are none."""
    points = np.asarray(points, dtype=float)
    if not np.isfinite(points).all():
        points = points[np.isfinite(points).all(axis=1)]
    return np.array([np.ptp(column) for column in points.T]) if len(points) else np.zeros(3)


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


def _reader(suffix: str):
    if suffix in TABLES:
        return _read_table
    return {".ply": _read_ply, ".pcd": _read_pcd, ".npy": _read_npy}.get(suffix, _read_mesh)


def _read_table(path: Path) -> Cloud:
    try:
        lines = path.read_text(encoding="utf-8-sig").translate(str.maketrans(",;\t", "   ")).splitlines()
    except UnicodeDecodeError:
        raise FileError(f"{path}: not a text table of x y z") from None
    lines = [line for line in lines if line.strip() and not line.lstrip().startswith(("#", "//"))]
    if lines and not _is_number(lines[0].split()[0]):
        lines = lines[1:]
    return _cloud_of_rows(path, _numbers(path, lines), [*POINT])


def _read_npy(path: Path) -> Cloud:
    try:
        rows = np.load(path, allow_pickle=False, mmap_mode="r")
    except (ValueError, EOFError) as error:
        raise FileError(f"{path}: not a NumPy array of numbers ({' '.join(str(error).split())})") from None
    if rows.dtype.kind not in "iuf" or rows.ndim not in (2, 3) or rows.shape[-1] < 3:
        raise FileError(f"{path}: array of shape {rows.shape} and type {rows.dtype}; expected numbers of shape (N, 3)")
    grid = rows.shape[:2] if rows.ndim == 3 else None
    return Cloud(np.array(rows[..., :3], dtype=float).reshape(-1, 3), None, grid)


def _read_ply(path: Path) -> Cloud:
    with open(path, "rb") as file:
        if file.readline(100).strip() != b"ply":
            raise FileError(f"{path}: does not begin with 'ply'; is it a PLY file?")
        form, elements = "", []
        for words in _header_lines(path, file, b"end_header"):
            if words[0] == "format" and len(words) > 1:
                form = words[1]
            elif words[0] == "element" and len(words) == 3 and words[2].isdigit():
                elements.append((words[1], int(words[2]), []))
            elif words[0] == "property" and elements and len(words) > 2:
                elements[-1][2].append(words[1:])
        if not elements or elements[0][0] != "vertex":
            raise FileError(f"{path}: the PLY file does not begin with its vertices; export it as a plain point cloud")
        _, count, properties = elements[0]
        try:
            names = [words[-1] for words in properties]
            kinds = [PLY_TYPES[words[0]] for words in properties]
        except KeyError as error:
            raise FileError(f"{path}: vertex property type {error} is not read; export plain numbers") from None
        if form == "ascii":
            return _cloud_of_rows(path, _ascii_rows(path, file, count, len(names)), names)
        order = {"binary_little_endian": "<", "binary_big_endian": ">"}.get(form)
        if order is None:
            raise FileError(f"{path}: PLY format {form!r} is unknown; use ascii or binary")
        return _cloud_of_records(path, file, count, names, [order + kind for kind in kinds])


def _read_pcd(path: Path) -> Cloud:
    header: dict[str, list[str]] = {}
    with open(path, "rb") as file:
        for words in _header_lines(path, file, b"DATA"):
            header[words[0].upper()] = words[1:]
        try:
            names, sizes, kinds = header["FIELDS"], header["SIZE"], header["TYPE"]
            counts = [int(word) for word in header.get("COUNT", ["1"] * len(names))]
            width, height = int(header["WIDTH"][0]), int(header["HEIGHT"][0])
            types = ["<" + kind.lower() + size for kind, size in zip(kinds, sizes, strict=True)]
            columns = [(name, kind, number) for name, kind, number in zip(names, types, counts, strict=True)]
            np.dtype([(str(at), kind) for at, (_, kind, _) in enumerate(columns)])
            form = header["DATA"][0]
        except (KeyError, IndexError, ValueError, TypeError):
            raise FileError(f"{path}: the PCD header is damaged; export the cloud again") from None
        count = width * height
        grid = (height, width) if height > 1 else None
        if form == "ascii":
            flat = [name if number == 1 else f"{name}_{k}" for name, _, number in columns for k in range(number)]
            cloud = _cloud_of_rows(path, _ascii_rows(path, file, count, len(flat)), flat)
        elif form == "binary":
            flat = [(name if k == 0 else f"{name}_{k}", kind) for name, kind, number in columns for k in range(number)]
            cloud = _cloud_of_records(path, file, count, [name for name, _ in flat], [kind for _, kind in flat])
        elif form == "binary_compressed":
            cloud = _read_compressed(path, file, count, sum(np.dtype(kind).itemsize * n for _, kind, n in columns))
        else:
            raise FileError(f"{path}: PCD data {form!r} is unknown; use ascii, binary or binary_compressed")
    return Cloud(cloud.points, cloud.normals, grid)


def _read_compressed(path: Path, file: BinaryIO, count: int, row_bytes: int) -> Cloud:
    import open3d as o3d

    packed, unpacked = (int(size) for size in np.frombuffer(file.read(8).ljust(8, b"\0"), dtype="<u4"))
    left = path.stat().st_size - file.tell()
    if unpacked != count * row_bytes or packed > left or unpacked > 300 * max(packed, 1):
        raise FileError(
            f"{path}: the header announces {count} points, the file holds {left} bytes; it is cut short or damaged"
        )
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        cloud = o3d.io.read_point_cloud(str(path), remove_nan_points=False, remove_infinite_points=False)
    return Cloud(np.asarray(cloud.points), np.asarray(cloud.normals) if cloud.has_normals() else None)


def _read_mesh(path: Path) -> Cloud:
    import open3d as o3d

    with open(path, "rb") as file:
        start = file.read(84)
    if path.suffix.lower() == ".stl" and not start.lstrip().startswith(b"solid"):
        triangles = int(np.frombuffer(start[80:84].ljust(4, b"\0"), dtype="<u4")[0])
        if 84 + 50 * triangles > path.stat().st_size:
            raise FileError(
                f"{path}: the header announces {triangles} triangles, the file is shorter; it is cut short or damaged"
            )
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        mesh = o3d.io.read_triangle_mesh(str(path))
    points = np.asarray(mesh.vertices)
    if path.suffix.lower() == ".stl" and len(points):
        points = np.unique(points, axis=0)
    return Cloud(points)


def _header_lines(path: Path, file: BinaryIO, last: bytes):
    """Words of each header line up to and including the one that begins with ``last``."""
    for _ in range(1000):
        line = file.readline(10_000)
        if not line:
            break
        try:
            words = line.decode("ascii").split()
        except UnicodeDecodeError:
            break
        if words:
            yield words
        if line.startswith(last):
            return
    raise FileError(f"{path}: the header has no {last.decode()} line; the file is cut short or damaged")


def _ascii_rows(path: Path, file: BinaryIO, count: int, columns: int) -> Floats:
    left = path.stat().st_size - file.tell()
    if 2 * columns * count > left + 1:
        raise FileError(
            f"{path}: the header announces {count} points, the file holds {left} bytes; it is cut short or damaged"
        )
    text = file.read().decode("ascii", errors="replace").splitlines()
    lines = [line for line in text if line.strip()][:count]
    if len(lines) < count:
        raise FileError(
            f"{path}: the header announces {count} points, the file holds {len(lines)}; it is cut short or damaged"
        )
    return _numbers(path, lines)


def _numbers(path: Path, lines: list[str]) -> Floats:
    if not lines:
        raise FileError(f"{path}: no points in the file")
    try:
        return np.loadtxt(io.StringIO("\n".join(lines)), ndmin=2, comments=None)
    except ValueError as error:
        raise FileError(f"{path}: not a table of numbers ({' '.join(str(error).split())})") from None


def _cloud_of_rows(path: Path, rows: Floats, names: list[str]) -> Cloud:
    if rows.shape[1] < 3 or not set(POINT) <= set(names):
        raise FileError(f"{path}: rows need x y z; found {rows.shape[1]} columns {' '.join(names)}")

    def columns(wanted: tuple[str, ...]) -> Floats | None:
        return (
            np.ascontiguousarray(rows[:, [names.index(name) for name in wanted]]) if set(wanted) <= set(names) else None
        )

    if rows.shape[1] < len(names):
        raise FileError(f"{path}: rows have {rows.shape[1]} columns, the header names {len(names)}")
    normals = columns(NORMAL)
    return Cloud(columns(POINT), columns(PCD_NORMAL) if normals is None else normals)


def _cloud_of_records(path: Path, file: BinaryIO, count: int, names: list[str], kinds: list[str]) -> Cloud:
    """Fixed-size binary records; only the columns asked for are converted."""
    fields = [f"{name}#{at}" for at, name in enumerate(names)]
    record = np.dtype(list(zip(fields, kinds, strict=True)))
    left = path.stat().st_size - file.tell()
    if count * record.itemsize > left:
        raise FileError(
            f"{path}: the header announces {count} points of {record.itemsize} bytes, the file holds {left} bytes; it"
            " is cut short or damaged"
        )
    rows = np.fromfile(file, dtype=record, count=count)

    def columns(wanted: tuple[str, ...]) -> Floats | None:
        if not set(wanted) <= set(names):
            return None
        if tuple(names) == wanted and len(set(kinds)) == 1:
            return rows.view(kinds[0]).reshape(count, 3).astype(float)
        table = np.empty((count, 3))
        for k, name in enumerate(wanted):
            table[:, k] = rows[fields[names.index(name)]]
        return table

    points = columns(POINT)
    if points is None:
        raise FileError(f"{path}: points need x y z; found {' '.join(names)}")
    normals = columns(NORMAL)
    return Cloud(points, columns(PCD_NORMAL) if normals is None else normals)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
