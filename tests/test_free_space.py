"""What stands where the sample's scanner saw through is new material, whichever way its faces look."""

import warnings

import numpy as np
import pytest
from scipy.spatial import cKDTree

from grindvision.geometry import move_points
from grindvision.vision.change.detection import detect
from grindvision.vision.change.visibility import in_free_space
from grindvision.vision.surface.surfels import build_surfels
from tests.grinding_scene import arc_bead, pair


@pytest.fixture(scope="module")
def step():
    """Surfels of a floor at 400 mm and of a table 20 mm above its half, seen by a scanner at the origin."""
    rng = np.random.default_rng(7)
    x, y = rng.uniform(-40, 40, (2, 30_000))
    depth = np.where(x < 0, 380.0, 400.0)
    return build_surfels(np.column_stack([x * depth / 400, y * depth / 400, depth]), 1.5)


@pytest.mark.parametrize(
    ("place", "free"),
    [
        ((15, 0, 396), True),  # above the floor
        ((15, 0, 404), False),  # below it
        ((-15, 0, 376), True),
        ((-15, 0, 390), False),  # behind the table, where nothing was seen
        ((0.2, 0, 390), False),  # at the table's edge: a wall that the scanner sees edge-on
        ((60, 0, 390), False),  # beside all that was seen
        ((15, 0, 399.6), False),  # the floor itself
    ],
)
def test_only_what_stands_before_a_surface_seen_all_around_is_free(step, place, free):
    assert in_free_space(step, np.zeros(3), np.array([place], dtype=float))[0] == free


def test_without_a_viewpoint_nothing_is_free(step):
    assert not in_free_space(step, None, np.array([[15.0, 0, 396]])).any()
    assert in_free_space(step, np.zeros(3), np.empty((0, 3))).shape == (0,)


def fin(rng, height_mm, lean_rad, spacing_mm):
    """Points (N, 3) in the part's frame of both sides of a thin fin 40 mm long that leans to +y."""
    count = int(40 * height_mm / spacing_mm**2)
    x, up = rng.uniform(-20, 20, count), rng.uniform(0, height_mm, count)
    return np.column_stack([x - 15, 3 + up * np.sin(lean_rad), 4.2 + up * np.cos(lean_rad)])


@pytest.mark.parametrize(("height_mm", "lean_deg"), [(5.0, 0.0), pytest.param(6.0, 40.0, marks=pytest.mark.full)])
def test_a_fin_is_found_and_its_path_lies_on_it(height_mm, lean_deg):
    one = pair(seed=3, n_points=40_000)
    rng = np.random.default_rng(1)
    points = move_points(one.T_test_part, fin(rng, height_mm, np.radians(lean_deg), 0.8))
    points += rng.normal(0, 0.02, points.shape)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = detect(one.sample, np.concatenate([one.test, points]))
    assert len(found.beads) == 1
    away, _ = cKDTree(points).query(found.path_points)
    assert away.max() < found.difference.cell_mm
    assert found.beads[0].length_mm > 30
    assert found.beads[0].height_mm > 0.6 * height_mm * np.cos(np.radians(lean_deg))


def test_a_bead_too_short_for_a_path_is_said_and_is_not_nothing_to_grind():
    one = pair(seed=3, n_points=30_000, beads=[arc_bead(length_mm=5.0)])
    with pytest.warns(match="1 place stands out without a path, too small for one .*, the largest .* mm high"):
        found = detect(one.sample, one.test)
    assert not found.beads and len(found.difference.specks) == 1
    assert "nothing to grind" not in str(found)
