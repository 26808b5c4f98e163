"""Blended planes against their plain form, and what was looked up kept while the points move."""

import numpy as np
import pytest

from grindvision.vision.surface.signed_distance import CellBlocks, signed_distances
from grindvision.vision.surface.surfels import build_surfels

SIZE_MM = 2.0


@pytest.fixture
def surface(rng):
    places = rng.uniform(-20, 20, (6000, 2))
    heights = 3 * np.exp(-(places**2).sum(axis=1) / 30) + 0.02 * rng.normal(size=6000)
    return build_surfels(np.column_stack([places, heights]), SIZE_MM)


def plain(target, point, max_mm):
    """Distance, normal and variance of one point, from all surfels."""
    rows, size = target.planes, target.grid.size_mm
    away = np.linalg.norm(rows[:, :3] - point, axis=1)
    nearest = rows[away.argmin()]
    along = nearest[3:6] @ (point - nearest[:3])
    if away.min() >= max_mm or away.min() ** 2 - along**2 > (1.2 * size) ** 2:
        return np.nan, np.zeros(3), 0.0
    foot = point - along * nearest[3:6]
    cells = np.floor((rows[:, :3] - target.grid.origin_mm) / size) - np.floor((foot - target.grid.origin_mm) / size)
    facing = rows[:, 3:6] @ nearest[3:6]
    near = rows[(np.abs(cells) <= 1).all(axis=1) & (facing >= 0.8)]
    up = ((foot - near[:, :3]) * near[:, 3:6]).sum(axis=1)
    lateral = ((foot - near[:, :3]) ** 2).sum(axis=1) - up**2
    weights = near[:, 6] * np.exp(-lateral / (2 * (0.9 * size) ** 2))
    normal = weights @ near[:, 3:6]
    heights = up + near[:, 3:6] @ nearest[3:6] * along
    variance = weights**2 @ near[:, 7] / weights.sum() ** 2
    return weights @ heights / weights.sum(), normal / np.linalg.norm(normal), variance


def test_planes_around_the_nearest_surfel_are_blended(surface, rng):
    points = rng.uniform([-24, -24, -5], [24, 24, 8], (400, 3))
    found = signed_distances(surface, points, 2 * SIZE_MM)
    for point, distance, normal, variance in zip(points, *found, strict=True):
        wanted = plain(surface, point, 2 * SIZE_MM)
        np.testing.assert_allclose(distance, wanted[0], atol=1e-9)
        if np.isfinite(distance):
            np.testing.assert_allclose(normal, wanted[1], atol=1e-9)
            np.testing.assert_allclose(variance, wanted[2], rtol=1e-9)
    assert 0.2 < np.isnan(found[0]).mean() < 0.8


def test_what_was_looked_up_changes_nothing(surface, rng):
    points = rng.uniform([-24, -24, -5], [24, 24, 8], (400, 3))
    blocks = CellBlocks.unknown(len(points))
    for step_mm in (0.0, 1e-3, 0.5, 30.0):
        moved = points + step_mm
        for kept, fresh in zip(
            signed_distances(surface, moved, 2 * SIZE_MM, blocks),
            signed_distances(surface, moved, 2 * SIZE_MM),
            strict=True,
        ):
            np.testing.assert_array_equal(kept, fresh)
