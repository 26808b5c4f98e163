"""What is no bead is not called one: concave corners, edges of a model, faces that a scanner's errors move."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

from grindvision.geometry import move_points
from grindvision.vision.change.detection import DetectOptions, detect
from grindvision.vision.change.pieces import Standing, find_pieces
from grindvision.vision.surface.model_surface import model_surface, scan_seen_from
from grindvision.vision.surface.scan import Resolution, prepare_scan
from grindvision.vision.surface.signed_distance import signed_distances
from tests.box_scenes import STEPPED, looking_at, scan_of

MIDDLE = (0, 0, 12)


def found_in(sample, test):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return detect(sample, test, DetectOptions(viewpoint_sample_mm=np.zeros(3), viewpoint_test_mm=np.zeros(3)))


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.full), pytest.param(3, marks=pytest.mark.full)])
def test_concave_corners_of_a_good_part_that_is_scanned_finely_show_nothing(seed):
    rng = np.random.default_rng(seed)
    sample, test = (
        scan_of(STEPPED, looking_at(MIDDLE, 0.6, azimuth), 0.3, rng, noise_mm=0.008) for azimuth in (0.5, 1.0)
    )
    found = found_in(sample, test)
    assert not found.difference.clusters and not found.difference.specks
    assert found.coverage.height_mm < 0.06  # and yet low beads would be told elsewhere


def test_a_plane_through_a_corner_moves_no_distance_from_the_floor_beside_it():
    rng = np.random.default_rng(4)
    view = looking_at(MIDDLE, 0.6, -0.5)
    surface = prepare_scan(scan_of(STEPPED, view, 0.3, rng, noise_mm=0.008), Resolution(0.3, 0.8, 3.0), np.zeros(3))
    y = np.linspace(-19, -13, 400)  # on the top of the base, 0.3 to 1.6 mm before the foot of a step
    floor = np.column_stack([5 + rng.uniform(0.3, 1.6, 400), y, np.full(400, 10.0)])
    asked = move_points(np.linalg.inv(view), floor)
    plain, trusted = (signed_distances(surface.surfels, asked, 1.6, trusted=kind)[0] for kind in (False, True))
    assert np.nanquantile(np.abs(trusted), 0.9) < 0.5 * np.nanquantile(np.abs(plain), 0.9)
    assert np.nanquantile(np.abs(trusted), 0.9) < 0.05


def block():
    """Vertices and triangles of a box 60 x 40 x 3 mm."""
    corners = np.array([[x, y, z] for x in (0, 60.0) for y in (0, 40.0) for z in (0, 3.0)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return corners, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])


def test_surfels_of_a_model_lie_in_its_faces_beside_its_edges_too():
    surface = model_surface(*block())
    seen = scan_seen_from(surface, Resolution(0.5, 1.3, 4.0), np.array([-150.0, -120.0, 300.0]))
    surfels = seen.surfels
    faces = np.abs(np.stack([surfels.points, surfels.points - [60, 40, 3]])).min(axis=0)
    assert faces.min(axis=1).max() < 1e-6
    assert np.abs(surfels.normals).max(axis=1).min() > 1 - 1e-9
    # what a scan of such a cell is worth is known all the same
    at_edge = (np.abs(surfels.points[:, 0]) < 1) & (surfels.points[:, 2] > 1)
    assert np.median(surfels.roughness_mm[at_edge]) > 5 * np.median(surfels.roughness_mm)


def test_one_face_alone_of_two_about_a_models_edge_does_not_stand_out():
    """A scan of the top, without the walls that its scanner hardly saw."""
    surface = model_surface(*block())
    resolution = Resolution(0.5, 1.3, 4.0)
    good = scan_seen_from(surface, resolution, np.array([-150.0, -120.0, 300.0]))
    rng = np.random.default_rng(0)
    top = np.column_stack([rng.uniform(0, 60, 9000), rng.uniform(0, 40, 9000), rng.normal(3, 0.02, 9000)])
    signed, _, _ = signed_distances(good.surfels, top, 2.6, trusted=True)
    assert np.nanmax(signed) < 0.15
    chamfered = prepare_scan(good.points, resolution, np.array([-150.0, -120.0, 300.0])).surfels
    assert np.nanmax(signed_distances(chamfered, top, 2.6)[0]) > 0.3  # planes that cut the corner


@pytest.fixture
def plate():
    """A flat scan 40 x 30 mm as test scan and as sample, and what stands out of it: nothing yet."""
    rng = np.random.default_rng(5)
    points = np.column_stack([rng.uniform(0, 40, 20_000), rng.uniform(0, 30, 20_000), rng.normal(0, 0.01, 20_000)])
    scan = prepare_scan(points, Resolution(0.25, 1.0, 3.0), np.array([20.0, 15.0, 300.0]))
    count = len(scan.surfels)
    none, level = np.zeros(count, dtype=bool), np.full(count, 0.05)
    return scan, Standing(
        none.nonzero()[0], none, none, np.zeros(count), scan.surfels.normals, level, np.hypot(level, 0.08)
    )


def pieces_where(plate, height_mm, around_mm, shown=None):
    """How many pieces there are where a strip 4 mm wide stands out by one height and the rest by another; only what is
    ``shown`` was compared."""
    scan, standing = plate
    x = scan.surfels.points[:, 0]
    inside = np.abs(x - 20) < 2
    points = scan.points + np.column_stack(
        [np.zeros((len(scan.points), 2)), np.where(np.abs(scan.points[:, 0] - 20) < 2, height_mm, around_mm)]
    )
    signed = np.where(inside, height_mm, around_mm)
    if shown is not None:
        signed = np.where(shown(x), signed, np.nan)
    high = replace(scan, points=points)
    standing = standing._replace(chosen=np.flatnonzero(inside), signed=signed)
    return len(find_pieces(high, scan.surfels, standing, 10)[0])


def test_a_face_that_is_off_as_a_whole_is_no_bead_and_a_bead_on_it_is(plate):
    assert pieces_where(plate, 0.15, 0.0) == 1
    assert pieces_where(plate, 0.15, 0.13) == 0  # the surface around it is as high
    assert pieces_where(plate, 0.30, 0.13) == 1
    # without surroundings, what the scanners' errors may do to a face counts: twice 0.094 mm
    assert pieces_where(plate, 0.15, 0.0, shown=lambda x: np.abs(x - 20) < 2) == 0
    assert pieces_where(plate, 0.25, 0.0, shown=lambda x: np.abs(x - 20) < 2) == 1


def test_a_bead_that_a_gap_cuts_into_specks_is_told_and_specks_apart_are_none(plate):
    """Two ends of a bead 1 mm wide and high; of what lies between, nothing was compared, or the bare surface."""
    good, _ = plate
    across, ahead = (np.abs(good.points[:, k] - middle) for k, middle in ((1, 15), (0, 20)))
    on = (across < 0.5) & (ahead > 1.7) & (ahead < 4.7)
    bead = prepare_scan(good.points + np.outer(on, [0, 0, 1.0]), Resolution(0.25, 1.0, 3.0), good.viewpoint_mm)
    x, y, z = bead.surfels.points.T
    ends, gap = z > 0.9, (np.abs(y - 15) < 1) & (np.abs(x - 20) <= 1.7)
    few, usual = np.zeros(len(z), dtype=bool), np.full(len(z), 0.05)
    up = np.tile([0.0, 0, 1], (len(z), 1))
    assert 4 <= (ends & (x < 20)).sum() < 8
    for between, told in ((np.nan, 2), (1.0, 2), (0.0, 0)):
        signed = np.where(gap, between, z)
        standing = Standing(np.flatnonzero(ends), few, few, signed, up, usual, usual)
        found, specks = find_pieces(bead, good.surfels, standing, 8)
        assert (len(found), len(specks)) == (told, 2 - told)


@pytest.mark.parametrize("wide", [1.4, pytest.param(0.5, marks=pytest.mark.full)])
def test_flash_in_line_with_a_face_is_told_from_the_width_that_is_stated(wide):
    views = [looking_at(MIDDLE, 0.7, azimuth) for azimuth in (-1.9, -1.4)]
    rng = np.random.default_rng(3)
    good = scan_of(STEPPED, views[0], 0.8, rng)
    stated = found_in(good, scan_of(STEPPED, views[1], 0.8, rng)).coverage.sideways_mm
    flash = ((-25, -30 - wide * stated, 9.2), (25, -29, 10))
    answer = found_in(good, scan_of((*STEPPED, flash), views[1], 0.8, rng))
    assert answer.difference.clusters or wide < 1
    for piece in answer.difference.clusters:  # narrower flash may be told, and nothing else
        places = move_points(views[1], piece.points)
        assert (places > [-26, -31 - wide * stated, 8.7]).all()
        assert (places < [26, -28.5, 10.5]).all()
    assert f"flash in line with a face is told from {answer.coverage.sideways_mm:.2g} mm" in str(answer)
