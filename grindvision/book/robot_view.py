"""An arm in a PyVista scene: its bodies where the joint angles put them, and a run along a seam as an animation."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from grindvision.book.places import figures_folder
from grindvision.errors import InputError
from grindvision.files import write_whole
from grindvision.motion import Robot

if TYPE_CHECKING:
    import pyvista

Floats = NDArray[np.float64]


class RobotView:
    """The surfaces of a robot's bodies, ready to be placed: the maker's meshes where there are some, else capsules."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.surfaces = [_surface(body) for body in robot.bodies.geometryObjects]

    def placed(self, q_rad: ArrayLike) -> list[tuple[str, pyvista.PolyData]]:
        """Name and surface (mm, base frame) of every body at joint angles (n,)."""
        model, bodies = self.robot.model, self.robot.bodies
        data, bodies_data = model.createData(), bodies.createData()
        pin.updateGeometryPlacements(model, data, bodies, bodies_data, np.asarray(q_rad, dtype=float))
        return [
            (body.name, surface.transform(place.homogeneous, inplace=False))
            for body, surface, place in zip(bodies.geometryObjects, self.surfaces, bodies_data.oMg, strict=True)
        ]

    def add_to(self, plotter: pyvista.Plotter, q_rad: ArrayLike, colour: str, tool_colour: str, **look: Any) -> None:
        """Draw the robot at joint angles (n,); the tool in its own colour."""
        for name, surface in self.placed(q_rad):
            held = name.startswith(self.robot.tool.name)
            plotter.add_mesh(surface, color=tool_colour if held else colour, name=name, **look)


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
        scale_mm = 1000.0 * np.asarray(body.meshScale)
        return pyvista.read(body.meshPath).scale(scale_mm, inplace=False)
    if isinstance(body.geometry, coal.Capsule):
        length, radius = 2 * body.geometry.halfLength, body.geometry.radius
        return pyvista.Capsule(
            center=(0, 0, 0), direction=(0, 0, 1), radius=radius, cylinder_length=length, resolution=24
        )
    raise InputError(f"body {body.name} is neither a mesh nor a capsule; there is no way to draw it")
