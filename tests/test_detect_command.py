"""`grindvision detect`: files in, files out, and every bad input in one line with exit code 2."""

import json

import numpy as np
import pytest
from grinding_scene import arc_bead, pair

from grindvision.cli import main
from grindvision.clouds import read_cloud, write_ply
from grindvision.geometry import angle_between, inverse, move_points, random_rotation, rigid


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene")
    case = pair(seed=11, n_points=60_000, beads=[arc_bead()])
    write_ply(folder / "sample.ply", case.sample)
    write_ply(folder / "test.ply", case.test)
    return folder, case


def run(capsys, *words):
    code = main(["detect", *map(str, words)])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def test_two_files_become_a_path_in_both_frames(scene, tmp_path, capsys, rng):
    folder, case = scene
    pose = rigid(random_rotation(rng), (500.0, -600, 40))
    (tmp_path / "pose.json").write_text(json.dumps({"T_base_scanner": pose.tolist()}))
    out = tmp_path / "out"
    words = (
        folder / "sample.ply",
        folder / "test.ply",
        "-o",
        out,
        "--points",
        5,
        "--scanner-pose",
        tmp_path / "pose.json",
    )
    code, text, _ = run(capsys, *words)
    assert code == 0
    assert "1 bead" in text and "scanner at (500, -600, 40) mm in the base frame" in text
    here, base = (np.genfromtxt(out / name, delimiter=",", names=True) for name in ("path.csv", "path_base.csv"))
    assert list(here.dtype.names) == ["point", "x_mm", "y_mm", "z_mm", "nx", "ny", "nz"]
    assert here["point"].tolist() == [1, 2, 3, 4, 5]
    columns = [np.column_stack([table[name] for name in ("x_mm", "y_mm", "z_mm")]) for table in (here, base)]
    np.testing.assert_allclose(move_points(pose, columns[0]), columns[1], atol=2e-4)
    report = json.loads((out / "report.json").read_text())
    assert np.degrees(angle_between(report["T_sample_test"], case.T_sample_test)) < 0.05
    assert 0 < report["confidence"] <= 1
    assert report["fitness"] > 0.9
    assert report["rmse"] < 0.1
    assert report["timings_s"]["total"] > 0
    assert {"read", "coarse", "icp", "difference", "path"} <= set(report["timings_s"])
    assert [entry["name"] for entry in report["inputs"]] == ["sample.ply", "test.ply", "pose.json"]
    assert len(read_cloud(out / "difference.ply")) > 100
    assert (out / "report.png").stat().st_size > 10_000


def test_a_good_part_is_no_error(scene, tmp_path, capsys):
    folder, case = scene
    same = pair(seed=12, n_points=60_000)
    write_ply(tmp_path / "good.ply", same.test)
    write_ply(tmp_path / "sample.ply", same.sample)
    code, text, _ = run(capsys, tmp_path / "sample.ply", tmp_path / "good.ply", "-o", tmp_path / "out")
    assert code == 0
    assert "nothing to grind above the level of detection of 0." in text
    assert (tmp_path / "out" / "path.csv").read_text() == "point,x_mm,y_mm,z_mm,nx,ny,nz\n"
    del folder, case


def test_nan_points_are_only_a_warning(scene, tmp_path, capsys):
    folder, case = scene
    holed = case.test.copy()
    holed[::50] = np.nan
    write_ply(tmp_path / "holed.ply", holed)
    code, _, error = run(capsys, folder / "sample.ply", tmp_path / "holed.ply", "-o", tmp_path / "out")
    assert code == 0
    assert "hold NaN" in error


def bad_cases(case, folder):
    rng = np.random.default_rng(1)
    plane = np.column_stack([rng.uniform(-60, 60, size=(20_000, 2)), rng.normal(scale=0.02, size=20_000) + 400])
    yield "one_point", case.test[:1], "at least 500", ()
    yield "all_nan", np.full((600, 3), np.nan), "NaN", ()
    yield "metres", case.test / 1000, "--unit m", ()
    yield "one_place", np.zeros((600, 3)) + 400, "1 points given", ()
    yield "a_line", np.column_stack([np.linspace(0, 99, 900), np.zeros(900), np.full(900, 400.0)]), "", ()
    yield "another_part", plane, "", ()
    yield "far_outlier", np.vstack([case.test, [[0, 0, 1e12]]]), "outliers", ()
    yield "no_points_asked", case.test, "at least 1", ("--points", 0)
    yield "unit_m_for_mm", case.test, "--unit mm", ("--unit", "m")


NAMES = [name for name, *_ in bad_cases(pair(n_points=500), None)]


@pytest.mark.parametrize("name", NAMES)
def test_bad_input_is_one_line_and_exit_code_2(scene, tmp_path, capsys, name):
    folder, case = scene
    _, points, words, options = next(entry for entry in bad_cases(case, folder) if entry[0] == name)
    write_ply(tmp_path / "bad.ply", points)
    code, _, error = run(capsys, folder / "sample.ply", tmp_path / "bad.ply", "-o", tmp_path / "out", *options)
    assert code == 2
    assert error.count("\n") == 1
    assert words in error
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("nonsense", "JSON"),
        ('{"T": 1}', "T_base_scanner"),
        (json.dumps((2 * np.eye(4)).tolist()), "T_base_scanner"),
        (json.dumps(np.eye(3).tolist()), "4x4"),
        (json.dumps(inverse(rigid(None, (1, 2, 3))).T.tolist()), "transposed"),
        (json.dumps(rigid(None, (0.5, -0.6, 0.04)).tolist()), "metres"),
    ],
)
def test_a_bad_pose_is_refused_before_any_work(scene, tmp_path, capsys, content, words):
    folder, _ = scene
    (tmp_path / "pose.json").write_text(content)
    code, _, error = run(
        capsys,
        folder / "sample.ply",
        folder / "test.ply",
        "-o",
        tmp_path / "out",
        "--scanner-pose",
        tmp_path / "pose.json",
    )
    assert code == 2
    assert error.count("\n") == 1
    assert words in error
    assert not (tmp_path / "out").exists()


def test_real_range_scans_meet(real_data, tmp_path, capsys):
    sample, test = real_data("bun000.ply"), real_data("bun045.ply")
    code, _, _ = run(capsys, sample, test, "-o", tmp_path, "--unit", "m")
    assert code == 0
    from scipy.spatial.transform import Rotation

    poses = {}
    for line in real_data("bun.conf").read_text().splitlines():
        _, name, *numbers = line.split()
        tx, ty, tz, *q = map(float, numbers)
        poses[name] = rigid(Rotation.from_quat(q).as_matrix().T, np.array([tx, ty, tz]) * 1000)
    expected = inverse(poses["bun000.ply"]) @ poses["bun045.ply"]
    found = np.array(json.loads((tmp_path / "report.json").read_text())["T_sample_test"])
    at = read_cloud(test, "m").points.mean(axis=0)
    assert np.degrees(angle_between(found, expected)) < 0.2
    assert np.linalg.norm(move_points(found, at) - move_points(expected, at)) < 0.3
