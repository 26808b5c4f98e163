"""A sphere in a view: found in noise and in few points, and doubted where its points have another diameter."""

import numpy as np
import pytest

from grindvision.calibration.sphere_centres import find_sphere
from grindvision.calibration.sphere_search import cut_out_sphere, doubt_diameter, own_diameter
from grindvision.cli import main
from grindvision.errors import DegenerateError
from tests.test_hand_eye import folder_of_views

pytestmark = pytest.mark.usefixtures("blank_pictures")

CENTRE = np.array([10.0, -20.0, 400.0])


def cap(rng, radius=40.0, n=3000, noise_mm=0.1, relief_mm=0.0):
    """Points of the side of a sphere that a camera at the origin sees; its surface may be in relief."""
    rays = rng.normal(size=(4 * n, 3))
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    rays = rays[rays @ (-CENTRE / np.linalg.norm(CENTRE)) > 0.25][:n]
    out = radius + relief_mm * np.sin(9 * rays[:, 0]) * np.cos(8 * rays[:, 1])
    return CENTRE + out[:, None] * rays + noise_mm * rng.normal(size=rays.shape)


@pytest.mark.parametrize("noise_mm", [0.2, 0.5, 1.0])
@pytest.mark.parametrize("n", [300, 3000, 12000])
def test_a_sphere_is_found_in_the_noise_of_any_camera(noise_mm, n):
    rng = np.random.default_rng(int(10 * noise_mm) + n)
    points = cap(rng, n=n, noise_mm=noise_mm)
    table = np.column_stack([rng.uniform(-150, 150, (n, 2)), np.full(n, 445.0) + noise_mm * rng.normal(size=n)])
    fit = cut_out_sphere(np.vstack([points, table]), 80.0, rng, "view")
    sigma = np.sqrt(np.linalg.eigvalsh(fit.centre_covariance)[-1])
    assert np.linalg.norm(fit.centre_mm - CENTRE) < max(4 * sigma, 0.1)
    assert fit.inliers.shape == (2 * n,)
    assert fit.inliers[:n].mean() > 0.6 > 0.02 > fit.inliers[n:].mean()


@pytest.mark.parametrize("noise_mm", [0.1, 0.5])
def test_relief_is_no_noise(noise_mm):
    rng = np.random.default_rng(3)
    with pytest.raises(DegenerateError, match="no sphere"):
        cut_out_sphere(cap(rng, noise_mm=noise_mm, relief_mm=3.0), 80.0, rng, "head")


@pytest.mark.parametrize("strays", [1, 2, 3])
def test_a_few_points_beside_a_sphere_are_strays(strays):
    rng = np.random.default_rng(strays)
    points = np.vstack([cap(rng, n=800), CENTRE + [0.0, 0, -45] + rng.uniform(-1, 1, (strays, 3))])
    fit = find_sphere(points, rng, 40.0, 0.5)
    assert np.linalg.norm(fit.centre_mm - CENTRE) < 0.05
    assert fit.inliers[:800].mean() > 0.95 and not fit.inliers[800:].any()


@pytest.mark.parametrize(("said", "where"), [(78.6, "near to"), (80.0, ""), (81.4, "far from")])
def test_a_diameter_that_the_points_do_not_have_is_doubted(said, where):
    rng = np.random.default_rng(5)
    views = [cap(rng, noise_mm=0.1) for _ in range(5)]
    fits = [cut_out_sphere(points, said, rng, "view") for points in views]
    own = [own_diameter(points, fit) for points, fit in zip(views, fits, strict=True)]
    assert all(abs(one.diameter_mm - 80.0) < 4 * one.sigma_mm + 0.02 for one in own)
    text = doubt_diameter(own, said)
    assert bool(text) == bool(where) and where in text
    shifts = [(fit.centre_mm - CENTRE) @ CENTRE / np.linalg.norm(CENTRE) for fit in fits]
    assert np.median(shifts) == pytest.approx(-np.median([one.farther_mm for one in own]), abs=0.1)


def test_the_command_warns_of_a_mistyped_diameter_with_its_size(tmp_path, capsys):
    words = ["hand-eye", *folder_of_views(tmp_path), "--rotation", "fanuc", "-o", str(tmp_path / "camera")]
    assert main([*words, "--target", "sphere:38.1"]) == 0
    assert "diameter" not in capsys.readouterr().err
    assert main([*words, "--target", "sphere:38.9"]) == 0
    error = capsys.readouterr().err
    assert "not the stated 38.9 mm" in error and "by its own points the sphere has a diameter of 38.1" in error
