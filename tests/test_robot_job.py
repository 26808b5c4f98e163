import argparse
import json
import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from grindvision.arm import MdhArm, write_arm
from grindvision.cell import weld_scene
from grindvision.cli import main
from grindvision.cli.camera_pose import where_it_stood
from grindvision.cli.robot_job import add_robot_arguments, motion_facts, robot_job
from grindvision.errors import FileError, GrindvisionError, InputError, NotRigidError
from grindvision.geometry import inverse, move_points, rigid, rotate_vectors, rotation_about
from grindvision.motion import tool_trajectory, welding_torch
from tests.calibration_rig import rig
from tests.motion_scene import seam

#: A scanner half a metre above the table that looks straight down.
T_BASE_SCANNER = rigid(np.diag([1.0, -1.0, -1.0]), [310.0, 0.0, 500.0])


def options(*words):
    parser = argparse.ArgumentParser()
    add_robot_arguments(parser)
    return parser.parse_args(words)


@pytest.fixture
def pose(tmp_path):
    path = tmp_path / "pose.json"
    path.write_text(json.dumps({"T_base_scanner": T_BASE_SCANNER.tolist(), "base": "model"}))
    return str(path)


def test_without_a_robot_there_is_no_job_and_no_stray_option(pose):
    assert robot_job(options()) is None
    for stray in (["--program", "csv"], ["--scanner-pose", pose], ["--torch-speed", "5"], ["--table-top", "0"]):
        with pytest.raises(InputError, match=f"{stray[0]} is for a robot's programme"):
            robot_job(options(*stray))


@pytest.mark.parametrize(
    ("form", "name"), [("csv", "program.csv"), ("json", "program.json"), ("urscript", "program.script")]
)
def test_a_scanned_seam_becomes_a_programme(pose, tmp_path, form, name):
    positions, normals = seam(points=15)
    T_scanner_base = inverse(T_BASE_SCANNER)
    trajectory = tool_trajectory(move_points(T_scanner_base, positions), rotate_vectors(T_scanner_base, normals))
    job = robot_job(options("--robot", "ur3", "--program", form, "--scanner-pose", pose, "--torch-speed", "10"))
    work = np.random.default_rng(0).uniform([250, -90, 20], [370, 90, 45], (3000, 3))
    motion = job.plan(trajectory, move_points(T_scanner_base, work))
    assert job.write(motion, tmp_path / "out") == name
    assert [path.name for path in (tmp_path / "out").iterdir()] == [name]
    reached = motion.path.T_base_tool[:, :3, 3]
    nearest = np.linalg.norm(reached[:, None] - positions, axis=2).min(axis=0)
    assert nearest.max() < 0.05  # every way point of the seam, though poses were put in between
    facts = json.loads(json.dumps(motion_facts(motion), default=float))
    assert facts["robot"] == "ur3" and facts["torch_speed_mm_s"] == 10.0
    assert facts["clearance_mm"] > 2.0 and facts["position_error_mm"] < 0.05 and facts["angle_error_deg"] < 0.1


def test_what_cannot_work_is_refused_before_any_work(pose, tmp_path):
    with pytest.raises(InputError, match="--robot needs --scanner-pose"):
        robot_job(options("--robot", "ur3"))
    with pytest.raises(InputError, match="--flange is for a URDF file"):
        robot_job(options("--robot", "ur3", "--scanner-pose", pose, "--flange", "tool0"))
    with pytest.raises(InputError, match="--torch-speed is -1 mm/s"):
        robot_job(options("--robot", "ur3", "--scanner-pose", pose, "--torch-speed", "-1"))
    with pytest.raises(FileError, match="no such file"):
        robot_job(options("--robot", str(tmp_path / "arm.urdf"), "--scanner-pose", pose))
    squashed = tmp_path / "squashed.json"
    squashed.write_text(json.dumps((2 * np.eye(4)).tolist()))
    with pytest.raises(NotRigidError, match=r"squashed.json"):
        robot_job(options("--robot", "ur3", "--scanner-pose", str(squashed)))


def test_a_robot_file_needs_the_flange_and_a_language_it_understands(pose, tmp_path):
    arm = tmp_path / "arm.urdf"
    arm.write_text(
        '<robot name="two"><link name="base"/><link name="arm"/><joint name="shoulder" type="revolute">'
        '<parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>'
        '<limit effort="1" lower="-1" upper="1" velocity="1"/></joint></robot>'
    )
    with pytest.raises(FileError, match="no joint or link named tool0 for the flange"):
        robot_job(options("--robot", str(arm), "--scanner-pose", pose))
    with pytest.raises(InputError, match="two is no arm of Universal Robots"):
        robot_job(options("--robot", str(arm), "--scanner-pose", pose, "--flange", "arm", "--program", "urscript"))


@pytest.mark.parametrize(
    ("name", "form"), [("ur3", "urscript"), ("ur5e", "urscript"), ("lrmate200id", "ls"), ("gp7", "jbi")]
)
def test_a_pose_from_the_controller_counts_from_the_controller_s_base(tmp_path, name, form, pose):
    """The same place, told in the model's base, in the controller's, and by hand-eye: one job."""
    of_model = robot_job(options("--robot", name, "--program", form, "--scanner-pose", pose, "--table-top", "-200"))
    T_controller_model = of_model.robot.T_controller_base
    assert not np.array_equal(T_controller_model, np.eye(4))
    T_controller_scanner = T_controller_model @ T_BASE_SCANNER
    table = str(-200 + T_controller_model[2, 3])
    bare = tmp_path / "bare.json"
    bare.write_text(json.dumps(T_controller_scanner.tolist()))
    stated = tmp_path / "stated.json"
    stated.write_text(json.dumps({"T_base_scanner": T_controller_scanner.tolist(), "base": "controller"}))
    camera = tmp_path / "hand_eye.json"
    T_flange_camera = rigid(rotation_about([0.2, 1, 0], 0.3), (40.0, -20.0, 60.0))
    camera.write_text(json.dumps({"T_flange_camera": T_flange_camera.tolist(), "mounted": "on-arm"}))
    flange = (T_controller_scanner @ inverse(T_flange_camera))[:3].ravel()
    by_hand_eye = ["--hand-eye", str(camera), "--rotation", "matrix", "--robot-pose", *map(str, flange)]
    common = ["--robot", name, "--program", form, "--table-top", table]
    for where in (["--scanner-pose", str(bare), "--base", "controller"], ["--scanner-pose", str(stated)], by_hand_eye):
        job = robot_job(options(*common, *where))
        np.testing.assert_allclose(job.T_base_scanner, T_BASE_SCANNER, atol=1e-9)
        assert job.table_top_mm == pytest.approx(-200)
    with pytest.raises(InputError, match=r"shows poses in another base.*--base controller, or --base model"):
        robot_job(options(*common, "--scanner-pose", str(bare)))
    with pytest.raises(InputError, match="leave --base out"):
        robot_job(options(*common, *by_hand_eye, "--base", "model"))
    (question,) = where_it_stood(None, of_model)
    assert f"({T_controller_scanner[0, 3]:.0f}, " in question


def test_the_groove_door_writes_the_programme_or_nothing(tmp_path, capsys):
    scene = weld_scene("line", np.random.default_rng(3), every=2)
    np.save(tmp_path / "cloud.npy", scene.points)
    T_base_piece = rigid([[0, -1, 0], [1, 0, 0], [0, 0, 1]], [300.0, 0.0, 12.0])
    (tmp_path / "pose.json").write_text(json.dumps((T_base_piece @ scene.scan.T_world_scanner).tolist()))
    words = ["groove", str(tmp_path / "cloud.npy"), "-o", str(tmp_path / "out"), "--robot", "ur3"]
    words += ["--scanner-pose", str(tmp_path / "pose.json"), "--base", "model", "--program", "urscript"]
    assert main([*words, "--table-top", "30"]) == 2
    assert "behind the table" in capsys.readouterr().err and not (tmp_path / "out").exists()
    assert main(words) == 0
    script = (tmp_path / "out" / "program.script").read_text()
    assert script.startswith("def follow_seam():") and script.endswith("\nend\n") and script.count("movep(") >= 49
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["motion"]["robot"] == "ur3" and report["motion"]["clearance_mm"] > 2.0
    assert report["timings_s"]["motion"] > 0 and report["parameters"]["program"] == "urscript"


def test_sending_is_asked_for_and_never_by_chance(pose):
    common = ["--robot", "ur3", "--scanner-pose", pose]
    with pytest.raises(InputError, match="--yes is for sending"):
        robot_job(options(*common, "--yes"))
    with pytest.raises(InputError, match="--send hands URScript over, not csv"):
        robot_job(options(*common, "--send", "10.0.0.2"))
    with pytest.raises(InputError, match="--send is for a robot's programme"):
        robot_job(options("--send", "10.0.0.2"))


def calibrated_cell(folder):
    """A UR3 whose table was measured with a tracker and corrected by ``calibrate``: the corrected table's file."""
    table = [[0, 0, 151.9, 0, 0], [np.pi / 2, 0, 0, 0, 0], [0, -243.65, 0, 0, 0], [0, -213.25, 112.35, 0, 0]]
    table += [[np.pi / 2, 0, 85.35, 0, 0], [-np.pi / 2, 0, 81.9, 0, 0]]
    nominal = MdhArm(table, tuple(f"J{i}" for i in range(1, 7)), limits=np.tile([-2 * np.pi, 2 * np.pi, 3.14], (6, 1)))
    made = rig(nominal, np.random.default_rng(0), rows=60, on_tool=True, off_mm=0.3, off_rad=3e-4)
    rows = np.hstack([made.measurements.q_rad, made.measurements.tracker_mm])
    names = [*(f"q{i}_rad" for i in range(1, 7)), "bx_mm", "by_mm", "bz_mm"]
    np.savetxt(folder / "m.csv", rows, delimiter=",", header=",".join(names), comments="")
    write_arm(nominal, folder / "r.csv")
    words = ["--robot", str(folder / "r.csv"), "-o", str(folder / "cell"), "--beyond-geometry", "off"]
    assert main(["calibrate", str(folder / "m.csv"), *words]) == 0
    return folder / "cell" / "robot.csv"


def test_the_table_that_calibrate_writes_is_a_robot_to_weld_with(pose, tmp_path):
    arm_file = calibrated_cell(tmp_path)
    positions, normals = seam(points=15)
    T_scanner_base = inverse(T_BASE_SCANNER)
    trajectory = tool_trajectory(move_points(T_scanner_base, positions), rotate_vectors(T_scanner_base, normals))
    job = robot_job(options("--robot", str(arm_file), "--scanner-pose", pose))
    work = np.random.default_rng(0).uniform([250, -90, 20], [370, 90, 45], (3000, 3))
    assert job.write(job.plan(trajectory, move_points(T_scanner_base, work)), tmp_path / "out") == "program.csv"


@pytest.mark.parametrize(
    ("robot", "form", "names"),
    [
        ("irb1200_5_90", "rapid", ["prog_arc.mod", "program.mod"]),
        ("kr6_r900", "krl", ["prog_arc.dat", "prog_arc.src", "program.dat", "program.src"]),
        ("lrmate200id", "ls", ["prog_arc.ls", "program.ls"]),
        ("ur5e", "urscript", ["prog_arc.script", "program.script"]),
    ],
)
def test_a_hot_run_is_written_beside_the_dry_one(pose, tmp_path, robot, form, names):
    output = "doArc" if form == "rapid" else "5"
    words = ("--robot", robot, "--program", form, "--scanner-pose", pose, "--torch-speed", "10")
    job = robot_job(options(*words, "--arc", "--arc-output", output))
    positions, normals = seam(points=6, centre=(430.0, 0.0, 90.0))
    T_scanner_base = inverse(T_BASE_SCANNER)
    trajectory = tool_trajectory(move_points(T_scanner_base, positions), rotate_vectors(T_scanner_base, normals))
    work = np.random.default_rng(0).uniform([400, -90, 20], [460, 90, 60], (300, 3))
    motion = job.plan(trajectory, move_points(T_scanner_base, work))
    job.write(motion, tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == names
    text = {path.name: path.read_bytes().decode("ascii") for path in (tmp_path / "out").iterdir()}
    switch = {"rapid": "SetDO doArc,1", "krl": "$OUT[5]=TRUE", "ls": "DO[5]=ON"}.get(form, "digital_out(5, True)")
    assert sum(switch in one for name, one in text.items() if name.startswith("prog_arc")) == 1
    assert not any(switch in one for name, one in text.items() if name.startswith("program"))


def test_wishes_for_an_arc_are_refused_in_one_line_before_any_work(pose, tmp_path):
    here = ("--scanner-pose", pose)
    for words, message in (
        (("--robot", "ur3", "--arc-output", "5"), "--arc-output is for a hot run; give --arc as well"),
        (("--robot", "ur3", "--arc", "--arc-output", "5"), "--arc needs a language that can set outputs"),
        (("--robot", "gp7", "--program", "jbi", "--arc"), "needs the digital output that strikes the arc"),
        (("--robot", "gp7", "--program", "krl"), "gp7 is an arm of Yaskawa; it takes --program jbi, not krl"),
        (("--robot", "ur3", "--program", "rapid"), "the axes 4, 5 and 6 of ur3 miss one point"),
        (("--robot", "gp7", "--program", "jbi", "--arc", "--arc-output", "arc"), "JBI counts its outputs"),
        (
            ("--robot", "gp7", "--program", "jbi", "--arc", "--arc-output", "5", "--arc-setpoint", "1=x"),
            "--arc-setpoint 1=x: give NAME=VALUE",
        ),
        (
            ("--robot", "ur3", "--program", "urscript", "--send", "10.0.0.2", "--arc", "--arc-output", "5"),
            "--send hands the dry run over",
        ),
        (("--robot", "gp7", "--stick-out", "80"), "--stick-out is 80 mm; give 5 to 50"),
    ):
        with pytest.raises(InputError, match=re.escape(message)):
            robot_job(options(*words, *here))
    torch = tmp_path / "torch.json"
    for content, message in (
        ({"tcp": 1}, "no key T_flange_tcp; found tcp"),
        ({"T_flange_tcp": rigid(translation_mm=[0, 0, 0.3]).tolist()}, "metres\\? give millimetres"),
        ({"T_flange_tcp": rigid(translation_mm=[0, 0, 50]).tolist()}, "is shorter than its parts"),
        ({"T_flange_tcp": rigid(translation_mm=[300, 0, -50]).tolist()}, "50 mm behind the flange"),
    ):
        torch.write_text(json.dumps(content))
        with pytest.raises(GrindvisionError, match=message):
            robot_job(options("--robot", "gp7", "--tool", str(torch), *here))


def test_a_torch_from_a_file_carries_its_tip_and_a_body_up_to_the_nozzle(pose, tmp_path):
    tip = rigid(Rotation.from_euler("y", 35, degrees=True).as_matrix(), [70.0, 5.0, 330.0])
    torch = tmp_path / "torch.json"
    torch.write_text(json.dumps({"T_flange_tcp": tip.tolist()}))
    tool = robot_job(
        options("--robot", "gp7", "--tool", str(torch), "--scanner-pose", pose, "--stick-out", "20")
    ).robot.tool
    np.testing.assert_allclose(tool.T_flange_tool, tip)
    (start, bend, _), (again, nozzle, radius_mm) = tool.capsules
    assert start == (0, 0, 0) and bend == again
    assert np.linalg.norm(np.subtract(nozzle, tip[:3, 3])) == pytest.approx(20 + radius_mm)
    straight = robot_job(options("--robot", "ur3", "--scanner-pose", pose)).robot.tool
    assert straight == welding_torch()  # today's torch, unless another is asked for
