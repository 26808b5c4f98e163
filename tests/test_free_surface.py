"""Surfaces that resist no pose: told from those that a small feature holds, before rivals are sought."""

import numpy as np
import pytest

from grindvision.errors import AmbiguousError
from grindvision.geometry import move_points, rigid, rotate_vectors, rotation_about
from grindvision.vision.registration import verification
from grindvision.vision.registration.free_surface import UNRESISTED, least_resistance
from grindvision.vision.registration.rivals import with_rivals
from grindvision.vision.registration.scan_registration import register

MOTION = rigid(rotation_about([0.3, -1.0, 0.4], 1.1), [200.0, -50.0, 400.0])
SPHERE_MM = 150.0


def dome(rib_mm=0.0, noise_mm=0.03, seed=0):
    """Points (N, 3) of a cap of a sphere, with a rib as high, 40 mm long and 6 mm wide beside its middle,
    and the normals."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-60, 60, (2, 20_000))
    x, y = x[np.hypot(x, y) < 60], y[np.hypot(x, y) < 60]
    z = np.sqrt(SPHERE_MM**2 - x**2 - y**2)
    points = np.column_stack([x, y, z])
    normals = points / SPHERE_MM
    raised = rib_mm / (1 + np.exp(3 * (np.maximum(abs(x - 25) / 20, abs(y + 10) / 3) * 4 - 4)))
    return points + (raised + noise_mm * rng.standard_normal(len(x)))[:, None] * normals, normals


def seen(points):
    """The same part 400 mm in front of its scanner."""
    return move_points(rigid(np.diag([1.0, -1.0, -1.0]), [0, 0, 400 + SPHERE_MM]), points)


def searches(monkeypatch):
    """A list that grows with each search for rivals."""
    asked = []

    def counted(*given):
        asked.append(given)
        return with_rivals(*given)

    monkeypatch.setattr(verification, "with_rivals", counted)
    return asked


def test_a_sphere_resists_nothing_and_a_box_all_wherever_they_are_and_in_any_unit():
    points, normals = dome(noise_mm=0.0)
    assert abs(least_resistance(points, normals)) < 1e-12
    side = np.random.default_rng(1).uniform(-1, 1, (600, 3))
    faces = np.arange(600) % 3
    side[np.arange(600), faces] = 1.0
    of_box = least_resistance(side, np.eye(3)[faces])
    assert of_box > 0.02
    moved = move_points(MOTION, side), rotate_vectors(MOTION, np.eye(3)[faces])
    assert least_resistance(*moved) == pytest.approx(of_box, rel=1e-9)
    assert least_resistance(1000 * moved[0], moved[1]) == pytest.approx(of_box, rel=1e-9)


def test_no_rival_is_sought_of_what_neither_scan_can_tell(monkeypatch):
    asked = searches(monkeypatch)
    with pytest.raises(AmbiguousError, match="free motion") as refused:
        register(seen(dome(seed=1)[0]), seen(dome(seed=2)[0]))
    assert str(refused.value).count("; ") == 3  # three motions, and what to do
    assert not asked


def test_a_small_rib_holds_what_it_resists(monkeypatch):
    """The rib covers a fiftieth of the cap, more than the errors of the normals feign: rivals are sought."""
    asked = searches(monkeypatch)
    source, target = dome(2.0, seed=1), dome(2.0, seed=2)
    turned = rigid(rotation_about([0.0, 0.0, 1.0], 0.2))
    found = register(seen(move_points(turned, source[0])), seen(target[0]))
    assert asked
    away = move_points(found.T_target_source, seen(move_points(turned, source[0]))) - seen(source[0])
    assert np.linalg.norm(away, axis=1).max() < 0.5


def test_a_part_of_which_only_one_scan_shows_the_rib_is_refused_after_a_search(monkeypatch):
    asked = searches(monkeypatch)
    with pytest.raises(AmbiguousError, match="free motion"):
        register(seen(dome(2.0, seed=1)[0]), seen(dome(seed=2)[0]))
    assert asked


def test_the_limit_is_that_of_the_errors_of_the_normals():
    """Normals with errors of the size that is allowed for hold a plane by half of the limit."""
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(-50, 50, (4000, 2)), np.zeros(4000)])
    tilted = np.column_stack([0.01 * rng.standard_normal((4000, 2)), np.ones(4000)])
    normals = tilted / np.linalg.norm(tilted, axis=1, keepdims=True)
    assert least_resistance(points, normals) == pytest.approx(UNRESISTED / 2, rel=0.1)
