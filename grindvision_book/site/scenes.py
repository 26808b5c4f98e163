"""3D scenes that a reader can turn in the page: each one HTML file with its viewer inside, and a picture of it."""

from __future__ import annotations

import html
import io
import json
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision import arm as arms
from grindvision import cell, geometry, paper
from grindvision.files import write_whole
from grindvision.vision import TraceWeldOptions, detect, trace_weld
from grindvision_book.machinery import frames
from grindvision_book.machinery.session import COLOURS
from grindvision_book.site.pictures import Figure
from grindvision_book.site.pipelines import PLAYBACKS, laid_flat
from grindvision_book.site.playbacks import Playback, white_plotter

if TYPE_CHECKING:
    import pyvista

Floats = NDArray[np.float64]
Scalar = TypeVar("Scalar", bound=np.generic)

SEED = 5


@dataclass(frozen=True)
class Scene:
    """A scene: file ``name``, ``title``, ``caption``, the ``figures`` of the book it belongs to, and who ``draws`` it.

    ``draws`` gets an empty plotter and the largest number of points of one cloud.
    """

    name: str
    title: str
    caption: str
    figures: tuple[str, ...]
    draws: Callable[[pyvista.Plotter, int], None]
    invitation: ClassVar[str] = "Turn it in 3D"

    def write(self, folder: Path, most_points: int = 6000) -> Path:
        """Write ``name.html`` and the picture ``name.png`` into a folder, and return the first.

        The viewer's own address of an icon on the web is taken out: the page loads nothing from elsewhere.

        Raises:
            FileError: the folder cannot be written to.
        """
        plotter = white_plotter(1200, 700)
        self.draws(plotter, most_points)
        with write_whole(folder / f"{self.name}.png") as path:
            plotter.screenshot(path)
        page = _viewer_page(plotter)
        plotter.close()
        page = page.replace("https://kitware.github.io/vtk-js/icon/favicon-${t}x${t}.png", "data:,")
        page = page.replace("<title>VTK.js | Example - OfflineLocalView</title>", f"<title>{self.title}</title>")
        target = folder / f"{self.name}.html"
        with write_whole(target) as path:
            path.write_text(page, encoding="utf-8")
        return target


def scene_link(scene: Scene | Playback, root: str) -> str:
    """HTML that opens a scene in place (a script of the book does it) or, without scripts, in a page of its own.

    ``root`` leads from the page to the first folder of the site.
    """
    title = html.escape(scene.title)
    address, kind = f"{root}scenes/{scene.name}.html", type(scene).__name__.lower()
    return (
        f'<p><a class="scene" href="{address}" data-title="{title}" data-kind="{kind}">'
        f"{scene.invitation}: {title}</a></p>\n"
    )


def scene_markdown(scene: Scene | Playback, root: str) -> str:
    """The picture of a scene with its caption, and the link that opens it."""
    picture = f"```{{figure}} {root}scenes/{scene.name}.png\n:alt: {scene.caption}\n\n{scene.caption}\n```\n"
    return f"{picture}\n{scene_link(scene, root)}"


def scenes_page(scenes: Sequence[Scene | Playback], chapters: Mapping[str, str], figures: Mapping[str, Figure]) -> str:
    """Markdown of the page with all scenes, each under its picture; ``chapters``: two digits -> Markdown link."""
    parts = [
        "# In 3D\n",
        "Each picture below becomes a scene to turn (drag), shift (drag with Shift) and zoom (wheel) when it is asked "
        "for; the first two play the papers' pipelines step by step. A scene weighs about 2 MB and "
        "brings its own viewer, so it works without a network. Without scripts the picture stays.\n",
    ]
    for scene in scenes:
        shown_in = sorted({figures[name].chapter for name in scene.figures if name in figures} & set(chapters))
        parts += [
            f"## {scene.title}\n",
            scene_markdown(scene, ""),
            "Shown in " + ", ".join(chapters[number] for number in shown_in) + ".\n" if shown_in else "",
        ]
    return "\n".join(parts)


def draw_registration(plotter: pyvista.Plotter, most_points: int) -> None:
    """Before, after, and what differs: the two scans of experiment 4's twin, side by side."""
    twin = cell.experiment4_twin(np.random.default_rng(SEED), every=3)
    sample, test = twin.scene.sample.points, twin.scene.test.points
    found = detect(sample, test)
    T_sample_test = found.T_sample_test
    moved = geometry.move_points(T_sample_test, test)
    level = laid_flat(sample)
    width = np.ptp(geometry.move_points(level, sample)[:, 0]) + 60.0

    def place(points: ArrayLike, column: int) -> Floats:
        return geometry.move_points(level, points) + [column * width, 0.0, 0.0]

    for column, scan in enumerate((test, moved)):
        _dots(plotter, place(_some(sample, most_points), column), COLOURS["sample"])
        _dots(plotter, place(_some(scan, most_points), column), COLOURS["test"])
    compared = np.flatnonzero(np.isfinite(found.difference.signed_mm))
    shown = _some(compared, 2 * most_points)
    surfels = geometry.move_points(T_sample_test, found.difference.surfels[shown])
    _dots(plotter, place(surfels, 2), found.difference.signed_mm[shown])
    path = geometry.move_points(T_sample_test, found.path_points)
    normals = geometry.rotate_vectors(level @ T_sample_test, found.path_normals)
    frames.draw_path(plotter, place(path, 2), normals, COLOURS["ours"], length_mm=18, radius_mm=1.4)
    below = geometry.move_points(level, sample)[:, 1].min() - 22.0
    for column, title in enumerate(("as scanned", "registered", "difference and path")):
        _text(plotter, title, [column * width, below, 0.0], 15.0, np.eye(3))
    _look(plotter, [width, 0.0, -20.0], [0.0, -0.9, 0.8], 540.0, up=(0.0, 1.0, 0.0))


def draw_cell(plotter: pyvista.Plotter, most_points: int) -> None:
    """The arm that the printed numbers imply, its frames, the scanner with its field, and the printed path."""
    nominal = cell.nominal_arm()
    points_scanner, normals_scanner = paper.path_points(3)
    points_base = paper.path_points(4)[0]
    T_base_scanner = geometry.fit_rigid(points_scanner, points_base).T_target_source
    T_base_joint4 = T_base_scanner @ geometry.inverse(paper.hand_eye("accurate"))
    q_rad = arms.nearest_angles(nominal, T_base_joint4, np.random.default_rng(SEED), starts=25)[0].q_rad
    joints = frames.draw_arm(plotter, nominal, q_rad)
    frames.draw_bracket(plotter, joints[4], T_base_scanner)
    frames.draw_scanner(plotter, T_base_scanner)
    facing = geometry.rotate_vectors(T_base_scanner, normals_scanner * [-1, -1, 1])
    frames.draw_path(plotter, points_base, facing, COLOURS["test"], length_mm=70, radius_mm=4)
    outwards = facing.mean(axis=0) / np.linalg.norm(facing.mean(axis=0))
    frames.draw_part(plotter, points_base.mean(axis=0) - 6 * outwards, outwards)
    direction = np.array([-0.34, -0.94, 0.33])
    facing_reader = _facing(direction, [0.0, 0.0, 1.0])
    names = ["base", "joint 1", "joint 2", "joint 3", "joint 4", "scanner"]
    offsets = [(0, 0, -75), (-110, 40, -10), (90, -30, 95), (60, 0, 95), (-135, 40, 15), (60, 60, 110)]
    for T_base_frame, name, offset in zip([*joints, T_base_scanner], names, offsets, strict=True):
        frames.draw_frame(plotter, T_base_frame, length_mm=150 if name == "base" else 110)
        _text(plotter, name, T_base_frame[:3, 3] + offset, 30.0, facing_reader)
    _text(plotter, "path, Table 4", points_base.mean(axis=0) + [30, 30, -70], 30.0, facing_reader)
    _look(plotter, (270.0, -280.0, 170.0), direction, 1000.0)


def draw_welds(plotter: pyvista.Plotter, most_points: int) -> None:
    """The four weld pieces as the camera sees them: groove found, way points with the direction of approach."""
    for number, kind in enumerate(cell.KINDS):
        scene = cell.weld_scene(kind, np.random.default_rng([SEED, number]), every=3)
        weld = trace_weld(scene.points, TraceWeldOptions(waypoints=16))
        middle = scene.points.mean(axis=0)
        turn = np.diag([1.0, -1.0, -1.0])  # the camera looks down: x right, y up, z towards the reader
        shift = np.array([(number % 2) * 330.0, -(number // 2) * 260.0, 0.0])

        def place(points: ArrayLike, middle: Floats = middle, shift: Floats = shift, turn: Floats = turn) -> Floats:
            return (np.asarray(points) - middle) @ turn.T + shift

        _dots(plotter, place(_some(scene.points[~weld.labels], most_points)), "#b8bec4")
        _dots(plotter, place(_some(scene.points[weld.labels], most_points // 3)), COLOURS["paper_variant"])
        normals = weld.path.normals @ turn.T
        frames.draw_path(plotter, place(weld.path.points), normals, COLOURS["ours"], length_mm=22, radius_mm=1.6)
        _text(plotter, kind, shift + [0.0, -118.0, 0.0], 17.0, np.eye(3))
    _look(plotter, (165.0, -140.0, 0.0), (0.0, -0.7, 1.0), 480.0, up=(0.0, 1.0, 0.0))


SCENES: tuple[Scene | Playback, ...] = (
    *PLAYBACKS,
    Scene(
        "registration",
        "Two scans, registered, and their difference",
        "Left: the good part (blue) and the test part (vermilion) as scanned. Middle: after registration. Right: the "
        "test part coloured by its signed difference, and the path points with their normals. Sample scanner's frame "
        f"laid flat, mm; synthetic twin of experiment 4, seed {SEED}.",
        ("fig07", "difference_map"),
        draw_registration,
    ),
    Scene(
        "cell",
        "The arm, its frames, and the path",
        "The arm at the joint angles that the print implies, the frames of base, joints and scanner (x vermilion, y "
        "green, z blue), the scanner's field, and the path of Table 4 with its mended normals; bracket and part are "
        "sketched. Base frame, mm; printed numbers.",
        ("conventions_frames", "table4_scene"),
        draw_cell,
    ),
    Scene(
        "welds",
        "Four weld pieces with groove and way points",
        "The four pieces: what the camera sees (grey), the groove found (orange), and way points on its root with the "
        f"direction of approach (blue). Camera frame turned towards the reader, mm; synthetic, seed {SEED}.",
        ("peng_fig12", "peng_fig16", "peng_fig13", "peng_fig17"),
        draw_welds,
    ),
)

#: What the front page shows.
FIRST_SCENE = PLAYBACKS[0]


def _viewer_page(plotter: pyvista.Plotter) -> str:
    """What ``plotter.trame.export_html`` writes, without the web server that it starts for it."""
    from trame_vtk.modules.vtk import serializers
    from trame_vtk.tools.vtksz2html import write_html

    window, camera = plotter.render_window, plotter.camera
    serializers.initialize_serializers()
    context = serializers.SynchronizationContext()
    context.set_ignore_last_dependencies(True)
    content = serializers.serialize(None, window, serializers.reference_id(window), context, 1)
    content["extra"] = {
        "vtkRefId": serializers.reference_id(window),
        "centerOfRotation": camera.GetFocalPoint(),
        "camera": serializers.reference_id(camera),
    }
    arrays = {
        entry["hash"]: {**entry, "content": context.get_cached_data_array(entry["hash"], False)}
        for entry in serializers.extract_array_hash(content)
    }
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("index.json", json.dumps({"hashes": arrays, "scene": content}))
    page = io.StringIO()
    write_html(packed.getvalue(), page)
    return page.getvalue()


def _dots(plotter: pyvista.Plotter, points: Floats, colour: str | Floats) -> None:
    import pyvista as pv

    cloud = pv.PolyData(np.asarray(points, dtype=np.float32))
    if isinstance(colour, str):
        plotter.add_mesh(cloud, color=colour, style="points", point_size=3, lighting=False)
        return
    cloud["difference, mm"] = colour.astype(np.float32)
    plotter.add_mesh(
        cloud, style="points", point_size=3, lighting=False, cmap="cividis", clim=(-0.3, 1.5), show_scalar_bar=False
    )


def _some(rows: NDArray[Scalar], most: int) -> NDArray[Scalar]:
    return rows[np.sort(np.random.default_rng(SEED).permutation(len(rows))[:most])]


def _text(plotter: pyvista.Plotter, words: str, centre_mm: ArrayLike, height_mm: float, turn: Floats) -> None:
    """Flat letters, as the viewer in the page has no labels; ``turn`` (3, 3) holds right, up and out as columns."""
    import pyvista as pv

    letters = pv.Text3D(words, depth=0.02).scale(height_mm, inplace=False)
    letters = letters.translate(-np.array(letters.center), inplace=False)
    plotter.add_mesh(letters.transform(geometry.rigid(turn, centre_mm), inplace=False), color="black", lighting=False)


def _look(
    plotter: pyvista.Plotter,
    centre_mm: Sequence[float],
    direction: ArrayLike,
    height_mm: float,
    up: Sequence[float] = (0.0, 0.0, 1.0),
) -> None:
    """Set a view in perspective (the viewer in the page knows no other), ``height_mm`` high at the point looked at."""
    away = np.asarray(direction, dtype=float) / np.linalg.norm(direction)
    plotter.camera.view_angle = 30.0
    eye = np.asarray(centre_mm) + 0.5 * height_mm / np.tan(np.radians(15.0)) * away
    plotter.camera_position = [tuple(eye), tuple(centre_mm), tuple(up)]
    plotter.reset_camera_clipping_range()


def _facing(direction: ArrayLike, up: ArrayLike) -> Floats:
    out = np.asarray(direction, dtype=float) / np.linalg.norm(direction)
    right = np.cross(np.asarray(up, dtype=float), out)
    right /= np.linalg.norm(right)
    return np.column_stack([right, np.cross(out, right), out])
