"""Way points of a groove: on its root, evenly spaced, in order; the paper's recipe as printed."""

import numpy as np
import pytest

from grindvision.cell import weld_scene
from grindvision.errors import InputError
from grindvision.vision.seam.groove import find_grooves
from grindvision.vision.seam.seam_path import descended_median, root_path, slab_path, weiszfeld_median
from tests.groove_scenes import cloud, grid, straight_groove, vee


def test_way_points_lie_on_the_root_at_equal_distances(rng):
    points, _ = straight_groove(rng)
    path = root_path(find_grooves(points).grooves[0], 21)
    steps = np.linalg.norm(np.diff(path.points, axis=0), axis=1)
    assert len(path) == 21
    assert np.ptp(steps) < 0.05 * steps.mean()
    assert np.abs(path.points[:, 1]).max() < 0.3 and np.abs(path.points[:, 2] - 406).max() < 0.3
    assert (path.normals @ [0, 0, -1] > 0.999).all()


def test_ring_path_closes(rng):
    places = grid(110, 110)
    path = root_path(find_grooves(cloud(places, vee(np.hypot(*places.T) - 32), rng)).grooves[0], 40)
    assert path.closed
    steps = np.linalg.norm(np.diff(path.points, axis=0, append=path.points[:1]), axis=1)
    assert np.ptp(steps) < 0.3 * steps.mean()
    off = np.abs(np.hypot(path.points[:, 0], path.points[:, 1]) - 32)
    assert off.mean() < 0.4 and off.max() < 2.5


def test_root_beats_the_printed_recipe():
    """The paper's medians sit part-way up the walls; the root line is where the walls meet."""
    scene = weld_scene("curve", np.random.default_rng(5), every=2)
    found = find_grooves(scene.points)
    normals = np.tile([0.0, 0, -1], (int(found.labels.sum()), 1))
    ours, printed = root_path(found.grooves[0]), slab_path(scene.points[found.labels], normals)

    def error(path):
        return np.linalg.norm(path.points[:, None] - scene.root_mm[None], axis=2).min(axis=1).mean()

    assert error(ours) < 1.0 < error(printed)


def test_descent_and_weiszfeld_agree(rng):
    """As far as the descent's printed stopping rule lets it: it looks at the cost, which is flat near the median."""
    for _ in range(5):
        points = rng.normal(0, 3, (60, 3)) * [2, 1, 0.5]
        np.testing.assert_allclose(descended_median(points), weiszfeld_median(points), atol=0.06)


def test_median_resists_outliers(rng):
    points = rng.normal(0, 0.1, (50, 3))
    points[:10] += 100
    assert np.linalg.norm(weiszfeld_median(points)) < 0.2


def test_slabs_cover_the_longest_axis_in_order(rng):
    points = np.column_stack([rng.uniform(0, 100, 4000), rng.uniform(-3, 3, (4000, 2))])
    path = slab_path(points, np.tile([0, 0, 1.0], (4000, 1)), 50)
    along = path.points[:, 0] if path.points[-1, 0] > path.points[0, 0] else path.points[::-1, 0]
    np.testing.assert_allclose(along, np.arange(1, 100, 2), atol=0.5)
    np.testing.assert_allclose(np.linalg.norm(path.normals, axis=1), 1)


def test_bad_requests_are_named(rng):
    points, _ = straight_groove(rng)
    groove = find_grooves(points).grooves[0]
    with pytest.raises(InputError, match="1 way points"):
        root_path(groove, 1)
    with pytest.raises(InputError, match="normals"):
        slab_path(points, points[:5])


def test_a_slabs_normal_is_the_unit_sum_of_its_points_normals():
    """Eq 8 by hand: three normals along z and one along x give (1, 0, 3) / sqrt(10)."""
    along = np.repeat(np.arange(0.0, 40.0, 10.0), 4)
    points = np.column_stack([along, np.tile([-1.0, 1, -1, 1], 4), np.tile([-0.1, 0.1, 0.1, -0.1], 4)])
    for first in range(4):
        normals = np.tile([0, 0, 1.0], (4, 1))
        normals[first] = [1.0, 0, 0]
        path = slab_path(points, np.tile(normals, (4, 1)), 4)
        np.testing.assert_allclose(path.normals, np.tile(np.array([1, 0, 3]) / np.sqrt(10), (4, 1)), atol=1e-12)
