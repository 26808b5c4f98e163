"""Detection on parts other than the book's plate: ``python -m benchmarks.workpieces --pairs 24``.

Pairs of scans of random workpieces, with a bead, with a pit and as good, some 10 to 60 deg apart, each with its truth.
Printed: how many ours solves, refuses and gets wrong, silently (exit 0 and no warning) or not; with ``--peers``, how
many poses the peers find on the same pairs.
"""

from __future__ import annotations

import argparse
import csv
import os
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from benchmarks.peers.programs import build_pcl, run_pcl
from grindvision.cell.workpiece_scene import CHANGES, WorkpieceScene, workpiece_scene
from grindvision.cell.workpieces import WORKPIECES
from grindvision.clouds import write_ply
from grindvision.errors import GrindvisionError, MissingExtraError
from grindvision.models import Model
from grindvision.vision.change.detection import Detection, DetectOptions, detect
from grindvision.vision.change.ridge_path import BeadPath
from grindvision.words import counted

Floats = NDArray[np.float64]

MAX_POSE_MM = 1.0
"""A pose that moves a point by more is wrong."""

MAX_PATH_MM = 2.0
"""A path point farther than this from the true ridge is wrong."""

MIN_SEEN, MIN_COVERED = 0.8, 0.5
"""A bead that both scans show along so much of its length needs a path, and along so much of what they show, within
twice ``MAX_PATH_MM``."""

NO_PATH = "bead missed"

COLUMNS = ("pair", "kind", "change", "determined", "outcome", "pose_mm", "confidence", "seconds", "said")


def scene_of(pair: int, seed: int = 0, kinds: tuple[str, ...] = tuple(WORKPIECES)) -> WorkpieceScene:
    """The pair of that number: kinds and changes in turn, everything else drawn."""
    kind, change = kinds[pair % len(kinds)], CHANGES[pair // len(kinds) % len(CHANGES)]
    return workpiece_scene(kind, np.random.default_rng([seed, pair]), change)


def judged(scene: WorkpieceScene, options: DetectOptions, model: bool = False) -> dict[str, Any]:
    """What ``detect`` makes of a pair, or of the test scan and the good part's ``model``, and the verdict."""
    sample = Model(scene.good.vertices_mm, scene.good.triangles) if model else scene.sample.points
    started = time.process_time()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            found = detect(sample, scene.test.points, options)
        except GrindvisionError as error:
            seconds = time.process_time() - started
            return {"outcome": "refused", "seconds": seconds, "said": str(error)}
    said = " | ".join(str(one.message) for one in caught)
    pose_mm = scene.pose_error_mm(found.T_sample_test)
    fault = _fault(scene, pose_mm, found.beads)
    outcome = "solved" if not fault else "wrong" if caught else "silently wrong"
    if fault == NO_PATH and caught and _names_the_bead(scene, found):
        outcome = "refused"
    seconds = time.process_time() - started
    return {
        "outcome": outcome,
        "pose_mm": pose_mm,
        "confidence": found.confidence,
        "seconds": seconds,
        "said": "; ".join(filter(None, (fault, str(found), said))),
    }


def _fault(scene: WorkpieceScene, pose_mm: float, beads: Sequence[BeadPath]) -> str:
    """What is wrong with a result, empty where nothing is."""
    if pose_mm > MAX_POSE_MM:
        return f"pose {pose_mm:.2f} mm off"
    if scene.change != "bead":
        return f"{counted(len(beads), 'false bead')}" if beads else ""
    for bead in beads:
        away, _ = cKDTree(scene.ridge_mm).query(bead.points)
        if away.max() > MAX_PATH_MM:
            return f"path point {away.max():.1f} mm off the bead"
    if scene.comparable <= MIN_SEEN:
        return ""
    if not beads:
        return NO_PATH
    followed = cKDTree(np.concatenate([bead.ridge for bead in beads]))
    away, _ = followed.query(scene.ridge_mm[scene.seen_by_both])
    covered = float(np.mean(away < 2 * MAX_PATH_MM))
    return f"path along {covered:.0%} of the bead" if covered < MIN_COVERED else ""


def _names_the_bead(scene: WorkpieceScene, found: Detection) -> bool:
    """Whether what stands out without a path, which the warnings list, is the bead: then the path alone is refused."""
    pieces = [piece.points.mean(axis=0) for piece in found.difference.clusters]
    places = [*pieces, *(speck.middle_mm for speck in found.difference.specks)]
    away, _ = cKDTree(scene.ridge_mm).query(np.array(places).reshape(-1, 3))
    return bool((away < 2 * MAX_PATH_MM).any())


def open3d_pose(scene: WorkpieceScene) -> Floats:
    """Open3D's global registration (FPFH and RANSAC) and its point-to-plane ICP, as its tutorial has them."""
    import open3d as o3d

    o3d.utility.random.seed(0)
    voxel = 2.5
    clouds, features = [], []
    for scan in (scene.test, scene.sample):
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(scan.points)).voxel_down_sample(voxel)
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(2 * voxel, 30))
        cloud.orient_normals_towards_camera_location(np.zeros(3))
        clouds.append(cloud)
        search = o3d.geometry.KDTreeSearchParamHybrid(5 * voxel, 100)
        features.append(o3d.pipelines.registration.compute_fpfh_feature(cloud, search))
    registration = o3d.pipelines.registration
    coarse = registration.registration_ransac_based_on_feature_matching(
        *clouds, *features, True, 1.5 * voxel,
        registration.TransformationEstimationPointToPoint(False), 3,
        [
            registration.CorrespondenceCheckerBasedOnEdgeLength(0.9),
            registration.CorrespondenceCheckerBasedOnDistance(1.5 * voxel),
        ],
        registration.RANSACConvergenceCriteria(100_000, 0.999),
    )  # fmt: skip
    pose = coarse.transformation
    for reach in (voxel, 0.4 * voxel):
        plane = registration.TransformationEstimationPointToPlane()
        pose = registration.registration_icp(*clouds, reach, pose, plane).transformation
    return np.asarray(pose)


def kiss_matcher_pose(scene: WorkpieceScene) -> Floats:
    """KISS-Matcher and Open3D's point-to-plane ICP."""
    import kiss_matcher
    import open3d as o3d

    voxel = 2.5
    matcher = kiss_matcher.KISSMatcher(kiss_matcher.KISSMatcherConfig(voxel))
    found = matcher.estimate(scene.test.points.astype(np.float32), scene.sample.points.astype(np.float32))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = found.rotation, np.ravel(found.translation)
    clouds = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(scan.points)) for scan in (scene.test, scene.sample)]
    clouds[1].estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(2 * voxel, 30))
    registration = o3d.pipelines.registration
    for reach in (voxel, 0.4 * voxel):
        plane = registration.TransformationEstimationPointToPlane()
        pose = registration.registration_icp(*clouds, reach, pose, plane).transformation
    return np.asarray(pose)


def pcl_pose(scene: WorkpieceScene, method: str) -> Floats:
    """PCL's first alignment by ``sacia`` or ``prerejective``, and its ICP to planes."""
    if why := build_pcl():
        raise MissingExtraError(f"PCL: {why}")
    tries = {"sacia": 2_000, "prerejective": 50_000}[method]
    with tempfile.TemporaryDirectory() as folder:
        sample, test, start = (Path(folder) / name for name in ("sample.ply", "test.ply", "start"))
        write_ply(sample, scene.sample.points)
        write_ply(test, scene.test.points)
        words = sample, test, os.devnull
        coarse = run_pcl("pcl_grind", "coarse", *words, method, 2.5, tries)["T_sample_test"]
        np.ascontiguousarray(coarse).tofile(start)
        return np.asarray(run_pcl("pcl_grind", "icp", *words, "plane", start)["T_sample_test"])


PEERS: dict[str, Callable[[WorkpieceScene], Floats]] = {
    "open3d": open3d_pose,
    "kiss-matcher": kiss_matcher_pose,
    "pcl-sacia": partial(pcl_pose, method="sacia"),
    "pcl-prerejective": partial(pcl_pose, method="prerejective"),
}


def rows_of(path: Path) -> list[dict[str, Any]]:
    """The rows that an earlier run, perhaps cut off, left in ``path``; none where there is no such file."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        rows: list[dict[str, Any]] = list(csv.DictReader(file))
    for row in rows:
        row["pair"], row["determined"] = int(row["pair"]), row["determined"] == "True"
        for name in ("pose_mm", "confidence", "seconds"):
            row[name] = float(row[name]) if row[name] else None
    return [{name: value for name, value in row.items() if value is not None} for row in rows]


def append(path: Path, row: dict[str, Any]) -> None:
    """Put ``row`` at the end of ``path``, at once, so that a long study that is cut off keeps what it has."""
    begins = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        if begins:
            writer.writeheader()
        writer.writerow(row)


def race_peers(scenes: Iterable[tuple[int, WorkpieceScene]], names: Sequence[str], path: Path | None = None) -> None:
    """Print how many poses each peer gets right, of all pairs and of the determined ones; rows of pairs go to ``path``,
    and a peer is not asked again for a pair that stands there.

    None of them refuses a pair: what is not right is silently wrong.
    """
    rows: list[dict[str, Any]] = rows_of(path) if path else []
    done = {(row["pair"], row["change"]) for row in rows}
    for pair, scene in scenes:
        for name in names:
            if (pair, name) in done:
                continue
            started = time.perf_counter()
            try:
                error = scene.pose_error_mm(PEERS[name](scene))
            except (RuntimeError, GrindvisionError) as refusal:
                error = np.inf
                print(f"{pair} {name}: {refusal}")
            row = {"pair": pair, "kind": scene.piece.kind, "change": name, "determined": scene.determined,
                   "outcome": "solved" if error <= MAX_POSE_MM else "silently wrong", "pose_mm": error,
                   "seconds": time.perf_counter() - started}  # fmt: skip
            rows.append(row)
            if path:
                append(path, row)
    for name in names:
        for title, some in (("all", rows), ("determined", [row for row in rows if row["determined"]])):
            errors = [row["pose_mm"] for row in some if row["change"] == name]
            right = sum(error <= MAX_POSE_MM for error in errors)
            middle = f"median error {np.median(errors):.3g} mm" if errors else "no pairs"
            print(f"{name}, {title}: pose right {right} of {len(errors)}, {middle}")


def main(words: list[str] | None = None) -> int:
    """Run the study and print its table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.workpieces", description=__doc__.splitlines()[0])
    parser.add_argument("--pairs", type=int, default=24, help="how many (default: 24)")
    parser.add_argument("--first", type=int, default=0, help="number of the first pair (default: 0)")
    parser.add_argument("--seed", type=int, default=0, help="of the scenes (default: 0)")
    parser.add_argument("--model", action="store_true", help="the good part's model takes the place of its scan")
    parser.add_argument("--kinds", nargs="+", choices=tuple(WORKPIECES), default=tuple(WORKPIECES))
    parser.add_argument("--peers", nargs="+", choices=tuple(PEERS), default=(), help="these instead of ours")
    parser.add_argument(
        "--csv", type=Path, help="a row a pair, appended to this file; pairs that stand in it are skipped"
    )
    options = parser.parse_args(words)
    rows: list[dict[str, Any]] = rows_of(options.csv) if options.csv else []
    done = {row["pair"] for row in rows}
    pairs = range(options.first, options.first + options.pairs)
    for pair in pairs if not options.peers else ():
        if pair in done:
            continue
        scene = scene_of(pair, options.seed, tuple(options.kinds))
        row = {"pair": pair, "kind": scene.piece.kind, "change": scene.change, "determined": scene.determined}
        rows.append(row | judged(scene, DetectOptions(seed=pair), options.model))
        print(*(f"{rows[-1].get(name, ''):.3g}" if isinstance(rows[-1].get(name), float) else rows[-1].get(name, "-")
                for name in COLUMNS), sep="  ", flush=True)  # fmt: skip
        if options.csv:
            append(options.csv, rows[-1])
    if options.peers:
        scenes = (scene_of(pair, options.seed, tuple(options.kinds)) for pair in pairs)
        race_peers(zip(pairs, scenes, strict=True), options.peers, options.csv)
        return 0
    determined = [row for row in rows if row["determined"]]
    for title, some in (("all", rows), ("determined", determined)):
        counts = Counter(row["outcome"] for row in some)
        text = ", ".join(f"{name} {counts[name]}" for name in ("solved", "refused", "wrong", "silently wrong"))
        print(f"{title}: {len(some)} pairs: {text}")
    print(f"ours: pose right {sum(row.get('pose_mm', np.inf) <= MAX_POSE_MM for row in rows)} of {len(rows)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
