"""Workpieces other than the book's plate, and their scans with truth."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from grindvision.errors import InputError

pytest.importorskip("open3d", reason="needs the extra sim")
pytest.importorskip("manifold3d", reason="needs the extra sim")

from grindvision.cell.workpiece_scene import workpiece_scene
from grindvision.cell.workpieces import WORKPIECES, workpiece
from grindvision.geometry import move_points


@pytest.mark.parametrize("kind", WORKPIECES)
def test_each_is_a_closed_solid_whose_two_scans_agree_by_the_true_pose(kind):
    scene = workpiece_scene(kind, np.random.default_rng(3), "bead", every=6)
    assert scene.good.watertight
    assert scene.good.volume_mm3 > 1000
    away, _ = cKDTree(scene.sample.true_points).query(move_points(scene.T_sample_test, scene.test.true_points))
    assert np.quantile(away, 0.5) < 1.2  # the points stand 1.2 mm apart
    assert scene.pose_error_mm(scene.T_sample_test) == 0
    off = np.eye(4)
    off[0, 3] = 2.0
    assert scene.pose_error_mm(off @ scene.T_sample_test) == pytest.approx(2.0)


@pytest.mark.parametrize(("change", "sign"), [("bead", 1), ("pit", -1)])
def test_a_bead_stands_out_of_the_good_part_and_a_pit_goes_into_it(change, sign):
    scene = workpiece_scene("tray", np.random.default_rng(1), change)
    foot = move_points(scene.T_sample_test, scene.ridge_mm)
    up = scene.ridge_normals @ scene.T_sample_test[:3, :3].T
    near = cKDTree(scene.sample.true_points).query(foot)[1]
    heights = ((foot - scene.sample.true_points[near]) * up).sum(axis=1)
    assert (sign * heights > 0.7).all()
    measured = cKDTree(scene.test.true_points).query(scene.ridge_mm)[0]
    assert np.median(measured) < 1.0
    assert scene.comparable > 0.9


def test_a_part_as_good_has_no_ridge_and_the_same_seed_makes_the_same_scene():
    first, second = (workpiece_scene("sheet", np.random.default_rng(5), "none", every=8) for _ in range(2))
    assert len(first.ridge_mm) == 0
    assert np.isnan(first.comparable)
    np.testing.assert_array_equal(first.test.points, second.test.points)


def test_a_marked_part_is_determined_only_where_both_scans_show_its_mark():
    seen = [workpiece_scene("flange", np.random.default_rng(k), "none").determined for k in range(2)]
    assert all(seen)
    coarse = workpiece_scene("flange", np.random.default_rng(0), "none", every=40)
    assert not coarse.determined


def test_unknown_words_and_angles_are_refused():
    rng = np.random.default_rng(0)
    with pytest.raises(InputError, match="no workpiece 'cup'"):
        workpiece("cup", rng)
    with pytest.raises(InputError, match="no change 'dent'"):
        workpiece_scene("tray", rng, "dent")
    with pytest.raises(InputError, match="apart_deg"):
        workpiece_scene("tray", rng, apart_deg=(50, 40))


def test_a_table_that_was_cut_off_is_read_back_as_it_was_written(tmp_path):
    from benchmarks.workpieces import append, rows_of

    solved = {"pair": 0, "kind": "tray", "change": "pit", "determined": True, "outcome": "solved", "pose_mm": 0.25,
              "confidence": 1.0, "seconds": 1.5, "said": "nothing, or\nthe like"}  # fmt: skip
    refused = {"pair": 7, "kind": "sheet", "change": "bead", "determined": False, "outcome": "refused", "seconds": 2.5,
               "said": "ambiguous"}  # fmt: skip
    path = tmp_path / "rows.csv"
    assert rows_of(path) == []
    for row in (solved, refused):
        append(path, row)
    assert rows_of(path) == [solved, refused]


def test_a_peer_is_asked_once_for_each_pair(tmp_path, monkeypatch, capsys):
    from benchmarks import workpieces

    scene, asked = workpiece_scene("sheet", np.random.default_rng(5), "none", every=8), []

    def right(scene):
        asked.append(scene)
        return scene.T_sample_test

    monkeypatch.setitem(workpieces.PEERS, "open3d", right)
    for pairs in (1, 2, 2):
        workpieces.race_peers([(pair, scene) for pair in range(pairs)], ["open3d"], tmp_path / "rows.csv")
    assert len(asked) == 2
    assert "open3d, all: pose right 2 of 2" in capsys.readouterr().out.splitlines()[-2]
