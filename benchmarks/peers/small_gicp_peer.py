"""small_gicp: generalised ICP, point-to-plane ICP, voxel filter and kd-tree, on all cores."""

from __future__ import annotations

import os

import numpy as np
import small_gicp

from benchmarks.peers.laps import Answer, Laps
from benchmarks.peers.recipe import THRESHOLD_MM
from grindvision.clouds import read_cloud

THREADS = os.cpu_count() or 1


def icp(sample: str, test: str, start: str, method: str) -> Answer:
    """ICP on voxels of 1 mm, within 4 mm and then within 1 mm; ``method`` GICP or PLANE_ICP."""
    lap = Laps()
    clouds = [read_cloud(path).points for path in (sample, test)]
    pose = np.fromfile(start).reshape(4, 4)
    lap("read")
    (target, tree), (source, _) = (small_gicp.preprocess_points(points, 1.0, 20, THREADS) for points in clouds)
    lap("prepare")
    for max_mm in (4.0, 1.0):
        pose = small_gicp.align(
            target, source, tree, pose, registration_type=method, max_correspondence_distance=max_mm,
            num_threads=THREADS, max_iterations=50, rotation_epsilon=1e-6, translation_epsilon=1e-4,
        ).T_target_source  # fmt: skip
    lap("icp")
    return {"T_sample_test": pose, "laps_s": lap.laps_s}


def difference(sample: str, test: str) -> Answer:
    """Points farther than 0.5 mm from their nearest neighbour."""
    lap = Laps()
    target, source = (read_cloud(path).points for path in (sample, test))
    lap("read")
    tree = small_gicp.KdTree(target, num_threads=THREADS)
    _, squared = tree.batch_nearest_neighbor_search(source, num_threads=THREADS)
    changed = np.ravel(squared) > THRESHOLD_MM**2
    lap("difference")
    return {"changed": changed, "laps_s": lap.laps_s}


def voxels(cloud: str, size_mm: float = 2.0) -> Answer:
    """The voxel grid filter, in one thread: with more its result is not the same every time."""
    lap = Laps()
    points = read_cloud(cloud).points
    lap("read")
    less = np.asarray(small_gicp.voxelgrid_sampling(points, size_mm).points())[:, :3]
    lap("voxel")
    return {"points": less, "size_mm": np.array(size_mm), "origin": np.zeros(3), "laps_s": lap.laps_s}
