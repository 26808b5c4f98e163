"""What speaks for a pose and against it: depth images, rivals, motions that are hardly known."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

from grindvision.errors import AmbiguousError
from grindvision.geometry import angle_between, inverse, move_points, rigid, rotation_about, small_motion, twist_between
from grindvision.vision.registration import depth_image as images
from grindvision.vision.registration import rivals
from grindvision.vision.registration.evidence import ABSENT, AGREES, IN_FRONT, IN_HOLE, UNSEEN
from grindvision.vision.registration.free_motions import weakest_motion
from grindvision.vision.registration.pose_candidates import PoseJudge
from grindvision.vision.registration.scan_registration import RegisterOptions, register
from grindvision.vision.surface.scan import choose_resolution, prepare_pair, prepare_scan
from tests.grinding_scene import pair

CELL = 1.0


def image_of(height, hidden=None):
    """Depth (mm) of a surface at 400 mm less ``height(x, y)``, in pixels of 1 mm, infinite where ``hidden``."""
    x, y = np.meshgrid(np.arange(-40.0, 41), np.arange(-30.0, 31), indexing="ij")
    depth = 400 - height(x, y)
    if hidden is not None:
        depth[hidden(x, y)] = np.inf
    depth[[0, -1]], depth[:, [0, -1]] = np.inf, np.inf
    return x, y, depth


def test_a_hole_in_a_tilted_plane_is_bridged_at_the_planes_own_depth():
    x, y, depth = image_of(lambda x, y: 0.4 * x - 0.2 * y, lambda x, y: np.hypot(x - 5, y) < 8)
    bridge = images._bridges(depth, CELL / 400)
    inside = np.hypot(x - 5, y) < 6
    np.testing.assert_allclose(bridge[inside], (400 - 0.4 * x + 0.2 * y)[inside], atol=1e-9)
    assert np.isneginf(bridge[np.hypot(x - 5, y) > 9]).all()


@pytest.mark.parametrize("start", [-0.5, 0.5])
def test_a_shadow_beside_a_wall_is_no_hole(start):
    """A wall 20 mm high hides a strip of the floor: along the rows the depth jumps across the gap."""
    _, _, depth = image_of(lambda x, y: np.where(x < 0, 20.0, 0.0), lambda x, y: (x > start) & (x < 9) & (abs(y) < 20))
    assert np.isneginf(images._bridges(depth, CELL / 400)).all()


def holed(points, T_test_part):
    """A scan less what lies over a round hole of the part."""
    at = move_points(inverse(T_test_part), points)
    return points[np.hypot(at[:, 0] - 10, at[:, 1] + 25) > 12]


def test_a_pose_is_contradicted_in_front_of_what_was_seen_and_over_holes():
    case = pair(seed=2, n_points=30_000)
    T_sample_part = case.T_sample_test @ case.T_test_part
    test, sample = prepare_pair(case.test, holed(case.sample, T_sample_part), (np.zeros(3), np.zeros(3)))
    judge = PoseJudge(test, sample, np.random.default_rng(0), 4000)
    truth = judge.evidence(case.T_sample_test, None).states
    nearer = judge.evidence(rigid(None, [0, 0, -8.0]) @ case.T_sample_test, None).states
    share = {state: (truth == state).mean() for state in (UNSEEN, ABSENT, AGREES, IN_FRONT, IN_HOLE)}
    assert share[AGREES] > 0.9
    assert share[IN_FRONT] < 0.001
    assert 0.004 < share[IN_HOLE] < 0.02  # 1.6 % of the test scan lie over the hole, less its rim
    assert (nearer == IN_FRONT).mean() > 0.3


def test_a_twist_between_two_poses_is_the_small_motion_that_leads_there(rng):
    centre = rng.normal(size=3) * 100
    start = rigid(rotation_about(rng.normal(size=3), 1.0), rng.normal(size=3) * 50)
    for angle in (0.0, 1e-9, 1e-3, 1.0, 3.1):
        twist = np.concatenate([rng.normal(size=3), angle * np.array([0.6, 0.0, 0.8])])
        end = rigid(None, centre) @ small_motion(twist) @ rigid(None, -centre) @ start
        np.testing.assert_allclose(twist_between(start, end, centre), twist, atol=1e-9, rtol=1e-7)


def groove_plate(seed, bend_mm):
    """A plate with two long ribs along x: nothing but its ends, which are beside the picture, fixes it along x."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-90, 90, 40_000), rng.uniform(-40, 40, 40_000)
    height = sum(5 / (1 + np.exp((np.abs(y - at) - 5) / 0.8)) for at in (-15.0, 20.0)) + 0.004 * y**2
    height += 0.35 * np.exp(-((x - 20) ** 2 + (y - 3) ** 2) / 900)  # hardly a bump: a weak hold along x
    height += bend_mm * np.sin(x / 40 + seed)
    return np.column_stack([x, y, 400 - height + rng.normal(0, 0.03, len(x))])


def test_a_motion_that_bending_decides_is_said_or_refused():
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            found = register(groove_plate(0, 0.05), groove_plate(1, 0.05), RegisterOptions(seed=0))
        except AmbiguousError:
            return
    error = np.linalg.norm(found.T_target_source[:3, 3])
    assert error < 0.9 or any("known to" in str(one.message) for one in said)


def test_a_part_with_relief_all_over_is_known_well():
    case = pair(seed=4, n_points=30_000)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = register(case.test, case.sample)
    sigma, deviated = weakest_motion(found.fine, found.source.surfels.points[::20])
    assert 0.001 < sigma < 0.2
    moved = [move_points(pose, found.source.surfels.points) for pose in (deviated, found.T_target_source)]
    assert np.linalg.norm(moved[0] - moved[1], axis=1).max() == pytest.approx(sigma, rel=0.3)


def test_an_origin_that_the_surface_hides_from_itself_is_no_scanners_place():
    """A curved scan that was moved: the origin may lie on the side that it shows and still cannot have seen it all."""
    rng = np.random.default_rng(3)
    v, u = rng.uniform(-1.4, 1.4, 20_000), rng.uniform(-1.4, 1.4, 20_000)
    bowl = 50 * np.stack([np.sin(u), np.sin(v) * np.cos(u), -np.cos(u) * np.cos(v)], axis=1)
    seen = bowl + [0.0, 0.0, 400.0]
    assert images.depth_image(prepare_scan(seen, choose_resolution(seen), np.zeros(3))).known
    aside = bowl @ rotation_about((0, 1, 0), 1.2).T + [0.0, 0.0, 400.0]
    assert not images.depth_image(prepare_scan(aside, choose_resolution(aside), np.zeros(3))).known


def test_the_teeth_of_a_part_show_in_the_angles_between_its_rivals():
    tooth = np.radians(360 / 31)
    assert rivals._folds([3 * tooth, 7 * tooth, np.pi * 2 - 12 * tooth]) == 31
    assert rivals._folds([np.radians(120), np.radians(120.4)]) == 3
    assert rivals._folds([np.radians(11.6)]) == 1
    assert rivals._folds([1.0, 1.1, 1.234567, 0.3333]) == 1
    # between the holes of a flange nothing resists, and rivals rest anywhere
    assert rivals._folds(np.radians([72.0, 143.99, 38.4, 48.5, 72.02, 28.4, 43.4, 96.9, 51.4, 144.0])) == 5


def ribbed_rod(seed, notch_deg):
    """Half a rod with collars, as seen from above along x, with a notch about an angle where one is given."""
    rng = np.random.default_rng(seed)
    x, turn = rng.uniform(-60, 60, 30_000), rng.uniform(-1.2, 1.2, 30_000)
    radius = 16 + 5 * (np.abs(x - 20) < 8) + 0.05 * np.maximum(-x, 0) + rng.normal(0, 0.03, len(x))
    if notch_deg is not None:
        radius -= 4.0 * ((np.abs(turn - np.radians(notch_deg)) < 0.2) & (np.abs(x + 30) < 12))
    return np.column_stack([x, radius * np.sin(turn), 400 - radius * np.cos(turn)])


def test_a_round_part_without_its_mark_in_both_scans_is_refused():
    """What the scans overlap must not choose the turn: with no mark any turn fits."""
    with pytest.raises(AmbiguousError):
        register(ribbed_rod(0, None), ribbed_rod(1, None), RegisterOptions(seed=0))


def test_what_no_longer_overlaps_is_no_rival_along_a_free_motion():
    source, target = (ribbed_rod(seed, 10.0) for seed in (0, 1))
    test, sample = prepare_pair(source, target, (np.zeros(3), np.zeros(3)))
    judge = PoseJudge(test, sample, np.random.default_rng(0), 4000)
    near = judge.refined(np.eye(4))
    assert near is not None
    best = judge.at_rest(near)
    assert best is not None
    information = np.diag([1.0, 1, 1, 1e-9, 900, 900])
    free = replace(best, found=replace(best.found, information=information, centre_mm=np.array([0, 0, 400.0])))
    slid = rivals._slid(judge, free)
    assert slid
    assert all(judge.evidence(one.pose).met > rivals.OVERLAPS * judge.evidence(best.pose).met for one in slid)
    assert max(np.degrees(angle_between(one.pose, best.pose)) for one in slid) < 90
