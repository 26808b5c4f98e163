"""What a wheel leaves of a bead when it follows a path that vision found: rigid kinematics, no forces, no wear.

Everything is laid out on the bead's own grid: ``s`` along the true ridge, ``u`` across it, heights above the good
surface, which counts as flat over the wheel's contact: the wheel must be small against the part's curvature.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.cell.grinding_part import Bead
from grindvision.errors import InputError
from grindvision.geometry import check_points

Floats = NDArray[np.float64]

#: Distance of two places of the wheel, and of two lines of the bead's grid, mm.
STEP_MM = 0.2


@dataclass(frozen=True)
class Wheel:
    """A cylindrical wheel whose axis lies across the path: ``radius_mm``, and ``width_mm`` along its axis."""

    radius_mm: float
    width_mm: float

    def __post_init__(self) -> None:
        if not (self.radius_mm > 0 and self.width_mm > 0):
            raise InputError(f"wheel of radius {self.radius_mm} and width {self.width_mm} mm; both must be above zero")


@dataclass(frozen=True)
class GroundBead:
    """Heights (S, U) above the good surface, before and after, at ``s_mm`` (S,) and ``u_mm`` (U,).

    ``along`` (S,) marks the part of the bead between the path's first and last point. ``wheel_s_mm, wheel_u_mm`` (P,):
    where the middle of the wheel passed.
    """

    s_mm: Floats
    u_mm: Floats
    before_mm: Floats
    after_mm: Floats
    along: NDArray[np.bool_]
    wheel_s_mm: Floats
    wheel_u_mm: Floats

    @property
    def left_mm(self) -> float:
        """Highest remainder along the path; below zero where even that lies below the good surface."""
        return float(self.after_mm[self.along].max())

    @property
    def gouge_mm(self) -> float:
        """Deepest cut into the good surface along the path."""
        return max(0.0, float(-self.after_mm[self.along].min()))

    def __str__(self) -> str:
        return f"{self.before_mm.max():.2f} mm bead ground to {self.left_mm:.3f} mm, gouge {self.gouge_mm:.3f} mm"


def grind(
    bead: Bead,
    points_mm: ArrayLike,
    normals: ArrayLike,
    heights_mm: ArrayLike,
    wheel: Wheel,
    depth_of_cut_mm: float,
    passes: int,
) -> GroundBead:
    """Grind a bead in passes along straight lines between path points, never deeper than the heights vision found.

    Pass k lowers the wheel by k depths of cut along the found normal, at most by the found height, so the last pass
    ends on what vision takes for the good surface.

    Args:
        bead: the truth, in the frame of the path; its rounded ends count as full.
        points_mm, normals: path points (N, 3) on the ridge and their outward unit normals (N, 3), in order.
        heights_mm: found height (N,) of each path point above the good surface.
        wheel: its size.
        depth_of_cut_mm, passes: of the process.

    Raises:
        InputError: fewer than two path points, a path beside the bead, or a process without passes or depth.
    """
    points = check_points(points_mm, "path points")
    if len(points) < 2 or passes < 1 or not depth_of_cut_mm > 0:
        raise InputError(
            f"{len(points)} path points, {passes} passes of {depth_of_cut_mm} mm; give two, one and above zero"
        )
    ridge, up = resampled(bead.ridge_mm, bead.normals)
    step = np.linalg.norm(np.diff(ridge, axis=0), axis=1)
    s = np.concatenate([[0.0], np.cumsum(step)])
    u = np.linspace(-1.0, 1.0, 41) * 0.6 * bead.width_mm
    profile = bead.height_mm * np.clip(1 - (2 * u / bead.width_mm) ** 2, 0.0, None)
    before = np.broadcast_to(profile, (len(s), len(u)))

    carried = np.column_stack([normals, heights_mm])
    places, carried = resampled(points, carried)
    lean = carried[:, :3] / np.linalg.norm(carried[:, :3], axis=1, keepdims=True)
    contact = places - np.minimum(passes * depth_of_cut_mm, carried[:, 3])[:, None] * lean

    nearest = np.argmin(np.linalg.norm(contact[:, None] - ridge[None], axis=2), axis=1)
    tangent = np.gradient(ridge, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    side = np.cross(up, tangent)
    offset = contact - ridge[nearest]
    at_s = s[nearest] + np.einsum("ij,ij->i", offset, tangent[nearest])
    at_u = np.einsum("ij,ij->i", offset, side[nearest])
    at_h = np.einsum("ij,ij->i", offset, up[nearest]) + bead.height_mm
    roll = np.einsum("ij,ij->i", lean, side[nearest]) / np.einsum("ij,ij->i", lean, up[nearest])

    after = before.copy()
    for place in range(len(contact)):
        reach = np.abs(s - at_s[place]) < wheel.radius_mm
        under = np.abs(u - at_u[place]) <= wheel.width_mm / 2
        rise = wheel.radius_mm - np.sqrt(wheel.radius_mm**2 - (s[reach] - at_s[place]) ** 2)
        floor = at_h[place] + rise[:, None] - roll[place] * (u[under] - at_u[place])
        box = np.ix_(reach, under)
        after[box] = np.minimum(after[box], floor)
    along = (s >= at_s.min()) & (s <= at_s.max())
    if not along.any():
        raise InputError("the path runs past no part of the bead; are both in the same frame?")
    return GroundBead(s, u, before, after, along, at_s, at_u)


def resampled(points_mm: ArrayLike, values: ArrayLike) -> tuple[Floats, Floats]:
    """Points (M, 3) every ``STEP_MM`` along the straight lines through points (N, 3), values (N, K) carried along."""
    points, values = np.asarray(points_mm, dtype=float), np.asarray(values, dtype=float)
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    at = np.linspace(0.0, s[-1], max(round(s[-1] / STEP_MM), 1) + 1)

    def interpolated(columns: Floats) -> Floats:
        return np.column_stack([np.interp(at, s, column) for column in columns.T])

    return interpolated(points), interpolated(values)
