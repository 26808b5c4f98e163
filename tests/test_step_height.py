"""Step heights: a known step comes back, wherever the cloud lies, with an uncertainty that fits the scatter."""

import numpy as np
import pytest

from grindvision.errors import DegenerateError, InputError
from grindvision.geometry import move_points, random_rotation, rigid
from grindvision.vision.metrology.step_height import measure_step


def step_cloud(rng, noise_mm=0.0, height_mm=12.5):
    lower = np.column_stack([rng.uniform(-50, 50, (4000, 2)), np.zeros(4000)])
    upper = np.column_stack([rng.uniform(-15, 15, (1500, 2)), np.full(1500, height_mm)])
    wall = np.column_stack([np.full(200, 15.0), rng.uniform(-15, 15, 200), rng.uniform(0, height_mm, 200)])
    points = np.concatenate([lower[np.abs(lower[:, :2]).max(axis=1) > 15], upper, wall])
    points[:, 2] += noise_mm * rng.standard_normal(len(points))
    return points


def test_step_is_found_at_any_pose_and_in_any_order(rng):
    points = step_cloud(rng)
    moved = move_points(rigid(random_rotation(rng), rng.uniform(-500, 500, 3)), rng.permutation(points))
    assert measure_step(points, rng).height_mm == pytest.approx(12.5, abs=1e-8)
    assert measure_step(moved, rng).height_mm == pytest.approx(12.5, abs=1e-8)


def test_stated_uncertainty_is_the_scatter_of_repeated_measurements(rng):
    steps = [measure_step(step_cloud(rng, 0.05), rng) for _ in range(60)]
    scatter = np.std([step.height_mm for step in steps])
    assert np.mean([step.height_mm for step in steps]) == pytest.approx(12.5, abs=3e-3)
    assert 0.6 < np.mean([step.fit_std_mm for step in steps]) / scatter < 1.5


def test_what_is_no_step_is_refused(rng):
    flat = np.column_stack([rng.uniform(-50, 50, (500, 2)), np.zeros(500)])
    with pytest.raises(DegenerateError, match="one face only"):
        measure_step(flat, rng)
    edge = np.concatenate([flat, flat[:300][:, [2, 1, 0]] + [60, 0, 60]])
    with pytest.raises(DegenerateError, match="enclose 90"):
        measure_step(edge, rng)
    with pytest.raises(InputError, match="threshold_mm"):
        measure_step(step_cloud(rng), rng, threshold_mm=0.0)
