"""`grindvision detect`: files in, files out, and every bad input in one line with exit code 2."""

import json
from functools import cache

import numpy as np
import pytest

from grindvision.cli import main
from grindvision.clouds import read_cloud, write_ply
from grindvision.geometry import angle_between, inverse, move_points, random_rotation, rigid
from grindvision.vision.depth_calibration.field_correction import FieldCorrection, write_field
from tests.grinding_scene import arc_bead, pair, plate_height


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
    yield "one_place", np.zeros((600, 3)) + 400, "all 600 finite points are 400 400 400", ()
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


def model_files(folder):
    """The good part in its own frame, points on both sides of z = 0: a PLY with faces, an OBJ, and its bare points."""
    x, y = np.meshgrid(np.arange(-100.0, 101.0), np.arange(-70.0, 71.0))
    points = np.column_stack([x.ravel(), y.ravel(), plate_height(x, y).ravel()])
    at = np.arange(x.size).reshape(x.shape)
    squares = np.stack([at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]], axis=-1).reshape(-1, 4)
    rows = ["{:.6f} {:.6f} {:.6f}".format(*row) for row in points]
    head = "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n"
    faces = f"element face {len(squares)}\nproperty list uchar int vertex_indices\nend_header\n"
    corners = ["4 {} {} {} {}".format(*row) for row in squares]
    (folder / "faces.ply").write_text("\n".join([head.format(len(points)) + faces + rows[0], *rows[1:], *corners, ""]))
    (folder / "model.obj").write_text(
        "".join(f"v {row}\n" for row in rows) + "".join("f {} {} {} {}\n".format(*row) for row in squares + 1)
    )
    write_ply(folder / "points.ply", points)


@pytest.mark.usefixtures("blank_pictures")
def test_a_field_is_taken_off_what_the_scanner_measured_and_nothing_else(scene, tmp_path, capsys):
    """With the field, bent scans give the result of true ones; a model, which no scanner bent, stays as it is.

    The mesh's two files hold the same model: one of them says what is wanted of both.
    """
    folder, case = scene
    u, v = np.meshgrid(np.linspace(-0.5, 0.5, 41), np.linspace(-0.5, 0.5, 41), indexing="ij")
    error = np.repeat((0.4 * np.cos(9 * u + 1) * np.cos(7 * v))[:, :, None], 2, axis=2)
    field = FieldCorrection(error, np.array([-0.5, -0.5, 300]), np.array([0.5, 0.5, 500]), np.array([0.0, 0, 1]))
    write_field(field, tmp_path / "field.npz")
    model_files(tmp_path)
    for name, true in (("sample", case.sample), ("test", case.test)):
        write_ply(tmp_path / f"{name}.ply", true * (1 + field.error_mm(true) / true[:, 2])[:, None])

    @cache
    def found(*words):
        code, _, error = run(capsys, *words, "-o", tmp_path / "out")
        assert code == 0, error
        report = json.loads((tmp_path / "out" / "report.json").read_text())
        path = np.genfromtxt(tmp_path / "out" / "path.csv", delimiter=",", names=True)
        return np.array(report["T_sample_test"]), np.column_stack([path[name] for name in ("x_mm", "y_mm", "z_mm")])

    words = ("--field-correction", tmp_path / "field.npz")
    for sample, true_sample, more in (
        ("sample.ply", folder / "sample.ply", ()),
        ("faces.ply", tmp_path / "faces.ply", ()),
        ("model.obj", tmp_path / "faces.ply", ()),
        ("points.ply", tmp_path / "points.ply", ("--sample-model",)),
    ):
        wanted, path = found(true_sample, folder / "test.ply")
        pose, mended = found(tmp_path / sample, tmp_path / "test.ply", *words, *more)
        assert np.abs(move_points(pose, path) - move_points(wanted, path)).max() < 0.03, sample
        assert np.abs(mended - path).max() < 0.06, sample
    bent = found(tmp_path / "sample.ply", tmp_path / "test.ply")[1]
    assert np.abs(bent - found(folder / "sample.ply", folder / "test.ply")[1]).max() > 0.12

    for sample, test, option, said in (
        ("points.ply", "test.ply", (), "or say --sample-model"),
        ("sample.ply", "faces.ply", (), "faces.ply: a mesh"),
        ("sample.ply", "test.ply", ("--sample-viewpoint", 0, 0, 9), "scanner's own frame"),
    ):
        code, _, error = run(capsys, tmp_path / sample, tmp_path / test, *words, *option, "-o", tmp_path / "none")
        assert code == 2 and said in error and error.count("\n") == 1
        assert not (tmp_path / "none").exists()


def test_a_height_that_the_pair_cannot_show_ends_with_three(tmp_path, capsys):
    one = pair(seed=4, n_points=12_000)
    write_ply(tmp_path / "good.ply", one.sample)
    write_ply(tmp_path / "test.ply", one.test)
    words = ["detect", str(tmp_path / "good.ply"), str(tmp_path / "test.ply"), "--require-height"]
    assert main([*words, "2", "-o", str(tmp_path / "high")]) == 0
    assert main([*words, "0.01", "-o", str(tmp_path / "low")]) == 3
    assert "would not be told on" in capsys.readouterr().err
    report = json.loads((tmp_path / "low" / "report.json").read_text())
    assert report["coverage"]["test"]["fraction"] > 0.9
    assert report["coverage"]["min_height_mm"]["median"] > 0.01
    assert report["coverage"]["least_height_mm"] == report["coverage"]["min_height_mm"]  # the old key, one version
    assert main([*words, "-1", "-o", str(tmp_path / "none")]) == 2
