"""Smoothing along a seam: what it keeps, what it bridges, and a stiffness that follows from the noise."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from grindvision.vision.seam.seam_smoothing import GAP, JUDGED, KEPT, OUTLIER, smooth_along, smooth_to_noise

STEP_MM = 0.7
ALONG_MM = STEP_MM * np.arange(300)
SEAM_MM = 2.0 * np.sin(ALONG_MM / 25)
EVEN = np.ones(300)


def test_smoothing_keeps_lines_and_bridges_gaps():
    line = np.column_stack([np.linspace(0, 5, 60), np.linspace(3, -1, 60)])
    weights = np.ones(60)
    weights[20:30] = 0
    noisy = line.copy()
    noisy[20:30] = 99
    np.testing.assert_allclose(smooth_along(noisy, weights, 10, 1), line, atol=1e-4)
    spoilt = line.copy()
    spoilt[45] += 20
    np.testing.assert_allclose(smooth_along(spoilt, np.ones(60), 10, 1, robust=True), line, atol=0.05)


def test_smoothing_solves_its_equations(rng):
    for count in (3, 4, 5, 40):
        values, weights = rng.standard_normal(count), rng.random(count)
        bending = np.diff(np.eye(count), 2, axis=0)
        matrix = np.diag(weights / weights.max()) + 3.0**4 * bending.T @ bending
        expected = np.linalg.solve(matrix, weights / weights.max() * values)
        np.testing.assert_allclose(smooth_along(values, weights, 1.5, 0.5), expected, atol=1e-7)


def test_the_stiffness_is_that_of_the_plain_cross_validation(rng):
    values, weights = SEAM_MM[:90] + 0.1 * rng.standard_normal(90), rng.uniform(0.5, 1, 90)
    weights[40:50] = 0
    lengths = STEP_MM / 2 * np.sqrt(2) ** np.arange(17)
    missed, place = np.empty((17, 90)), np.arange(90)
    period = GAP + KEPT
    for turn in range(period // JUDGED):
        in_period = (place + turn * JUDGED) % period
        judged = np.abs(in_period - GAP // 2) <= JUDGED // 2
        kept = np.where(in_period < GAP, 0, weights)
        for trial, length in enumerate(lengths):
            missed[trial, judged] = (values - smooth_along(values, kept, length, STEP_MM))[judged]
    scaled = np.abs(missed) * np.sqrt(weights / weights.max())
    limit = OUTLIER * np.median(scaled[:, weights > 0], axis=1).min()
    best = np.argmin((np.minimum(scaled, limit) ** 2).sum(axis=1))
    assert smooth_to_noise(values, weights, STEP_MM)[1] == pytest.approx(lengths[best])


def test_without_noise_the_values_themselves_come_back():
    smooth, length_mm = smooth_to_noise(SEAM_MM, EVEN, STEP_MM)
    np.testing.assert_allclose(smooth, SEAM_MM, atol=2e-3)
    assert length_mm <= STEP_MM


def test_twice_the_noise_makes_the_curve_stiffer():
    noise = np.random.default_rng(3).standard_normal((5, 300))
    lengths = [
        np.median([smooth_to_noise(SEAM_MM + size * values, EVEN, STEP_MM)[1] for values in noise])
        for size in (0.0, 0.02, 0.04, 0.08, 0.16, 0.32, 0.64)
    ]
    assert (np.diff(lengths) >= 0).all()
    assert lengths[-1] > 2 * lengths[1] > 2 * lengths[0]


@pytest.mark.parametrize("alike_over", [0.0, 1.0])
@pytest.mark.parametrize("size_mm", [0.05, 0.2])
def test_no_other_stiffness_would_have_been_much_nearer_to_the_seam(rng, size_mm, alike_over):
    """Also where the noise of neighbouring stations is alike, as a camera's is."""

    def error(smooth):
        return np.sqrt(np.mean((smooth - SEAM_MM) ** 2))

    reached, possible = [], []
    for _ in range(10):
        noise = rng.standard_normal(300)
        noise = gaussian_filter1d(noise, alike_over) if alike_over else noise
        values = SEAM_MM + size_mm * noise / noise.std()
        reached.append(error(smooth_to_noise(values, EVEN, STEP_MM)[0]))
        possible.append(min(error(smooth_along(values, EVEN, STEP_MM * 2**k, STEP_MM)) for k in np.arange(-1, 8, 0.5)))
    assert np.mean(reached) < 1.25 * np.mean(possible)
    assert np.mean(reached) < 0.6 * size_mm


def test_scale_does_not_matter(rng):
    values = SEAM_MM + 0.1 * rng.standard_normal(300)
    smooth, length_mm = smooth_to_noise(values, EVEN, STEP_MM)
    larger, larger_mm = smooth_to_noise(1000 * values, 7 * EVEN, 1000 * STEP_MM)
    assert larger_mm == pytest.approx(1000 * length_mm)
    np.testing.assert_allclose(larger, 1000 * smooth, rtol=1e-6, atol=1e-6)


def test_values_far_off_and_unknown_ones_do_not_bend_the_curve(rng):
    values = SEAM_MM + 0.05 * rng.standard_normal(300)
    weights = EVEN.copy()
    values[[40, 41, 200]] += 30
    weights[100:110] = 0
    values[100:110] = 99
    assert np.abs(smooth_to_noise(values, weights, STEP_MM)[0] - SEAM_MM).max() < 0.2
