"""What every maker's programme says, before it is said in a maker's words: frames, moves, signals, waits, comments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from grindvision.errors import InputError
from grindvision.geometry import check_rigid, inverse
from grindvision.motion.programme import blend_radii
from grindvision.records import by_content

if TYPE_CHECKING:
    from grindvision.motion.placement import Placement
    from grindvision.motion.plan import Motion

Floats = NDArray[np.float64]

#: Fraction of the joints' full speed at which the arm goes to the approach.
JOINT_SPEED = 0.1

#: Speed of the straight moves to the seam and away from it, mm/s.
APPROACH_MM_S = 20.0


@by_content
@dataclass(frozen=True)
class JointMove:
    """The arm goes to joint angles ``q_rad`` (n,), rad, with ``speed_fraction`` of its full speed, and stops there."""

    q_rad: Floats
    speed_fraction: float = JOINT_SPEED


@by_content
@dataclass(frozen=True)
class LinearMove:
    """The tool goes straight to ``T_work_tool`` (4, 4), mm, at ``speed_mm_s``.

    It stops there when ``zone_mm`` is 0, else it leaves the line that far before the corner. ``q_rad`` (n,) are the
    planned joint angles, ``placement`` how the arm stands there, where its maker's language names that. ``on_seam``:
    it works on its way there, at the process's speed.
    """

    T_work_tool: Floats
    q_rad: Floats
    speed_mm_s: float
    zone_mm: float = 0.0
    placement: Placement | None = None
    on_seam: bool = False


@dataclass(frozen=True)
class Output:
    """A named output is set: a digital one to True or False, an analogue one to a number in the controller's unit."""

    name: str
    value: bool | float


@dataclass(frozen=True)
class Wait:
    """The programme waits, s."""

    seconds: float


@dataclass(frozen=True)
class Comment:
    """A line for the reader."""

    text: str


@dataclass(frozen=True)
class ArcStart:
    """From the next position on the arc burns, by the named data of the controller's own arc package."""


@dataclass(frozen=True)
class ArcEnd:
    """At the last position of the seam the arc goes out."""


Step = JointMove | LinearMove | Output | Wait | Comment | ArcStart | ArcEnd


@by_content
@dataclass(frozen=True)
class ArcOptions:
    """What a hot run switches; a shop's own names, never a default.

    ``output`` is the digital output that strikes the arc, ``setpoints`` the analogue outputs (name, value) written
    before it. ``data`` names seam data and weld data of ABB's arc package; then RAPID uses ``ArcLStart``, ``ArcL`` and
    ``ArcLEnd``, and no outputs. The torch waits ``start_s`` after striking and fills the crater for ``crater_s``.
    ``gas`` is the digital output of the shielding gas: open ``pre_flow_s`` before the arc, ``post_flow_s`` after it.
    """

    output: str = ""
    setpoints: Sequence[tuple[str, float]] = ()
    data: tuple[str, str] | None = None
    start_s: float = 0.5
    crater_s: float = 0.5
    gas: str = ""
    pre_flow_s: float = 0.5
    post_flow_s: float = 1.0

    def __post_init__(self) -> None:
        if bool(self.output) == (self.data is not None):
            raise InputError(
                "a hot run needs the digital output that strikes the arc, or seam and weld data; one of them"
            )
        if self.data is not None and self.setpoints:
            raise InputError("setpoints belong to an output; seam and weld data hold their own")
        if self.gas and (self.data is not None or self.gas == self.output):
            raise InputError("the gas needs an output of its own beside the arc's; seam data hold it already")
        times = ("start", self.start_s), ("crater", self.crater_s), ("pre-flow", self.pre_flow_s)
        for name, value in (*times, ("post-flow", self.post_flow_s)):
            if not 0 <= value <= 60:
                raise InputError(f"the {name} time of the arc is {value:g} s; give 0 to 60")
        for name, value in self.setpoints:
            if not np.isfinite(value):
                raise InputError(f"the setpoint of {name} is {value}; give a number")


@by_content
@dataclass(frozen=True)
class RobotProgramme:
    """A motion along one seam as steps, in the frames in which a controller counts.

    ``T_flange_tool``, ``T_base_work`` (4, 4), mm: tool, and work object in the controller's base; poses of the steps
    stand in the work object. ``tool_number`` and ``work_number`` are where FANUC and Yaskawa keep both.
    ``kept_tool`` and ``kept_work`` call them by what a controller keeps already: names in RAPID, numbers in KRL.
    ``hot``: the steps switch the arc on.
    """

    name: str
    robot: str
    joints: tuple[str, ...]
    T_flange_tool: Floats
    T_base_work: Floats
    steps: tuple[Step, ...]
    arc: ArcOptions | None = None
    tool_number: int = 1
    work_number: int = 1
    kept_tool: str = ""
    kept_work: str = ""

    @property
    def hot(self) -> bool:
        """Does it switch the arc on?"""
        return self.arc is not None

    @property
    def moves(self) -> tuple[LinearMove, ...]:
        """The straight moves, in order."""
        return tuple(step for step in self.steps if isinstance(step, LinearMove))

    def __str__(self) -> str:
        run = "hot run, the arc is switched" if self.hot else "dry run, no arc"
        return f"{self.name} for {self.robot}: {len(self.moves)} straight moves, {run}"


@by_content
@dataclass(frozen=True)
class RobotProgrammeOptions:
    """Settings of ``robot_programme``.

    ``T_base_work`` (4, 4), mm: the work object in the controller's base (left out: the base itself). ``arc``: a hot
    run; left out, the run is dry. ``placed``: name the arm's placement at every position, as RAPID, KRL, LS and JBI do.
    ``kept_tool``, ``kept_work``: names or numbers of frames that the controller keeps, see ``RobotProgramme``; left
    out, the programme brings its own.
    """

    name: str = "program"
    T_base_work: ArrayLike = field(default_factory=lambda: np.eye(4))
    arc: ArcOptions | None = None
    placed: bool = True
    tool_number: int = 1
    work_number: int = 1
    kept_tool: str = ""
    kept_work: str = ""

    def __post_init__(self) -> None:
        for name, number in (("tool", self.tool_number), ("work object", self.work_number)):
            if not 0 <= number <= 99:
                raise InputError(f"the {name}'s number is {number}; give 0 to 99")


def robot_programme(motion: Motion, options: RobotProgrammeOptions | None = None) -> RobotProgramme:
    """A checked motion as the steps of a programme.

    A joint move to the approach fixes how the arm stands; then straight moves to the seam, along it, and away. A hot
    run sets its setpoints before the seam, strikes the arc at the first pose, fills the crater at the last one and
    switches off there, before the torch leaves.

    Args:
        motion: see ``plan_motion``.
        options: name, work object, arc.

    Raises:
        InputError: the arm's placement cannot be named, or it changes along the seam.
    """
    options = RobotProgrammeOptions() if options is None else options
    robot, timing, path = motion.robot, motion.timing, motion.path
    T_base_work = check_rigid(options.T_base_work, "T_base_work")
    T_work_base = inverse(T_base_work) @ robot.T_controller_base
    q = np.vstack([motion.q_approach_rad, path.q_rad, motion.q_retreat_rad])
    poses = T_work_base @ np.concatenate([path.T_base_tool, robot.forward(motion.q_retreat_rad)[None]])
    stands: tuple[Placement | None, ...] = (None,) * len(q)
    if options.placed:
        stands = _one_placement(motion, q)
    blends_mm, arc = blend_radii(path.T_base_tool[:, :3, 3]), motion.trajectory.arc_mm
    seam = [
        LinearMove(poses[number], q[number + 1], _speed(motion, number), blends_mm[number], stands[number + 1], True)
        for number in range(1, len(path.q_rad))
    ]
    before, after = arc_steps(options.arc)
    steps: list[Step] = [
        Comment(f"{len(path.q_rad)} poses, {arc[-1]:.1f} mm at {timing.asked_speed_mm_s:g} mm/s"),
        Comment("HOT RUN: the arc is switched on" if options.arc else "dry run, no arc"),
        JointMove(q[0]),
        LinearMove(poses[0], q[1], APPROACH_MM_S, 0.0, stands[1]),
        *before,
        *seam,
        *after,
        LinearMove(poses[-1], q[-1], APPROACH_MM_S, 0.0, stands[-1]),
    ]
    return RobotProgramme(
        options.name,
        robot.name,
        robot.joints,
        robot.tool.T_flange_tool,
        T_base_work,
        tuple(steps),
        options.arc,
        options.tool_number,
        options.work_number,
        options.kept_tool,
        options.kept_work,
    )


def euler_zyx_deg(rotation: Floats) -> tuple[float, float, float]:
    """Angles (about z, y, x) in deg with ``R = Rz(z) Ry(y) Rx(x)``, x = 0 where y is a right angle.

    KUKA's A, B, C are these; FANUC's W, P, R and Yaskawa's Rx, Ry, Rz are the same three turns about fixed axes, in the
    order x, y, z.
    """
    R = rotation
    across = float(np.hypot(R[0, 0], R[1, 0]))
    y = np.arctan2(-R[2, 0], across)
    if across < 1e-9:
        z, x = np.arctan2(-R[0, 1], R[1, 1]), 0.0
    else:
        z, x = np.arctan2(R[1, 0], R[0, 0]), np.arctan2(R[2, 1], R[2, 2])
    degrees = [float(np.degrees(angle)) for angle in (z, y, x)]
    z, y, x = (180.0 if angle < -180.0 + 1e-6 else angle for angle in degrees)  # one name for half a turn
    return z, y, x


def quaternion_wxyz(rotation: Floats) -> tuple[float, float, float, float]:
    """Unit quaternion of a rotation (3, 3), the real part first; the first part that is not zero is above it."""
    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    first = next(part for part in (w, x, y, z) if abs(part) > 1e-6)
    w, x, y, z = (float(part) * np.sign(first) for part in (w, x, y, z))
    return w, x, y, z


def plain(value: float, decimals: int) -> str:
    """A number with a point and fixed decimals whatever the machine's language, never ``-0``.

    Raises:
        InputError: NaN or infinity.
    """
    if not np.isfinite(value):
        raise InputError(f"a programme cannot hold {value}; plan the motion anew")
    text = f"{value:.{decimals}f}"
    return text[1:] if text.startswith("-") and not text.strip("-0.") else text


def _speed(motion: Motion, number: int) -> float:
    """The highest speed, mm/s, that the time law has on the move to worked pose ``number``, so that joints keep it."""
    timing, arc = motion.timing, motion.trajectory.arc_mm
    on_move = (timing.arc_mm >= arc[number - 1]) & (timing.arc_mm <= arc[number])
    return float(timing.tool_speed_mm_s[on_move].max(initial=0.1))


def arc_steps(arc: ArcOptions | None) -> tuple[list[Step], list[Step]]:
    """What is said where an arc begins, and where it ends: nothing in a dry run."""
    if arc is None:
        return [], []
    if arc.data is not None:
        return [ArcStart()], [ArcEnd()]
    setpoints: list[Step] = [Output(name, float(value)) for name, value in arc.setpoints]
    off: list[Step] = [Output(name, 0.0) for name, _ in arc.setpoints]
    gas_on: list[Step] = [Output(arc.gas, True), Wait(arc.pre_flow_s)] if arc.gas else []
    gas_off: list[Step] = [Wait(arc.post_flow_s), Output(arc.gas, False)] if arc.gas else []
    return (
        [*setpoints, *gas_on, Output(arc.output, True), Wait(arc.start_s)],
        [Wait(arc.crater_s), Output(arc.output, False), *off, *gas_off],
    )


def _one_placement(motion: Motion, q: Floats) -> tuple[Placement, ...]:
    from grindvision.motion.placement import placements

    stands = placements(motion.robot, q)
    first = stands[1]
    for number, one in enumerate(stands):
        if (one.in_front, one.elbow_up, one.wrist_positive) != (first.in_front, first.elbow_up, first.wrist_positive):
            raise InputError(
                f"between position 1 ({first}) and {number} ({one}) the arm passes a singular position, which no"
                " straight move can; move or turn the work, or tilt the torch"
            )
    return stands
