"""From a trajectory to a motion that can be run: the arm's branch, the way in and out, clearances and the time law."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from grindvision.errors import CollisionError, InputError, UnreachableError
from grindvision.lazy import renamed_fields
from grindvision.loose_settings import settings_in
from grindvision.motion.clearance import Clearance, Obstacle, measure_clearance, table
from grindvision.motion.follow import JointPath, Stopped, follow_or_stop, start_angles
from grindvision.motion.robot import Robot
from grindvision.motion.timing import TOOL_ACCELERATION, TimeLaw, time_law
from grindvision.motion.trajectory import Trajectory
from grindvision.parallel import one_blas_thread
from grindvision.records import by_content

Floats = NDArray[np.float64]

#: The ways in and out are looked at so often, mm.
WAY_STEP_MM = 10.0


@renamed_fields(least_clearance_mm="min_clearance_mm")
@by_content
@dataclass(frozen=True)
class PlanMotionOptions:
    """Settings of ``plan_motion``, lengths in mm, base frame.

    ``tool_speed_mm_s`` along the seam; ``obstacles`` beside the table, whose top is at z = ``table_top_mm``; the tool
    backs off by ``backed_off_mm`` before and behind the seam; ``min_clearance_mm`` is kept to everything.
    ``spin_free``: the tool may turn about its own axis, as a round one may. ``seed`` of the random start angles.
    ``tool_acceleration_mm_s2`` along the path, which a weave needs more of.
    """

    tool_speed_mm_s: float = 8.0
    obstacles: Sequence[Obstacle] = ()
    table_top_mm: float = 0.0
    backed_off_mm: float = 40.0
    min_clearance_mm: float = 2.0
    spin_free: bool = False
    seed: int | np.random.Generator = 0
    tool_acceleration_mm_s2: float = TOOL_ACCELERATION

    def __post_init__(self) -> None:
        if not self.backed_off_mm > 0:
            raise InputError(f"the way in and out is {self.backed_off_mm:.4g} mm; give a length above 0")
        if not 0 < self.tool_speed_mm_s < np.inf:
            raise InputError(f"the tool's speed is {self.tool_speed_mm_s:.4g} mm/s; give a number above 0")


@by_content
@dataclass(frozen=True)
class Motion:
    """A checked motion of ``robot`` along ``path.trajectory``.

    ``q_approach_rad`` and ``q_retreat_rad`` (n,) hold the tool backed off along its own axis from the first and from
    the last pose. ``clearance`` covers the way in, every worked pose and the way out, in this order; the ways in and
    out are looked at every 10 mm and count as one position each.
    """

    robot: Robot
    path: JointPath
    q_approach_rad: Floats
    q_retreat_rad: Floats
    clearance: Clearance
    timing: TimeLaw

    @property
    def trajectory(self) -> Trajectory:
        """The trajectory that is followed."""
        return self.path.trajectory

    def __str__(self) -> str:
        return f"{self.robot.name}: {self.path}; {self.clearance}; {self.timing}"


@settings_in(PlanMotionOptions, 2, ("seed",))
@one_blas_thread()
def plan_motion(robot: Robot, trajectory: Trajectory, options: PlanMotionOptions | None = None) -> Motion:
    """Follow the trajectory on one branch of the arm, clear of the table, the obstacles and itself.

    Every branch that ``start_angles`` finds is followed. They are ranked by their room to the table and the arm
    itself, in steps of 10 mm, then by how little the joints travel; the first that keeps the clearance to everything
    wins.

    Args:
        robot: arm with its tool, see ``load_robot``.
        trajectory: poses ``T_base_tool`` (N, 4, 4) in the arm's base frame, mm.
        options: speed, obstacles, table, clearance, seed; see ``PlanMotionOptions``.

    Returns:
        Joint angles (N, n) in rad, with the way in and out, the clearance in mm, and times in s.

    Raises:
        CollisionError: the groove lies below the table's top, or no branch keeps the clearance.
        UnreachableError: no branch follows the trajectory; the complaint is that of the first one tried.

    Example:
        >>> from grindvision import PlanMotionOptions, load_robot, plan_motion, tool_trajectory
        >>> seam_mm = [(300, y, 60) for y in (-40, -20, 0, 20, 40)]
        >>> trajectory = tool_trajectory(seam_mm, [(0, 0, 1)] * 5)
        >>> motion = plan_motion(load_robot("ur3"), trajectory, PlanMotionOptions(tool_speed_mm_s=10.0))
        >>> motion.path.q_rad.shape, bool(motion.path.position_error_mm.max() < 0.01)
        ((5, 6), True)
    """
    options = PlanMotionOptions() if options is None else options
    rng, spin_free = np.random.default_rng(options.seed), options.spin_free
    table_top_mm, min_clearance_mm = options.table_top_mm, options.min_clearance_mm
    _check_above_table(trajectory, table_top_mm)
    followed: list[tuple[JointPath, Floats, int]] = []
    complaints: list[Stopped | UnreachableError] = []
    for start in start_angles(robot, trajectory.T_base_tool[0], rng, spin_free=spin_free):
        try:
            path = follow_or_stop(robot, trajectory, start, spin_free)
            ends = [_backed_off(robot, path, row, options.backed_off_mm, spin_free) for row in (0, -1)]
        except (Stopped, UnreachableError) as error:
            complaints.append(error)
        else:
            followed.append((path, np.vstack([ends[0][::-1], path.q_rad, ends[1]]), len(ends[0])))
    if not followed:
        first = complaints[0]
        raise first.complaint() if isinstance(first, Stopped) else first
    the_table = table(table_top_mm)
    followed.sort(key=lambda one: (-(measure_clearance(robot, one[1], [the_table]).min_mm // 10), _travel(one[1])))
    blocked: list[Clearance] = []
    for path, q, way in followed:
        free = _ways_as_one(measure_clearance(robot, q, [the_table, *options.obstacles]), way)
        if free.min_mm >= min_clearance_mm:
            timing = time_law(
                path,
                robot.limits,
                options.tool_speed_mm_s,
                tool_acceleration_mm_s2=options.tool_acceleration_mm_s2,
            )
            return Motion(robot, path, q[0], q[-1], free, timing)
        blocked.append(free)
    tightest = max(blocked, key=lambda one: one.min_mm)
    one, other = tightest.nearest[tightest.tightest]
    where = min(max(tightest.tightest - 1, 0), len(trajectory.T_base_tool) - 1)
    raise CollisionError(
        f"{one} and {other} come within {tightest.min_mm:.1f} mm near way point {where}, even on the best of"
        f" {len(followed)} branches of {robot.name}; {min_clearance_mm:g} mm is asked for: move or turn the work, or"
        " tilt the tool"
    )


def _travel(q_rad: Floats) -> float:
    return float(np.abs(np.diff(q_rad, axis=0)).sum())


def _backed_off(robot: Robot, path: JointPath, row: int, length_mm: float, spin_free: bool) -> Floats:
    """Joint angles (W, n) with the tool pulled back along its axis from one worked pose, further and further."""
    pose = path.T_base_tool[row]
    ups = np.linspace(0.0, length_mm, int(np.ceil(length_mm / WAY_STEP_MM)) + 1)
    back = np.repeat(pose[None], len(ups), axis=0)
    back[:, :3, 3] -= ups[:, None] * pose[:3, 2]
    return follow_or_stop(robot, Trajectory(back), path.q_rad[row], spin_free).q_rad[1:]


def _ways_as_one(free: Clearance, way: int) -> Clearance:
    """Clearances with the first and the last ``way`` positions each taken as one, the tightest of them."""
    rows = np.arange(len(free.distance_mm))
    parts = [rows[:way], *rows[way:-way, None], rows[-way:]]
    tightest = [int(part[free.distance_mm[part].min(axis=1).argmin()]) for part in parts]
    distance = np.stack([free.distance_mm[part].min(axis=0) for part in parts])
    return Clearance(distance, free.against, tuple(free.nearest[row] for row in tightest))


def _check_above_table(trajectory: Trajectory, table_top_mm: float) -> None:
    below = table_top_mm - trajectory.positions_mm[:, 2]
    if (below > 0).any():
        deepest = int(below.argmax())
        raise CollisionError(
            f"the groove lies behind the table: way point {deepest} is {below[deepest]:.1f} mm below its top at z ="
            f" {table_top_mm:g} mm ({int((below > 0).sum())} of {len(below)} are below it); check the scanner's pose"
            " or the height of the table"
        )
