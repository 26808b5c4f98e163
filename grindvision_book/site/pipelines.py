"""The two pipelines of the papers, step by step, as the player shows them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import to_hex
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from grindvision import arm as arms
from grindvision import cell, geometry, paper
from grindvision.vision import find_grooves
from grindvision.vision.change import change_detection
from grindvision.vision.change.detection import detect
from grindvision.vision.registration.plane_icp import icp_planes
from grindvision.vision.registration.scan_registration import propose, refine
from grindvision.vision.registration.verification import choose_pose
from grindvision.vision.seam.gfh_groove import find_groove_gfh
from grindvision.vision.seam.seam_path import root_path
from grindvision.vision.surface import scan
from grindvision_book.chapter_10 import even_rows
from grindvision_book.machinery.frames import AXIS_COLOURS
from grindvision_book.machinery.session import COLOURS
from grindvision_book.site.playbacks import Dots, Pipeline, Playback, Rods, Step, View, arrows, chain, shaded

Floats = NDArray[np.float64]
Scalar = TypeVar("Scalar", bound=np.generic)

SEED = 5
#: Iterations of ICP that are shown one by one; the last one comes to rest.
SHOWN_ITERATIONS = 6
ICP_POINTS = 4000
#: Heights at the ends of the colour scale.
LOW_MM, HIGH_MM = -0.3, 1.5
HIGH_SPREAD_DEG = 12.0
METAL = "#c9ced4"


@dataclass(frozen=True)
class _Grinding:
    """What the detection of the twin goes through: both scans prepared, its poses T_sample_test, and what it finds."""

    twin: cell.Experiment4Twin
    source: scan.Scan
    target: scan.Scan
    iterated: tuple[Floats, ...]
    T_sample_test: Floats
    change: change_detection.Difference
    path_points: Floats
    path_normals: Floats

    @cached_property
    def T_flat_sample(self) -> Floats:
        return laid_flat(self.twin.scene.sample.points)

    @cached_property
    def T_flat_base(self) -> Floats:
        return self.T_flat_sample @ self.T_sample_test @ geometry.inverse(self.twin.T_base_scanner)

    def off(self, T_sample_test: Floats) -> str:
        """How far a pose is from the true one, at the middle of the test scan."""
        true, middle = self.twin.scene.T_sample_test, self.twin.scene.test.points.mean(axis=0)
        shift = np.linalg.norm(geometry.move_points(T_sample_test, middle) - geometry.move_points(true, middle))
        return f"{np.degrees(geometry.angle_between(T_sample_test, true)):.3f}° and {shift:.3f} mm off the true pose"


def grinding(most_points: int) -> Pipeline:
    """Experiment 4's twin: coarse pose, ICP one iteration at a time, difference, path, and the arm's base frame."""
    run = _detected()
    layers = (*_part_layers(run, most_points), *_arm_layers(run))
    return Pipeline(layers, _grinding_steps(run, [layer.name for layer in layers]), _grinding_views(run))


def _detected() -> _Grinding:
    rng = np.random.default_rng(SEED)
    twin = cell.experiment4_twin(np.random.default_rng(SEED), every=3)
    sample, test = twin.scene.sample.points, twin.scene.test.points
    source, target = scan.prepare_pair(test, sample)
    source, poses = propose(source, target, rng)
    few = slice(None, None, max(len(source.surfels.points) // ICP_POINTS, 1))
    points, normals = source.surfels.points[few], source.surfels.normals[few]
    iterated = [poses[0]]
    for _ in range(SHOWN_ITERATIONS):
        iterated.append(icp_planes(points, normals, target.surfels, iterated[-1], iterations=1).T_target_source)
    registration = refine(source, target, choose_pose(source, target, poses, rng), rng)
    change = change_detection.find_change(source, target, registration)
    found = detect(sample, test)
    rest = registration.T_target_source
    return _Grinding(twin, source, target, tuple(iterated), rest, change, found.path_points, found.path_normals)


def _part_layers(run: _Grinding, most_points: int) -> tuple[Dots | Rods, ...]:
    blue, red = (_some(s.surfels.points, most_points) for s in (run.target, run.source))
    blue_normals, red_normals = (_some(s.surfels.normals, most_points) for s in (run.target, run.source))
    compared = _some(np.flatnonzero(np.isfinite(run.change.signed_mm)), most_points)
    heights = np.clip((run.change.signed_mm[compared] - LOW_MM) / (HIGH_MM - LOW_MM), 0, 1)
    return (
        Dots(
            "good part (sample)",
            geometry.move_points(run.T_flat_sample, blue),
            shaded(COLOURS["sample"], geometry.rotate_vectors(run.T_flat_sample, blue_normals)),
            COLOURS["sample"],
        ),
        Dots("part with the bead (test)", red, shaded(COLOURS["test"], red_normals), COLOURS["test"], moves=True),
        Dots(
            f"signed difference, {LOW_MM} to {HIGH_MM} mm",
            run.change.surfels[compared],
            colormaps["YlOrRd"](heights)[:, :3],
            to_hex(colormaps["YlOrRd"](1.0)),
            moves=True,
        ),
        Rods(
            "path points and normals",
            np.vstack([chain(run.path_points, 1.0), arrows(run.path_points, run.path_normals, 18.0, 1.0)]),
            COLOURS["ours"],
            moves=True,
        ),
    )


def _grinding_steps(run: _Grinding, names: list[str]) -> tuple[Step, ...]:
    good, bad, signed, path, *robot = names
    first = geometry.move_points(run.twin.T_base_scanner, run.path_points)[0].round(1)

    def step(title: str, text: str, number: str, shown: tuple[str, ...], T: Floats, view: str = "part") -> Step:
        return Step(title, text, number, shown, view, run.T_flat_sample @ T)

    def poses(title: str, text: str, T: Floats) -> Step:
        return step(title, text, run.off(T), (good, bad), T)

    rest = run.T_sample_test
    peak_mm = run.change.clusters[0].peak_mm
    lead = "FPFH features are matched; this is the best of the proposed poses."
    leads = "The calibrated arm carries the path from the scanner into its base frame."
    return (
        poses("two scans", "Each as its scanner saw it, in one frame.", np.eye(4)),
        poses("coarse pose", lead, run.iterated[0]),
        *(
            poses(f"ICP, iteration {k}", "Points go onto the planes of the good part.", T)
            for k, T in enumerate(run.iterated[1:], 1)
        ),
        poses("registered", "ICP at rest, with the whole scan.", rest),
        step(
            "difference",
            "Signed distance along the good part's normals: what stands out is red.",
            f"the bead stands {peak_mm:.2f} mm above the good part",
            (signed,),
            rest,
        ),
        step(
            "path",
            "Path points on the bead's ridge; a tool comes opposite to the normals.",
            f"{len(run.path_points)} points",
            (signed, path),
            rest,
        ),
        step(
            "in the robot's base frame",
            leads,
            "first point at x {:.1f}, y {:.1f}, z {:.1f} mm".format(*first),
            (signed, path, *robot),
            rest,
            "cell",
        ),
    )


def _grinding_views(run: _Grinding) -> dict[str, View]:
    part = geometry.move_points(run.T_flat_sample, run.twin.scene.sample.points).mean(axis=0)
    foot, up = run.T_flat_base[:3, 3], run.T_flat_base[:3, 2]
    middle, reach = (foot + part) / 2, np.linalg.norm(foot - part)
    side = np.cross(up, part - foot)
    eye = middle + 2.0 * reach * side / np.linalg.norm(side) + 0.5 * reach * up
    return {
        "part": View((0.0, -250.0, 300.0), (0.0, 0.0, -10.0), (0.0, 0.0, 1.0)),
        "cell": View(eye.tolist(), (middle + 0.15 * reach * up).tolist(), up.tolist()),
    }


def _arm_layers(run: _Grinding) -> tuple[Rods, ...]:
    """The arm that carries the scanner to where it scanned, its scanner, and the axes of the base frame."""
    twin, T_flat_base = run.twin, run.T_flat_base
    nominal = cell.nominal_arm()
    T_base_joint4 = twin.T_base_scanner @ geometry.inverse(paper.hand_eye("accurate"))
    q_rad = arms.nearest_angles(nominal, T_base_joint4, np.random.default_rng(SEED), starts=25)[0].q_rad
    frames = arms.joint_transforms(nominal, q_rad)
    line = [frames[0][:3, 3]]
    for row, before, after in zip(nominal.table, frames[:-1], frames[1:], strict=True):
        line += [before[:3, 3] + row[1] * before[:3, 0], after[:3, 3]]
    line = [point for i, point in enumerate(line) if i == 0 or np.linalg.norm(point - line[i - 1]) > 1.0]
    drums = [[*(frame[:3, 3] - 40 * frame[:3, 2]), *(frame[:3, 3] + 40 * frame[:3, 2]), 38.0] for frame in frames[1:]]
    eye = twin.T_base_scanner[:3, 3]
    bracket = chain([frames[-1][:3, 3], eye - 50 * twin.T_base_scanner[:3, 2]], 12.0)
    housing = [[*(eye - 60 * twin.T_base_scanner[:3, 0]), *(eye + 60 * twin.T_base_scanner[:3, 0]), 28.0]]

    def flat(rods: list[list[float]] | Floats) -> Floats:
        rows = np.asarray(rods, dtype=float)
        ends = [geometry.move_points(T_flat_base, rows[:, k : k + 3]) for k in (0, 3)]
        return np.hstack([*ends, rows[:, 6:]])

    axes = np.vstack([arrows(np.zeros((1, 3)), axis[None], 300.0, 9.0) for axis in np.eye(3)])
    return (
        Rods("arm", flat(np.vstack([chain(line, 26.0), drums])), "#aab2ba"),
        Rods("scanner", flat(np.vstack([bracket, housing])), "#4d5358"),
        Rods("base frame", flat(axes), AXIS_COLOURS[0], colours=tuple(np.repeat(AXIS_COLOURS, 2).tolist())),
    )


def welding(most_points: int) -> Pipeline:
    """The curved piece: cloud, normals, their spread, the paper's groove, ours, and the way points of the torch."""
    scene = cell.weld_scene("curve", np.random.default_rng(SEED), every=2)
    theirs, ours = find_groove_gfh(scene.points), find_grooves(scene.points)
    path = root_path(ours.grooves[0], 16)
    turn = np.diag([1.0, -1.0, -1.0])  # the camera looks down: x right, y up, z towards the reader
    middle = scene.points.mean(axis=0)
    shown = even_rows(scene.points, most_points)
    normals = theirs.normals[shown] @ turn.T
    spread_deg = theirs.features.spread_deg
    widths = colormaps["cividis"](np.clip(spread_deg[shown] / HIGH_SPREAD_DEG, 0, 1))[:, :3]
    grey = shaded(METAL, normals)

    def place(points: Floats) -> Floats:
        return (points - middle) @ turn.T

    def marked(labels: NDArray[np.bool_], colour: str) -> Floats:
        return np.where(labels[shown, None], shaded(colour, normals), grey)

    looks = (
        ("cloud", grey, METAL),
        ("normals as colours", 0.5 + 0.5 * normals, "#8080ff"),
        ("spread of the normals", widths, to_hex(colormaps["cividis"](1.0))),
        ("groove of the paper's method", marked(theirs.labels, COLOURS["paper_variant"]), COLOURS["paper_variant"]),
        ("groove found by us", marked(ours.labels, COLOURS["ours"]), COLOURS["ours"]),
    )
    points, way = place(scene.points[shown]), arrows(place(path.points), path.normals @ turn.T, 22.0, 0.7)
    layers: tuple[Dots | Rods, ...] = (
        *(Dots(name, points, colours, swatch) for name, colours, swatch in looks),
        Rods("root of the groove", chain(place(ours.grooves[0].root), 1.6), COLOURS["printed"]),
        Rods("way points, torch direction", way, COLOURS["test"]),
    )

    def overlap(labels: NDArray[np.bool_]) -> str:
        share = np.sum(labels & scene.labels) / np.sum(labels | scene.labels)
        return f"overlap with the truth {100 * share:.1f} %"

    apart_mm = cKDTree(scene.root_mm).query(path.points)[0].mean()
    numbers = (
        f"{len(scene.points):,} points",
        "",
        f"up to {np.nanmax(spread_deg):.1f}°",
        overlap(theirs.labels),
        overlap(ours.labels),
        f"{len(path.points)} points, {apart_mm:.2f} mm off the true root on average",
        "",
    )
    near = place(path.points)[len(path.points) // 2]
    views = {
        "piece": View((0.0, -260.0, 380.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
        "near": View((near + [0.0, -90.0, 70.0]).tolist(), near.tolist(), (0.0, 0.0, 1.0)),
    }
    return Pipeline(layers, _welding_steps([layer.name for layer in layers], numbers), views)


def _welding_steps(names: list[str], numbers: tuple[str, ...]) -> tuple[Step, ...]:
    cloud, colours, widths, theirs, ours, root, way = names
    told = (
        ("cloud", "What the depth camera sees of a curved weld piece.", (cloud,)),
        ("normals", "The normal of each point as a colour.", (colours,)),
        (
            "groove features",
            "How widely normals spread around a point: widely in a groove, little on a plane.",
            (widths,),
        ),
        ("the paper's groove", "Points whose histograms are those of a groove.", (theirs,)),
        ("our groove", "Both walls are fitted along the seam; the root is where they meet.", (ours, root)),
        ("way points", "Points on the root, each with the direction from which the torch comes.", (cloud, root, way)),
        ("close to the seam", "Wall, root and way points from near by.", (ours, root, way)),
    )
    return tuple(
        Step(title, text, number, shown, "near" if title == "close to the seam" else "piece")
        for (title, text, shown), number in zip(told, numbers, strict=True)
    )


def laid_flat(points: Floats) -> Floats:
    """T_flat_scanner (4, 4): the part's long side along x, its face towards +z."""
    centre = points.mean(axis=0)
    axes = np.linalg.svd(points - centre, full_matrices=False)[2]
    out = axes[2] * -np.sign(axes[2] @ centre)  # towards the scanner, which stands at the origin
    along = axes[0] * np.sign(axes[0, 0])
    turn = np.stack([along, np.cross(out, along), out])
    return geometry.rigid(turn) @ geometry.rigid(None, -centre)


def _some(rows: NDArray[Scalar], most: int) -> NDArray[Scalar]:
    return rows[:: max(len(rows) // most, 1)]


PLAYBACKS = (
    Playback(
        "pipeline_grinding",
        "From two scans to a path in the robot's frame",
        "The detection of experiment 4 step by step: play it, or move the slider. Sample scanner's frame laid flat, "
        f"mm; synthetic twin, seed {SEED}, every third pixel.",
        ("fig07", "table3_path", "table4_scene", "fig09"),
        grinding,
    ),
    Playback(
        "pipeline_welding",
        "From a cloud to the way points of a weld",
        "The groove of the curved piece, by the paper's method and ours, and the torch's way points. Camera frame "
        f"turned towards the reader, mm; synthetic, seed {SEED}, every second pixel.",
        ("peng_fig12", "peng_fig13"),
        welding,
    ),
)
