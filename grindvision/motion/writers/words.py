"""What the writers share: names and comments that a controller takes, and the checks of a programme."""

from __future__ import annotations

import re

from grindvision.errors import InputError
from grindvision.motion.placement import Placement
from grindvision.motion.programme_steps import Floats, JointMove, LinearMove, Output, RobotProgramme, euler_zyx_deg


def checked_name(name: str, language: str, longest: int, what: str = "programme") -> str:
    """The name itself, when it has a letter first, then letters, digits and underscores, and fits.

    Raises:
        InputError: it does not.
    """
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name, re.ASCII) or len(name) > longest:
        raise InputError(
            f"{language} takes no {what} named {name[:40]!r}: a letter, then letters, digits and underscores, {longest}"
            " at most"
        )
    return name


def checked_number(name: str, language: str, highest: int, what: str = "outputs") -> int:
    """The number of an output or a frame, for controllers that count them.

    Raises:
        InputError: it is no whole number from 1 to ``highest``.
    """
    if not re.fullmatch(r"[0-9]{1,5}", name, re.ASCII) or not 1 <= int(name) <= highest:
        raise InputError(f"{language} counts its {what}: give a number from 1 to {highest}, not {name[:40]!r}")
    return int(name)


def plain_text(text: str, longest: int) -> str:
    """A comment without what a controller could read as more than a comment, cut to its line."""
    return re.sub(r"[^A-Za-z0-9 _.,:/()+-]", "_", text)[:longest]


def placed(move: LinearMove) -> Placement:
    """How the arm stands at a move.

    Raises:
        InputError: the programme was made without placements.
    """
    if move.placement is None:
        raise InputError("the programme names no placement of the arm; make it with placed=True")
    return move.placement


def check_six_joints(programme: RobotProgramme, language: str) -> None:
    """Refuse an arm that has not six joints.

    Raises:
        InputError: it has not.
    """
    if len(programme.joints) != 6:
        raise InputError(f"{programme.robot} has {len(programme.joints)} joints; {language} is written for six")


def check_no_arc_data(programme: RobotProgramme, language: str) -> None:
    """Refuse seam and weld data where they mean nothing.

    Raises:
        InputError: the hot run names them.
    """
    if programme.arc is not None and programme.arc.data is not None:
        raise InputError(f"seam and weld data are for RAPID; {language} needs the output that strikes the arc")


def is_digital(step: Output) -> bool:
    """Is it a digital output?"""
    return isinstance(step.value, bool)


def percent(move: JointMove) -> float:
    """Speed of a joint move, % of the joints' full speed.

    Raises:
        InputError: it is not above 0 or above 100.
    """
    if not 0 < move.speed_fraction <= 1:
        raise InputError(
            f"a joint move at {move.speed_fraction:g} of the full speed; give a fraction above 0, 1 at most"
        )
    return 100.0 * move.speed_fraction


def numbers_of(pose: Floats) -> list[float]:
    """x, y, z in mm of a pose (4, 4), and its turns in deg about the fixed axes x, y, z."""
    z, y, x = euler_zyx_deg(pose[:3, :3])
    return [*map(float, pose[:3, 3]), x, y, z]
