"""Joint angles along a trajectory, on one branch of the arm: differential inverse kinematics (pink), pose to pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from grindvision.errors import InputError, UnreachableError
from grindvision.extras import extra
from grindvision.geometry import vector_angle
from grindvision.motion.robot import TOOL_FRAME, Robot
from grindvision.motion.trajectory import Trajectory
from grindvision.parallel import one_blas_thread
from grindvision.records import by_content

with extra("robot"):
    import pinocchio as pin
    from pink import Configuration, solve_ik
    from pink.exceptions import NoSolutionFound
    from pink.limits import ConfigurationLimit, VelocityLimit
    from pink.tasks import FrameTask

Floats = NDArray[np.float64]

#: A pose counts as reached within these; a tenth of what a torch could feel, far above rounding.
REACHED_MM, REACHED_RAD = 0.005, 1e-4

#: One radian of tool direction weighs as much as this many mm while the solver trades one for the other.
_MM_PER_RAD = 200.0
_STEP_S = 0.15  # a solver step may turn a joint as far as it can go in this time
_STEPS = 80


@by_content
@dataclass(frozen=True)
class JointPath:
    """Joint angles ``q_rad`` (N, n) that hold the tool at each worked pose of ``trajectory``, on one branch.

    ``T_base_tool`` (N, 4, 4) is where the tool stands then; the errors (N,) are its distance in mm from the wanted
    tip and the angle in rad from the wanted frame (from the wanted axis alone where the tool is free to spin).
    """

    trajectory: Trajectory
    q_rad: Floats
    T_base_tool: Floats
    position_error_mm: Floats
    angle_error_rad: Floats

    def __str__(self) -> str:
        return (
            f"{len(self.q_rad)} poses followed within {self.position_error_mm.max():.2g} mm"
            f" and {np.degrees(self.angle_error_rad.max()):.2g} deg"
        )


@one_blas_thread()
def follow_trajectory(
    robot: Robot, trajectory: Trajectory, q_start_rad: Floats, *, spin_free: bool = False
) -> JointPath:
    """Joint angles along the trajectory, each pose reached from the one before, the first from ``q_start_rad`` (n,).

    Every step is a quadratic programme that respects the limits of angle and speed, so the arm stays on its branch.
    With ``spin_free`` the tool may turn about its own axis, as a round grinding stone may. Where a joint runs into
    its limit, the whole path is tried once more with that joint a full turn back.

    Raises:
        UnreachableError: a pose is not reached, or the arm would have to turn over between two; the message tells which
            way point, why, and what to move.
    """
    try:
        return follow_or_stop(robot, trajectory, q_start_rad, spin_free)
    except Stopped as stopped:
        raise stopped.complaint() from None


class Stopped(Exception):
    """A pose out of ``poses`` (N, 4, 4) was not reached from ``q_start_rad`` (n,); ``complaint`` says which and why."""

    def __init__(self, robot: Robot, poses: Floats, q_start_rad: Floats, spin_free: bool) -> None:
        super().__init__()
        self.robot, self.poses, self.q_start_rad, self.spin_free = robot, poses, q_start_rad, spin_free

    @one_blas_thread()
    def complaint(self) -> UnreachableError:
        """The error in words; it takes longer than the attempt: all poses are tried for it."""
        q, position_error, angle_error = _drive(self.robot, self.poses, self.q_start_rad, self.spin_free)
        return UnreachableError(
            _complaint(self.robot, self.poses, q, _missed(position_error, angle_error), self.spin_free)
        )


def follow_or_stop(robot: Robot, trajectory: Trajectory, q_start_rad: Floats, spin_free: bool) -> JointPath:
    """``follow_trajectory`` that stops at the first pose that it does not reach.

    Raises:
        Stopped: there. UnreachableError: the arm would have to turn over between two poses.
    """
    _check_angles(robot, q_start_rad)
    poses = trajectory.T_base_tool_worked
    start = np.array(q_start_rad, dtype=float)
    for _ in range(robot.model.nq):
        begun = start
        q, position_error, angle_error = _drive(robot, poses, begun, spin_free, to_the_end=False)
        missed = _missed(position_error, angle_error)
        turned = _turned_back(robot, start, q[int(missed.argmax())]) if missed.any() else None
        if turned is None:
            break
        start = turned
    if missed.any():
        raise Stopped(robot, poses, begun, spin_free)
    _check_branch(robot, poses, q)
    return JointPath(trajectory, q, robot.forward(q), position_error, angle_error)


def start_angles(
    robot: Robot, T_base_tool: Floats, rng: np.random.Generator, *, spin_free: bool = False, starts: int = 40
) -> list[Floats]:
    """Distinct joint angles (n,) that reach one pose, nearest to the middle of the joints' ranges first.

    They are found from random starts; each branch of the arm (elbow up or down, wrist turned over, ...) is one. Where
    none reaches the pose, the one that comes nearest is returned alone.

    Raises:
        InputError: ``starts`` below one.
    """
    if starts < 1:
        raise InputError(f"starts is {starts}; at least one is needed")
    lower, upper = robot.limits.lower_rad, robot.limits.upper_rad
    middle = (lower + upper) / 2
    found: list[Floats] = []
    nearest, least = middle, np.inf
    for _ in range(starts):
        random = rng.uniform(np.maximum(lower, middle - np.pi), np.minimum(upper, middle + np.pi))
        q, position_error, angle_error = _drive(robot, T_base_tool[None], random, spin_free)
        angles = middle + (q[0] - middle + np.pi) % (2 * np.pi) - np.pi
        angles = np.where((angles < lower) | (angles > upper), q[0], angles)
        missed_by = float(position_error[0] + _MM_PER_RAD * angle_error[0])
        if missed_by < least:
            nearest, least = angles, missed_by
        if _missed(position_error, angle_error)[0]:
            continue
        if all(np.abs(angles - other).max() > 0.05 for other in found):
            found.append(angles)
    return sorted(found, key=lambda angles: float(np.abs(angles - middle).sum())) or [nearest]


def _drive(
    robot: Robot,
    poses: Floats,
    q_start: Floats,
    spin_free: bool,
    mm_per_rad: float = _MM_PER_RAD,
    to_the_end: bool = True,
) -> tuple[Floats, Floats, Floats]:
    """Angles (N, n) nearest to each pose (N, 4, 4) in turn, with the tip's error in mm and the direction's in rad.

    Where not ``to_the_end``, zeros stand behind the first pose that is missed.
    """
    model = robot.model
    orientation_cost = mm_per_rad * np.array([1.0, 1.0, 0.0 if spin_free else 1.0])
    task = FrameTask(TOOL_FRAME, position_cost=1.0, orientation_cost=orientation_cost, lm_damping=1e-3)
    limits = [ConfigurationLimit(model, config_limit_gain=1.0), VelocityLimit(model)]
    configuration = Configuration(model, model.createData(), q_start)
    q, errors = np.zeros((len(poses), model.nq)), np.zeros((2, len(poses)))
    for row, pose in enumerate(poses):
        target = (
            _spun_like(pose, configuration.get_transform_frame_to_world(TOOL_FRAME).rotation) if spin_free else pose
        )
        task.set_target(pin.SE3(target))
        for _ in range(_STEPS):
            try:
                speed = solve_ik(
                    configuration, [task], _STEP_S, solver="daqp", damping=1e-3, limits=limits, safety_break=False
                )
            except NoSolutionFound:  # the arm stays where it is, and the pose counts as missed
                break
            inside = np.clip(configuration.q + speed * _STEP_S, model.lowerPositionLimit, model.upperPositionLimit)
            moved = np.abs(inside - configuration.q).max()
            configuration.update(inside)
            if moved < 1e-9:
                break
        q[row] = configuration.q
        errors[:, row] = _error(pose, configuration.get_transform_frame_to_world(TOOL_FRAME).homogeneous, spin_free)
        if not to_the_end and _missed(*errors[:, row]):
            break
    return q, errors[0], errors[1]


def _spun_like(pose: Floats, rotation: Floats) -> Floats:
    """The pose spun about its own z so that it differs from ``rotation`` by the least turn."""
    shortest_rotation = pin.Quaternion.FromTwoVectors(rotation[:, 2], pose[:3, 2]).matrix()
    spun = pose.copy()
    spun[:3, :3] = shortest_rotation @ rotation
    return spun


def _error(wanted: Floats, reached: Floats, spin_free: bool) -> tuple[float, float]:
    columns = slice(2, 3) if spin_free else slice(0, 3)
    turn = vector_angle(wanted[:3, columns].T, reached[:3, columns].T).max()
    return float(np.linalg.norm(reached[:3, 3] - wanted[:3, 3])), float(turn)


def _missed(position_error: Floats, angle_error: Floats) -> NDArray[np.bool_]:
    return (position_error > REACHED_MM) | (angle_error > REACHED_RAD)


def _at_limit(robot: Robot, q: Floats) -> NDArray[np.intp]:
    """Which joints stand at a limit: +1 at the upper, -1 at the lower, 0 between, (n,)."""
    return (q > robot.limits.upper_rad - 1e-6).astype(int) - (q < robot.limits.lower_rad + 1e-6)


def _turned_back(robot: Robot, start: Floats, q_stuck: Floats) -> Floats | None:
    """The start with the joints that got stuck a full turn away from their limit, or None where there is no room."""
    turned = start - 2 * np.pi * _at_limit(robot, q_stuck)
    inside = ((turned >= robot.limits.lower_rad) & (turned <= robot.limits.upper_rad)).all()
    return turned if inside and not np.array_equal(turned, start) else None


def _complaint(robot: Robot, poses: Floats, q: Floats, missed: NDArray[np.bool_], spin_free: bool) -> str:
    """One line: which way point, why, and what to move."""
    first = int(missed.argmax())
    x, y, z = poses[first, :3, 3]
    where = (
        f"way point {first} at ({x:.0f}, {y:.0f}, {z:.0f}) mm in the base frame cannot be reached by {robot.name}"
        f" ({int(missed.sum())} of {len(poses)} cannot)"
    )
    stuck = _at_limit(robot, q[first])
    if stuck.any():
        names = " and ".join(f"{robot.joints[j]} at {np.degrees(q[first, j]):.0f} deg" for j in np.flatnonzero(stuck))
        why = f"a joint stands at its limit: {names}"
    else:
        why = "it lies beyond the arm's reach with the tool in this direction"
    held, _, _ = _drive(robot, poses[missed], q[first], spin_free, mm_per_rad=100 * _MM_PER_RAD)
    shifts = robot.forward(held)[:, :3, 3] - poses[missed, :3, 3]
    displacement = shifts[np.linalg.norm(shifts, axis=1).argmax()]
    if np.linalg.norm(displacement) > 1.0:
        x, y, z = displacement
        return f"{where}: {why}; move the work by about ({x:.0f}, {y:.0f}, {z:.0f}) mm, or tilt or spin the tool"
    return f"{where}: {why}; tilt or spin the tool{'' if spin_free else ', or let it spin freely'}, or turn the work"


def _check_branch(robot: Robot, poses: Floats, q: Floats) -> None:
    """Refuse a path whose joints, moved evenly between two way points, would swing the tool away from the seam."""
    halfway = robot.forward((q[1:] + q[:-1]) / 2)[:, :3, 3]
    chord = poses[1:, :3, 3] - poses[:-1, :3, 3]
    off_mm = np.linalg.norm(halfway - poses[:-1, :3, 3] - chord / 2, axis=1)
    if (astray := off_mm > np.maximum(1.0, 0.2 * np.linalg.norm(chord, axis=1))).any():
        here = int(astray.argmax())
        joint = int(np.abs(q[here + 1] - q[here]).argmax())
        raise UnreachableError(
            f"between way points {here} and {here + 1} the arm would swing the tool {off_mm[here]:.0f} mm off the seam:"
            f" {robot.joints[joint]} turns by {np.degrees(abs(q[here + 1, joint] - q[here, joint])):.0f} deg; refine"
            " the trajectory, or move the work away from this posture"
        )


def _check_angles(robot: Robot, q_rad: Floats) -> None:
    q = np.asarray(q_rad, dtype=float)
    if q.shape != (robot.model.nq,) or not np.isfinite(q).all():
        raise InputError(f"start angles {np.array2string(q)} are not {robot.model.nq} finite numbers in rad")
    outside = (q < robot.limits.lower_rad) | (q > robot.limits.upper_rad)
    if outside.any():
        joint = int(outside.argmax())
        raise InputError(f"start angle of {robot.joints[joint]} is {np.degrees(q[joint]):.1f} deg, outside its limits")
