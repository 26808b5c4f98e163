"""Poses that the likeliest few proposals miss, marks that few surfels show, and parts whose ends alone say where they
lie."""

from dataclasses import replace

import numpy as np
import pytest

from grindvision.errors import AmbiguousError, DegenerateError
from grindvision.geometry import angle_between, inverse, move_points, rigid, rotation_about
from grindvision.vision.registration import rivals, verification
from grindvision.vision.registration.icp import FineRegistration
from grindvision.vision.registration.pose_candidates import UNLIKE_RAD, Candidate, PoseJudge, unlike_poses
from grindvision.vision.registration.verification import choose_pose
from grindvision.vision.surface.model_surface import model_surface, whole_scan
from grindvision.vision.surface.scan import choose_resolution, prepare_pair, prepare_scan
from tests.box_scenes import STEPPED, looking_at, scan_of

ANGLE_BAR = (((0, 0, 0), (90, 30, 4)), ((0, 0, 0), (90, 4, 18)))


@pytest.fixture(scope="module")
def stepped():
    """Two scans of a stepped block from 40 degrees apart, made ready, the true pose, the angle, and half a turn about
    the block's z in the frame of the source."""
    rng = np.random.default_rng(3)
    views = [looking_at((0, 0, 8), 0.6, azimuth, roll_rad=roll) for azimuth, roll in ((0.5, 0.2), (1.8, -0.9))]
    source, target = (scan_of(STEPPED, pose, 0.9, rng) for pose in views)
    ways = [pose[:3, 3] - [0, 0, 8] for pose in views]
    angle = np.arccos(ways[0] @ ways[1] / np.prod([np.linalg.norm(way) for way in ways]))
    up = views[0][:3, :3].T @ [0, 0, 1.0]
    half_turn = rotation_about(up, np.pi)
    return *prepare_pair(source, target, (np.zeros(3), np.zeros(3))), inverse(views[1]) @ views[0], angle, half_turn


@pytest.fixture
def judge(stepped):
    return PoseJudge(stepped[0], stepped[1], np.random.default_rng(0), 4000)


def turned(true, scan, rotation):
    middle = scan.points.mean(axis=0)
    return true @ rigid(None, middle) @ rigid(rotation) @ rigid(None, -middle)


def away_mm(pose, true, scan):
    return float(np.linalg.norm(move_points(pose, scan.points) - move_points(true, scan.points), axis=1).max())


def test_of_the_proposals_that_were_not_tried_those_turned_from_all_that_were_are(judge, stepped):
    source, _, true, _, half_turn = stepped
    known = judge.refined(turned(true, source, half_turn))
    near = [turned(true, source, rotation_about((1.0, 0.3, 0), angle)) for angle in (0.05, 0.0, 0.1)]
    asked = np.stack([known.pose, *near])
    found = unlike_poses(judge, asked, [known])
    assert len(found) == 1
    assert angle_between(found[0], known.pose) > UNLIKE_RAD
    np.testing.assert_array_equal(found[0], near[1])  # of poses that are alike the one at which most meets
    assert len(unlike_poses(judge, asked, [known, Candidate(replace(known.found, T_target_source=true), 0.0)])) == 0


def test_before_a_refusal_faces_are_laid_on_faces_even_where_a_wrong_pose_looked_certain(stepped, monkeypatch):
    source, target, true, _, half_turn = stepped
    wrong = turned(true, source, half_turn)[None]
    monkeypatch.setattr(PoseJudge, "is_uncertain", lambda judge, best: False)
    monkeypatch.setattr(verification, "with_rivals", lambda judge, best, known: list(known))
    with pytest.raises(DegenerateError):
        choose_pose(source, target, wrong, np.random.default_rng(1), insist=False)
    found = choose_pose(source, target, wrong, np.random.default_rng(1))
    assert away_mm(found.registration.T_target_source, true, source) < 0.5


def test_many_rivals_are_told_apart_by_all_samples_before_the_best_few_come_to_rest(judge, stepped, monkeypatch):
    """By the first samples the true pose is the worst of all: they hold the bead and not the mark."""
    source, _, true, _, half_turn = stepped
    best = judge.refined(turned(true, source, half_turn))
    many = [
        Candidate(replace(best.found, T_target_source=turned(true, source, rotation_about((0, 0, 1.0), k))), 0.001 * k)
        for k in np.linspace(0.3, 2.8, 9)
    ]
    many.append(Candidate(replace(best.found, T_target_source=true), 0.01))
    monkeypatch.setattr(rivals, "_turned", lambda judge, best, near: [])
    monkeypatch.setattr(rivals, "_repeated", lambda judge, best, near: [])
    given = iter([many])
    monkeypatch.setattr(judge, "refined_all", lambda poses, free=False, far=False: next(given, []))
    rested = []

    def at_rest(candidates, kept):
        rested.extend(candidates)
        return []

    monkeypatch.setattr(judge, "settled", at_rest)
    rivals.with_rivals(judge, replace(best, cost=0.0), [best])
    assert min(rested, key=lambda one: one.cost).pose is many[-1].pose


def test_the_angle_of_sight_at_the_true_pose_is_that_between_the_scanners(judge, stepped):
    assert abs(judge.angle_of_sight(stepped[2]) - stepped[3]) < np.radians(2)


def test_where_the_views_coincide_a_smaller_misfit_says_little_and_contradictions_as_much(judge, stepped, monkeypatch):
    source, _, true, _, half_turn = stepped
    best = judge.refined(true)
    rival = judge.refined(turned(true, source, half_turn))
    angles = {best.pose.tobytes(): 0.5, rival.pose.tobytes(): 0.5}
    monkeypatch.setattr(judge, "angle_of_sight", lambda pose: angles[pose.tobytes()])
    whole = verification._log_ratios(judge, best, [rival])[0]
    angles[rival.pose.tobytes()] = 1.0
    nearer = verification._log_ratios(judge, best, [rival])[0]
    one, other = (judge.evidence(each.pose, None) for each in (best, rival))
    misfit = judge.surfels * (other.misfit_cost() - one.misfit_cost())
    assert misfit > 0
    assert abs(whole - nearer - (1 - verification.COUNTED) * misfit) < 1e-6
    angles[best.pose.tobytes()] = 1.0
    assert verification._log_ratios(judge, best, [rival])[0] == whole


def angle_bar():
    """Vertices and outward triangles of an angle bar along x, of unequal legs."""
    section = np.array([(0, 0), (30, 0), (30, 4), (4, 4), (4, 18), (0, 18)], dtype=float)
    ends = [np.column_stack([np.full(6, x), section]) for x in (0.0, 90.0)]
    triangles = []
    for k in range(6):
        a, b = k, (k + 1) % 6
        triangles += [(a, a + 6, b + 6), (a, b + 6, b)]
    for a, b in ((4, 5), (5, 0), (0, 1), (1, 2)):
        triangles += [(3, b, a), (9, a + 6, b + 6)]
    return np.concatenate(ends), np.array(triangles)[:, ::-1]


def placed(left=-1.0, right=91.0):
    """The angle bar's scan between two places along it, chosen on its model from beside; the true pose, and the
    scan."""
    view = looking_at((45, 12, 6), 0.5, 0.9)
    test = scan_of(ANGLE_BAR, view, 0.7, np.random.default_rng(0))
    along = move_points(view, test)[:, 0]
    test = test[(along > left) & (along < right)]
    resolution = choose_resolution(test)
    whole = whole_scan(model_surface(*angle_bar()), resolution)
    beside = rigid(None, [0.8, 0.5, -0.4]) @ view
    source = prepare_scan(test, resolution, np.zeros(3))
    return choose_pose(source, whole, beside[None], np.random.default_rng(0), insist=False), view, test


def test_a_bar_is_told_on_its_model_by_its_ends():
    found, view, test = placed()
    off = move_points(found.registration.T_target_source, test) - move_points(view, test)
    assert np.linalg.norm(off, axis=1).max() < 2.0
    assert found.confidence > 0.9


def test_a_bar_of_which_the_scan_shows_no_end_is_refused():
    with pytest.raises(AmbiguousError):
        placed(20.0, 70.0)


def test_poses_along_a_free_motion_are_refuted_only_where_each_is_clearly_worse():
    found = FineRegistration(np.eye(4), 0.1, 1.0, 1, True, np.zeros(3), np.eye(6), np.eye(6), np.zeros(1))
    free, other = (Candidate(found, 0.0, free) for free in (True, False))
    assert verification._is_refuted_along([free, other], [20.0, 1.0])
    assert not verification._is_refuted_along([free, free], [20.0, 5.0])
    assert not verification._is_refuted_along([other], [20.0])
