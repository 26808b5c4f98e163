"""KISS-Matcher for the first alignment, then Open3D's ICP and SciPy's kd-tree."""

from __future__ import annotations

import kiss_matcher
import numpy as np
import open3d as o3d
from scipy.spatial import cKDTree

from benchmarks.peers.laps import Answer, Laps
from benchmarks.peers.open3d_peer import plane_icp
from benchmarks.peers.recipe import bead_path
from grindvision.geometry import move_points, rigid


def detect(sample: str, test: str, voxel_mm: float = 2.0) -> Answer:
    """The whole pipeline."""
    lap = Laps()
    target, source = o3d.io.read_point_cloud(sample), o3d.io.read_point_cloud(test)
    lap("read")
    fine = [cloud.voxel_down_sample(1.0) for cloud in (target, source)]
    lap("features")
    pose = matched(np.asarray(fine[0].points), np.asarray(fine[1].points), voxel_mm)
    lap("coarse")
    pose = plane_icp(fine[0], fine[1], pose)
    lap("icp")
    points = np.asarray(source.points)
    moved = move_points(pose, points)
    distances, _ = cKDTree(np.asarray(target.points)).query(moved, workers=-1)
    lap("difference")
    path = bead_path(points, moved, distances, np.asarray(fine[0].points), np.asarray(fine[0].normals))
    lap("path")
    return {"T_sample_test": pose, "path": path, "laps_s": lap.laps_s}


def matched(target: np.ndarray, source: np.ndarray, voxel_mm: float) -> np.ndarray:
    """The pose T_target_source that KISS-Matcher finds, with its own voxel filter and features."""
    matcher = kiss_matcher.KISSMatcher(kiss_matcher.KISSMatcherConfig(voxel_mm))
    found = matcher.estimate(source.astype(np.float32), target.astype(np.float32))
    return rigid(found.rotation, np.ravel(found.translation))


def coarse(sample: str, test: str, voxel_mm: float = 2.0) -> Answer:
    """The first alignment."""
    lap = Laps()
    target, source = (np.asarray(o3d.io.read_point_cloud(path).points) for path in (sample, test))
    lap("read")
    pose = matched(target, source, voxel_mm)
    lap("coarse")
    return {"T_sample_test": pose, "laps_s": lap.laps_s}
