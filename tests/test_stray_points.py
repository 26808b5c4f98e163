"""A few points that lie alone change nothing."""

import warnings

import numpy as np
import pytest
from scipy.spatial import cKDTree

from grindvision.errors import GrindvisionWarning
from grindvision.geometry import move_points
from grindvision.vision.change.detection import detect
from grindvision.vision.surface.normals import guess_viewpoint
from grindvision.vision.surface.stray_points import MAX_STRAY, stray_points
from tests.grinding_scene import arc_bead, pair


@pytest.fixture(scope="module")
def case():
    return pair(seed=5, n_points=22_000, beads=[arc_bead()])


@pytest.fixture(scope="module")
def plain(case):
    found = detect(case.sample, case.test)
    assert len(found.path_points) == 6
    return found


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
def test_stray_points_change_no_result_and_are_said(case, plain, name):
    strays = np.array(STRAYS[name])
    with pytest.warns(GrindvisionWarning, match="lies? alone"):
        found = detect(np.vstack([case.sample, strays]), np.vstack([strays, case.test]))
    np.testing.assert_allclose(found.T_sample_test, plain.T_sample_test, atol=1e-9)
    np.testing.assert_allclose(found.path_points, plain.path_points, atol=1e-9)


def scattered(kind, cloud, rng):
    """Stray points (n, 3), a thousandth of a cloud, of a kind."""
    count = len(cloud) // 1000
    low, high, middle = cloud.min(axis=0), cloud.max(axis=0), cloud.mean(axis=0)
    some = cloud[rng.integers(len(cloud), size=count)]
    depths = np.linalg.norm(some, axis=1, keepdims=True)
    return {
        "without depth": np.zeros((count, 3)),
        "near the scanner": rng.uniform(-15, 15, (count, 3)) + [0, 0, 25],
        "far away": middle + rng.normal(size=(count, 3)) * 2000,
        "around the part": middle + 2.5 * rng.uniform(low - middle, high - middle, (count, 3)),
        "among the part": rng.uniform(low, high, (count, 3)),
        "inside the part": some * (1 + rng.uniform(2, 25, (count, 1)) / depths),
        "along the rays": some * rng.uniform(0.05, 1, (count, 1)),
        "copies": some,
        "beside the surface": some * (1 + rng.normal(0, 1.5, (count, 1)) / depths),
    }[kind]


KINDS = ["among the part", "inside the part"]
MORE_KINDS = [
    "without depth", "near the scanner", "far away", "around the part", "along the rays", "copies", "beside the surface"
]  # fmt: skip


@pytest.mark.parametrize("kind", [*KINDS, *(pytest.param(one, marks=pytest.mark.full) for one in MORE_KINDS)])
def test_a_thousandth_of_stray_points_anywhere_moves_no_result_beyond_its_sigma(case, plain, kind, rng):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GrindvisionWarning)
        found = detect(*(np.vstack([cloud, scattered(kind, cloud, rng)]) for cloud in (case.sample, case.test)))
    off, sigma = plain_path_moved(plain, found)
    assert (off < sigma).all()
    assert found.path_points.shape == plain.path_points.shape
    assert (np.linalg.norm(found.path_points - plain.path_points, axis=1) < sigma).all()


def test_a_clump_in_mid_air_gets_no_path(case, plain, rng):
    clump = case.test.mean(axis=0) - [30, 0, 15] + rng.normal(size=(22, 3))
    with pytest.warns(GrindvisionWarning, match="touching nothing of the part, the largest"):
        found = detect(case.sample, np.vstack([case.test, clump]))
    assert len(found.beads) == 1
    away, _ = cKDTree(plain.beads[0].ridge).query(found.path_points)
    assert away.max() < 0.2


def plain_path_moved(plain, found):
    """How far the found pose moves each point of the plain path, and what the plain pose's covariance says of it."""
    places, registration = plain.path_points, plain.registration
    moved, wanted = (move_points(one.T_sample_test, places) for one in (found, plain))
    arms = wanted - registration.centre_mm
    jacobians = np.concatenate([np.tile(np.eye(3), (len(arms), 1, 1)), -np.cross(np.eye(3), arms[:, None])], axis=2)
    spread = np.einsum("nij,jk,nik->n", jacobians, registration.total_covariance, jacobians)
    return np.linalg.norm(moved - wanted, axis=1), np.sqrt(spread)


def test_a_deep_part_tells_by_its_rays_where_its_scanner_stood(rng):
    """A deep box, open to the scanner, whose walls hide one another from any far side."""
    x, y = rng.uniform(-50, 50, (2, 12_000))
    depth = np.where((np.abs(x) < 20) & (np.abs(y) < 20), 470.0, np.where(np.hypot(x, y) < 40, 430.0, 380.0))
    rays = np.column_stack([x / 400, y / 400, np.ones(len(x))])
    floors = rays * depth[:, None]
    np.testing.assert_array_equal(guess_viewpoint(floors, np.tile([0.0, 0, 1], (len(x), 1))), np.zeros(3))
