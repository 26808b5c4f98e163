"""Smoothed depth pictures and merged views: what is said of them, and which pieces they leave out."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from grindvision.cell.rays import target_of
from grindvision.cell.solids import box
from grindvision.cell.views import view_from
from grindvision.geometry import inverse, move_points
from grindvision.vision.change.change_detection import find_change
from grindvision.vision.change.mixed_pixels import diagnose_mixed_pixels
from grindvision.vision.change.smoothed_edges import find_smoothed_edges, smoothing_doubts
from grindvision.vision.registration.icp import FineRegistration
from grindvision.vision.surface.range_picture import is_one_picture
from grindvision.vision.surface.scan import prepare_pair
from grindvision.vision.surface.surfels import build_surfels

PART = (
    box("plate", [-40, -30, 0], [40, 30, 8])
    + box("block", [-25, -15, 5], [5, 10, 30])
    + box("wall", [25, -28, 5], [31, 28, 22])
)
VIEWS = [view_from(np.zeros(3), 400.0, 0.5, azimuth, 0.0) for azimuth in (0.3, 0.9)]


def picture(shape, T_part_scanner, rng, smoothing_px=0.0, step_mm=0.5, noise_mm=0.02):
    """Points (N, 3) of a depth picture in the scanner's frame, its depths smoothed over so many pixels."""
    across = np.arange(-55.0, 55.0, step_mm) / 400
    u, v = np.meshgrid(across, across, indexing="ij")
    rays = np.stack([u, v, np.ones_like(u)], axis=-1)
    target = target_of(shape.solid())
    directions = rays.reshape(-1, 3) @ T_part_scanner[:3, :3].T
    hits = target.cast(T_part_scanner[:3, 3], directions)
    slant = np.abs((directions[hits.ray] * target.normals[hits.triangle]).sum(axis=1))
    seen = hits.ray[slant > 0.2]
    depth = np.full(u.size, np.nan)
    depth[seen] = hits.distance[slant > 0.2]
    depth = depth.reshape(u.shape) + rng.normal(0, noise_mm, u.shape)
    shown = np.isfinite(depth)
    if smoothing_px:
        weights = np.maximum(gaussian_filter(shown.astype(float), smoothing_px), 1e-9)
        depth = gaussian_filter(np.where(shown, depth, 0.0), smoothing_px) / weights
    return (rays * depth[..., None])[shown]


def compared(shapes, smoothing_px, also_seen_from=None, **camera):
    """Both scans of a pair at its true pose, that pose, and their difference; the test scan holds one view more."""
    rng = np.random.default_rng(3)
    sample, test = (
        picture(shape, view, rng, px, **camera) for shape, view, px in zip(shapes, VIEWS, smoothing_px, strict=True)
    )
    if also_seen_from is not None:
        more = picture(shapes[1], also_seen_from, rng)
        test = np.concatenate([test, move_points(inverse(VIEWS[1]) @ also_seen_from, more)])
    source, target = prepare_pair(test, sample)
    pose = inverse(VIEWS[0]) @ VIEWS[1]
    nothing = np.zeros((6, 6))
    known = FineRegistration(pose, 0.02, 1.0, 5, True, np.zeros(3), np.eye(6), nothing, np.zeros(1))
    return source, target, known, find_change(source, target, known)


@pytest.mark.parametrize("smoothing_px", [(1.5, 1.5), (0.0, 1.5)])
def test_pieces_along_the_rims_of_smoothed_pictures_are_left_out(smoothing_px):
    source, target, known, difference = compared((PART, PART), smoothing_px)
    assert difference.clusters
    smoothed = find_smoothed_edges(source, target, known, difference)
    assert smoothed is not None
    assert "a depth picture that was smoothed" in str(smoothed)
    doubted = smoothing_doubts(difference, smoothed)
    assert 0 in doubted  # the largest, which would be ground first
    assert len(doubted) > len(difference.clusters) / 2


@pytest.mark.parametrize("smoothing_px", [(1.0, 1.0), (2.5, 2.5), (0.0, 1.0)])
@pytest.mark.parametrize("camera", [{"step_mm": 1.0, "noise_mm": 0.05}, {"step_mm": 0.8}, {"step_mm": 0.35}])
def test_other_cameras_are_told_as_well(smoothing_px, camera):
    assert find_smoothed_edges(*compared((PART, PART), smoothing_px, **camera)) is not None
    assert find_smoothed_edges(*compared((PART, PART), (0.0, 0.0), **camera)) is None


def test_a_bead_amid_a_face_of_smoothed_pictures_is_kept():
    bead = box("bead", [10, -15, 7], [18, 15, 9.5])
    source, target, known, difference = compared((PART, PART + bead), (1.5, 1.5))
    doubted = smoothing_doubts(difference, find_smoothed_edges(source, target, known, difference))
    middle = move_points(inverse(VIEWS[1]), [14.0, 0.0, 9.5])
    on_bead = [np.linalg.norm(one.points - middle, axis=1).min() < 2 for one in difference.clusters]
    assert [rank for rank, there in enumerate(on_bead) if there and rank not in doubted]


@pytest.mark.parametrize("bead", [None, box("bead", [-25, -19, 7], [5, -14, 11])])
def test_raw_pictures_and_a_bead_along_an_edge_are_not_taken_for_smoothed(bead):
    source, target, known, difference = compared((PART, PART if bead is None else PART + bead), (0.0, 0.0))
    assert find_smoothed_edges(source, target, known, difference) is None
    assert diagnose_mixed_pixels(source, target, known, difference) == ()


def test_points_of_one_picture_stand_evenly_in_angle_and_those_of_two_do_not():
    rng = np.random.default_rng(4)
    views = [view_from(np.zeros(3), 400.0, 0.6, azimuth, 0.0) for azimuth in (0.0, 2.2)]
    first, second = (picture(PART, view, rng) for view in views)
    smoothed = picture(PART, views[0], rng, 1.5)
    both = np.concatenate([first, move_points(inverse(views[0]) @ views[1], second)])
    one, two, slopes = (build_surfels(points, 1.0) for points in (first, both, smoothed))
    assert is_one_picture(one, np.zeros(3))
    assert is_one_picture(slopes, np.zeros(3))
    assert not is_one_picture(two, np.zeros(3))


def test_walls_from_another_view_of_a_merged_scan_are_not_called_smoothed_alone():
    aside = view_from(np.zeros(3), 400.0, 0.7, 3.5, 0.0)
    (said,) = diagnose_mixed_pixels(*compared((PART, PART), (0.0, 0.0), aside))
    assert "several views in one cloud" in said
    assert "smoothed" not in said
