"""PLY files: text or binary of either byte order; of a mesh the vertices are read."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import BinaryIO

import numpy as np

from grindvision.errors import FileError
from grindvision.formats.content import Content
from grindvision.formats.records import (
    content_of_records,
    content_of_rows,
    count_in_header,
    header_lines,
    numbers,
)
from grindvision.formats.records import text_lines as next_lines
from grindvision.input_files import bytes_left
from grindvision.records import by_content

PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}


@by_content
@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    names: list[str] = field(default_factory=list)
    types: list[str] = field(default_factory=list)

    def kinds(self, path: Path, order: str) -> list[str]:
        """NumPy types of the properties."""
        for name, word in zip(self.names, self.types, strict=True):
            if word not in PLY_TYPES:
                raise FileError(
                    f"{path}: {self.name} property {name} is of type {word}, which is not read; export plain numbers"
                )
        return [order + PLY_TYPES[word] for word in self.types]


def read_ply(path: Path, file: BinaryIO) -> Content:
    """Read the vertices of a PLY file: x y z and, where it has them, nx ny nz; everything else is passed over.

    Raises:
        FileError: no PLY, no vertices, a property that is no plain number, or shorter than its header says.
    """
    if file.readline(100).strip() != b"ply":
        raise FileError(f"{path}: does not begin with 'ply'; is it a PLY file?")
    form, elements = _header(path, file)
    if form != "ascii" and form not in ORDERS:
        raise FileError(f"{path}: PLY format {form!r} is unknown; use ascii or binary")
    for element in elements:
        if element.name == "vertex":
            kinds = element.kinds(path, ORDERS.get(form, "="))
            if form != "ascii":
                found = content_of_records(path, file, element.count, element.names, kinds)
            else:
                rows = numbers(path, next_lines(path, file, element.count, len(kinds)))
                found = content_of_rows(path, rows, element.names)
            return replace(found, mesh=any(other.name == "face" and other.count for other in elements))
        _pass_over(path, file, element, form)
    raise FileError(f"{path}: the header has no element vertex; export it as a plain point cloud")


def _header(path: Path, file: BinaryIO) -> tuple[str, list[_Element]]:
    form: str = ""
    elements: list[_Element] = []
    for words in header_lines(path, file, b"end_header"):
        if words[0] == "format" and len(words) > 1:
            form = words[1]
        elif words[0] == "element":
            if len(words) != 3:
                raise FileError(f"{path}: header line {' '.join(words)[:60]!r} has no count; the file is damaged")
            elements.append(_Element(words[1], count_in_header(path, words[2])))
        elif words[0] == "property" and elements and len(words) > 2:
            elements[-1].types.append(words[1])
            elements[-1].names.append(words[-1].lower())
    return form, elements


def _pass_over(path: Path, file: BinaryIO, element: _Element, form: str) -> None:
    """Skip an element that stands before the vertices."""
    if form == "ascii":
        for _ in range(element.count):
            if not file.readline():
                raise FileError(f"{path}: it ends within element {element.name}; it is cut short or damaged")
        return
    size = element.count * sum(np.dtype(kind).itemsize for kind in element.kinds(path, "<"))
    if size > bytes_left(file):
        raise FileError(f"{path}: it ends within element {element.name}; it is cut short or damaged")
    file.seek(size, 1)
