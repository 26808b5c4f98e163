"""Open3D: RANSAC on FPFH matches, point-to-plane ICP, distances to the nearest neighbour."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
import open3d as o3d

from benchmarks.peers.laps import Answer, Laps
from benchmarks.peers.recipe import THRESHOLD_MM, bead_path
from benchmarks.peers.weld_recipe import groove_labels, slab_medians

REGISTRATION = o3d.pipelines.registration
#: A cloud and the FPFH of its points; Open3D has no types to give.
Featured: TypeAlias = tuple[Any, Any]


def detect(sample: str, test: str, voxel_mm: float = 4.0) -> Answer:
    """The whole pipeline as its tutorials write it."""
    lap = Laps()
    target, source = o3d.io.read_point_cloud(sample), o3d.io.read_point_cloud(test)
    lap("read")
    fine = [cloud.voxel_down_sample(1.0) for cloud in (target, source)]
    features = [featured(cloud, voxel_mm) for cloud in fine]
    lap("features")
    pose = ransac(features[0], features[1], voxel_mm)
    lap("coarse")
    pose = plane_icp(fine[0], fine[1], pose)
    lap("icp")
    moved = o3d.geometry.PointCloud(source).transform(pose)
    distances = np.asarray(moved.compute_point_cloud_distance(target))
    lap("difference")
    surface, normals = np.asarray(fine[0].points), np.asarray(fine[0].normals)
    path = bead_path(np.asarray(source.points), np.asarray(moved.points), distances, surface, normals)
    lap("path")
    return {"T_sample_test": pose, "path": path, "laps_s": lap.laps_s}


def featured(cloud: o3d.geometry.PointCloud, voxel_mm: float) -> Featured:
    """Voxel filter, normals towards the scanner, FPFH within five voxels."""
    cloud = cloud.voxel_down_sample(voxel_mm)
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(2 * voxel_mm, 30))
    cloud.orient_normals_towards_camera_location()
    search = o3d.geometry.KDTreeSearchParamHybrid(5 * voxel_mm, 100)
    return cloud, REGISTRATION.compute_fpfh_feature(cloud, search)


def ransac(target: Featured, source: Featured, voxel_mm: float, tries: int = 100_000) -> np.ndarray:
    """RANSAC on mutual matches of the features."""
    (target_cloud, target_features), (source_cloud, source_features) = target, source
    checks = [
        REGISTRATION.CorrespondenceCheckerBasedOnEdgeLength(0.9),
        REGISTRATION.CorrespondenceCheckerBasedOnDistance(1.5 * voxel_mm),
    ]
    return REGISTRATION.registration_ransac_based_on_feature_matching(
        source_cloud, target_cloud, source_features, target_features, True, 1.5 * voxel_mm,
        REGISTRATION.TransformationEstimationPointToPoint(False), 3, checks,
        REGISTRATION.RANSACConvergenceCriteria(tries, 0.999),
    ).transformation  # fmt: skip


def plane_icp(target: o3d.geometry.PointCloud, source: o3d.geometry.PointCloud, pose: np.ndarray) -> np.ndarray:
    """Point-to-plane ICP on voxels of 1 mm: within 4 mm, then within 1 mm."""
    target.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(3.0, 30))
    for max_mm in (4.0, 1.0):
        pose = REGISTRATION.registration_icp(
            source, target, max_mm, pose, REGISTRATION.TransformationEstimationPointToPlane(),
            REGISTRATION.ICPConvergenceCriteria(1e-7, 1e-7, 30),
        ).transformation  # fmt: skip
    return pose


def coarse(sample: str, test: str, voxel_mm: float, tries: int = 100_000) -> Answer:
    """The first alignment."""
    lap = Laps()
    clouds = [o3d.io.read_point_cloud(path) for path in (sample, test)]
    lap("read")
    features = [featured(cloud, voxel_mm) for cloud in clouds]
    lap("features")
    pose = ransac(features[0], features[1], voxel_mm, tries)
    lap("coarse")
    return {"T_sample_test": pose, "laps_s": lap.laps_s}


def icp(sample: str, test: str, start: str) -> Answer:
    """Point-to-plane ICP."""
    lap = Laps()
    clouds = [o3d.io.read_point_cloud(path) for path in (sample, test)]
    lap("read")
    target, source = (cloud.voxel_down_sample(1.0) for cloud in clouds)
    lap("prepare")
    pose = plane_icp(target, source, np.fromfile(start).reshape(4, 4))
    lap("icp")
    return {"T_sample_test": pose, "laps_s": lap.laps_s}


def difference(sample: str, test: str) -> Answer:
    """Points farther than 0.5 mm from their nearest neighbour."""
    lap = Laps()
    target, source = (o3d.io.read_point_cloud(path) for path in (sample, test))
    lap("read")
    changed = np.asarray(source.compute_point_cloud_distance(target)) > THRESHOLD_MM
    lap("difference")
    return {"changed": changed, "laps_s": lap.laps_s}


def voxels(cloud: str, size_mm: float = 2.0) -> Answer:
    """The voxel grid filter; the lattice begins half a voxel below the lowest corner."""
    lap = Laps()
    points = o3d.io.read_point_cloud(cloud)
    lap("read")
    less = points.voxel_down_sample(size_mm)
    lap("voxel")
    origin = points.get_min_bound() - 0.5 * size_mm
    return {"points": np.asarray(less.points), "size_mm": np.array(size_mm), "origin": origin, "laps_s": lap.laps_s}


def fpfh(sample: str, test: str, radius_mm: float = 10.0) -> Answer:
    """Histograms of both scans' points."""
    lap = Laps()
    clouds = [o3d.io.read_point_cloud(path) for path in (sample, test)]
    lap("read")
    search = o3d.geometry.KDTreeSearchParamRadius(radius_mm)
    good, seen = (np.asarray(REGISTRATION.compute_fpfh_feature(cloud, search).data).T for cloud in clouds)
    lap("fpfh")
    return {"sample": good, "test": seen, "laps_s": lap.laps_s}


def groove(cloud: str, radius_mm: float, threshold_deg: float) -> Answer:
    """The second paper's recipe without smoothing: Open3D's normals and clusters, the descriptor in NumPy."""
    lap = Laps()
    points = o3d.io.read_point_cloud(cloud)
    lap("read")
    points.estimate_normals(o3d.geometry.KDTreeSearchParamRadius(radius_mm))
    points.orient_normals_towards_camera_location()
    places, normals = np.asarray(points.points), np.asarray(points.normals)
    labels = groove_labels(places, normals, radius_mm, threshold_deg)
    lap("groove")
    path = slab_medians(places[labels]) if labels.any() else np.empty((0, 3))
    lap("trajectory")
    return {"labels": labels, "path": path, "laps_s": lap.laps_s}
