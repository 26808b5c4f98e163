"""NumPy files: an array (N, 3 or more) or, organised, (rows, columns, 3 or more); nothing pickled is loaded."""

from __future__ import annotations

import lzma
import math
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, BinaryIO

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from grindvision.errors import FileError
from grindvision.formats.content import Content
from grindvision.input_files import bytes_left, check_memory, open_input

#: Measured points never pack tighter than this; what does is no cloud.
LARGEST_RATIO = 100

#: What NumPy and zipfile raise over damaged files, besides an OSError.
DAMAGED = (
    zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error, EOFError, ValueError, SyntaxError, TypeError,
    LookupError, OverflowError, MemoryError, NotImplementedError, RuntimeError, tokenize.TokenError,
)  # fmt: skip


@dataclass(frozen=True)
class _Header:
    """Shape, order and type of the array that follows."""

    shape: tuple[int, ...]
    fortran_order: bool
    kind: np.dtype

    @property
    def size(self) -> int:
        """Bytes of the array."""
        return math.prod(self.shape) * self.kind.itemsize


def read_npy(path: Path, file: BinaryIO) -> Content:
    """Read a .npy file.

    Raises:
        FileError: no array of numbers of a cloud's shape, or shorter than its header says.
    """
    header = _header(path, file)
    _check_cloud(path, header)
    if header.size > bytes_left(file):
        raise FileError(
            f"{path}: the header announces {header.size} bytes, the file holds {bytes_left(file)};"
            " it is cut short or damaged"
        )
    if header.size == 0:
        return Content(np.empty((0, 3)))
    order = "F" if header.fortran_order else "C"
    return _content(path, np.memmap(file, header.kind, "r", file.tell(), header.shape, order))  # type: ignore[call-overload]


def read_npz(path: Path, file: BinaryIO) -> Content:
    """Read the array ``points`` of a .npz file, or its only array.

    Raises:
        FileError: damaged, several arrays and none of them named points, packed so tightly that it is no cloud.
    """
    with _archive(path, file) as archive:
        inside = {Path(entry.filename).stem: entry for entry in archive.infolist()}
        name = "points" if "points" in inside else next(iter(inside), None)
        if name is None or (name != "points" and len(inside) > 1):
            known = ", ".join(inside)[:80] or "none"
            raise FileError(f"{path}: arrays {known}; name the cloud's array 'points' or store it alone")
        entry = inside[name]
        if entry.file_size > LARGEST_RATIO * max(entry.compress_size, 1):
            raise FileError(
                f"{path}: {entry.compress_size} bytes unpack to {entry.file_size}; that is no measured cloud"
            )
        with archive.open(entry) as packed:
            header = _header(path, packed)
            _check_cloud(path, header)
            return _content(path, _unpacked(path, name, packed, header, entry.file_size))


def read_arrays(path: str | Path, names: Sequence[str], largest: int) -> dict[str, NDArray[np.float64]]:
    """The named arrays of numbers of a .npz file that unpacks to no more than ``largest`` bytes.

    Raises:
        FileError: missing, damaged, larger, or without one of the arrays.
    """
    path = Path(path)
    with open_input(path) as file, _archive(path, file) as archive:
        inside = {Path(entry.filename).stem: entry for entry in archive.infolist()}
        if sum(entry.file_size for entry in archive.infolist()) > largest:
            raise FileError(f"{path}: it unpacks to more than {largest} bytes; check the path")
        if missing := [name for name in names if name not in inside]:
            known = ", ".join(inside)[:80] or "none"
            raise FileError(f"{path}: no array {missing[0]} in it, only {known}; check the path")
        arrays = {}
        for name in names:
            with archive.open(inside[name]) as packed:
                rows = _unpacked(path, name, packed, _header(path, packed), inside[name].file_size)
                arrays[name] = rows.astype(float)
        return arrays


@contextmanager
def _archive(path: Path, file: BinaryIO) -> Iterator[zipfile.ZipFile]:
    """A .npz file, whatever is wrong with it told as one error."""
    try:
        with zipfile.ZipFile(file) as archive:
            yield archive
    except DAMAGED as error:
        raise _no_array(path, error) from None


def _header(path: Path, file: IO[bytes]) -> _Header:
    """What a .npy header announces; leaves the file behind it."""
    try:
        version = npy.read_magic(file)
        read_header = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}.get(version)
        if read_header is None:
            raise FileError(f"{path}: a NumPy file of an unknown version; save a plain array of numbers")
        shape, fortran_order, kind = read_header(file)
    except DAMAGED as error:
        raise _no_array(path, error) from None
    if not all(type(length) is int and 0 <= length < 1 << 60 for length in shape):
        raise FileError(f"{path}: its header gives a shape that is none; the file is damaged, save it again")
    if kind.kind not in "iuf":
        raise FileError(f"{path}: array of shape {shape} and type {str(kind)[:40]}; expected plain numbers")
    return _Header(shape, fortran_order, kind)


def _check_cloud(path: Path, header: _Header) -> None:
    shape = header.shape
    if len(shape) not in (2, 3) or shape[-1] < 3:
        raise FileError(f"{path}: array of shape {shape}; expected numbers of shape (N, 3)")
    if len(shape) == 2 and shape[0] == 3 and shape[1] > 30:
        raise FileError(f"{path}: array of shape {shape}; expected (N, 3): save it transposed")


def _unpacked(path: Path, name: str, packed: IO[bytes], header: _Header, held: int) -> np.ndarray:
    """The array behind a header inside an archive, which holds so many bytes in all."""
    if header.size > held:
        raise FileError(
            f"{path}: the header of {name} announces {header.size} bytes, the file holds {held}; it is"
            " cut short or damaged"
        )
    check_memory(path, 2 * header.size)
    data = packed.read(header.size)
    if len(data) != header.size:
        raise FileError(f"{path}: {name} ends early; it is cut short or damaged")
    return np.frombuffer(data, header.kind).reshape(header.shape, order="F" if header.fortran_order else "C")


def _content(path: Path, rows: np.ndarray) -> Content:
    grid = (rows.shape[0], rows.shape[1]) if rows.ndim == 3 else None
    check_memory(path, 2 * 24 * math.prod(rows.shape[:-1]))
    return Content(np.array(rows[..., :3], dtype=float).reshape(-1, 3), None, grid)


def _no_array(path: Path, error: Exception) -> FileError:
    return FileError(f"{path}: not a NumPy array of numbers ({' '.join(str(error).split())[:120]}); save it again")
