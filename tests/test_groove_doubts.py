"""A groove that is hardly one is said to be doubtful, and why; a groove that is well seen never is."""

import warnings

import numpy as np
import pytest

from grindvision.cell import weld_scene
from grindvision.errors import GrindvisionWarning
from grindvision.vision.seam.weld import TraceWeldOptions, trace_weld
from tests.groove_scenes import anywhere, cloud, grid, overlap, straight_groove, vee


def gap(rng, gap_mm, high_mm, noise_mm, shadow=0.0):
    """Two blocks on a table; ``shadow`` is the share of the floor between them that no pixel shows."""
    places = grid(200, 200, 1.0)
    away = np.abs(places[:, 1])
    seen = (away >= gap_mm / 2) | (away < (1 - shadow) * gap_mm / 2)
    return cloud(places[seen], np.where(away < gap_mm / 2, 0, high_mm)[seen], rng, noise_mm)


#: The first everywhere in every run, the others by night.
SEEDS = (0, pytest.param(1, marks=pytest.mark.full), pytest.param(2, marks=pytest.mark.full))


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(
    ("gap_mm", "high_mm", "shadow"), [(68, 30, 0.5), (68, 100, 0.0), (40, 30, 0.0), (20, 50, 0.4), (30, 15, 0.0)]
)
def test_a_gap_between_two_blocks_is_a_warning(gap_mm, high_mm, shadow, seed):
    rng = np.random.default_rng([seed, gap_mm])
    points, _, shift = anywhere(gap(rng, gap_mm, high_mm, rng.choice([0.1, 0.3]), shadow), rng)
    with pytest.warns(GrindvisionWarning, match=r"groove 1 .* may be a gap between two things"):
        trace_weld(points, TraceWeldOptions(viewpoint_mm=shift))


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(("gap_mm", "high_mm"), [(30, 15), (30, 40), (40, 30), (40, 100)])
def test_a_groove_comes_before_a_gap_however_large(gap_mm, high_mm, seed):
    rng = np.random.default_rng([seed, gap_mm, high_mm])
    places = grid(200, 200, 1.0)
    y = places[:, 1]
    seen = cloud(places, np.where(np.abs(y) < gap_mm / 2, 0, high_mm + vee(y - 60)), rng, rng.choice([0.1, 0.3]))
    points, rotation, shift = anywhere(seen, rng)
    with pytest.warns(GrindvisionWarning) as caught:
        weld = trace_weld(points, TraceWeldOptions(viewpoint_mm=shift))
    first = np.isin(np.arange(len(points)), weld.grooves[0].members)
    assert overlap(first, np.abs(y - 60) < 5) > 0.9
    assert np.abs((weld.path.points - shift) @ rotation[:, 1] + 60).max() < 0.5
    assert [len(weld.grooves), len(weld.left_out)] == [2, 0]
    assert any("groove 2" in str(one.message) and "may be a gap" in str(one.message) for one in caught)
    assert not any("groove 1" in str(one.message) for one in caught)


def test_a_groove_of_few_points_is_a_warning(rng):
    points, truth = straight_groove(rng, spacing_mm=0.4)
    thinned = points[~truth | (rng.random(len(points)) < 0.2)]
    with pytest.warns(GrindvisionWarning, match="groove 1 holds only .* of the points"):
        trace_weld(thinned)


@pytest.mark.parametrize(
    "height",
    [
        vee,
        lambda y: vee(y, 8, 9),
        lambda y: vee(y, 25, 3),
        lambda y: -5 * np.clip((6 - np.abs(y)) / 3.5, 0, 1),
        lambda y: -8 * np.clip((6 - np.abs(y)) / 1.6, 0, 1),
        lambda y: -8 * np.cos(np.clip(y / 20, -0.5, 0.5) * np.pi) ** 2,
    ],
    ids=["V", "steep", "shallow", "flat root", "U of 11 degrees", "round"],
)
@pytest.mark.parametrize("scale", [1, 4])
def test_a_groove_well_seen_is_no_doubt(rng, height, scale):
    places = grid()
    kept = rng.random(len(places)) < 0.8
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        trace_weld(scale * cloud(places, height(places[:, 1]), rng)[kept])


@pytest.mark.parametrize("kind", ["line", "curve", "box", "cylinder"])
def test_the_weld_pieces_are_no_doubt(kind):
    for seed, every in ((1, 1), (2, 4)):
        scene = weld_scene(kind, np.random.default_rng([seed, every]), every=every)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            trace_weld(scene.points)
