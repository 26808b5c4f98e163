"""What the four tools share: parameters from a file, a report that says all, JSON for machines, a bar for people."""

import argparse
import fcntl
import hashlib
import json
import os
import pty
import struct
import subprocess
import sys
import termios
import time

import numpy as np
import pandas as pd
import pytest

from grindvision.cli import COMMANDS, main
from grindvision.clouds import write_ply
from tests.calibration_rig import as_table, er3a, rig
from tests.groove_scenes import straight_groove

TOOLS = ("detect", "groove", "calibrate", "calibrate-field", "simulate")


@pytest.fixture
def scan(tmp_path, rng):
    write_ply(tmp_path / "cloud.ply", straight_groove(rng, spacing_mm=1.2)[0])
    return tmp_path / "cloud.ply"


def run(capsys, *words):
    code = main([str(word) for word in words])
    said = capsys.readouterr()
    return code, said.out, said.err


def rows(out):
    return len(pd.read_csv(out / "trajectory.csv"))


def test_the_command_line_goes_before_the_file_and_the_file_before_the_defaults(scan, tmp_path):
    (tmp_path / "p.toml").write_text("waypoints = 12\nviewpoint = [0.0, 0.0, -1e-3]\n")
    words = ["groove", str(scan), "--parameters", str(tmp_path / "p.toml")]
    assert main([*words, "-o", str(tmp_path / "file")]) == 0
    assert main([*words, "-o", str(tmp_path / "line"), "--waypoints", "7"]) == 0
    assert main(["groove", str(scan), "-o", str(tmp_path / "default")]) == 0
    assert [rows(tmp_path / name) for name in ("file", "line", "default")] == [12, 7, 50]
    report = json.loads((tmp_path / "line" / "report.json").read_text())
    assert report["parameters"]["waypoints"] == 7
    assert report["parameters"]["viewpoint"] == [0, 0, -0.001]


def test_negative_numbers_with_exponents_are_numbers(scan, tmp_path):
    words = ["groove", str(scan), "--viewpoint", "-1e-3", "-2E+1", "-.5", "-o", str(tmp_path / "out")]
    assert main(words) == 0
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["parameters"]["viewpoint"] == [-0.001, -20, -0.5]


def test_the_parameters_written_give_the_same_result_again(scan, tmp_path):
    first, again = tmp_path / "first", tmp_path / "again"
    assert main(["groove", str(scan), "-o", str(first), "--waypoints", "9", "--width", "11.5", "--unit", "mm"]) == 0
    assert main(["groove", str(scan), "-o", str(again), "--parameters", str(first / "parameters.toml")]) == 0
    for name in ("trajectory.csv", "labels.npy", "report.png", "parameters.toml"):
        assert (first / name).read_bytes() == (again / name).read_bytes(), name
    assert "# spacing_mm = " in (first / "parameters.toml").read_text()


def test_a_tracked_arm_runs_again_from_its_parameters(tmp_path, rng):
    made = rig(er3a(), rng, rows=80, on_tool=True, off_mm=0, off_rad=0)
    table = as_table(made.measurements, split=False).drop(columns=["pose", "sphere", "sx_mm", "sy_mm", "sz_mm"])
    for i in range(1, 5):
        table[f"joint {i}"] = np.degrees(table.pop(f"q{i}_rad"))
    table.to_csv(tmp_path / "log.csv", index=False)
    head = "joint,alpha_deg,a_m,d_m,theta_deg,beta_deg\n"
    numbers = er3a().table * [180 / np.pi, 1e-3, 1e-3, 180 / np.pi, 180 / np.pi]
    lines = [f"J{i},{','.join(map(repr, row.tolist()))}" for i, row in enumerate(numbers)]
    (tmp_path / "robot.csv").write_text(head + "\n".join(lines))
    words = ["calibrate", str(tmp_path / "log.csv")]
    columns = [f"q{i}_deg=joint {i}" for i in range(1, 5)]
    more = ["--robot", str(tmp_path / "robot.csv"), "--train", "60", "--seed", "3", "--columns", *columns]
    assert main([*words, *more, "-o", str(tmp_path / "first")]) == 0
    parameters = str(tmp_path / "first" / "parameters.toml")
    assert main([*words, "--parameters", parameters, "-o", str(tmp_path / "again")]) == 0
    for name in ("robot.csv", "hand_eye.json", "report.png"):
        assert (tmp_path / "first" / name).read_bytes() == (tmp_path / "again" / name).read_bytes(), name
    report = json.loads((tmp_path / "again" / "report.json").read_text())
    assert report["held_out"] == "20 test rows, the others than 60 drawn to train, seed 3"
    assert report["errors_mm"]["test"]["after"]["mean"] < 0.2
    assert report["from_the_data"]["measured point"] == "reflector on the tool, found"
    assert [entry["name"] for entry in report["inputs"]] == ["log.csv", "robot.csv"]


def test_json_is_the_report_and_nothing_else(scan, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(time, "perf_counter", time.process_time)  # what others do meanwhile takes no time
    code, text, error = run(capsys, "groove", scan, "-o", tmp_path / "out", "--json")
    assert code == 0 and error == ""
    assert text == (tmp_path / "out" / "report.json").read_text()
    report = json.loads(text)
    assert set(report["files"]) == {path.name for path in (tmp_path / "out").iterdir()}
    times = report["timings_s"]
    assert times["total"] == max(times.values())
    assert sum(value for name, value in times.items() if name != "total") == pytest.approx(times["total"], rel=0.1)
    assert {"read", "detect", "path", "picture", "write", "hash"} < set(times)
    assert {"grindvision", "python", "numpy"} <= set(report["versions"])
    assert report["inputs"] == [{"name": "cloud.ply", "sha256": hashlib.sha256(scan.read_bytes()).hexdigest()}]
    code, text, error = run(capsys, "groove", tmp_path / "absent.ply", "-o", tmp_path / "out", "--json")
    assert (code, text) == (2, "") and error.count("\n") == 1


def test_simulations_report_too(tmp_path, capsys):
    code, text, _ = run(capsys, "simulate", "calibration", "-o", tmp_path, "--json", "--seed", 4)
    report = json.loads(text)
    assert code == 0 and report["seed"] == 4 and report["origin"] == "synthetic"
    assert (tmp_path / "report.png").stat().st_size > 10_000
    assert "seed = 4" in (tmp_path / "parameters.toml").read_text()


@pytest.mark.parametrize("tool", TOOLS)
def test_help_tells_defaults_files_exit_codes_and_examples(tool, capsys):
    with pytest.raises(SystemExit) as stop:
        main([tool, "--help"])
    text = " ".join(capsys.readouterr().out.split())
    assert stop.value.code == 0
    assert "results in DIR" in text and "exit code: 0 done" in text and f"examples: grindvision {tool}" in text
    assert "(default" in text and COMMANDS[tool][1:] in text


def test_near_names_of_options_are_not_guessed(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["groove", "a.ply", "-o", "x", "--param", "p.toml"])
    assert stop.value.code == 2 and "unrecognized" in capsys.readouterr().err


def terminal_of(code):
    """What a Python program writes to stderr where that is a terminal of 24 x 100."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 100, 0, 0))
    process = subprocess.Popen([sys.executable, "-c", code], stderr=theirs, stdout=subprocess.DEVNULL)
    os.close(theirs)
    seen = b""
    try:
        while part := os.read(ours, 4096):
            seen += part
    except OSError:  # the other end is closed
        pass
    os.close(ours)
    assert process.wait() == 0
    return seen.decode()


def test_a_bar_appears_on_a_terminal_when_it_takes_a_while():
    code = (
        "import threading, tqdm\nfrom grindvision.cli import progress\nprogress.PATIENCE_S = {}\n"
        "told, shown = tqdm.tqdm.set_description_str, threading.Event()\n"
        "tqdm.tqdm.set_description_str = lambda *words: (told(*words), shown.set())\n"
        "bar = progress.Progress(2)\nbar.finished('read')\nshown.wait({})\nbar.close()\n"
    )
    seen = terminal_of(code.format(0.05, 600))
    assert "read done" in seen and "1 of 2 stages" in seen
    assert terminal_of(code.format(600, 0.3)) == ""


def test_without_a_terminal_there_is_no_bar(monkeypatch, capsys):
    from grindvision.cli import progress

    monkeypatch.setattr(progress, "PATIENCE_S", 0.0)
    monkeypatch.setattr("grindvision.cli.progress.time.sleep", lambda _: None)
    bar = progress.Progress(1)
    bar.close()
    assert capsys.readouterr().err == ""


def test_an_arm_from_a_table_carries_the_torch(tmp_path, capsys):
    from grindvision.cli.robot_job import add_robot_arguments, robot_job

    numbers = er3a().first(2).table.tolist()
    lines = [f"J{i},{','.join(map(repr, row))},-170,170,3" for i, row in enumerate(numbers, 1)]
    head = "joint,alpha_rad,a_mm,d_mm,theta_rad,beta_rad,lower_deg,upper_deg,speed_rad_s\n"
    (tmp_path / "arm.csv").write_text(head + "\n".join(lines))
    (tmp_path / "pose.json").write_text(json.dumps(np.eye(4).tolist()))
    parser = argparse.ArgumentParser()
    add_robot_arguments(parser)
    options = parser.parse_args(["--robot", str(tmp_path / "arm.csv"), "--scanner-pose", str(tmp_path / "pose.json")])
    robot = robot_job(options).robot
    assert robot.joints == ("J1", "J2") and robot.name == "arm"
    assert robot.limits.upper_rad == pytest.approx(np.radians([170, 170]))
    words = ["groove", "absent.ply", "-o", tmp_path / "out", "--scanner-pose", tmp_path / "pose.json", "--robot"]
    (tmp_path / "bare.csv").write_text("joint,alpha_rad,a_mm,d_mm,theta_rad,beta_rad\nJ1,0,0,300,0,0\n")
    code, _, error = run(capsys, *words, tmp_path / "bare.csv")
    assert code == 2 and "column lower_rad, upper_rad, speed_rad_s missing" in error


def test_a_calibrated_field_is_used_by_both_doors_for_clouds(tmp_path, capsys, rng):
    def bend(points):
        return points * (1 + 0.004 * np.cos(points[:, :1] / 30))

    u, v = (part.ravel() for part in np.meshgrid(np.linspace(-0.3, 0.3, 150), np.linspace(-0.2, 0.2, 100)))
    rays = np.column_stack([u, v, np.ones(u.size)])
    for k, distance in enumerate((440.0, 460.0, 480.0)):
        write_ply(tmp_path / f"p{k}.ply", np.vstack([np.zeros(3), bend(rays * distance)]))
    plates = [tmp_path / f"p{k}.ply" for k in range(3)]
    steps = ("--steps-mm", 0, 20, 40, "--distance-mm", 440)
    code, text, error = run(capsys, "calibrate-field", *plates, *steps, "-o", tmp_path / "camera", "--json")
    report = json.loads(text)
    assert code == 0 and error == "" and len(report["inputs"]) == 3
    assert report["held_out_rms_mm"]["after"] < 0.2 * report["held_out_rms_mm"]["before"]
    assert report["files"] == ["field.npz", "parameters.toml", "report.png", "report.json"]

    true, _ = straight_groove(rng)
    true = true + [0, 0, 460 - true[:, 2].mean()]
    write_ply(tmp_path / "true.ply", true)
    write_ply(tmp_path / "bent.ply", bend(true))
    field = ("--field-correction", tmp_path / "camera" / "field.npz")
    deep = {}
    for name, more in (("true", ()), ("bent", ()), ("bent", field)):
        out = tmp_path / f"{name}{len(more)}"
        assert run(capsys, "groove", tmp_path / f"{name}.ply", *more, "-o", out)[0] == 0
        deep[out.name] = pd.read_csv(out / "trajectory.csv")["z_mm"].mean()
    assert abs(deep["bent2"] - deep["true0"]) < 0.1 < abs(deep["bent0"] - deep["true0"])

    for door, clouds, option in (
        ("groove", [tmp_path / "bent.ply"], "--viewpoint"),
        ("detect", [tmp_path / "bent.ply", tmp_path / "true.ply"], "--test-viewpoint"),
    ):
        code, _, error = run(capsys, door, *clouds, *field, option, 0, 0, 900, "-o", tmp_path / "none")
        assert code == 2 and "scanner's own frame" in error
    code, _, error = run(capsys, "calibrate-field", *plates, "-o", tmp_path / "none")
    assert code == 2 and "--steps-mm is missing" in error
    code, _, error = run(capsys, "calibrate-field", *plates[:2], "--steps-mm", 0, 20, "-o", tmp_path / "two")
    assert code == 0 and "scan at least three" in error
