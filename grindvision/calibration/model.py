"""The error model: an arm, a scanner on its last joint, a tracker, and how each unknown moves a measured point."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.arm import MdhArm, joint_transforms, joint_twists, moved_by_twist, parameter_twists
from grindvision.calibration.joint_terms import JointCorrections, bases_of
from grindvision.calibration.measurements import Measurements
from grindvision.calibration.unknowns import Unknowns
from grindvision.geometry import motion_columns, move_points, small_motion
from grindvision.records import by_content

Floats = NDArray[np.float64]

#: Points whose Jacobians are worked on at a time: few enough for the processor's cache.
BLOCK = 512


@by_content
@dataclass(frozen=True)
class ScannerOnArm:
    """An arm, the scanner on its last joint (``T_joint_scanner``) and the tracker looking on (``T_tracker_base``).

    ``corrections`` are added to the commanded joint angles. ``reflectors_mm`` (R, 3): how far each reflector stands off
    the place that the measurements say. ``fixtures_mm`` (F, 4), in the tracker's frame: the unknown point of a socket
    (x, y, z, 0), or a plane's unit normal and its distance from the origin.
    """

    arm: MdhArm
    T_joint_scanner: Floats
    T_tracker_base: Floats
    corrections: JointCorrections = field(default_factory=JointCorrections)
    reflectors_mm: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    fixtures_mm: Floats = field(default_factory=lambda: np.zeros((0, 4)))

    def points_base(self, q_rad: ArrayLike, points_scanner: ArrayLike) -> Floats:
        """Points (..., 3) of the scanner's frame, seen at joint angles (..., n), in the arm's base frame (Eq 9)."""
        return carry(self, q_rad, points_scanner).base_mm

    def points_tracker(self, q_rad: ArrayLike, points_scanner: ArrayLike) -> Floats:
        """Points (..., 3) of the scanner's frame, seen at joint angles (..., n), in the tracker's frame."""
        return carry(self, q_rad, points_scanner).tracker_mm

    def __str__(self) -> str:
        x, y, z = self.T_joint_scanner[:3, 3]
        return f"{self.arm}; scanner at ({x:.3f}, {y:.3f}, {z:.3f}) mm in the last joint's frame"


@by_content
@dataclass(frozen=True)
class CarriedPoints:
    """M points of the scanner's frame carried through a cell: what residuals and Jacobians have in common.

    ``frames`` (M, n + 1, 4, 4) are the ``joint_transforms`` at the commanded joint angles ``q_rad`` (M, n) with the
    cell's corrections; ``joint_mm`` and ``base_mm`` (M, 3) the points in the last joint's and in the base frame.
    ``reflector`` (M,) numbers the reflector of every point, ``fixture`` (M,) the fixture that it touches; -1: none.
    """

    cell: ScannerOnArm
    q_rad: Floats
    scanner_mm: Floats
    frames: Floats
    joint_mm: Floats
    base_mm: Floats
    reflector: NDArray[np.int64]
    fixture: NDArray[np.int64]

    @property
    def tracker_mm(self) -> Floats:
        """The points (M, 3) in the tracker's frame."""
        return move_points(self.cell.T_tracker_base, self.base_mm)

    def moved(self, unknowns: Unknowns, step: ArrayLike) -> CarriedPoints:
        """Return the same points carried through the cell with a step (K,) of its unknowns carried out."""
        cell = moved_cell(self.cell, unknowns, step)
        frames = None if unknowns.table or unknowns.terms else self.frames
        return carry(cell, self.q_rad, self.scanner_mm, frames, self.reflector, self.fixture)

    def blocks(self) -> Iterator[tuple[slice, CarriedPoints]]:
        """Parts of at most ``BLOCK`` points, with the rows they are."""
        arrays = ("q_rad", "scanner_mm", "frames", "joint_mm", "base_mm", "reflector", "fixture")
        for first in range(0, len(self.base_mm), BLOCK):
            rows = slice(first, first + BLOCK)
            yield rows, CarriedPoints(self.cell, **{name: getattr(self, name)[rows] for name in arrays})

    def design(self, unknowns: Unknowns) -> Floats:
        """How each unknown moves each point in the tracker's frame, (M, 3, K), see ``design_matrix``."""
        columns = []
        if unknowns.scanner:
            columns.append(self.frames[..., -1, :3, :3] @ motion_columns(self.joint_mm)[..., : unknowns.scanner])
        if unknowns.table:
            twists = parameter_twists(self.cell.arm, self.q_rad, self.frames)[..., list(unknowns.table)]
            columns.append(moved_by_twist(twists, self.base_mm))
        if unknowns.terms:
            columns.append(self._base_jacobian()[..., [term.joint for term in unknowns.terms]])
            columns[-1] = columns[-1] * bases_of(unknowns.terms, self.q_rad)[..., None, :]
        if unknowns.reflectors:
            rotated = self.frames[..., -1, :3, :3] @ self.cell.T_joint_scanner[:3, :3]
            own = np.equal.outer(self.reflector, np.arange(len(unknowns.reflectors)))
            blocks = own[:, None, :, None] * rotated[:, :, None, :]
            columns.append(blocks.reshape(*rotated.shape[:-1], -1))
        if unknowns.fixtures:
            columns.append(self.cell.T_tracker_base[:3, :3].T @ self._fixture_columns(unknowns))
        if unknowns.base:
            columns.append(motion_columns(self.base_mm))
        return self.cell.T_tracker_base[:3, :3] @ np.concatenate(columns, axis=-1)

    def jacobian(self) -> Floats:
        """How each joint moves each point in the tracker's frame, (M, 3, n) in mm per rad (prismatic: per mm)."""
        return self.cell.T_tracker_base[:3, :3] @ self._base_jacobian()

    def _base_jacobian(self) -> Floats:
        return moved_by_twist(joint_twists(self.cell.arm, self.q_rad, self.frames), self.base_mm)

    def _fixture_columns(self, unknowns: Unknowns) -> Floats:
        """Minus how each fixture's unknowns move the point that it holds, in the tracker's frame, (M, 3, 3 F)."""
        columns = np.zeros((len(self.fixture), 3, len(unknowns.fixtures), 3))
        points = self.tracker_mm
        for number, (kind, _) in enumerate(unknowns.fixtures):
            rows = self.fixture == number
            if kind == "plane":
                normal = self.cell.fixtures_mm[number, :3]
                sides = tangents(normal)
                columns[rows, :, number, :2] = normal[:, None] * (points[rows] @ sides.T)[:, None, :]
                columns[rows, :, number, 2] = -normal
            else:
                columns[rows, :, number] = -np.eye(3)
        return columns.reshape(*columns.shape[:2], -1)


def carry(
    cell: ScannerOnArm,
    q_rad: ArrayLike,
    points_scanner: ArrayLike,
    frames: Floats | None = None,
    reflector: NDArray[np.int64] | None = None,
    fixture: NDArray[np.int64] | None = None,
) -> CarriedPoints:
    """Carry points (M, 3) of the scanner's frame, seen at joint angles (M, n), through the cell.

    ``frames`` are the ``joint_transforms`` there, where they are known already; ``reflector`` and ``fixture`` (M,) as
    in ``CarriedPoints``.
    """
    q, points = np.asarray(q_rad, dtype=float), np.asarray(points_scanner, dtype=float)
    frames = joint_transforms(cell.arm, cell.corrections.applied(q)) if frames is None else frames
    none = np.full(points.shape[:-1], -1)
    reflector, fixture = (none if numbers is None else numbers for numbers in (reflector, fixture))
    seen = points
    if len(cell.reflectors_mm) and (reflector >= 0).any():
        seen = points + np.where((reflector >= 0)[..., None], cell.reflectors_mm[reflector], 0.0)
    joint = move_points(cell.T_joint_scanner, seen)
    base = np.einsum("...ij,...j->...i", frames[..., -1, :3, :3], joint) + frames[..., -1, :3, 3]
    return CarriedPoints(cell, q, points, frames, joint, base, reflector, fixture)


def carried(cell: ScannerOnArm, measurements: Measurements) -> CarriedPoints:
    """Carry the points of all rows through the cell."""
    return carry(cell, measurements.q_rad, measurements.scanner_mm, None, measurements.reflector, measurements.fixture)


def measured_points(points: CarriedPoints, measurements: Measurements) -> tuple[Floats, Floats | None]:
    """Where the points were measured (M, 3), tracker frame, and the directions in which that says nothing (M, 3, 3).

    A reading of the tracker says all three coordinates. A ball in a socket lies at the socket's point; on a ball bar,
    at the bar's length from it, whatever the direction; a touched point lies in its plane, wherever there. The second
    array is a projector on the directions that are free, None where there are no fixtures.
    """
    if not measurements.fixtures:
        return measurements.tracker_mm, None
    predicted, measured = points.tracker_mm, measurements.tracker_mm.copy()
    free = np.zeros((len(measured), 3, 3))
    for number, (kind, _) in enumerate(measurements.fixtures):
        rows = np.flatnonzero(measurements.fixture == number)
        place = points.cell.fixtures_mm[number]
        if kind == "plane":
            off = predicted[rows] @ place[:3] - place[3]
            measured[rows] = predicted[rows] - off[:, None] * place[:3]
            free[rows] = np.eye(3) - np.outer(place[:3], place[:3])
            continue
        measured[rows] = place[:3]
        bars = rows[np.isfinite(measurements.bar_mm[rows])]
        rays = predicted[bars] - place[:3]
        rays = rays / np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-9)
        measured[bars] = place[:3] + measurements.bar_mm[bars, None] * rays
        side = (predicted[bars] - measured[bars]) - rays * ((predicted[bars] - measured[bars]) * rays).sum(1)[:, None]
        measured[bars] = measured[bars] + side
        free[bars] = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    return measured, free


def tangents(normal: Floats) -> Floats:
    """Two unit vectors (2, 3) across a unit vector (3,), always the same for the same one."""
    start = np.eye(3)[int(np.argmin(np.abs(normal)))]
    first = np.cross(normal, start)
    first /= np.linalg.norm(first)
    return np.array([first, np.cross(normal, first)])


def design_matrix(cell: ScannerOnArm, q_rad: ArrayLike, points_scanner: ArrayLike, unknowns: Unknowns) -> Floats:
    """How each unknown moves each measured point in the tracker's frame, (M, 3, K): G_i of Eqs 10-16, in closed form.

    Columns in mm per mm and mm per rad. The scanner moves in the last joint's frame (Eq 10), the base in its own frame.
    """
    return carry(cell, q_rad, points_scanner).design(unknowns)


def joint_jacobian(cell: ScannerOnArm, q_rad: ArrayLike, points_scanner: ArrayLike) -> Floats:
    """How each joint moves each measured point in the tracker's frame, (M, 3, n) in mm per rad (prismatic: per mm)."""
    return carry(cell, q_rad, points_scanner).jacobian()


def moved_cell(cell: ScannerOnArm, unknowns: Unknowns, step: ArrayLike) -> ScannerOnArm:
    """Return the cell with a step (K,) of its unknowns carried out, to first order what ``design_matrix`` says."""
    step = np.asarray(step, dtype=float)
    table = np.zeros(5 * cell.arm.n)
    table[list(unknowns.table)] = step[unknowns.in_table]
    twist_scanner, twist_base = np.zeros(6), np.zeros(6)
    twist_scanner[: unknowns.scanner] = step[: unknowns.scanner]
    twist_base[: unknowns.base] = step[len(step) - unknowns.base :]
    corrections = cell.corrections.changed_by(step[unknowns.in_terms]) if unknowns.terms else cell.corrections
    reflectors, fixtures = cell.reflectors_mm, cell.fixtures_mm
    if unknowns.reflectors:
        reflectors = reflectors + step[unknowns.in_reflectors].reshape(-1, 3)
    if unknowns.fixtures:
        fixtures = _moved_fixtures(fixtures, unknowns, step[unknowns.in_fixtures].reshape(-1, 3))
    return replace(
        cell,
        arm=cell.arm.changed_by(table),
        T_joint_scanner=small_motion(twist_scanner) @ cell.T_joint_scanner,
        T_tracker_base=cell.T_tracker_base @ small_motion(twist_base),
        corrections=corrections,
        reflectors_mm=reflectors,
        fixtures_mm=fixtures,
    )


def _moved_fixtures(fixtures_mm: Floats, unknowns: Unknowns, steps: Floats) -> Floats:
    moved = fixtures_mm.copy()
    for number, (kind, _) in enumerate(unknowns.fixtures):
        if kind == "plane":
            normal = moved[number, :3]
            normal = normal + steps[number, :2] @ tangents(normal)
            moved[number] = np.append(normal, moved[number, 3] + steps[number, 2]) / np.linalg.norm(normal)
        else:
            moved[number, :3] += steps[number]
    return moved
