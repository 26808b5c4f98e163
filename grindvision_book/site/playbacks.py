"""Pipelines to scrub through: clouds, poses and numbers of every step in one HTML file that brings its own player.

The player is ``player/player.js`` on three.js; ``npm install && npm run build`` in that folder bundles both into
``player.bundle.js``, which is committed, so that building the site needs no network.
"""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.files import write_whole

if TYPE_CHECKING:
    import pyvista

Floats = NDArray[np.float64]

PLAYER = Path(__file__).with_name("player")
#: How far the player's camera opens, upwards.
VIEW_ANGLE_DEG = 30.0
_LIGHT = np.array([0.3, -0.5, 0.81])


@dataclass(frozen=True)
class Dots:
    """A cloud: ``points`` (N, 3) in mm, ``colours`` (N, 3) from 0 to 1, its name's ``colour``, whether it ``moves``."""

    name: str
    points: Floats
    colours: Floats
    colour: str
    moves: bool = False


@dataclass(frozen=True)
class Rods:
    """Round rods (M, 7): both ends in mm and the radius, of one ``colour`` or of one each (``colours``)."""

    name: str
    rods: Floats
    colour: str
    moves: bool = False
    colours: tuple[str, ...] | None = None


@dataclass(frozen=True)
class Step:
    """One step: what is told, the number that belongs to it, the layers shown, the view, and where moving layers are.

    ``pose`` (4, 4) brings what moves into the scene's frame.
    """

    title: str
    text: str
    number: str
    layers: tuple[str, ...]
    view: str
    pose: Floats = field(default_factory=lambda: np.eye(4))


@dataclass(frozen=True)
class View:
    """A camera: where it stands, what it looks at, and which way is up; mm."""

    eye: Sequence[float]
    centre: Sequence[float]
    up: Sequence[float]


@dataclass(frozen=True)
class Pipeline:
    """What a playback shows."""

    layers: tuple[Dots | Rods, ...]
    steps: tuple[Step, ...]
    views: dict[str, View]


@dataclass(frozen=True)
class Playback:
    """A pipeline as a page: file ``name``, ``title``, ``caption``, the ``figures`` it belongs to, and what ``plays``.

    ``plays`` gets the largest number of points of one cloud.
    """

    name: str
    title: str
    caption: str
    figures: tuple[str, ...]
    plays: Callable[[int], Pipeline]
    invitation: ClassVar[str] = "Play it step by step"

    def write(self, folder: Path, most_points: int = 20_000) -> Path:
        """Write ``name.html`` and the picture ``name.png`` of its last step but one into a folder; return the first.

        Raises:
            FileError: the folder cannot be written to.
        """
        pipeline = self.plays(most_points)
        page = (PLAYER / "player.html").read_text(encoding="utf-8")
        for word, content in (
            ("title", html.escape(self.title)),
            ("data", json.dumps(_packed(pipeline, self.caption), separators=(",", ":")).replace("<", "\\u003c")),
            ("player", (PLAYER / "player.bundle.js").read_text(encoding="utf-8")),
        ):
            page = page.replace("{{" + word + "}}", content)
        _draw_picture(pipeline, folder / f"{self.name}.png")
        target = folder / f"{self.name}.html"
        with write_whole(target) as path:
            path.write_text(page, encoding="utf-8")
        return target


def shaded(colour: str, normals: Floats) -> Floats:
    """Colours (N, 3) of a matt surface in the light from above, by its normals; either side of it is lit."""
    from matplotlib.colors import to_rgb

    brightness = 0.25 + 0.75 * np.abs(normals @ (_LIGHT / np.linalg.norm(_LIGHT)))
    return np.clip(brightness[:, None] * np.array(to_rgb(colour)), 0.0, 1.0)


def arrows(points: Floats, directions: Floats, length_mm: float, radius_mm: float) -> Floats:
    """Rods (2 M, 7) that stand on points along unit directions, thick at the foot."""
    foot = np.hstack([points, points + 0.12 * length_mm * directions, np.full((len(points), 1), 2.4 * radius_mm)])
    shaft = np.hstack([points, points + length_mm * directions, np.full((len(points), 1), radius_mm)])
    return np.vstack([foot, shaft])


def chain(points: ArrayLike, radius_mm: float) -> Floats:
    """Rods from each of the points (N, 3) to the next."""
    line = np.asarray(points, dtype=float)
    return np.hstack([line[:-1], line[1:], np.full((len(line) - 1, 1), radius_mm)])


def white_plotter(width_px: int, height_px: int) -> pyvista.Plotter:
    """An empty picture off screen; VTK keeps to itself that there is no X server."""
    import pyvista as pv
    from vtkmodules.vtkCommonCore import vtkLogger

    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_ERROR)
    plotter = pv.Plotter(off_screen=True, window_size=[width_px, height_px])
    plotter.background_color = "white"
    return plotter


def dot_size_mm(points: Floats) -> float:
    """How wide dots must be so that a surface of points (N, 3) closes: as far as the fourth neighbour.

    On a square lattice that is the side of a square.
    """
    from scipy.spatial import cKDTree

    few = points[:: max(len(points) // 2000, 1)]
    return float(np.median(cKDTree(points).query(few, min(5, len(points)))[0][:, -1]))


def _packed(pipeline: Pipeline, caption: str) -> dict[str, Any]:
    names = [layer.name for layer in pipeline.layers]
    return {
        "caption": caption,
        "layers": [_packed_layer(layer) for layer in pipeline.layers],
        "views": {name: {"eye": v.eye, "centre": v.centre, "up": v.up} for name, v in pipeline.views.items()},
        "steps": [
            {
                "title": step.title,
                "text": step.text,
                "number": step.number,
                "layers": [names.index(name) for name in step.layers],
                "view": step.view,
                "pose": np.asarray(step.pose, dtype=float).round(9).ravel().tolist(),
            }
            for step in pipeline.steps
        ],
    }


def _packed_layer(layer: Dots | Rods) -> dict[str, Any]:
    head = {"name": layer.name, "colour": layer.colour, "moves": layer.moves}
    if isinstance(layer, Rods):
        return {**head, "kind": "rods", "rods": layer.rods.round(3).tolist(), "colours": layer.colours}
    centre = (layer.points.min(axis=0) + layer.points.max(axis=0)) / 2
    unit_mm = max(float(np.abs(layer.points - centre).max()) / 32_000, 1e-6)
    positions = np.round((layer.points - centre) / unit_mm).astype("<i2")
    colours = np.round(255 * layer.colours).astype(np.uint8)
    return {
        **head,
        "kind": "points",
        # three.js draws a dot as large as a camera that opens by 90 degrees would see it
        "size_mm": round(dot_size_mm(layer.points) / np.tan(np.radians(VIEW_ANGLE_DEG / 2)), 3),
        "unit_mm": unit_mm,
        "centre_mm": centre.tolist(),
        "positions": base64.b64encode(positions.tobytes()).decode(),
        "colours": base64.b64encode(colours.tobytes()).decode(),
    }


def _draw_picture(pipeline: Pipeline, target: Path) -> None:
    """The step before the last as a picture, for readers without scripts."""
    from PIL import Image

    step = pipeline.steps[-2]
    plotter = white_plotter(900, 525)
    for layer in pipeline.layers:
        if layer.name in step.layers:
            _draw_layer(plotter, layer, step.pose if layer.moves else np.eye(4))
    view = pipeline.views[step.view]
    plotter.camera.view_angle = VIEW_ANGLE_DEG
    plotter.camera_position = [tuple(view.eye), tuple(view.centre), tuple(view.up)]
    plotter.reset_camera_clipping_range()
    picture = Image.fromarray(plotter.screenshot(return_img=True)).quantize(64, dither=Image.Dither.NONE)
    plotter.close()
    with write_whole(target) as path:
        picture.save(path, format="PNG", optimize=True)


def _draw_layer(plotter: pyvista.Plotter, layer: Dots | Rods, pose: Floats) -> None:
    import pyvista as pv

    if isinstance(layer, Dots):
        cloud = pv.PolyData(layer.points.astype(np.float32)).transform(pose, inplace=False)
        plotter.add_mesh(cloud, scalars=layer.colours, rgb=True, style="points", point_size=3, lighting=False)
        return
    for rod, colour in zip(layer.rods, layer.colours or [layer.colour] * len(layer.rods), strict=True):
        tube = pv.Line(rod[:3], rod[3:6]).tube(radius=rod[6], n_sides=20).transform(pose, inplace=False)
        plotter.add_mesh(tube, color=colour, smooth_shading=True)
