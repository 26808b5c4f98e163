"""On a deformed part only what cannot be bending is a bead: narrow, agreeing surface on both sides of it, and higher
than what is missing elsewhere."""

import warnings

import numpy as np
import pytest
from scipy.spatial import cKDTree

from grindvision import GrindOptions, detect, grind
from grindvision.geometry import inverse, move_points
from grindvision.vision.change.bent_pieces import bending_doubts, deepest_missing, fraction_between
from grindvision.vision.change.change_detection import Difference
from grindvision.vision.change.comparison import compare
from grindvision.vision.change.pieces import Cluster
from grindvision.vision.registration.deformation import zero_field
from grindvision.vision.registration.field_misfit import field_misfit
from tests.grinding_scene import arc_bead
from tests.test_deformation import T_TEST_PART, bent, pair

CELL = 2.0
UP = np.array([0.0, 0.0, 1.0])


def face(low=-60.0, high=60.0):
    """Surfels (N, 3) of a plane face of 120 x 120 mm and its normals, in its middle the origin."""
    x, y = np.meshgrid(np.arange(low, high + 1, CELL), np.arange(-60.0, 61.0, CELL))
    places = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    return places, np.tile(UP, (len(places), 1))


def difference(places, signed, pieces=()):
    """A comparison of surfels (N, 3) at a level of detection of 0.2 mm, with pieces (N,) of what stands out."""
    clusters = []
    for on in pieces:
        normals = np.tile(UP, (int(on.sum()), 1))
        raised = places[on] + signed[on, None] * UP
        clusters.append(Cluster(raised, signed[on], normals, CELL, 0.0, 0.0, float(np.quantile(signed[on], 0.98))))
    level = np.full(len(places), 0.2)
    return Difference(tuple(clusters), places, signed, level, 0.2, level, np.ones(len(places), dtype=bool), CELL)


class Deformed:
    """A part of 120 x 120 mm that is bent by a field of the second order: half a wave is 21 mm."""

    field = zero_field(2, face()[0])


def doubts_of(on, height=1.0, sunk=None, depth=0.0):
    """What is said of one piece where ``on``, beside a place where material is missing."""
    places, normals = face()
    signed = np.where(on(places), height, 0.0)
    if sunk is not None:
        signed -= np.where(sunk(places), depth, 0.0)
    found = difference(places, signed, [on(places)])
    return bending_doubts(found, normals, Deformed()).get(0, "")


def strip(at, width):
    return lambda places: (np.abs(places[:, 0] - at) <= width / 2) & (np.abs(places[:, 1]) < 40)


@pytest.mark.parametrize("width", [4.0, 10.0, 18.0])
def test_a_strip_within_a_face_is_between_and_one_along_its_rim_is_not(width):
    assert doubts_of(strip(0.0, width)) == ""
    assert doubts_of(strip(40.0, width)) == ""
    assert "of it lies between surface of its face" in doubts_of(strip(60.0 - width / 2, width))


def test_a_strip_as_wide_as_half_a_wave_of_the_field_may_be_bent():
    assert "it is 2" in doubts_of(strip(0.0, 24.0)) and "more finely than the field tells" in doubts_of(
        strip(0.0, 24.0)
    )


def test_a_ring_about_agreeing_surface_is_between_and_one_about_a_hole_is_not():
    places, normals = face()
    away = np.linalg.norm(places[:, :2], axis=1)
    ring = (away > 15) & (away < 21)
    for shown, expected in ((away >= 0, 1.0), (away > 15, 0.0)):
        found = difference(places[shown], ring[shown] * 1.0, [ring[shown]])
        assert fraction_between(found.clusters[0], found, normals[shown]) == pytest.approx(expected, abs=0.1)


def test_a_wall_that_rises_out_of_a_corner_is_the_other_side_and_one_that_falls_from_an_edge_is_not():
    places, normals = face(-60.0, 0.0)
    for sign, at, expected in ((1.0, -5.0, 1.0), (-1.0, -3.0, 0.0)):  # the second up to the edge
        on = strip(at, 6.0)(places)
        y, z = np.meshgrid(np.arange(-60.0, 61.0, CELL), sign * np.arange(CELL, 30.0, CELL))
        wall = np.column_stack([np.zeros(y.size), y.ravel(), z.ravel()])
        both = np.vstack([places, wall])
        facing = np.vstack([normals, np.tile([-sign, 0.0, 0.0], (len(wall), 1))])
        chosen = np.append(on, np.zeros(len(wall), dtype=bool))
        found = difference(both, chosen * 1.0, [chosen])
        assert fraction_between(found.clusters[0], found, facing) == pytest.approx(expected, abs=0.1)


def test_a_piece_no_higher_than_what_is_missing_elsewhere_may_be_the_fields_error():
    def hollow(places):
        return np.linalg.norm(places[:, :2] - (35.0, 0.0), axis=1) < 8

    assert doubts_of(strip(0.0, 8.0), 1.0, hollow, 0.9) == ""
    assert "1 mm high where 1.1 mm are missing about (35, 0, 0) mm" in doubts_of(strip(0.0, 8.0), 1.0, hollow, 1.1)
    small = doubts_of(strip(0.0, 8.0), 1.0, lambda places: np.linalg.norm(places[:, :2] - (35, 0), axis=1) < 3, 5.0)
    assert small == ""  # too few surfels to be sure of


def test_nothing_missing_is_no_depth():
    places, _ = face()
    assert deepest_missing(difference(places, np.zeros(len(places))))[0] == 0


def test_stock_does_not_raise_the_misfit_about_it_and_bending_does(rng):
    places, _ = face()
    noise = rng.normal(0, 0.05, len(places))
    bead = np.where(strip(0.0, 6.0)(places), 1.5, 0.0)
    waves = np.where(places[:, 0] > 0, 0.4 * np.sin(places[:, 1] / 5), 0.0)
    quiet, with_bead, with_waves = (field_misfit(places, noise + more, 42.0) for more in (0.0 * bead, bead, waves))
    assert quiet.usual_mm == pytest.approx(0.05, rel=0.1)
    asked = np.array([[0.0, 0, 0], [50.0, 0, 0], [-55.0, 0, 0]])
    assert (np.sqrt(with_bead.variances(asked)) < 0.07).all()
    wavy = np.sqrt(with_waves.variances(asked))
    assert wavy[1] > 0.25 and wavy[2] < 0.07
    assert with_waves.beyond_usual(asked)[2] == 0


def test_where_half_of_a_neighbourhood_meets_nothing_its_misfit_is_the_largest_residual():
    places, _ = face()
    residuals = np.where(places[:, 0] > 0, np.nan, 0.1)
    residuals[0] = 3.0
    asked = np.array([[55.0, 0, 0], [-55.0, 0, 0]])
    np.testing.assert_allclose(
        np.sqrt(field_misfit(places, residuals, 42.0).variances(asked)), 1.4826 * np.array([3.0, 0.1]), rtol=1e-9
    )


@pytest.fixture(scope="module")
def curled():
    """A twisted plate with a bead, whose end is bent up by 2.5 mm over its last 12 mm, where no low order follows."""
    sample, test = pair("twist", 1, (arc_bead(),))
    part = move_points(inverse(T_TEST_PART), test)
    part[:, 2] += 2.5 * (np.clip(part[:, 0] - 88, 0, None) / 12) ** 2
    return sample, move_points(T_TEST_PART, part), move_points(T_TEST_PART, bent(arc_bead().ridge(), "twist"))


@pytest.fixture(scope="module")
def compared_once():
    """``compare``, which takes most of the time: ``detect`` and ``grind`` ask it the same of the same scans."""
    known = {}

    def once(sample, test, options, clock):
        key = (sample.tobytes(), test.tobytes())
        if key not in known:
            known[key] = compare(sample, test, options, clock)
        return known[key]

    return once


def test_a_curled_end_is_no_path_and_the_bead_beside_it_is(curled, compared_once, monkeypatch):
    monkeypatch.setattr("grindvision.vision.change.detection.compare", compared_once)
    sample, test, ridge = curled
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = detect(sample, test)
    assert found.deformed is not None
    assert cKDTree(ridge).query(found.path_points)[0].max() < 1.0
    assert len(found.beads) == 1 and any("on a deformed part: " in str(one.message) for one in caught)


def test_a_curled_end_is_not_ground_and_the_bead_beside_it_is(curled, compared_once, monkeypatch):
    monkeypatch.setattr("grindvision.grinding.compare", compared_once)
    sample, test, ridge = curled
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        ground = grind(sample, test, GrindOptions(seed=0))
    planned = [piece for piece, plan in zip(ground.stock.pieces, ground.plans, strict=True) if plan is not None]
    assert len(planned) == 1 < len(ground.stock.pieces)
    feet = move_points(planned[0].map.T_scan_map, planned[0].map.feet_mm[planned[0].above])
    assert cKDTree(ridge).query(feet)[0].max() < 5.0
    assert any("is not ground: " in str(one.message) and "deformed" in str(one.message) for one in caught)
