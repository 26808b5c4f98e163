"""The UR3 in front of the four weld pieces: where they stand, how it looks, what a programme says back."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from grindvision.cell import WeldPiece
from grindvision.cell.places import T_base_piece
from grindvision.geometry import angle_between, inverse, rigid
from grindvision.motion import Motion, urscript
from grindvision_book.chapter_11.robot_view import RobotView
from grindvision_book.machinery.session import COLOURS

if TYPE_CHECKING:
    import pyvista

Floats = NDArray[np.float64]


def programme_errors(motion: Motion) -> tuple[float, float]:
    """Largest distance in mm and angle in deg between the trajectory and the poses its URScript says, read back."""
    poses = [
        _pose_mm([float(number) for number in match.split(",")])
        for match in re.findall(r"move[lp]\(p\[([^\]]*)\]", urscript(motion))
    ][:-1]
    wanted = motion.trajectory.T_base_tool_worked
    said = inverse(motion.robot.T_controller_base) @ np.stack(poses)
    off_mm = np.linalg.norm(said[:, :3, 3] - wanted[:, :3, 3], axis=1).max()
    return float(off_mm), float(np.degrees(max(map(angle_between, said, wanted))))


def welding_view(plotter: pyvista.Plotter, motion: Motion, piece: WeldPiece) -> RobotView:
    """Draw table, piece, way points and robot in the base frame; the view's ``move`` sets the arm's joints."""
    import pyvista

    solid = piece.solid.moved(T_base_piece(piece.kind))
    faces = np.column_stack([np.full(len(solid.triangles), 3), solid.triangles])
    table = pyvista.Plane(center=(200, 0, -0.5), i_size=760, j_size=640)
    plotter.add_mesh(table, color="#f2f2f2", lighting=False)
    plotter.add_mesh(pyvista.PolyData(solid.vertices_mm, faces.ravel()), color=COLOURS["sample"])
    seam = motion.trajectory.T_base_tool_worked[:, :3, 3]
    plotter.add_mesh(pyvista.MultipleLines(seam), color=COLOURS["ours"], line_width=5)
    plotter.camera_position = [(1020, -820, 620), (170, 0, 130), (0, 0, 1)]
    plotter.camera.view_angle = 30
    return RobotView(motion.robot, plotter, "#cccccc", COLOURS["test"])


def add_strip(plotter: pyvista.Plotter, row: int, motion: Motion, piece: WeldPiece, shares: Sequence[float]) -> None:
    """Fill one row of a plotter's grid: the arm after each of ``shares`` (0..1) of the seam, in working order."""
    for column, share in enumerate(shares):
        plotter.subplot(row, column)
        welding_view(plotter, motion, piece).move(angles_after(motion, share))


def angles_after(motion: Motion, share: float) -> Floats:
    """Joint angles (n,) when the tool has worked a share (0..1) of the seam's length."""
    along = motion.timing.arc_mm
    return motion.timing.q_rad[int(np.argmin(np.abs(along - share * along[-1])))]


def _pose_mm(numbers: list[float]) -> Floats:
    return rigid(Rotation.from_rotvec(numbers[3:]).as_matrix(), 1000.0 * np.array(numbers[:3]))
