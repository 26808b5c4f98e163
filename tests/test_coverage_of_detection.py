"""What a comparison could not show is part of its answer."""

import warnings

import numpy as np
import pytest

from grindvision.errors import InputError
from grindvision.vision.change.coverage import cannot_show
from grindvision.vision.change.detection import detect
from grindvision.vision.change.visibility import MAX_OPEN, surrounded
from grindvision.vision.surface.surfels import build_surfels
from tests.grinding_scene import arc_bead, pair, plate_height, scan, view


def found_of(sample, test):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = detect(sample, test)
    return found, " | ".join(str(one.message) for one in caught)


@pytest.fixture(scope="module")
def good():
    return pair(seed=4, n_points=20_000)


@pytest.fixture(scope="module")
def found_good(good):
    return found_of(good.sample, good.test)


def test_nothing_to_grind_is_said_with_what_was_compared_and_what_would_have_been_told(found_good):
    found, _ = found_good
    cover = found.coverage
    assert not found.beads and "were compared; beads" in str(found)
    assert 0.9 < cover.test_fraction < 1 and 0.9 < cover.sample_fraction <= 1
    assert 0.05 < cover.height_mm <= cover.height_95_mm < np.inf
    assert cover.width_mm == 3 * found.difference.cell_mm


def test_a_bead_of_the_least_height_and_width_that_is_stated_is_found(found_good):
    cover = found_good[0].coverage
    for seed in (4, 5, 6):
        bead = arc_bead(length_mm=30.0, width_mm=cover.width_mm, height_mm=cover.height_mm)
        one = pair(seed=seed, n_points=20_000, beads=[bead])
        assert len(found_of(one.sample, one.test)[0].difference.clusters) == 1


def test_a_hole_of_the_sample_where_the_bead_is_is_told_with_its_place():
    bead = arc_bead(length_mm=12.0)
    whole = pair(seed=2, n_points=20_000, beads=[bead])
    middle = bead.line.mean(axis=0)
    rng = np.random.default_rng(2)
    holed = scan(
        plate_height,
        view(0.15, (1.0, 0.3, 0.0)),
        20_000,
        rng,
        mask=lambda x, y: np.hypot(x - middle[0], y - middle[1]) > 10,
    )
    found, said = found_of(holed, whole.test)
    assert not found.difference.clusters
    assert "was not compared" in said
    ridge = (whole.T_test_part @ [*middle, plate_height(*middle), 1])[:3]
    assert min(np.linalg.norm(place.middle_mm - ridge) for place in found.coverage.test_missed) < 5
    assert found.coverage.test_missed_mm2 > 200


def test_noise_raises_the_least_height_that_is_stated(found_good):
    noisy = pair(seed=4, n_points=20_000, noise_mm=0.3)
    calm, loud = found_good[0], found_of(noisy.sample, noisy.test)[0]
    assert loud.coverage.height_mm > 3 * calm.coverage.height_mm
    assert cannot_show(calm.difference, 2 * calm.coverage.height_95_mm)[0] < 0.15
    blind, places = cannot_show(loud.difference, calm.coverage.height_mm)
    assert blind > 0.9 and places[0].area_mm2 > 1000
    with pytest.raises(InputError, match="above zero"):
        cannot_show(calm.difference, 0.0)


def test_a_bead_that_noise_or_wide_spacing_hides_is_no_bare_nothing_to_grind(rng):
    bead = arc_bead(height_mm=1.5)
    one = pair(seed=11, n_points=20_000, beads=[bead])
    rays = one.test / np.linalg.norm(one.test, axis=1, keepdims=True)
    found, said = found_of(one.sample, one.test + rays * rng.normal(0, 0.9, (len(rays), 1)))
    assert not found.beads and "its noise is 0." in said and "would not be seen on half of the test scan" in said
    coarse = pair(seed=12, n_points=4_500, beads=[bead])
    found, said = found_of(coarse.sample, coarse.test)
    assert not found.beads and "beads narrower than" in said


def test_the_same_scan_twice_says_nothing_of_the_part(good, found_good):
    _, said = found_of(good.sample, good.sample.copy())
    assert "are one scan" in said
    assert "are one scan" not in found_good[1]


def test_all_around_is_told_from_octants_as_from_all_angles(rng):
    """A surface with a hole and rims: the short way agrees with the angles of all neighbours."""
    places = rng.uniform(-20, 20, (4000, 2))
    places = places[np.hypot(*places.T) > 6]
    points = np.column_stack([places, 0.02 * places[:, 0] ** 2])
    surface = build_surfels(points, 1.0)
    feet = np.column_stack([rng.uniform(-23, 23, (3000, 2)), np.zeros(3000)])
    feet[:, 2] = 0.02 * feet[:, 0] ** 2
    normals = rng.normal([0, 0, 1], 0.3, (3000, 3))
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    normals[::100] = 0.0
    wanted = [widest_gap(surface.points, *foot, 2.5) < MAX_OPEN for foot in zip(feet, normals, strict=True)]
    np.testing.assert_array_equal(surrounded(surface, feet, normals), wanted)
    assert 0.2 < np.mean(wanted) < 0.95


def widest_gap(points, foot, normal, reach):
    around = points[np.linalg.norm(points - foot, axis=1) <= reach] - foot
    if len(around) < 4 or not normal.any():
        return 2 * np.pi
    across = np.linalg.svd(normal[None])[2][1:]
    angles = np.sort(np.arctan2(*(around @ across.T).T))
    return np.diff(angles, append=angles[0] + 2 * np.pi).max()
