"""A path stays on the points of its own piece, whatever the piece looks like: a law over random pieces."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from grindvision.errors import DegenerateError, NoPathError
from grindvision.geometry import random_rotation
from grindvision.vision.change.pieces import Cluster
from grindvision.vision.change.ridge_path import lies_on, trace_bead


def piece(rng, kind):
    """A random piece: a bead, thin fin, one flank, plateau, lump or scattered points, with noise and holes."""
    length, width, peak = rng.uniform(4, 60), rng.uniform(0.5, 8), rng.uniform(0.1, 6)
    count = int(rng.uniform(15, 900))
    x, y = rng.uniform(-length / 2, length / 2, count), rng.uniform(-width / 2, width / 2, count)
    bow = rng.uniform(-0.01, 0.01)
    across = 2 * y / width
    height = {
        "bead": peak * (1 - across**2),
        "fin": rng.uniform(0.3, 1, count) * peak,
        "flank": peak * (1 + across) / 2,
        "plateau": np.full(count, peak),
        "lump": peak * np.exp(-((x / width) ** 2) - across**2),
        "scatter": rng.uniform(0, peak, count),
    }[kind]
    if kind == "fin":
        y *= 0.1
    height = np.maximum(height + rng.normal(0, rng.uniform(0, 0.2) * peak, count), 1e-3)
    tilt = np.array([0.0, rng.uniform(-1, 1), 1.0]) if kind in ("fin", "flank") else np.array([0.0, 0.0, 1.0])
    up = np.tile(tilt / np.linalg.norm(tilt), (count, 1))
    points = np.column_stack([x, y + bow * x**2, np.zeros(count)]) + height[:, None] * up
    turn = random_rotation(rng)
    size = np.sqrt(length * width / count) * rng.uniform(1.2, 2.5)
    return Cluster(points @ turn.T, height, up @ turn.T, max(size, 0.05), length * width, length * width * peak, peak)


@pytest.mark.parametrize("kind", ["bead", "fin", "flank", "plateau", "lump", "scatter"])
def test_no_path_point_leaves_its_piece_by_more_than_a_cell(kind):
    followed = 0
    for seed in range(20):
        one = piece(np.random.default_rng([seed, len(kind)]), kind)
        try:
            path = trace_bead(one, 7)
        except DegenerateError:
            continue
        followed += 1
        away, _ = cKDTree(one.points).query(path.points)
        assert away.max() <= one.spacing_mm
        away, _ = cKDTree(one.points).query(path.ridge)
        assert away.max() <= 2 * one.spacing_mm
    assert followed > 5


def test_lies_on_tells_what_is_off_the_piece_or_no_number():
    one = piece(np.random.default_rng(0), "plateau")
    assert lies_on(one, one.points)
    assert not lies_on(one, one.points + [0, 0, 100.0])
    assert not lies_on(one, np.full((1, 3), np.nan))


def test_the_crest_of_a_thin_fin_that_is_seen_from_one_side_is_followed():
    rng = np.random.default_rng(4)
    x, out = rng.uniform(-30, 30, 160), rng.uniform(0, 4, 160)
    points = np.column_stack([x, rng.normal(0, 0.02, 160), out])  # a fin of no thickness, 4 mm high
    fin = Cluster(points, out, np.tile([0.0, 0, 1], (160, 1)), 1.7, 240.0, 480.0, 4.0)
    path = trace_bead(fin, 6)
    assert np.ptp(path.points[:, 0]) > 35
    assert (path.points[:, 2] > 2).all()
    assert path.height_mm > 2


def test_a_face_that_stands_out_as_a_whole_gets_no_line_drawn_through_it():
    x, y = np.meshgrid(np.arange(0, 60.0), np.arange(0, 40.0))
    points = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 0.5)])
    up = np.tile([0.0, 0, 1], (x.size, 1))
    with pytest.raises(NoPathError, match=r"a face of 2,400 mm2 stands out by 0\.50 mm"):
        trace_bead(Cluster(points, np.full(x.size, 0.5), up, 1.0, 2400.0, 1200.0, 0.5))
