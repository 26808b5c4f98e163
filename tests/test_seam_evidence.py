"""What noise and mixed pixels make look like a seam is none, or is said to be doubtful."""

import warnings

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from benchmarks.seams import surface
from grindvision.errors import GrindvisionWarning, NoGrooveError
from grindvision.vision.seam.groove import FindGroovesOptions, find_grooves
from grindvision.vision.seam.groove_diagnostics import judge_groove
from grindvision.vision.seam.groove_noise import patch_noise_mm, stands_out
from grindvision.vision.seam.seams import FindSeamsOptions, find_seams
from grindvision.vision.seam.weld import TraceWeldOptions, trace_weld
from grindvision_book.chapter_15.study import look_at_bend
from tests.groove_scenes import cloud, grid, vee
from tests.seam_scenes import corner, noisy, tube_on_plate

ABOVE = np.array([0.0, 0.0, 450.0])
FRONT = np.array([20.0, -220.0, 320.0])


def blotched(rng, rows=160, columns=200, spacing=0.8, noise_mm=0.5, alike_px=1.5):
    """Places and errors of a camera whose pixels err alike over their neighbourhood."""
    errors = gaussian_filter(rng.standard_normal((rows, columns)), alike_px)
    x, y = np.meshgrid(np.arange(columns) * spacing, np.arange(rows) * spacing)
    return x - x.mean(), y - y.mean(), noise_mm * errors / errors.std()


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.full) for seed in (3, 7))])
def test_the_blotches_of_a_camera_on_a_flat_plate_are_no_groove(seed):
    x, y, errors = blotched(np.random.default_rng(seed))
    with pytest.raises(NoGrooveError):
        find_seams(np.stack([x, y, errors], axis=-1), FindSeamsOptions(ABOVE))


def test_a_groove_stands_out_of_the_blotches_of_its_plate():
    x, y, errors = blotched(np.random.default_rng(4), 120, 160)
    points = np.stack([x, y, errors - np.maximum(0.0, 5.0 - np.abs(y))], axis=-1).reshape(-1, 3)
    (groove,) = find_grooves(points, FindGroovesOptions(viewpoint_mm=ABOVE)).grooves
    noise_mm = patch_noise_mm(groove, points, 0.8)
    assert noise_mm is not None and 0.2 < noise_mm < 0.5
    assert stands_out(judge_groove(groove, points), points, 0.8)
    (seam,) = find_seams(points, FindSeamsOptions(ABOVE)).seams
    assert np.abs(seam.root[:, 1]).mean() < 0.5


@pytest.mark.parametrize("share", [0.25, 1.0])
def test_mixed_pixels_along_the_rays_are_no_wall_unless_they_are_as_dense_as_one(share):
    """Merged scans show a wall as densely as its base, from wherever the first one was taken."""
    rng = np.random.default_rng(5)
    points = corner(rng, leg=50.0)
    points = points[(points[:, 2] < 1) | (rng.random(len(points)) < share)]
    options = FindSeamsOptions(np.array([0.0, -15.0, 450.0]), "fillet")
    if share == 1.0:
        assert find_seams(points, options).seams[0].length_mm > 80
    else:
        with pytest.raises(NoGrooveError):
            find_seams(points, options)


def test_a_seam_ends_where_its_wall_ends_whatever_few_pixels_lie_behind():
    rng = np.random.default_rng(6)
    points = corner(rng, leg=50.0, length=100.0)
    wall = (points[:, 2] > 1) & (points[:, 0] > 10)
    kept = ~wall | ((rng.random(len(points)) < 0.12) & (points[:, 0] < 40))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        (seam,) = trace_weld(points[kept], TraceWeldOptions(viewpoint_mm=FRONT)).seams
    assert seam.root[:, 0].max() == pytest.approx(10, abs=4)
    assert seam.root[:, 0].min() == pytest.approx(-50, abs=3)


@pytest.mark.parametrize("radius_mm", [0.0, 7.0])
def test_a_bend_of_one_sheet_is_said_to_be_rounded(radius_mm):
    rng = np.random.default_rng(7)
    points = corner(rng, leg=50.0)
    off = np.abs(points[:, 1:]).max(axis=1) < radius_mm
    x, angle = np.meshgrid(np.arange(-45.0, 45.0), np.arange(0.0, np.pi / 2, 1 / max(radius_mm, 1.0)))
    arc = radius_mm * np.stack([0 * x, np.sin(angle) - 1, 1 - np.cos(angle)], axis=-1) + x[..., None] * [1, 0, 0]
    bent = np.concatenate([points[~off], noisy(arc.reshape(-1, 3), rng, 0.1)])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", GrindvisionWarning)
        seams = trace_weld(bent if radius_mm else points, TraceWeldOptions(viewpoint_mm=FRONT)).seams
    assert any("is rounded" in str(one.message) for one in caught) == (radius_mm > 0)
    assert len(seams) == 1


def test_members_are_numbers_of_the_cloud_with_its_empty_pixels():
    rng = np.random.default_rng(8)
    places = grid(80, 60)
    points = cloud(places, vee(places[:, 1]), rng)
    sparse = np.concatenate([np.full((500, 3), np.nan), points])
    weld = trace_weld(sparse, TraceWeldOptions(joint="groove"))
    (groove,) = weld.grooves
    assert weld.labels[groove.members].all() and len(groove.members) == weld.labels.sum()


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.full) for seed in (3, 6))])
def test_a_sheet_bent_as_narrowly_as_its_noise_allows_is_no_corner(seed):
    assert look_at_bend(15.0, 0.4, 1.0, seed) is None


@pytest.mark.parametrize("seed", [80, 83])
def test_a_turn_that_only_coarse_cells_show_is_a_bend(seed):
    with pytest.raises(NoGrooveError):
        find_seams(surface("bend")(seed).points)


@pytest.mark.parametrize("warped", [True, False])
def test_a_plate_that_is_warped_is_not_called_a_tube_without_a_doubt(warped):
    """An upright on a base that bends by 25 deg over its length, and a tube on a plate, of which half is seen."""
    rng = np.random.default_rng(9)
    if warped:
        points = corner(rng, length=120.0)
        points[:, 2] -= points[:, 0] ** 2 / 2 / 270
    else:
        points = tube_on_plate(rng)
    (seam,) = find_seams(points, FindSeamsOptions(FRONT)).seams
    assert seam.kind == "tube-on-plate"
    assert any("as a warped plate may" in doubt for doubt in seam.doubts) == warped
