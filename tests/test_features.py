"""Normals, surfels and FPFH: against plain twins, Open3D, and the laws they must keep."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from grindvision.errors import DegenerateError, InputError
from grindvision.geometry import move_points, random_rotation, rigid, rotate_vectors
from grindvision.vision.surface.fpfh import BINS, _bin_of_direction, compute_fpfh, mirrored_fpfh
from grindvision.vision.surface.normals import (
    _covered_cells,
    estimate_normals,
    guess_viewpoint,
    orient_by_neighbours,
    seen_along,
    smallest_eigenpair,
)
from grindvision.vision.surface.surfels import build_surfels, surface_area
from tests.grinding_scene import pair, plate_height, scan, view


def plain_fpfh(points, normals, radius):
    """Eqs 3-5 pair by pair, straight from the text."""
    neighbours = cKDTree(points).query_ball_point(points, radius)
    simple = np.zeros((len(points), 33))
    for p, around in enumerate(neighbours):
        others = [q for q in around if q != p]
        for q in others:
            line = points[q] - points[p]
            d = np.linalg.norm(line)
            source, target = p, q
            if abs(normals[p] @ line) < abs(normals[q] @ line):
                source, target, line = q, p, -line
            u = normals[source]
            v = np.cross(line, u)
            v /= np.linalg.norm(v)
            w = np.cross(u, v)
            n = normals[target]
            angles = np.arctan2(w @ n, u @ n) / (2 * np.pi) + 0.5, (v @ n + 1) / 2, (u @ line / d + 1) / 2
            for third, share in enumerate(angles):
                simple[p, 11 * third + int(np.clip(11 * share, 0, 10))] += 100 / len(others)
    full = simple.copy()
    for p, around in enumerate(neighbours):
        weighted = np.sum([simple[q] / np.sum((points[q] - points[p]) ** 2) for q in around if q != p], axis=0)
        for rows in np.split(np.arange(33), 3):
            full[p, rows] += 100 * weighted[rows] / weighted[rows].sum()
    return full


@pytest.fixture(scope="module")
def patch():
    rng = np.random.default_rng(3)
    points = scan(plate_height, view(0.2), 4000, rng, window=(20, 90, -10, 60), noise_mm=0.02)
    return points, estimate_normals(points, 4.0, 30, np.zeros(3))


def test_the_bin_of_a_direction_is_that_of_its_angle(rng):
    angles = rng.uniform(-np.pi, np.pi, 5000)
    lengths = 10.0 ** rng.uniform(-6, 6, 5000)
    found = [_bin_of_direction(x, y) for x, y in zip(lengths * np.cos(angles), lengths * np.sin(angles), strict=True)]
    np.testing.assert_array_equal(found, np.floor(BINS * (angles + np.pi) / (2 * np.pi)))
    assert _bin_of_direction(0.0, 0.0) == BINS // 2


def test_fpfh_is_the_plain_twin_s(patch):
    points, normals = patch[0][:600], patch[1][:600]
    np.testing.assert_allclose(compute_fpfh(points, normals, 5.0), plain_fpfh(points, normals, 5.0), atol=1e-9)


def test_eq_5_as_printed_is_the_mean_of_the_neighbours_over_their_distance(patch):
    points, normals = patch
    neighbours = cKDTree(points).query_ball_point(points, 5.0)
    full = compute_fpfh(points, normals, 5.0, as_printed=True)
    for size in (0.1, 10.0):  # the own part keeps its sum of 100, the neighbours' part scales with one over the unit
        scaled = compute_fpfh(size * points, normals, size * 5.0, as_printed=True)
        own = (full - size * scaled) / (1 - size)
        np.testing.assert_allclose(own.reshape(-1, 3, 11).sum(axis=2), 100, atol=1e-6)
    p = 7
    pairs = [(q, np.linalg.norm(points[q] - points[p])) for q in neighbours[p] if q != p]
    expected = own[p] + np.mean([own[q] / distance for q, distance in pairs], axis=0)
    np.testing.assert_allclose(full[p], expected, atol=1e-6)


def test_fpfh_is_open3d_s_on_the_same_neighbourhoods(patch):
    import open3d as o3d

    points, normals = patch
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.normals = o3d.utility.Vector3dVector(normals)
    search = o3d.geometry.KDTreeSearchParamHybrid(radius=6.0, max_nn=50)
    theirs = np.asarray(o3d.pipelines.registration.compute_fpfh_feature(cloud, search).data).T
    np.testing.assert_allclose(compute_fpfh(points, normals, 6.0, 50), theirs, atol=1e-8)


def test_fpfh_does_not_see_the_pose_nor_the_unit(patch, rng):
    points, normals = patch
    T_other = rigid(random_rotation(rng), rng.normal(size=3) * 50)
    moved = compute_fpfh(move_points(T_other, points), rotate_vectors(T_other, normals), 5.0)
    here = compute_fpfh(points, normals, 5.0)
    assert np.mean(np.abs(moved - here).max(axis=1) < 1e-6) > 0.97  # the rest sits on a bin's edge
    in_metres = compute_fpfh(points / 1000, normals, 5.0 / 1000)
    assert np.mean(np.abs(in_metres - here).max(axis=1) < 1e-6) > 0.97


def test_reversed_normals_mirror_the_histogram(patch):
    points, normals = patch
    mirrored = mirrored_fpfh(compute_fpfh(points, normals, 5.0))
    assert np.mean(np.abs(mirrored - compute_fpfh(points, -normals, 5.0)).max(axis=1) < 1e-6) > 0.97


def test_fpfh_wants_a_normal_for_every_point(patch):
    with pytest.raises(InputError, match="come in pairs"):
        compute_fpfh(patch[0], patch[1][:-1], 5.0)


def test_least_spread_is_the_smallest_eigenpair(rng):
    for scale in (1e-8, 1.0, 1e6):
        for _ in range(50):
            a = rng.normal(size=(3, 3)) * [1, 0.5, 0.05]
            matrix = scale * a.T @ a
            value, *vector = smallest_eigenpair(*matrix[np.triu_indices(3)])
            values, vectors = np.linalg.eigh(matrix)
            assert value == pytest.approx(values[0], abs=1e-10 * values[2])
            assert abs(np.dot(vector, vectors[:, 0])) == pytest.approx(1, abs=1e-6)


def test_normals_of_a_sphere_point_at_the_viewpoint(rng):
    directions = rng.normal(size=(6000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    seen = directions[directions[:, 2] > 0.2]
    normals = estimate_normals(seen * 50, 6.0, None, (0, 0, 500))
    assert np.degrees(np.arccos(np.clip((normals * seen).sum(axis=1), -1, 1))).max() < 6
    unseen_side = orient_by_neighbours(seen * 50, np.where(rng.random((len(seen), 1)) < 0.5, normals, -normals), 6.0)
    assert ((unseen_side * seen).sum(axis=1) > 0).mean() > 0.999


def test_a_flat_part_in_the_base_frame_faces_up_and_is_not_seen_edge_on(rng):
    plate = np.column_stack([rng.uniform(-80, 80, 4000), rng.uniform(500, 660, 4000), rng.normal(20, 0.05, 4000)])
    normals = estimate_normals(plate, 12.0, viewpoint_mm=None)
    assert (normals[:, 2] > 0.9).all()
    assert guess_viewpoint(plate) is not None
    assert guess_viewpoint(plate, normals) is None
    assert guess_viewpoint(plate + [0, 0, 400.0], normals) is not None


@pytest.fixture
def folded_scan():
    """A ball over a bowl, two pieces that do not touch, as a scanner at the origin, 800 mm above, sees them."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(-90, 90, 3.0), np.arange(-90, 90, 3.0)))
    away = np.hypot(x, y)
    ball, bowl = np.sqrt(np.maximum(45**2 - away**2, 0)), (away / 90) ** 2 * 60 - 90
    kept = (away < 42) | ((away > 48) & (away < 90))
    return np.column_stack([x, -y, 800 - np.where(away < 42, ball, bowl)])[kept]


def test_without_a_viewpoint_all_normals_of_a_scan_face_one_side(folded_scan, rng):
    """However deep its folds and gaps: each piece for itself, bulging, would have the ball and the bowl disagree."""
    seen = estimate_normals(folded_scan, 8.0, 40, np.zeros(3))
    for _ in range(5):
        turn, shift = random_rotation(rng), rng.uniform(-50, 50, 3)
        guessed = estimate_normals((folded_scan - [0, 0, 800]) @ turn.T + shift, 8.0, 40)
        same = ((guessed @ turn) * seen).sum(axis=1) > 0
        assert max(same.mean(), 1 - same.mean()) > 0.97


def test_an_origin_beside_the_line_of_sight_is_no_scanner(folded_scan):
    normals = estimate_normals(folded_scan, 8.0, 40, np.zeros(3))
    assert guess_viewpoint(folded_scan, normals) is not None
    for side in ([500, 0, 0], [0, -400, 100], [-300, 300, 50]):
        assert guess_viewpoint(folded_scan - [0, 0, 800] - side, normals) is None


@pytest.mark.parametrize("aside_deg", [0, 60, 80])
def test_an_origin_from_which_half_of_a_ball_is_seen_from_behind_is_no_scanner(rng, aside_deg):
    """A cloud of a ball's upper half whose file counts from some place aside."""
    directions = rng.normal(size=(8000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    seen = directions[directions[:, 2] > 0.2]
    normals = np.where(rng.random((len(seen), 1)) < 0.5, seen, -seen)
    aside = np.radians(aside_deg)
    origin = 350 * np.array([np.sin(aside), 0.0, np.cos(aside)])
    assert (guess_viewpoint(50 * seen - origin, normals) is not None) == (aside_deg == 0)


def test_covered_cells_are_counted_as_by_hand(rng):
    away = rng.normal(scale=[30, 20, 5], size=(500, 3))
    directions = np.array([random_rotation(rng)[2] for _ in range(20)])
    counts = _covered_cells(away, directions, 4.0)
    for n, count in zip(directions, counts, strict=True):
        u = np.array([0, n[2], -n[1]]) if abs(n[0]) < 0.6 else np.array([-n[2], 0, n[0]])
        axes = np.array([u, np.cross(n, u)]) / np.linalg.norm(u)
        assert count == len(np.unique(np.floor(away @ axes.T / 4.0), axis=0))
    far = np.concatenate([away, [[1e7, 0, 0]]])
    assert (
        _covered_cells(far, np.array([[0, 0, 1.0]]), 4.0)[0]
        == _covered_cells(away, np.array([[0, 0, 1.0]]), 4.0)[0] + 1
    )


def test_a_whole_model_is_not_seen_at_one_glance(rng):
    sphere = rng.standard_normal((4000, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    assert seen_along(50 * sphere, sphere, 6.0) is None
    plate = np.column_stack([rng.uniform(-90, 90, (4000, 2)), np.repeat([0.0, 12.0], 2000)])
    assert seen_along(plate, np.tile([0.0, 0, 1], (4000, 1)), 8.0) is None


def test_the_viewpoint_is_guessed_only_where_it_can_be():
    scanned = pair().sample
    np.testing.assert_array_equal(guess_viewpoint(scanned), np.zeros(3))
    assert guess_viewpoint(scanned - scanned.mean(axis=0)) is None
    with pytest.raises(DegenerateError):
        guess_viewpoint(np.empty((0, 3)))


def test_surfels_lie_on_the_plane_and_know_the_noise(rng):
    x, y = rng.uniform(0, 40, size=(2, 40_000))
    points = np.column_stack([x, y, 0.3 * x - 0.2 * y + rng.normal(scale=0.05, size=x.size)])
    surfels = build_surfels(points, 2.0)
    assert surfels.counts.sum() == len(points)
    normal = np.array([-0.3, 0.2, 1]) / np.linalg.norm([-0.3, 0.2, 1])
    inner = (np.abs(surfels.points[:, :2] - 20) < 15).all(axis=1) & (surfels.counts > 30)
    assert np.abs(surfels.normals[inner] @ normal).min() > 0.9998
    assert np.median(surfels.noise_mm[inner]) == pytest.approx(0.05 * normal[2], rel=0.05)
    assert np.median(surfels.roughness_mm[inner]) == pytest.approx(0.05 * normal[2], rel=0.05)


def test_surfels_do_not_depend_on_the_order_of_points(rng):
    points = pair(n_points=5000).sample
    here, there = build_surfels(points, 3.0), build_surfels(points[rng.permutation(len(points))], 3.0)
    sort = [np.lexsort(np.round(s.points, 6).T) for s in (here, there)]
    np.testing.assert_allclose(here.points[sort[0]], there.points[sort[1]], atol=1e-9)
    np.testing.assert_allclose(here.roughness_mm[sort[0]], there.roughness_mm[sort[1]], atol=1e-9)


def test_the_area_of_a_square_is_about_right(rng):
    points = np.column_stack([rng.uniform(0, 100, size=(200_000, 2)), np.zeros(200_000)])
    tilted = points @ random_rotation(rng).T
    assert surface_area(tilted) == pytest.approx(10_000, rel=0.35)
    with pytest.raises(DegenerateError, match="coincide"):
        surface_area(np.zeros((50, 3)))


def test_planes_of_a_larger_scan_are_larger_and_their_variance_with_the_square(rng):
    points = np.column_stack([rng.uniform(-20, 20, (4000, 2)), rng.normal(0, 0.1, 4000)])
    points[:, 2] += 0.3 * np.sin(points[:, 0])  # roughness beside the noise
    small, large = build_surfels(points, 2.0), build_surfels(4 * points, 8.0)
    assert (small.roughness_mm > small.noise_mm).any()
    np.testing.assert_allclose(large.planes, small.planes * [4, 4, 4, 1, 1, 1, 1, 16], rtol=1e-6, atol=1e-9)
    noise, counts = small.noise_mm, small.counts
    bound = (noise**2 / counts)[small.grid.order]
    assert (small.planes[:, 7] >= bound * (1 - 1e-12)).all()
