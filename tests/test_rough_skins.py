"""Rough skins: both parts' surfaces wave by a tenth of a millimetre over some millimetres, each by its own."""

import warnings

import numpy as np
import pytest

from grindvision.errors import GrindvisionWarning
from grindvision.geometry import move_points
from grindvision.vision.change.detection import DetectOptions, detect
from tests.grinding_scene import arc_bead, plate_height, scan, view

POSES = view(0.15, (1.0, 0.3, 0.0)), view(0.47, (0.2, -0.5, 0.8))
BEAD = arc_bead(height_mm=1.2)


def rough(sigma_mm, rng, over_mm=3.0):
    """The plate with a skin of that standard deviation, waves of ``over_mm`` and longer in all directions."""
    waves, starts = rng.normal(size=(60, 2)) / over_mm, rng.uniform(0, 2 * np.pi, 60)

    def height(x, y):
        skin = sum(np.cos(u * x + v * y + start) for (u, v), start in zip(waves, starts, strict=True))
        return plate_height(x, y) + sigma_mm * np.sqrt(2 / len(waves)) * skin

    return height


def found_and_said(sigma_mm, beads, seed):
    """What is detected between two plates with skins of their own, what is said, and the bead's ridge."""
    rng = np.random.default_rng(seed)
    surface = rough(sigma_mm, rng)
    sample = scan(rough(sigma_mm, rng), POSES[0], 20_000, rng)
    test = scan(surface, POSES[1], 20_000, rng, beads)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", GrindvisionWarning)
        found = detect(sample, test, DetectOptions(seed=seed))
    return found, " | ".join(str(one.message) for one in caught), move_points(POSES[1], BEAD.ridge(surface))


@pytest.mark.parametrize("seed", [1, 2])
def test_how_far_a_rough_skin_may_move_the_path_is_said(seed):
    found, said, ridge = found_and_said(0.12, [BEAD], seed)
    away = np.linalg.norm(found.path_points[:, None] - ridge, axis=2).min(axis=1).max()
    assert "where their noise explains 0.0" in said and "rough skins" in said
    assert away < float(said.split("path points may be off by ")[1].split(" mm")[0])


def test_noise_is_not_blamed_for_what_rough_skins_hide():
    found, said, _ = found_and_said(0.3, [], 3)
    assert not found.beads and "would not be seen on half" in said
    assert "rough skins" in said and "scan with less noise" not in said


def test_of_smooth_skins_nothing_is_said():
    found, said, _ = found_and_said(0.0, [BEAD], 4)
    assert len(found.beads) == 1 and "skins" not in said and "path points may be off" not in said
