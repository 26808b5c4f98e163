"""How an arm with a spherical wrist stands: in front or overhead, elbow up or down, the sign of its wrist.

Four makers write this beside every Cartesian position (ABB ``confdata``, KUKA ``S`` and ``T``, FANUC ``CONFIG``,
Yaskawa ``RCONF``), because up to eight placements reach the same pose. It is measured on the arm's geometry, not on
joint angles, so that it holds for every table whose joints are counted as the maker counts them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from grindvision.errors import InputError
from grindvision.extras import extra
from grindvision.motion.robot import Robot
from grindvision.records import by_content

with extra("robot"):
    import pinocchio as pin

Floats = NDArray[np.float64]

#: Axes 4, 5 and 6 of a calibrated arm still count as meeting in one point when they miss it by no more, mm.
MEETING_MM = 2.0

#: Nearer to a singular position the placement is not told: rad at the wrist, mm at axis 1 and at the elbow.
SINGULAR_RAD, SINGULAR_MM = 0.005, 1.0


@by_content
@dataclass(frozen=True)
class Placement:
    """How a six-axis arm stands at joint angles ``q_rad`` (6,).

    ``in_front``: the wrist's centre lies on that side of axis 1 to which the arm points with all joints at zero.
    ``elbow_up``: the forearm is bent from the lower arm towards the front. ``wrist_positive``: joint 5 is above zero.
    """

    in_front: bool
    elbow_up: bool
    wrist_positive: bool
    q_rad: Floats

    def __str__(self) -> str:
        front, elbow = "in front" if self.in_front else "overhead", "up" if self.elbow_up else "down"
        return f"wrist {front}, elbow {elbow}, joint 5 {'above' if self.wrist_positive else 'below'} zero"


def placements(robot: Robot, q_rad: Floats) -> tuple[Placement, ...]:
    """Placement of the arm at each of N joint positions (N, 6).

    Raises:
        InputError: the arm has no six joints or no spherical wrist; it points nowhere at zero; a position stands on a
            singular one, where the placement changes.
    """
    check_spherical_wrist(robot)
    zero = _wrist_centre(robot, np.zeros(6))[0]
    radius_mm = float(np.hypot(zero[0], zero[1]))
    if radius_mm < SINGULAR_MM:
        raise InputError(
            f"with all joints at zero the wrist of {robot.name} stands on axis 1; no side of the arm is its front:"
            " give a table that counts the joints as the maker does"
        )
    front_zero = np.array([zero[0], zero[1], 0.0]) / radius_mm
    return tuple(_placement(robot, q, front_zero, number) for number, q in enumerate(np.atleast_2d(q_rad)))


def _placement(robot: Robot, q: Floats, front_zero: Floats, number: int) -> Placement:
    wrist, joints = _wrist_centre(robot, q)
    turn = joints[0].rotation @ _joint_poses(robot, np.zeros(6))[0].rotation.T
    front, up = turn @ front_zero, np.array([0.0, 0.0, 1.0])
    ahead = float(wrist @ front)
    shoulder, elbow = joints[1].translation, joints[2].translation
    lower, fore = elbow - shoulder, wrist - elbow
    bend = float(np.cross(lower, fore) @ np.cross(up, front)) / float(np.linalg.norm(lower))
    for name, value, limit in (
        ("the wrist stands over axis 1", ahead, SINGULAR_MM),
        ("the elbow is stretched", bend, SINGULAR_MM),
        ("joint 5 is at zero", float(np.sin(q[4])), SINGULAR_RAD),
    ):
        if abs(value) < limit:
            raise InputError(
                f"at position {number} {name}, a singular position of {robot.name}; move or turn the work, or tilt the"
                " torch"
            )
    return Placement(ahead > 0, bend > 0, bool(np.sin(q[4]) > 0), np.array(q, dtype=float))


def _joint_poses(robot: Robot, q: Floats) -> list[pin.SE3]:
    data = robot.model.createData()
    pin.forwardKinematics(robot.model, data, np.asarray(q, dtype=float))
    return [data.oMi[joint] for joint in range(1, robot.model.njoints)]


def _wrist_centre(robot: Robot, q: Floats) -> tuple[Floats, list[pin.SE3]]:
    """The point nearest to the axes 4, 5 and 6, and the poses of all joints."""
    joints = _joint_poses(robot, q)
    return _meeting(joints)[0], joints


def _meeting(joints: list[pin.SE3]) -> tuple[Floats, float]:
    """Point nearest to the axes 4, 5 and 6, and its largest distance to one of them, mm."""
    across = [np.eye(3) - np.outer(one.rotation[:, 2], one.rotation[:, 2]) for one in joints[3:6]]
    right = sum((part @ one.translation for part, one in zip(across, joints[3:6], strict=True)), np.zeros(3))
    centre = np.linalg.lstsq(sum(across, np.zeros((3, 3))), right, rcond=None)[0]
    misses = [np.linalg.norm(part @ (centre - one.translation)) for part, one in zip(across, joints[3:6], strict=True)]
    return centre, float(max(misses))


def check_spherical_wrist(robot: Robot) -> None:
    """Refuse an arm whose placement cannot be named.

    Raises:
        InputError: it has not six joints, or its axes 4, 5 and 6 do not meet.
    """
    if robot.model.nq != 6:
        raise InputError(f"{robot.name} has {robot.model.nq} joints; RAPID, KRL, LS and JBI are written for six")
    trial = np.array([0.3, 0.2, -0.4, 0.5, 0.9, 0.2])
    miss_mm = _meeting(_joint_poses(robot, trial))[1]
    if miss_mm > MEETING_MM:
        raise InputError(
            f"the axes 4, 5 and 6 of {robot.name} miss one point by {miss_mm:.1f} mm; RAPID, KRL, LS and JBI can name"
            " the placement of an arm with a spherical wrist only: write urscript, csv or json"
        )
