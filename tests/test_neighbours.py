import numpy as np
import pytest
from scipy.spatial import cKDTree

from grindvision.errors import InputError
from grindvision.geometry.hash_grid import build_cells
from grindvision.geometry.neighbours import nearest, within_radius


def test_the_nearest_point_is_the_kd_tree_s(rng):
    points, queries = rng.normal(size=(3000, 3)) * 10, rng.normal(size=(500, 3)) * 14
    for size, most in ((2.0, 5.0), (7.0, 3.0), (0.5, 1.0)):
        indices, distances = nearest(build_cells(points, size), queries, most)
        expected, _ = cKDTree(points).query(queries)
        found = expected <= most
        np.testing.assert_array_equal(indices >= 0, found)
        np.testing.assert_allclose(distances[found], expected[found], rtol=1e-12)
        assert np.isinf(distances[~found]).all()


@pytest.mark.parametrize("size, most", [(0.05, 0.4), (1.0, 7.5)])
def test_searches_far_from_all_points_are_the_kd_tree_s(rng, size, most):
    """Two clusters, of more cells along an axis than there are blocks, with much empty space in between and around."""
    points = np.concatenate([rng.normal(size=(2000, 3)), rng.normal(size=(50, 3)) + [40.0, 0, -3]])
    queries = np.concatenate([rng.uniform(-12, 50, size=(2000, 3)), points[::7] + 0.9 * size, [[1e6, -1e6, 0.0]]])
    indices, distances = nearest(build_cells(points, size), queries, most)
    expected, there = cKDTree(points).query(queries, distance_upper_bound=most)
    np.testing.assert_array_equal(indices, np.where(np.isfinite(expected), there, -1))
    np.testing.assert_allclose(distances, expected, rtol=1e-12)
    assert 20 < (indices >= 0).sum() < len(queries) - 20


def test_radius_neighbours_are_the_kd_tree_s(rng):
    points = rng.uniform(0, 20, size=(1500, 3))
    around = within_radius(build_cells(points, 3.0), points, 3.0)
    for query, expected in enumerate(cKDTree(points).query_ball_point(points, 3.0)):
        assert sorted(around.indices[around.starts[query] : around.starts[query + 1]]) == sorted(expected)


def test_the_nearest_few_come_in_order(rng):
    points = rng.uniform(0, 20, size=(1500, 3))
    around = within_radius(build_cells(points, 6.0), points[:50], 6.0, max_neighbours=5)
    distances, indices = cKDTree(points).query(points[:50], k=5)
    np.testing.assert_array_equal(around.indices.reshape(50, 5), indices)
    np.testing.assert_allclose(np.sqrt(around.squared_mm2.reshape(50, 5)), distances, rtol=1e-12)


def test_cells_partition_the_points(rng):
    points = rng.normal(size=(4000, 3)) * 30
    grid = build_cells(points, 5.0)
    assert sorted(grid.order) == list(range(4000))
    for cell in range(len(grid.starts) - 1):
        members = points[grid.order[grid.starts[cell] : grid.starts[cell + 1]]]
        assert len(np.unique(np.floor((members - grid.origin_mm) / 5.0), axis=0)) == 1


@pytest.mark.parametrize(("size", "spread"), [(0.0, 1.0), (-1.0, 1.0), (1e-9, 1e3)])
def test_impossible_cells_are_refused(rng, size, spread):
    with pytest.raises(InputError):
        build_cells(rng.normal(size=(10, 3)) * spread, size)


def test_a_radius_above_the_cell_size_is_refused(rng):
    points = rng.normal(size=(10, 3))
    with pytest.raises(InputError, match="exceeds the cell size"):
        within_radius(build_cells(points, 1.0), points, 2.0)
