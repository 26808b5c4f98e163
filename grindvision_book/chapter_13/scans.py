"""Pairs of scans with a pose that others found, and a part with what an engineer wanted ground."""

from __future__ import annotations

import json
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import open3d as o3d
import pandas as pd
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from grindvision.clouds import finite_points, read_cloud
from grindvision.errors import FileError, GrindvisionWarning
from grindvision.geometry import angle_between, move_points, random_rotation, rigid, small_motion
from grindvision.vision.change.detection import Detection, detect
from grindvision.vision.registration.scan_registration import RegisterOptions, register

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class GroundPart:
    """The part to be ground against its model.

    ``from_model_mm`` (N,) nearest model point of every scanned point; ``shown`` and ``marked`` (N,): near a piece that
    stands out, and chosen by the engineer; ``icp_deg``: angle between our pose and where Open3D's ICP ends from there;
    ``median_mm``: least median of distances from the model that a rigid pose was found to leave. How far what was
    chosen stands out, at 16, 50 and 84 % of it: ``chosen_rigid_mm`` of the model, ``chosen_bent_mm`` of the model bent
    like the part. ``said``: the warnings of ``detect``.
    """

    found: Detection
    from_model_mm: Floats
    shown: NDArray[np.bool_]
    marked: NDArray[np.bool_]
    icp_deg: float
    median_mm: float
    chosen_rigid_mm: Floats
    chosen_bent_mm: Floats
    said: tuple[str, ...]

    @property
    def missed_percent(self) -> float:
        """Marked points that are not shown."""
        return float(100 * (~self.shown[self.marked]).mean())

    @property
    def shown_percent(self) -> float:
        """Points of the whole scan that are shown."""
        return float(100 * self.shown.mean())


def cloud(path: Path) -> Floats:
    """Points (N, 3) in mm of a file in metres."""
    return finite_points(read_cloud(path, "m"), str(path))


def published_pose(path: Path, file: str) -> Floats:
    """T_world_scan (4, 4), mm, of a scan in a ``.conf`` of the Stanford repository.

    A line reads ``bmesh file tx ty tz qx qy qz qw``, and p_world = R(q)^T p + t in metres.

    Raises:
        FileError: no line of that file.
    """
    for line in path.read_text(encoding="utf-8").splitlines():
        words = line.split()
        if words[:2] == ["bmesh", file]:
            numbers = np.array(words[2:9], dtype=float)
            return rigid(Rotation.from_quat(numbers[3:]).as_matrix().T, 1000 * numbers[:3])
    raise FileError(f"{path}: no pose of {file} in it")


def stanford_bunny(folder: Path, turns: int, seed: int) -> tuple[pd.DataFrame, float]:
    """Register both scans of the bunny, the second turned at random each time, and compare with the published poses.

    Returns:
        A row a turn: angle (deg) and distance at the middle of the second scan (mm) from the published pose; and the
        rms distance (mm) of the first turn's pose from where Open3D's ICP ends that starts in the published one.
    """
    fixed, moving = (cloud(folder / name) for name in ("bun000.ply", "bun045.ply"))
    true = np.linalg.inv(published_pose(folder / "bun.conf", "bun000.ply")) @ published_pose(
        folder / "bun.conf", "bun045.ply"
    )
    rng, rows, poses = np.random.default_rng(seed), [], []
    for turn in range(turns):
        turned = rigid(random_rotation(rng), rng.normal(0, 300, 3))
        found = register(move_points(turned, moving), fixed, RegisterOptions(seed=turn))
        poses.append(found.T_target_source @ turned)
        rows.append({"turn": turn, **away_from(poses[-1], true, moving), "overlap_percent": 100 * found.overlap})
    settled = open3d_icp(moving, fixed, true)
    gap = move_points(poses[0], moving) - move_points(settled, moving)
    return pd.DataFrame(rows), float(np.sqrt((gap**2).sum(axis=1).mean()))


def pcl_bunny(folder: Path, seed: int) -> dict[str, float]:
    """Register the small pair of PCL's tests; angle (deg) and distance (mm) from the independent pose."""
    target, source = (cloud(folder / "pcl" / name) for name in ("sample.ply", "test.ply"))
    true = np.array(json.loads((folder / "pcl" / "truth.json").read_text(encoding="utf-8"))["T_sample_test"])
    true[:3, 3] *= 1000
    return away_from(register(source, target, RegisterOptions(seed=seed)).T_target_source, true, source)


def away_from(pose: Floats, true: Floats, points: Floats) -> dict[str, float]:
    """Angle (deg) between two poses, and their distance (mm) at the middle of the points (N, 3)."""
    middle = points.mean(axis=0)
    gap = move_points(pose, middle) - move_points(true, middle)
    return {
        "off_deg": float(np.degrees(angle_between(pose[:3, :3], true[:3, :3]))),
        "off_mm": float(np.linalg.norm(gap)),
    }


def ground_part(folder: Path, every: int = 1) -> GroundPart:
    """Compare the scan of the part with points of its model, or one of ``every`` points of both."""
    model, scan = (cloud(folder / "dac" / name)[::every] for name in ("sample.ply", "test.ply"))
    marked = np.load(folder / "dac" / "labels.npy")[::every]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", GrindvisionWarning)
        found = detect(model, scan)
    pose = found.T_sample_test
    pieces = np.concatenate([piece.points for piece in found.difference.clusters] or [np.full((1, 3), np.inf)])
    near = cKDTree(pieces).query(scan, distance_upper_bound=found.difference.cell_mm)[0]
    settled = open3d_icp(scan, model, pose, reach_mm=10.0)
    places = [found.difference.surfels] * 2, [found.difference.signed_mm] * 2
    if found.deformed is not None:
        places = [found.deformed.points, places[0][1]], [found.deformed.sizes_mm, places[1][1]]
    off_rigid, off_bent = (out[marked[cKDTree(scan).query(at)[1]]] for at, out in zip(*places, strict=True))
    return GroundPart(
        found,
        cKDTree(model).query(move_points(pose, scan))[0],
        np.isfinite(near),
        marked,
        float(np.degrees(angle_between(settled[:3, :3], pose[:3, :3]))),
        least_median(scan, model, pose),
        np.nanquantile(off_rigid, (0.16, 0.5, 0.84)),
        np.nanquantile(off_bent, (0.16, 0.5, 0.84)),
        tuple(str(one.message) for one in caught),
    )


def spread_text(quantiles_mm: Floats) -> str:
    """A median and the middle two thirds of lengths, in words."""
    low, middle, high = quantiles_mm
    return f"{middle:+.2f} mm, two thirds from {low:+.2f} to {high:+.2f} mm"


def least_median(scan: Floats, model: Floats, start: Floats, points: int = 4000) -> float:
    """Least median distance (mm) of a scan (N, 3) from a model's points (M, 3) over rigid poses near ``start`` (4, 4):
    the best of fits to the nearer half, three fifths and three quarters, each brought to rest."""
    surface, moving = cKDTree(model), scan[:: max(1, len(scan) // points)]
    planes = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(model))
    planes.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(20))
    normals, medians = np.asarray(planes.normals), []
    for part in (0.5, 0.6, 0.75):
        pose = start
        for _ in range(60):
            places = move_points(pose, moving)
            away, at = surface.query(places)
            medians.append(float(np.median(away)))
            used = away <= np.quantile(away, part)
            up, centre = normals[at[used]], places.mean(axis=0)
            off = ((places[used] - model[at[used]]) * up).sum(axis=1)
            design = np.column_stack([up, np.cross(places[used] - centre, up)])
            twist = -np.linalg.lstsq(design, off, rcond=1e-6)[0]
            pose = rigid(None, centre) @ small_motion(twist) @ rigid(None, -centre) @ pose
    return min(medians)


def part_table(folder: Path, part: GroundPart | None, refusal: str) -> pd.DataFrame:
    """What is known of the part and its model, and what became of their comparison."""
    marked = np.load(folder / "dac" / "labels.npy")
    rows = [("scanned points", f"{len(marked)}"), ("of them chosen by the engineer", f"{100 * marked.mean():.1f} %")]
    if part is None:
        return pd.DataFrame([*rows, ("detect", f"refused: {refusal}")], columns=["what", "found"])
    rows += [
        ("detect", str(part.found)),
        ("deformation", "none" if part.found.deformed is None else str(part.found.deformed)),
        ("median distance from the model", f"{np.median(part.from_model_mm):.2f} mm"),
        ("least median at any rigid pose found", f"{part.median_mm:.2f} mm"),
        ("chosen points above the model", spread_text(part.chosen_rigid_mm)),
        ("chosen points above the bent model", spread_text(part.chosen_bent_mm)),
        ("angle to where Open3D's ICP ends", f"{part.icp_deg:.2f} deg"),
        ("chosen points that are not shown", f"{part.missed_percent:.1f} %"),
        ("scan that is shown", f"{part.shown_percent:.1f} %"),
    ]
    return pd.DataFrame(rows, columns=["what", "found"])


def open3d_icp(source: Floats, target: Floats, start: Floats, reach_mm: float = 2.0) -> Floats:
    """Where Open3D's point-to-plane ICP ends that begins with a pose (4, 4), mm; partners within ``reach_mm``."""
    clouds = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)) for points in (source, target)]
    clouds[1].estimate_normals(o3d.geometry.KDTreeSearchParamKNN(20))
    to_plane = o3d.pipelines.registration.TransformationEstimationPointToPlane()
    enough = o3d.pipelines.registration.ICPConvergenceCriteria(max_iteration=100)
    return np.array(
        o3d.pipelines.registration.registration_icp(*clouds, reach_mm, start, to_plane, enough).transformation
    )
