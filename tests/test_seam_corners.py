"""Seams end at the corners of plates and bodies; what only looks like a step or a gap in a scene is none."""

import numpy as np
import pytest

from grindvision.errors import NoGrooveError
from grindvision.geometry import rotation_about
from grindvision.vision.seam.face_fit import Scale
from grindvision.vision.seam.seam_tracing import cut_at_corners
from grindvision.vision.seam.seams import FindSeamsOptions, find_seams
from grindvision.vision.seam.step_fit import fit_step
from tests.seam_scenes import corner, noisy, plate, step

ABOVE = np.array([0.0, 0.0, 450.0])


def along(corners, rng, noise):
    """Places every cell along the straight lines between corners, or on a ring of many corners."""
    corners = np.asarray(corners, dtype=float)
    at = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    fine = np.arange(0, at[-1], 1.0)
    line = np.stack([np.interp(fine, at, corners[:, k]) for k in range(3)], axis=1)
    return noisy(line, rng, noise)


@pytest.mark.parametrize("noise", [0.0, 0.15])
def test_a_curve_is_cut_at_its_corners_and_a_ring_is_not(noise):
    rng = np.random.default_rng(int(100 * noise))
    square = along([(0, 0, 0), (40, 0, 0), (40, 30, 0), (0, 30, 0), (0, 0, 0)], rng, noise)
    parts = cut_at_corners(square, 1.0)
    assert len(parts) == 4
    for part, side in zip(parts, (40, 30, 40, 30), strict=True):
        # A cell at each corner belongs to neither side.
        assert np.linalg.norm(part[-1] - part[0]) == pytest.approx(side - 2, abs=1.5)
    angle = np.linspace(0, 1.9 * np.pi, 200)
    for radius in (2.0, 4.0, 10.0):
        circle = radius * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
        assert len(cut_at_corners(along(circle, rng, noise), 1.0)) == 1


def plate_on_table(rng, height=4.0, spacing=1.0):
    """A plate of 120 x 80 mm on a table, seen from above."""
    table = plate((-110.0, 110.0), (-90.0, 90.0), spacing=spacing)
    upper = plate((-60.0, 60.0), (-40.0, 40.0), origin=(0.0, 0.0, height), spacing=spacing)
    hidden = (np.abs(table[:, 0]) < 60) & (np.abs(table[:, 1]) < 40)
    return noisy(np.concatenate([table[~hidden], upper]), rng, 0.1)


def test_laps_end_at_the_corners_of_their_plate():
    found = find_seams(plate_on_table(np.random.default_rng(3)), FindSeamsOptions(ABOVE))
    assert [seam.kind for seam in found.seams] == ["lap-joint"] * 4
    for seam in found.seams:
        x, y = np.abs(seam.root[:, 0]), np.abs(seam.root[:, 1])
        beside = np.abs(np.maximum(x - 60, y - 40))
        assert beside.max() < 2.5 and beside.mean() < 0.8
        assert seam.length_mm == pytest.approx(120 if np.ptp(seam.root[:, 0]) > 100 else 80, abs=5)


def test_a_step_is_followed_to_its_ends_from_wherever_it_was_noticed(rng):
    points = step(rng, length=260.0)
    path = np.column_stack([np.linspace(-20, -6, 15), np.zeros(15), np.zeros(15)])
    way, up = np.tile([0.0, -1.0, 0.0], (15, 1)), np.tile([0.0, 0.0, 1.0], (15, 1))
    fit = fit_step(points, path, way, up, 6.0, Scale(1.0, 4.0, 0.1))
    assert fit is not None and fit.length_mm > 250


def test_a_tube_that_lies_on_a_table_is_no_lap():
    rng = np.random.default_rng(4)
    angle, x = np.meshgrid(np.arange(-1.4, 1.4, 1 / 30), np.arange(-80.0, 80.0))
    tube = np.stack([x, 30 * np.sin(angle), 30 * np.cos(angle)], axis=-1).reshape(-1, 3)
    table = plate((-80.0, 80.0), (-120.0, 120.0), origin=(0.0, 0.0, -30.0))
    table = table[np.abs(table[:, 1]) > 34]
    with pytest.raises(NoGrooveError):
        find_seams(noisy(np.concatenate([tube, table]), rng, 0.2), FindSeamsOptions(ABOVE))


def test_a_groove_that_is_open_below_is_no_butt_gap():
    rng = np.random.default_rng(5)
    wall = (0.0, np.sin(np.radians(30)), np.cos(np.radians(30)))
    right = [
        plate((-80.0, 80.0), (6.5, 45.0)),
        plate((-80.0, 80.0), (0.0, 11.0), origin=(0.0, 1.0, -9.5), second=wall),
    ]
    below = plate((-80.0, 80.0), (-0.5, 1.0), origin=(0.0, 0.0, -9.5))
    points = noisy(np.concatenate([*right, *(one * [1, -1, 1] for one in right), below]), rng, 0.1)
    with pytest.raises(NoGrooveError, match="no butt-gap"):
        find_seams(points, FindSeamsOptions(ABOVE, "butt-gap"))
    (seam,) = find_seams(points, FindSeamsOptions(ABOVE)).seams
    assert seam.kind in ("v-groove", "u-groove") and np.abs(seam.root[:, 1]).max() < 0.5


@pytest.mark.parametrize("tilt_deg", [15.0, 52.0])
def test_a_camera_is_believed_however_it_is_tilted_and_far_the_background_goes(tilt_deg):
    rng = np.random.default_rng(6)
    points = np.concatenate([corner(rng, leg=60.0), plate((-300.0, 300.0), (-200.0, -60.0), spacing=2.0)])
    points = np.concatenate([points, plate((-300.0, 300.0), (20.0, 500.0), spacing=2.0)])
    turn = rotation_about([1.0, 0.0, 0.0], np.pi - np.radians(tilt_deg))
    found = find_seams(points @ turn.T + [0.0, 0.0, 480.0])
    root = (found.seams[0].root - [0.0, 0.0, 480.0]) @ turn
    assert not found.view_assumed and np.hypot(root[:, 1], root[:, 2]).max() < 0.5


@pytest.mark.parametrize("spacing, told", [(0.8, True), (2.0, False)])
def test_a_step_is_told_from_a_spacing_and_a_fifth_on(spacing, told):
    options = FindSeamsOptions(np.array([20.0, -220.0, 320.0]))
    points = step(np.random.default_rng(8), 2.0, 0.02, length=160.0, wide=70.0, spacing=spacing)
    if told:
        assert [seam.kind for seam in find_seams(points, options).seams] == ["lap-joint"]
    else:
        with pytest.raises(NoGrooveError):
            find_seams(points, options)
