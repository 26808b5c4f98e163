"""The calibration experiment: the measured spheres are where the truth says, the fast way agrees with the full one."""

from dataclasses import replace

import numpy as np
import pytest

from grindvision import cell, paper
from grindvision.arm import joint_transforms
from grindvision.cell import ScannerErrors, spheres
from grindvision.cell.arms import JOINT_LIMITS_RAD
from grindvision.cell.joint_errors import GRAVITY
from grindvision.cell.spheres import nest_directions
from grindvision.errors import DegenerateError, InputError, SightError
from grindvision.geometry import inverse, move_points, vector_angle

Q = np.radians([-51.06, -75.62, 18.29, -5.30])


@pytest.fixture(scope="module")
def robot():
    return cell.GrindingRobot()


@pytest.fixture(scope="module")
def experiment(robot):
    return cell.calibration_experiment(np.random.default_rng(3), robot=robot, every=None)


def in_front(robot, place):
    return move_points(robot.exact_poses(Q), np.array(place, dtype=float))


def test_truth_is_nominal_plus_printed_table_2(robot):
    np.testing.assert_allclose(robot.true.table - robot.nominal.table, paper.mdh_corrections(), atol=1e-12)
    assert robot.nominal.n == 4
    np.testing.assert_allclose(robot.T_joint4_scanner, paper.hand_eye("accurate"))


@pytest.mark.parametrize("place", [(0, 0, 400), (50, 30, 380)])
def test_sphere_is_located_without_errors(robot, place):
    exact = replace(robot, scanner=robot.scanner.with_errors(ScannerErrors()), joint_noise_deg=0.0)
    found = cell.measure_sphere(exact, Q, in_front(robot, place), np.random.default_rng(0), every=2)
    np.testing.assert_allclose(found.centre_mm, place, atol=1e-3)
    np.testing.assert_allclose(found.T_base_scanner, robot.exact_poses(Q), atol=1e-9)


def test_nest_is_cut_away(robot):
    rng = np.random.default_rng(0)
    scan = cell.scan_sphere(robot, Q, in_front(robot, (0, 0, 400)), rng, every=2)
    found = cell.measure_sphere(robot, Q, in_front(robot, (0, 0, 400)), rng, every=2)
    assert scan.on("nest").sum() > 300
    assert found.fit.inliers.sum() < 1.02 * scan.on("sphere").sum()
    assert np.linalg.norm(found.centre_mm - [0, 0, 400]) < 0.3


def test_fast_centre_errors_agree_with_the_full_way(robot):
    down = nest_directions([robot.exact_poses(Q)])
    sources = robot.scanner.errors
    bent = replace(robot, scanner=robot.scanner.with_errors(sources.only("distortion_mm", "scale")), joint_noise_deg=0)
    noisy_sources = sources.only("white_mm", "triangulation_px", "correlated_px", "shadow", "grazing_deg")
    noisy = replace(robot, scanner=robot.scanner.with_errors(noisy_sources), joint_noise_deg=0)
    for place in ((0.0, 0.0, 400.0), (-60.0, -40.0, 430.0)):
        rng = np.random.default_rng(1)
        full = cell.measure_sphere(bent, Q, in_front(robot, place), rng, every=2).centre_mm - place
        fast = cell.sphere_centre_errors(bent.scanner, [place], down, rng)[0]
        np.testing.assert_allclose(fast, full, atol=2e-3)
        fulls = [cell.measure_sphere(noisy, Q, in_front(robot, place), rng).centre_mm - place for _ in range(12)]
        fasts = [cell.sphere_centre_errors(noisy.scanner, [place], down, rng)[0] for _ in range(200)]
        assert 0.5 < np.linalg.norm(np.std(fulls, axis=0)) / np.linalg.norm(np.std(fasts, axis=0)) < 2.0


def test_layout_is_the_papers(experiment):
    table, plan = experiment.table, experiment.plan
    assert list(table.columns[:2]) == ["pose", "sphere"] and table.columns[-1] == "split"
    assert (table["split"] == "train").sum() == 54 and (table["split"] == "test").sum() == 60
    assert table.groupby("sphere").size().eq(6).all()
    train = plan.centres_mm[:9, 2]
    assert len(np.unique(train)) == 3
    assert set(np.round(plan.centres_mm[9:, 2])) == {-50.0, 50.0}


def test_poses_are_reachable_see_the_sphere_in_range_and_differ(experiment):
    low, high = JOINT_LIMITS_RAD.T
    q = experiment.plan.q_rad
    assert (q >= low).all() and (q <= high).all()
    poses = experiment.robot.exact_poses(q)
    seen = np.array([move_points(inverse(T), c) for T, c in zip(poses, experiment.centres_base_mm, strict=True)])
    assert (seen[:, 2] > 350).all() and (seen[:, 2] < 450).all()
    views = poses[:6, :3, 2]
    assert np.degrees(vector_angle(views[1:], views[0])).min() > 5


def test_measurements_fit_the_truth(experiment):
    scanned = experiment.table[["sx_mm", "sy_mm", "sz_mm"]].to_numpy()
    back = [move_points(T, s) for T, s in zip(experiment.T_base_scanner, scanned, strict=True)]
    off = np.linalg.norm(np.array(back) - experiment.centres_base_mm, axis=1)
    assert 0.01 < off.mean() < 0.2
    tracked = experiment.table[["bx_mm", "by_mm", "bz_mm"]].to_numpy()
    expected = move_points(experiment.tracker.T_tracker_base, experiment.centres_base_mm)
    assert np.abs(tracked - expected).max() < 0.06
    assert np.abs(tracked - experiment.centres_base_mm).max() > 0.05


def test_full_and_fast_experiments_have_errors_of_one_size(robot):
    plan = cell.calibration_plan(robot, np.random.default_rng(0), spheres=2, test_spheres=0)
    tracker = cell.misaligned_tracker(np.random.default_rng(0))
    sizes = []
    for every in (3, None):
        done = cell.measured(plan, robot, tracker, np.random.default_rng(1), every)
        scanned = done.table[["sx_mm", "sy_mm", "sz_mm"]].to_numpy()
        true = [move_points(inverse(T), c) for T, c in zip(done.T_base_scanner, done.centres_base_mm, strict=True)]
        sizes.append(scanned - true)
    assert np.abs(sizes[0] - sizes[1]).max() < 0.05


def test_spheres_out_of_sight_are_named(robot):
    rng = np.random.default_rng(0)
    with pytest.raises(SightError, match="in front of the scanner"):
        cell.measure_sphere(robot, Q, in_front(robot, (0, 0, -100)), rng)
    with pytest.raises(SightError, match="outside the image"):
        cell.measure_sphere(robot, Q, in_front(robot, (400, 0, 400)), rng)
    with pytest.raises(SightError, match="measuring range"):
        cell.measure_sphere(robot, Q, in_front(robot, (0, 0, 600)), rng)
    with pytest.raises(SightError, match="nearer to the arm"):
        cell.directions_seeing(robot, [3000.0, 0, 0], 6, rng)
    with pytest.raises(InputError, match="directions is 0"):
        cell.calibration_plan(robot, rng, directions=0)


@pytest.mark.parametrize("metres", [0.0, 5.0, 20.0])
def test_the_tracker_is_as_noisy_as_its_maker_says_at_every_distance(metres):
    tracker = cell.LaserTracker(np.eye(4))
    points = np.tile(tracker.station_mm + [0, 0, 1000 * metres], (20_000, 1))
    errors_um = 1000 * (tracker.measure(points, np.random.default_rng(1)) - points)
    np.testing.assert_allclose(errors_um.std(axis=0), 5.0 + 2.0 * metres, rtol=0.03)


def test_gravity_turns_joints_by_the_slope_of_the_potential_energy(rng):
    errors = cell.drawn_joint_errors(cell.nominal_arm(), rng)
    q = rng.uniform(-2, 2, 4)

    def energy(at):
        frames = joint_transforms(errors.arm, at)[1:]
        places = np.einsum("kij,kj->ki", frames[:, :3, :3], errors.centres_mm) + frames[:, :3, 3]
        return -GRAVITY * errors.masses_kg @ (places @ errors.down) / 1000

    slopes = [(energy(q - 1e-6 * axis) - energy(q + 1e-6 * axis)) / 2e-6 for axis in np.eye(4)]
    np.testing.assert_allclose(errors.torques_nm(q), slopes, atol=1e-6)
    assert abs(errors.torques_nm(q)[0]) < 1e-9  # about the upright axis there is none


def test_gear_waves_repeat_with_every_turn_and_the_papers_twin_has_none(rng, robot):
    errors = cell.drawn_joint_errors(robot.true, rng, sag_deg=0.0)
    q = rng.uniform(-1, 1, 4)
    np.testing.assert_allclose(errors.applied(q + 2 * np.pi) - errors.applied(q), 2 * np.pi, atol=1e-12)
    assert 0 < np.abs(errors.applied(q) - q).max() < np.radians(0.2)
    wavy = replace(robot, joint_errors=errors)
    np.testing.assert_allclose(wavy.exact_poses(q), robot.exact_poses(errors.applied(q)), atol=1e-12)
    assert robot.joint_errors is None
    with pytest.raises(InputError, match="masses_kg"):
        replace(errors, masses_kg=np.ones(3))


@pytest.mark.parametrize("seen", [49, 50])
def test_a_sphere_needs_fifty_points(robot, monkeypatch, seen):
    class Seen(list):
        T_world_scanner = np.eye(4)
        points = property(np.array)

    turn = np.arange(seen) * 2.4  # spread over the half of the sphere that the scanner sees
    down = (np.arange(seen) + 0.5) / seen
    cap = np.column_stack([np.sqrt(1 - down**2) * np.cos(turn), np.sqrt(1 - down**2) * np.sin(turn), -down])
    scan = Seen(np.array([5.0, -3.0, 400.0]) + spheres.SPHERE_RADIUS_MM * cap)
    monkeypatch.setattr(spheres, "scan_sphere", lambda *_: scan)
    if seen < 50:
        with pytest.raises(DegenerateError, match="only 49 points of the sphere were seen"):
            cell.measure_sphere(robot, Q, np.zeros(3), np.random.default_rng(0))
    else:
        found = cell.measure_sphere(robot, Q, np.zeros(3), np.random.default_rng(0))
        np.testing.assert_allclose(found.centre_mm, [5, -3, 400], atol=1e-6)
