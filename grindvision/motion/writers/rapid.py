"""ABB RAPID: one module with its tool and work object; metres nowhere, quaternions with the real part first."""

from __future__ import annotations

import numpy as np

from grindvision.motion.placement import Placement
from grindvision.motion.programme_steps import (
    ArcEnd,
    ArcStart,
    Comment,
    Floats,
    JointMove,
    LinearMove,
    Output,
    RobotProgramme,
    Wait,
    plain,
    quaternion_wxyz,
)
from grindvision.motion.writers.words import check_six_joints, checked_name, is_digital, percent, placed, plain_text

LONGEST_NAME = 32
EXTERNAL = "[9E9,9E9,9E9,9E9,9E9,9E9]"


def rapid(programme: RobotProgramme) -> tuple[str]:
    """Text of a RAPID module: ``MoveAbsJ`` to the approach, ``MoveL`` along the seam, ``ArcL`` where an arc burns.

    Raises:
        InputError: a name that RAPID does not take, an arm without six joints.
    """
    check_six_joints(programme, "RAPID")
    name = checked_name(programme.name, "RAPID", LONGEST_NAME)
    return ("\n".join([f"MODULE {_fit(name, 'm_')}", *_frames(programme), *_procedure(programme), "ENDMODULE", ""]),)


def confdata(placement: Placement) -> tuple[int, int, int, int]:
    """``[cf1, cf4, cf6, cfx]``: quadrants of the joints 1, 4 and 6, counted from 0 up and -1 down, and the case.

    cfx counts 4 for a wrist behind axis 1, 2 for a wrist behind the lower arm, 1 for joint 5 below zero.
    """
    cf1, cf4, cf6 = (int(np.floor(placement.q_rad[joint] / (np.pi / 2))) for joint in (0, 3, 5))
    return cf1, cf4, cf6, 4 * (not placement.in_front) + 2 * (not placement.elbow_up) + (not placement.wrist_positive)


def _fit(name: str, before: str) -> str:
    return checked_name(before + name, "RAPID", LONGEST_NAME)


def _names(programme: RobotProgramme) -> tuple[str, str]:
    """Names of tool and work object: the controller's own, or those that the module declares."""
    kept = (programme.kept_tool, "tTorch"), (programme.kept_work, "wWork")
    tool, work = (checked_name(name, "RAPID", LONGEST_NAME, "frame") if name else own for name, own in kept)
    return tool, work


def _frames(programme: RobotProgramme) -> list[str]:
    tool, work = _names(programme)
    tool_frame, work_frame = _pose(programme.T_flange_tool), _pose(programme.T_base_work)
    lines = [f"  ! {plain_text(str(programme), 70)}"]
    if programme.kept_tool:
        lines.append(f"  ! tframe of {tool} as this programme was made: {tool_frame}")
    else:
        lines += [
            "  ! mass and centre of gravity of the torch: put in what loadidentify measures",
            f"  PERS tooldata {tool}:=[TRUE,{tool_frame},[1,[0,0,50],[1,0,0,0],0,0,0]];",
        ]
    if programme.kept_work:
        lines.append(f"  ! uframe of {work} as this programme was made: {work_frame}")
    else:
        lines.append(f'  PERS wobjdata {work}:=[FALSE,TRUE,"",{work_frame},[[0,0,0],[1,0,0,0]]];')
    return lines


def _procedure(programme: RobotProgramme) -> list[str]:
    lines = [f"  PROC {programme.name}()"]
    burning = False
    tool, work = _names(programme)
    arc_data = "" if programme.arc is None or programme.arc.data is None else _arc_data(programme.arc.data)
    for step in programme.steps:
        if isinstance(step, Comment):
            lines.append(f"    ! {plain_text(step.text, 70)}")
        elif isinstance(step, JointMove):
            angles = ",".join(plain(float(np.degrees(angle)), 6) for angle in step.q_rad)
            speed = f"[{plain(10 * percent(step), 1)},{plain(5 * percent(step), 1)},5000,1000]"
            lines.append(f"    MoveAbsJ [[{angles}],{EXTERNAL}]\\NoEOffs,{speed},fine,{tool}\\WObj:={work};")
        elif isinstance(step, Output):
            lines.append(_output(step))
        elif isinstance(step, Wait):
            lines.append(f"    WaitTime {plain(step.seconds, 3)};")
        elif isinstance(step, ArcStart):
            burning = True
            lines[-1] = lines[-1].replace("MoveL ", "ArcLStart ").replace(",fine,", f",{arc_data},fine,")
        elif isinstance(step, ArcEnd):
            burning = False
            lines[-1] = lines[-1].replace("ArcL ", "ArcLEnd ")
        elif isinstance(step, LinearMove):
            instruction, data = ("ArcL", f",{arc_data}") if burning else ("MoveL", "")
            speed, zone = _speed(step.speed_mm_s), _zone(step.zone_mm)
            lines.append(f"    {instruction} {_target(step)},{speed}{data},{zone},{tool}\\WObj:={work};")
    return [*lines, "  ENDPROC"]


def _output(step: Output) -> str:
    name = checked_name(step.name, "RAPID", LONGEST_NAME, "signal")
    return f"    SetDO {name},{int(step.value)};" if is_digital(step) else f"    SetAO {name},{plain(step.value, 4)};"


def _arc_data(data: tuple[str, str]) -> str:
    return ",".join(checked_name(name, "RAPID", LONGEST_NAME, "arc data") for name in data)


def _target(move: LinearMove) -> str:
    numbers = ",".join(str(number) for number in confdata(placed(move)))
    return f"[{_pose(move.T_work_tool)[1:-1]},[{numbers}],{EXTERNAL}]"


def _pose(pose: Floats) -> str:
    place = ",".join(plain(number, 5) for number in pose[:3, 3])
    turn = ",".join(plain(number, 9) for number in quaternion_wxyz(pose[:3, :3]))
    return f"[[{place}],[{turn}]]"


def _speed(speed_mm_s: float) -> str:
    return f"[{plain(speed_mm_s, 3)},500,5000,1000]"


def _zone(zone_mm: float) -> str:
    if zone_mm < 0.05:
        return "fine"
    size = plain(zone_mm, 3)
    return f"[FALSE,{size},{size},{size},0.1,{size},0.1]"
