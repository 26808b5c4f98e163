"""Where the engineer says that there is something to be ground: pieces that may be bending, and a skin off a face."""

import warnings

import numpy as np
import pytest
from scipy.spatial import cKDTree

from grindvision.errors import DegenerateError, GrindvisionWarning, InputError
from grindvision.geometry import inverse, move_points
from grindvision.grinding import GrindOptions, grind
from grindvision.grinding_again import grind_again
from grindvision.grinding_files import job_of
from grindvision.grinding_region import in_region
from grindvision.motion.grinding_options import GrindingOptions
from grindvision.motion.grinding_path import CUT, tool_path
from grindvision.vision.change.comparison import compare
from grindvision.vision.registration.scan_registration import StageClock
from tests.grinding_scene import Bead, arc_bead
from tests.test_deformation import T_TEST_PART, pair

PASSES = GrindingOptions(depth_mm=0.5, pattern="raster", width_mm=8.0)
SKIN_MM = 0.8


def compared(scans):
    """Their comparison, which takes most of the time, for several jobs."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GrindvisionWarning)
        return compare(scans[0], scans[1], GrindOptions(), StageClock())


def ground_with(monkeypatch, scans, known, **options):
    sample, test = scans
    monkeypatch.setattr("grindvision.grinding.compare", lambda *given: known)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        found = grind(sample, test, GrindOptions(PASSES, **options))
    return found, " ".join(str(one.message) for one in told if issubclass(one.category, GrindvisionWarning))


def part_of(points, x, y):
    """Those of the points of the test scan that lie between two places of the plate each way."""
    on_part = move_points(inverse(T_TEST_PART), points)
    return points[(on_part[:, 0] > x[0]) & (on_part[:, 0] < x[1]) & (on_part[:, 1] > y[0]) & (on_part[:, 1] < y[1])]


@pytest.fixture(scope="module")
def twisted():
    scans = pair("twist")
    return scans, compared(scans)


def test_a_skin_comes_off_a_face_of_a_bent_plate_and_nothing_beside_it(twisted, monkeypatch):
    """No stock stands there: the scans alone give nothing to grind, and say how much was given to deformation."""
    sample, test = twisted[0]
    region = part_of(test, (-30.0, 20.0), (-15.0, 40.0))
    with pytest.raises(DegenerateError, match=r"nothing stands out.*given to deformation") as refusal:
        ground_with(monkeypatch, *twisted, region_mm=region)
    assert "\n" not in str(refusal.value)
    found, told = ground_with(monkeypatch, *twisted, region_mm=region, skin_mm=SKIN_MM)
    assert "given to deformation" in told
    assert str(found).startswith(f"a layer of {SKIN_MM:g} mm as asked for, ")
    assert {piece.asked_mm for piece in found.stock.pieces} == {SKIN_MM}
    assert found.stock.volume_mm3 == pytest.approx(SKIN_MM * found.stock.pieces[0].area_mm2, rel=0.1)
    assert 0.75 * 50 * 55 < found.stock.pieces[0].area_mm2 < 1.05 * 50 * 55
    path = tool_path(found.plans[0])
    cut = path.points[path.kinds == CUT]
    assert cKDTree(region).query(cut)[0].max() < 4.0  # lines run on over two nodes, lifted; none off the part
    normals = path.normals[path.kinds == CUT]
    at = cKDTree(test).query(cut)[1]
    depth = ((test[at] - cut) * normals).sum(axis=1)
    assert 0.6 * SKIN_MM < np.quantile(depth, 0.9) < 1.1 * SKIN_MM
    outside = test[~in_region(test, region, 1.5)]
    at = cKDTree(outside).query(cut, distance_upper_bound=1.0)[1]
    near = at < len(outside)
    over = ((outside[at[near]] - cut[near]) * normals[near]).sum(axis=1)
    assert over.max(initial=-1.0) < 0.15

    job = job_of(found.T_sample_test, found.stock.pieces, found.plans, PASSES, {"skin_mm": SKIN_MM})
    with pytest.raises(InputError, match=r"takes a skin of 0\.8 mm off"):
        grind_again(job, sample, test)


@pytest.mark.full
def test_a_piece_that_may_be_bending_is_ground_where_the_engineer_says_that_it_is_stock(monkeypatch):
    """A bead along the plate's rim, which the scans do not tell from a bent rim."""
    line = np.column_stack([np.linspace(-60.0, 20.0, 400), np.full(400, -67.5)])
    scans = pair("twist", beads=(Bead(line, 5.0, 2.5), arc_bead(height_mm=2.5, width_mm=5.0)))
    known = compared(scans)
    alone, _ = ground_with(monkeypatch, scans, known)
    doubted = [number for number, why in alone.refusals.items() if "bent" in why or "bending" in why]
    assert doubted and "--region" in alone.refusals[doubted[0]]
    region = part_of(scans[1], (-70.0, 30.0), (-70.0, -60.0))
    found, _ = ground_with(monkeypatch, scans, known, region_mm=region)
    ground = [number for number, plan in enumerate(found.plans, start=1) if plan is not None]
    assert ground == doubted and "outside of the region" in " ".join(found.refusals.values())


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"skin_mm": 1.0}, "say where"),
        ({"region_mm": np.zeros((2, 3)), "skin_mm": -1.0}, "thickness above zero"),
        ({"region_mm": np.full((2, 3), 1e5)}, "in TEST's frame"),
        ({"region_mm": np.full((2, 3), np.nan)}, "a region of shape"),
    ],
)
def test_a_region_that_is_none_is_named_in_one_line(twisted, monkeypatch, options, said):
    with pytest.raises(InputError, match=said) as refusal:
        ground_with(monkeypatch, *twisted, **options)
    assert "\n" not in str(refusal.value)
