"""Grooves in noise that is alike over some pixels, and hollows that are no grooves."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from grindvision.cell import DepthCamera, JointSize, joint_scene, weld_scene
from grindvision.errors import GrindvisionWarning
from grindvision.vision.seam.groove import find_grooves
from grindvision.vision.seam.groove_diagnostics import Edge, edge_or_arc, judge_groove
from grindvision.vision.seam.groove_profile import Corners, profile_height
from grindvision.vision.seam.joint_names import FAMILIES
from grindvision.vision.seam.seam_curve import Strip
from grindvision.vision.seam.seams import FindSeamsOptions, find_seams
from grindvision.vision.seam.section_shift import section_shifts
from grindvision.vision.seam.weld import trace_weld
from tests.groove_scenes import cloud, grid, overlap

#: Noise of 0.6 mm at 450 mm: of single pixels, of some pixels together (fractions), and waviness, mm.
SETTINGS = {"white": (1.0, 0.0, 0.0), "correlated": (0.3, 0.95, 0.0), "D415": (0.5, 0.5, 0.42)}


def noisy_scene(kind, setting, seed):
    camera = DepthCamera(serial=seed + 5)
    disparity_px = 0.6 / float(camera.mm_per_px(450.0))
    white, alike, waves_mm = SETTINGS[setting]
    errors = replace(
        camera.errors,
        triangulation_px=white * disparity_px,
        correlated_px=alike * disparity_px,
        distortion_mm=waves_mm,
        disparity_step_px=0.0,
    )
    return weld_scene(kind, np.random.default_rng(100 + seed), camera=camera.with_errors(errors))


def check(scene):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GrindvisionWarning)  # the plate's rim, in such noise, is a less certain step
        weld = trace_weld(scene.points)
    assert overlap(weld.labels, scene.labels) >= 0.95
    shown = scene.root_mm + scene.root_errors_mm
    fine = np.linspace(0, len(shown) - 1, 10 * len(shown))
    line = np.stack([np.interp(fine, np.arange(len(shown)), column) for column in shown.T], axis=1)
    off = cKDTree(line).query(weld.path.points)[0]
    assert off.mean() <= 0.25 and off.max() <= 0.8


def test_a_groove_on_a_pipe_in_noise_that_is_alike_over_some_pixels():
    check(noisy_scene("cylinder", "correlated", 0))


@pytest.mark.full
@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("setting", SETTINGS)
@pytest.mark.parametrize("kind", ["line", "curve", "box", "cylinder"])
def test_grooves_in_three_kinds_of_noise(kind, setting, seed):
    check(noisy_scene(kind, setting, seed))


@pytest.mark.parametrize("floor_mm", [0.0, 2.0])
def test_sections_moved_as_a_whole_are_brought_back(rng, floor_mm):
    corners = Corners(0.05, 0.05, floor_mm)
    sections = np.tile([0.2, 0.02, 0.0, 6.0, -5.0, 0.3, 5.0], (80, 1))
    along, across = rng.uniform(0, 79, 8000), rng.uniform(-7, 7, 8000)
    aside, above = 0.3, -0.4
    height = profile_height(across[:, None] - aside, np.tile(sections[0], (8000, 1)), corners)[:, 0] + above
    strip = Strip(np.arange(8000), along, across, height + 0.05 * rng.standard_normal(8000))
    shifts = section_shifts(strip, sections, corners, 1.0)
    np.testing.assert_allclose(shifts[0], aside, atol=0.05)
    np.testing.assert_allclose(shifts[1], above, atol=0.05)


def test_an_oblique_end_is_labelled_wall_by_wall(rng):
    places = grid()
    kept = places[:, 0] + places[:, 1] < 40
    heights = -np.maximum(0, 6 - 1.2 * np.abs(places[:, 1]))
    found = find_seams(cloud(places[kept], heights[kept], rng))
    assert overlap(found.labels, (np.abs(places[:, 1]) < 5)[kept]) > 0.97


def test_a_hollow_whose_sides_bend_on_is_no_groove(rng):
    """Two tubes side by side: both arcs fall towards the line in which they touch, and no edge begins the hollow."""
    places = grid(150, 120)
    beside = np.abs(places[:, 1]) - 45.0
    tubes = cloud(places, np.sqrt(60.0**2 - beside**2) - 60.0, rng)
    (groove,) = find_grooves(tubes).grooves
    assert judge_groove(groove, tubes).bends_on
    assert {seam.kind for seam in find_seams(tubes).seams} <= set(FAMILIES["fillet"])
    (asked,) = find_seams(tubes, FindSeamsOptions(joint="groove")).seams
    assert asked.groove is not None


@pytest.mark.parametrize("seed", range(2))
def test_tubes_that_lean_in_noise_are_no_groove(seed):
    rng = np.random.default_rng([seed, 45, 20])
    size = JointSize(length_mm=250, radius_mm=40, branch_mm=20, lean_deg=45, height_mm=100)
    scene = joint_scene("saddle", rng, size, None, 500.0, every=2)
    found = find_seams(scene.points + 0.4 * rng.standard_normal(scene.points.shape))
    assert [seam.kind for seam in found.seams] == ["saddle"]
    assert cKDTree(scene.root_mm + scene.root_errors_mm).query(found.seams[0].root)[0].mean() < 2.0


def test_an_edge_that_noise_hides_is_no_edge_and_is_said(rng):
    """The same wall, round or with an edge, in noise larger than what tells them apart, and in a tenth of it."""
    place = np.linspace(0.1, 1.7, 16)
    arc, edged = -((1.75 - place) ** 2), -3.0 * np.maximum(1.0 - place, 0.0)
    for height, clear in ((arc, Edge.BENDS), (edged, Edge.ENDS)):
        assert edge_or_arc(np.column_stack([place, height]), 0.001) is clear
    blurred = (arc + edged) / 2
    for noise_mm in (0.3, 1.0):
        assert edge_or_arc(np.column_stack([place, 0.3 * arc]), noise_mm) is Edge.UNTOLD
    assert edge_or_arc(np.column_stack([place, blurred]), 0.001) is Edge.ENDS


def test_a_groove_whose_surface_ends_beside_it_is_followed_with_a_warning(rng):
    """Nothing tells a strip of one wall's width from one of two round bodies."""
    places = grid(150, 60)
    seen = places[:, 1] < 5.6
    heights = -np.maximum(0, 6 - 1.2 * np.abs(places[:, 1]))
    points = cloud(places[seen], heights[seen], rng)
    with pytest.warns(GrindvisionWarning, match=r"hardly any points show how it ends|partly outside"):
        trace_weld(points)
