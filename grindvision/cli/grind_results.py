"""What ``grindvision grind`` writes: the wheel's ways as tables, stock and passes in numbers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np

    from grindvision.cli.grind_robot import GrindRobot
    from grindvision.motion.grinding import GrindingPlan
    from grindvision.motion.grinding_path import ToolPath

COLUMNS = "piece,pass,line,kind,x_mm,y_mm,z_mm,nx,ny,nz,tx,ty,tz,feed_mm_s,force_n"


def write_ways(
    folder: Path,
    plans: Sequence[GrindingPlan | None],
    T_base_scanner: np.ndarray | None,
    robot: GrindRobot | None,
    points: np.ndarray,
) -> list[dict[str, Any]] | None:
    """Write passes.csv, passes_base.csv where a pose is given, and the robot's programmes; what these are, or None."""
    from grindvision.files import write_text
    from grindvision.motion.grinding_path import tool_path

    ways = [None if plan is None else tool_path(plan) for plan in plans]
    write_text(folder / "passes.csv", passes_text(ways))
    if T_base_scanner is not None:
        based = [None if way is None else way.moved(T_base_scanner) for way in ways]
        write_text(folder / "passes_base.csv", passes_text(based))
    return None if robot is None else robot.write(ways, points, folder)


def passes_text(ways: list[ToolPath | None]) -> str:
    """The places of all ways as CSV; a piece without a way has none."""
    import numpy as np

    from grindvision.motion.grinding_path import KINDS

    lines = [COLUMNS]
    for piece, way in enumerate(ways, start=1):
        if way is None:
            continue
        numbers = np.column_stack([way.points, way.normals, way.ahead, way.feeds_mm_s, way.forces_n])
        for at, row in enumerate(np.round(numbers, 6).tolist()):
            words = (piece, way.passes[at], way.lines[at], KINDS[way.kinds[at]], *row)
            lines.append(",".join(map(str, words)))
    return "\n".join(lines) + "\n"


def piece_facts(piece: Any) -> dict[str, Any]:
    """What report.json says of a piece of stock."""
    import numpy as np

    from grindvision.geometry import move_points

    grid = piece.map
    middle = np.array([[side * grid.spacing_mm / 2 for side in (grid.shape[0] - 1, grid.shape[1] - 1)] + [0.0]])
    names = ("volume_mm3", "area_mm2", "height_max_mm", "height_mean_mm")
    spread = ("volume_sigma_mm3", "area_sigma_mm2", "height_max_sigma_mm", "height_mean_sigma_mm")
    return {
        "middle_mm": move_points(grid.T_scan_map, middle)[0],
        **{name: getattr(piece, name) for pair in zip(names, spread, strict=True) for name in pair},
        "hidden_mm2": piece.hidden_mm2,
        "unshown_mm2": piece.unshown_mm2,
        "asked_mm": piece.asked_mm,
        "datum_mm": float(piece.datum.heights_mm.mean()),
        "datum_sigma_mm": float(np.sqrt(piece.datum.variances_mm2.mean())),
        "node_spacing_mm": grid.spacing_mm,
        "node_sigma_mm": piece.datum.noise.sigma_mm,
    }


def plan_facts(plan: Any) -> dict[str, Any] | None:
    """What report.json says of a plan."""
    if plan is None:
        return None
    import numpy as np

    left = np.nan_to_num(plan.remaining_mm)[plan.work.inside]
    return {
        "leave_mm": plan.leave_mm,
        "offset_mm": plan.work.offset_mm,
        "offset_sigma_mm": plan.work.offset_sigma_mm,
        "contact_s": plan.seconds,
        "planned_remaining_mm": {"max": float(left.max()), "mean": float(left.mean())},
        "unreached_mm2": float(plan.work.heights.areas_mm2[plan.unreached].sum()),
        "passes": [
            {
                "pass": one.number,
                "floor_mm": one.floor_mm,
                "lines": len(one.strokes),
                "feed_mm_s": one.feed_mm_s,
                "force_n": one.force_n,
                "removed_mm3": one.removed_mm3,
            }
            for one in plan.passes
        ],
    }
