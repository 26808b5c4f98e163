"""Laws of the rigid, plane and sphere fits: known truth found within the stated covariance, invariance, bad input."""

import numpy as np
import pytest

from grindvision import geometry
from grindvision.errors import DegenerateError, InputError
from grindvision.geometry.ransac import ransac_plane, ransac_sphere


def cap(rng, count=150, opening_rad=1.0, radius_mm=19.0, noise_mm=0.0, centre=(30.0, -20.0, 400.0)):
    """Points on the part of a sphere that looks towards -z."""
    cosines, turn = rng.uniform(np.cos(opening_rad), 1, count), rng.uniform(0, 2 * np.pi, count)
    sines = np.sqrt(1 - cosines**2)
    rays = np.column_stack([sines * np.cos(turn), sines * np.sin(turn), -cosines])
    return np.array(centre) + radius_mm * rays + noise_mm * rng.standard_normal((count, 3))


def patch(rng, T_world_plane, count=100, noise_mm=0.0):
    """Points of a 60 x 20 mm patch in the xy plane of a frame."""
    local = np.column_stack(
        [rng.uniform(-30, 30, count), rng.uniform(-10, 10, count), noise_mm * rng.standard_normal(count)]
    )
    return geometry.move_points(T_world_plane, local)


@pytest.fixture
def pose(rng):
    return geometry.rigid(geometry.random_rotation(rng), rng.uniform(-300, 300, 3))


def test_a_rigid_motion_is_found_and_the_order_of_points_does_not_matter(pose, rng):
    source = rng.uniform(-50, 50, (20, 3))
    target = geometry.move_points(pose, source) + 0.1 * rng.standard_normal(source.shape)
    fit, order = geometry.fit_rigid(source, target), rng.permutation(20)
    assert geometry.angle_between(fit.T_target_source, pose) < 0.005
    assert fit.residuals_mm == pytest.approx(target - geometry.move_points(fit.T_target_source, source))
    assert fit.rms_mm == pytest.approx(np.sqrt((fit.residuals_mm**2).sum(axis=1).mean()))
    assert geometry.fit_rigid(source[order], target[order]).T_target_source == pytest.approx(fit.T_target_source)


def test_the_rigid_fit_moves_with_either_frame_and_scales_with_the_unit(pose, rng):
    source, other = rng.uniform(-50, 50, (12, 3)), geometry.rigid(geometry.random_rotation(rng), [5.0, 6.0, 7.0])
    target = geometry.move_points(pose, source) + rng.standard_normal(source.shape)
    T = geometry.fit_rigid(source, target).T_target_source
    moved = geometry.fit_rigid(geometry.move_points(other, source), geometry.move_points(pose, target)).T_target_source
    assert moved == pytest.approx(pose @ T @ geometry.inverse(other), abs=1e-8)
    metres = geometry.fit_rigid(source / 1000, target / 1000)
    assert metres.T_target_source[:3, :3] == pytest.approx(T[:3, :3], abs=1e-9)
    assert 1000 * metres.T_target_source[:3, 3] == pytest.approx(T[:3, 3])


def test_the_rigid_fit_is_never_a_reflection_and_beats_its_neighbours(rng):
    source = rng.uniform(-50, 50, (8, 3))
    fit = geometry.fit_rigid(source, source * [1, 1, -1])
    assert np.linalg.det(fit.T_target_source[:3, :3]) == pytest.approx(1)
    for _ in range(20):
        near = geometry.small_motion(0.01 * rng.standard_normal(6)) @ fit.T_target_source
        off = source * [1, 1, -1] - geometry.move_points(near, source)
        assert np.sqrt((off**2).sum(axis=1).mean()) >= fit.rms_mm


def test_a_weight_of_zero_leaves_the_pair_out(pose, rng):
    source = rng.uniform(-50, 50, (9, 3))
    target = geometry.move_points(pose, source) + rng.standard_normal(source.shape)
    weights = np.ones(9)
    weights[[2, 5]] = 0
    weighted = geometry.fit_rigid(source, target, weights)
    kept = geometry.fit_rigid(source[weights > 0], target[weights > 0])
    assert weighted.T_target_source == pytest.approx(kept.T_target_source)
    assert weighted.rms_mm == pytest.approx(kept.rms_mm)


def test_the_plane_is_found_and_its_covariance_covers_the_truth(rng):
    noise_mm, squared = 0.05, []
    for _ in range(250):
        pose = geometry.rigid(geometry.random_rotation(rng), rng.uniform(-300, 300, 3))
        fit = geometry.fit_plane(patch(rng, pose, noise_mm=noise_mm))
        true_normal = pose[:3, 2] * np.sign(pose[:3, 2] @ fit.normal)
        turn = np.cross(true_normal, fit.normal)
        lift = (fit.centre_mm - pose[:3, 3]) @ true_normal
        error = np.array([*(fit.axes @ turn), lift])
        squared.append(error @ np.linalg.solve(fit.covariance, error))
    assert np.mean(squared) == pytest.approx(3, abs=0.6)
    assert np.mean(np.array(squared) < 7.815) > 0.9  # 95 % of chi-squared with three degrees of freedom


def test_plane_distances_are_signed_and_unchanged_by_moving_the_world(pose, rng):
    points = patch(rng, pose, noise_mm=0.2)
    fit = geometry.fit_plane(points)
    assert fit.distance(fit.centre_mm + 2.5 * fit.normal) == pytest.approx(2.5)
    assert fit.rms_mm == pytest.approx(np.sqrt(np.mean(fit.distance(points) ** 2)))
    elsewhere = geometry.fit_plane(geometry.move_points(pose, points)[rng.permutation(len(points))])
    assert elsewhere.rms_mm == pytest.approx(fit.rms_mm)
    assert geometry.fit_plane(points / 1000).rms_mm == pytest.approx(fit.rms_mm / 1000)


@pytest.mark.parametrize("opening_rad", [0.6, 1.4])
@pytest.mark.parametrize("radius_mm", [None, 19.0])
def test_the_sphere_is_found_and_its_covariance_covers_the_truth(rng, opening_rad, radius_mm):
    truth, squared = np.array([30.0, -20.0, 400.0]), []
    for _ in range(200):
        fit = geometry.fit_sphere(cap(rng, opening_rad=opening_rad, noise_mm=0.03), radius_mm)
        error = fit.centre_mm - truth
        squared.append(error @ np.linalg.solve(fit.centre_covariance, error))
    assert np.mean(squared) == pytest.approx(3, abs=0.7)
    assert np.mean(np.array(squared) < 7.815) > 0.89


def test_a_small_cap_is_uncertain_along_its_axis_and_a_known_radius_helps(rng):
    points = cap(rng, opening_rad=0.5, noise_mm=0.03)
    free, fixed = geometry.fit_sphere(points), geometry.fit_sphere(points, 19.0)
    assert free.centre_covariance[2, 2] > 10 * free.centre_covariance[0, 0]
    assert fixed.centre_covariance[2, 2] < 0.05 * free.centre_covariance[2, 2]
    assert fixed.radius_mm == 19.0


def test_the_sphere_does_not_depend_on_order_place_or_unit(pose, rng):
    points = cap(rng, noise_mm=0.05)
    fit = geometry.fit_sphere(points)
    moved = geometry.fit_sphere(geometry.move_points(pose, points)[::-1])
    assert moved.centre_mm == pytest.approx(geometry.move_points(pose, fit.centre_mm), abs=1e-6)
    assert geometry.fit_sphere(points / 1000).centre_mm * 1000 == pytest.approx(fit.centre_mm, abs=1e-5)
    assert fit.distance(fit.centre_mm + np.diag([0, 0, fit.radius_mm + 1])[2:]) == pytest.approx(1)


def test_ransac_finds_plane_and_sphere_among_outliers_and_repeats_with_its_seed(pose, rng):
    clutter = np.add(rng.uniform(-40, 40, (120, 3)), [30.0, -20.0, 400.0])
    ball = np.vstack([cap(rng, noise_mm=0.03), clutter])
    found = ransac_sphere(ball, 0.15, np.random.default_rng(1), radius_mm=19.0)
    assert found.centre_mm == pytest.approx([30.0, -20.0, 400.0], abs=0.1)
    assert found.inliers[:150].mean() > 0.98
    again = ransac_sphere(ball, 0.15, np.random.default_rng(1), radius_mm=19.0)
    assert again.centre_mm.tolist() == found.centre_mm.tolist()
    sheet = np.vstack([patch(rng, pose, noise_mm=0.02), geometry.move_points(pose, rng.uniform(-40, 40, (80, 3)))])
    plane = ransac_plane(sheet, 0.1, np.random.default_rng(1))
    assert np.abs(plane.normal @ pose[:3, 2]) > 1 - 1e-5
    assert plane.inliers[:100].mean() > 0.98


def plain_consensus(points, size, distances, threshold_mm, rng, iterations=500):
    """RANSAC as a textbook has it: ``distances(sample)`` gives those of all points, None where there is no shape."""
    scored = points if len(points) <= 4000 else points[rng.choice(len(points), 4000, replace=False)]
    best, shape = 0, None
    for trial in range(1, iterations + 1):
        found = distances(points[rng.choice(len(points), size, replace=False)])
        if found is None:
            continue
        count = (found(scored) <= threshold_mm).sum()
        if count > best:
            best, shape = count, found
        if best and (1 - (best / len(scored)) ** size) ** trial < 1e-6:
            break
    assert shape is not None
    return shape(points) <= threshold_mm


def plain_plane(sample):
    normal = np.cross(sample[1] - sample[0], sample[2] - sample[0])
    return lambda points: np.abs((points - sample[0]) @ normal) / np.linalg.norm(normal)


def plain_sphere(radius_mm):
    def through(sample):
        squares = (sample[1:] ** 2).sum(axis=1) - (sample[0] ** 2).sum()
        centre = np.linalg.solve(2 * (sample[1:] - sample[0]), squares)
        radius = np.linalg.norm(sample[0] - centre)
        if radius_mm is not None and abs(radius - radius_mm) > 0.2 * radius_mm:
            return None
        return lambda points: np.abs(np.linalg.norm(points - centre, axis=1) - (radius_mm or radius))

    return through


@pytest.mark.parametrize("count", [150, 6000])
@pytest.mark.parametrize("radius_mm", [None, 19.0])
def test_compiled_ransac_answers_as_the_plain_one_and_leaves_the_generator_where_it_does(count, radius_mm, pose, rng):
    for seed in range(5):
        clutter = rng.uniform(-40, 40, (count // 2, 3))
        ball = np.vstack([cap(rng, count, noise_mm=0.05), clutter + [30.0, -20.0, 400.0]])
        sheet = np.vstack([patch(rng, pose, count, noise_mm=0.05), geometry.move_points(pose, clutter)])
        ours, plain = np.random.default_rng(seed), np.random.default_rng(seed)
        inliers = plain_consensus(ball, 4, plain_sphere(radius_mm), 0.15, plain)
        for _ in range(3):
            fit = geometry.fit_sphere(ball[inliers], radius_mm)
            inliers = np.abs(fit.distance(ball)) <= 0.15
        sphere = ransac_sphere(ball, 0.15, ours, radius_mm)
        assert (sphere.inliers == inliers).all() and ours.random() == plain.random()
        inliers = plain_consensus(sheet, 3, plain_plane, 0.15, plain)
        plane = ransac_plane(sheet, 0.15, ours)
        assert (plane.inliers == (np.abs(geometry.fit_plane(sheet[inliers]).distance(sheet)) <= 0.15)).all()
        assert ours.random() == plain.random()


LINE = np.outer(np.arange(5.0), [1.0, 2.0, 3.0])
CIRCLE = np.column_stack([np.cos(np.arange(9.0)), np.sin(np.arange(9.0)), np.zeros(9)])
REFUSED = {
    "rigid, one point": (lambda: geometry.fit_rigid([[1, 2, 3]], [[1, 2, 3]]), DegenerateError, "at least 3"),
    "rigid, line": (lambda: geometry.fit_rigid(LINE, LINE), DegenerateError, "one line"),
    "rigid, unpaired": (lambda: geometry.fit_rigid(CIRCLE, CIRCLE[:5]), InputError, "in pairs"),
    "rigid, weights": (lambda: geometry.fit_rigid(CIRCLE, CIRCLE, -np.ones(9)), InputError, "non-negative"),
    "rigid, a weight": (lambda: geometry.fit_rigid(CIRCLE, CIRCLE, [np.nan] + 8 * [1.0]), InputError, "non-negative"),
    "plane, line": (lambda: geometry.fit_plane(LINE + 1000), DegenerateError, "one line"),
    "plane, NaN": (lambda: geometry.fit_plane([[0, 0, np.nan], *LINE]), InputError, "1 of 6 points hold NaN"),
    "plane, flat array": (lambda: geometry.fit_plane([1.0, 2.0, 3.0]), InputError, r"expected \(N, 3\)"),
    "plane, text": (lambda: geometry.fit_plane([["a", "b", "c"]] * 4), InputError, "not numbers"),
    "sphere, circle": (lambda: geometry.fit_sphere(CIRCLE), DegenerateError, "one plane"),
    "sphere, few": (lambda: geometry.fit_sphere(CIRCLE[:3]), DegenerateError, "at least 4"),
    "ransac, threshold": (
        lambda: ransac_plane(CIRCLE, 0.0, np.random.default_rng(0)),
        InputError,
        "above zero",
    ),
    "ransac, nothing there": (
        lambda: ransac_sphere(CIRCLE, 0.1, np.random.default_rng(0)),
        DegenerateError,
        "no model found",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_data_that_do_not_determine_the_answer_are_refused(case):
    call, error, reason = REFUSED[case]
    with pytest.raises(error, match=reason):
        call()


@pytest.mark.parametrize("size_mm", [1e-3, 1.0, 1e3, 1e6])
def test_a_thin_needle_is_fitted_and_a_line_refused_at_every_scale(rng, size_mm):
    along = np.linspace(-1, 1, 12)
    needle = size_mm * np.column_stack([along, 1e-4 * rng.normal(size=12), 1e-4 * rng.normal(size=12)])
    turn = geometry.rigid(geometry.random_rotation(rng), size_mm * rng.normal(size=3))
    fit = geometry.fit_rigid(needle, geometry.move_points(turn, needle))
    np.testing.assert_allclose(fit.residuals_mm, 0, atol=1e-12 * size_mm)
    np.testing.assert_allclose(fit.T_target_source[:3, :3], turn[:3, :3], atol=1e-9)
    line = size_mm * np.outer(along, rng.normal(size=3))
    with pytest.raises(DegenerateError, match="one line"):
        geometry.fit_rigid(line, geometry.move_points(turn, line))


def test_a_line_is_refused_however_far_away_and_a_plane_is_fitted(rng):
    """Far away, rounding alone gives a line some width."""
    line = np.outer(np.linspace(-1, 1, 12), [2.0, -1.0, 0.5]) + [1e9, 0.0, 0.0]
    with pytest.raises(DegenerateError, match="source points lie on one line"):
        geometry.fit_rigid(line, rng.normal(size=(12, 3)))
    for there in (line, 1e-3 * line, 1e-9 * line):
        with pytest.raises(DegenerateError, match="one line"):
            geometry.fit_plane(there)
    plane = np.column_stack([rng.uniform(-50, 50, (12, 2)), np.zeros(12)])
    turn = geometry.rigid(geometry.random_rotation(rng), [10.0, 20.0, 30.0])
    found = geometry.fit_rigid(plane, geometry.move_points(turn, plane))
    np.testing.assert_allclose(found.T_target_source, turn, atol=1e-9)
    assert abs(geometry.fit_plane(plane).normal[2]) == pytest.approx(1.0)
