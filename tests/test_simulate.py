"""``grindvision simulate``: the files are there, belong together, and repeat byte for byte."""

import json
from functools import cache

import numpy as np
import pytest

from grindvision.arm import read_arm
from grindvision.cli import main
from grindvision.clouds import read_cloud
from grindvision.files import read_table, sha256
from grindvision.geometry import check_rigid, move_points


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    """Function that simulates a subject from seed 5, once, and returns its folder."""

    @cache
    def folder_of(subject):
        folder = tmp_path_factory.mktemp(subject) / "made"
        assert main(["simulate", subject, "-o", str(folder), "--seed", "5"]) == 0
        return folder

    return folder_of


@pytest.mark.parametrize(
    ("subject", "files"),
    [
        ("grinding", ["sample.ply", "test.ply", "pose.json", "truth.json"]),
        (
            "welding",
            [
                f"{k}/{f}"
                for k in ("line", "curve", "box", "cylinder")
                for f in ("cloud.ply", "labels.npy", "pose.json")
            ],
        ),
        ("calibration", ["measurements.csv", "robot.csv", "truth.json"]),
    ],
)
def test_files_belong_together_and_the_same_seed_gives_the_same_bytes(tmp_path, simulated, request, subject, files):
    made = simulated(subject)
    request.getfixturevalue("blank_pictures")
    assert main(["simulate", subject, "-o", str(tmp_path / "again"), "--seed", "5"]) == 0
    for name in files:
        assert sha256(made / name) == sha256(tmp_path / "again" / name), name
    assert not list(tmp_path.rglob(".*"))
    check = {"grinding": check_grinding, "welding": check_welding, "calibration": check_calibration}[subject]
    check(made)


def test_another_seed_gives_another_experiment(tmp_path, simulated, blank_pictures):
    made = simulated("calibration")
    assert main(["simulate", "calibration", "-o", str(tmp_path), "--seed", "6"]) == 0
    assert sha256(made / "measurements.csv") != sha256(tmp_path / "measurements.csv")
    assert sha256(made / "robot.csv") == sha256(tmp_path / "robot.csv")


def check_grinding(folder):
    truth = json.loads((folder / "truth.json").read_text())
    test = read_cloud(folder / "test.ply").points
    check_rigid(truth["T_sample_test"], "T_sample_test")
    ridge = np.array(truth["ridge_test_mm"])
    bead = test[truth["bead_points_test"]]
    assert np.linalg.norm(bead.mean(axis=0) - ridge.mean(axis=0)) < 3
    T_base_test = check_rigid(json.loads((folder / "pose.json").read_text())["T_base_scanner"], "pose.json")
    np.testing.assert_allclose(move_points(T_base_test, ridge), truth["ridge_base_mm"], atol=1e-9)
    assert T_base_test[2, 2] < -0.7  # the scanner looks down
    sample = read_cloud(folder / "sample.ply").points
    moved = move_points(truth["T_sample_test"], test)
    assert np.linalg.norm(moved.mean(axis=0) - sample.mean(axis=0)) < 20


def check_welding(folder):
    for kind in ("line", "curve", "box", "cylinder"):
        cloud = read_cloud(folder / kind / "cloud.ply").points
        labels = np.load(folder / kind / "labels.npy")
        truth = json.loads((folder / kind / "truth.json").read_text())
        assert labels.dtype == bool and labels.shape == (len(cloud),)
        assert 0.03 < labels.mean() < 0.2
        root = np.array(truth["root_camera_mm"])
        assert root.shape == np.array(truth["normals_camera"]).shape == np.array(truth["tangents_camera"]).shape
        assert np.linalg.norm(cloud[labels].mean(axis=0) - root.mean(axis=0)) < 15


def check_calibration(folder):
    truth = json.loads((folder / "truth.json").read_text())
    table = read_table(folder / "measurements.csv", ["q1_rad", "sx_mm", "bz_mm"], ["split"])
    assert len(table) == len(truth["T_base_scanner"]) == 114
    assert read_arm(folder / "robot.csv").n == 4
    nominal, true = read_arm(folder / "robot.csv").table, [list(row.values()) for row in truth["robot"].values()]
    assert np.abs(np.array(true) - nominal).max() > 1


def test_bad_input_is_one_line_and_exit_2(tmp_path, capsys):
    assert main(["simulate", "grinding", "-o", str(tmp_path / "x"), "--seed", "-3"]) == 2
    assert "--seed is -3" in capsys.readouterr().err
    assert not (tmp_path / "x").exists()


def test_a_folder_that_cannot_be_written_is_refused_before_the_work(tmp_path, capsys):
    (tmp_path / "file").write_text("no folder")
    assert main(["simulate", "grinding", "-o", str(tmp_path / "file" / "x")]) == 2
    assert "cannot write to" in capsys.readouterr().err
