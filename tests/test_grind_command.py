"""``grindvision grind``: passes, the report, and a scan afterwards judged; what cannot be ground is named."""

import json
import warnings

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from grindvision.calibration.pose_conventions import convention
from grindvision.cli import main
from grindvision.cli.camera_pose import camera_content
from grindvision.clouds import write_ply
from grindvision.errors import FileError
from grindvision.files import write_json
from grindvision.geometry import inverse, move_points
from grindvision.grinding_files import read_job
from grindvision_book.chapter_16.ground_scans import ground_points
from tests.grinding_scene import arc_bead, pair
from tests.hand_eye_scene import X


def told(capsys, *words):
    code = main(["grind", *map(str, words)])
    out, err = capsys.readouterr()
    return code, out, err


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A job that was planned, and scans after its passes: done, and only begun."""
    place = tmp_path_factory.mktemp("grind")
    scene = pair(0, 60_000, beads=[arc_bead(width_mm=6.0)])
    write_ply(place / "good.ply", scene.sample)
    write_ply(place / "test.ply", scene.test)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scans, job = [str(place / name) for name in ("good.ply", "test.ply")], str(place / "job")
        assert main(["grind", *scans, "-o", job, "--depth", "0.3", "--serial", "part=A17"]) == 0
    plan = read_job(place / "job").plans[0]
    fresh = pair(5, 60_000, beads=[arc_bead(width_mm=6.0)])
    T_test_fresh = scene.T_test_part @ inverse(fresh.T_test_part)
    for name, factor in (("done", 1.2), ("begun", 0.4)):
        write_ply(place / f"{name}.ply", ground_points(fresh.test, plan, factor, T_test_fresh, times=2))
    return place


def test_a_job_is_whole_and_says_what_it_found(folder):
    report = json.loads((folder / "job" / "report.json").read_text())
    assert {"passes.csv", "plan.npz", "report.pdf", "report.png"} <= set(report["files"])
    (piece,) = report["pieces"]
    assert piece["volume_mm3"] > 50 and 0 < piece["volume_sigma_mm3"] < 5 and report["serials"] == {"part": "A17"}
    assert len(piece["plan"]["passes"]) == 5 and report["timings_s"]["passes"] > 0
    rows = (folder / "job" / "passes.csv").read_text().splitlines()
    assert rows[0].startswith("piece,pass,line,kind,x_mm") and len(rows) > 100
    assert (folder / "job" / "report.pdf").read_bytes().startswith(b"%PDF")


def test_a_scan_after_the_passes_is_judged(folder, capsys, tmp_path):
    code, out, _ = told(
        capsys, "--again", folder / "job", folder / "done.ply", "--tolerance-mm", "0.25", "-o", tmp_path
    )
    assert code == 0 and "tolerance of 0.25 mm met" in out
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["met"] and report["pieces"][0]["remaining"]["gouged_mm2"] == 0
    assert "passes.csv" not in report["files"]


@pytest.mark.usefixtures("blank_pictures")
def test_a_tolerance_that_is_not_met_ends_with_three_and_the_rest_is_planned(folder, capsys):
    code, out, _ = told(capsys, "--again", folder / "job", folder / "begun.ply", "--tolerance-mm", "0.25")
    assert code == 3 and "not met" in out and "the rest" in out
    again = folder / "job" / "again"
    report = json.loads((again / "report.json").read_text())
    (piece,) = report["pieces"]
    assert piece["remaining"]["over_mm2"] > 20 and piece["remaining"]["height_max_mm"] > 0.5
    assert piece["learnt"]["factor"] == pytest.approx(0.4, rel=0.15)
    assert {"passes.csv", "plan.npz"} <= set(report["files"])
    assert read_job(again).options.k_mm2_n == pytest.approx(piece["learnt"]["k_mm2_n"])


def test_a_job_reads_back_as_it_was_written(folder):
    job = read_job(folder / "job")
    (plan,) = job.plans
    assert job.sample["path"].endswith("good.ply") and plan.options == job.options
    assert plan.passes[0].strokes[0].poses.shape[1] == 12 and len(plan.passes) == 5


def test_a_job_that_is_damaged_or_missing_is_refused(folder, tmp_path):
    with pytest.raises(FileError, match=r"no plan\.npz"):
        read_job(tmp_path)
    whole = (folder / "job" / "plan.npz").read_bytes()
    for broken in (b"", b"no archive", whole[: len(whole) // 2]):
        (tmp_path / "plan.npz").write_bytes(broken)
        with pytest.raises(FileError, match="damaged"):
            read_job(tmp_path)
    arrays = dict(np.load(folder / "job" / "plan.npz"))
    content = json.loads(str(arrays["content"]))
    for damage in (
        {"content": "[" * 100_000},
        {"content": "7"},
        {"content": json.dumps(content | {"options": {"radius_mm": "wide"}})},
        {"content": json.dumps(content | {"pieces": {"a": 1}})},
        {"piece0_ground": np.zeros((4, 4))},
    ):
        np.savez(tmp_path / "plan.npz", **(arrays | damage))
        with pytest.raises(FileError, match="damaged"):
            read_job(tmp_path)


def test_another_good_scan_is_refused(folder, capsys, tmp_path):
    code, _, err = told(
        capsys, "--again", folder / "job", folder / "done.ply", "--sample", folder / "test.ply", "-o", tmp_path
    )
    assert code == 2 and "not the good scan that this job was planned with" in err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["good.ply"], "give SAMPLE and TEST"),
        (["good.ply", "test.ply"], "-o DIR is missing"),
        (["good.ply", "test.ply", "-o", "x", "--depth", "0.01"], "below the level of detection"),
        (["good.ply", "test.ply", "-o", "x", "--depth", "nan"], "--depth"),
        (["good.ply", "test.ply", "-o", "x", "--depth", "0.3", "--width", "200"], "wider than the place: on its way"),
        (["good.ply", "test.ply", "-o", "x", "--depth", "0.3", "--wheel", "2000"], "wider than the place: on its way"),
        (["test.ply", "good.ply", "-o", "x"], "a pit is never ground"),
        (["good.ply", "good.ply", "-o", "x"], "nothing to grind"),
        (["good.ply", "test.ply", "-o", "x", "--keep-out", "test.ply"], "closes the stock on all sides"),
        (
            ["good.ply", "test.ply", "-o", "x", "--robot", "ur3", "--program", "urscript"],
            "--robot needs --scanner-pose",
        ),
        (["good.ply", "test.ply", "-o", "x", "--program", "krl"], "give --robot as well"),
        (["good.ply", "test.ply", "-o", "x", "--tolerance-mm", "0.2"], "give --again DIR as well"),
        (["good.ply", "test.ply", "-o", "x", "--serial", "A17"], "give NAME=VALUE"),
        (["good.ply", "test.ply", "-o", "x", "--wheel", "-3"], "radius_mm is -3"),
        (["--again", "nowhere", "test.ply"], "no plan.npz"),
        (["--again", "job", "done.ply", "--tolerance-mm", "0.01", "-o", "x"], "below the level of detection"),
        (["--again", "job", "good.ply", "--tolerance-mm", "0.25", "-o", "x"], "is the good scan itself"),
    ],
)
def test_what_cannot_be_ground_is_named_in_one_line(folder, capsys, monkeypatch, words, said):
    monkeypatch.chdir(folder)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            code, _, err = told(capsys, *words)
        except SystemExit as ended:
            code, err = ended.code, capsys.readouterr().err
    assert code == 2 and said in err
    assert len([line for line in err.splitlines() if not line.startswith("warning")]) == 1
    assert not (folder / "x").exists()


@pytest.mark.usefixtures("blank_pictures")
def test_a_robot_drives_the_passes_where_the_controller_s_pose_and_the_camera_on_its_flange_put_them(
    folder, capsys, tmp_path
):
    pytest.importorskip("pinocchio", reason="needs the extra robot")
    scene = pair(0, 60_000, beads=[arc_bead(width_mm=6.0)])
    T_model_part, T_controller_model = np.eye(4), np.diag([-1.0, -1.0, 1.0, 1.0])
    T_model_part[:3, 3] = (330.0, 0.0, 60.0)
    T_controller_scanner = T_controller_model @ T_model_part @ inverse(scene.T_test_part)
    write_json(tmp_path / "camera.json", camera_content(X, "on-arm", convention("ur")))
    flange = T_controller_scanner @ inverse(X)
    pose = [*flange[:3, 3], *Rotation.from_matrix(flange[:3, :3]).as_rotvec()]
    words = [folder / "good.ply", folder / "test.ply", "-o", tmp_path / "out", "--disc", "20", "--depth", "0.7"]
    words += ["--robot", "ur3", "--program", "urscript", "--hand-eye", tmp_path / "camera.json"]
    code, _, err = told(capsys, *words)
    assert code == 2 and "give --robot-pose" in err and not (tmp_path / "out").exists()
    code, _, err = told(capsys, *words, "--robot-pose", *pose)
    assert code == 0, err
    text = (tmp_path / "out" / "grind1.script").read_text()
    (motion,) = json.loads((tmp_path / "out" / "report.json").read_text())["motion"]
    assert text.count("  move") > 40 and motion["position_error_mm"] < 0.01
    seen, based = (
        np.loadtxt(tmp_path / "out" / name, delimiter=",", skiprows=1, usecols=(4, 5, 6))
        for name in ("passes.csv", "passes_base.csv")
    )
    assert np.abs(move_points(T_controller_scanner, seen) - based).max() < 1e-3
