"""Scans of which a part is missing in gaps, or with pixels mixed across edges: pose, bead, and what is said of them."""

import warnings
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from grindvision.geometry import move_points
from grindvision.vision.change.change_detection import Difference
from grindvision.vision.change.detection import DetectOptions, detect
from grindvision.vision.change.mixed_pixels import MIXED, along_the_rays, diagnose_mixed_pixels
from grindvision.vision.change.pieces import Cluster
from grindvision.vision.change.ridge_path import lies_on_top, trace_bead
from grindvision.vision.registration.icp import FineRegistration
from grindvision.vision.surface.scan import Resolution, prepare_scan
from tests.grinding_scene import arc_bead, pair


def with_gaps(points, size_mm, rng, share=0.15):
    """Points (N, 3) of a scanner at the origin less those where a random field of that length is highest."""
    waves, phases = rng.normal(size=(100, 2)) / size_mm, rng.uniform(0, 2 * np.pi, 100)
    field = np.cos(400 * points[:, :2] / points[:, 2:] @ waves.T + phases).sum(axis=1)
    return points[field < np.quantile(field, 1 - share)]


def test_gaps_of_either_scan_leave_pose_and_bead_and_are_told():
    beads = (arc_bead(),)
    case, rng = pair(seed=4, n_points=20_000, beads=beads), np.random.default_rng(8)
    sample, test = (with_gaps(points, 7.0, rng) for points in (case.sample, case.test))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = detect(sample, test, DetectOptions(seed=1))
    away = move_points(found.T_sample_test, case.test) - move_points(case.T_sample_test, case.test)
    assert np.linalg.norm(away, axis=1).max() < 0.3
    assert len(found.difference.clusters) == len(found.beads) == 1
    assert found.coarse.in_gaps > 0.05
    assert sum("lies in holes of the other" in str(one.message) for one in caught) == 1
    assert found.coverage.test_fraction < 0.9
    ridge = move_points(case.T_test_part, beads[0].ridge())
    assert cKDTree(ridge).query(found.path_points)[0].max() < 0.7


def test_a_ridge_beside_the_highest_points_across_it_is_told():
    """A bead along y; its path, and the same path moved down its flank."""
    x, y = np.meshgrid(np.arange(-3, 3.1, 0.6), np.arange(-15, 15.1, 0.6))
    x, y = x.ravel(), y.ravel()
    height = 1.6 * (1 - (x / 3.2) ** 2)
    up = np.tile([0.0, 0.0, 1.0], (len(x), 1))
    piece = Cluster(np.column_stack([x, y, height]), height, up, 1.2, 60.0, 80.0, 1.6)
    path = trace_bead(piece, 6)
    assert lies_on_top(piece, path)
    down = np.array([2.7, 0.0, 0.0])
    assert not lies_on_top(piece, replace(path, points=path.points + down, ridge=path.ridge + down))


def test_a_slope_between_two_planes_along_the_rays_is_told_as_mixed_pixels():
    """Two planes 20 mm apart; in one scan a slope nearly along the rays joins them, in the other nothing does."""
    rng = np.random.default_rng(0)
    x, y = (one.ravel() for one in np.meshgrid(np.arange(-40, 40.1, 1.0), np.arange(-30, 30.1, 1.0)))
    planes = np.column_stack([x, y, np.where(x > 0, 400.0, 420.0)])
    deep = rng.uniform(400, 420, 1500)
    ramp = np.column_stack([0.06 * (deep - 400), rng.uniform(-30, 30, len(deep)), deep])
    ramp[:, 1] *= deep / 400
    clean, mixed = (prepare_scan(points, Resolution(1.0, 2.0, 4.0), np.zeros(3), None) for points in
                    (planes, np.concatenate([planes, ramp])))  # fmt: skip
    assert along_the_rays(clean).mean() < MIXED < along_the_rays(mixed).mean()
    same = FineRegistration(np.eye(4), 0.1, 1.0, 5, True, np.zeros(3), np.eye(6), np.eye(6), np.zeros(1))
    none = np.ones(len(mixed.surfels))
    difference = Difference((), mixed.surfels.points, 0.3 * none, none, 1.0, none, none > 0, 2.0)
    (said,) = diagnose_mixed_pixels(mixed, clean, same, difference)
    assert "of the test scan lies along the lines of sight" in said
    assert "by up to 0.3 mm" in said
    assert diagnose_mixed_pixels(clean, clean, same, difference) == ()
