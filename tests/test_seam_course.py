"""Corners that are followed in part, and hollows that are no joint of plates: said, or named as what they are."""

import warnings

import numpy as np
import pytest

from grindvision.cell import JointSize, joint_scene
from grindvision.errors import GrindvisionWarning, NoGrooveError
from grindvision.geometry import rotation_about
from grindvision.vision.seam.seams import FindSeamsOptions, find_seams
from grindvision.vision.seam.weld import TraceWeldOptions, trace_weld
from tests.seam_scenes import corner, two_tubes

EYE = np.array([20.0, -220.0, 320.0])


@pytest.mark.parametrize("radius", [20.0, 30.0, 45.0])
@pytest.mark.parametrize("noise_mm", [0.02, 0.25])
def test_two_tubes_that_run_into_each_other_are_no_plates(radius, noise_mm):
    rng = np.random.default_rng(int(radius))
    points = two_tubes(rng, radius, 0.3 * radius, noise_mm=noise_mm)
    try:
        seam = find_seams(points, FindSeamsOptions([0.0, 0.0, radius + 400.0])).seams[0]
    except NoGrooveError as error:
        assert "sides bend on" in str(error) and radius < 30
        return
    assert np.abs(seam.root[:, 1]).mean() < 0.3 + noise_mm
    assert seam.kind == "saddle" or any("undecided between t-joint and saddle" in doubt for doubt in seam.doubts)
    assert seam.kind == "saddle" or radius < 30


def test_a_slit_between_two_tubes_is_no_gap_between_plates(rng):
    radius = 10.0
    points = two_tubes(rng, radius, -2.0, spacing=0.9)
    below = np.column_stack([rng.uniform(-60, 60, 400), rng.uniform(-1, 1, 400), np.full(400, -radius)])
    try:
        found = find_seams(np.concatenate([points, below]), FindSeamsOptions([0.0, 0.0, 410.0])).seams
    except NoGrooveError:
        return
    assert all(seam.kind != "butt-gap" for seam in found)


def test_a_corner_of_60_deg_is_not_turned_inside_out():
    scene = joint_scene("t-joint", np.random.default_rng(1), JointSize(length_mm=120, angle_deg=60), every=2)
    found = find_seams(scene.points)
    assert not found.view_assumed and found.seams[0].kind == "t-joint"
    assert np.median(found.seams[0].opening_deg) == pytest.approx(60, abs=2)


def cut(points, low, high, reach):
    """Points without those of the seam's surroundings between two places along x."""
    hole = (points[:, 0] > low) & (points[:, 0] < high) & (np.hypot(points[:, 1], points[:, 2]) < reach)
    return points[~hole]


@pytest.mark.parametrize("mirrored", [1.0, -1.0])
def test_a_corner_that_goes_on_behind_a_hole_is_said_to_be_followed_in_part(rng, mirrored):
    """What is left behind a wide hole is too short for a seam of its own: that it is left out is said."""
    points = cut(corner(rng, length=112.0, noise_mm=0.1), 0.0, 42.0, 60.0) * [mirrored, 1.0, 1.0]
    rotation = rotation_about([1.0, 0.0, 0.0], 0.3)
    with pytest.warns(GrindvisionWarning, match=r"seam 1 \(.*\) is followed over \d+ mm only, about [4-6]\d% of"):
        weld = trace_weld(points @ rotation.T, TraceWeldOptions(viewpoint_mm=rotation @ EYE))
    assert len(weld.seams) == 1 and weld.seams[0].length_mm == pytest.approx(56, abs=4)


def test_a_corner_in_two_parts_that_are_both_followed_is_no_doubt(rng):
    points = cut(corner(rng, length=200.0, noise_mm=0.1), -30.0, 30.0, 60.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        weld = trace_weld(points, TraceWeldOptions(viewpoint_mm=EYE))
    assert len(weld.seams) == 2


def test_a_corner_seen_whole_is_no_doubt(rng):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        trace_weld(corner(rng, noise_mm=0.1), TraceWeldOptions(viewpoint_mm=EYE))
