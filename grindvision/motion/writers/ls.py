"""FANUC TP programme as text (LS): W P R turn about fixed x, y, z; UF and UT name frame and tool; CONFIG is kept."""

from __future__ import annotations

import numpy as np

from grindvision.errors import InputError
from grindvision.motion.placement import Placement
from grindvision.motion.programme_steps import (
    Comment,
    Floats,
    JointMove,
    LinearMove,
    Output,
    RobotProgramme,
    Wait,
    plain,
)
from grindvision.motion.writers.words import (
    check_no_arc_data,
    check_six_joints,
    checked_name,
    checked_number,
    is_digital,
    numbers_of,
    percent,
    placed,
    plain_text,
)

#: Eight, as every controller takes; a remark may have 32 characters.
LONGEST_NAME, LONGEST_REMARK = 8, 30


def ls(programme: RobotProgramme) -> tuple[str]:
    """Text of the programme: ``J`` by joints to the approach, ``L`` along the seam.

    Tool and frame stand in the controller's tables under their numbers; remarks give the values they must have there.

    Raises:
        InputError: a name, an output or a speed that LS does not take; an arm without six joints; one that stands
            overhead or has turned a wrist joint past half a turn.
    """
    check_six_joints(programme, "LS")
    check_no_arc_data(programme, "LS")
    name = checked_name(programme.name, "LS", LONGEST_NAME).upper()
    lines = [
        *_remarks(f"UT{programme.tool_number}", programme.T_flange_tool),
        *_remarks(f"UF{programme.work_number}", programme.T_base_work),
        f"UFRAME_NUM={programme.work_number}",
        f"UTOOL_NUM={programme.tool_number}",
    ]
    positions: list[str] = []
    for step in programme.steps:
        if isinstance(step, Comment):
            lines.append(f"!{plain_text(step.text, LONGEST_REMARK)}")
        elif isinstance(step, JointMove):
            positions.append(_joint_position(len(positions) + 1, step, programme))
            lines.append(f"J P[{len(positions)}] {max(int(percent(step)), 1)}% FINE")
        elif isinstance(step, Output):
            lines.append(_output(step))
        elif isinstance(step, Wait):
            lines.append(f"WAIT {plain(step.seconds, 2)}(sec)")
        elif isinstance(step, LinearMove):
            positions.append(_position(len(positions) + 1, step, programme))
            lines.append(f"L P[{len(positions)}] {speed_words(step.speed_mm_s)} {_end(step.zone_mm)}")
    body = [f"{number:4d}:{'' if line[0] in 'JL' else '  '}{line} ;" for number, line in enumerate(lines, 1)]
    return ("\n".join([*_head(name, programme, len(body)), "/MN", *body, "/POS", *positions, "/END", ""]),)


def config(placement: Placement) -> str:
    """``F`` or ``N`` for the wrist, ``U`` for the elbow, ``T`` in front; all turn numbers 0.

    ``N`` is written where joint 5 is below zero, where the torch hangs down with joint 4 at zero. The joint move to the
    approach settles which wrist it is; a straight move cannot change it.

    Raises:
        InputError: the arm stands overhead, or a wrist joint is past half a turn.
    """
    if not placement.in_front:
        raise InputError("the arm reaches over its own back, which LS is not written for; move the work to its front")
    joints = np.abs(np.degrees(placement.q_rad[[0, 3, 4, 5]])) >= 179.9
    if joints.any():
        joint = (1, 4, 5, 6)[int(joints.argmax())]
        raise InputError(f"joint {joint} turns past 180 deg, whose turn number LS is not written for; turn the torch")
    return f"{'F' if placement.wrist_positive else 'N'} {'U' if placement.elbow_up else 'D'} T, 0, 0, 0"


def pendant_angles_deg(q_rad: Floats) -> Floats:
    """Joint angles (6,) in deg as a FANUC pendant shows them: joint 3 against the horizontal, not the lower arm."""
    angles = np.degrees(np.asarray(q_rad, dtype=float))
    angles[2] -= angles[1]
    return angles


def speed_words(speed_mm_s: float) -> str:
    """A speed of whole mm/s, or of whole cm/min, the next one below.

    Raises:
        InputError: it is below 1 cm/min.
    """
    if abs(speed_mm_s - round(speed_mm_s)) < 1e-6 and round(speed_mm_s) > 0:
        return f"{round(speed_mm_s)}mm/sec"
    cm_min = int(np.floor(6.0 * speed_mm_s + 1e-6))
    if cm_min < 1:
        raise InputError(f"{speed_mm_s:.4g} mm/s is below 1 cm/min, the slowest that LS can say; give a higher speed")
    return f"{cm_min}cm/min"


def _head(name: str, programme: RobotProgramme, lines: int) -> list[str]:
    return [
        f"/PROG  {name}",
        "/ATTR",
        "OWNER\t\t= MNEDITOR;",
        f'COMMENT\t\t= "{"HOT RUN" if programme.hot else "dry run"}";',
        f"LINE_COUNT\t= {lines};",
        "PROTECT\t\t= READ_WRITE;",
        "DEFAULT_GROUP\t= 1,*,*,*,*;",
        "CONTROL_CODE\t= 00000000 00000000;",
    ]


def _remarks(name: str, pose: Floats) -> list[str]:
    values = numbers_of(pose)
    return [f"!{name} {letter} {plain(value, 4)}" for letter, value in zip("XYZWPR", values, strict=True)]


def _end(zone_mm: float) -> str:
    return "FINE" if zone_mm < 0.05 else "CNT100"


def _output(step: Output) -> str:
    if is_digital(step):
        return f"DO[{checked_number(step.name, 'LS', 9999)}]={'ON' if step.value else 'OFF'}"
    return f"AO[{checked_number(step.name, 'LS', 99)}]={plain(step.value, 3)}"


def _place(number: int, programme: RobotProgramme) -> str:
    return f"P[{number}]{{\n   GP1:\n\tUF : {programme.work_number}, UT : {programme.tool_number},\t"


def _joint_position(number: int, move: JointMove, programme: RobotProgramme) -> str:
    angles = [f"J{joint}= {plain(angle, 4)} deg" for joint, angle in enumerate(pendant_angles_deg(move.q_rad), 1)]
    upper, wrist = ",\t".join(angles[:3]), ",\t".join(angles[3:])
    return f"{_place(number, programme)}\n\t{upper},\n\t{wrist}\n}};"


def _position(number: int, move: LinearMove, programme: RobotProgramme) -> str:
    x, y, z, w, p, r = (plain(value, 4) for value in numbers_of(move.T_work_tool))
    return (
        f"{_place(number, programme)}\tCONFIG : '{config(placed(move))}',\n"
        f"\tX = {x} mm,\tY = {y} mm,\tZ = {z} mm,\n\tW = {w} deg,\tP = {p} deg,\tR = {r} deg\n}};"
    )
