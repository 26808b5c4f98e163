"""Sums over a bead's cross-sections against their plain form."""

import numpy as np
import pytest

from grindvision.vision.change.bead_sections import FLANK, REACH_WIDTHS, sums_of_sections


@pytest.mark.parametrize("around_mm", [np.inf, 30.0])
def test_sections_are_weighted_least_squares_of_the_points_around_each_station(rng, around_mm):
    s, b, h = rng.uniform(0, 30, 800), rng.uniform(-3, 3, 800), rng.normal(1.0, 0.1, 800)
    up, offsets = rng.normal(size=(800, 3)), rng.normal(size=(800, 3))
    arcs, width = np.array([0.0, 4.0, 15.0, 29.5]), 4.0
    found = sums_of_sections(s, b, h, up, offsets, arcs, width, around_mm)
    for m, arc in enumerate(arcs):
        away = s - arc
        if np.isfinite(around_mm):
            away -= around_mm * np.round(away / around_mm)
        used = (np.abs(away) < REACH_WIDTHS * width) & (np.abs(b) < 0.5 * width)
        weights = (1 - (np.abs(away[used]) / (REACH_WIDTHS * width)) ** 3) ** 3
        along, across = away[used] / width, b[used] / width
        terms = np.column_stack(
            [np.ones_like(along), along, along**2, along * across, *across ** np.arange(1, 5)[:, None]]
        )
        assert found.counts[m] == used.sum()
        np.testing.assert_allclose(found.normal[m], terms.T @ (terms * weights[:, None]), rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(found.right[m], terms.T @ (weights * h[used]), rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(found.up[m], np.average(up[used], axis=0, weights=weights), atol=1e-12)
        np.testing.assert_allclose(found.offset[m], np.average(offsets[used], axis=0, weights=weights), atol=1e-12)
        for flank, side in zip(found.flanks[m], (-1, 1), strict=True):
            assert flank == pytest.approx(np.average(side * across > FLANK, weights=weights))


def test_a_station_without_points_counts_none(rng):
    up, offsets = rng.normal(size=(2, 20, 3))
    found = sums_of_sections(np.full(20, 3.0), np.zeros(20), np.ones(20), up, offsets, np.array([90.0]), 4.0, np.inf)
    assert found.counts[0] == 0 and not found.normal.any() and not found.up.any()
