"""grindvision's own racers of detection and its stages: the public functions at their defaults."""

from __future__ import annotations

import numpy as np

from benchmarks.peers.laps import Answer, Laps
from grindvision.clouds import read_cloud
from grindvision.vision.change import detection
from grindvision.vision.change.change_detection import find_change
from grindvision.vision.registration.icp import FineRegistration, icp_points
from grindvision.vision.registration.plane_icp import icp_planes
from grindvision.vision.registration.scan_registration import propose
from grindvision.vision.registration.verification import choose_pose
from grindvision.vision.surface.fpfh import compute_fpfh
from grindvision.vision.surface.normals import orient_to_viewpoint
from grindvision.vision.surface.scan import choose_resolution, coarser, prepare_pair
from grindvision.vision.surface.surfels import build_surfels
from grindvision.vision.surface.voxel_grid import voxel_grid


def detect(sample: str, test: str) -> Answer:
    """Two scans in, path points out."""
    lap = Laps()
    good, seen = _read(sample, test)
    lap("read")
    found = detection.detect(good, seen)
    path = found.beads[0].points if found.beads else np.empty((0, 3))
    return {"T_sample_test": found.T_sample_test, "path": path, "laps_s": {**lap.laps_s, **found.timings_s}}


def coarse(sample: str, test: str, seed: int = 0) -> Answer:
    """The first alignment: features, proposals, verification."""
    lap, rng = Laps(), np.random.default_rng(seed)
    clouds = _read(sample, test)
    lap("read")
    source, target = prepare_pair(*reversed(clouds))
    lap("features")
    source, poses = propose(source, target, rng)
    lap("coarse")
    found = choose_pose(source, target, poses, rng)
    lap("verification")
    return {"T_sample_test": found.registration.T_target_source, "laps_s": lap.laps_s}


def icp(sample: str, test: str, start: str) -> Answer:
    """Point-to-plane ICP on surfels."""
    lap = Laps()
    clouds, pose = _read(sample, test), _pose(start)
    lap("read")
    size = coarser(*map(choose_resolution, clouds)).surfel_mm
    target, source = (build_surfels(points, size) for points in clouds)
    normals = orient_to_viewpoint(source.points, source.normals, np.zeros(3))
    target.normals[:] = orient_to_viewpoint(target.points, target.normals, np.zeros(3))
    lap("prepare")
    found = icp_planes(source.points, normals, target, pose, max_mm=4.0)
    lap("icp")
    return {"T_sample_test": found.T_target_source, "laps_s": lap.laps_s}


def icp_paper(sample: str, test: str, start: str) -> Answer:
    """Point-to-point ICP on voxels of 1 mm, as the paper stops it."""
    lap = Laps()
    clouds, pose = _read(sample, test), _pose(start)
    lap("read")
    target, source = (voxel_grid(points, 1.0).centroids for points in clouds)
    lap("prepare")
    found = icp_points(source, target, pose, max_mm=4.0, iterations=400)
    lap("icp")
    return {"T_sample_test": found.T_target_source, "laps_s": lap.laps_s}


def difference(sample: str, test: str) -> Answer:
    """What stands out of the sample, in clusters; the scans are in one frame."""
    lap = Laps()
    clouds = _read(sample, test)
    lap("read")
    source, target = prepare_pair(*reversed(clouds))
    lap("prepare")
    unknown = np.full((6, 6), np.nan)
    same = FineRegistration(np.eye(4), 0.0, 1.0, 0, True, np.zeros(3), unknown, unknown, np.zeros(1))
    found = find_change(source, target, same)
    lap("difference")
    return {"points": found.points, "laps_s": lap.laps_s}


def voxels(cloud: str, size_mm: float = 2.0) -> Answer:
    """The voxel grid filter."""
    lap = Laps()
    (points,) = _read(cloud)
    lap("read")
    found = voxel_grid(points, size_mm)
    lap("voxel")
    return {"points": found.centroids, "size_mm": np.array(size_mm), "origin": np.zeros(3), "laps_s": lap.laps_s}


def fpfh(sample: str, test: str, radius_mm: float = 10.0) -> Answer:
    """Histograms of both scans' points."""
    lap = Laps()
    clouds = [read_cloud(path) for path in (sample, test)]
    lap("read")
    found = []
    for cloud in clouds:
        assert cloud.normals is not None  # the race's files have them
        found.append(compute_fpfh(cloud.points, cloud.normals, radius_mm))
    target, source = found
    lap("fpfh")
    return {"sample": target, "test": source, "laps_s": lap.laps_s}


def _read(*files: str) -> list[np.ndarray]:
    return [read_cloud(file).points for file in files]


def _pose(file: str) -> np.ndarray:
    return np.fromfile(file).reshape(4, 4)
