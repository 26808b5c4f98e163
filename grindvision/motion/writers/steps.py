"""The common form itself: a JSON file with every step and its frames, or a CSV with a row per step."""

from __future__ import annotations

import json
from typing import Any

from grindvision.motion.programme_steps import (
    ArcEnd,
    ArcStart,
    Comment,
    JointMove,
    LinearMove,
    Output,
    RobotProgramme,
    Step,
    Wait,
    plain,
    quaternion_wxyz,
)
from grindvision.motion.writers.words import plain_text

COLUMNS = ("step", "kind", "x_mm", "y_mm", "z_mm", "qw", "qx", "qy", "qz", "speed_mm_s", "zone_mm", "on_seam") + (
    "speed_fraction",
    "output",
    "value",
    "seconds",
    "text",
)

KINDS = {
    JointMove: "joint move",
    LinearMove: "linear move",
    Output: "output",
    Wait: "wait",
    Comment: "comment",
    ArcStart: "arc start",
    ArcEnd: "arc end",
}


def steps_json(programme: RobotProgramme) -> tuple[str]:
    """Text of a JSON object: robot, frames, units, and ``steps`` in order, poses as 4x4 matrices in the work object."""
    content = {
        "name": programme.name,
        "robot": programme.robot,
        "joints": programme.joints,
        "hot": programme.hot,
        "units": {"length": "mm", "angle": "rad", "time": "s"},
        "T_flange_tool": programme.T_flange_tool.tolist(),
        "T_base_work": programme.T_base_work.tolist(),
        "arc_data": None if programme.arc is None else programme.arc.data,
        "steps": [{"kind": KINDS[type(step)], **_content(step)} for step in programme.steps],
    }
    return (json.dumps(content, indent=1) + "\n",)


def steps_csv(programme: RobotProgramme) -> tuple[str]:
    """Text of a table: a row per step, poses in the work object with unit quaternions, joint angles in rad at the end.

    What a step has not stays empty. Frames of tool and work object stand in comment lines that begin with ``#``.
    """
    joints = [f"{joint}_rad" for joint in programme.joints]
    lines = [
        f"# {name}: {' '.join(plain(number, 9) for number in frame[:3].ravel().tolist())}"
        for name, frame in (("T_flange_tool", programme.T_flange_tool), ("T_base_work", programme.T_base_work))
    ]
    lines.append(",".join([*COLUMNS, *joints]))
    for number, step in enumerate(programme.steps):
        content = _content(step)
        angles = content.pop("q_rad", [])
        if pose := content.pop("T_work_tool", None):
            turn = quaternion_wxyz(step.T_work_tool[:3, :3]) if isinstance(step, LinearMove) else ()
            content |= dict(zip(COLUMNS[2:9], [*(row[3] for row in pose[:3]), *turn], strict=True))
        cells = {"step": number, "kind": KINDS[type(step)], **content}
        words = [_word(cells.get(column, "")) for column in COLUMNS]
        lines.append(",".join([*words, *(_word(angle) for angle in angles), *[""] * (len(joints) - len(angles))]))
    return ("\n".join([*lines, ""]),)


def _content(step: Step) -> dict[str, Any]:
    if isinstance(step, JointMove):
        return {"q_rad": step.q_rad.tolist(), "speed_fraction": step.speed_fraction}
    if isinstance(step, LinearMove):
        return {
            "T_work_tool": step.T_work_tool.tolist(),
            "q_rad": step.q_rad.tolist(),
            "speed_mm_s": float(step.speed_mm_s),
            "zone_mm": float(step.zone_mm),
            "on_seam": step.on_seam,
        }
    if isinstance(step, Output):
        return {"output": plain_text(step.name, 40), "value": step.value}
    if isinstance(step, Wait):
        return {"seconds": step.seconds}
    return {"text": plain_text(step.text, 200)} if isinstance(step, Comment) else {}


def _word(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    return plain(value, 9) if isinstance(value, float) else str(value).replace(",", ";")
