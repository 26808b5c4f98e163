"""Curves by arc length: SciPy's spline is the oracle; places come back, and the nearest place is the nearest."""

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from grindvision.geometry.curves import Curve


def spiral(count, turns):
    angle = np.linspace(0, 2 * np.pi * turns, count, endpoint=turns < 1)
    return np.column_stack([30 * np.cos(angle), 20 * np.sin(angle), 5 * np.sin(2 * angle)])


@pytest.mark.parametrize(
    ("places", "closed"), [(spiral(9, 0.6), False), (spiral(14, 1), True), (spiral(2, 0.3), False)]
)
def test_the_curve_is_scipy_s_spline(places, closed):
    curve = Curve(places, closed)
    oracle = CubicSpline(curve.arc, curve.places, bc_type="periodic" if closed else "natural")
    arc = np.linspace(-4, curve.length_mm + 4, 200)
    np.testing.assert_allclose(curve.at(arc), oracle(arc), atol=1e-10)
    slope = oracle(arc, 1)
    np.testing.assert_allclose(curve.tangents(arc), slope / np.linalg.norm(slope, axis=1, keepdims=True), atol=1e-10)


def test_repeated_places_do_not_count(rng):
    places = spiral(9, 0.6)
    twice = Curve(np.repeat(places, 2, axis=0))
    arc = np.linspace(0, twice.length_mm, 50)
    np.testing.assert_allclose(twice.at(arc), Curve(places).at(arc), atol=1e-12)


def test_points_find_their_arc_length(rng):
    curve = Curve(spiral(12, 0.6))
    arc = rng.uniform(0, curve.length_mm, 100)
    across = np.cross(curve.tangents(arc), [0.0, 0.0, 1.0])
    np.testing.assert_allclose(curve.arc_of(curve.at(arc) + 2 * across), arc, atol=0.1)
    beyond = curve.at([curve.length_mm]) + 7 * curve.tangents([curve.length_mm])
    assert curve.arc_of(beyond) == pytest.approx([curve.length_mm + 7], abs=1e-6)
    far = curve.at(arc) + rng.normal(0, 200, (100, 3))
    fine = np.linspace(0, curve.length_mm, 96)
    _, near = cKDTree(curve.at(fine)).query(far)
    along = ((far - curve.at(fine[near])) * curve.tangents(fine[near])).sum(axis=1)
    np.testing.assert_allclose(curve.arc_of(far), fine[near] + along)


@pytest.mark.parametrize(("places", "closed"), [(spiral(12, 0.6), False), (spiral(14, 1), True)])
def test_distances_are_those_of_a_fine_polyline_and_of_the_ends(rng, places, closed):
    curve = Curve(places, closed)
    points = places[rng.integers(0, len(places), 60)] + rng.normal(scale=3, size=(60, 3))
    fine = curve.at(np.linspace(0, curve.length_mm, 100_000, endpoint=not closed))
    np.testing.assert_allclose(curve.distances(points), cKDTree(fine).query(points)[0], atol=0.02)
    if not closed:
        end = curve.at([curve.length_mm]) + 5 * curve.tangents([curve.length_mm])
        np.testing.assert_allclose(curve.distances(end), [5], atol=1e-6)
