import argparse
import json

import numpy as np
import pytest

from grindvision.arm import MdhArm, write_arm
from grindvision.cell import weld_scene
from grindvision.cli import main
from grindvision.cli.robot_job import add_robot_arguments, motion_facts, robot_job
from grindvision.errors import FileError, InputError, NotRigidError
from grindvision.geometry import inverse, move_points, rigid, rotate_vectors
from grindvision.motion import tool_trajectory
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
    path.write_text(json.dumps({"T_base_scanner": T_BASE_SCANNER.tolist()}))
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


def test_the_groove_door_writes_the_programme_or_nothing(tmp_path, capsys):
    scene = weld_scene("line", np.random.default_rng(3), every=2)
    np.save(tmp_path / "cloud.npy", scene.points)
    T_base_piece = rigid([[0, -1, 0], [1, 0, 0], [0, 0, 1]], [300.0, 0.0, 12.0])
    (tmp_path / "pose.json").write_text(json.dumps((T_base_piece @ scene.scan.T_world_scanner).tolist()))
    words = ["groove", str(tmp_path / "cloud.npy"), "-o", str(tmp_path / "out"), "--robot", "ur3"]
    words += ["--scanner-pose", str(tmp_path / "pose.json"), "--program", "urscript"]
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


def test_the_table_that_calibrate_writes_is_a_robot_to_weld_with(pose, tmp_path):
    table = [[0, 0, 151.9, 0, 0], [np.pi / 2, 0, 0, 0, 0], [0, -243.65, 0, 0, 0], [0, -213.25, 112.35, 0, 0]]
    table += [[np.pi / 2, 0, 85.35, 0, 0], [-np.pi / 2, 0, 81.9, 0, 0]]
    nominal = MdhArm(table, tuple(f"J{i}" for i in range(1, 7)), limits=np.tile([-2 * np.pi, 2 * np.pi, 3.14], (6, 1)))
    made = rig(nominal, np.random.default_rng(0), rows=60, on_tool=True, off_mm=0.3, off_rad=3e-4)
    rows = np.hstack([made.measurements.q_rad, made.measurements.tracker_mm])
    names = [*(f"q{i}_rad" for i in range(1, 7)), "bx_mm", "by_mm", "bz_mm"]
    np.savetxt(tmp_path / "m.csv", rows, delimiter=",", header=",".join(names), comments="")
    write_arm(nominal, tmp_path / "r.csv")
    words = ["--robot", str(tmp_path / "r.csv"), "-o", str(tmp_path / "cell"), "--beyond-geometry", "off"]
    assert main(["calibrate", str(tmp_path / "m.csv"), *words]) == 0
    positions, normals = seam(points=15)
    T_scanner_base = inverse(T_BASE_SCANNER)
    trajectory = tool_trajectory(move_points(T_scanner_base, positions), rotate_vectors(T_scanner_base, normals))
    job = robot_job(options("--robot", str(tmp_path / "cell" / "robot.csv"), "--scanner-pose", pose))
    work = np.random.default_rng(0).uniform([250, -90, 20], [370, 90, 45], (3000, 3))
    assert job.write(job.plan(trajectory, move_points(T_scanner_base, work)), tmp_path / "out") == "program.csv"
