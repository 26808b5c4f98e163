"""Poses of parts with flat faces, of which all edges look alike: faces laid on faces."""

import numpy as np
import pytest

from grindvision.geometry import inverse, move_points, random_rotation, rigid
from grindvision.vision.registration.face_poses import face_poses
from grindvision.vision.registration.pose_candidates import PoseJudge
from grindvision.vision.registration.verification import MIN_OVERLAP, choose_pose
from grindvision.vision.surface.scan import prepare_pair
from tests.box_scenes import TRAY, looking_at, scan_of


@pytest.fixture(scope="module")
def tray():
    """Two scans of a tray from sides that are 75 degrees apart, made ready, and the true pose."""
    rng = np.random.default_rng(8)
    views = [looking_at((0, 0, 8), 0.75, azimuth, roll_rad=roll) for azimuth, roll in ((0.6, 0.0), (1.9, 1.0))]
    source, target = (scan_of(TRAY, pose, 0.9, rng) for pose in views)
    return *prepare_pair(source, target, (np.zeros(3), np.zeros(3))), inverse(views[1]) @ views[0]


def away_mm(pose, true, scan):
    return float(np.linalg.norm(move_points(pose, scan.points) - move_points(true, scan.points), axis=1).max())


def test_faces_laid_on_faces_come_near_the_true_pose_and_rest_beside_it(tray):
    source, target, true = tray
    judge = PoseJudge(source, target, np.random.default_rng(0), 4000)
    poses = face_poses(judge)
    assert 4 < len(poses) <= 16
    assert min(away_mm(pose, true, source) for pose in poses) < 0.3 * judge.extent
    settled = judge.settled(judge.refined_all(poses, far=True))
    assert min(away_mm(one.pose, true, source) for one in settled) < 0.1 * judge.extent


def test_a_pose_at_which_neither_scanner_saw_what_the_other_did_does_not_win_over_one_that_fits(tray):
    """Turned away from each other two scans contradict nothing."""
    source, target, true = tray
    middle = source.points.mean(axis=0)
    turned = [
        true @ rigid(None, middle) @ rigid(random_rotation(np.random.default_rng(k))) @ rigid(None, -middle)
        for k in range(12)
    ]
    near = true @ rigid(None, [0.5, -0.4, 0.3])
    found = choose_pose(source, target, np.stack([*turned, near]), np.random.default_rng(1))
    assert found.agreement.overlap > MIN_OVERLAP
    assert away_mm(found.registration.T_target_source, true, source) < 0.5
