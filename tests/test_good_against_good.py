"""A good part against a good part has no piece, whatever the part: corners, steps, edges and curved faces."""

import warnings

import numpy as np
import pytest

from grindvision.errors import DegenerateError
from grindvision.vision.change.detection import DetectOptions, detect

pytest.importorskip("open3d", reason="needs the extra sim")
pytest.importorskip("manifold3d", reason="needs the extra sim")

from grindvision.cell.solids import box
from grindvision.cell.workpiece_scene import workpiece_scene
from grindvision.cell.workpieces import WORKPIECES, Workpiece


def stepped_block(rng):
    """Steps of several heights that meet in concave corners."""
    a, b = rng.uniform(45, 60), rng.uniform(35, 45)
    body = box("body", [-a, -b, 0], [a, b, 10])
    for left, low, high in ((-0.6, -0.9, 14), (-0.2, -0.5, 20), (0.3, -0.1, 27)):
        body = body + box("body", [left * a, low * b, 9], [a - 0.5, 0.9 * b, high + rng.uniform(-1, 1)])
    return Workpiece("stepped block", body, ((-0.9 * a, -0.8 * b), (-0.7 * a, 0.5 * b)))


def grooved_plate(rng):
    """Ribs and grooves of several widths, and a window."""
    a, b = rng.uniform(50, 65), rng.uniform(35, 45)
    body = box("body", [-a, -b, 0], [a, b, 12])
    for at, width, deep in ((-0.7, 6, 3), (-0.35, 10, 5), (0.1, 14, 4)):
        body = body - box("body", [at * a, -b - 1, 12 - deep], [at * a + width, rng.uniform(0.2, 0.6) * b, 20])
    body = body + box("body", [0.5 * a, -0.6 * b, 11], [0.58 * a, 0.7 * b, rng.uniform(18, 24)])
    body = body - box("body", [0.68 * a, -0.2 * b, -1], [0.9 * a, 0.5 * b, 40])
    return Workpiece("grooved plate", body, ((-0.9 * a, -0.8 * b), (-0.9 * a, 0.8 * b)))


OTHERS = {"stepped block": stepped_block, "grooved plate": grooved_plate}
KINDS = (*WORKPIECES, *OTHERS)


def pieces_of(kind, pair):
    """Pieces and specks that two scans of a good part are said to differ by; None where they are refused, or where the
    pose is wrong: that is the registration's affair."""
    scene = workpiece_scene(kind, np.random.default_rng([77, pair]), "none")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            found = detect(scene.sample.points, scene.test.points, DetectOptions(seed=pair))
        except DegenerateError:
            return None
    if scene.pose_error_mm(found.T_sample_test) > 1.0:
        return None
    return len(found.difference.clusters), len(found.difference.specks)


@pytest.mark.parametrize("kind", ["stepped block", "casting"])
def test_good_against_good_has_no_piece(kind, monkeypatch):
    monkeypatch.setitem(WORKPIECES, kind, (WORKPIECES | OTHERS)[kind])
    assert pieces_of(kind, 7) == (0, 0)


@pytest.mark.full
def test_good_against_good_over_a_hundred_pairs_of_ten_parts(monkeypatch):
    for kind, make in OTHERS.items():
        monkeypatch.setitem(WORKPIECES, kind, make)
    found = {pair: pieces_of(KINDS[pair % len(KINDS)], pair) for pair in range(100)}
    answered = {pair: counts for pair, counts in found.items() if counts is not None}
    assert len(answered) > 60
    assert {pair: KINDS[pair % len(KINDS)] for pair, counts in answered.items() if counts[0]} == {}
    assert sum(counts[1] > 0 for counts in answered.values()) <= len(answered) / 10
