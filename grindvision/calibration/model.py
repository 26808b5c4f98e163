"""The error model: an arm, a scanner on its last joint, a tracker, and how each unknown moves a measured point."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.arm import PARAMETERS, MdhArm, joint_transforms, joint_twists, moved_by_twist, parameter_twists
from grindvision.errors import InputError
from grindvision.geometry import move_points, skew, small_motion

Floats = NDArray[np.float64]

#: Points whose slopes are worked on at a time: few enough for the processor's cache.
BLOCK = 512

_MOTION = ("x_mm", "y_mm", "z_mm", "rx_rad", "ry_rad", "rz_rad")


@dataclass(frozen=True)
class ScannerOnArm:
    """An arm, the scanner on its last joint (``T_joint_scanner``) and the tracker looking on (``T_tracker_base``)."""

    arm: MdhArm
    T_joint_scanner: Floats
    T_tracker_base: Floats

    def points_base(self, q_rad: ArrayLike, points_scanner: ArrayLike) -> Floats:
        """Points (..., 3) of the scanner's frame, seen at joint angles (..., n), in the arm's base frame (Eq 9)."""
        return carry(self, q_rad, points_scanner).base_mm

    def points_tracker(self, q_rad: ArrayLike, points_scanner: ArrayLike) -> Floats:
        """Points (..., 3) of the scanner's frame, seen at joint angles (..., n), in the tracker's frame."""
        return carry(self, q_rad, points_scanner).tracker_mm

    def __str__(self) -> str:
        x, y, z = self.T_joint_scanner[:3, 3]
        return f"{self.arm}; scanner at ({x:.3f}, {y:.3f}, {z:.3f}) mm in the last joint's frame"


@dataclass(frozen=True)
class Unknowns:
    """Which numbers are sought: the scanner's small motion, entries of the MDH table, the base's small motion.

    ``scanner`` is 6 (motion), 3 (shift only) or 0 columns, ``table`` numbers the entries of the flattened MDH table,
    ``base`` is 6 or 0 columns. ``names`` carry the units; the number in ``d3_mm`` is the row of the table, so
    ``alpha3_rad`` is the paper's alpha_2.
    """

    scanner: int
    table: tuple[int, ...]
    base: int

    @property
    def names(self) -> tuple[str, ...]:
        """One name with unit per unknown, in column order."""
        motion = [[f"{part}_{name}" for name in _MOTION] for part in ("scanner", "base")]
        return (*motion[0][: self.scanner], *(entry_name(i) for i in self.table), *motion[1][: self.base])

    @property
    def is_angle(self) -> NDArray[np.bool_]:
        """Flags (K,) of the unknowns measured in radians."""
        return np.array([name.endswith("_rad") for name in self.names], dtype=bool)

    @property
    def in_table(self) -> NDArray[np.bool_]:
        """Flags (K,) of the unknowns that are entries of the MDH table."""
        flags = np.zeros(len(self), dtype=bool)
        flags[self.scanner : self.scanner + len(self.table)] = True
        return flags

    def __len__(self) -> int:
        return self.scanner + len(self.table) + self.base


def entry_name(entry: int) -> str:
    """Name of an entry of the flattened MDH table: 0 is ``alpha1_rad``, 12 is ``d3_mm``."""
    quantity, unit = PARAMETERS[entry % 5].split("_")
    return f"{quantity}{entry // 5 + 1}_{unit}"


def table_entries(arm: MdhArm, names: Sequence[str] | None = None) -> tuple[int, ...]:
    """Entries of the flattened MDH table to estimate: those named, or the usual ones.

    The usual ones are alpha, a, d and theta of every joint, and Hayati's beta where an axis is nominally parallel to
    the one before it (behind the first joint): there, and only there, the other four do not suffice.

    Raises:
        InputError: a name that is no entry of this arm's table.
    """
    if names is None:
        parallel = np.abs(np.sin(arm.table[:, 0])) < 0.02
        return tuple(i for i in range(5 * arm.n) if i % 5 < 4 or (i >= 5 and parallel[i // 5]))
    known = {entry_name(i): i for i in range(5 * arm.n)}
    wrong = [name for name in names if name not in known]
    if wrong:
        raise InputError(f"{wrong[0]!r} is no entry of this arm's table; its entries are {', '.join(known)}")
    return tuple(sorted({known[name] for name in names}))


@dataclass(frozen=True)
class CarriedPoints:
    """M points of the scanner's frame carried through a cell: what residuals and slopes have in common.

    ``frames`` (M, n + 1, 4, 4) are the ``joint_transforms`` at joint angles ``q_rad`` (M, n); ``joint_mm`` and
    ``base_mm`` (M, 3) the points in the last joint's and in the base frame.
    """

    cell: ScannerOnArm
    q_rad: Floats
    scanner_mm: Floats
    frames: Floats
    joint_mm: Floats
    base_mm: Floats

    @property
    def tracker_mm(self) -> Floats:
        """The points (M, 3) in the tracker's frame."""
        return move_points(self.cell.T_tracker_base, self.base_mm)

    def moved(self, unknowns: Unknowns, step: ArrayLike) -> CarriedPoints:
        """Return the same points carried through the cell with a step (K,) of its unknowns carried out."""
        cell = moved_cell(self.cell, unknowns, step)
        return carry(cell, self.q_rad, self.scanner_mm, None if unknowns.table else self.frames)

    def blocks(self) -> Iterator[tuple[slice, CarriedPoints]]:
        """Parts of at most ``BLOCK`` points, with the rows they are."""
        for first in range(0, len(self.base_mm), BLOCK):
            rows = slice(first, first + BLOCK)
            parts = {
                name: getattr(self, name)[rows] for name in ("q_rad", "scanner_mm", "frames", "joint_mm", "base_mm")
            }
            yield rows, CarriedPoints(self.cell, **parts)

    def design(self, unknowns: Unknowns) -> Floats:
        """How each unknown moves each point in the tracker's frame, (M, 3, K), see ``design_matrix``."""
        columns = []
        if unknowns.scanner:
            columns.append(self.frames[..., -1, :3, :3] @ _motion_columns(self.joint_mm)[..., : unknowns.scanner])
        if unknowns.table:
            twists = parameter_twists(self.cell.arm, self.q_rad, self.frames)[..., list(unknowns.table)]
            columns.append(moved_by_twist(twists, self.base_mm))
        if unknowns.base:
            columns.append(_motion_columns(self.base_mm))
        return self.cell.T_tracker_base[:3, :3] @ np.concatenate(columns, axis=-1)

    def slopes(self) -> Floats:
        """How each joint angle moves each point in the tracker's frame, (M, 3, n) in mm per rad."""
        twists = joint_twists(self.cell.arm, self.q_rad, self.frames)
        return self.cell.T_tracker_base[:3, :3] @ moved_by_twist(twists, self.base_mm)


def carry(
    cell: ScannerOnArm, q_rad: ArrayLike, points_scanner: ArrayLike, frames: Floats | None = None
) -> CarriedPoints:
    """Carry points (M, 3) of the scanner's frame, seen at joint angles (M, n), through the cell.

    ``frames`` are the ``joint_transforms`` there, where they are known already.
    """
    q, points = np.asarray(q_rad, dtype=float), np.asarray(points_scanner, dtype=float)
    frames = joint_transforms(cell.arm, q) if frames is None else frames
    joint = move_points(cell.T_joint_scanner, points)
    base = np.einsum("...ij,...j->...i", frames[..., -1, :3, :3], joint) + frames[..., -1, :3, 3]
    return CarriedPoints(cell, q, points, frames, joint, base)


def design_matrix(cell: ScannerOnArm, q_rad: ArrayLike, points_scanner: ArrayLike, unknowns: Unknowns) -> Floats:
    """How each unknown moves each measured point in the tracker's frame, (M, 3, K): G_i of Eqs 10-16, in closed form.

    Columns in mm per mm and mm per rad. The scanner moves in the last joint's frame (Eq 10), the base in its own frame.
    """
    return carry(cell, q_rad, points_scanner).design(unknowns)


def joint_slopes(cell: ScannerOnArm, q_rad: ArrayLike, points_scanner: ArrayLike) -> Floats:
    """How each joint angle moves each measured point in the tracker's frame, (M, 3, n) in mm per rad."""
    return carry(cell, q_rad, points_scanner).slopes()


def moved_cell(cell: ScannerOnArm, unknowns: Unknowns, step: ArrayLike) -> ScannerOnArm:
    """Return the cell with a step (K,) of its unknowns carried out, to first order what ``design_matrix`` says."""
    step = np.asarray(step, dtype=float)
    table = np.zeros(5 * cell.arm.n)
    table[list(unknowns.table)] = step[unknowns.in_table]
    twist_scanner, twist_base = np.zeros(6), np.zeros(6)
    twist_scanner[: unknowns.scanner] = step[: unknowns.scanner]
    twist_base[: unknowns.base] = step[len(step) - unknowns.base :]
    return replace(
        cell,
        arm=cell.arm.changed_by(table),
        T_joint_scanner=small_motion(twist_scanner) @ cell.T_joint_scanner,
        T_tracker_base=cell.T_tracker_base @ small_motion(twist_base),
    )


def _motion_columns(points: Floats) -> Floats:
    shifts = np.broadcast_to(np.eye(3), (*points.shape[:-1], 3, 3))
    return np.concatenate([shifts, -skew(points)], axis=-1)
