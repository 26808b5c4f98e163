"""An arm in a PyVista scene: its bodies where the joint angles put them, and a run along a seam as an animation."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import InputError
from grindvision.files import write_whole
from grindvision.geometry import inverse
from grindvision.motion import Robot
from grindvision_book.machinery.places import figures_folder

if TYPE_CHECKING:
    import pyvista

Floats = NDArray[np.float64]


class RobotView:
    """A robot drawn in a plotter: the maker's meshes where there are some, else capsules; ``move`` sets the joints."""

    def __init__(self, robot: Robot, plotter: pyvista.Plotter, colour: str, tool_colour: str) -> None:
        self.robot = robot
        self.actors = []
        for body in robot.bodies.geometryObjects:
            held = body.name.startswith(robot.tool.name)
            surface = _surface(body)
            self.actors.append(plotter.add_mesh(surface, color=tool_colour if held else colour, smooth_shading=True))
        self.wire = plotter.add_mesh(_wire(robot), color=tool_colour, line_width=4)

    def move(self, q_rad: ArrayLike) -> None:
        """Put every body where the joint angles (n,) want it."""
        q = np.asarray(q_rad, dtype=float)
        model, bodies = self.robot.model, self.robot.bodies
        data, bodies_data = model.createData(), bodies.createData()
        pin.updateGeometryPlacements(model, data, bodies, bodies_data, q)
        for actor, place in zip(self.actors, bodies_data.oMg, strict=True):
            actor.user_matrix = place.homogeneous
        self.wire.user_matrix = self.robot.forward(q)


def save_animation(
    frames: Iterable[Callable[[], None]], plotter: pyvista.Plotter, name: str, frame_s: float = 0.1
) -> None:
    """Save a looping ``name.gif`` beside the chapter's figures: before each picture one of ``frames`` moves the scene.

    Raises:
        InputError: there are no frames. FileError: the folder cannot be written to.
    """
    from PIL import Image

    pictures = []
    for move in frames:
        move()
        plotter.render()
        picture = Image.fromarray(plotter.screenshot(return_img=True)[..., :3])
        pictures.append(picture.quantize(64, dither=Image.Dither.NONE))
    plotter.close()
    if not pictures:
        raise InputError(f"animation {name}: there is nothing to show; give at least one frame")
    with write_whole(figures_folder() / f"{name}.gif") as path:
        pictures[0].save(
            path, save_all=True, append_images=pictures[1:], duration=int(1000 * frame_s), loop=0, optimize=True
        )


def _surface(body: pin.GeometryObject) -> pyvista.PolyData:
    import coal
    import pyvista

    if body.meshPath:
        return _mesh(body.meshPath, tuple(1000.0 * np.asarray(body.meshScale)))
    if isinstance(body.geometry, coal.Capsule):
        length, radius = 2 * body.geometry.halfLength, body.geometry.radius
        return pyvista.Capsule(
            center=(0, 0, 0), direction=(0, 0, 1), radius=radius, cylinder_length=length, resolution=24
        )
    raise InputError(f"body {body.name} is neither a mesh nor a capsule; there is no way to draw it")


@cache
def _mesh(path: str, scale_mm: tuple[float, float, float]) -> pyvista.PolyData:
    """A robot file's mesh in mm, its sharp edges kept sharp."""
    import pyvista

    return pyvista.read(path).scale(scale_mm, inplace=False).compute_normals(split_vertices=True)


def _wire(robot: Robot) -> pyvista.PolyData:
    """What sticks out of the tool's last capsule, in the frame of the tip."""
    import pyvista

    end = inverse(robot.tool.T_flange_tool) @ [*robot.tool.capsules[-1][1], 1.0]
    return pyvista.Line(end[:3], (0.0, 0.0, 0.0))
