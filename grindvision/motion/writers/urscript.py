"""URScript from the common form: metres, rotation vectors; the dry run of ``grindvision.motion.urscript`` stays."""

from __future__ import annotations

from scipy.spatial.transform import Rotation

from grindvision.errors import InputError
from grindvision.motion.programme import UR_JOINTS
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
    checked_name,
    checked_number,
    is_digital,
    percent,
    plain_text,
)


def urscript_of(programme: RobotProgramme) -> tuple[str]:
    """Text of the function: ``movej`` to the approach, ``movel`` to the seam, ``movep`` along it.

    Raises:
        InputError: the arm is none of Universal Robots'; a name or an output that URScript does not take.
    """
    if programme.joints != UR_JOINTS:
        raise InputError(f"{programme.robot} is no arm of Universal Robots, it cannot run URScript")
    check_no_arc_data(programme, "URScript")
    lines = [
        f"def {checked_name(programme.name, 'URScript', 32)}():",
        f"  set_tcp({_pose(programme.T_flange_tool)})",
    ]
    if programme.kept_tool:
        lines[1] = f"  # TCP {plain_text(programme.kept_tool, 32)} as this was made: {_pose(programme.T_flange_tool)}"
    for step in programme.steps:
        if isinstance(step, Comment):
            lines.append(f"  # {plain_text(step.text, 70)}")
        elif isinstance(step, JointMove):
            angles = ", ".join(plain(float(angle), 9) for angle in step.q_rad)
            lines.append(f"  movej([{angles}], a=0.8, v={plain(0.05 * percent(step), 3)})")
        elif isinstance(step, Output):
            lines.append(_output(step))
        elif isinstance(step, Wait):
            lines.append(f"  sleep({plain(step.seconds, 3)})")
        elif isinstance(step, LinearMove):
            pose, speed = _pose(programme.T_base_work @ step.T_work_tool), plain(step.speed_mm_s / 1000.0, 6)
            if step.on_seam:
                lines.append(f"  movep({pose}, a=0.1, v={speed}, r={plain(step.zone_mm / 1000.0, 6)})")
            else:
                lines.append(f"  movel({pose}, a=0.3, v={speed})")
    return ("\n".join([*lines, "end", ""]),)


def _pose(pose: Floats) -> str:
    numbers = [*(pose[:3, 3] / 1000.0), *Rotation.from_matrix(pose[:3, :3]).as_rotvec()]
    return "p[" + ", ".join(plain(float(number), 9) for number in numbers) + "]"


def _output(step: Output) -> str:
    if is_digital(step):
        return f"  set_standard_digital_out({_from_zero(step.name, 7)}, {'True' if step.value else 'False'})"
    if not 0.0 <= step.value <= 1.0:
        raise InputError(f"URScript takes an analogue setpoint from 0 to 1 of the range, not {step.value:g}")
    return f"  set_standard_analog_out({_from_zero(step.name, 1)}, {plain(step.value, 4)})"


def _from_zero(name: str, highest: int) -> int:
    return 0 if name == "0" else checked_number(name, "URScript", highest)
