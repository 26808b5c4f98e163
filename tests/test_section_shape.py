"""The cross-section of a groove from all its points at once: edges, feet and floor come back, upright walls or not."""

import contextlib
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial import cKDTree

from benchmarks.seams import tubes
from grindvision.cell import joint_scene
from grindvision.errors import NoGrooveError
from grindvision.vision.seam.groove_lines import DetectedGroove
from grindvision.vision.seam.seams import FindSeamsOptions, find_seams
from grindvision.vision.seam.section_shape import section_shape, with_shape
from tests.seam_scenes import turned


def section(rng, feet, width=6.0, depth=5.0, noise=0.15, wall_points=True):
    """Points of a groove along x whose walls end at ``feet`` (two places from the left edge), seen from +z."""
    nodes = np.array([[-10, 0], [-width / 2, 0], [feet[0] - width / 2, -depth], [feet[1] - width / 2, -depth]])
    nodes = np.concatenate([nodes, [[width / 2, 0], [10, 0]]])
    parts = []
    for a, b in pairwise(nodes):
        length = np.linalg.norm(b - a)
        upright = abs(b[0] - a[0]) < 0.1 * length
        count = int(length / 0.8) if wall_points or not upright else 0
        t = rng.random((count * 80, 1))
        parts.append(a + t * (b - a))
    across = np.concatenate(parts)
    along = rng.uniform(-40, 40, len(across))
    return np.column_stack([along, across]) + noise * rng.standard_normal((len(across), 3)) * [0, 0.3, 1]


def rough_groove(width=6.4, depth=4.6, root=0.2):
    """A groove as single sections may give it: a little off in all its lines."""
    x = np.linspace(-40, 40, 81)
    line = np.column_stack([x, 0 * x, 0 * x])
    return DetectedGroove(
        np.arange(10), line + [0, root, -depth], line - [0, width / 2, 0], line + [0, width / 2, 0],
        np.tile([0.0, 0.0, 1.0], (81, 1)), np.full(81, width), np.full(81, depth), np.full(81, 0.1), 1.0, 1.0,
        floor_fraction=0.2,
    )  # fmt: skip


@pytest.mark.parametrize("wall_points", [True, False])
@pytest.mark.parametrize(
    ("feet", "floor"), [((3.0, 3.0), 0.0), ((6.0, 6.0), 0.0), ((0.0, 0.0), 0.0), ((4.4, 4.4), 0.0), ((1.5, 4.5), 0.5)]
)
def test_edges_feet_and_floor_come_back(rng, feet, floor, wall_points):
    shape = section_shape(rough_groove(), section(rng, feet, wall_points=wall_points), 0.8)
    assert shape.floor_fraction == pytest.approx(floor, abs=0.08)
    np.testing.assert_allclose(shape.edges_mm, [-3, 3], atol=0.2)
    np.testing.assert_allclose(shape.feet_mm, np.subtract(feet, 3), atol=0.35)
    assert shape.depth_mm == pytest.approx(5, abs=0.25)
    assert (shape.floor_log_ratio > 5) == (floor > 0)


@pytest.mark.parametrize("seed", [9301, 9302])
def test_a_hollow_beside_a_round_body_has_no_shape_beyond_its_points(seed):
    """Two tubes side by side, seen askew: the chain of lines that fitted best began at an edge 10 m below."""
    with contextlib.suppress(NoGrooveError):
        for seam in find_seams(tubes((20.0, 20.0), 1, False)(seed).points).seams:
            assert np.ptp(seam.root, axis=0).max() < 200


def test_a_groove_takes_on_the_shape_in_any_frame_and_order(rng):
    points, groove = section(rng, (6.0, 6.0)), rough_groove()
    here = with_shape(groove, section_shape(groove, points, 0.8))
    np.testing.assert_allclose(np.median(here.root[:, 1:], axis=0), [3, -5], atol=0.3)
    assert np.median(here.width_mm) == pytest.approx(6, abs=0.3) and here.floor_fraction == 0
    moved, rotation, shift = turned(points, rng)
    lines = {name: getattr(groove, name) @ rotation.T + shift for name in ("root", "left", "right")}
    there = DetectedGroove(**{**vars(groove), **lines, "normals": groove.normals @ rotation.T})
    there = with_shape(there, section_shape(there, moved[rng.permutation(len(moved))], 0.8))
    np.testing.assert_allclose((there.root - shift) @ rotation, here.root, atol=0.05)


@pytest.mark.parametrize("seed", [1, 3, 4])
@pytest.mark.parametrize("every", [1, 2])
def test_a_bevel_groove_of_seven_pixels_is_one(seed, every):
    """At every second pixel of a D415 a groove of 6.4 mm is seven points wide: it was a V-groove 1.9 mm beside."""
    scene = joint_scene("bevel-groove", np.random.default_rng(seed), every=every)
    seam = find_seams(scene.points).seams[0]
    assert seam.kind == "bevel-groove"
    off = cKDTree(scene.root_mm + scene.root_errors_mm).query(seam.root)[0]
    assert off.mean() < 0.5 and off.max() < 1.2


def test_a_bevel_does_not_depend_on_where_it_is_seen_from():
    scene = joint_scene("bevel-groove", np.random.default_rng(7), every=2)
    here = find_seams(scene.points).seams[0]
    there = find_seams(1.0 * scene.points + [500.0, -300.0, 200.0], FindSeamsOptions([500.0, -300.0, 200.0])).seams[0]
    assert there.kind == here.kind == "bevel-groove"
    assert cKDTree(here.root).query(there.root - [500.0, -300.0, 200.0])[0].max() < 0.3
