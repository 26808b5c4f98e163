"""PCD files of the Point Cloud Library: text, binary, and binary packed with LZF."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from grindvision.errors import FileError
from grindvision.formats.content import Content, Floats, chosen_columns
from grindvision.formats.records import (
    content_of_records,
    content_of_rows,
    count_in_header,
    header_lines,
    numbers,
    text_lines,
    too_short,
)
from grindvision.input_files import bytes_left, check_memory
from grindvision.kernels import njit
from grindvision.records import by_content

#: NumPy types by TYPE and SIZE of a field.
PCD_TYPES = {
    (kind, str(size)): f"<{kind.lower()}{size}" for kind in "FIU" for size in (1, 2, 4, 8) if (kind, size) != ("F", 1)
}

#: LZF packs no run tighter than 264 bytes into 3.
LARGEST_RATIO = 88
MAX_VALUES_PER_POINT = 4096


@by_content
@dataclass(frozen=True)
class _Header:
    """Columns one by one (a field with COUNT 3 gives three), their number, and how the table is stored."""

    names: list[str]
    kinds: list[str]
    fields: list[tuple[str, int]]
    width: int
    height: int
    form: str

    @property
    def count(self) -> int:
        return self.width * self.height


def read_pcd(path: Path, file: BinaryIO) -> Content:
    """Read a PCD file: x y z and, where it has them, normal_x normal_y normal_z; an organised cloud keeps its grid.

    Raises:
        FileError: no PCD, a damaged header, an unknown kind of data, or shorter than its header says.
    """
    header = _header(path, file)
    if header.form == "ascii":
        rows = numbers(path, text_lines(path, file, header.count, len(header.names)))
        found = content_of_rows(path, rows, header.names)
    elif header.form == "binary":
        found = content_of_records(path, file, header.count, header.names, header.kinds)
    elif header.form == "binary_compressed":
        found = _compressed(path, file, header)
    else:
        raise FileError(f"{path}: PCD data {header.form!r} is unknown; use ascii, binary or binary_compressed")
    grid = (header.height, header.width) if min(header.height, header.width) > 1 else None
    return Content(found.points, found.normals, grid)


def _header(path: Path, file: BinaryIO) -> _Header:
    said: dict[str, list[str]] = {}
    for words in header_lines(path, file, b"DATA"):
        said[words[0].upper()] = words[1:]
    try:
        counts = [count_in_header(path, word) for word in said.get("COUNT", ["1"] * len(said["FIELDS"]))]
        if min(counts) < 1 or sum(counts) > MAX_VALUES_PER_POINT:
            raise ValueError
        fields = [
            (PCD_TYPES[kind.upper(), size], count)
            for kind, size, count in zip(said["TYPE"], said["SIZE"], counts, strict=True)
        ]
        names = [
            name.lower() if k == 0 else f"{name.lower()}_{k}"
            for name, count in zip(said["FIELDS"], counts, strict=True)
            for k in range(count)
        ]
        width, height = (count_in_header(path, said[name][0]) for name in ("WIDTH", "HEIGHT"))
        form = said["DATA"][0]
    except (KeyError, IndexError, ValueError, TypeError):
        raise FileError(f"{path}: the PCD header is damaged; export the cloud again") from None
    points = said.get("POINTS", [str(width * height)])
    if points != [str(width * height)]:
        raise FileError(f"{path}: POINTS {' '.join(points)} is not WIDTH {width} x HEIGHT {height}; export it again")
    return _Header(names, [kind for kind, count in fields for _ in range(count)], fields, width, height, form)


def _compressed(path: Path, file: BinaryIO, header: _Header) -> Content:
    """Unpack; the values stand field by field, not point by point."""
    count = header.count
    packed_size, size = (int(word) for word in np.frombuffer(file.read(8).ljust(8, b"\0"), dtype="<u4"))
    left = bytes_left(file)
    record = sum(np.dtype(kind).itemsize * number for kind, number in header.fields)
    if size != count * record or packed_size > left or size > LARGEST_RATIO * max(packed_size, 1):
        raise too_short(path, count, f"the file holds {left} packed bytes")
    check_memory(path, 4.0 * size)
    unpacked = unpack_lzf(np.frombuffer(file.read(packed_size), dtype=np.uint8), size)
    if len(unpacked) != size:
        raise FileError(f"{path}: the packed points cannot be unpacked; the file is damaged, export the cloud again")
    columns: list[NDArray[np.generic]] = []
    begin = 0
    for kind, number in header.fields:
        end = begin + count * number * np.dtype(kind).itemsize
        columns += list(unpacked[begin:end].view(kind).reshape(count, number).T)
        begin = end
    point, normal = chosen_columns(header.names)
    if point is None:
        raise FileError(f"{path}: points need x y z; found {' '.join(header.names)}")

    def table(chosen: Sequence[int]) -> Floats:
        return np.stack([columns[k] for k in chosen], axis=1).astype(float)

    return Content(table(point), None if normal is None else table(normal))


@njit(cache=True)
def unpack_lzf(packed: NDArray[np.uint8], size: int) -> NDArray[np.uint8]:
    """Unpack LZF bytes into ``size`` bytes; an empty array where they do not give exactly that."""
    out = np.empty(size, np.uint8)
    at, filled = 0, 0
    while at < len(packed):
        control: Any = np.int64(packed[at])
        at += 1
        if control < 32:
            length = control + 1
            if at + length > len(packed) or filled + length > size:
                return out[:0]
            out[filled : filled + length] = packed[at : at + length]
            at += length
        else:
            length = control >> 5
            if length == 7:
                if at >= len(packed):
                    return out[:0]
                length += np.int64(packed[at])
                at += 1
            length += 2
            if at >= len(packed):
                return out[:0]
            start = filled - ((control & 31) << 8) - np.int64(packed[at]) - 1
            at += 1
            if start < 0 or filled + length > size:
                return out[:0]
            for k in range(length):
                out[filled + k] = out[start + k]
        filled += length
    return out if filled == size else out[:0]
