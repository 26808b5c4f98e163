"""Laws of the arithmetic: neither the last digits of the points nor their order move a path, and the book's pins."""

import numpy as np
import pytest

from grindvision.vision import detect
from grindvision_book.machinery.arithmetic import PINS, pins
from tests.grinding_scene import arc_bead, pair


def moved(points, rng):
    """The points in another order, each by 1e-12 of its size elsewhere."""
    return rng.permutation(points * (1 + 1e-12 * rng.uniform(-1, 1, points.shape)))


def largest_change(seed, n_points):
    rng = np.random.default_rng([seed, 17])
    scene = pair(seed=seed, n_points=n_points, beads=[arc_bead()], angle_rad=rng.uniform(0.2, 0.6))
    found = detect(scene.sample, scene.test)
    again = detect(moved(scene.sample, rng), moved(scene.test, rng))
    spots = scene.test[::500]
    apart = (found.T_sample_test - again.T_sample_test) @ np.column_stack([spots, np.ones(len(spots))]).T
    return max(np.abs(found.path_points - again.path_points).max(), np.abs(apart).max())


@pytest.mark.parametrize("seed", range(3))
def test_order_and_last_digits_of_the_points_move_no_path(seed):
    assert largest_change(seed, 40_000) < 1e-6


@pytest.mark.full
def test_order_and_last_digits_move_no_path_of_a_hundred_scenes():
    changes = np.array([largest_change(seed, 40_000) for seed in range(100)])
    assert (changes < 1e-4).all(), f"seeds {np.flatnonzero(changes >= 1e-4)}"


def test_pins_leave_what_the_environment_says():
    assert not set(pins(dict.fromkeys(PINS, "x"))) & set(PINS)
    assert pins({"OMP_NUM_THREADS": "3"}).get("OMP_NUM_THREADS") is None
