"""The whole chain: without errors it finds the true ridge, with them it stays near, and a case repeats exactly."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from grindvision import cell
from grindvision.cell.experiment4 import printed_path
from grindvision.geometry import angle_between, move_points
from grindvision_book.chapter_08 import compound
from grindvision_book.chapter_08.compound import (
    ORIENTATIONS_DEG,
    SOURCES,
    compound_case,
    compound_paths,
    off_ridge,
    spreads,
)
from grindvision_book.chapter_08.registered import RegisteredPair, pairs_from_fixture
from grindvision_book.chapter_08.workplace import workplace
from grindvision_book.chapter_09.limits import displacement


@pytest.fixture(scope="module")
def paths():
    return compound_paths(np.random.default_rng(1))


def test_d1_is_the_pose_that_the_printed_tables_imply():
    pose = cell.GrindingRobot().exact_poses(np.radians(ORIENTATIONS_DEG["D1"]))
    implied = printed_path().T_base_scanner
    assert np.linalg.norm(pose[:3, 3] - implied[:3, 3]) < 1.5
    assert np.degrees(angle_between(pose, implied)) < 0.6


def test_without_errors_the_path_is_the_ridge():
    off = off_ridge(compound_paths(np.random.default_rng(2), **dict.fromkeys(SOURCES, False)))
    assert np.linalg.norm(off, axis=1).max() < 0.05


def test_with_all_errors_corresponding_points_share_a_square(paths):
    assert len(paths) == 24
    assert (spreads(paths)[["x_mm", "y_mm", "z_mm"]] < 0.5).all(axis=None)
    assert np.linalg.norm(off_ridge(paths), axis=1).max() < 0.4


def test_vectors_from_the_ridge_are_square_to_it(paths):
    bead = workplace().bead
    tangents = np.gradient(bead.ridge_mm, axis=0)
    for row in paths.itertuples():
        near = np.argmin(np.linalg.norm(bead.ridge_mm - [row.x_mm, row.y_mm, row.z_mm], axis=1))
        off = np.array([row.off_x_mm, row.off_y_mm, row.off_z_mm])
        assert abs(off @ tangents[near]) < 1e-9


def test_a_case_repeats_and_says_what_its_paths_say(paths):
    """The case walks the chain once more, from the same seed: its numbers are those of the paths to the last digit."""
    case = compound_case(np.random.default_rng(1))
    lengths = np.linalg.norm(off_ridge(paths), axis=1)
    assert case["off_mm"] == lengths.mean() and case["largest_off_mm"] == lengths.max()
    assert case["spread_z_mm"] == spreads(paths)["z_mm"].max()


def test_the_paper_s_boxes_are_found_on_the_same_scans_and_farther_from_the_ridge():
    case = compound_case(np.random.default_rng(1), boxes=True)
    ours = compound_case(np.random.default_rng(1))
    assert {name: case[name] for name in ours} == ours
    assert set(case) == {*ours, *(f"boxes_{name}" for name in ours)}
    assert case["boxes_off_mm"] > 3 * case["off_mm"] and case["boxes_spread_rms_mm"] > case["spread_rms_mm"]


def test_a_displacement_moves_points_by_the_size_asked_for(rng):
    points = rng.uniform([-50, -50, 350], [50, 50, 450], (200, 3))
    moved = move_points(displacement(rng, points, 0.3), points)
    assert np.sqrt(((moved - points) ** 2).sum(axis=1).mean()) == pytest.approx(0.3, rel=1e-3)


def test_a_spread_is_the_largest_minus_the_smallest_coordinate():
    paths = pd.DataFrame(
        {
            "point": [1, 2, 1, 2, 1, 2],
            "x_mm": [0.0, 7.0, 1.0, 7.5, 5.0, 7.0],
            "y_mm": [-1.0, 0.0, -4.0, 0.0, 2.0, 0.0],
            "z_mm": [3.0, 1.0, 3.0, 2.0, 3.0, 4.0],
        }
    )
    np.testing.assert_array_equal(spreads(paths).to_numpy(), [[1, 5, 6, 0], [2, 0.5, 0, 3]])


def test_a_pair_known_to_the_fixture_ends_where_one_registered_from_nothing_does(monkeypatch):
    """From four standard deviations off in every coordinate, too."""
    seen = []

    def watched(*given):
        seen.append(given)
        return pairs_from_fixture(*given)

    monkeypatch.setattr(compound, "pairs_from_fixture", watched)
    compound_case(np.random.default_rng(1))
    ((sample, tests, believed, _),) = seen
    known = RegisteredPair.of(sample.points, tests[0].points).registration.T_target_source
    for sign in (-1.0, 1.0):
        drawn = SimpleNamespace(standard_normal=lambda count, sign=sign: np.full(count, 4 * sign))
        found = pairs_from_fixture(sample, tests[:1], believed[:1], drawn)[0].registration.T_target_source
        assert np.abs(move_points(found, tests[0].points) - move_points(known, tests[0].points)).max() < 1e-4
