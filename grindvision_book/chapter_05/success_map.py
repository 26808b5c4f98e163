"""When does a first alignment succeed? Situations made from one clean pair of scans, and three methods (chapter 05)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from grindvision.cell import GrindingScene
from grindvision.geometry import angle_between, inverse, move_points, rigid, rotation_about
from grindvision.vision.registration.global_registration import propose_poses
from grindvision.vision.registration.sac_ia import sac_ia_paper
from grindvision.vision.surface import scan
from grindvision.vision.surface.keypoints import Keypoints

Floats = NDArray[np.float64]

#: A pose this near to the truth is healed by any ICP.
NEAR_DEG, NEAR_MM = 5.0, 5.0

#: Voxels that the paper's variant gets, and its samples; more of either takes minutes.
PAPER_VOXELS, PAPER_SAMPLES = 900, 300


@dataclass(frozen=True)
class Situation:
    """Two clouds (N, 3) and (M, 3) in mm, the truth ``T_sample_test`` (4, 4), and where the test scanner stood (3,)."""

    sample: Floats
    test: Floats
    T_sample_test: Floats
    viewpoint_mm: Floats

    def healed_by_icp(self, T_sample_test: Floats) -> bool:
        """Whether a pose is near enough to the truth, its shift measured at the middle of the test cloud."""
        middle = self.test.mean(axis=0)
        shift = np.linalg.norm(move_points(T_sample_test, middle) - move_points(self.T_sample_test, middle))
        return bool(np.degrees(angle_between(T_sample_test, self.T_sample_test)) < NEAR_DEG and shift < NEAR_MM)

    def __str__(self) -> str:
        return f"sample of {len(self.sample):,} points, test of {len(self.test):,}"


def situation(
    scene: GrindingScene, turn_deg: float, overlap: float, noise_mm: float, rng: np.random.Generator
) -> Situation:
    """The scene's true points made noisy, the test cut along its long side and turned about its middle."""
    sample, test = scene.sample.true_points, scene.test.true_points
    sample = sample + rng.normal(scale=noise_mm, size=sample.shape)
    along = test[:, 0]
    test = test[along > np.quantile(along, 1 - overlap)]
    test = test + rng.normal(scale=noise_mm, size=test.shape)
    turn = rigid(rotation_about(rng.normal(size=3), np.radians(turn_deg)))
    T_turned_test = turn @ rigid(None, -test.mean(axis=0))
    T_sample_turned = scene.T_sample_test @ inverse(T_turned_test)
    return Situation(sample, move_points(T_turned_test, test), T_sample_turned, T_turned_test[:3, 3])


def first_poses(one: Situation, rng: np.random.Generator) -> dict[str, Floats]:
    """First poses T_sample_test (4, 4) of the paper's SAC-IA, of ours, and of Open3D's RANSAC on the voxels of ours.

    Open3D's threads share one random generator: its answer need not repeat.
    """
    views = (one.test, one.viewpoint_mm), (one.sample, np.zeros(3))
    source, target = (
        part.keypoints for part in scan.prepare_pair(one.test, one.sample, (one.viewpoint_mm, np.zeros(3)))
    )
    few_sizes = scan.coarser(*(scan.choose_resolution(cloud, voxels=PAPER_VOXELS) for cloud, _ in views))
    few_source, few_target = (scan.prepare_scan(cloud, few_sizes, view).keypoints for cloud, view in views)
    paper = sac_ia_paper(few_source, few_target, rng, iterations=PAPER_SAMPLES, refine=False)
    return {
        "paper": paper.T_target_source,
        "ours": propose_poses(source, target, rng)[0][0],
        "Open3D": _open3d_pose(source, target),
    }


def _open3d_pose(test: Keypoints, sample: Keypoints) -> Floats:
    clouds, features = [], []
    for keys in (test, sample):
        clouds.append(o3d.geometry.PointCloud(o3d.utility.Vector3dVector(keys.points)))
        features.append(o3d.pipelines.registration.Feature())
        features[-1].data = keys.features.T
    checks = [o3d.pipelines.registration.CorrespondenceCheckerBasedOnEdgeLength(0.9)]
    stop = o3d.pipelines.registration.RANSACConvergenceCriteria(30_000, 0.999)
    estimate = o3d.pipelines.registration.TransformationEstimationPointToPoint(False)
    found = o3d.pipelines.registration.registration_ransac_based_on_feature_matching(
        *clouds, *features, True, 1.5 * test.spacing_mm, estimate, 3, checks, stop
    )
    return np.asarray(found.transformation)
