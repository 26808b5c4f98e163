"""Measures of the book worked by hand: overlap, way points, heights; signs as their names say."""

from types import SimpleNamespace

import numpy as np
import pytest

from grindvision import cell
from grindvision.calibration.statistics import error_statistics
from grindvision.cell.height_target import HEIGHT_MM, height_sighting
from grindvision.vision.seam.gfh import AngleHistograms
from grindvision.vision.seam.seam_path import SeamPath
from grindvision_book.chapter_02 import height_errors, measured_heights
from grindvision_book.chapter_10 import overlap_percent
from grindvision_book.chapter_11.waypoints import waypoint_errors


def test_overlap_counts_what_was_found_or_true():
    """Four found, three true, two both: 2 of 5; the same the other way round."""
    found, truth = np.array([1, 1, 1, 1, 0, 0], bool), np.array([0, 0, 1, 1, 1, 0], bool)
    assert overlap_percent(found, truth) == pytest.approx(40.0)
    assert overlap_percent(truth, found) == pytest.approx(40.0)
    assert overlap_percent(~found & False, truth) == 0.0
    assert overlap_percent(truth, truth) == 100.0


def seam_along_x():
    """A root line along x whose groove opens along z: across is y (normal x tangent)."""
    root = np.column_stack([np.arange(0.0, 101.0), np.zeros((101, 2))])
    scene = SimpleNamespace(
        root_mm=root,
        root_errors_mm=np.tile([0.0, 0.0, 0.1], (101, 1)),
        tangents=np.tile([1.0, 0, 0], (101, 1)),
        normals=np.tile([0, 0, 1.0], (101, 1)),
    )
    return root, scene


def test_way_point_errors_are_the_path_minus_the_root():
    root, scene = seam_along_x()
    tilted = np.tile([0.0, np.sin(0.1), np.cos(0.1)], (4, 1))
    path = SeamPath(root[[10, 40, 70, 100]] + [0, 0.3, 0.4] + np.array([[0, 0, 0]] * 3 + [[2.0, 0, 0]]), tilted)
    errors = waypoint_errors(path, scene)
    np.testing.assert_allclose(errors.across_mm, 0.3)
    np.testing.assert_allclose(errors.up_mm, 0.4)
    np.testing.assert_allclose(errors.beyond_mm, [0, 0, 0, 2.0])
    np.testing.assert_allclose(errors.off_mm, [0.5, 0.5, 0.5, np.sqrt(4.25)])
    np.testing.assert_allclose(errors.axis_deg, np.degrees(0.1))
    np.testing.assert_allclose(waypoint_errors(path, scene, as_shown=True).up_mm, 0.3)


def test_height_errors_are_the_measured_minus_the_true_height():
    scanner = cell.StructuredLightScanner().with_errors(cell.ScannerErrors(scale=0.01))
    sightings = {"P1": height_sighting(scanner, (0.0, 0.0), every=8)}
    rows = measured_heights(scanner.with_serial(3), sightings, np.random.default_rng(3))
    assert abs(rows["error_mm"][0]) > 0.1
    assert rows["error_mm"][0] == pytest.approx(rows["height_mm"][0] - HEIGHT_MM)
    assert height_errors(scanner, sightings, [3])[0, 0] == rows["error_mm"][0]


def test_standard_deviations_are_those_of_the_whole_lot():
    """Divided by the number, not by one less, as for Figure 5: lengths 3 and 5 have mean 4 and deviation 1."""
    found = error_statistics([[3.0, 0, 0], [0, 3.0, 4.0]])
    assert (found.mean, found.max, found.std, found.count) == (4.0, 5.0, 1.0, 2)
    assert found.rms == pytest.approx(np.sqrt(17))
    assert "local std 1.00, global 2.00" in str(AngleHistograms(np.array([1.0, 3.0]), np.array([2.0, 6.0])))
