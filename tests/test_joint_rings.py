"""One round of a ring, which a seam path that comes back to its start is cut to."""

import numpy as np
import pytest

from grindvision.vision.seam.ring_line import one_round

REACH_MM = 6.0


def circle(turns: np.ndarray, radius_mm: float = 20.0, climb_mm: float = 0.0) -> np.ndarray:
    """Points (S, 3) of a circle, or of a helix, at these numbers of turns."""
    angle = 2 * np.pi * turns
    return np.column_stack([radius_mm * np.cos(angle), radius_mm * np.sin(angle), climb_mm * turns])


@pytest.mark.parametrize("stations", [16, 24, 60, 130])  # at 16 the second station already lies beyond the reach
@pytest.mark.parametrize("beyond", [0, 1, 9])
@pytest.mark.parametrize("phase", [0.0, 0.3])
def test_a_round_ends_where_it_began_however_far_the_path_goes_on(stations, beyond, phase):
    root = circle(phase + np.arange(stations + 1 + beyond) / stations)
    assert one_round(root, REACH_MM) == stations + 1
    assert one_round(root[::-1], REACH_MM) == stations + 1


@pytest.mark.parametrize("short_mm", [2.0, 5.0])
def test_a_round_may_end_a_little_before_its_start(short_mm):
    stations = 126  # 1 mm apart
    root = circle(np.arange(stations) / stations * (1 - short_mm / (2 * np.pi * 20.0)))
    assert one_round(root, REACH_MM) == len(root)


def test_what_does_not_come_back_is_no_round():
    turns = np.arange(127) / 126
    assert one_round(circle(turns * (1 - 7.0 / 126)), REACH_MM) is None  # its end lies 7 mm before its start
    assert one_round(circle(turns, radius_mm=2.9), REACH_MM) is None  # never beyond the reach
    there = np.column_stack([np.linspace(0, 40, 41), np.zeros(41), np.zeros(41)])
    assert one_round(np.vstack([there, there[::-1]]), REACH_MM) is None  # comes back the other way round
    assert one_round(circle(turns, climb_mm=5.0), REACH_MM) is None  # comes back beside itself, not onward
    assert one_round(circle(turns, climb_mm=1.0), REACH_MM) == 127


def test_a_path_beside_its_start_that_leads_away_from_it_is_no_round():
    square = np.array([[0.0, 0, 0], [20, 0, 0], [20, 20, 0], [-5, 20, 0], [-5, 0, 0], [-5, -20, 0]])
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(square, axis=0), axis=1))])
    root = np.column_stack([np.interp(np.arange(0, arc[-1], 0.5), arc, square[:, k]) for k in range(3)])
    assert one_round(root, REACH_MM) is None
