"""The difference cloud, its level of detection, and the paths along beads."""

import warnings
from dataclasses import replace

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
    vector_angle,
)
from grindvision.vision.change.centreline import bead_centreline
from grindvision.vision.change.change_detection import find_change, find_change_paper
from grindvision.vision.change.detection import DetectOptions, detect
from grindvision.vision.change.diagnostics import missing_pieces
from grindvision.vision.change.oriented_box import box_path, minimal_box
from grindvision.vision.change.pieces import Cluster
from grindvision.vision.change.ridge_path import trace_bead
from grindvision.vision.surface.signed_distance import signed_distances
from grindvision.vision.surface.surfels import build_surfels
from tests.grinding_scene import Bead, arc_bead, pair, plate_height, ring_bead, scan, view


@pytest.fixture(scope="module")
def bead():
    return arc_bead()


@pytest.fixture(scope="module")
def case(bead):
    return pair(seed=2, n_points=120_000, beads=[bead])


@pytest.fixture(scope="module")
def found(case):
    return detect(case.sample, case.test)


def to_ridge(points, ridge_part, T_test_part):
    return cKDTree(move_points(T_test_part, ridge_part)).query(points)[0]


def test_the_path_follows_the_true_ridge(found, case, bead):
    assert len(found.beads) == 1
    away = to_ridge(found.path_points, bead.ridge(), case.T_test_part)
    assert away.mean() < 0.06
    assert away.max() < 0.15
    assert found.beads[0].height_mm == pytest.approx(1.5, abs=0.05)
    assert found.beads[0].length_mm == pytest.approx(30, rel=0.1)


def test_the_normals_are_those_of_the_good_surface(found, case, bead):
    x, y = bead.line.T
    step = 1e-3
    slope = [
        plate_height(x + step, y) - plate_height(x - step, y),
        plate_height(x, y + step) - plate_height(x, y - step),
    ]
    normals = np.column_stack([-np.array(slope).T / (2 * step), np.ones(len(x))])
    _, at = cKDTree(move_points(case.T_test_part, bead.ridge())).query(found.path_points)
    off = np.degrees(vector_angle(found.path_normals, rotate_vectors(case.T_test_part, normals[at])))
    assert np.median(off) < 1.5
    np.testing.assert_allclose(np.linalg.norm(found.path_normals, axis=1), 1)
    np.testing.assert_array_equal(found.beads[0].tool_axes(), -found.beads[0].normals)


def test_path_points_stand_in_the_middle_of_equal_parts(found):
    one = trace_bead(found.difference.clusters[0], 1)
    steps = np.linalg.norm(np.diff(found.path_points, axis=0), axis=1)
    assert np.ptp(steps) < 0.05 * steps.mean()
    np.testing.assert_allclose(one.points[0], found.path_points[2:4].mean(axis=0), atol=0.3)
    assert found.path_points[0, 0] < found.path_points[-1, 0]
    with pytest.raises(InputError, match="at least 1"):
        trace_bead(found.difference.clusters[0], 0)


def test_the_path_moves_with_the_test_scan(found, case):
    T_other_test = rigid(random_rotation(np.random.default_rng(5)), (5.0, -7.0, 12.0))
    options = DetectOptions(viewpoint_test_mm=T_other_test[:3, 3])
    moved = detect(case.sample, move_points(T_other_test, case.test), options)
    back = move_points(inverse(T_other_test), moved.path_points)
    away = np.minimum(
        np.linalg.norm(back - found.path_points, axis=1), np.linalg.norm(back[::-1] - found.path_points, axis=1)
    )
    assert away.max() < 0.1


def test_a_good_part_has_nothing_to_grind():
    for seed in range(3):
        same = pair(seed=seed, n_points=40_000)
        found = detect(same.sample, same.test)
        assert found.beads == ()
        assert found.path_points.shape == (0, 3)
        assert "nothing to grind above the level of detection of 0." in str(found)


def test_no_piece_is_lower_than_what_a_pose_that_is_hardly_known_hides(found):
    slide = np.zeros((6, 6))
    up = found.beads[0].normals.mean(axis=0)
    usual = found.difference.level_of_detection_mm
    for hidden_mm, pieces, level_mm in ((0.1, 1, usual), (1.0, 0, 1.96)):
        slide[:3, :3] = hidden_mm**2 * np.outer(up, up)
        bent = replace(found.registration, hidden_covariance=slide)
        difference = find_change(found.test, found.sample, bent)
        assert len(difference.clusters) == pieces
        assert difference.level_of_detection_mm == pytest.approx(level_mm, rel=0.1)
        back = inverse(bent.T_target_source)
        turned = np.kron(np.eye(2), back[:3, :3])
        swapped = replace(bent, T_target_source=back, hidden_covariance=turned @ slide @ turned.T)
        assert len(missing_pieces(found.sample, found.test, swapped)) == pieces


def test_a_coarse_test_scan_says_which_beads_it_would_not_show():
    fine = pair(seed=3, n_points=60_000)
    with pytest.warns(
        GrindvisionWarning, match=r"stand 2\.\d times as far apart as the sample's: beads narrower than"
    ) as caught:
        found = detect(fine.sample, fine.test[::6])
    assert found.beads == ()
    assert f"{found.coverage.width_mm:.2g} mm would not be seen" in str(caught[0].message)


def test_a_cavity_is_no_bead_but_is_said():
    dent = arc_bead(height_mm=-1.5)
    with pytest.warns(GrindvisionWarning, match=r"material is missing .* 1\.[45]. mm deep"):
        found = detect(*(getattr(pair(seed=4, beads=[dent]), name) for name in ("sample", "test")))
    assert found.beads == ()
    assert np.nanmin(found.difference.signed_mm) < -1


@pytest.mark.full
def test_another_part_is_refused(case):
    def other(x, y):
        return plate_height(x, y) + 4 * np.sin(x / 9) * np.cos(y / 7)

    with pytest.raises(DegenerateError):
        detect(case.sample, scan(other, view(0.2), 40_000, np.random.default_rng(1)))


def test_several_beads_come_largest_first():
    beads = [arc_bead(), Bead(np.column_stack([np.linspace(-80, -60, 800), np.full(800, -10.0)]), 3.0, 1.0)]
    two = pair(seed=6, n_points=90_000, beads=beads)
    found = detect(two.sample, two.test)
    assert len(found.beads) == 2
    assert found.beads[0].length_mm > found.beads[1].length_mm
    for bead, truth in zip(found.beads, beads, strict=True):
        assert to_ridge(bead.points, truth.ridge(), two.T_test_part).max() < 0.2
    assert len(found.path_points) == 12


def test_a_closed_bead_is_walked_round_once():
    ring = ring_bead()
    closed = pair(seed=7, n_points=90_000, beads=[ring])
    found = detect(closed.sample, closed.test, DetectOptions(points=8)).beads[0]
    assert found.closed
    assert found.length_mm == pytest.approx(2 * np.pi * 12, rel=0.03)
    assert to_ridge(found.points, ring.ridge(), closed.T_test_part).max() < 0.2
    steps = np.linalg.norm(np.diff(np.vstack([found.points, found.points[:1]]), axis=0), axis=1)
    assert np.ptp(steps) < 0.1 * steps.mean()
    turns = np.cross(found.points - found.points.mean(axis=0), np.roll(found.points, -1, axis=0) - found.points)
    assert (turns @ found.normals.mean(axis=0) > 0).all()


def test_a_branching_bead_is_refused_by_name():
    stem = np.column_stack([np.linspace(-25, 25, 1500), np.full(1500, 0.0)])
    arm = np.column_stack([np.full(800, 0.0), np.linspace(0, 25, 800)])
    fork = pair(seed=8, n_points=90_000, beads=[Bead(np.vstack([stem, arm]))])
    with pytest.raises(DegenerateError, match="branches near"):
        detect(fork.sample, fork.test)


def test_a_smaller_piece_that_branches_is_left_out_with_a_warning():
    stem = np.column_stack([np.linspace(-80, -60, 900), np.full(900, -20.0)])
    arm = np.column_stack([np.full(600, -70.0), np.linspace(-20, -6, 600)])
    both = pair(seed=9, n_points=90_000, beads=[arc_bead(length_mm=45.0), Bead(np.vstack([stem, arm]), 3.0, 1.0)])
    with pytest.warns(GrindvisionWarning, match="piece 2 of the difference is left out"):
        assert len(detect(both.sample, both.test).beads) == 1


def test_a_largest_piece_too_small_to_follow_leaves_pose_and_difference():
    paths = []
    for seed in (1, 2, 11):
        spike = arc_bead(length_mm=1.0, width_mm=4.0, height_mm=6.0)
        spiked = pair(seed=seed, beads=[spike])
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", GrindvisionWarning)
            found = detect(spiked.sample, spiked.test)
        assert angle_between(found.T_sample_test, spiked.T_sample_test) < np.radians(0.05)
        assert to_ridge(found.difference.points, spike.ridge(), spiked.T_test_part).max() < 8
        paths.append(len(found.path_points))
        if not found.beads:
            (said,) = (str(warning.message) for warning in caught)
            assert said.startswith("piece 1 of the difference is left out: ") and said.endswith("scan it denser")
            assert "nothing to grind" not in str(found)
            assert str(found).startswith("no path: 1 piece stands out")
    assert 0 in paths


def test_heights_are_signed_distances_from_the_surface(rng):
    x, y = rng.uniform(0, 50, size=(2, 60_000))
    surfels = build_surfels(np.column_stack([x, y, 0.2 * x]), 2.0)
    up = np.array([-0.2, 0, 1]) / np.linalg.norm([0.2, 0, 1])
    surfels = replace(surfels, normals=np.where((surfels.normals @ up < 0)[:, None], -surfels.normals, surfels.normals))
    spots = np.column_stack([rng.uniform(5, 45, size=(200, 2)), np.zeros(200)])
    spots[:, 2] = 0.2 * spots[:, 0]
    asked = rng.uniform(-2, 2, 200)
    heights, normals, _ = signed_distances(surfels, spots + asked[:, None] * up, 4.0)
    np.testing.assert_allclose(heights, asked, atol=1e-6)
    np.testing.assert_allclose(normals @ up, 1, atol=1e-9)
    beside, _, _ = signed_distances(surfels, np.array([[70.0, 25, 14], [25, 25, 40]]), 4.0)
    assert np.isnan(beside).all()


def test_the_level_of_detection_covers_the_noise(case, found):
    difference = found.difference
    on_bead = cKDTree(difference.points).query(difference.surfels)[0] < 2
    shown = ~np.isnan(difference.signed_mm) & ~on_bead
    exceeding = np.mean(np.abs(difference.signed_mm[shown]) > difference.level_mm[shown])
    assert exceeding < 0.08
    noisy = pair(seed=2, n_points=60_000, noise_mm=0.12)
    assert detect(noisy.sample, noisy.test).difference.level_of_detection_mm > 1.5 * difference.level_of_detection_mm


def test_steep_places_are_less_certain_after_an_uncertain_registration(found):
    unsure = replace(found.registration, covariance=np.diag([0.1, 0.1, 0.1, 0, 0, 0]) ** 2)
    sure = replace(found.registration, covariance=np.zeros((6, 6)))
    wide, narrow = (find_change(found.test, found.sample, one).level_mm for one in (unsure, sure))
    shown = ~np.isnan(found.difference.signed_mm)
    assert (wide[shown] > np.hypot(narrow[shown], 0.19)).all()


def test_no_level_is_below_what_the_scans_agree_to(found):
    signed = found.difference.signed_mm[~np.isnan(found.difference.signed_mm)]
    spread = 1.4826 * np.median(np.abs(signed - np.median(signed)))
    assert found.difference.level_mm.min() >= 1.96 * spread * 0.999


def test_a_thinly_sampled_straight_bead_does_not_seem_to_branch():
    for seed in range(30):
        draw = np.random.default_rng(seed)
        s, b = draw.uniform(0, 24, 50), draw.uniform(-1.9, 1.9, 50)
        h = 1.5 * (1 - (b / 2) ** 2)
        thin = Cluster(np.column_stack([s, b, h]), h, np.tile([0.0, 0, 1], (50, 1)), 1.8, 60.0, 60.0, 1.5)
        curve, closed, _ = bead_centreline(thin)
        assert not closed
        assert np.ptp(curve[:, 0]) > 12


def test_a_flank_in_shadow_does_not_move_the_ridge(rng):
    """All points of a bead on a plane, and those of one flank alone: the ridge stays where it is."""
    s, b = rng.uniform(0, 30, 6000), rng.uniform(-2, 2, 6000)
    h = 1.5 * (1 - (b / 2) ** 2) + rng.normal(scale=0.02, size=6000)
    places, up = np.column_stack([s, b, h]), np.tile([0.0, 0, 1], (6000, 1))
    for lit in (b > -2, b > -0.3):
        path = trace_bead(Cluster(places[lit], h[lit], up[lit], 0.9, 100.0, 100.0, 1.5))
        assert np.abs(path.points[:, 1]).mean() < 0.03
        assert path.points[:, 2] == pytest.approx(1.5, abs=0.03)


@pytest.mark.parametrize("radius_mm", [40.0, 120.0])
def test_a_curved_bead_is_followed_to_its_ends(radius_mm):
    """The outermost path points lie neither inside nor outside of the arc, in the mean over noise."""
    off = []
    for seed in range(8):
        draw = np.random.default_rng(seed)
        s, b = draw.uniform(0, 30, 6000), draw.uniform(-2, 2, 6000)
        to_end = np.clip(np.minimum(s, 30 - s) / 2, 0, 1)
        swell = np.sqrt(1 - (1 - to_end) ** 2)
        h = 1.5 * (swell - (b / 2) ** 2 / np.maximum(swell, 0.1))
        kept, angle = h > 0.1, s / radius_mm
        places = np.column_stack([(radius_mm + b) * np.cos(angle), (radius_mm + b) * np.sin(angle), h])[kept]
        noisy = h[kept] + draw.normal(scale=0.02, size=kept.sum())
        path = trace_bead(Cluster(places, noisy, np.tile([0.0, 0, 1], (len(noisy), 1)), 0.9, 115.0, 115.0, 1.5))
        off.append(np.linalg.norm(path.points[:, :2], axis=1) - radius_mm)
    assert np.abs(np.mean(off, axis=0)).max() < 0.02
    assert np.abs(off).mean() < 0.02


@pytest.mark.parametrize(
    ("section", "highest", "max_mm"),
    [
        (lambda u: np.sqrt(1.2 - u**2) - np.sqrt(0.2), 0.0, 0.03),
        (lambda u: (1 + np.cos(np.pi * u)) / 2, 0.0, 0.03),
        (lambda u: 1 - u**4, 0.0, 0.05),
        (lambda u: 1 - u**2 + 0.2 * (u - u**3), 0.098, 0.05),
        (lambda u: 1 - np.abs(u) ** 1.5, 0.0, 0.05),
    ],
    ids=["round", "bell", "flat-topped", "lopsided", "pointed"],
)
def test_beads_of_any_section_are_followed_where_they_are_highest(section, highest, max_mm):
    """``highest``: across, in half widths."""
    aside, above = [], []
    for seed in range(5):
        draw = np.random.default_rng(seed)
        s, u = draw.uniform(0, 30, 6000), draw.uniform(-1, 1, 6000)
        h = 1.5 * section(u) / section(highest) + draw.normal(scale=0.02, size=6000)
        places, up = np.column_stack([s, 2 * u, h]), np.tile([0.0, 0, 1], (6000, 1))
        path = trace_bead(Cluster(places, h, up, 0.9, 120.0, 120.0, 1.5))
        aside.append(path.points[:, 1] - 2 * highest)
        above.append(path.points[:, 2] - 1.5)
    assert np.abs(aside).mean() < max_mm
    assert np.abs(above).mean() < max_mm


def test_the_paper_s_threshold_is_squared_in_pcl(rng):
    sample = rng.uniform(0, 10, size=(500, 3))
    test = sample[:100] + [0, 0, 0.6]
    distances = cKDTree(sample).query(test)[0]
    np.testing.assert_array_equal(find_change_paper(test, sample, 0.5), distances > np.sqrt(0.5))
    np.testing.assert_array_equal(find_change_paper(test, sample, 0.5, squared=False), distances > 0.5)
    with pytest.raises(InputError, match="above zero"):
        find_change_paper(test, sample, 0.0)


def test_the_minimal_box_is_found_in_any_pose(rng):
    size = np.array([30.0, 6.0, 2.0])
    corners = np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, 8).T
    points = np.vstack([corners, rng.uniform(size=(300, 3))]) * size
    for _ in range(3):
        box = minimal_box(points @ random_rotation(rng).T + rng.normal(size=3))
        np.testing.assert_allclose(box.size_mm, size, rtol=1e-9)
        np.testing.assert_allclose(box.axes @ box.axes.T, np.eye(3), atol=1e-12)
    with pytest.raises(DegenerateError, match="one plane"):
        minimal_box(points * [1, 1, 0])


def test_boxes_give_centroids_snapped_to_the_scan(rng):
    points = rng.uniform(size=(3000, 3)) * [30, 3, 1]
    path = box_path(points, points, np.tile([0.0, 0, 1], (len(points), 1)), 5)
    np.testing.assert_allclose(path.centroids[:, 0], [3, 9, 15, 21, 27], atol=0.5)
    assert all(np.isclose(points, point).all(axis=1).any() for point in path.points)


def test_a_bead_of_few_points_is_refused(rng):
    points = rng.uniform(size=(8, 3))
    tiny = Cluster(points, np.ones(8), np.tile([0.0, 0, 1], (8, 1)), 1.0, 3.0, 3.0, 1.0)
    with pytest.raises(DegenerateError, match="too few"):
        trace_bead(tiny)


def test_the_minimal_box_is_smaller_than_every_other_one_about_a_prism(rng):
    outline = np.array([[0, 0], [30, 0], [34, 5], [20, 12], [4, 9], [-3, 4.0]])
    prism = np.array([[x, y, z] for x, y in outline for z in (0.0, 7.0)])
    volumes = [
        7.0 * np.prod(np.ptp(outline @ rotation_about((0, 0, 1), angle)[:2, :2], axis=0))
        for angle in np.linspace(0, np.pi / 2, 500)
    ]
    volume = np.prod(minimal_box(prism @ random_rotation(rng).T).size_mm)
    assert max(volumes) > 1.2 * min(volumes)
    assert 0.99 * min(volumes) < volume < min(volumes) * (1 + 1e-9)


def test_the_level_of_detection_is_no_finer_than_the_roughness_of_the_planes(case, found):
    surfels = found.test.surfels
    excess = np.sqrt(np.maximum(surfels.roughness_mm**2 - surfels.noise_mm**2, 0))
    floor = 1.96 * 0.5 * excess
    level = found.difference.level_mm
    assert (level >= floor * (1 - 1e-9)).all()
    assert np.mean(floor > 0.9 * level) > 0  # it is the roughness that decides somewhere
