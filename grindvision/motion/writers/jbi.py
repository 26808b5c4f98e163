"""Yaskawa INFORM job (JBI): Rx Ry Rz turn about fixed x, y, z; TOOL and USER are numbers; RCONF is kept."""

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

LONGEST_NAME, LONGEST_REMARK = 32, 32


def jbi(programme: RobotProgramme) -> tuple[str]:
    """Text of the job: ``MOVJ`` by joint angles to the approach, ``MOVL`` along the seam, in the work object's frame.

    The controller keeps the tool and the user frame under their numbers; remarks give the values they must have there.

    Raises:
        InputError: a name or an output that INFORM does not take; an arm without six joints or that reaches over its
            back.
    """
    check_six_joints(programme, "JBI")
    check_no_arc_data(programme, "JBI")
    name = checked_name(programme.name, "JBI", LONGEST_NAME).upper()
    at_base = bool(np.allclose(programme.T_base_work, np.eye(4), atol=1e-9))
    frame = "BASE" if at_base else "USER"
    lines = _remarks(f"TOOL{programme.tool_number}", programme.T_flange_tool)
    lines += [] if at_base else _remarks(f"USER{programme.work_number}", programme.T_base_work)
    joints: list[str] = []
    poses: list[str] = []
    last = ""
    number = sum(isinstance(step, JointMove) for step in programme.steps)  # positions of the joint moves come first
    for step in programme.steps:
        if isinstance(step, Comment):
            lines.append(f"'{plain_text(step.text, LONGEST_REMARK)}")
        elif isinstance(step, JointMove):
            lines.append(f"MOVJ C{len(joints):05d} VJ={plain(percent(step), 2)} PL=0")
            angles = ",".join(plain(float(np.degrees(q)), 4) for q in step.q_rad)
            joints.append(f"C{len(joints):05d}={angles}")
        elif isinstance(step, Output):
            lines.append(_output(step))
        elif isinstance(step, Wait):
            lines.append(f"TIMER T={plain(step.seconds, 2)}")
        elif isinstance(step, LinearMove):
            lines.append(f"MOVL C{number:05d} V={_speed(step.speed_mm_s)} PL={0 if step.zone_mm < 0.05 else 1}")
            words = ",".join(str(flag) for flag in rconf(placed(step)))
            poses += [f"///RCONF {words}"] if words != last else []
            poses.append(f"C{number:05d}={','.join(plain(value, 4) for value in numbers_of(step.T_work_tool))}")
            last = words
            number += 1
    head = ["/JOB", f"//NAME {name}", "//POS", f"///NPOS {number},0,0,0,0,0", f"///TOOL {programme.tool_number}"]
    user = [] if at_base else [f"///USER {programme.work_number}"]
    attributes = ["///ATTR SC,RW" + ("" if at_base else ",RJ")] + (
        [] if at_base else [f"////FRAME USER {programme.work_number}"]
    )
    parts = [
        *head,
        "///POSTYPE ANGLE",
        "///ANGLE",
        *joints,
        *user,
        f"///POSTYPE {frame}",
        "///RECTAN",
        *poses,
        "//INST",
        *attributes,
        "///GROUP1 RB1",
        "NOP",
        *lines,
        "END",
        "",
    ]
    return ("\n".join(parts),)


def rconf(placement: Placement) -> tuple[int, ...]:
    """The first eight flags of ``RCONF``: no flip, elbow below, back, joints 4, 6 and 1 past half a turn, 0, 0.

    The wrist is flipped where joint 4 lies within a quarter turn of its zero, as Yaskawa's manual of the NX100 says.

    Raises:
        InputError: the arm stands overhead.
    """
    if not placement.in_front:
        raise InputError("the arm reaches over its own back, which JBI is not written for; move the work to its front")
    turned = np.degrees(placement.q_rad)
    no_flip = not -90.0 < (turned[3] + 180.0) % 360.0 - 180.0 <= 90.0
    past = [int(not -180.0 < turned[joint] <= 180.0) for joint in (3, 5, 0)]
    return (int(no_flip), int(not placement.elbow_up), 0, *past, 0, 0)


def _remarks(name: str, pose: Floats) -> list[str]:
    axes = ("X", "Y", "Z", "RX", "RY", "RZ")
    return [f"'{name} {axis} {plain(value, 4)}" for axis, value in zip(axes, numbers_of(pose), strict=True)]


def _speed(speed_mm_s: float) -> str:
    if speed_mm_s < 0.1:
        raise InputError(f"{speed_mm_s:.4g} mm/s is below 0.1 mm/s, the slowest that JBI can say; give a higher speed")
    return plain(np.floor(10.0 * speed_mm_s + 1e-6) / 10.0, 1)


def _output(step: Output) -> str:
    if is_digital(step):
        return f"DOUT OT#({checked_number(step.name, 'JBI', 4096)}) {'ON' if step.value else 'OFF'}"
    return f"AOUT AO#({checked_number(step.name, 'JBI', 40)}) {plain(step.value, 2)}"
