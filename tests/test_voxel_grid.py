"""The voxel grid against a plain dictionary and against Open3D on the same lattice, and its laws."""

import numpy as np
import open3d as o3d
import pytest

from grindvision.errors import DegenerateError, InputError
from grindvision.vision.surface.voxel_grid import voxel_grid


def plain_voxel_grid(points, size, origin):
    """Oracle: Eqs 1-2 word by word, one point at a time."""
    cells: dict[tuple[int, ...], list[np.ndarray]] = {}
    for point in points:
        cells.setdefault(tuple(int(i) for i in np.floor((point - origin) / size)), []).append(point)
    return {cell: np.mean(members, axis=0) for cell, members in cells.items()}


def sorted_voxel_grid(points, size, origin):
    """Oracle without a loop: cells, counts, the voxel of every point and the centroids, by sorting cell numbers."""
    cells, voxels, counts = np.unique(
        np.floor((points - origin) / size).astype(int), axis=0, return_inverse=True, return_counts=True
    )
    sums = [np.bincount(voxels, column, len(cells)) for column in (points - points[0]).T]
    return cells, counts, voxels, points[0] + np.column_stack(sums) / counts[:, None]


@pytest.fixture
def cloud(rng):
    return rng.normal([100, -200, 400], 30, (3000, 3))


def test_equals_the_plain_definition(cloud):
    origin = np.array([0.3, -0.2, 1.0])
    grid = voxel_grid(cloud, 7.0, origin)
    plain = plain_voxel_grid(cloud, 7.0, origin)
    assert [tuple(c) for c in grid.cells] == sorted(plain)
    np.testing.assert_allclose(grid.centroids, [plain[tuple(c)] for c in grid.cells], atol=1e-10)


@pytest.mark.parametrize("decimals", [1, 12])
def test_equals_the_sorted_twin_with_many_voxels_and_points_on_their_borders(rng, decimals):
    cloud = np.round(rng.uniform(-40, 60, (150_000, 3)), decimals)
    cloud = cloud[np.argsort(cloud[:, 0])]
    grid = voxel_grid(cloud, 1.3, (0.1, 0.0, -0.2))
    twin = sorted_voxel_grid(cloud, 1.3, (0.1, 0.0, -0.2))
    assert len(grid) > 100_000
    for ours, plain in zip((grid.cells, grid.counts, grid.voxel_of_point), twin, strict=False):
        np.testing.assert_array_equal(ours, plain)
    np.testing.assert_allclose(grid.centroids, twin[3], atol=1e-10)


def test_equals_open3d_on_its_lattice(cloud):
    peer = np.asarray(o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cloud)).voxel_down_sample(5.0).points)
    ours = voxel_grid(cloud, 5.0, cloud.min(axis=0) - 2.5).centroids
    assert len(ours) == len(peer)
    in_order = [a[np.lexsort(np.round(a, 7).T)] for a in (ours, peer)]
    np.testing.assert_allclose(in_order[0], in_order[1], atol=1e-9)


def test_equals_pcl_lattice_by_default(cloud):
    # PCL: ijk = floor(p / leaf) - floor(min / leaf), so its lattice passes through the frame's origin.
    leaf = 4.0
    ijk = np.floor(cloud / leaf) - np.floor(cloud.min(axis=0) / leaf)
    grid = voxel_grid(cloud, leaf)
    assert len(grid) == len(np.unique(ijk, axis=0))
    np.testing.assert_array_equal(grid.cells[grid.voxel_of_point], np.floor(cloud / leaf))


def test_order_of_points_does_not_matter_and_counts_add_up(cloud, rng):
    grid, shuffled = voxel_grid(cloud, 6.0), voxel_grid(rng.permutation(cloud), 6.0)
    np.testing.assert_array_equal(grid.cells, shuffled.cells)
    np.testing.assert_allclose(grid.centroids, shuffled.centroids, atol=1e-10)
    assert grid.counts.sum() == len(cloud)
    np.testing.assert_allclose(grid.counts @ grid.centroids / len(cloud), cloud.mean(axis=0), atol=1e-9)


def test_lattice_moves_with_the_cloud_when_told_to_and_metres_do_not_matter(cloud):
    shift = np.array([1.7, -3.3, 0.4])
    grid = voxel_grid(cloud, 6.0)
    moved = voxel_grid(cloud + shift, 6.0, shift)
    assert (moved.cells == grid.cells).all(axis=1).mean() > 0.999
    metres = voxel_grid(cloud / 1000, 0.006)
    np.testing.assert_allclose(metres.centroids * 1000, grid.centroids, atol=1e-9)


def test_centroids_lie_in_their_voxels_and_values_are_averaged(cloud):
    grid = voxel_grid(cloud, 8.0)
    assert np.abs(grid.centroids - grid.centres).max() <= 4.0 + 1e-9
    np.testing.assert_allclose(grid.mean(cloud), grid.centroids, atol=1e-9)
    np.testing.assert_allclose(grid.mean(cloud[:, 2]), grid.centroids[:, 2], atol=1e-9)


def test_bad_input_is_refused(cloud):
    with pytest.raises(InputError, match="voxel size is 0"):
        voxel_grid(cloud, 0)
    with pytest.raises(InputError, match="too many to number"):
        voxel_grid(cloud, 1e-9)
    with pytest.raises(InputError, match="NaN"):
        voxel_grid(np.full((3, 3), np.nan), 1.0)
    with pytest.raises(InputError, match="origin_mm"):
        voxel_grid(cloud, 1.0, (0.0, 0.0))
    with pytest.raises(DegenerateError):
        voxel_grid(np.empty((0, 3)), 1.0)
