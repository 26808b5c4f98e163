"""Controller poses as numbers in a file: which convention of rotation, unit and direction they follow.

A convention is stated by the user. Others are tried on the side, so that a wrong one can be named; none is ever taken
in the place of the stated one.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from grindvision.errors import FileError, InputError
from grindvision.formats.tables import SAMPLE, punctuation
from grindvision.geometry import check_rigid, inverse
from grindvision.input_files import open_input, read_rest
from grindvision.records import by_content

Floats = NDArray[np.float64]

#: Rotation of a maker's controller -> (notation, unit of its angles). Capitals: intrinsic Euler angles, the second
#: rotation about the axis that the first one moved; small letters: extrinsic ones, about fixed axes.
MAKERS: dict[str, tuple[str, str]] = {
    "ur": ("rotation-vector", "rad"),
    "ur-rpy": ("xyz", "rad"),
    "abb": ("quaternion-wxyz", "rad"),
    "kuka": ("ZYX", "deg"),
    "fanuc": ("xyz", "deg"),
    "yaskawa": ("xyz", "deg"),
    "staubli": ("XYZ", "deg"),
    "doosan": ("ZYZ", "deg"),
}

EULER = re.compile("[xyz]{3}|[XYZ]{3}")
NOTATIONS = ("rotation-vector", "quaternion-wxyz", "quaternion-xyzw", "matrix")

#: What is tried beside the stated notation, by the count of its numbers.
COMMON = {3: ("rotation-vector", "xyz", "ZYX", "XYZ", "ZYZ"), 4: ("quaternion-wxyz", "quaternion-xyzw"), 9: ("matrix",)}

#: Columns of a pose: three of position with so many of rotation; a matrix has 12 or 16 numbers, row by row.
COUNTS = {6: 3, 7: 4, 12: 9, 16: 9}

#: A quaternion read from print may have a norm so far from one.
QUATERNION_TOLERANCE = 1e-2


@by_content
@dataclass(frozen=True)
class PoseConvention:
    """How a row of numbers says a pose.

    ``rotation``: ``rotation-vector``, ``quaternion-wxyz``, ``quaternion-xyzw``, ``matrix``, or Euler angles by their
    axes (``ZYX`` intrinsic, ``zyx`` extrinsic); ``angles`` in ``rad`` or ``deg``; ``length`` in ``mm`` or ``m``;
    ``rotation_first``: the rotation's numbers stand before the position's; ``inverted``: the pose is T_flange_base.
    """

    rotation: str
    angles: str = "rad"
    length: str = "mm"
    rotation_first: bool = False
    inverted: bool = False

    @property
    def numbers(self) -> int:
        """How many numbers say the rotation."""
        return {"quaternion-wxyz": 4, "quaternion-xyzw": 4, "matrix": 9}.get(self.rotation, 3)

    def __str__(self) -> str:
        words = [f"--rotation {self.rotation}"]
        if self.numbers == 3:
            words.append(f"--angles {self.angles}")
        words.append(f"--pose-unit {self.length}")
        words += ["--rotation-first"] * self.rotation_first + ["--inverse-poses"] * self.inverted
        return " ".join(words)


def convention(rotation: str, angles: str | None = None, length: str = "mm", **flags: bool) -> PoseConvention:
    """The convention of a maker (``MAKERS``), of ``NOTATIONS`` or of Euler axes.

    Raises:
        InputError: unknown name, or Euler angles without their unit.
    """
    notation, usual = MAKERS.get(rotation.lower(), (rotation, None))
    if notation not in NOTATIONS and not (EULER.fullmatch(notation) and _sequence(notation)):
        raise InputError(
            f"rotation {rotation!r} is unknown; use one of {', '.join((*MAKERS, *NOTATIONS))}, or three Euler axes"
            " (ZYX about moved axes, zyx about fixed ones)"
        )
    if notation == "rotation-vector":
        usual = "rad"
    made = PoseConvention(notation, angles or usual or "rad", length, **flags)
    if angles is None and usual is None and made.numbers == 3:
        raise InputError(f"rotation {rotation}: say --angles deg or rad")
    return made


def read_pose_rows(path: str | Path) -> Floats:
    """Numbers (N, C) of a table of poses, a row each, C of ``COUNTS``; commas, semicolons, tabs or blanks between.

    A first line of words is a header, and lines that begin with # are comments. A comma is the decimal point where
    something else parts the columns.

    Raises:
        FileError: missing or empty file, no numbers, rows of different lengths, a count that is no pose's.
    """
    with open_input(path) as file:
        text = read_rest(path, file, 20).decode("utf-8-sig", errors="replace")
    if "\0" in text:
        raise FileError(f"{path}: not a plain text table; save it as UTF-8 text")
    lines = [line.partition("#")[0].strip("[] \t") for line in text.splitlines()]
    decimal_comma = punctuation([line for line in lines if re.match(r"[-+.]?\d", line)][:SAMPLE])[1]
    rows: list[list[float]] = []
    header = False
    for number, line in enumerate(lines, start=1):
        words = [word for word in re.split(r"[;\s]+" if decimal_comma else r"[,;\s]+", line) if word]
        if not words:
            continue
        try:
            row = [float(word.replace(",", ".")) for word in words]
        except ValueError:
            if not rows and not header:
                header = True
                continue
            raise FileError(f"{path}: line {number} is no row of numbers ({line[:60]!r}); mend it") from None
        if not np.isfinite(row).all():
            raise FileError(f"{path}: line {number} holds NaN or infinity; take the pose and its cloud out")
        if rows and len(row) != len(rows[0]):
            raise FileError(f"{path}: line {number} has {len(row)} numbers, the first {len(rows[0])}; mend it")
        rows.append(row)
    if not rows:
        raise FileError(f"{path}: no rows of numbers; a pose a line: x y z and its rotation")
    if len(rows[0]) not in COUNTS:
        raise FileError(
            f"{path}: {len(rows[0])} numbers a line; a pose has 6 (position and three angles), 7 (a quaternion), 12 or"
            " 16 (a matrix); take other columns out"
        )
    return np.array(rows)


def poses_from(rows: ArrayLike, stated: PoseConvention, name: str = "poses") -> Floats:
    """Transforms T_base_flange (N, 4, 4), mm, of rows of numbers (N, C) by a convention.

    Raises:
        InputError: the count of numbers is another convention's; a quaternion is not of length one.
        NotRigidError: a matrix is no rigid transform.
    """
    rows = np.asarray(rows, dtype=float)
    count = COUNTS.get(rows.shape[1])
    if count != stated.numbers:
        fitting = ", ".join(COMMON.get(count or 0, ())) or "none"
        raise InputError(
            f"{name}: {rows.shape[1]} numbers a row, but --rotation {stated.rotation} has {stated.numbers} beside the"
            f" position's three; with so many columns: {fitting}"
        )
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    if count == 9:
        poses[:, :3] = rows[:, :12].reshape(-1, 3, 4)
        if rows.shape[1] == 16:
            poses[:, 3] = rows[:, 12:]
        for row, pose in enumerate(poses, start=1):
            check_rigid(pose, f"{name}: pose {row}", tolerance=1e-3)
    else:
        turn, place = (rows[:, :count], rows[:, count:]) if stated.rotation_first else (rows[:, 3:], rows[:, :3])
        poses[:, :3, :3] = _rotations(turn, stated, name)
        poses[:, :3, 3] = place
    poses[:, :3, 3] *= 1000.0 if stated.length == "m" else 1.0
    return inverse(poses) if stated.inverted else poses


def other_conventions(stated: PoseConvention, rows: ArrayLike) -> Iterator[PoseConvention]:
    """Common conventions that rows (N, C) may follow, without the stated one; each gives other poses than it."""
    rows = np.asarray(rows, dtype=float)
    count = COUNTS[rows.shape[1]]
    flips = (False, True)
    units = ("rad", "deg") if count == 3 else ("rad",)
    for rotation in dict.fromkeys((stated.rotation, *COMMON[count])):
        for angles in units:
            for length in ("mm", "m"):
                for first in flips if count in (3, 4) else (False,):
                    for inverted in flips:
                        other = PoseConvention(rotation, angles, length, first, inverted)
                        if other != stated and other.numbers == count and _plausible(rows, other):
                            yield other


def makers_of(stated: PoseConvention) -> str:
    """Makers whose controllers show such numbers, in brackets; nothing where none does."""
    said = (stated.rotation, stated.angles)
    names = [maker for maker, usual in MAKERS.items() if usual == said]
    return f" ({', '.join(names)})" if names else ""


def _plausible(rows: Floats, tried: PoseConvention) -> bool:
    count = tried.numbers
    if count == 9:
        return True
    turn, place = (rows[:, :count], rows[:, count:]) if tried.rotation_first else (rows[:, 3:], rows[:, :3])
    if count == 4:
        return bool(np.abs(np.linalg.norm(turn, axis=1) - 1).max() < QUATERNION_TOLERANCE)
    farthest = np.abs(place).max() * (1000 if tried.length == "m" else 1)
    return bool(np.abs(turn).max() <= (2 * np.pi + 0.1 if tried.angles == "rad" else 361) and farthest < 20_000)


def _rotations(numbers: Floats, stated: PoseConvention, name: str) -> Floats:
    if stated.rotation == "rotation-vector":
        scale = np.pi / 180 if stated.angles == "deg" else 1.0
        return Rotation.from_rotvec(numbers * scale).as_matrix()
    if stated.rotation.startswith("quaternion"):
        off = np.abs(np.linalg.norm(numbers, axis=1) - 1)
        if off.max() > QUATERNION_TOLERANCE:
            row = int(np.argmax(off))
            raise InputError(
                f"{name}: the quaternion of pose {row + 1} has length {np.linalg.norm(numbers[row]):.3g}, not 1; does"
                " the position stand before the rotation (else say --rotation-first), are all four numbers there?"
            )
        order = [1, 2, 3, 0] if stated.rotation == "quaternion-wxyz" else [0, 1, 2, 3]
        return Rotation.from_quat(numbers[:, order]).as_matrix()
    return Rotation.from_euler(stated.rotation, numbers, degrees=stated.angles == "deg").as_matrix()


def _sequence(axes: str) -> bool:
    """Whether no axis follows itself."""
    return all(a != b for a, b in pairwise(axes))
