"""The error model: an arm, a scanner on its last joint, a tracker, and how each unknown moves a measured point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.arm import PARAMETERS, MdhArm, forward, joint_twists, moved_by_twist, parameter_twists
from grindvision.errors import InputError
from grindvision.geometry import move_points, skew, small_motion

Floats = NDArray[np.float64]

_MOTION = ("x_mm", "y_mm", "z_mm", "rx_rad", "ry_rad", "rz_rad")


@dataclass(frozen=True)
class ScannerOnArm:
    """An arm, the scanner on its last joint (``T_joint_scanner``) and the tracker looking on (``T_tracker_base``)."""

    arm: MdhArm
    T_joint_scanner: Floats
    T_tracker_base: Floats

    def points_base(self, q_rad: ArrayLike, points_scanner: ArrayLike) -> Floats:
        """Points (..., 3) of the scanner's frame, seen at joint angles (..., n), in the arm's base frame (Eq 9)."""
        T_base_joint = forward(self.arm, q_rad)
        points_joint = move_points(self.T_joint_scanner, points_scanner)
        return np.einsum("...ij,...j->...i", T_base_joint[..., :3, :3], points_joint) + T_base_joint[..., :3, 3]

    def points_tracker(self, q_rad: ArrayLike, points_scanner: ArrayLike) -> Floats:
        """Points (..., 3) of the scanner's frame, seen at joint angles (..., n), in the tracker's frame."""
        return move_points(self.T_tracker_base, self.points_base(q_rad, points_scanner))

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


def design_matrix(cell: ScannerOnArm, q_rad: ArrayLike, points_scanner: ArrayLike, unknowns: Unknowns) -> Floats:
    """How each unknown moves each measured point in the tracker's frame, (M, 3, K): G_i of Eqs 10-16, in closed form.

    Columns in mm per mm and mm per rad. The scanner moves in the last joint's frame (Eq 10), the base in its own frame.
    """
    T_base_joint = forward(cell.arm, q_rad)
    points_joint = move_points(cell.T_joint_scanner, points_scanner)
    points_base = cell.points_base(q_rad, points_scanner)
    scanner = T_base_joint[..., :3, :3] @ _motion_columns(points_joint)[..., : unknowns.scanner]
    arm = moved_by_twist(parameter_twists(cell.arm, q_rad)[..., list(unknowns.table)], points_base)
    base = _motion_columns(points_base)[..., : unknowns.base]
    return cell.T_tracker_base[:3, :3] @ np.concatenate([scanner, arm, base], axis=-1)


def joint_slopes(cell: ScannerOnArm, q_rad: ArrayLike, points_scanner: ArrayLike) -> Floats:
    """How each joint angle moves each measured point in the tracker's frame, (M, 3, n) in mm per rad."""
    points_base = cell.points_base(q_rad, points_scanner)
    return cell.T_tracker_base[:3, :3] @ moved_by_twist(joint_twists(cell.arm, q_rad), points_base)


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
