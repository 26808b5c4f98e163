"""``groove``'s options of the weld: refused before any work, or written whole and read back."""

import csv
import json
import re

import numpy as np
import pytest

from grindvision.cell import weld_scene
from grindvision.cli import main
from grindvision.cli.robot_job import robot_job
from grindvision.cli.weld_job import groove_section, weld_runs
from grindvision.errors import FileError, GrindvisionError, GrindvisionWarning, InputError
from grindvision.geometry import inverse, move_points, rigid, rotate_vectors
from grindvision.motion import tool_trajectory
from grindvision.vision.seam.groove_lines import DetectedGroove
from grindvision.vision.seam.seam_path import SeamPath
from tests.programme_readers import read_ls, read_rapid, read_steps_json
from tests.test_robot_job import T_BASE_SCANNER, calibrated_cell, options


@pytest.fixture
def pose(tmp_path):
    path = tmp_path / "pose.json"
    path.write_text(json.dumps({"T_base_scanner": T_BASE_SCANNER.tolist(), "base": "model"}))
    return str(path)


def asked(pose, *words):
    parsed = options("--robot", "irb1200_5_90", "--program", "rapid", "--scanner-pose", pose, *words)
    parsed.variant = "ours"
    return robot_job(parsed)


def groove_of(width_mm=12.0, depth_mm=6.0, slope=0.0, stations=40, offset_mm=0.0):
    """A straight groove of 80 mm in the scanner's frame, whose width grows by ``slope`` along it."""
    x = np.linspace(-40.0, 40.0, stations)
    root = np.column_stack([x * 0 + 110.0, x, x * 0 + 440.0])
    up = np.tile([0.0, 0.0, -1.0], (stations, 1))
    wide = width_mm + slope * (x + 40.0)
    left, right = (root + np.outer(side * wide / 2 + offset_mm, [1.0, 0, 0]) + depth_mm * up for side in (-1, 1))
    flat = np.full(stations, 0.05)
    return DetectedGroove(np.arange(10), root, left, right, up, wide, np.full(stations, depth_mm), flat, 2.0, 1.0)


def path_of(groove, waypoints=12):
    rows = np.linspace(0, len(groove.root) - 1, waypoints).astype(int)
    return SeamPath(groove.root[rows], groove.normals[rows])


def torch(path):
    return tool_trajectory(path.points, path.normals)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--weave-frequency", "2"], "--weave-frequency is for a weave; give --weave MM as well"),
        (["--weave", "4", "--weave-length", "4", "--weave-frequency", "2"], "say the same at one speed"),
        (["--weave", "4", "--weave-frequency", "30"], "--weave-frequency is 30 Hz; give 0.05 to 10"),
        (["--weave", "-4"], "a weave -4 mm wide"),
        (["--weave", "40", "--weave-frequency", "9"], "250 is the most: weave at"),
        (["--weave", "4", "--weave-dwell", "2"], "leaves no way to swing"),
        (["--bead-area", "0"], "--bead-area is 0 mm2"),
        (["--run-on", "-1"], "--run-on is -1 mm; give 0 to 200"),
        (["--tacks", "0"], "--tacks is 0; give 1 to 100 tacks"),
        (["--tack-length", "5"], "--tack-length is for tacks"),
        (["--tacks", "3", "--tack-length", "0.2"], "--tack-length is 0.2 mm; give 1 to 200"),
        (["--tacks", "missing.csv"], "no such file"),
        (["--pre-flow", "1"], "--pre-flow is for a hot run; give --arc as well"),
        (["--arc", "--arc-output", "do1", "--pre-flow", "1"], "give --arc-gas NAME as well"),
        (["--arc", "--arc-output", "do1", "--arc-gas", "do1"], "the gas needs an output of its own"),
        (["--arc", "--arc-output", "do1", "--crater-fill", "-1"], "the crater time of the arc is -1 s"),
        (["--arc", "--arc-output", "do1", "--arc-gas", "gas valve"], "takes no signal named"),
        (["--work-object", "wTable"], "--work-object needs --work-frame"),
        (["--tool-data", "my gun"], "takes no frame named"),
        (["--tool-data", " "], "--tool-data is empty"),
    ],
)
def test_what_does_not_go_together_is_refused_before_any_work(pose, words, message):
    with pytest.raises((InputError, FileError), match=re.escape(message)):
        asked(pose, *words)


def test_formats_and_arms_that_cannot_say_it_are_refused(pose, tmp_path):
    for words, message in (
        (("ur3", "--weave", "3"), "--weave needs a programme that sets speeds and the arc; give --program, not csv"),
        (("ur3", "--tool-data", "torch"), "--tool-data is for a controller's language"),
        (("ur3", "--program", "urscript", "--work-object", "plane"), "names no work object"),
        (("ur3", "--program", "urscript", "--send", "10.0.0.2", "--tacks", "3"), "--send hands one programme over"),
        (("lrmate200id", "--program", "ls", "--tool-data", "12"), "LS counts its frames: give 0 to 10"),
        (("gp7", "--program", "jbi", "--tool-data", "gun"), "JBI counts its frames"),
    ):
        parsed = options("--robot", *words, "--scanner-pose", pose)
        parsed.variant = "ours"
        with pytest.raises(InputError, match=re.escape(message)):
            robot_job(parsed)
    frame = tmp_path / "frame.json"
    for content, message in (
        (rigid(translation_mm=[0.4, 0, 0.3]).tolist(), "metres"),
        ([[1, 2], [3, 4]], "frame.json"),
        ({"T": 1}, "frame.json"),
    ):
        frame.write_text(json.dumps(content))
        with pytest.raises(GrindvisionError, match=message):
            asked(pose, "--work-object", "wTable", "--work-frame", str(frame))
    table = tmp_path / "tacks.csv"
    table.write_text("x_mm,y_mm,z_mm,length_mm\n1,2,3,0.1\n")
    with pytest.raises(InputError, match=r"tack 1 is 0\.1 mm long"):
        asked(pose, "--tacks", str(table))


def test_passes_and_tacks_are_a_programme_each_and_stand_where_they_should(pose, tmp_path):
    groove = groove_of()
    path = path_of(groove)
    job = asked(pose, "--bead-area", "12", "--tacks", "3", "--tack-length", "6", "--run-on", "4", "--weave", "2")
    welding = weld_runs(job.wishes, job.torch_speed_mm_s, path, groove, torch)
    assert [run.name for run in welding.runs] == ["pass1", "pass2", "pass3", "tacks"]
    facts = json.loads(json.dumps(welding.facts(), default=float))
    assert facts["section_mm2"] == pytest.approx(36.0) and sum(p["area_mm2"] for p in facts["passes"]) == pytest.approx(
        36
    )
    work = np.random.default_rng(0).uniform([400, -90, 0], [460, 90, 30], (300, 3))
    cloud = move_points(inverse(T_BASE_SCANNER), work)
    for run, one in zip(welding.runs, (*welding.fill.passes, None), strict=True):
        motion = job.plan_weld(run.path, cloud)
        job.write_weld(motion, run, tmp_path / "out")
        _, _, said = read_rapid((tmp_path / "out" / f"{run.name}.mod").read_bytes().decode("ascii"))
        tips = np.array([step[1][:3, 3] for step in said if step[0] == "pose"])[:-1]
        assert len(tips) == len(run.path)
        there = move_points(inverse(T_BASE_SCANNER), tips)
        if one is not None:  # the middle of each pass lies beside and above the root as the fill says
            assert 440.0 - there[:, 2].mean() == pytest.approx(one.up_mm, abs=1e-3)
            right = (there[:, 0] - 110.0).mean() * np.sign(torch(path).T_base_tool[0, 0, 1])
            assert right == pytest.approx(one.right_mm, abs=0.02)
            assert run.path.speed_mm_s == pytest.approx(8.0 * one.speed_factor)
    assert welding.runs[-1].path.count == 3 and welding.runs[-1].path.weave is None


def test_tacks_that_are_there_are_not_welded_over(pose, tmp_path):
    table = tmp_path / "tacks.csv"
    table.write_text("x_mm,y_mm,z_mm\n110,-20,440\n110,15,440\n")
    groove = groove_of()
    job = asked(pose, "--skip-tacks", str(table), "--tack-length", "8", "--tacks", str(table), "--run-on", "3")
    welding = weld_runs(job.wishes, 8.0, path_of(groove), groove, torch)
    main_run, tacks = welding.runs
    assert [run.name for run in welding.runs] == ["program", "tacks"]
    on = main_run.path.trajectory.positions_mm[main_run.path.welds > 0]
    for y in (-20, 15):
        assert np.abs(on[:, 1] - y).min() > 3.8
    assert main_run.path.count == 3 and on[:, 1].min() == pytest.approx(-43.0)
    laid = tacks.path.trajectory.positions_mm[tacks.path.welds > 0]
    assert np.min(np.abs(laid[:, 1, None] - [-20, 15]), axis=1).max() < 4.2


def test_a_section_is_measured_on_both_sides_and_told_where_it_varies():
    even = groove_section(groove_of())
    assert (even.left_mm, even.right_mm, even.depth_mm) == pytest.approx((6, 6, 6)) and even.area_mm2 == pytest.approx(
        36
    )
    bevel = groove_section(groove_of(offset_mm=6.0))
    assert min(bevel.left_mm, bevel.right_mm) == pytest.approx(0.0, abs=1e-9) and bevel.area_mm2 == pytest.approx(36)
    with pytest.warns(GrindvisionWarning, match="section runs from 4. to 6. mm2 along the seam"):
        groove_section(groove_of(slope=0.15))


def test_passes_need_a_groove(pose):
    job = asked(pose, "--bead-area", "12")
    with pytest.raises(InputError, match="fills a groove, and the first seam is none"):
        weld_runs(job.wishes, 8.0, path_of(groove_of()), None, torch)


def test_a_weave_by_frequency_keeps_it_in_every_pass(pose):
    groove = groove_of()
    for words, same in ((("--weave-frequency", "2"), "hz"), (("--weave-length", "4"), "mm")):
        job = asked(pose, "--bead-area", "10", "--weave", "2", *words)
        run = weld_runs(job.wishes, 8.0, path_of(groove), groove, torch).runs[0]
        assert run.path.speed_mm_s != 8.0
        length = run.path.weave.length_mm
        found = run.path.speed_mm_s / length if same == "hz" else length
        assert found == pytest.approx(2.0 if same == "hz" else 4.0, rel=0.03)


def test_the_controllers_frames_reach_the_programme(pose, tmp_path):
    frame = tmp_path / "frame.json"
    T_base_work = rigid(translation_mm=[400.0, 10.0, 20.0])
    frame.write_text(json.dumps({"T_base_work": T_base_work.tolist()}))
    groove = groove_of()
    words = ("--tool-data", "7", "--work-object", "3", "--work-frame", str(frame), "--run-off", "2")
    parsed = options("--robot", "lrmate200id", "--program", "ls", "--scanner-pose", pose, *words)
    parsed.variant = "ours"
    job = robot_job(parsed)
    path = path_of(groove)
    back = SeamPath(path.points[::-1], path.normals)  # the other way joint 4 would turn past half a turn
    run = weld_runs(job.wishes, 8.0, back, groove, torch).runs[0]
    low = np.array([[110.0, 0.0, 470.0]])
    text = job.write_weld(job.plan_weld(run.path, low), run, tmp_path / "out")
    assert "UTOOL_NUM=7" in text and "UFRAME_NUM=3" in text and "UF : 3, UT : 7" in text
    work = read_ls(text)[1]
    np.testing.assert_allclose(work, T_base_work, atol=1e-3)
    # a plain run along the seam takes the frames too
    parsed = options("--robot", "irb1200_5_90", "--program", "rapid", "--scanner-pose", pose, "--tool-data", "tGun")
    parsed.variant = "ours"
    job = robot_job(parsed)
    assert job.wishes is None
    assert job.write(job.plan(torch(path_of(groove)), low), tmp_path / "plain") == "program.mod"
    assert "tGun\\WObj:=wWork" in (tmp_path / "plain" / "program.mod").read_text()


def test_from_calibration_to_a_woven_weld_with_the_calibrated_arm(tmp_path, capsys):
    """``calibrate``, then ``groove --robot OUT/robot.csv``: the joints drive the calibrated arm along the path."""
    from grindvision.arm import forward, read_arm
    from grindvision.motion import welding_torch

    arm_file = calibrated_cell(tmp_path)
    scene = weld_scene("line", np.random.default_rng(3), every=3)
    np.save(tmp_path / "cloud.npy", scene.points)
    T_base_piece = rigid([[0, -1, 0], [1, 0, 0], [0, 0, 1]], [300.0, 0.0, 12.0])
    T_base_scanner = T_base_piece @ scene.scan.T_world_scanner
    (tmp_path / "pose.json").write_text(json.dumps(T_base_scanner.tolist()))
    words = ["groove", str(tmp_path / "cloud.npy"), "-o", str(tmp_path / "out"), "--robot", str(arm_file)]
    words += ["--scanner-pose", str(tmp_path / "pose.json"), "--program", "steps-json", "--waypoints", "20"]
    assert main([*words, "--weave", "3", "--weave-length", "10", "--arc", "--arc-output", "4", "--tacks", "3"]) == 0
    files = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"program.json", "prog_arc.json", "tacks.json", "tack_arc.json", "report.png"} <= files
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert [run["program"] for run in report["welding"]["runs"]] == ["program", "tacks"]
    content = json.loads((tmp_path / "out" / "program.json").read_text())
    moves = [step for step in content["steps"] if step["kind"] == "linear move"]
    arm, nominal, tip = read_arm(arm_file), read_arm(tmp_path / "r.csv"), welding_torch().T_flange_tool
    off = [np.abs((forward(arm, step["q_rad"]) @ tip - step["T_work_tool"])[:3, 3]).max() for step in moves]
    assert max(off) < 0.01
    away = [np.abs((forward(nominal, step["q_rad"]) @ tip - step["T_work_tool"])[:3, 3]).max() for step in moves]
    assert max(away) > 0.1  # the nominal table would have missed it: the calibrated one is what drives
    # the woven path goes along the seam that was found, to both sides
    rows = list(csv.DictReader((tmp_path / "out" / "trajectory.csv").open()))
    seam = np.array([[float(row[key]) for key in ("x_mm", "y_mm", "z_mm")] for row in rows])
    normals = np.array([[float(row[key]) for key in ("nx", "ny", "nz")] for row in rows])
    in_base = move_points(T_base_scanner, seam)
    places = np.array([step["T_work_tool"] for step in moves])[:-1, :3, 3]
    ahead = in_base[-1] - in_base[0]
    ahead /= np.linalg.norm(ahead)
    side = np.cross(ahead, rotate_vectors(T_base_scanner, normals).mean(axis=0))
    swing = (places - in_base.mean(axis=0)) @ side
    assert swing.max() == pytest.approx(1.5, abs=0.5) and swing.min() == pytest.approx(-1.5, abs=0.5)
    hot = read_steps_json((tmp_path / "out" / "prog_arc.json").read_text())[2]
    assert [step[2] for step in hot if step[0] == "output"] == [True, False]
    # a second run without these wishes leaves none of their files
    assert main(["groove", *words[1:]]) == 0
    files = {path.name for path in (tmp_path / "out").iterdir()}
    assert "program.json" in files and not files & {"prog_arc.json", "tacks.json", "tack_arc.json"}
    capsys.readouterr()
