"""NumPy files: an array (N, 3 or more) or, organised, (rows, columns, 3 or more); nothing pickled is loaded."""

from __future__ import annotations

import math
import tokenize
import zipfile
import zlib
from pathlib import Path
from typing import IO

import numpy as np
from numpy.lib import format as npy

from grindvision.errors import FileError
from grindvision.formats.content import Content
from grindvision.formats.records import bytes_left

#: Measured points never pack tighter than this; what does is no cloud.
LARGEST_RATIO = 100


def read_npy(path: Path) -> Content:
    """Read a .npy file.

    Raises:
        FileError: no array of numbers of a cloud's shape, or shorter than its header says.
    """
    with open(path, "rb") as file:
        size = _announced_bytes(path, file)
        if size > bytes_left(path, file):
            raise FileError(
                f"{path}: the header announces {size} bytes, the file holds {bytes_left(path, file)};"
                " it is cut short or damaged"
            )
    return _content(path, np.load(path, allow_pickle=False, mmap_mode="r"))


def read_npz(path: Path) -> Content:
    """Read the array ``points`` of a .npz file, or its only array.

    Raises:
        FileError: damaged, several arrays and none of them named points, packed so tightly that it is no cloud.
    """
    try:
        with zipfile.ZipFile(path) as archive:
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
            with archive.open(entry) as file:
                size = _announced_bytes(path, file)
            if size > entry.file_size:
                raise FileError(
                    f"{path}: the header of {name} announces {size} bytes, the file holds {entry.file_size}; it is"
                    " cut short or damaged"
                )
            with archive.open(entry) as file:
                return _content(path, npy.read_array(file, allow_pickle=False))
    except (zipfile.BadZipFile, zlib.error, EOFError, ValueError, NotImplementedError, RuntimeError) as error:
        raise _no_array(path, error) from None


def _announced_bytes(path: Path, file: IO[bytes]) -> int:
    """Size of the array that a .npy header announces; leaves the file behind the header."""
    try:
        version = npy.read_magic(file)
        read_header = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}[version]
        shape, _, kind = read_header(file)
    except KeyError:
        raise FileError(f"{path}: a NumPy file of an unknown version; save a plain array of numbers") from None
    except (ValueError, EOFError, SyntaxError, TypeError, RecursionError, tokenize.TokenError) as error:
        raise _no_array(path, error) from None
    if kind.kind not in "iuf" or len(shape) not in (2, 3) or min(shape) < 0 or shape[-1] < 3:
        raise FileError(f"{path}: array of shape {shape} and type {kind}; expected numbers of shape (N, 3)")
    if len(shape) == 2 and shape[0] == 3 and shape[1] > 30:
        raise FileError(f"{path}: array of shape {shape}; expected (N, 3): save it transposed")
    return math.prod(shape) * kind.itemsize


def _content(path: Path, rows: np.ndarray) -> Content:
    grid = (rows.shape[0], rows.shape[1]) if rows.ndim == 3 else None
    return Content(np.array(rows[..., :3], dtype=float).reshape(-1, 3), None, grid)


def _no_array(path: Path, error: Exception) -> FileError:
    return FileError(f"{path}: not a NumPy array of numbers ({' '.join(str(error).split())[:120]}); save it again")
