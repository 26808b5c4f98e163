"""A seam ends where its points end: it is carried on across a hole only onto the same corner."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from benchmarks.seams import joint, off_line
from grindvision.vision.seam.face_fit import FaceFit, Faces
from grindvision.vision.seam.joint_extent import main_run
from grindvision.vision.seam.joint_fit import turned_stations
from grindvision.vision.seam.seams import FindSeamsOptions, find_seams
from tests.seam_scenes import corner

FRONT = FindSeamsOptions(np.array([20.0, -220.0, 320.0]), "fillet")
RIGHT_ANGLE = np.pi / 2


def along(*runs):
    """Flags (S,) and turns (S,), rad, of runs of (stations, turn); a run without a turn is hidden."""
    shown = np.concatenate([np.full(count, turn is not None) for count, turn in runs])
    turns = np.concatenate([np.full(count, 0.0 if turn is None else turn) for count, turn in runs])
    return shown, turns


@pytest.mark.parametrize(
    ("behind", "expected"),
    [
        ((14, RIGHT_ANGLE), (0, 60)),  # the same corner goes on
        ((14, RIGHT_ANGLE - 0.6), (0, 40)),  # another one
        ((3, RIGHT_ANGLE), (0, 40)),  # too short a stretch to tell
    ],
)
def test_a_hole_is_bridged_to_a_stretch_of_the_same_corner_only(behind, expected):
    shown, turns = along((40, RIGHT_ANGLE), (6, None), behind)
    assert main_run(shown, turns, 2.0) == expected
    mirrored = (len(shown) - expected[1], len(shown) - expected[0])
    assert main_run(shown[::-1], turns[::-1], 2.0) == mirrored


def test_a_long_hole_ends_a_seam():
    shown, turns = along((40, RIGHT_ANGLE), (25, None), (30, RIGHT_ANGLE))
    assert main_run(shown, turns, 2.0) == (0, 40)


@pytest.mark.parametrize(("angle_deg", "end_mm"), [(90.0, 80.0), (140.0, 0.0)])
def test_a_seam_jumps_no_hole_onto_another_corner(angle_deg, end_mm):
    """Behind a hole of 25 mm the wall goes on upright, or leans back by 50 deg."""
    rng = np.random.default_rng(11)
    before, behind = corner(rng, length=160.0), corner(rng, angle_deg, length=160.0)
    points = np.concatenate([before[before[:, 0] < 0], behind[behind[:, 0] > 25]])
    seam = find_seams(points, FRONT).seams[0]
    assert seam.root[:, 0].min() == pytest.approx(-80, abs=3)
    assert seam.root[:, 0].max() == pytest.approx(end_mm, abs=3)


def test_a_corner_ends_where_its_windows_show_none_whatever_its_steadied_bend_says():
    """Both faces carry on a turn of 40 deg by their steadied curvature; what the windows show lies flat from 12 on."""
    count = 20
    first = np.tile([0.0, 0.0, 1.0], (count, 1))
    second = np.tile([0.0, -np.sin(0.7), np.cos(0.7)], (count, 1))
    outward = np.stack([np.tile([0.0, -1.0, 0.0], (count, 1)), np.tile([0.0, np.cos(0.7), np.sin(0.7)], (count, 1))])
    none = np.zeros((2, count))
    single = none.copy()
    single[1, 12:] = -np.tan(0.7)
    covariance = np.tile(1e-6 * np.eye(3), (2, count, 1, 1))
    sides = FaceFit(
        np.zeros((2, count, 3)), covariance, np.full(2, 0.1), (True, True), none, (np.arange(0), np.arange(0)), none,
        np.zeros(2), single, (np.zeros((2, count, 3)), covariance),
    )  # fmt: skip
    turned = turned_stations(Faces(outward, np.stack([first, second])), none, sides, True)
    assert turned.tolist() == [True] * 12 + [False] * 8


@pytest.mark.parametrize("seed", [9301, 9522])
def test_a_lap_of_which_few_surfels_show_a_part_is_followed_over_a_hole(seed):
    """Pairs of surfels showed 10 mm of 180: the line grew as far as a place without points and stopped there."""
    seen = joint("lap-joint")(seed)
    seam = find_seams(seen.points).seams[0]
    assert seam.kind == "lap-joint"
    assert (cKDTree(seam.root).query(seen.root)[0] < 4).mean() > 0.9
    assert off_line(seam.root, seen.root)[3:-3].mean() < 0.3
