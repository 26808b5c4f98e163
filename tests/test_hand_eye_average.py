"""A hand-eye fit over kinds of errors: like the plain mixture, sigmas that hold, small changes that move it little."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from grindvision.arm import forward, read_arm
from grindvision.calibration.hand_eye import HandEyeOptions, hand_eye
from grindvision.calibration.hand_eye_average import ARM, CAMERA, DEPTH, LENGTHS_RAD, Linear, average
from grindvision.calibration.hand_eye_fit import FitOptions, fit, left_out_mm
from grindvision.data_files import data_folder
from grindvision.geometry import inverse, rigid
from tests.hand_eye_scene import TARGET, X, looking_poses, seen_poses


def a_fit(rng, n=7):
    """A linearised fit of made-up numbers in the shapes of a real one."""
    arm = np.concatenate([rng.normal(size=(n, 3, 3)) * 200, np.tile(np.eye(3), (n, 1, 1))], axis=1)
    axis = rng.normal(size=(n, 3))
    white = np.stack([np.tile(np.eye(3), (n, 1, 1)), axis[:, :, None] * axis[:, None] / (axis**2).sum()])
    apart = np.abs(np.subtract.outer(*[np.linspace(0, 0.8, n)] * 2))
    scale = np.repeat([1.0, 0.003], 3)
    rows, J = rng.normal(size=(n, 6)) * scale, rng.normal(size=(n, 6, 12)) * scale[:, None]
    return Linear(rows, J, arm, white, rng.uniform(0.5, 1, n), apart, 350.0)


def of_a_point(fit):
    """The same fit with the place alone, whose least squares is stated."""
    J, n = fit.J[:, :3, :9], len(fit.rows)
    return replace(
        fit,
        rows=fit.rows[:, :3],
        J=J,
        arm=fit.arm[:, :3],
        weights=np.ones(n),
        solution=np.linalg.pinv(J.reshape(-1, 9)).reshape(9, n, 3),
    )


def plainly(fit):
    """``average`` with the covariance of all residuals written out, kind by kind."""
    (n, size), unknowns = fit.rows.shape, fit.J.shape[2]
    root = np.sqrt(np.repeat(fit.weights, size))
    r, J = root * fit.rows.ravel(), root[:, None] * fit.J.reshape(-1, unknowns)
    freedom = size * fit.weights.sum() - unknowns
    logs, changes, covariances = [], [], []
    cameras = CAMERA / fit.lever_mm if size == 6 else [0.0]
    for length, depth, camera, arm in product(LENGTHS_RAD, DEPTH, cameras, ARM / fit.lever_mm):
        V = np.zeros((n, size, n, size))
        for i, j in product(range(n), repeat=2):
            like = float(i == j) if length == 0 else np.exp(-0.5 * (fit.apart_rad[i, j] / length) ** 2)
            if length > 0:
                like *= np.sqrt(fit.weights[i] * fit.weights[j])
            V[i, :, j] = arm**2 * like * fit.arm[i] @ fit.arm[j].T
            if i == j:
                V[i, :3, j, :3] += fit.white[0, i] + depth**2 * fit.white[1, i]
                V[i, 3:, j, 3:] += camera**2 * np.eye(size - 3)
        V = V.reshape(size * n, size * n)
        W = np.linalg.inv(V)
        C = np.linalg.inv(J.T @ W @ J)
        change = -C @ J.T @ W @ r
        left = (r + J @ change) @ W @ (r + J @ change)
        logs.append(0.5 * (np.linalg.slogdet(W)[1] + np.linalg.slogdet(C)[1] - freedom * np.log(left)))
        if fit.solution is not None:
            A = fit.solution.reshape(unknowns, -1)
            change, C = np.zeros(unknowns), A @ V @ A.T
        changes.append(change)
        covariances.append(C * left / (freedom - 2))
    p = np.exp(np.array(logs) - max(logs))
    p /= p.sum()
    mean = p @ np.array(changes)
    spread = np.array(changes) - mean
    return mean, np.einsum("g,gij->ij", p, covariances) + (p[:, None] * spread).T @ spread


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("point", [False, True])
def test_errors_as_unknowns_give_what_their_covariance_written_out_gives(seed, point):
    fit = a_fit(np.random.default_rng(seed))
    fit = of_a_point(fit) if point else fit
    found = average(fit)
    change, covariance = plainly(fit)
    sigma = np.sqrt(np.diag(covariance))
    assert np.abs((found.change - change) / sigma).max() < 1e-3
    assert np.abs(found.covariance - covariance).max() / np.abs(covariance).max() < 1e-3
    assert 0 <= found.shared <= 1


def small_motions(rng, n, mm, rad):
    turns = Rotation.from_rotvec(rad * rng.normal(size=(n, 3))).as_matrix()
    return np.array([rigid(turn, mm * rng.normal(size=3)) for turn in turns])


def independent(rng, n):
    """Poses shown and the target seen; every pose errs for itself."""
    poses = looking_poses(rng, n)
    true = poses @ small_motions(rng, n, rng.uniform(0.05, 0.5), np.radians(rng.uniform(0.02, 0.13)))
    return poses, true


def an_arm_with_wrong_zeros(rng, n):
    """Poses shown by an arm whose table is slightly wrong, turned about all joints, and those that are true.

    The last joint's own errors are left out: no data can tell them from the camera's place.
    """
    arm = read_arm(data_folder() / "robots" / "ur5e.csv")
    q = np.array([0.3, -1.3, 1.6, -1.9, -1.57, 0.4]) + rng.uniform(-1, 1, (n, 6)) * [0.15, 0.15, 0.2, 0.4, 0.4, 0.5]
    wrong = rng.normal(size=arm.table.shape) * [np.radians(0.04), 0.15, 0.15, np.radians(0.06), 0]
    wrong[-1, 2:4] = 0
    true = forward(arm.with_table(arm.table + wrong * rng.uniform(0.5, 1.5)), q)
    return forward(arm, q), true @ small_motions(rng, n, 0.02, np.radians(rng.uniform(0.003, 0.03)))


@pytest.mark.parametrize("kind", [pytest.param(independent, marks=pytest.mark.full), an_arm_with_wrong_zeros])
def test_stated_sigmas_hold_over_many_sequences(kind):
    off = []
    for seed in range(40):
        rng = np.random.default_rng([seed, 22])
        n = int(rng.integers(8, 15))
        shown, true = kind(rng, n)
        target = true[0] @ X @ rigid(None, [0, 0, 380.0])
        seen = inverse(true @ X) @ target @ small_motions(rng, n, rng.uniform(0.02, 0.15), np.radians(0.05))
        found = hand_eye(shown, seen)
        turn = Rotation.from_matrix(found.T_parent_camera[:3, :3] @ X[:3, :3].T).as_rotvec()
        change = np.concatenate([found.T_parent_camera[:3, 3] - X[:3, 3], turn])
        off.append(np.abs(change) / np.sqrt(np.diag(found.covariance)))
    in_sigmas = np.array(off)
    assert 0.58 <= (in_sigmas < 1).mean() <= 0.78
    assert (in_sigmas < 3).mean() >= 0.97


@pytest.mark.parametrize("mounted", ["on-arm", pytest.param("fixed", marks=pytest.mark.full)])
def test_stated_sigmas_of_a_sphere_hold_over_many_sequences(mounted):
    """Errors of the arm's rotation move the sphere over the lever to it: more than errors of the place alone would."""
    off = []
    for seed in range(60):
        rng = np.random.default_rng([seed, 24])
        n = int(rng.integers(8, 15))
        carrier = looking_poses(rng, n)
        shown = carrier if mounted == "on-arm" else inverse(carrier)
        true = shown @ small_motions(rng, n, rng.uniform(0.05, 0.5), np.radians(rng.uniform(0.02, 0.13)))
        truly = true if mounted == "on-arm" else inverse(true)
        seen = (inverse(truly @ X) @ rigid(None, TARGET))[:, :3, 3] + rng.uniform(0.02, 0.15) * rng.normal(size=(n, 3))
        found = hand_eye(shown, seen, HandEyeOptions(mounted))
        turn = Rotation.from_matrix(found.T_parent_camera[:3, :3] @ X[:3, :3].T).as_rotvec()
        change = np.concatenate([found.T_parent_camera[:3, 3] - X[:3, 3], turn])
        off.append(np.abs(change) / np.sqrt(np.diag(found.covariance)))
    in_sigmas = np.array(off)
    assert 0.6 <= (in_sigmas < 1).mean() <= 0.76
    assert (in_sigmas < 3).mean() >= 0.97


def test_small_changes_of_the_data_move_the_camera_by_a_part_of_its_sigma():
    for seed in range(12):
        rng = np.random.default_rng([seed, 23])
        poses = looking_poses(rng, 9)
        seen = seen_poses(poses, rng, arm_mm=0.5, arm_rad=np.radians(0.1))
        first = hand_eye(poses, seen)
        again = hand_eye(poses, seen @ small_motions(rng, 9, 0.02, np.radians(0.01)))
        moved = np.abs(again.T_parent_camera[:3, 3] - first.T_parent_camera[:3, 3]) / first.sigma_mm
        assert moved.max() < 0.5


@pytest.mark.parametrize("mounted", ["on-arm", "fixed"])
def test_the_frame_in_which_the_target_rests_changes_nothing(mounted):
    rng = np.random.default_rng(9)
    poses = looking_poses(rng, 9)
    seen = seen_poses(poses, rng, arm_mm=0.3, arm_rad=0.001)
    on_arm = mounted == "on-arm"  # the flange, where the arm's errors turn the target beside it, stays where it is
    moved = rigid(Rotation.from_rotvec([0.3, -0.5, 1.0]).as_matrix(), [100.0, 2000.0, -50.0] if on_arm else None)
    given, other = (poses, moved @ poses) if on_arm else (inverse(poses), inverse(moved @ poses))
    one, two = (hand_eye(these, seen, HandEyeOptions(mounted)) for these in (given, other))
    assert np.abs(one.T_parent_camera - two.T_parent_camera).max() < 1e-4 * np.linalg.norm(TARGET)
    assert np.abs(one.covariance - two.covariance).max() < 1e-3 * np.abs(one.covariance).max()


def test_a_pose_left_out_in_one_step_is_what_a_fit_without_it_gives():
    for seed, points in ((0, False), (1, True)):
        rng = np.random.default_rng([seed, 25])
        poses = looking_poses(rng, 9)
        seen = seen_poses(poses, rng, arm_mm=0.5, arm_rad=np.radians(0.1))
        seen = seen[:, :3, 3] if points else seen
        found = fit(poses, seen, X, FitOptions(noise=not points))
        stated = left_out_mm(poses, seen, found, True)
        for row in range(9):
            keep = np.where(np.arange(9) == row, 1e-9, found.weights)
            left = fit(poses, seen, found.X, FitOptions(iterations=20, keep=keep, sizes=found.sizes))
            assert stated[row] == pytest.approx(np.linalg.norm(left.place[row]), rel=0.03, abs=0.01)
