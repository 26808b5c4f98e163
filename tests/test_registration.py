"""SAC-IA, verification and ICP."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from grindvision.errors import DegenerateError, GrindvisionWarning, InputError
from grindvision.geometry import (
    angle_between,
    inverse,
    move_points,
    random_rotation,
    rigid,
    rotate_vectors,
    rotation_about,
    small_motion,
)
from grindvision.vision.change.detection import DetectOptions, detect
from grindvision.vision.registration import plane_icp, sac_ia
from grindvision.vision.registration.agreement import agreeing_fraction, agreement
from grindvision.vision.registration.deformable import refine_bent
from grindvision.vision.registration.global_registration import distinct_poses, propose_poses
from grindvision.vision.registration.icp import icp_generalised, icp_points
from grindvision.vision.registration.plane_icp import icp_planes, plane_residuals, solve_definite
from grindvision.vision.registration.sac_ia import huber, refine_pose, sac_ia_paper
from grindvision.vision.registration.scan_registration import register
from grindvision.vision.registration.verification import choose_pose
from grindvision.vision.surface.keypoints import Keypoints, most_similar
from grindvision.vision.surface.normals import orient_to_viewpoint
from grindvision.vision.surface.scan import choose_resolution, prepare_pair, prepare_scan, reversed_scan
from tests.grinding_scene import pair, plate_height, scan, view


def errors(T_found, T_true, at):
    """Rotation error in degrees and shift error in mm at a point."""
    shift = np.linalg.norm(move_points(T_found, at) - move_points(T_true, at))
    return float(np.degrees(angle_between(T_found, T_true))), float(shift)


@pytest.fixture(scope="module")
def easy():
    return pair(seed=1, n_points=30_000)


@pytest.fixture(scope="module")
def prepared(easy):
    return prepare_pair(easy.test, easy.sample)


@pytest.fixture(scope="module")
def close(easy):
    """A start some tenths of a millimetre off."""
    centre = move_points(easy.T_sample_test, easy.test.mean(axis=0))
    return (
        rigid(None, centre)
        @ small_motion([0.4, -0.3, 0.3, 0.004, -0.003, 0.005])
        @ rigid(None, -centre)
        @ easy.T_sample_test
    )


def test_huber_is_quadratic_then_linear_and_smooth():
    assert huber([0.5, -0.5], 1.0) == pytest.approx([0.125, 0.125])
    assert huber(3.0, 1.0) == pytest.approx(2.5)
    assert huber(1 + 1e-6, 1.0) - huber(1 - 1e-6, 1.0) == pytest.approx(2e-6, rel=1e-3)


def test_most_similar_is_the_plain_search(rng):
    a, b = rng.normal(size=(700, 33)), rng.normal(size=(900, 33))
    expected = np.argsort(((a[:, None] - b[None]) ** 2).sum(axis=2), axis=1)[:, :4]
    assert np.mean(most_similar(a, b, 4) == expected) > 0.999
    with pytest.raises(InputError):
        most_similar(a, b, 1000)


def test_sac_ia_as_in_the_paper_comes_near(easy):
    resolution = choose_resolution(easy.sample, voxels=600)
    sample, test = (prepare_scan(points, resolution) for points in (easy.sample, easy.test))
    found = sac_ia_paper(test.keypoints, sample.keypoints, np.random.default_rng(2), iterations=300)
    turn, shift = errors(found.T_target_source, easy.T_sample_test, easy.test.mean(axis=0))
    assert turn < 5
    assert shift < 5


def test_refinement_lowers_the_error_it_minimises(prepared, close):
    source, target = prepared
    tree = cKDTree(target.voxels.points)

    def error(transform):
        return huber(tree.query(move_points(transform, source.voxels.points))[0], 2.0).mean()

    start = close @ rigid(rotation_about((0, 0, 1), 0.01), (1.0, 0, 0))
    assert error(refine_pose(source.voxels.points, target.voxels.points, start, 2.0)) < 0.9 * error(start)


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.full) for seed in (2, 3))])
def test_any_start_leads_to_the_truth(easy, seed):
    T_other_test = rigid(random_rotation(np.random.default_rng(seed)), (10.0, 20.0, -30.0))
    moved = move_points(T_other_test, easy.test)
    viewpoint = T_other_test[:3, 3]
    found = detect(easy.sample, moved, DetectOptions(viewpoint_test_mm=viewpoint))
    turn, shift = errors(found.T_sample_test @ T_other_test, easy.T_sample_test, easy.test.mean(axis=0))
    assert turn < 0.05  # 0.016 rms over 24 pairs, 0.048 the largest
    assert shift < 0.03
    assert found.confidence > 0.9


def test_shallow_relief_and_partial_overlap_are_found():
    hard = pair(seed=5, n_points=60_000, relief=0.2, overlap=0.6)
    with pytest.warns(GrindvisionWarning, match="of the test scan .* was not compared"):
        found = detect(hard.sample, hard.test)
    turn, shift = errors(found.T_sample_test, hard.T_sample_test, hard.test.mean(axis=0))
    assert turn < 0.2
    assert shift < 0.3


@pytest.mark.parametrize("line_mm", [1.5, 3.0])
def test_a_profile_scanners_lines_meet_an_area_scan(easy, line_mm):
    at = np.round(easy.test[:, 0] / line_mm)
    lines = easy.test[np.abs(easy.test[:, 0] - at * line_mm) < 0.15]
    found = register(lines, easy.sample)
    turn, shift = errors(found.T_target_source, easy.T_sample_test, easy.test.mean(axis=0))
    assert turn < 0.2
    assert shift < 0.3


def test_cells_reach_across_gaps_and_stay_small_where_there_are_none(rng):
    plane = np.column_stack([rng.uniform(-60, 60, size=(20_000, 2)), np.zeros(20_000)])
    lines = plane * [1, 1, 1]
    lines[:, 1] = np.round(lines[:, 1] / 4) * 4
    sizes = [choose_resolution(points).surfel_mm for points in (plane, lines)]
    assert sizes[0] < 1.6
    assert 4 / 3 < sizes[1] < 4


def test_the_same_seed_gives_the_same_pose(easy):
    one, other = (detect(easy.sample, easy.test, DetectOptions(seed=7)) for _ in range(2))
    np.testing.assert_array_equal(one.T_sample_test, other.T_sample_test)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.full) for seed in (1, 2))])
def test_rounding_of_the_points_does_not_reach_the_result(easy, seed):
    rng = np.random.default_rng(seed)
    found = detect(easy.sample, easy.test)
    sample, test = (cloud + 1e-12 * rng.standard_normal(cloud.shape) for cloud in (easy.sample, easy.test))
    again = detect(sample, test)
    np.testing.assert_allclose(again.T_sample_test, found.T_sample_test, atol=1e-9)
    np.testing.assert_allclose(again.path_points, found.path_points, atol=1e-9)


def test_a_scan_turned_inside_out_is_turned_back(easy):
    middle = easy.sample.mean(axis=0)
    found = detect(easy.sample - middle, easy.test - easy.test.mean(axis=0))
    expected = rigid(None, -middle) @ easy.T_sample_test @ rigid(None, easy.test.mean(axis=0))
    assert errors(found.T_sample_test, expected, np.zeros(3))[0] < 0.05


def test_reversing_a_scan_twice_changes_nothing(prepared):
    twice = reversed_scan(reversed_scan(prepared[0]))
    np.testing.assert_array_equal(twice.keypoints.features, prepared[0].keypoints.features)
    np.testing.assert_array_equal(twice.surfels.normals, prepared[0].surfels.normals)


def bump(x, y, at, height=8.0, size=200.0):
    return height * np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / size)


FREE = {
    "plane": (lambda x, y: 0 * x, "translation"),
    "sphere": (lambda x, y: np.sqrt(80**2 - x**2 - y**2), "rotation"),
    "cylinder": (lambda x, y: np.sqrt(90**2 - x**2), "translation"),
    "two bumps": (lambda x, y: bump(x, y, (30, 0)) + bump(x, y, (-30, 0)), "rotation .here by 180 deg"),
    "square pocket": (
        lambda x, y: -6 / (1 + np.exp((np.maximum(abs(x), abs(y)) - 25) / 0.8)),
        "rotation .here by (90|180)",
    ),
}


@pytest.mark.parametrize("name", FREE)
def test_a_symmetric_part_is_refused_and_the_free_motion_named(name):
    surface, motion = FREE[name]

    def disc(x, y):
        return np.hypot(x, y) < 62

    window = (-65, 65, -65, 65)
    sample = scan(surface, view(0.3, (1.0, 0.4, 0.2)), 25_000, np.random.default_rng(1), window=window, mask=disc)
    test = scan(surface, view(-0.2, (0.3, 1.0, 0.5)), 25_000, np.random.default_rng(2), window=window, mask=disc)
    with pytest.raises(DegenerateError, match=f"ambiguous.*{motion}"):
        detect(sample, test)


def test_scans_that_do_not_overlap_are_refused():
    left = scan(plate_height, view(), 20_000, np.random.default_rng(1), window=(-100, -15, -70, 70))
    right = scan(plate_height, view(0.3), 20_000, np.random.default_rng(2), window=(15, 100, -70, 70))
    with pytest.raises(DegenerateError):
        detect(left, right)


def test_choose_pose_corrects_a_rough_guess_and_drops_wrong_ones(prepared, easy, close, rng):
    source, target = prepared
    centre = source.surfels.points.mean(axis=0)
    wrong = close @ rigid(None, centre) @ rigid(rotation_about((0, 0, 1), 2.0)) @ rigid(None, -centre)
    chosen = choose_pose(source, target, np.stack([wrong, close]), rng)
    assert errors(chosen.registration.T_target_source, easy.T_sample_test, centre)[0] < 0.1


def test_proposals_are_distinct_and_hold_the_truth(prepared, easy, rng):
    source, target = prepared
    poses, shares = propose_poses(source.keypoints, target.keypoints, rng)
    assert (np.diff(shares) <= 0).all()
    assert shares[0] > 0.1
    assert (shares <= 1).all()
    turn, shift = errors(poses[0], easy.T_sample_test, easy.test.mean(axis=0))
    assert turn < 5
    assert shift < 5


def test_distinct_poses_are_those_of_the_plain_search(rng):
    """The oracle compares every pose with all that were kept before it."""
    centre = np.array([100.0, -50.0, 400.0])
    poses = np.stack([small_motion(rng.normal(size=6) * [3, 3, 3, 0.2, 0.2, 0.2]) for _ in range(300)])
    expected: list[int] = []
    for at, pose in enumerate(poses):
        near = [
            np.linalg.norm(move_points(pose, centre) - move_points(poses[other], centre)) < 60.0
            and angle_between(pose, poses[other]) < 0.3
            for other in expected
        ]
        if not any(near):
            expected.append(at)
    assert 10 < len(expected) < 290
    for kept in (3, 300):
        found, ranks = distinct_poses(poses, np.arange(300), centre, 60.0, 0.3, kept)
        np.testing.assert_array_equal(ranks, expected[:kept])
        np.testing.assert_array_equal(found, poses[expected[:kept]])


@pytest.mark.parametrize("bend_mm", [0.0, 0.05])
def test_the_pose_errs_as_its_covariance_says(close, bend_mm):
    """Errors divided by their stated standard deviations, all six directions, over ten pairs; once with noise
    alone, once with a scanner that bends each scan as well: a part of that looks like a motion, and is guessed."""
    normalised = []
    for seed in range(10):
        case = pair(seed=40 + seed, n_points=20_000, noise_mm=0.1)
        draw = np.random.default_rng(seed)
        sample, test = (bent(points, bend_mm, draw) for points in (case.sample, case.test))
        source, target = prepare_pair(test, sample)
        points, normals = source.surfels.points, source.surfels.normals
        found = refine_bent(points, normals, target.surfels, icp_planes(points, normals, target.surfels, close))
        to_centre = rigid(None, -found.centre_mm)
        motion = to_centre @ found.T_target_source @ inverse(case.T_sample_test) @ inverse(to_centre)
        error = np.array([*motion[:3, 3], motion[2, 1], motion[0, 2], motion[1, 0]])
        normalised.append(np.linalg.solve(np.linalg.cholesky(found.total_covariance), error))
    assert 0.4 < np.sqrt(np.mean(np.square(normalised))) < (1.5 if bend_mm == 0 else 3.0)


def bent(points, size_mm, rng, length_mm=70.0):
    """Points (N, 3) moved along their rays by a smooth random field of waves, of rms ``size_mm``."""
    waves, phases = rng.normal(size=(24, 3)) / length_mm, rng.uniform(0, 2 * np.pi, 24)
    field = np.cos(points @ waves.T + phases).sum(axis=1) / np.sqrt(12)
    return points * (1 + size_mm * field / np.linalg.norm(points, axis=1))[:, None]


def test_a_bent_field_is_not_taken_for_a_motion():
    """A cubic bulge of the test scan's depth moves a shallow part's pose less when the bending is allowed for."""
    flat = pair(seed=8, n_points=40_000, relief=0.3, noise_mm=0.01)
    u, v = flat.test[:, 0] / 100, flat.test[:, 1] / 70
    bent = flat.test * (1 + (0.1 * (u**3 - 0.6 * u) + 0.08 * u * v**2)[:, None] / 400)
    source, target = prepare_pair(bent, flat.sample)
    points, normals = source.surfels.points, source.surfels.normals
    stiff = icp_planes(points, normals, target.surfels, flat.T_sample_test)
    free = refine_bent(points, normals, target.surfels, stiff)
    at = flat.test.mean(axis=0)
    off = [errors(found.T_target_source, flat.T_sample_test, at)[1] for found in (stiff, free)]
    assert off[1] < 0.5 * off[0]


def test_planes_are_matched_as_the_plain_twin_does(prepared, close):
    source, target = prepared
    source, normals, target = source.surfels.points[:3000], source.surfels.normals[:3000], target.surfels
    most = 3 * target.grid.size_mm
    residuals, facing = plane_residuals(source, normals, target, close, most)
    moved = move_points(close, source)
    distances, at = cKDTree(target.points).query(moved)
    along = ((moved - target.points[at]) * target.normals[at]).sum(axis=1)
    shown = (distances <= most) & (np.sqrt(distances**2 - along**2) < 1.5 * target.grid.size_mm)
    np.testing.assert_allclose(residuals, np.where(shown, along, np.nan), atol=1e-9)
    np.testing.assert_array_equal(
        facing, shown & ((rotate_vectors(close, normals) * target.normals[at]).sum(axis=1) > 0.7)
    )


def test_planes_that_are_kept_and_a_few_points_first_do_not_move_the_result(prepared, close, monkeypatch):
    source, target = prepared
    source, normals = source.surfels.points, source.surfels.normals
    assert len(source) > plane_icp.MANY
    found = icp_planes(source, normals, target.surfels, close)
    monkeypatch.setattr(plane_icp, "REMATCH_TOLERANCE", 0.0)
    monkeypatch.setattr(plane_icp, "MANY", len(source))
    plain = icp_planes(source, normals, target.surfels, close)
    turn, shift = errors(found.T_target_source, plain.T_target_source, source.mean(axis=0))
    assert shift < 0.02 * plain.rms_mm
    assert turn < 1e-3
    np.testing.assert_allclose(found.covariance, plain.covariance, rtol=0.05, atol=1e-3 * plain.covariance.max())


@pytest.mark.parametrize("within_mm", [0.05, 0.5, 5.0])
def test_the_agreeing_share_is_that_of_the_whole_agreement(prepared, close, within_mm):
    source, target = prepared
    for turn in (0.0, 0.02, 1.5):
        pose = close @ rigid(rotation_about((0, 0, 1), turn))
        asked = source.surfels.points[:500], source.surfels.normals[:500], target.voxels, pose, within_mm
        assert agreeing_fraction(*asked) == agreement(*asked).agreeing


def test_point_icp_never_gets_worse_and_stops_as_the_paper_says(easy, close):
    found = icp_points(easy.test[::30], easy.sample[::10], close, tolerance_mm2=1e-5)
    steps = np.diff(found.mean_squares_mm2)
    assert (steps <= 1e-12).all()
    assert found.converged
    assert -steps[-1] < 1e-5
    assert (-steps[:-1] >= 1e-5).all()


def test_trimming_helps_where_the_scans_overlap_in_part(close):
    part = pair(seed=3, n_points=30_000, overlap=0.7)
    whole = icp_points(part.test[::30], part.sample[::10], close)
    trimmed = icp_points(part.test[::30], part.sample[::10], close, keep=0.7)
    at = part.test.mean(axis=0)
    assert (
        errors(trimmed.T_target_source, part.T_sample_test, at)[1]
        < errors(whole.T_target_source, part.T_sample_test, at)[1]
    )
    with pytest.raises(InputError, match="share"):
        icp_points(part.test[::30], part.sample[::10], keep=0.0)


def test_generalised_icp_agrees_with_the_truth(easy, close):
    found = icp_generalised(easy.test[::6], easy.sample[::3], close, max_mm=2.0)
    turn, shift = errors(found.T_target_source, easy.T_sample_test, easy.test.mean(axis=0))
    assert turn < 0.05
    assert shift < 0.05
    assert np.isfinite(found.covariance).all()
    assert (np.linalg.eigvalsh(found.covariance) > 0).all()


def test_scans_far_apart_share_no_pairs(easy, prepared):
    far = rigid(None, (0, 0, 5000.0))
    source = prepared[0].surfels
    with pytest.raises(DegenerateError, match="meet within"):
        icp_planes(source.points, source.normals, prepared[1].surfels, far)
    with pytest.raises(DegenerateError, match="meet within"):
        icp_generalised(easy.test[::30], easy.sample[::30], far)
    with pytest.raises(DegenerateError, match="pairs of points"):
        icp_points(easy.test[::30], easy.sample[::30], far, max_mm=5.0)


def test_orientation_follows_the_viewpoint(rng):
    points = rng.normal(size=(100, 3)) + [0, 0, 50]
    normals = rng.normal(size=(100, 3))
    turned = orient_to_viewpoint(points, normals, (0, 0, 0))
    assert ((turned * -points).sum(axis=1) >= 0).all()
    np.testing.assert_allclose(np.abs(turned), np.abs(normals))


def test_a_small_definite_system_is_solved_like_numpy_does(rng):
    for _ in range(20):
        factor, right = rng.normal(size=(6, 6)) * 10.0 ** rng.uniform(-3, 3, 6), rng.normal(size=6)
        matrix = factor.T @ factor + 1e-9 * np.diag(np.square(factor).sum(axis=0))
        np.testing.assert_allclose(matrix @ solve_definite(matrix, right), right, atol=1e-6)


def scattered(rng, count=60):
    """Keypoints without meaning: points in a box, random histograms."""
    up = np.tile([0.0, 0, 1], (count, 1))
    return Keypoints(rng.uniform(0, 80, (count, 3)), up, rng.normal(size=(count, 33)), 4.0)


def test_sac_ia_judges_a_pose_by_hubers_error_of_the_squared_distances(rng):
    source, target = scattered(rng), scattered(rng)
    found = sac_ia_paper(source, target, np.random.default_rng(3), iterations=20, refine=False)
    distances = cKDTree(target.points).query(move_points(found.T_target_source, source.points))[0]
    assert found.error == pytest.approx(huber(distances**2, 5 * 4.0).mean(), rel=1e-12)


def test_sac_ia_keeps_its_samples_a_tenth_of_the_extent_apart(rng, monkeypatch):
    source, target = scattered(rng), scattered(rng)
    drawn, draw = [], sac_ia._spread_samples

    def noted(*asked):
        drawn.append((asked[1], draw(*asked)))
        return drawn[-1][1]

    monkeypatch.setattr(sac_ia, "_spread_samples", noted)
    sac_ia_paper(source, target, np.random.default_rng(3), iterations=50, refine=False)
    assert {asked for asked, _ in drawn} == {0.1 * float(np.linalg.norm(np.ptp(source.points, axis=0)))}
    for asked, (samples, d_min) in drawn:
        sides = source.points[samples] - source.points[np.roll(samples, 1)]
        assert d_min == asked
        assert np.linalg.norm(sides, axis=1).min() >= asked


def test_samples_that_no_points_allow_come_after_the_distance_is_halved(rng):
    points = rng.uniform(0, 10, (20, 3))
    samples, d_min = sac_ia._spread_samples(points, 64.0, rng)
    assert d_min in 64.0 / 2 ** np.arange(1, 12)
    sides = points[samples] - points[np.roll(samples, 1)]
    assert np.linalg.norm(sides, axis=1).min() >= d_min


def test_point_icp_stops_at_the_first_fall_below_tau_and_not_before(easy, close):
    start = close @ rigid(rotation_about((0, 0, 1), 0.02), (2.0, 1.0, 0.0))
    found = icp_points(easy.test[::30], easy.sample[::10], start)
    falls = -np.diff(found.mean_squares_mm2)
    assert found.converged and found.iterations > 5
    assert (falls[:-1] >= 1e-6).all() and falls[-1] < 1e-6


def test_plane_icp_goes_on_until_a_step_is_a_thousandth_of_the_noise(prepared, close, monkeypatch):
    source, target = prepared
    monkeypatch.setattr(plane_icp, "MANY", len(source.surfels))
    asked = source.surfels.points, source.surfels.normals, target.surfels, close
    found = icp_planes(*asked)
    before = icp_planes(*asked, iterations=found.iterations - 1)
    centre = source.surfels.points.mean(axis=0)
    step = move_points(found.T_target_source, centre) - move_points(before.T_target_source, centre)
    assert found.converged and found.iterations > 2
    assert np.linalg.norm(step) < 2e-3 * found.rms_mm


def test_a_far_search_goes_through_larger_cells_and_finds_the_same_planes(prepared, close, monkeypatch):
    source, target = prepared
    apart = close @ rigid(rotation_about((1, 0, 0), 0.1), (3.0, 0.0, 6.0))
    asked = source.surfels.points, source.surfels.normals, target.surfels, apart, 12 * target.surfels.grid.size_mm
    through_larger = plane_icp.plane_residuals(*asked)
    monkeypatch.setattr(plane_icp, "FAR_CELLS", np.inf)
    for one, other in zip(through_larger, plane_icp.plane_residuals(*asked), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("cells", [2.0, 4.0, 6.0])
def test_points_that_have_no_plane_are_sought_anew_as_soon_as_they_may_have_one(prepared, close, monkeypatch, cells):
    source, target = prepared
    cell = target.surfels.grid.size_mm
    points, normals = source.surfels.points[::4].copy(), source.surfels.normals[::4].copy()
    points[::3] += np.linspace(4, 10, len(points[::3]))[:, None] * cell * normals[::3]
    asked = points, normals, target.surfels, close @ rigid(None, (1.0, 0.0, 2.0) * np.array(cell)), cells * cell
    found = icp_planes(*asked)
    monkeypatch.setattr(plane_icp, "SLACK", 0.0)
    always = icp_planes(*asked)
    np.testing.assert_array_equal(found.T_target_source, always.T_target_source)
    assert found.iterations == always.iterations > 5 and found.overlap == always.overlap < 1


def test_a_real_scan_agrees_as_well_however_it_lies_in_its_file(real_data):
    """At this turn the file's origin stands beside the line of sight; normals turned to it disagreed on a third."""
    from grindvision.clouds import read_cloud

    fixed, moving = (read_cloud(real_data(name), "m").points for name in ("bun000.ply", "bun045.ply"))
    turned = rigid(rotation_about([0.3, 1.0, 0.1], 0.9), (-250.0, 0.0, 300.0))
    found = register(move_points(turned, moving), fixed)
    assert found.coarse.agreement.fraction_of_overlap > 0.9
