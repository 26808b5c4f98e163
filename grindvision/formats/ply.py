"""PLY files: text or binary of either byte order; vertices and the faces of a mesh."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from grindvision.errors import FileError
from grindvision.formats.content import Content
from grindvision.formats.meshes import check_faces, fans
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
from grindvision.records import by_content

Integers = NDArray[np.int64]

PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
FACE_LISTS = ("vertex_indices", "vertex_index")
ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}


@by_content
@dataclass(frozen=True)
class _Element:
    """An element of the header: properties' ``names`` and ``types``; of a list the types of its length and of its
    items."""

    name: str
    count: int
    names: list[str] = field(default_factory=list)
    types: list[tuple[str, ...]] = field(default_factory=list)

    def kinds(self, path: Path, order: str) -> list[tuple[str, ...]]:
        """NumPy types of the properties."""
        for name, words in zip(self.names, self.types, strict=True):
            for word in words:
                if word not in PLY_TYPES:
                    raise FileError(
                        f"{path}: {self.name} property {name} is of type {word}, which is not read; export plain"
                        " numbers"
                    )
        return [tuple(order + PLY_TYPES[word] for word in words) for words in self.types]

    def plain_kinds(self, path: Path, order: str) -> list[str]:
        """NumPy types of the properties of an element without lists."""
        for name, words in zip(self.names, self.types, strict=True):
            if len(words) > 1:
                raise FileError(
                    f"{path}: {self.name} property {name} is of type list, which is not read; export plain numbers"
                )
        return [kind for (kind,) in self.kinds(path, order)]


def read_ply(path: Path, file: BinaryIO) -> Content:
    """Read the vertices of a PLY file, x y z and, where it has them, nx ny nz, and its faces; polygons become fans of
    triangles, everything else is passed over.

    Raises:
        FileError: no PLY, no vertices, a property that is not read, a face of vertices that are not there, or shorter
            than its header says.
    """
    if file.readline(100).strip() != b"ply":
        raise FileError(f"{path}: does not begin with 'ply'; is it a PLY file?")
    form, elements = _header(path, file)
    if form != "ascii" and form not in ORDERS:
        raise FileError(f"{path}: PLY format {form!r} is unknown; use ascii or binary")
    found: Content | None = None
    triangles: Integers | None = None
    last = max((k for k, one in enumerate(elements) if one.name == "vertex" or _is_faces(one)), default=-1)
    for element in elements[: last + 1]:
        if element.name == "vertex":
            found = _vertices(path, file, element, form)
        elif _is_faces(element):
            triangles = _faces(path, file, element, form)
        else:
            _pass_over(path, file, element, form)
    if found is None:
        raise FileError(f"{path}: the header has no element vertex; export it as a plain point cloud")
    if triangles is not None:
        check_faces(path, triangles, len(found.points))
        return replace(found, triangles=triangles if len(triangles) else None)
    if any(one.count and one.name in ("face", "tristrips") for one in elements):
        return replace(
            found, note="its faces are stored as strips or without corners and are not read; its vertices are"
        )
    return found


def _is_faces(element: _Element) -> bool:
    return element.name == "face" and element.count > 0 and any(name in FACE_LISTS for name in element.names)


def _vertices(path: Path, file: BinaryIO, element: _Element, form: str) -> Content:
    kinds = element.plain_kinds(path, ORDERS.get(form, "="))
    if form != "ascii":
        return content_of_records(path, file, element.count, element.names, kinds)
    return content_of_rows(path, numbers(path, text_lines(path, file, element.count, len(kinds))), element.names)


def _faces(path: Path, file: BinaryIO, element: _Element, form: str) -> Integers:
    """Triangles (T, 3) of the faces."""
    at = next(k for k, name in enumerate(element.names) if name in FACE_LISTS)
    kinds = element.kinds(path, ORDERS.get(form, "="))
    if len(kinds[at]) != 2:
        raise FileError(f"{path}: face property {element.names[at]} is no list; export the mesh again")
    if form == "ascii":
        return _faces_of_text(path, text_lines(path, file, element.count, 2 * len(kinds), "faces"), kinds, at)
    same = _faces_of_one_size(path, file, element.count, kinds, at)
    return _faces_of_any_size(path, file, element.count, kinds, at) if same is None else same


def _faces_of_text(path: Path, lines: Sequence[str], kinds: Sequence[tuple[str, ...]], at: int) -> Integers:
    faces = []
    try:
        for line in lines:
            words, here = line.split(), 0
            for kind in kinds[:at]:
                here += 1 if len(kind) == 1 else 1 + int(words[here])
            count = int(words[here])
            face = [int(word) for word in words[here + 1 : here + 1 + count]]
            if count < 0 or len(face) < count:
                raise ValueError(f"{count} corners announced, {len(face)} there")
            faces.append(face)
    except (ValueError, IndexError) as error:
        raise FileError(f"{path}: a face is damaged ({error}); export the mesh again") from None
    return fans(path, faces)


def _faces_of_one_size(
    path: Path, file: BinaryIO, count: int, kinds: Sequence[tuple[str, ...]], at: int
) -> Integers | None:
    """Triangles (T, 3), where all lists are as long as the first record's; None, and the file as it was, where not."""
    start = file.tell()
    fields: list[tuple[str, str] | tuple[str, str, int]] = []
    lengths = []
    for k, kind in enumerate(kinds):
        if len(kind) == 1:
            fields.append((f"{k}", kind[0]))
            file.seek(np.dtype(kind[0]).itemsize, 1)
            continue
        length = _list_length(path, file, kind)
        lengths.append((f"n{k}", length))
        fields += [(f"n{k}", kind[0]), (f"{k}", kind[1], length)]
        file.seek(length * np.dtype(kind[1]).itemsize, 1)
    file.seek(start)
    record = np.dtype(fields)
    if count * record.itemsize > bytes_left(file):
        return None
    check_memory(path, 2 * count * record.itemsize + 32 * count * max(length for _, length in lengths))
    rows = np.fromfile(file, dtype=record, count=count)
    if not all((rows[name] == length).all() for name, length in lengths):
        file.seek(start)
        return None
    corners = _whole(rows[f"{at}"])
    size = corners.shape[1]
    if size < 3:
        return np.empty((0, 3), dtype=np.int64)
    return np.stack([corners[:, [0, k, k + 1]] for k in range(1, size - 1)], axis=1).reshape(-1, 3)


def _faces_of_any_size(path: Path, file: BinaryIO, count: int, kinds: Sequence[tuple[str, ...]], at: int) -> Integers:
    if count > bytes_left(file):
        raise too_short(path, count, f"the file holds {bytes_left(file)} bytes", "faces")
    faces = []
    for _ in range(count):
        for k, kind in enumerate(kinds):
            if len(kind) == 1:
                _number(path, file, kind[0])
                continue
            item = np.dtype(kind[1])
            items = np.frombuffer(file.read(_list_length(path, file, kind) * item.itemsize), dtype=item)
            if k == at:
                faces.append(_whole(items).tolist())
    return fans(path, faces)


def _list_length(path: Path, file: BinaryIO, kind: tuple[str, ...]) -> int:
    """How many items the list at this place of a binary file has; all of them are there.

    Raises:
        FileError: no count, or more than the file holds.
    """
    length = _number(path, file, kind[0])
    if not (length >= 0 and length * np.dtype(kind[1]).itemsize <= bytes_left(file)):
        raise FileError(f"{path}: a face of {length:g} corners, which it does not hold; it is cut short or damaged")
    return int(length)


def _whole(items: NDArray[np.generic]) -> Integers:
    """Items of a list as whole numbers; what is none becomes one that no vertex has."""
    with np.errstate(invalid="ignore"):
        return items.astype(np.int64)


def _number(path: Path, file: BinaryIO, kind: str) -> float:
    """The next number of a binary file."""
    size = np.dtype(kind).itemsize
    data = file.read(size)
    if len(data) < size:
        raise FileError(f"{path}: it ends within element face; it is cut short or damaged")
    return float(np.frombuffer(data, dtype=kind)[0])


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
            elements[-1].types.append(tuple(words[2:4]) if words[1] == "list" else (words[1],))
            elements[-1].names.append(words[-1].lower())
    return form, elements


def _pass_over(path: Path, file: BinaryIO, element: _Element, form: str) -> None:
    """Skip an element that stands before the vertices."""
    if form == "ascii":
        for _ in range(element.count):
            if not file.readline():
                raise FileError(f"{path}: it ends within element {element.name}; it is cut short or damaged")
        return
    size = element.count * sum(np.dtype(kind).itemsize for kind in element.plain_kinds(path, "<"))
    if size > bytes_left(file):
        raise FileError(f"{path}: it ends within element {element.name}; it is cut short or damaged")
    file.seek(size, 1)
