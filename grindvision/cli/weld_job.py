"""The runs of a weld: what is asked for becomes paths, motions and programmes, one each for tacks and passes."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeVar

from grindvision.cli.weld_options import WeldWishes
from grindvision.errors import GrindvisionWarning, InputError, UnreachableError
from grindvision.records import by_content

if TYPE_CHECKING:
    from grindvision.motion import GrooveSection, Trajectory, Weave, WeldFill, WeldPath
    from grindvision.vision.seam.groove_lines import DetectedGroove
    from grindvision.vision.seam.seam_path import SeamPath

#: A groove whose section varies by more than this, between its tenth and its ninetieth percentile, is told.
VARYING_SECTION = 0.3

#: So many places of a closed seam are tried as its start, 45 deg apart: a wrist joint whose range is a little more than
#: a full turn (2 x 270 deg less where it stands first) goes round from some of them only.
STARTS = 8

Plan = TypeVar("Plan")


@by_content
@dataclass(frozen=True)
class WeldRun:
    """One programme: names of its dry and its hot file, and its path in the scanner's frame."""

    name: str
    hot_name: str
    path: WeldPath


@by_content
@dataclass(frozen=True)
class WeldRuns:
    """All programmes of a weld in their order, with the passes that fill the groove where those were asked for."""

    runs: tuple[WeldRun, ...]
    fill: WeldFill | None = None

    def facts(self) -> dict[str, Any]:
        """What report.json says about them."""
        told = [
            {
                "program": run.name,
                "welds": run.path.count,
                "length_mm": sum(run.path.lengths_mm),
                "speed_mm_s": run.path.speed_mm_s,
                "weave": None if run.path.weave is None else str(run.path.weave),
                "positions": len(run.path),
            }
            for run in self.runs
        ]
        if self.fill is None:
            return {"runs": told}
        section = self.fill.section
        passes = [
            {
                "layer": one.layer,
                "area_mm2": one.area_mm2,
                "right_mm": one.right_mm,
                "up_mm": one.up_mm,
                "speed_factor": one.speed_factor,
            }
            for one in self.fill.passes
        ]
        groove = {"width_mm": section.width_mm, "depth_mm": section.depth_mm, "root_gap_mm": section.gap_mm}
        return {"runs": told, "section_mm2": section.area_mm2, "section": groove, "passes": passes}


def weld_runs(
    wishes: WeldWishes,
    speed_mm_s: float,
    path: SeamPath,
    groove: DetectedGroove | None,
    torch: Callable[[SeamPath], Trajectory],
) -> WeldRuns:
    """Paths of all programmes along the first seam; ``torch`` makes tool frames of way points.

    Raises:
        InputError: passes for a seam that is no groove; tacks that do not fit the seam.
    """
    from grindvision.motion import (
        WeldPathOptions,
        equal_tacks,
        fill_groove,
        shifted_seam,
        stretches_between,
        tacks_at,
        weld_path,
    )

    seam = torch(path)
    left = None
    if wishes.skipped is not None:
        left = stretches_between(seam, tacks_at(seam, wishes.skipped[:, :3], wishes.skipped[:, 3]))
    options = WeldPathOptions(speed_mm_s, wishes.run_on_mm, wishes.run_off_mm, wishes.weave, left)
    fill = None
    if wishes.bead_mm2 is None:
        runs = [WeldRun("program", "prog_arc", weld_path(seam, options))]
    elif groove is None:
        raise InputError("--bead-area fills a groove, and the first seam is none; give --joint groove, or leave it out")
    else:
        fill = fill_groove(groove_section(groove), wishes.bead_mm2)
        runs = []
        for one in fill.passes:
            points, normals = shifted_seam(path.points, path.normals, path.closed, one.right_mm, one.up_mm)
            beside = torch(replace(path, points=points, normals=normals))
            stretches = None if left is None else _scaled(left, beside.arc_mm[-1] / seam.arc_mm[-1])
            settings = replace(
                options,
                speed_mm_s=speed_mm_s * one.speed_factor,
                weave=_at_speed(wishes, one.speed_factor),
                stretches=stretches,
            )
            runs.append(WeldRun(f"pass{one.number}", f"arc{one.number}", weld_path(beside, settings)))
    if wishes.tacks is not None:
        if isinstance(wishes.tacks, int):
            stretches = equal_tacks(seam, wishes.tacks, wishes.tack_mm)
        else:
            stretches = tacks_at(seam, wishes.tacks[:, :3], wishes.tacks[:, 3])
        tacks = weld_path(seam, WeldPathOptions(speed_mm_s, stretches=stretches))
        runs.append(WeldRun("tacks", "tack_arc", tacks))
    return WeldRuns(tuple(runs), fill)


def within_reach(path: SeamPath, plan: Callable[[SeamPath], Plan]) -> Plan:
    """What ``plan`` makes of the path; of a closed one that the arm cannot go round from its first way point, from the
    first of ``STARTS`` others from which it can.

    Raises:
        UnreachableError: it can from none; the complaint is that of the first way point.
    """
    try:
        return plan(path)
    except UnreachableError:
        if path.closed:
            for start in sorted({part * len(path) // STARTS for part in range(1, STARTS)} - {0}):
                with suppress(UnreachableError):
                    planned = plan(path.begun_at(start))
                    warnings.warn(
                        f"the arm cannot go round the seam from way point 1 on: the programme begins and ends at way"
                        f" point {start + 1}",
                        GrindvisionWarning,
                        stacklevel=2,
                    )
                    return planned
        raise


def groove_section(groove: DetectedGroove) -> GrooveSection:
    """The median cross-section of a groove that was found, and a warning where it varies along the seam."""
    import numpy as np

    from grindvision.motion import GrooveSection, ToolTrajectoryOptions, tool_trajectory

    frames = tool_trajectory(groove.root, groove.normals, ToolTrajectoryOptions(groove.closed)).T_base_tool
    sides = [
        float(np.median(((edge - groove.root) * frames[:, :3, 1]).sum(axis=1))) for edge in (groove.left, groove.right)
    ]
    left, right = max(-min(sides), 0.0), max(*sides, 0.0)
    gap = min(groove.floor_fraction * (left + right), 2 * left, 2 * right)
    section = GrooveSection(left, right, float(np.median(groove.depth_mm)), gap)
    low, high = np.quantile(groove.width_mm * groove.depth_mm, [0.1, 0.9]) / 2
    if high - low > VARYING_SECTION * section.area_mm2:
        warnings.warn(
            f"the groove's section runs from {low:.0f} to {high:.0f} mm2 along the seam; the passes fill its median of"
            f" {section.area_mm2:.0f} mm2",
            GrindvisionWarning,
            stacklevel=1,
        )
    return section


def _at_speed(wishes: WeldWishes, factor: float) -> Weave | None:
    """The weave at another speed along the seam: what was given in seconds keeps its time."""
    if wishes.weave is None:
        return None
    length_mm = wishes.weave.length_mm * (factor if wishes.weave_by_time else 1.0)
    return replace(wishes.weave, length_mm=length_mm, dwell_mm=wishes.weave.dwell_mm * factor)


def _scaled(stretches: tuple[tuple[float, float], ...], factor: float) -> tuple[tuple[float, float], ...]:
    return tuple((start * factor, end * factor) for start, end in stretches)
