"""What a camera sees of a seam, and from where: scenes of upright boxes under a pinhole camera that matches windows."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from grindvision.errors import GrindvisionWarning
from grindvision.geometry import rotation_about, unit_vectors, vector_angle
from grindvision.vision.seam.point_density import camera_place
from grindvision.vision.seam.seam_sight import narrow_face
from grindvision.vision.seam.seams import FindSeamsOptions, find_seams
from grindvision.vision.seam.weld import trace_weld
from tests.groove_scenes import straight_groove
from tests.seam_scenes import corner, turned

FOCAL_PX, BASELINE_MM = 500.0, 55.0
EYE = np.array([30.0, -250.0, 380.0])
BASE = ([-90.0, -70.0, -8.0], [90.0, 70.0, 0.0])
UPRIGHT = ([-90.0, 0.0, -8.0], [90.0, 8.0, 60.0])
TABLE = ([-160.0, -160.0, -30.0], [160.0, 160.0, -8.0])


def seen(boxes, rng, window_px=0.0, noise_px=0.03, tube=None):
    """Points (N, 3) of axis-parallel boxes, and of a tube along x with y, z, radius, from ``EYE``: one a pixel,
    disparities averaged over a window."""
    forward = unit_vectors(-EYE)
    right = unit_vectors(np.cross(forward, [0.0, 0.0, 1.0]))
    down = np.cross(forward, right)
    column, row = np.meshgrid(np.arange(-170.0, 170.0), np.arange(-150.0, 150.0))
    rays = forward + (column[..., None] * right + row[..., None] * down) / FOCAL_PX
    depth = np.full(column.shape, np.inf)
    for low, high in boxes:
        ends = np.sort((np.array([low, high])[:, None, None] - EYE) / rays, axis=0)
        enters, leaves = ends[0].max(axis=-1), ends[1].min(axis=-1)
        depth = np.where((enters < leaves) & (enters < depth), enters, depth)
    if tube is not None:
        away, turns = EYE[1:] - tube[:2], (rays[..., 1:] ** 2).sum(axis=-1)
        half = rays[..., 1:] @ away
        root = half**2 - turns * (away @ away - tube[2] ** 2)
        enters = np.where(root > 0, (-half - np.sqrt(np.maximum(root, 0.0))) / turns, np.inf)
        depth = np.where((enters < depth) & (np.abs(EYE[0] + rays[..., 0] * enters) < 80), enters, depth)
    hit = np.isfinite(depth)
    disparity = FOCAL_PX * BASELINE_MM / np.where(hit, depth, 1e6)
    disparity = gaussian_filter(disparity, window_px) + noise_px * rng.standard_normal(depth.shape)
    return (EYE + rays * (FOCAL_PX * BASELINE_MM / disparity)[..., None])[hit]


def anywhere(points, rng):
    """The points in another frame, and the frame's rotation and origin."""
    rotation, origin = rotation_about(rng.normal(size=3), 2.0), rng.uniform(-900, 900, 3)
    return points @ rotation.T + origin, rotation, origin


def test_the_density_of_the_points_tells_where_the_camera_stood(rng):
    points, rotation, origin = anywhere(seen([BASE, UPRIGHT], rng), rng)
    place, again = camera_place(points), camera_place(points[::-1])
    assert place is not None and again is not None
    true, middle = rotation @ EYE + origin, points.mean(axis=0)
    assert vector_angle(place - middle, true - middle) < np.radians(6)
    assert np.linalg.norm(place - middle) == pytest.approx(np.linalg.norm(true - middle), rel=0.25)
    assert np.linalg.norm(again - place) < 1.0
    found = find_seams(points)
    assert not found.view_assumed and found.seams[0].kind == "t-joint"


@pytest.mark.parametrize("radius_mm", [15.0, 22.0])
def test_a_tube_on_a_plate_is_no_groove_from_below(rng, radius_mm):
    points = seen([BASE], rng, tube=(0.0, 3.0, radius_mm)) + [600.0, 100.0, 50.0]  # as in a robot's base frame
    (seam,) = find_seams(points).seams
    assert seam.kind == "t-joint" and (seam.root[:, 2] - 50.0).max() < 1.0


def test_a_groove_whose_side_nothing_tells_says_so(rng):
    points = straight_groove(rng)[0] * [1, -1, -1] + [600.0, 100.0, 500.0]  # even spacing, a robot's base frame
    assert find_seams(points).view_assumed
    assert not find_seams(points, FindSeamsOptions((600.0, 100.0, 500.0))).view_assumed
    with pytest.warns(GrindvisionWarning, match="a ridge for a groove"):
        trace_weld(points)


def test_evenly_spaced_points_tell_no_place(rng):
    assert camera_place(corner(rng, leg=50.0)) is None
    assert camera_place(turned(corner(rng, 70, leg=50.0), rng)[0]) is None


def test_a_step_whose_foot_is_hidden_is_said_to_be_so_and_comes_last(rng):
    found = find_seams(seen([BASE, TABLE], rng), FindSeamsOptions(EYE))
    assert all(seam.root[:, 1].mean() < 60 for seam in found.seams)
    far = [seam for seam in found.weaker if seam.root[:, 1].mean() > 60]
    assert far and all("where the camera does not see it" in seam.doubts[-1] for seam in far)
    assert found.seams[0].root[:, 1].mean() == pytest.approx(-70, abs=1) and not found.seams[0].doubts


def test_the_band_at_the_edge_of_a_nearer_body_is_no_sure_face():
    """A wall of 8 mm that is seen at 65 deg from straight on looks as wide as a window of pixels."""
    root, cell = np.zeros((5, 3)), 4.0
    faces = np.repeat([[[0.0, -1.0, 0.0]], [[0.0, 0.0, 1.0]]], 5, axis=1)
    low, high = (500.0 * np.array([0.0, -np.cos(flat), np.sin(flat)]) for flat in np.radians([45.0, 65.0]))
    short, tall = (np.stack([np.full(5, leg), np.full(5, 60.0)]) for leg in (8.0, 30.0))
    assert "looks 3.4 mm wide only, seen at 65 deg" in narrow_face(faces, short, root, cell, high)
    assert narrow_face(faces, tall, root, cell, high) == ""
    assert narrow_face(faces, short, root, cell, low) == ""
    assert narrow_face(faces, short, root, cell, None) == ""


@pytest.mark.parametrize("window_px", [0.0, 2.0, 3.0])
def test_the_blur_of_a_camera_does_not_move_a_corner(rng, window_px):
    """Windows of pixels round a corner of two plates: its root is where the plates meet."""
    points = seen([BASE, UPRIGHT], rng, window_px)
    points = points[(points[:, 1] > -55) & (np.abs(points[:, 0]) < 75) & (points[:, 2] < 45)]
    seam = find_seams(points, FindSeamsOptions(EYE)).seams[0]
    assert seam.kind in ("t-joint", "inside-corner")
    assert np.hypot(*seam.root[3:-3, 1:].T).mean() < 0.25
