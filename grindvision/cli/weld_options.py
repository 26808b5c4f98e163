"""Options of ``grindvision groove`` that say how a seam is welded: weave, run-on, passes, tacks, frames, gas."""

from __future__ import annotations

import argparse
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

from grindvision.cli.parameters import number
from grindvision.errors import FileError, InputError, UnitError
from grindvision.records import by_content

if TYPE_CHECKING:
    import numpy as np

    from grindvision.motion import ArcOptions, RobotProgrammeOptions, Weave

#: Options of the weld itself; a plain dry run along the seam has none of them.
WELD_OPTIONS = ("weave", "weave_shape", "weave_length", "weave_frequency", "weave_dwell", "run_on", "run_off") + (
    "bead_area",
    "tacks",
    "tack_length",
    "skip_tacks",
)

#: Names of the controller's frames.
FRAME_OPTIONS = ("tool_data", "work_object", "work_frame")

#: What a hot run says.
ARC_OPTIONS = ("arc_output", "arc_setpoint", "arc_data") + (
    "arc_gas",
    "pre_flow",
    "post_flow",
    "arc_start",
    "crater_fill",
)

TACK_MM = 10.0


@by_content
@dataclass(frozen=True)
class WeldWishes:
    """What was asked for beside a plain run along the seam; lengths in mm, ``tacks`` a number of them or places.

    ``tacks`` and ``skipped`` given as places are rows x, y, z, length in the cloud's frame. ``weave_by_time``: the
    swing was given by its frequency, and keeps it at other speeds along the seam.
    """

    weave: Weave | None = None
    weave_by_time: bool = False
    run_on_mm: float = 0.0
    run_off_mm: float = 0.0
    bead_mm2: float | None = None
    tacks: int | np.ndarray | None = None
    tack_mm: float = TACK_MM
    skipped: np.ndarray | None = None


@by_content
@dataclass(frozen=True)
class FrameNames:
    """Tool and work object as the controller names or counts them, and where the work object stands, mm."""

    tool: str = ""
    work: str = ""
    T_base_work: np.ndarray | None = None

    def programme_options(self, name: str, form: str, arc: ArcOptions | None = None) -> RobotProgrammeOptions:
        """Settings of a programme in a language."""
        import numpy as np

        from grindvision.motion import RobotProgrammeOptions

        numbered = form in ("ls", "jbi")
        return RobotProgrammeOptions(
            name,
            T_base_work=np.eye(4) if self.T_base_work is None else self.T_base_work,
            arc=arc,
            placed=form in ("rapid", "krl", "ls", "jbi"),
            tool_number=_number("--tool-data", self.tool, form) if numbered and self.tool else 1,
            work_number=_number("--work-object", self.work, form) if numbered and self.work else 1,
            kept_tool="" if numbered else self.tool,
            kept_work="" if numbered else self.work,
        )


def add_weld_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of weave, run-on, passes, tacks and frames."""
    group = parser.add_argument_group("weld (need --robot and a language that sets speeds, not csv or json)")
    group.add_argument("--weave", type=number, metavar="MM", help="swing from side to side, so wide from toe to toe")
    group.add_argument("--weave-shape", choices=("sine", "triangle"), help="course of the swing (default: sine)")
    group.add_argument(
        "--weave-length", type=number, metavar="MM", help="a swing takes so much of the seam (default: 4)"
    )
    group.add_argument("--weave-frequency", type=number, metavar="HZ", help="swings a second, in place of the length")
    group.add_argument(
        "--weave-dwell", type=number, metavar="S", help="go on without swinging at each toe (default: 0)"
    )
    group.add_argument("--run-on", type=number, metavar="MM", help="begin so far before the seam (default: 0)")
    group.add_argument(
        "--run-off", type=number, metavar="MM", help="end so far behind it; overlap of a closed seam (default: 0)"
    )
    group.add_argument(
        "--bead-area",
        type=number,
        metavar="MM2",
        help="cross-section of the bead that the feed lays at --torch-speed: the first groove is filled in passes,"
        " pass1.*, pass2.*, ...",
    )
    group.add_argument(
        "--tacks",
        metavar="N|FILE.csv",
        help="write tack welds too, tacks.*: N equally spaced, or at places x_mm,y_mm,z_mm[,length_mm] of CLOUD",
    )
    group.add_argument("--tack-length", type=number, metavar="MM", help=f"length of a tack (default: {TACK_MM:g})")
    group.add_argument(
        "--skip-tacks", metavar="FILE.csv", help="tacks that are there already, as in --tacks: no arc over them"
    )
    frames = parser.add_argument_group("controller's frames (need --robot)")
    frames.add_argument(
        "--tool-data",
        metavar="NAME|N",
        help="the tool as the controller keeps it: tooldata of RAPID, TOOL number of KRL, UTOOL of LS, TOOL of JBI, TCP"
        " of URScript; the programme then brings none of its own",
    )
    frames.add_argument(
        "--work-object", metavar="NAME|N", help="wobjdata of RAPID, BASE of KRL, UFRAME of LS, USER frame of JBI"
    )
    frames.add_argument(
        "--work-frame",
        metavar="FILE.json",
        help="where the work object stands: 4x4 matrix T_base_work, mm, in the controller's base (default: the base)",
    )


def add_arc_arguments(group: argparse._ArgumentGroup) -> None:
    """Options of a hot run."""
    group.add_argument(
        "--arc",
        action="store_true",
        default=None,
        help="write a hot run too, prog_arc.*: it sets the outputs named here",
    )
    group.add_argument(
        "--arc-output", metavar="NAME", help="digital output that strikes the arc, as the controller names it"
    )
    group.add_argument(
        "--arc-setpoint", nargs="+", metavar="NAME=VALUE", help="analogue outputs set before the arc, as 1=22.5"
    )
    group.add_argument(
        "--arc-data", nargs=2, metavar=("SEAM", "WELD"), help="rapid: seam and weld data of ArcL, in place of outputs"
    )
    group.add_argument(
        "--arc-gas", metavar="NAME", help="digital output of the shielding gas, where the arc's has none"
    )
    for name, text in (
        ("--pre-flow", "gas before the arc, with --arc-gas (default: 0.5)"),
        ("--post-flow", "gas after the arc, with --arc-gas (default: 1)"),
        ("--arc-start", "stand after striking (default: 0.5)"),
        ("--crater-fill", "stand at the weld's end before the arc goes out (default: 0.5)"),
    ):
        group.add_argument(name, type=number, metavar="S", help=text)


def weld_wishes(options: argparse.Namespace, form: str, speed_mm_s: float) -> WeldWishes | None:
    """What the options ask for, or None for a plain run along the seam.

    Raises:
        InputError: options that do not go together or cannot be meant. FileError: a file of tacks is none.
    """
    given = [name for name in WELD_OPTIONS if getattr(options, name) is not None]
    if not given:
        return None
    if form in ("csv", "json"):
        raise InputError(
            f"--{given[0].replace('_', '-')} needs a programme that sets speeds and the arc; give --program, not"
            f" {form}: steps-csv or steps-json for a table of steps"
        )
    if options.send is not None and (options.bead_area is not None or options.tacks is not None):
        raise InputError("--send hands one programme over; leave --bead-area and --tacks out, or load the files")
    if options.variant != "ours" and options.bead_area is not None:
        raise InputError("--bead-area needs the groove's measured section; leave --variant at ours")
    if options.tack_length is not None and options.tacks is None and options.skip_tacks is None:
        raise InputError("--tack-length is for tacks; give --tacks or --skip-tacks as well")
    tack_mm = TACK_MM if options.tack_length is None else options.tack_length
    if not 1 <= tack_mm <= 200:
        raise InputError(f"--tack-length is {tack_mm:g} mm; give 1 to 200")
    if options.bead_area is not None and not options.bead_area > 0:
        raise InputError(f"--bead-area is {options.bead_area:g} mm2; give a cross-section above 0")
    for name in ("run_on", "run_off"):
        if not 0 <= (getattr(options, name) or 0.0) <= 200:
            raise InputError(f"--{name.replace('_', '-')} is {getattr(options, name):g} mm; give 0 to 200")
    return WeldWishes(
        _weave(options, speed_mm_s),
        options.weave_frequency is not None,
        options.run_on or 0.0,
        options.run_off or 0.0,
        options.bead_area,
        _tacks(options.tacks, tack_mm),
        tack_mm,
        None if options.skip_tacks is None else _places(options.skip_tacks, tack_mm),
    )


def hot_run(options: argparse.Namespace, form: str) -> ArcOptions | None:
    """The hot run that is asked for, or None.

    Raises:
        InputError: details without ``--arc``, or ones that do not go together.
    """
    if options.arc is None:
        lonely = [name for name in ARC_OPTIONS if getattr(options, name, None) is not None]
        if lonely:
            raise InputError(f"--{lonely[0].replace('_', '-')} is for a hot run; give --arc as well")
        return None
    from grindvision.motion import ArcOptions

    if form in ("csv", "json"):
        raise InputError(f"--arc needs a language that can set outputs; give --program, not {form}")
    if options.send is not None:
        raise InputError("--send hands the dry run over; load a hot run at the controller, without --send")
    setpoints = [word.partition("=") for word in options.arc_setpoint or []]
    try:
        values = tuple((name, float(value)) for name, _, value in setpoints)
    except ValueError:
        raise InputError(f"--arc-setpoint {' '.join(options.arc_setpoint)[:60]}: give NAME=VALUE, as 1=22.5") from None
    if options.arc_gas is None and (options.pre_flow is not None or options.post_flow is not None):
        raise InputError("--pre-flow and --post-flow switch the shielding gas; give --arc-gas NAME as well")
    times = {"start_s": "arc_start", "crater_s": "crater_fill", "pre_flow_s": "pre_flow", "post_flow_s": "post_flow"}
    said = {name: getattr(options, option) for name, option in times.items() if getattr(options, option) is not None}
    data = tuple(options.arc_data) if options.arc_data else None
    return ArcOptions(options.arc_output or "", values, data, gas=options.arc_gas or "", **said)


def frame_names(options: argparse.Namespace, form: str) -> FrameNames:
    """Names of the controller's frames.

    Raises:
        InputError: a name where the language has none. FileError, NotRigidError, UnitError: the frame's file.
    """
    tool, work = options.tool_data or "", options.work_object or ""
    for option, value in (("--tool-data", options.tool_data), ("--work-object", options.work_object)):
        if value is not None and form in ("csv", "json", "steps-csv", "steps-json"):
            raise InputError(f"{option} is for a controller's language; give --program, not {form}")
        if value is not None and not value.strip():
            raise InputError(f"{option} is empty; give a name or a number, or leave it out")
    if form == "urscript" and work:
        raise InputError("URScript counts in the robot's base and names no work object; leave --work-object out")
    if options.work_frame is None:
        if work and work != "0":
            raise InputError(
                "--work-object needs --work-frame: where the controller's work object stands in its base, so that the"
                " positions can be given in it"
            )
        return FrameNames(tool, work)
    if form in ("csv", "json"):
        raise InputError(f"--work-frame is for a controller's language; give --program, not {form}")
    import numpy as np

    from grindvision.files import read_json
    from grindvision.geometry import check_rigid

    content = read_json(options.work_frame)
    if isinstance(content, dict):
        if "T_base_work" not in content:
            raise FileError(f"{options.work_frame}: no key T_base_work; found {', '.join(list(content)[:8])[:80]}")
        content = content["T_base_work"]
    frame = check_rigid(content, f"{options.work_frame}: T_base_work", tolerance=1e-3)
    if 0 < np.linalg.norm(frame[:3, 3]) < 5.0:
        raise UnitError(
            f"{options.work_frame}: the work object is {np.linalg.norm(frame[:3, 3]):.3g} mm from the base: metres?"
            " give millimetres"
        )
    return FrameNames(tool, work, frame)


def _weave(options: argparse.Namespace, speed_mm_s: float) -> Weave | None:
    details = ("weave_shape", "weave_length", "weave_frequency", "weave_dwell")
    if options.weave is None:
        lonely = [name for name in details if getattr(options, name) is not None]
        if lonely:
            raise InputError(f"--{lonely[0].replace('_', '-')} is for a weave; give --weave MM as well")
        return None
    if options.weave_length is not None and options.weave_frequency is not None:
        raise InputError("--weave-length and --weave-frequency say the same at one speed; give one of them")
    if options.weave_frequency is not None and not 0.05 <= options.weave_frequency <= 10:
        raise InputError(f"--weave-frequency is {options.weave_frequency:g} Hz; give 0.05 to 10")
    from grindvision.motion import Weave

    length = 4.0 if options.weave_length is None else options.weave_length
    if options.weave_frequency is not None:
        length = speed_mm_s / options.weave_frequency
    weave = Weave(options.weave, length, options.weave_shape or "sine", (options.weave_dwell or 0.0) * speed_mm_s)
    weave.check_speed(speed_mm_s)
    return weave


def _tacks(text: str | None, tack_mm: float) -> int | np.ndarray | None:
    if text is None:
        return None
    if re.fullmatch(r"[+-]?\d{1,9}", text):
        if not 1 <= int(text) <= 100:
            raise InputError(f"--tacks is {text}; give 1 to 100 tacks, or a file of places")
        return int(text)
    return _places(text, tack_mm)


def _places(path: str, tack_mm: float) -> np.ndarray:
    """Rows x, y, z, length in mm."""
    import numpy as np

    from grindvision.files import column_names, read_table

    axes = ("x_mm", "y_mm", "z_mm")
    own = "length_mm" in column_names(path)
    table = read_table(path, (*axes, "length_mm") if own else axes)
    lengths = table["length_mm"].to_numpy() if own else np.full(len(table), tack_mm)
    if not ((lengths >= 1) & (lengths <= 200)).all():
        worst = int(np.argmin((lengths >= 1) & (lengths <= 200)))
        raise InputError(f"{path}: tack {worst + 1} is {lengths[worst]:g} mm long; give 1 to 200 mm")
    return np.column_stack([table[axis].to_numpy() for axis in axes] + [lengths])


def _number(option: str, text: str, form: str) -> int:
    highest = {("--tool-data", "ls"): 10, ("--work-object", "ls"): 9}.get((option, form), 63)
    if not re.fullmatch(r"\d{1,2}", text, re.ASCII) or int(text) > highest:
        raise InputError(f"{option} is {text[:40]!r}; {form.upper()} counts its frames: give 0 to {highest}")
    return int(text)
