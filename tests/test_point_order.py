"""The order of a scan's points in its file changes no result."""

import warnings

import numpy as np
import pytest

from grindvision.errors import DegenerateError
from grindvision.geometry.point_order import in_order
from grindvision.vision.change.detection import detect
from tests.grinding_scene import arc_bead, pair, ring_bead


def test_the_same_points_in_any_order_are_one_array(rng):
    cloud = rng.normal(size=(3000, 3)) * [80.0, 50.0, 3.0]
    copies = np.concatenate([cloud, cloud[:500], np.round(cloud[:800])])
    wanted = in_order(copies)
    np.testing.assert_array_equal(in_order(rng.permutation(copies)), wanted)
    np.testing.assert_array_equal(np.sort(wanted, axis=0), np.sort(copies, axis=0))


def test_points_of_one_code_are_told_apart_by_their_coordinates(rng):
    near = np.array([[0.0, 0, 0], [1e6, 0, 0], [5.0, 1e-3, 0], [5.0, 0, 1e-3], [5.0, 0, 0]])
    np.testing.assert_array_equal(in_order(near[::-1]), in_order(near))
    assert in_order(near[:0]).shape == (0, 3)


def test_neighbours_in_space_stand_near_one_another(rng):
    x, y = rng.uniform(0, 100, (2, 10_000))
    steps = np.linalg.norm(np.diff(in_order(np.column_stack([x, y, 0 * x])), axis=0), axis=1)
    assert np.median(steps) < 1.5  # a grid of as many points has steps of 1 mm


def of_a_workpiece(kind, seed=3):
    def scans():
        pytest.importorskip("open3d", reason="needs the extra sim")
        pytest.importorskip("manifold3d", reason="needs the extra sim")
        from grindvision.cell.workpiece_scene import workpiece_scene

        scene = workpiece_scene(kind, np.random.default_rng(seed), "bead")
        return scene.sample.points, scene.test.points

    return scans


def of_the_plate(bead, seed):
    def scans():
        one = pair(seed=seed, n_points=22_000, beads=[bead])
        return one.sample, one.test

    return scans


PARTS = {"plate": of_the_plate(arc_bead(), 5), "tray": of_a_workpiece("tray")}
MORE = {"ring": of_the_plate(ring_bead(), 6)}
MORE |= {kind: of_a_workpiece(kind) for kind in ("bracket", "blade", "casting")}
MORE |= {kind: of_a_workpiece(kind, 4) for kind in ("flange", "gear")}


@pytest.mark.parametrize(
    "name",
    [*PARTS, *(pytest.param(name, marks=pytest.mark.full) for name in MORE)],
)
def test_any_order_of_the_points_of_both_scans_gives_the_same_path(name, rng):
    sample, test = (PARTS | MORE)[name]()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        plain = detect(sample, test)
        shuffled = detect(rng.permutation(sample), rng.permutation(test))
    assert len(plain.path_points) > 0
    np.testing.assert_allclose(shuffled.path_points, plain.path_points, atol=1e-6, rtol=0)
    np.testing.assert_allclose(shuffled.T_sample_test, plain.T_sample_test, atol=1e-6, rtol=0)


@pytest.mark.full
def test_any_order_of_the_points_of_both_scans_gives_the_same_refusal(rng):
    """Two scans of a flange that leave its pose open."""
    sample, test = of_a_workpiece("flange")()
    said = []
    for scans in ((sample, test), (rng.permutation(sample), rng.permutation(test))):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with pytest.raises(DegenerateError) as refused:
                detect(*scans)
        said.append(str(refused.value))
    assert said[0] == said[1]
