"""Grooves are found where they are: known shapes, any frame and order, nothing invented, bad input named."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree

from grindvision.cell import weld_scene
from grindvision.errors import InputError, NoGrooveError, UnitError
from grindvision.geometry import rotation_about
from grindvision.vision.seam.groove import FindGroovesOptions, find_grooves
from grindvision.vision.seam.groove_profile import Corners, Sections, fit_profiles, profile_height
from grindvision.vision.seam.height_field import closed, coarser, rasterise, smoothed
from grindvision.vision.seam.seam_curve import build_curve, lay_straight
from tests import plain_profile
from tests.groove_scenes import anywhere, cloud, grid, overlap, straight_groove, vee


@pytest.mark.parametrize("kind", ["line", "curve", "box", "cylinder"])
def test_weld_pieces_overlap(kind):
    """The simulated D415 on the four pieces, one set of defaults."""
    scene = weld_scene(kind, np.random.default_rng(3))
    found = find_grooves(scene.points)
    assert len(found.grooves) == 1
    assert overlap(found.labels, scene.labels) > 0.925
    assert np.median(found.grooves[0].width_mm) == pytest.approx(12, abs=0.6)


def test_the_ends_of_the_root_are_found_on_a_flank_too():
    """The pipe's flanks, where the camera looks nearly along the surface: no end way point goes astray."""
    for seed in (11, 77):
        scene = weld_scene("cylinder", np.random.default_rng([seed, 2, 3]), every=2)
        root = find_grooves(scene.points).grooves[0].root
        shown = scene.root_mm + scene.root_errors_mm
        assert cKDTree(shown).query(root)[0].max() < 1.5
        assert cKDTree(root).query(scene.root_mm)[0].max() < 8.0


def test_an_oblique_end_reaches_as_far_as_the_root_does(rng):
    """Where a plate's edge cuts the groove askew, one wall ends before the other; the root goes on straight."""
    places = grid()
    for height in (vee(places[:, 1]), -6 * np.cos(np.clip(places[:, 1] / 10, -0.5, 0.5) * np.pi) ** 2):
        kept = places[:, 0] + places[:, 1] < 40
        root = find_grooves(cloud(places[kept], height[kept], rng)).grooves[0].root
        assert np.abs(root[:, 1]).max() < 0.6
        assert root[:, 0].max() == pytest.approx(40, abs=1.5) and root[:, 0].min() == pytest.approx(-60, abs=1.5)


def test_width_depth_root_of_a_known_groove(rng):
    points, truth = straight_groove(rng)
    groove = find_grooves(points).grooves[0]
    assert overlap(find_grooves(points).labels, truth) > 0.95
    assert np.median(groove.width_mm) == pytest.approx(10, abs=0.3)
    assert np.median(groove.depth_mm) == pytest.approx(6, abs=0.2)
    assert np.abs(groove.root[:, 1]).max() < 0.3
    assert np.abs(groove.root[:, 2] - 406).max() < 0.3
    assert np.abs(groove.normals @ [0, 0, -1] - 1).max() < 2e-3
    assert groove.length_mm == pytest.approx(120, abs=3)


def test_any_order_and_any_frame_give_the_same_groove(rng):
    points, _ = straight_groove(rng)
    labels = find_grooves(points).labels
    order = rng.permutation(len(points))
    assert np.mean(find_grooves(points[order]).labels != labels[order]) < 1e-3
    for _ in range(3):
        moved, _, shift = anywhere(points, rng)
        assert np.mean(find_grooves(moved, FindGroovesOptions(viewpoint_mm=shift)).labels != labels) < 2e-3


def test_unknown_viewpoint_finds_the_groove_from_either_side(rng):
    points, truth = straight_groove(rng)
    shift = np.array([5000.0, 0, -400])
    assert overlap(find_grooves(points + shift).labels, truth) > 0.95


def test_scale_of_everything_does_not_matter(rng):
    points, truth = straight_groove(rng)
    assert overlap(find_grooves(points * 4).labels, truth) > 0.95
    assert np.median(find_grooves(points * 4).grooves[0].width_mm) == pytest.approx(40, rel=0.03)


def test_organised_clouds_keep_their_shape_and_nan_pixels_belong_to_nothing(rng):
    points, truth = straight_groove(rng)
    columns = len(np.unique(grid()[:, 1]))
    points[rng.random(len(points)) < 0.1] = np.nan
    organised = points.reshape(-1, columns, 3)
    labels = find_grooves(organised).labels
    assert labels.shape == organised.shape[:2]
    assert not labels[np.isnan(organised[..., 0])].any()
    seen = np.isfinite(points[:, 0])
    assert overlap(labels.ravel()[seen], truth[seen]) > 0.95


@pytest.mark.parametrize(
    "height",
    [
        lambda x, y: 0 * x,
        lambda x, y: 4 * np.exp(-(y**2) / 8),
        lambda x, y: np.where(y > 0, 5.0, 0.0),
        lambda x, y: -0.004 * x**2 - 0.02 * np.maximum(np.abs(y) - 25, 0) ** 2,
        lambda x, y: -7 * np.exp(-(x**2 + y**2) / 50),
        lambda x, y: 0.6 * np.sin(x / 6) * np.sin(y / 5),
    ],
    ids=["plate", "bead", "step", "rounded outline", "dent", "waviness"],
)
def test_nothing_is_invented(rng, height):
    places = grid()
    with pytest.raises(NoGrooveError, match="no groove in the cloud"):
        find_grooves(cloud(places, height(*places.T), rng))


def test_gaps_between_things_beside_the_plate_hide_no_groove(rng):
    """In a whole camera view the largest hollows are gaps between boxes; where there is no groove, none is invented."""
    places = grid(200, 200, 0.8)
    y = places[:, 1]
    boxes = np.select([(y > 20) & (y < 30), y > 60, y < -60], [45, 60, 50], 0.0)
    groove = np.where(np.abs(y) < 18, vee(y), 0)
    found = find_grooves(cloud(places, boxes + groove, rng))
    assert found.cluttered and len(found.grooves) == 1
    assert overlap(found.labels, np.abs(y) < 5) > 0.93
    assert not find_grooves(cloud(places, vee(y), rng)).cluttered
    with pytest.raises(NoGrooveError):
        find_grooves(cloud(places, boxes, rng))


def test_two_grooves_are_both_found_the_larger_first(rng):
    places = grid()
    heights = vee(places[:, 1] - 18, 12, 7) + vee(places[:, 1] + 20, 8, 4)
    found = find_grooves(cloud(places, heights, rng))
    assert [round(float(np.median(groove.width_mm))) for groove in found.grooves] == [12, 8]
    assert overlap(found.groove_id == 1, np.abs(places[:, 1] + 20) < 4) > 0.9


@pytest.mark.parametrize("ends_mm", [(-40, 40), (0, 40)], ids=["crossing", "branch"])
def test_crossing_and_branching_grooves_are_all_found(rng, ends_mm):
    places = grid()
    low, high = ends_mm
    branch = vee(places[:, 0] - 5, 8, 4) * ((places[:, 1] >= low) & (places[:, 1] <= high))
    found = find_grooves(cloud(places, np.minimum(vee(places[:, 1]), branch), rng))
    assert np.median(found.grooves[0].width_mm) == pytest.approx(10, abs=0.4)
    assert np.abs(found.grooves[0].root[:, 1]).max() < 0.5 and found.grooves[0].length_mm == pytest.approx(120, abs=3)
    assert len(found.grooves) == (3 if low < 0 else 2)
    for groove in found.grooves[1:]:
        assert np.abs(groove.root[:, 0] - 5).max() < 0.6 and groove.length_mm > 25


@pytest.mark.parametrize("seed", range(4))
def test_arms_of_a_crossing_are_found_from_any_view(seed):
    rng, places = np.random.default_rng([seed, 20]), grid()
    heights = np.minimum(vee(places[:, 1]), vee(places[:, 0] - 5, 8, 4))
    points = cloud(places, heights, rng)
    found = find_grooves(points @ rotation_about(rng.standard_normal(3), 0.05).T)
    assert len(found.grooves) == 3
    for groove in found.grooves:
        assert groove.length_mm < np.ptp(points[groove.members], axis=0).max() + 1.5


def test_shallow_wide_grooves_count_and_so_do_steep_narrow_ones(rng):
    for width, depth in ((25, 3), (6, 3), (8, 9)):
        points, truth = straight_groove(rng, width, depth)
        found = find_grooves(points)
        assert len(found.grooves) == 1 and overlap(found.labels, truth) > 0.9
        assert np.median(found.grooves[0].depth_mm) == pytest.approx(depth, rel=0.1)


@pytest.mark.parametrize("noise_mm", [0.05, 0.6])
def test_noise_does_not_make_a_rounded_groove_sharp(rng, noise_mm):
    """The middle of a rounded groove lies on its floor, not where its walls would meet below it."""
    places = grid(spacing_mm=0.9)
    heights = -8 * np.cos(np.clip(places[:, 1] / 20, -0.5, 0.5) * np.pi) ** 2
    groove = find_grooves(cloud(places, heights, rng, noise_mm)).grooves[0]
    assert np.abs(groove.root[:, 2] - 408).mean() < 0.4
    assert np.abs(groove.root[:, 1]).mean() < 0.3


def test_a_robot_base_at_the_origin_is_no_camera(rng):
    """A plate that stands with its back to the robot: the origin lies behind it, z points up."""
    points, truth = straight_groove(rng)
    standing = np.column_stack([points[:, 0], 1100 - points[:, 2], points[:, 1]])
    assert overlap(find_grooves(standing).labels, truth) > 0.93


def test_ring_is_closed_and_measured_once(rng):
    places = grid(110, 110)
    found = find_grooves(cloud(places, vee(np.hypot(*places.T) - 32), rng))
    assert found.grooves[0].closed
    assert found.grooves[0].length_mm == pytest.approx(2 * np.pi * 32, rel=0.03)


def test_blind_groove_ends_where_it_ends(rng):
    places = grid()
    found = find_grooves(cloud(places, vee(places[:, 1]) * (np.abs(places[:, 0]) < 35), rng))
    assert found.grooves[0].length_mm == pytest.approx(70, abs=4)


def test_flat_root_does_not_widen_the_groove(rng):
    places = grid()
    heights = -5 * np.clip((6 - np.abs(places[:, 1])) / 3.5, 0, 1)
    groove = find_grooves(cloud(places, heights, rng)).grooves[0]
    assert np.median(groove.width_mm) == pytest.approx(12, abs=0.6)
    assert np.median(groove.depth_mm) == pytest.approx(5, abs=0.3)


def test_the_line_of_a_blunt_groove_does_not_care_which_wall_more_points_show(rng):
    places = grid()
    heights = -5 * np.clip((6 - np.abs(places[:, 1])) / 2.5, 0, 1)
    points = cloud(places, heights, rng)
    on_wall = (places[:, 1] > 3.5) & (places[:, 1] < 6)
    more = np.concatenate([points, *(points[on_wall] + rng.normal(0, 0.05, (on_wall.sum(), 3)) for _ in range(3))])
    before, after = (find_grooves(one).grooves[0].root for one in (points, more))
    assert abs(np.median(after[:, 1]) - np.median(before[:, 1])) < 0.1


def test_groove_partly_outside_says_which_share_has_both_sides(rng):
    points, _ = straight_groove(rng)
    kept = grid()[:, 1] < 4
    groove = find_grooves(points[kept]).grooves[0]
    assert groove.edges_seen < 0.5
    assert find_grooves(points).grooves[0].edges_seen == 1


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (lambda p: p / 1000, UnitError, "metres"),
        (lambda p: p[:50], InputError, "50 of 50 points"),
        (lambda p: np.full_like(p, np.nan), InputError, "finite"),
        (lambda p: p[:, :2], InputError, "shape"),
        (lambda p: "cloud", InputError, "numbers"),
    ],
)
def test_bad_clouds_are_named(rng, change, error, message):
    points, _ = straight_groove(rng)
    with pytest.raises(error, match=message):
        find_grooves(change(points))


def test_cloud_too_sparse_for_the_groove_asked_for(rng):
    points, _ = straight_groove(rng, spacing_mm=3.0)
    with pytest.raises(InputError, match="too sparse for a groove 10 mm wide"):
        find_grooves(points, FindGroovesOptions(width_mm=10))


def test_real_plate(real_data):
    """Points deeper than 1 mm below the plate, found by another way, are recalled in one connected groove."""
    from grindvision.clouds import read_cloud

    points = read_cloud(real_data("weld_plate.pcd"), "m").points
    found = find_grooves(points)
    assert len(found.grooves) == 1
    level = np.median(points[:, 2])
    plate = points[np.abs(points[:, 2] - level) < 4]
    for _ in range(10):
        terms = np.column_stack([np.ones(len(plate)), plate[:, :2]])
        plane = np.linalg.lstsq(terms, plate[:, 2], rcond=None)[0]
        plate = plate[np.abs(plate[:, 2] - terms @ plane) < 1.5]
    depth = plane[0] + points[:, :2] @ plane[1:] - points[:, 2]
    near_seam = cKDTree(found.grooves[0].root).query(points)[0] < 25
    deep = (depth > 1) & (depth < 11) & near_seam
    assert deep.sum() > 6000
    assert found.labels[deep].mean() > 0.95


def test_profile_slopes_agree_with_finite_differences(rng):
    across = np.sort(rng.uniform(-12, 12, (2, 40)), axis=1)
    parameters = np.array([[0.1, 0.05, 0.01, 7, -6, 0.3, 5.5], [0, 0, -0.01, 4, -4, -0.5, 5]])
    for corners in (Corners(0.3, 0.5), Corners(0.2, 0.1, 1.2)):
        height, slopes = plain_profile.profile_slopes(across, parameters, corners)
        np.testing.assert_allclose(height, profile_height(across, parameters, corners), atol=1e-12)
        for k in range(7):
            step = 1e-5 * np.eye(7)[k]
            high, low = (profile_height(across, parameters + sign * step, corners) for sign in (1, -1))
            np.testing.assert_allclose(slopes[..., k], (high - low) / 2e-5, atol=1e-7)


def test_fitted_sections_agree_with_the_plain_twin(rng):
    across = np.tile(np.linspace(-12, 12, 49), (30, 1)) + rng.uniform(-0.2, 0.2, (30, 49))
    true = np.array([0, 0, 0, 6, -5, 0, 5]) + 0.3 * rng.standard_normal((30, 7)) * [1, 0.1, 0.01, 1, 1, 1, 1]
    start = np.tile([0.0, 0, 0, 5, -6, 0, 6], (30, 1))
    spread = np.array([3, 0.5, 0.02, 6, 5, 4, 5])
    for corners in (Corners(0.05, 0.05), Corners(0.6, 0.4, 1.2)):
        up = profile_height(across, true, corners) + 0.1 * rng.standard_normal(across.shape)
        up[rng.random(up.shape) < 0.03] += 4
        weight = np.where(rng.random(up.shape) < 0.9, rng.uniform(0.5, 2, up.shape), 0)
        weight[:5, 30:] = 0
        sections = Sections(across, up, weight, 0.5)
        plain, deviation, noise = plain_profile.fit_profiles(sections, start, spread, corners, 0.2)
        fit = fit_profiles(sections, start, spread, corners, 0.2)
        np.testing.assert_allclose(fit.parameters, plain, atol=1e-6)
        np.testing.assert_allclose(fit.deviation, deviation, rtol=1e-5)
        np.testing.assert_allclose(fit.noise_mm, noise, rtol=1e-5)


def test_closing_fills_valleys_and_leaves_ridges_and_outlines(rng):
    places = grid(60, 60, 1.0)
    frame = np.diag([1.0, -1.0, -1.0, 1.0])

    def filled(height):
        field = rasterise(cloud(places, height(*places.T), rng, 0), frame, 1.0)
        return closed(field.heights_mm, 12) - field.heights_mm

    assert np.nanmax(filled(lambda x, y: vee(y, 10, 6))) == pytest.approx(6, abs=1.5)
    assert np.nanmax(filled(lambda x, y: -vee(y, 10, 6))) < 1e-4
    assert np.nanmax(filled(lambda x, y: -(x**2) / 60)) < 1e-4


@pytest.mark.parametrize(("shape", "radius"), [((23, 19), 3.4), ((40, 61), 13.3), ((50, 30), 8.0)])
def test_closing_agrees_with_the_plain_definition(rng, shape, radius):
    heights = rng.random(shape).round(3)
    heights[rng.random(shape) < 0.1] = np.nan
    reach = range(-int(radius), int(radius) + 1)
    pad = 2 * int(radius) + 2
    low = np.pad(np.where(np.isnan(heights), -np.inf, heights), pad, constant_values=-np.inf)
    steps = [(i, j) for i in reach for j in reach if i * i + j * j <= radius**2]
    lifted = np.max([np.roll(low, step, (0, 1)) for step in steps], axis=0)
    lowered = np.min([np.roll(lifted, step, (0, 1)) for step in steps], axis=0)[pad:-pad, pad:-pad]
    expected = np.where(np.isnan(heights), np.nan, np.maximum(lowered, heights))
    np.testing.assert_allclose(closed(heights, radius), expected, atol=1e-6)


def test_smoothed_heights_are_means_of_the_filled_cells_around(rng):
    places = grid(40, 30, 1.0)
    places = places[rng.random(len(places)) < 0.8]
    field = rasterise(np.column_stack([places, rng.normal(300, 1, len(places))]), np.eye(4), 1.0)
    share = gaussian_filter(field.filled.astype(float), 1.7, mode="constant", truncate=3.0)
    total = gaussian_filter(np.nan_to_num(field.heights_mm), 1.7, mode="constant", truncate=3.0)
    expected = np.where(field.filled, total / share, np.nan)
    np.testing.assert_allclose(smoothed(field, 1.7), expected, atol=1e-3)


def test_coarser_raster_holds_the_same_points(rng):
    points = rng.uniform([0, 0, 0], [31, 23, 5], (2000, 3))
    fine = rasterise(points, np.eye(4), 0.5)
    coarse = coarser(fine, 3)
    assert coarse.counts.sum() == len(points)
    cells = np.floor((points[:, :2] + fine.T_field_cloud[:2, 3]) / 1.5).astype(int)
    for cell in np.unique(cells[:200], axis=0):
        inside = (cells == cell).all(axis=1)
        assert coarse.counts[tuple(cell)] == inside.sum()
        assert coarse.heights_mm[tuple(cell)] == pytest.approx(points[inside, 2].mean())


def test_coordinates_along_a_circle(rng):
    turn = np.linspace(0, 3, 400)
    circle = 40 * np.column_stack([np.cos(turn), np.sin(turn), 0 * turn])
    curve = build_curve(circle, np.array([0, 0, 1.0]), 0.5)
    angle, radius, height = rng.uniform(0.2, 2.8, 300), rng.uniform(36, 44, 300), rng.uniform(-2, 2, 300)
    points = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), height])
    strip = lay_straight(points, np.eye(4), curve, 6, 3, 3)
    assert len(strip.index) == 300
    np.testing.assert_allclose(strip.along, 40 * angle[strip.index], atol=0.1)
    np.testing.assert_allclose(strip.across, 40 - radius[strip.index], atol=0.02)
    np.testing.assert_allclose(strip.up, height[strip.index], atol=1e-9)


@pytest.mark.parametrize("at", [-12.0, 0.0, 22.0])
@pytest.mark.parametrize("long_mm", [10.0, 16.0])
def test_a_tack_weld_does_not_end_the_groove(at, long_mm, rng):
    """A quarter of the depth is left above the tack; the seam goes on behind it, and so does the path."""
    places = grid()
    tack = np.abs(places[:, 0] - at) < long_mm / 2
    heights = np.where(tack, np.maximum(vee(places[:, 1]), -1.6), vee(places[:, 1]))
    found = find_grooves(cloud(places, heights, rng))
    assert len(found.grooves) == 1
    assert np.ptp(found.grooves[0].root[:, 0]) > 0.97 * 120
    groove = (np.abs(places[:, 1]) < 4) & ~tack
    assert found.labels[groove].mean() > 0.98


def test_two_grooves_in_line_stay_two(rng):
    """Where the plate comes up between them there is no seam to follow."""
    places = grid()
    heights = np.where(np.abs(places[:, 0]) < 8, 0.0, vee(places[:, 1]))
    found = find_grooves(cloud(places, heights, rng))
    assert len(found.grooves) == 2
    assert found.labels[np.abs(places[:, 0]) < 5].mean() < 0.01
