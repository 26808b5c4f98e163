"""Surfaces in report.png: means over cells, holes between rows closed, lit from the upper left."""

import numpy as np
import pytest
from matplotlib.figure import Figure

from grindvision.relief import draw_relief, rasterised


def rows_of_a_scan(step_mm: float = 1.0, between_mm: float = 1.9):
    """Places (N, 2) in rows that are farther apart than the points in them."""
    x, y = np.meshgrid(np.arange(0, 60, step_mm), np.arange(0, 40, between_mm))
    return np.column_stack([x.ravel(), y.ravel()])


def shown(axes):
    return np.asarray(axes.get_images()[-1].get_array())


def test_a_tilted_plane_keeps_its_heights_to_the_slope_times_a_cell():
    places = rows_of_a_scan()
    raster = rasterised(places, 5 + 0.1 * places[:, 0])
    columns = raster.cells.shape[1]
    middles = raster.corner_mm[0] + raster.size_mm * (np.arange(columns) + 0.5)
    assert np.nanmax(np.abs(raster.cells - (5 + 0.1 * middles))) <= 0.1 * raster.size_mm
    assert np.isfinite(raster.cells).mean() == 1  # no hole between the rows


def test_holes_between_rows_close_and_a_hole_of_the_part_stays():
    places = rows_of_a_scan(0.5, 0.5)
    off = np.linalg.norm(places - [30, 20], axis=1)
    raster = rasterised(places[off > 8], np.zeros((off > 8).sum()), 1.2)
    open_mm2 = np.isnan(raster.cells).sum() * raster.size_mm**2
    assert 0.8 * np.pi * 8**2 < open_mm2 < 1.1 * np.pi * 8**2


@pytest.mark.parametrize("downwards", [False, True])
def test_a_dome_is_bright_towards_the_upper_left_and_dark_opposite(downwards):
    places = rows_of_a_scan(0.5, 0.5) - [30, 20]
    axes = Figure().subplots()
    axes.yaxis.set_inverted(downwards)
    draw_relief(axes, places, -0.01 * (places**2).sum(axis=1), "#808080")
    image = shown(axes)[::-1, :, :3].mean(axis=2)  # first row at the top, as axes run upwards
    image = image[::-1] if downwards else image
    rows, columns = image.shape
    assert axes.yaxis_inverted() == downwards
    assert image[: rows // 3, : columns // 3].mean() > 1.1 * image[-rows // 3 :, -columns // 3 :].mean()


def test_noise_of_a_flat_plate_is_not_drawn_as_walls():
    places, rng = rows_of_a_scan(0.3, 0.3), np.random.default_rng(1)
    axes = Figure().subplots()
    draw_relief(axes, places, rng.normal(0, 0.005, len(places)), "#ffffff")
    assert shown(axes)[..., 0].std() < 0.03


def test_cells_have_the_size_that_is_asked_for_and_no_points_draw_nothing():
    axes = Figure().subplots()
    assert draw_relief(axes, np.empty((0, 2)), np.empty(0), "#ffffff", size_mm=2.0) == 2.0
    assert not axes.get_images()
    places = rows_of_a_scan()
    assert draw_relief(axes, places, np.zeros(len(places)), "#ffffff", size_mm=3.0) == 3.0
    assert draw_relief(axes, places[:1], np.zeros(1), "#ffffff") > 0  # one point


def test_surfaces_of_one_panel_share_its_limits():
    axes = Figure().subplots()
    for shift_mm in (0, 50):
        places = rows_of_a_scan() + shift_mm
        draw_relief(axes, places, np.zeros(len(places)), "#ffffff")
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    assert left < 0 and right > 109 and low < 0 and high > 88
