"""KUKA KRL: a ``.src`` with the steps and a ``.dat`` with the positions; A B C turn about z, y, x; S and T are kept."""

from __future__ import annotations

import numpy as np

from grindvision.motion.placement import Placement
from grindvision.motion.programme_steps import (
    Comment,
    Floats,
    JointMove,
    LinearMove,
    Output,
    RobotProgramme,
    Wait,
    euler_zyx_deg,
    plain,
)
from grindvision.motion.writers.words import (
    check_no_arc_data,
    check_six_joints,
    checked_name,
    checked_number,
    is_digital,
    percent,
    placed,
    plain_text,
)

LONGEST_NAME = 24


def krl(programme: RobotProgramme) -> tuple[str, str]:
    """Texts of the ``.src`` and the ``.dat``: ``PTP`` by axes to the approach, ``LIN`` along the seam.

    Raises:
        InputError: a name or an output that KRL does not take, an arm without six joints.
    """
    check_six_joints(programme, "KRL")
    check_no_arc_data(programme, "KRL")
    name = checked_name(programme.name, "KRL", LONGEST_NAME)
    source = [
        f"DEF {name}()",
        f"; {plain_text(str(programme), 70)}",
        "BAS(#INITMOV,0)",
        *_frames(programme),
        "$IPO_MODE=#BASE",
    ]
    data = [f"DEFDAT {name}"]
    for step in programme.steps:
        if isinstance(step, Comment):
            source.append(f"; {plain_text(step.text, 70)}")
        elif isinstance(step, JointMove):
            axes = ",".join(f"A{number} {plain(float(np.degrees(q)), 5)}" for number, q in enumerate(step.q_rad, 1))
            source += [f"BAS(#VEL_PTP,{plain(percent(step), 1)})", f"PTP {{{axes}}}"]
        elif isinstance(step, Output):
            source.append(_output(step))
        elif isinstance(step, Wait):
            source.append(f"WAIT SEC {plain(step.seconds, 3)}")
        elif isinstance(step, LinearMove):
            number = sum(line.startswith("DECL") for line in data)
            status, turn = status_and_turn(placed(step))
            data.append(f"DECL POS XP{number}={{{_frame(step.T_work_tool)},S {status},T {turn}}}")
            smooth = step.zone_mm >= 0.05
            source.append(f"$VEL.CP={plain(step.speed_mm_s / 1000.0, 7)}")
            source += [f"$APO.CDIS={plain(step.zone_mm, 3)}"] if smooth else []
            source.append(f"LIN XP{number}{' C_DIS' if smooth else ''}")
    return "\n".join([*source, "END", ""]), "\n".join([*data, "ENDDAT", ""])


def status_and_turn(placement: Placement) -> tuple[int, int]:
    """``S``: 1 overhead, 2 elbow up, 4 joint 5 below zero. ``T``: bit i - 1 is set where axis i is below zero."""
    status = (not placement.in_front) + 2 * placement.elbow_up + 4 * (not placement.wrist_positive)
    return int(status), sum(1 << joint for joint, angle in enumerate(placement.q_rad) if angle < 0)


def _frames(programme: RobotProgramme) -> list[str]:
    """Tool and base: given by value, or called by the number under which the controller keeps them."""
    lines = []
    for word, kept, highest, frame in (
        ("TOOL", programme.kept_tool, 16, _frame(programme.T_flange_tool)),
        ("BASE", programme.kept_work, 32, _frame(programme.T_base_work)),
    ):
        if kept:
            number = checked_number(kept, "KRL", highest, "frames")
            lines += [f"; {word}_DATA[{number}] as this programme was made: {{{frame}}}", f"BAS(#{word},{number})"]
        else:
            lines.append(f"${word}={{{frame}}}")
    return lines


def _frame(pose: Floats) -> str:
    a, b, c = euler_zyx_deg(pose[:3, :3])
    numbers = zip("XYZABC", (*pose[:3, 3], a, b, c), strict=True)
    return ",".join(f"{letter} {plain(float(number), 5)}" for letter, number in numbers)


def _output(step: Output) -> str:
    if is_digital(step):
        return f"$OUT[{checked_number(step.name, 'KRL', 8192)}]={'TRUE' if step.value else 'FALSE'}"
    return f"$ANOUT[{checked_number(step.name, 'KRL', 32)}]={plain(step.value, 4)}"
