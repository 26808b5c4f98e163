"""From way points and surface normals to tool frames: z into the work, x along the seam."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from grindvision.errors import DegenerateError, InputError
from grindvision.geometry import check_points, check_rigid, rotation_about
from grindvision.loose_settings import settings_in
from grindvision.records import by_content

Floats = NDArray[np.float64]


@by_content
@dataclass(frozen=True)
class Trajectory:
    """Poses of the tool along a seam, in the order they are worked.

    ``T_base_tool`` (N, 4, 4), translations in mm: the tool's z axis points out of the tool into the work, its x axis
    along the seam. ``closed`` says that the last way point leads back to the first. Until ``moved`` says otherwise,
    "base" is the frame the way points were given in. The array is read-only.
    """

    T_base_tool: Floats
    closed: bool = False

    def __post_init__(self) -> None:
        poses = np.array(self.T_base_tool, dtype=float)
        if poses.ndim != 3 or poses.shape[1:] != (4, 4) or len(poses) < 2:
            raise InputError(f"a trajectory needs poses of shape (N, 4, 4) with N >= 2, got {poses.shape}")
        for number, pose in enumerate(poses):
            check_rigid(pose, f"pose of way point {number}")
        poses.setflags(write=False)
        object.__setattr__(self, "T_base_tool", poses)

    @property
    def positions_mm(self) -> Floats:
        """Way points (N, 3), mm."""
        return self.T_base_tool[:, :3, 3]

    @property
    def rpy_rad(self) -> Floats:
        """Roll, pitch, yaw (N, 3) about the fixed x, y, z axes of the base: ``R = Rz(yaw) Ry(pitch) Rx(roll)``."""
        return Rotation.from_matrix(self.T_base_tool[:, :3, :3]).as_euler("xyz")

    @property
    def T_base_tool_worked(self) -> Floats:
        """The poses as they are driven: (N, 4, 4), or (N + 1, 4, 4) for a closed seam, which ends where it began."""
        return np.concatenate([self.T_base_tool, self.T_base_tool[:1]]) if self.closed else self.T_base_tool

    @property
    def arc_mm(self) -> Floats:
        """Length of the polygon of way points up to each worked pose, (N,) or (N + 1,) when closed, starting at 0."""
        return _arc(self.T_base_tool_worked[:, :3, 3])

    def moved(self, T_new_base: ArrayLike) -> Trajectory:
        """Return the same trajectory in another frame, ``T_new_tool = T_new_base @ T_base_tool``."""
        return replace(self, T_base_tool=check_rigid(T_new_base, "T_new_base") @ self.T_base_tool)

    def spun(self, angle_rad: float) -> Trajectory:
        """Return the trajectory with every tool frame turned about its own z axis; a round tool works just the same."""
        turn = np.eye(4)
        turn[:3, :3] = rotation_about([0, 0, 1], angle_rad)
        return replace(self, T_base_tool=self.T_base_tool @ turn)

    def refined(self, step_mm: float, step_rad: float) -> Trajectory:
        """Return the trajectory with poses in between, at most ``step_mm`` and ``step_rad`` apart; the old ones stay.

        Positions follow a cubic spline over the arc length, orientations a spline of rotations. An arm that moves its
        joints evenly between two poses swings the tool off the seam by the square of how far they are apart.

        Raises:
            InputError: a step that is not above zero.
        """
        if not (step_mm > 0 and step_rad > 0):
            raise InputError(f"steps of {step_mm:.4g} mm and {step_rad:.4g} rad; both must be above 0")
        poses, arc = self.T_base_tool_worked, self.arc_mm
        turns = Rotation.from_matrix(np.swapaxes(poses[:-1, :3, :3], 1, 2) @ poses[1:, :3, :3]).magnitude()
        pieces = np.ceil(np.maximum(np.maximum(np.diff(arc) / step_mm, turns / step_rad), 1)).astype(int)
        inner = [np.linspace(arc[i], arc[i + 1], count, endpoint=False) for i, count in enumerate(pieces)]
        return replace(self, T_base_tool=self.poses_at(np.concatenate([*inner, [] if self.closed else arc[-1:]])))

    def poses_at(self, arc_mm: ArrayLike) -> Floats:
        """Poses (M, 4, 4) at lengths (M,) along the trajectory, mm: positions on a cubic spline over the arc length,
        orientations on a spline of rotations.

        Beyond the ends of an open trajectory the tool goes straight on, turned as at the end; a closed one goes round
        again.
        """
        poses, arc, wanted = self.T_base_tool_worked, self.arc_mm, np.atleast_1d(np.asarray(arc_mm, dtype=float))
        at = np.mod(wanted, arc[-1]) if self.closed else np.clip(wanted, 0.0, arc[-1])
        line = CubicSpline(arc, poses[:, :3, 3], bc_type="periodic" if self.closed else "not-a-knot")
        found = np.zeros((len(at), 4, 4))
        found[:, :3, :3] = RotationSpline(arc, Rotation.from_matrix(poses[:, :3, :3]))(at).as_matrix()
        found[:, :3, 3] = line(at)
        if not self.closed:
            ahead = line(at, 1)
            ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
            found[:, :3, 3] += (wanted - at)[:, None] * ahead
        found[:, 3, 3] = 1.0
        return found

    def __str__(self) -> str:
        shape = "closed" if self.closed else "open"
        return f"{shape} trajectory of {len(self.T_base_tool)} way points, {self.arc_mm[-1]:.1f} mm long"


@dataclass(frozen=True)
class ToolTrajectoryOptions:
    """Settings of ``tool_trajectory``.

    ``closed``: the last way point leads back to the first. ``work_angle_rad`` tilts the tool about its x axis, along
    the seam, ``travel_angle_rad`` about y; above zero the tool points forward along the seam (pushing), below it drags.
    ``steady_mm`` above zero takes normal and direction at each way point from a parabola through all of them, weighted
    by a Gaussian of that standard deviation along the seam: noise of single normals then no longer shakes the tool. The
    tip stays on the way points.
    """

    closed: bool = False
    work_angle_rad: float = 0.0
    travel_angle_rad: float = 0.0
    steady_mm: float = 0.0

    def __post_init__(self) -> None:
        for name, angle in (("work", self.work_angle_rad), ("travel", self.travel_angle_rad)):
            if not abs(angle) < np.pi / 2:
                raise InputError(f"the {name} angle is {angle:.4g} rad; it must lie within 1.57 rad (90 degrees)")
        if not 0 <= self.steady_mm < np.inf:
            raise InputError(f"steady_mm is {self.steady_mm:.4g}; give a length along the seam, or 0")


@settings_in(ToolTrajectoryOptions, 2)
def tool_trajectory(
    positions_mm: ArrayLike, normals: ArrayLike, options: ToolTrajectoryOptions | None = None
) -> Trajectory:
    """Tool frames at way points, in working order: z into the work, x along the seam.

    z is opposite to the normal, x is the seam's direction freed from its part along the normal, y completes the right
    hand: between way points the frame turns only as the seam and the surface turn.

    Args:
        positions_mm: way points (N, 3).
        normals: outward surface normals (N, 3), in the same frame.
        options: whether the seam is closed, tilt of the tool, smoothing; see ``ToolTrajectoryOptions``.

    Returns:
        ``T_base_tool`` (N, 4, 4), mm, "base" being the frame of the way points.

    Raises:
        InputError: shapes differ, NaN, fewer than two way points, an angle of 90 degrees or more.
        DegenerateError: two way points coincide, a normal has no length, or the seam runs along a normal.

    Example:
        >>> from grindvision import ToolTrajectoryOptions, tool_trajectory
        >>> seam_mm = [(0, 0, 50), (10, 0, 50), (20, 0, 50)]
        >>> tool_trajectory(seam_mm, [(0, 0, 1)] * 3).T_base_tool[0].round(6) + 0.0
        array([[ 1.,  0.,  0.,  0.],
               [ 0., -1.,  0.,  0.],
               [ 0.,  0., -1., 50.],
               [ 0.,  0.,  0.,  1.]])
        >>> print(tool_trajectory(seam_mm, [(0, 0, 1)] * 3, ToolTrajectoryOptions(travel_angle_rad=0.2)))
        open trajectory of 3 way points, 20.0 mm long
    """
    options = ToolTrajectoryOptions() if options is None else options
    closed, steady_mm = options.closed, options.steady_mm
    points = check_points(positions_mm, "way points", min_points=2)
    outward = check_points(normals, "normals", min_points=2)
    if points.shape != outward.shape:
        raise InputError(f"{len(points)} way points but {len(outward)} normals; give one normal per way point")
    outward = _unit(outward, "the normal of way point {} has length zero")
    if steady_mm and len(points) > 3:
        tangents, outward = _steadied(points, outward, closed, steady_mm)
    else:
        tangents = _tangents(points, closed)
    z = -outward
    across = np.cross(z, tangents)
    if (steep := np.linalg.norm(across, axis=1) < 0.1).any():
        where = int(steep.argmax())
        raise DegenerateError(
            f"at way point {where} the seam runs along the surface normal; a normal must stand across the seam"
        )
    y = _unit(across, "way point {} has no direction across the seam")
    frames = np.zeros((len(points), 4, 4))
    frames[:, :3, 0], frames[:, :3, 1], frames[:, :3, 2] = np.cross(y, z), y, z
    frames[:, :3, :3] = frames[:, :3, :3] @ (
        rotation_about([1, 0, 0], options.work_angle_rad) @ rotation_about([0, 1, 0], options.travel_angle_rad)
    )
    frames[:, :3, 3] = points
    frames[:, 3, 3] = 1.0
    return Trajectory(frames, closed)


def angular_speed_rad_s(trajectory: Trajectory, speed_mm_s: float) -> float:
    """The tool's greatest angular speed between two way points, rad/s, at a speed along the seam."""
    poses = trajectory.T_base_tool_worked[:, :3, :3]
    angles = Rotation.from_matrix(np.swapaxes(poses[:-1], 1, 2) @ poses[1:]).magnitude()
    return float((angles / np.diff(trajectory.arc_mm)).max() * speed_mm_s)


def limit_angular_speed(
    positions_mm: ArrayLike,
    normals: ArrayLike,
    options: ToolTrajectoryOptions,
    speed_mm_s: float,
    max_turning_rad_s: float,
) -> Trajectory:
    """Tool frames as of ``tool_trajectory``, steadied along the seam just so far that the tool turns slowly enough.

    ``steady_mm`` of the options is tried first, then half as much more each time, up to half the seam's length.

    Raises:
        InputError: the bound or the speed is not above zero; the seam itself bends faster.
    """
    if not (max_turning_rad_s > 0 and speed_mm_s > 0):
        raise InputError(f"a turning of {max_turning_rad_s:g} rad/s at {speed_mm_s:g} mm/s; give both above 0")
    trajectory = tool_trajectory(positions_mm, normals, options)
    steady_mm, longest_mm = max(options.steady_mm, 2.0), trajectory.arc_mm[-1] / 2
    while (fastest := angular_speed_rad_s(trajectory, speed_mm_s)) > max_turning_rad_s:
        if steady_mm > longest_mm:
            raise InputError(
                f"the seam itself turns the tool at {np.degrees(fastest):.3g} deg/s at {speed_mm_s:g} mm/s; the bound"
                f" is {np.degrees(max_turning_rad_s):.3g}; weld slower or allow more"
            )
        steady_mm *= 1.5
        trajectory = tool_trajectory(positions_mm, normals, replace(options, steady_mm=steady_mm))
    return trajectory


def _tangents(points: Floats, closed: bool) -> Floats:
    """Unit tangents (N, 3) of the parabola through each way point and its two neighbours."""
    line = np.concatenate([points[-1:], points, points[:1]]) if closed else points
    slopes = np.gradient(line, _arc(line), axis=0, edge_order=1 if len(line) < 3 else 2)
    return _unit(slopes[1:-1] if closed else slopes, "the seam turns back on itself at way point {}")


def _steadied(points: Floats, normals: Floats, closed: bool, width_mm: float) -> tuple[Floats, Floats]:
    """Unit tangents and normals (N, 3) of the parabola that fits the way points around each one best."""
    arc = _arc(np.concatenate([points, points[:1]]) if closed else points)
    ahead = arc[None, : len(points)] - arc[: len(points), None]
    if closed:
        ahead = (ahead + arc[-1] / 2) % arc[-1] - arc[-1] / 2
    scaled = ahead / max(width_mm, float(np.diff(arc).max()))
    weights = np.exp(-(scaled**2) / 2)
    terms = np.stack([np.ones_like(scaled), scaled, scaled**2], axis=-1)
    left = np.einsum("ij,ija,ijb->iab", weights, terms, terms)
    right = np.einsum("ij,ija,jk->iak", weights, terms, np.hstack([points, normals]))
    fit = np.linalg.solve(left, right)
    return (
        _unit(fit[:, 1, :3], "the seam turns back on itself at way point {}"),
        _unit(fit[:, 0, 3:], "the normals around way point {} cancel each other"),
    )


def _arc(line: Floats) -> Floats:
    """Length (N,) of the polygon through points (N, 3) up to each of them."""
    steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
    if (same := steps < 1e-6).any():
        x, y, z = line[int(same.argmax())]
        raise DegenerateError(f"two way points coincide at ({x:.3f}, {y:.3f}, {z:.3f}) mm; give each place once")
    return np.concatenate([[0.0], np.cumsum(steps)])


def _unit(vectors: Floats, complaint: str) -> Floats:
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    if (short := lengths[:, 0] < 1e-9).any():
        raise DegenerateError(complaint.format(int(short.argmax())))
    return vectors / lengths
