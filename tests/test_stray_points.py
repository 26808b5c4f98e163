"""A few points that lie alone change nothing."""

import numpy as np
import pytest

from grindvision.errors import GrindvisionWarning
from grindvision.vision.change.detection import detect
from grindvision.vision.surface.normals import guess_viewpoint
from grindvision.vision.surface.stray_points import MAX_STRAY, stray_points
from tests.grinding_scene import arc_bead, pair


@pytest.fixture(scope="module")
def case():
    return pair(seed=5, n_points=12_000, beads=[arc_bead()])


STRAYS: dict[str, list[list[float]]] = {
    "a pixel without depth": [[0.0, 0, 0]],
    "beside the scanner": [[3.0, -2, 20]],
    "far behind": [[0.0, 0, 5000], [1e6, 0, 0]],
    "some of everything": [[0.0, 0, 0], [300, 0, 400], [301, 0, 400], [0, -4000, 0], [50, 60, 90]],
}


@pytest.mark.parametrize("name", STRAYS)
def test_points_that_lie_alone_are_found_and_no_others(case, name, rng):
    strays = np.array(STRAYS[name])
    mixed = np.concatenate([case.sample, strays])
    order = rng.permutation(len(mixed))
    found = stray_points(mixed[order])
    np.testing.assert_array_equal(np.sort(order[found]), np.arange(len(case.sample), len(mixed)))


def test_no_point_of_a_scan_is_stray_nor_a_second_part(case):
    assert not stray_points(case.sample).any()
    second = case.sample[: int(3 * MAX_STRAY * len(case.sample))] + [500.0, 0, 0]
    assert not stray_points(np.concatenate([case.sample, second])).any()


@pytest.mark.parametrize("name", ["a pixel without depth", "some of everything"])
def test_stray_points_change_no_result_and_are_said(case, name):
    strays = np.array(STRAYS[name])
    plain = detect(case.sample, case.test)
    with pytest.warns(GrindvisionWarning, match="lie alone"):
        found = detect(np.vstack([case.sample, strays]), np.vstack([strays, case.test]))
    np.testing.assert_allclose(found.T_sample_test, plain.T_sample_test, atol=1e-9)
    np.testing.assert_allclose(found.path_points, plain.path_points, atol=1e-9)


def test_a_deep_part_tells_by_its_rays_where_its_scanner_stood(rng):
    """A deep box, open to the scanner, whose walls hide one another from any far side."""
    x, y = rng.uniform(-50, 50, (2, 12_000))
    depth = np.where((np.abs(x) < 20) & (np.abs(y) < 20), 470.0, np.where(np.hypot(x, y) < 40, 430.0, 380.0))
    rays = np.column_stack([x / 400, y / 400, np.ones(len(x))])
    floors = rays * depth[:, None]
    np.testing.assert_array_equal(guess_viewpoint(floors, np.tile([0.0, 0, 1], (len(x), 1))), np.zeros(3))
