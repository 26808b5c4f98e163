"""Draws arms, scanners, frames and path points into a PyVista plotter; everything in the base frame, mm."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.arm import MdhArm, joint_transforms
from grindvision.geometry import move_points

if TYPE_CHECKING:
    import pyvista

Floats = NDArray[np.float64]

#: Colours of the x, y and z axis of every drawn frame (vermilion, green, blue: safe for colour-blind readers).
AXIS_COLOURS = ("#D55E00", "#009E73", "#0072B2")

_METAL = "#c3c9cf"
_JOINT = "#7d858d"
_SCANNER = "#4d5358"
_BRACKET = "#8c8c8c"
_PART = "#d8cdb8"


def draw_arm(plotter: pyvista.Plotter, arm: MdhArm, q_rad: ArrayLike, thickness_mm: float = 26.0) -> Floats:
    """Draw an arm at joint angles (n,): links as tubes along a and d of the MDH table, joints as drums on their axes.

    Returns:
        T_base_i of the base and every joint frame, (n + 1, 4, 4).
    """
    import pyvista as pv

    frames = joint_transforms(arm, q_rad)
    foot = pv.Cylinder(center=(0, 0, 15), direction=(0, 0, 1), radius=3 * thickness_mm, height=30)
    plotter.add_mesh(foot, color=_JOINT, smooth_shading=True, split_sharp_edges=True)
    for row, before, after in zip(arm.table, frames[:-1], frames[1:], strict=True):
        elbow = before[:3, 3] + row[1] * before[:3, 0]
        for start, end in ((before[:3, 3], elbow), (elbow, after[:3, 3])):
            if np.linalg.norm(end - start) > 1.0:
                tube = pv.Line(start, end).tube(radius=thickness_mm, n_sides=40)
                plotter.add_mesh(tube, color=_METAL, smooth_shading=True)
                plotter.add_mesh(pv.Sphere(radius=thickness_mm, center=end), color=_METAL, smooth_shading=True)
        drum = pv.Cylinder(
            center=after[:3, 3], direction=after[:3, 2], radius=1.45 * thickness_mm, height=3.4 * thickness_mm
        )
        plotter.add_mesh(drum, color=_JOINT, smooth_shading=True, split_sharp_edges=True)
    return frames


def draw_scanner(
    plotter: pyvista.Plotter,
    T_base_scanner: ArrayLike,
    distance_mm: float = 400.0,
    field_mm: tuple[float, float] = (210.0, 150.0),
    colour: str = "#56B4E9",
) -> None:
    """Draw a scanner's housing and, along its z axis, its field of view (width, height) at a distance."""
    import pyvista as pv

    pose = np.asarray(T_base_scanner, dtype=float)
    housing = pv.Box((-75, 75, -28, 28, -50, 0)).transform(pose, inplace=False)
    plotter.add_mesh(housing, color=_SCANNER)
    x, y = field_mm[0] / 2, field_mm[1] / 2
    corners = np.array([[-x, -y, distance_mm], [x, -y, distance_mm], [x, y, distance_mm], [-x, y, distance_mm]])
    points = move_points(pose, np.vstack([[0, 0, 0], corners]))
    sides = np.hstack([[3, 0, i, i % 4 + 1] for i in range(1, 5)])
    plotter.add_mesh(pv.PolyData(points, sides), color=colour, opacity=0.14)
    for i in range(1, 5):
        plotter.add_mesh(pv.Line(points[0], points[i]), color=colour, line_width=1.5, opacity=0.7)
        plotter.add_mesh(pv.Line(points[i], points[i % 4 + 1]), color=colour, line_width=3)


def draw_bracket(plotter: pyvista.Plotter, T_base_joint: ArrayLike, T_base_scanner: ArrayLike) -> None:
    """Draw what carries a scanner on a joint, a straight bar: sketched, as no paper gives its shape."""
    import pyvista as pv

    ends = np.asarray(T_base_joint, dtype=float)[:3, 3], move_points(T_base_scanner, [0.0, 0.0, -25.0])
    plotter.add_mesh(pv.Line(*ends).tube(radius=13, n_sides=24), color=_BRACKET, smooth_shading=True)


def draw_part(
    plotter: pyvista.Plotter,
    surface_mm: ArrayLike,
    outwards: ArrayLike,
    size_mm: tuple[float, float] = (190.0, 130.0),
    thickness_mm: float = 25.0,
) -> None:
    """Draw a plate as a workpiece, sketched: a point (3,) of its surface, and the normal (3,) that leaves it there."""
    import pyvista as pv

    normal = np.asarray(outwards, dtype=float) / np.linalg.norm(outwards)
    top = pv.Plane(center=surface_mm, direction=normal, i_size=size_mm[0], j_size=size_mm[1])
    plotter.add_mesh(top.extrude(-thickness_mm * normal, capping=True), color=_PART, opacity=0.35)


def draw_tracker(plotter: pyvista.Plotter, T_base_tracker: ArrayLike) -> None:
    """Draw a laser tracker whose measuring head is at the origin of its frame, on a stand 330 mm high."""
    import pyvista as pv

    pose = np.asarray(T_base_tracker, dtype=float)
    stand = pv.Cylinder(center=(0, 0, -195), direction=(0, 0, 1), radius=48, height=270)
    head = pv.Box((-45, 45, -45, 45, -60, 50))
    for part, colour in ((stand, _METAL), (head, _SCANNER)):
        moved = part.transform(pose, inplace=False)
        plotter.add_mesh(moved, color=colour, smooth_shading=True, split_sharp_edges=True)


def draw_sight(plotter: pyvista.Plotter, start_mm: ArrayLike, end_mm: ArrayLike, colour: str, dashes: int = 24) -> None:
    """Draw a dashed line between two points (3,)."""
    import pyvista as pv

    start, end = np.asarray(start_mm, dtype=float), np.asarray(end_mm, dtype=float)
    stops = start + np.linspace(0, 1, 2 * dashes)[:, None] * (end - start)
    plotter.add_mesh(pv.line_segments_from_points(stops), color=colour, line_width=4, lighting=False)
    plotter.add_mesh(pv.Sphere(radius=9, center=end), color=colour)


def draw_frame(
    plotter: pyvista.Plotter,
    T_base_frame: ArrayLike,
    name: str = "",
    length_mm: float = 110.0,
    label_mm: Sequence[float] = (0.0, 0.0, 0.0),
    font_size: int = 26,
) -> None:
    """Draw a frame's three axes as arrows and its name, ``label_mm`` away from the origin in the base frame."""
    import pyvista as pv

    pose = np.asarray(T_base_frame, dtype=float)
    for axis, colour in zip(pose[:3, :3].T, AXIS_COLOURS, strict=True):
        arrow = pv.Arrow(
            start=pose[:3, 3],
            direction=axis,
            scale=length_mm,
            shaft_radius=0.035,
            tip_radius=0.09,
            tip_length=0.25,
            shaft_resolution=24,
        )
        plotter.add_mesh(arrow, color=colour, smooth_shading=True, split_sharp_edges=True)
    plotter.add_mesh(pv.Sphere(radius=0.06 * length_mm, center=pose[:3, 3]), color="black")
    if name:
        draw_label(plotter, pose[:3, 3] + np.asarray(label_mm, dtype=float), name, font_size)


def draw_label(
    plotter: pyvista.Plotter, at_mm: ArrayLike, text: str, font_size: int = 26, colour: str = "black"
) -> None:
    """Write ``text`` at a point (3,), in front of everything."""
    plotter.add_point_labels(
        np.asarray(at_mm, dtype=float)[None],
        [text],
        font_size=font_size,
        text_color=colour,
        show_points=False,
        always_visible=True,
        shape=None,
        justification_horizontal="center",
        justification_vertical="center",
    )


def draw_path(
    plotter: pyvista.Plotter,
    points_mm: ArrayLike,
    directions: ArrayLike,
    colour: str,
    length_mm: float = 12.0,
    radius_mm: float = 0.9,
    path_colour: str = "black",
) -> None:
    """Draw path points (N, 3) as beads on a line, and a direction (N, 3) as an arrow at each."""
    import pyvista as pv

    points = np.asarray(points_mm, dtype=float)
    plotter.add_mesh(pv.lines_from_points(points).tube(radius=0.45 * radius_mm), color=path_colour)
    for point, direction in zip(points, np.asarray(directions, dtype=float), strict=True):
        plotter.add_mesh(pv.Sphere(radius=radius_mm, center=point), color=path_colour, smooth_shading=True)
        arrow = pv.Arrow(
            start=point, direction=direction, scale=length_mm, shaft_radius=0.03, tip_radius=0.08, tip_length=0.22
        )
        plotter.add_mesh(arrow, color=colour, smooth_shading=True, split_sharp_edges=True)


def look(
    plotter: pyvista.Plotter,
    centre_mm: ArrayLike,
    direction: ArrayLike,
    height_mm: float,
    up: Sequence[float] = (0.0, 0.0, 1.0),
) -> None:
    """Set a parallel view on a point (3,) from a direction (3,), ``height_mm`` of the scene from bottom to top."""
    centre, away = np.asarray(centre_mm, dtype=float), np.asarray(direction, dtype=float)
    eye = centre + 4 * height_mm * away / np.linalg.norm(away)
    plotter.camera_position = [tuple(eye), tuple(centre), tuple(up)]
    plotter.camera.parallel_projection = True
    plotter.camera.parallel_scale = height_mm / 2
    plotter.reset_camera_clipping_range()
