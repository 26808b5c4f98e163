"""What a wheel leaves of a bead: exact answers for a straight bead on a flat part, and the sagitta of a curved one."""

import numpy as np
import pytest

from grindvision.cell.grinding_part import Bead
from grindvision.errors import InputError
from grindvision.geometry import move_points, random_rotation, rigid, rotate_vectors
from grindvision_book.chapter_09.grinding import Wheel, grind

HEIGHT, WIDTH = 1.5, 4.0
WHEEL = Wheel(radius_mm=15.0, width_mm=6.0)


def straight_bead():
    x = np.linspace(0.0, 30.0, 16)
    ridge = np.column_stack([x, np.zeros(16), np.full(16, HEIGHT)])
    return Bead(ridge, np.tile([0.0, 0.0, 1.0], (16, 1)), WIDTH, HEIGHT)


def on_ridge(bead, chosen=slice(None), shift=(0.0, 0.0, 0.0)) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return bead.ridge_mm[chosen] + np.asarray(shift), bead.normals[chosen], np.full(len(bead.ridge_mm[chosen]), HEIGHT)


def test_a_perfect_path_with_enough_passes_leaves_nothing():
    ground = grind(straight_bead(), *on_ridge(straight_bead()), WHEEL, 0.5, 3)
    assert ground.left_mm < 1e-3 and ground.gouge_mm < 1e-9


@pytest.mark.parametrize("passes", [1, 2])
def test_each_pass_takes_its_depth_of_cut(passes):
    ground = grind(straight_bead(), *on_ridge(straight_bead()), WHEEL, 0.5, passes)
    assert ground.left_mm == pytest.approx(HEIGHT - 0.5 * passes, abs=1e-3)


def test_further_passes_do_not_go_deeper_than_vision_says():
    three, nine = (grind(straight_bead(), *on_ridge(straight_bead()), WHEEL, 0.5, n).after_mm for n in (3, 9))
    np.testing.assert_array_equal(three, nine)


def test_a_path_too_high_leaves_the_error_and_one_too_low_gouges_it():
    high = grind(straight_bead(), *on_ridge(straight_bead(), shift=(0, 0, 0.2)), WHEEL, 0.5, 3)
    low = grind(straight_bead(), *on_ridge(straight_bead(), shift=(0, 0, -0.2)), WHEEL, 0.5, 3)
    assert high.left_mm == pytest.approx(0.2, abs=1e-3) and high.gouge_mm == 0.0
    assert low.gouge_mm == pytest.approx(0.2, abs=1e-9) and low.left_mm < 1e-9


def test_a_wheel_too_narrow_or_shifted_leaves_the_flank():
    narrow = grind(straight_bead(), *on_ridge(straight_bead()), Wheel(15.0, 2.0), 0.5, 3)
    assert narrow.left_mm == pytest.approx(HEIGHT * (1 - (2 * 1.0 / WIDTH) ** 2), abs=0.1)
    wide = grind(straight_bead(), *on_ridge(straight_bead(), shift=(0, 0.9, 0)), WHEEL, 0.5, 3)
    assert wide.left_mm < 1e-3


def test_a_leaning_wheel_leaves_a_wedge_on_one_side_and_gouges_the_other():
    bead, lean = straight_bead(), np.radians(3.0)
    points, _, heights = on_ridge(bead)
    normals = np.tile([0.0, np.sin(lean), np.cos(lean)], (len(points), 1))
    ground = grind(bead, points, normals, heights, WHEEL, 0.5, 3)
    edge = np.tan(lean) * 0.6 * WIDTH
    assert ground.gouge_mm == pytest.approx(edge, abs=0.02)
    assert 0.05 < ground.left_mm < edge


def test_few_points_on_a_curved_bead_cost_their_sagitta():
    radius = 100.0
    angle = np.linspace(-0.15, 0.15, 61)
    ridge = np.column_stack([radius * np.sin(angle), np.zeros(61), radius * np.cos(angle)])
    bead = Bead(ridge, ridge / radius, WIDTH, HEIGHT)
    for chosen in (slice(None, None, 60), slice(None, None, 30), slice(None, None, 10)):
        ground = grind(bead, *on_ridge(bead, chosen), WHEEL, 0.5, 3)
        chord = np.linalg.norm(np.diff(ridge[chosen], axis=0), axis=1)[0]
        assert ground.gouge_mm == pytest.approx(chord**2 / (8 * radius), rel=0.05)


def test_the_frame_does_not_matter(rng):
    bead = straight_bead()
    points, normals, heights = on_ridge(bead, slice(None, None, 3), shift=(0.0, 0.1, 0.05))
    T_other_part = rigid(random_rotation(rng), [10.0, -20.0, 30.0])
    moved = Bead(move_points(T_other_part, bead.ridge_mm), rotate_vectors(T_other_part, bead.normals), WIDTH, HEIGHT)
    here = grind(bead, points, normals, heights, WHEEL, 0.5, 3).after_mm
    there = grind(
        moved, move_points(T_other_part, points), rotate_vectors(T_other_part, normals), heights, WHEEL, 0.5, 3
    ).after_mm
    np.testing.assert_allclose(here, there, atol=1e-9)


def test_impossible_requests_are_refused():
    points, normals, heights = on_ridge(straight_bead())
    with pytest.raises(InputError, match="0 passes"):
        grind(straight_bead(), points, normals, heights, WHEEL, 0.5, 0)
    with pytest.raises(InputError, match="1 path points"):
        grind(straight_bead(), points[:1], normals[:1], heights[:1], WHEEL, 0.5, 1)
    with pytest.raises(InputError, match="no part of the bead"):
        grind(straight_bead(), points + [100.0, 0.0, 0.0], normals, heights, WHEEL, 0.5, 1)
    with pytest.raises(InputError, match="radius 0"):
        Wheel(0.0, 5.0)
