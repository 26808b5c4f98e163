"""Open3D: RANSAC on FPFH matches, point-to-plane ICP, distances to the nearest neighbour."""

from __future__ import annotations

import numpy as np
import open3d as o3d

from benchmarks.peers.laps import Laps
from benchmarks.peers.recipe import bead_path

REGISTRATION = o3d.pipelines.registration


def detect(sample: str, test: str, voxel_mm: float = 4.0) -> dict:
    """The whole pipeline as its tutorials write it."""
    lap = Laps()
    target, source = o3d.io.read_point_cloud(sample), o3d.io.read_point_cloud(test)
    lap("read")
    fine = [cloud.voxel_down_sample(1.0) for cloud in (target, source)]
    features = [featured(cloud, voxel_mm) for cloud in fine]
    lap("features")
    pose = ransac(*features, voxel_mm)
    lap("coarse")
    pose = plane_icp(*fine, pose)
    lap("icp")
    moved = o3d.geometry.PointCloud(source).transform(pose)
    distances = np.asarray(moved.compute_point_cloud_distance(target))
    lap("difference")
    surface = (np.asarray(values) for values in (fine[0].points, fine[0].normals))
    path = bead_path(np.asarray(source.points), np.asarray(moved.points), distances, *surface)
    lap("path")
    return {"T_sample_test": pose, "path": path, "laps_s": lap.laps_s}


def featured(cloud, voxel_mm: float):
    """Voxel filter, normals towards the scanner, FPFH within five voxels."""
    cloud = cloud.voxel_down_sample(voxel_mm)
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(2 * voxel_mm, 30))
    cloud.orient_normals_towards_camera_location()
    search = o3d.geometry.KDTreeSearchParamHybrid(5 * voxel_mm, 100)
    return cloud, REGISTRATION.compute_fpfh_feature(cloud, search)


def ransac(target, source, voxel_mm: float) -> np.ndarray:
    """RANSAC on mutual matches of the features."""
    (target_cloud, target_features), (source_cloud, source_features) = target, source
    checks = [
        REGISTRATION.CorrespondenceCheckerBasedOnEdgeLength(0.9),
        REGISTRATION.CorrespondenceCheckerBasedOnDistance(1.5 * voxel_mm),
    ]
    return REGISTRATION.registration_ransac_based_on_feature_matching(
        source_cloud, target_cloud, source_features, target_features, True, 1.5 * voxel_mm,
        REGISTRATION.TransformationEstimationPointToPoint(False), 3, checks,
        REGISTRATION.RANSACConvergenceCriteria(100_000, 0.999),
    ).transformation  # fmt: skip


def plane_icp(target, source, pose: np.ndarray) -> np.ndarray:
    """Point-to-plane ICP on voxels of 1 mm: within 4 mm, then within 1 mm."""
    target.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(3.0, 30))
    for most_mm in (4.0, 1.0):
        pose = REGISTRATION.registration_icp(
            source, target, most_mm, pose, REGISTRATION.TransformationEstimationPointToPlane(),
            REGISTRATION.ICPConvergenceCriteria(1e-7, 1e-7, 30),
        ).transformation  # fmt: skip
    return pose
