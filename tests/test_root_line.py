"""The root line of a corner is as smooth as its noise asks for, and its stated deviation holds its error."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, gaussian_filter1d
from scipy.spatial import cKDTree

from grindvision.vision.seam.face_fit import _steadily_bent
from grindvision.vision.seam.narrower_fit import NARROW, NarrowerMove
from grindvision.vision.seam.root_line import root_line
from grindvision.vision.seam.seam_curve import build_curve, nearest_stations
from grindvision.vision.seam.seam_polynomial import fit_polynomial
from grindvision.vision.seam.seam_smoothing import smooth_to_noise
from grindvision.vision.seam.seams import FindSeamsOptions, find_seams
from tests.seam_scenes import plate

ABOVE = FindSeamsOptions(np.array([0.0, -300.0, 350.0]))


def windowed(rng, shape, window):
    """Noise of unit variance that a Gaussian window makes alike along the first axis."""
    noise = gaussian_filter1d(rng.standard_normal(shape), window, axis=0)
    return noise * np.sqrt(2 * np.sqrt(np.pi) * window)


def arc(turn_rad, count, radius=40.0):
    """A curve of so many stations that turns by ``turn_rad``."""
    angle = np.linspace(0.0, turn_rad, count)
    places = radius * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    up = np.tile([0.0, 0.0, 1.0], (count, 1))
    return build_curve(places, up, np.linalg.norm(places[1] - places[0]))


@pytest.mark.parametrize("turn_rad", [0.001, 1.5])
def test_the_stated_deviation_holds_the_error_of_a_line_through_windows(turn_rad):
    """Errors over their stated deviations have a variance of one, over lines on curves that followed their noise."""
    window, ratios, errors = 2.4, [], []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        curve = arc(turn_rad, 150, 170.0 / turn_rad)
        noise = 0.4 * windowed(rng, (len(curve), 2), window)
        # The curve itself was laid through the same noise before.
        bent = build_curve(
            curve.stations + noise[:, :1] * curve.across + noise[:, 1:] * curve.up, curve.up, curve.step_mm
        )
        level = np.full(len(bent), 0.15)
        line = root_line(bent, np.zeros((len(bent), 2)), np.ones(len(bent)), level, window)
        away = cKDTree(arc(turn_rad, 15000, 170.0 / turn_rad).stations)
        off = away.query(line.places)[0]
        errors.append(off.mean())
        ratios.append((off**2).mean() / 2 / (line.scatter * line.sigma * level).mean() ** 2)
    assert np.mean(errors) < 0.25  # single stations are 0.5 off
    assert 0.5 < np.mean(ratios) < 1.6


@pytest.mark.parametrize("turn_rad", [0.5, np.pi, 2 * np.pi])
def test_without_noise_a_line_follows_its_arc_however_far_it_turns(turn_rad):
    curve = arc(turn_rad, 180)
    line = root_line(curve, np.zeros((180, 2)), np.ones(180), np.full(180, 0.01), 2.4)
    assert np.abs(np.linalg.norm(line.places, axis=1) - 40).max() < 0.05


def test_noise_that_is_alike_over_a_gap_is_not_followed():
    """Gaps as long as noise is alike predict it from their sides; of longer ones the smooth line is left."""
    window, errors = 2.7, {}
    for gap in (11, 20):
        lines = [
            smooth_to_noise(windowed(np.random.default_rng(seed), 200, window), np.ones(200), 1.0, 2.5, gap)[0]
            for seed in range(20)
        ]
        errors[gap] = np.sqrt(np.mean(np.square(lines)))
    assert errors[20] < 0.75 * errors[11]


@pytest.mark.parametrize(("moved_mm", "share"), [(0.05, 0.0), (1.0, 0.98)])
def test_a_move_that_noise_explains_is_none(moved_mm, share):
    move = NarrowerMove(np.tile([0.0, moved_mm], (5, 1)), np.full(5, 0.1))
    np.testing.assert_allclose(move.share, share, atol=1e-9)
    np.testing.assert_allclose(move.missed[:, 1], share * moved_mm, atol=1e-9)
    # A miss that grows with the third or the fourth power of the width leaves this much after the move.
    for power in (3, 4):
        left = NARROW**power / (1 - NARROW**power) * move.missed[:, 1]
        assert (left <= 1.5 * move.sigma).all() and (move.sigma <= 2 * left + 0.1).all()


def test_a_degree_is_told_from_noise_and_no_higher_one_taken(rng):
    at = np.linspace(-1, 1, 200)[:, None]
    degrees = []
    for truth in (0 * at, 3 * at**3):
        values = truth + 0.3 * windowed(rng, (200, 1), 2.0)
        degrees.append(fit_polynomial(values, np.ones(200), 2 * np.sqrt(np.pi) * 2.0, (0, 5, 2)).degree)
    assert degrees[0] == 0 and degrees[1] in (3, 4)


def alike(rng, shape, sigma_px):
    """Noise of unit variance alike over some pixels."""
    return gaussian_filter(rng.standard_normal(shape), sigma_px) * np.sqrt(4 * np.pi) * sigma_px


def camera_corner(rng, noise_mm, blur_mm=0.0, spacing=0.5):
    """A right-angled corner along x whose points err by noise alike over pixels; the wall bends into it if blurred."""
    count = round(120 / spacing)
    base = plate((-60.0, 60.0), (-40.0, 0.0), spacing=spacing)
    wall = plate((-60.0, 60.0), (0.0, 40.0), second=(0.0, 0.0, 1.0), spacing=spacing)
    base[:, 2] += noise_mm * alike(rng, (count, len(base) // count), 2.5).ravel()
    wall[:, 1] += noise_mm * alike(rng, (count, len(wall) // count), 2.5).ravel()
    if blur_mm > 0:
        wall[:, 1] -= blur_mm * np.maximum(1 - wall[:, 2] / 2.5, 0) ** 2
    return np.concatenate([base, wall])


def test_noise_that_pixels_share_is_stated():
    """Over five clouds: a line of 120 mm is known better than a single place, and its deviation holds its error."""
    errors, ratios = [], []
    for seed in range(5):
        seam = find_seams(camera_corner(np.random.default_rng(seed), 0.25), ABOVE).seams[0]
        off = np.hypot(seam.root[:, 1], seam.root[:, 2])
        errors.append(off.mean())
        ratios.append(np.percentile(off / seam.sigma_mm, 95))
    assert np.mean(errors) < 0.3 and np.median(ratios) < 3


def test_the_stated_deviation_is_that_of_the_distance_to_the_root():
    """Faces wavy by 0.1 mm in noise of 0.2 mm and more that pixels share: about two thirds of the root lies within one
    of its deviations (63 % of a round spread do), nearly all within two (98 %)."""
    off_by = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        points = camera_corner(rng, 0.1)
        points += 0.2 * rng.standard_normal(points.shape)
        phase = rng.uniform(0, 2 * np.pi, 2)
        base, wall = np.split(points, 2)
        base[:, 2] += 0.1 * np.sin(phase[0] - 2 * np.pi * base[:, 1] / 40)
        wall[:, 1] += 0.1 * np.sin(phase[1] + 2 * np.pi * wall[:, 2] / 40)
        seam = find_seams(points, ABOVE).seams[0]
        off = np.hypot(seam.root[:, 1] - 0.1 * np.sin(phase[1]), seam.root[:, 2] - 0.1 * np.sin(phase[0]))
        off_by.append(off / seam.sigma_mm)
    deviations = np.concatenate(off_by)
    assert 0.45 < (deviations < 1).mean() < 0.85
    assert (deviations < 2).mean() > 0.9


def test_a_face_that_a_camera_blurs_into_the_corner_is_followed_from_beyond_the_blur():
    (seam,) = find_seams(camera_corner(np.random.default_rng(4), 0.15, blur_mm=1.5), ABOVE).seams
    assert np.hypot(seam.root[:, 1], seam.root[:, 2]).mean() < 0.4


def test_the_curvature_of_windows_is_steadied_and_takes_the_level_with_it(rng):
    """The level moves by its regression on the curvature, as a fit with the curvature known would give it."""
    count = 120
    covariance = np.tile([[0.04, -0.03, 0.006], [-0.03, 0.03, -0.007], [0.006, -0.007, 0.002]], (count, 1, 1))
    errors = windowed(rng, (count, 3), 2.4) @ np.linalg.cholesky(covariance[0]).T
    truth = np.array([1.0, 0.1, -0.02])
    steadied, left = _steadily_bent(truth + errors, covariance, 2 * np.sqrt(np.pi) * 2.4)
    assert np.std(steadied[:, 2]) < 0.3 * np.std(errors[:, 2])
    assert np.mean((steadied[:, 0] - 1.0) ** 2) < 0.8 * np.mean(errors[:, 0] ** 2)
    assert (left[:, 0, 0] < covariance[:, 0, 0]).all() and (np.linalg.eigvalsh(left) > -1e-12).all()


def test_a_plate_that_stands_on_a_tube_is_found_where_the_tube_is_seen(rng):
    """The tube is fitted near the plate, with fine cells: it bends away too fast for coarser ones."""
    angle, x = np.meshgrid(np.arange(-1.4, 1.4, 0.85 / 25), np.arange(-70.0, 70.0, 0.85))
    tube = np.stack([x, 25 * np.sin(angle), 25 * np.cos(angle)], axis=-1).reshape(-1, 3)
    tube = tube[(tube[:, 1] < -3) | (np.abs(tube[:, 0]) > 45)]
    lug = plate((-45.0, 45.0), (24.8, 65.0), origin=(0.0, -3.0, 0.0), second=(0.0, 0.0, 1.0), spacing=0.85)
    points = np.concatenate([tube[tube[:, 1] < 3], lug])
    found = find_seams(points + 0.03 * rng.standard_normal(points.shape), ABOVE)
    root = found.seams[0].root
    assert np.hypot(root[:, 1] + 3, root[:, 2] - np.sqrt(25**2 - 9)).mean() < 0.2


@pytest.mark.parametrize("turn_rad", [0.3, 3.0, 7.0])
def test_nearest_stations_agree_with_the_plain_search(rng, turn_rad):
    curve = arc(turn_rad, 83)
    points = rng.uniform(-55, 55, (4000, 3)) * [1, 1, 0.2]
    index, station, offset = nearest_stations(points, curve, 9.0)
    away, nearest = cKDTree(curve.stations).query(points)
    across = points - curve.stations[nearest]
    ahead = (across * curve.along[nearest]).sum(axis=1)
    kept = np.flatnonzero((away < 9.0) & (np.abs(ahead) <= 0.75 * curve.step_mm))
    assert (index == kept).all() and (station == nearest[kept]).all()
    np.testing.assert_allclose(offset, (across - ahead[:, None] * curve.along[nearest])[kept], atol=1e-12)
