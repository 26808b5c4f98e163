"""The paper's detector: every fast kernel against its plain twin, and the detector on its own ground."""

import numpy as np
import pytest

from grindvision.cell import weld_scene
from grindvision.errors import DegenerateError, InputError, NoGrooveError
from grindvision.vision.seam.gfh import angle_histograms, base_normal, groove_features, plane_normals, vote
from grindvision.vision.seam.gfh_groove import GfhSettings, find_groove_gfh
from grindvision.vision.seam.mls import smooth_mls
from grindvision.vision.surface.clustering import euclidean_clusters
from tests.groove_scenes import overlap, straight_groove


@pytest.fixture
def surface(rng):
    """A gently curved, noisy patch."""
    xy = rng.uniform(0, 20, (700, 2))
    return np.column_stack([xy, 0.02 * xy[:, 0] ** 2 + 0.1 * rng.standard_normal(700) + 100])


def plain_mls(points, radius):
    """Moving least squares of order 2 as PCL describes it, one point at a time."""
    moved = points.copy()
    for p, point in enumerate(points):
        near = points[np.linalg.norm(points - point, axis=1) <= radius]
        mean = near.mean(axis=0)
        frame = np.linalg.eigh((near - mean).T @ (near - mean))[1]
        normal, u, v = frame[:, 0], frame[:, 2], frame[:, 1]
        foot = point - normal * ((point - mean) @ normal)
        away = near - foot
        a, b, f = away @ u, away @ v, away @ normal
        weights = np.exp(-(away**2).sum(axis=1) / radius**2)
        terms = np.column_stack([np.ones(len(a)), a, b, a * a, a * b, b * b])
        fit = np.linalg.solve(terms.T @ (weights[:, None] * terms), terms.T @ (weights * f))
        moved[p] = foot + fit[0] * normal
    return moved


def test_mls_agrees_with_its_plain_twin(surface):
    np.testing.assert_allclose(smooth_mls(surface, 5.0), plain_mls(surface, 5.0), atol=2e-4)


def test_mls_leaves_a_paraboloid_and_flattens_noise(rng):
    xy = rng.uniform(-15, 15, (2000, 2))
    smooth = np.column_stack([xy, 0.01 * xy[:, 0] ** 2 - 0.02 * xy[:, 1] ** 2])
    inner = np.abs(xy).max(axis=1) < 10
    assert np.abs(smooth_mls(smooth, 4.0) - smooth)[inner].max() < 0.02
    noisy = smooth + np.array([0, 0, 0.2]) * rng.standard_normal((2000, 1))
    assert np.std((smooth_mls(noisy, 4.0) - smooth)[inner, 2]) < 0.08


def test_normals_agree_with_principal_components(surface):
    normals = plane_normals(surface, 3.0, [0, 0, 1])
    assert (normals[:, 2] > 0).all()
    for p in range(0, 700, 37):
        near = surface[np.linalg.norm(surface - surface[p], axis=1) <= 3.0]
        expected = np.linalg.eigh(np.cov(near.T))[1][:, 0]
        assert abs(normals[p] @ expected) == pytest.approx(1, abs=1e-5)


def test_features_agree_with_the_angles_of_single_points(surface):
    normals = plane_normals(surface, 3.0, [0, 0, 1])
    features = groove_features(surface, normals, 3.0)
    for p in range(0, 700, 37):
        angles = angle_histograms(surface, normals, p, 3.0)
        assert features.local_deg2[p] == pytest.approx(angles.local_deg.var(), rel=2e-3, abs=2e-3)
        assert features.global_deg2[p] == pytest.approx(angles.global_deg.var(), rel=2e-3, abs=2e-3)
    np.testing.assert_allclose(features.spread_deg**4, features.local_deg2 * features.global_deg2)


def test_features_of_a_plane_are_zero(rng):
    points = np.column_stack([rng.uniform(0, 20, (500, 2)), np.zeros(500)])
    features = groove_features(points, np.tile([0.0, 0, 1], (500, 1)), 3.0)
    assert features.spread_deg.max() < 0.05


def test_vote_is_a_majority_of_all_neighbours(surface, rng):
    marked = rng.random(700) < 0.5
    result = vote(surface, marked, 2.5)
    for p in range(0, 700, 23):
        near = np.linalg.norm(surface - surface[p], axis=1) <= 2.5
        assert result[p] == (2 * marked[near].sum() > near.sum())


def test_clusters_are_the_components_of_the_distance_graph(rng):
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import distance_matrix

    points = rng.uniform(0, 30, (250, 3))
    ours = euclidean_clusters(points, 3.0)
    _, plain = connected_components(distance_matrix(points, points) <= 3.0)
    assert len(set(zip(ours, plain, strict=True))) == ours.max() + 1 == plain.max() + 1
    sizes = np.bincount(ours)
    assert (np.diff(sizes) <= 0).all()


def test_kernels_do_not_depend_on_the_order_of_the_points(surface, rng):
    order = rng.permutation(len(surface))
    np.testing.assert_allclose(smooth_mls(surface[order], 5.0), smooth_mls(surface, 5.0)[order], atol=1e-4)


def test_the_paper_finds_a_groove_on_a_plate_and_marks_a_box_edge_too():
    line, box = (weld_scene(kind, np.random.default_rng(1), every=3) for kind in ("line", "box"))
    settings = GfhSettings(normal_radius_mm=3, histogram_radius_mm=3)
    found = find_groove_gfh(line.points, settings)
    assert overlap(found.labels, line.labels) > 0.5
    rounded = find_groove_gfh(box.points, settings)
    assert (rounded.above & ~box.labels).sum() > (found.above & ~line.labels).sum()


def test_plain_plate_has_no_groove_for_the_paper_either(rng):
    points, _ = straight_groove(rng, depth_mm=1e-9, noise_mm=0.02)
    with pytest.raises(NoGrooveError, match="spread stays below"):
        find_groove_gfh(points)


def test_bad_settings_are_named(surface):
    with pytest.raises(InputError, match="radius is 0"):
        smooth_mls(surface, 0)
    with pytest.raises(InputError, match="order is 3"):
        smooth_mls(surface, 5, 3)
    with pytest.raises(InputError, match="normal radius"):
        plane_normals(surface, -1, [0, 0, 1])
    with pytest.raises(InputError, match="cluster distance"):
        euclidean_clusters(surface, 0)
    with pytest.raises(DegenerateError, match="cancel"):
        base_normal([[0, 0, 1], [0, 0, -1.0]])
