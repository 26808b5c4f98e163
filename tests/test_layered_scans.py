"""Scans that show a surface twice, as views merged with a misfit do: found, and counted in the pose's covariance."""

import warnings

import numpy as np
import pytest

from grindvision.geometry import inverse, move_points
from grindvision.vision.registration.free_motions import weakest_motion
from grindvision.vision.registration.layered_scans import allow_for_layers
from grindvision.vision.registration.scan_registration import RegisterOptions, register
from grindvision.vision.surface.layers import find_layers
from grindvision.vision.surface.scan import choose_resolution, prepare_scan
from tests.grinding_scene import plate_height, scan, view

POSES = view(0.1, (1.0, 0.3, 0.0)), view(0.35, (0.2, -0.5, 0.8))


def prepared(points):
    return prepare_scan(points, choose_resolution(points), np.zeros(3), None)


def seen(pose, rng, surface=plate_height, noise_mm=0.02):
    return scan(surface, pose, 20_000, rng, noise_mm=noise_mm)


def twice(points, misfit_mm, rng, share=0.5):
    """The scan with a share of its points moved by the misfit (3,), as those of another view are."""
    return points + np.where(rng.uniform(size=len(points)) < share, 1.0, 0.0)[:, None] * np.asarray(misfit_mm)


@pytest.mark.parametrize("share", [0.3, 0.5])
@pytest.mark.parametrize("apart_mm", [0.2, 0.4])
def test_layers_are_found_with_their_distance(rng, apart_mm, share):
    layers = find_layers(prepared(twice(seen(POSES[0], rng), [0, 0, apart_mm], rng, share)))
    assert layers is not None and layers.share > 0.3
    assert layers.apart_mm == pytest.approx(apart_mm, rel=0.2)


def rippled(x, y):
    return plate_height(x, y) + 0.2 * np.sin(x / 0.7)


def stepped(x, y):
    return plate_height(x, y) + 0.3 * (np.floor(x / 6) % 2)


@pytest.mark.parametrize("surface", [plate_height, rippled, stepped])
@pytest.mark.parametrize("noise_mm", [0.02, 0.3])
def test_noise_ripples_and_steps_are_no_layers(rng, surface, noise_mm):
    assert find_layers(prepared(seen(POSES[0], rng, surface, noise_mm))) is None


def test_rounded_depths_are_no_layers(rng):
    points = seen(view(0.35, (0.2, -0.5, 0.8)), rng)
    points[:, 2] = np.round(points[:, 2] / 0.5) * 0.5
    assert find_layers(prepared(points)) is None


def test_two_sides_of_a_sheet_are_no_layers(rng):
    points = seen(POSES[0], rng)
    assert find_layers(prepared(twice(points, [0, 0, 4.0], rng))) is None


def test_the_pose_of_a_layered_scan_is_known_to_half_the_distance_of_the_layers_only():
    for seed in range(3):
        rng = np.random.default_rng(seed)
        first, second = (seen(pose, rng) for pose in POSES)
        misfit = 0.4 * np.array([0.1, 0.3, 0.95])
        with pytest.warns(UserWarning, match="two layers up to 0.[34]"):
            found = register(twice(second, misfit, rng), first, RegisterOptions(seed=seed))
        T_true = POSES[0] @ inverse(POSES[1])
        off = np.linalg.norm(move_points(found.T_target_source, second) - move_points(T_true, second), axis=1).max()
        sigma = weakest_motion(found.fine, second[::50])[0]
        assert 0.15 < sigma < 0.6
        assert off < 2 * sigma


def test_sound_scans_lose_nothing_and_are_not_warned_of(rng):
    first, second = (seen(pose, rng) for pose in POSES)
    found = register(second, first)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        same = allow_for_layers(found.fine, {"source": found.source, "target": found.target})
    assert same is found.fine
