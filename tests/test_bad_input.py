"""The law of every door: done with a sane result, or exit 2 with one line that says what was wrong; nothing in between.

No traceback, no half-written file, no silent wrong answer, whatever the input. ``obeys`` is that law.
"""

import json
import os
import resource
import signal
import struct
import subprocess
import sys
import tracemalloc
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from grindvision.cli import main
from grindvision.clouds import read_cloud
from grindvision.errors import GrindvisionError
from grindvision.geometry import move_points
from grindvision.result_set import LOCK, write_set
from tests.doors_law import (  # noqa: F401
    CLOUDS,
    ENDLESS,
    PATIENCE_S,
    command,
    good,
    obeys,
    quickly,
    root_is_right,
    wait_for,
)

pytestmark = pytest.mark.usefixtures("blank_pictures")

# Files that are cut, and files whose bytes were changed


@pytest.mark.parametrize("name", CLOUDS)
def test_every_format_says_the_same(good, obeys, name):
    code, _, out = obeys("groove", good / name, "--waypoints", 9)
    assert code == 0 and root_is_right(out)


@settings(quickly, max_examples=60)
@given(name=st.sampled_from(CLOUDS), share=st.floats(0, 1, exclude_max=True))
def test_a_file_cut_anywhere(good, obeys, tmp_path, name, share):
    data = (good / name).read_bytes()
    (tmp_path / name).write_bytes(data[: int(share * len(data))])
    code, error, out = obeys("groove", tmp_path / name, "--waypoints", 9)
    assert code == 2 or root_is_right(out)
    if name.endswith((".ply", ".pcd", ".npy", ".npz", ".stl")):
        assert code == 2 and name in error


@settings(quickly, max_examples=80)
@given(
    name=st.sampled_from(CLOUDS),
    changes=st.lists(st.tuples(st.integers(0, 420), st.integers(0, 255)), min_size=1, max_size=5),
)
def test_changed_bytes_in_the_header(good, tmp_path, name, changes):
    data = bytearray((good / name).read_bytes()[:6000])
    for at, value in changes:
        data[at] = value
    path = tmp_path / name
    path.write_bytes(bytes(data))
    tracemalloc.start()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            cloud = read_cloud(path)
        assert cloud.points.ndim == 2 and cloud.points.shape[1] == 3 and 0 < len(cloud) < 2_000_000
    except GrindvisionError as error:
        assert "\n" not in str(error) and name in str(error)
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert peak < 150e6


TABLES = {"m.csv": 6000, "r.csv": 1000}


@settings(quickly, max_examples=25)
@given(name=st.sampled_from(sorted(TABLES)), share=st.floats(0, 1, exclude_max=True))
def test_a_table_cut_anywhere(good, obeys, tmp_path, name, share):
    for table in TABLES:
        (tmp_path / table).write_bytes((good / table).read_bytes())
    data = (good / name).read_bytes()
    (tmp_path / name).write_bytes(data[: int(share * len(data))])
    code, _, out = obeys("calibrate", tmp_path / "m.csv", "--robot", tmp_path / "r.csv")
    if code == 0:
        assert json.loads((out / "report.json").read_text())["errors_mm"]["train"]["after"]["mean"] < 1


# Numbers that are none, too few, too far, or in another unit


def shapes(points):
    flat = np.column_stack([points[:, :2], np.zeros(len(points))])
    middle = points.mean(axis=0)
    yield "all_nan", np.full_like(points, np.nan), "NaN"
    yield "all_inf", np.full_like(points, np.inf), "NaN or infinity"
    yield "none", points[:0], "no points"
    yield "one", points[:1], "least"
    yield "one_place", np.repeat(points[:1], 600, axis=0), ""
    yield "two_places", np.repeat(points[:2], 600, axis=0), ""
    yield "a_line", np.outer(np.linspace(0, 300, 900), [1, 2, 3]), ""
    yield "a_plane", flat, ""
    yield "metres", points / 1000, "--unit m"
    yield "in_doubt", (points - middle) / np.linalg.norm(np.ptp(points, axis=0)) * 12, "--unit mm, cm, m or in"
    yield "micrometres", points * 1000, "mm across"
    yield "far_away", points + 1e7, "subtract the offset"
    yield "overflowing", points * 1e300, "mm across"
    yield "far_outlier", np.vstack([points, [[0, 0, 1e12]]]), "outliers"
    yield "noise", np.random.default_rng(0).normal(size=(3000, 3)) * 50, ""


SHAPES = [name for name, *_ in shapes(np.eye(3))]


@pytest.mark.parametrize(
    ("door", "name"),
    [
        pytest.param(door, name, marks=[pytest.mark.full] if (door, name) == ("detect", "noise") else [])
        for door in ("detect", "groove")
        for name in SHAPES
    ],
)
def test_clouds_that_cannot_be_used(good, obeys, tmp_path, door, name):
    cloud = good / ("test.ply" if door == "detect" else "a.ply")
    points, words = next((p, words) for one, p, words in shapes(read_cloud(cloud).points) if one == name)
    np.save(tmp_path / "bad.npy", points)
    scans = (good / "sample.ply", tmp_path / "bad.npy") if door == "detect" else (tmp_path / "bad.npy",)
    code, error, _ = obeys(door, *scans)
    assert code == 2 and words in error


@settings(quickly, max_examples=15)
@given(
    share=st.floats(0, 0.3),
    value=st.sampled_from([np.nan, np.inf, -np.inf]),
    copies=st.integers(0, 2),
    shift=st.sampled_from([0.0, 1e3, 1e5]),
    seed=st.integers(0, 99),
)
def test_what_remains_is_still_the_answer(good, obeys, tmp_path, share, value, copies, shift, seed):
    """Lost pixels, duplicates, another order and a far origin change nothing that matters."""
    rng = np.random.default_rng(seed)
    points = read_cloud(good / "a.ply").points + shift
    points[rng.random(len(points)) < share] = value
    points = rng.permutation(np.repeat(points, copies + 1, axis=0))
    np.save(tmp_path / "a.npy", points)
    code, _, out = obeys("groove", tmp_path / "a.npy", "--waypoints", 9)
    assert code == 0 and root_is_right(out)
    assert np.load(out / "labels.npy").shape == (len(points),)


def test_duplicates_and_a_far_origin_do_not_move_the_registration(good, obeys, tmp_path):
    shift = np.array([4e4, -2e4, 3e4])
    for name in ("sample", "test"):
        points = read_cloud(good / f"{name}.ply").points
        np.save(tmp_path / f"{name}.npy", np.repeat(points, 2, axis=0) + shift)
    code, _, out = obeys("detect", tmp_path / "sample.npy", tmp_path / "test.npy")
    assert code == 0
    found = np.array(json.loads((out / "report.json").read_text())["T_sample_test"])
    places = read_cloud(good / "test.ply").points[::100]
    truth = move_points(np.load(good / "T_sample_test.npy"), places)
    assert np.linalg.norm(move_points(found, places + shift) - shift - truth, axis=1).max() < 0.5


# Tables of measurements and of robots


MEASUREMENTS = {
    "text": (lambda t: t.assign(sx_mm=t["sx_mm"].astype(object).where(t.index != 3, "far")), "row 4, column sx_mm"),
    "nan": (lambda t: t.assign(by_mm=t["by_mm"].where(t.index != 2)), "row 3, column by_mm"),
    "inf": (lambda t: t.assign(q2_rad=t["q2_rad"].where(t.index != 2, np.inf)), "row 3, column q2_rad"),
    "huge": (lambda t: t.assign(bx_mm=t["bx_mm"].where(t.index != 2, 1e300)), ""),
    "column": (lambda t: t.rename(columns={"bz_mm": "z_tracker"}), "column bz_mm missing"),
    "joints": (lambda t: t.drop(columns="q4_rad"), "3 columns of joint angles"),
    "no_joints": (lambda t: t.drop(columns=[f"q{i}_rad" for i in range(1, 5)]), "--columns q1_deg=joint_1"),
    "degrees": (lambda t: t.assign(**{f"q{i}_rad": np.degrees(t[f"q{i}_rad"]) for i in range(1, 5)}), "degrees"),
    "metres": (lambda t: t.assign(**{f"b{a}_mm": t[f"b{a}_mm"] / 1000 for a in "xyz"}), "metres"),
    "no_rows": (lambda t: t[:0], "no rows"),
    "one_row": (lambda t: t[:1], "measurements give"),
    "copies": (lambda t: t.iloc[np.zeros(60, dtype=int)], "different training measurements"),
    "split": (lambda t: t.assign(split="valid"), "write train or test"),
    "shuffled": (lambda t: t.assign(bx_mm=np.random.default_rng(0).permutation(t["bx_mm"])), ""),
    "constant": (lambda t: t.assign(bx_mm=0.0, by_mm=0.0, bz_mm=0.0), ""),
}


@pytest.mark.parametrize("case", MEASUREMENTS)
def test_measurements_that_cannot_be_used(good, obeys, tmp_path, case):
    change, words = MEASUREMENTS[case]
    change(pd.read_csv(good / "m.csv")).to_csv(tmp_path / "m.csv", index=False)
    code, error, _ = obeys("calibrate", tmp_path / "m.csv", "--robot", good / "r.csv")
    assert code == 2 and words in error


ROBOTS = {
    "absent": (None, "no such file"),
    "words": ("hello", "no rows"),
    "degrees": ("joint,alpha_rad,a_mm,d_mm,theta_rad,beta_rad\nJ1,0,0,321,0,0\nJ2,90,50,0,0,0\n", "degrees"),
    "metres": (
        "joint,alpha_rad,a_mm,d_mm,theta_rad,beta_rad\nJ1,0,0,.32,0,0\nJ2,1.57,.05,0,0,0\nJ3,0,.3,0,0,0\nJ4,0,.2,0,0,0\n",
        "a_m and d_m",  # of up to three joints it may be a positioner whose axes nearly meet
    ),
    "text": ("joint,alpha_rad,a_mm,d_mm,theta_rad,beta_rad\nJ1,0,0,tall,0,0\n", "row 1, column d_mm: 'tall'"),
    "no_urdf": ("<robot>\n</robot>", "column"),
}


@pytest.mark.parametrize("case", ROBOTS)
def test_robots_that_cannot_be_used(good, obeys, tmp_path, case):
    text, words = ROBOTS[case]
    if text is not None:
        (tmp_path / "r.csv").write_text(text)
    code, error, _ = obeys("calibrate", good / "m.csv", "--robot", tmp_path / "r.csv")
    assert code == 2 and words in error and "r.csv" in error


NUMBERS = st.one_of(st.floats(-2e3, 2e3), st.sampled_from([0.0, 1.0, np.nan, np.inf, 1e308]), st.integers(-(10**30), 9))
JSON = st.recursive(
    st.one_of(NUMBERS, st.none(), st.booleans(), st.text(max_size=5)),
    lambda inner: st.one_of(st.lists(inner, max_size=5), st.dictionaries(st.text(max_size=5), inner, max_size=3)),
    max_leaves=20,
)
MATRICES = st.lists(st.lists(NUMBERS, min_size=4, max_size=4), min_size=4, max_size=4)


@settings(quickly, max_examples=120)
@given(content=st.one_of(JSON, MATRICES, st.fixed_dictionaries({"T_base_scanner": st.one_of(JSON, MATRICES)})))
def test_a_pose_that_is_no_rigid_motion_is_refused_before_any_work(good, obeys, tmp_path, content):
    (tmp_path / "pose.json").write_text(json.dumps(content))
    code, error, _ = obeys("detect", good / "absent.ply", good / "test.ply", "--scanner-pose", tmp_path / "pose.json")
    assert code == 2
    assert "pose.json" in error


# Parameters from a file


WORDS = st.sampled_from(
    ["points", "seed", "unit", "scanner-pose", "sample_viewpoint", "pionts", "output", "json", "x y"]
)
VALUES = st.one_of(NUMBERS, st.booleans(), st.text(max_size=8), st.lists(NUMBERS, max_size=4), st.just("cm"))


@settings(quickly, max_examples=120)
@given(content=st.dictionaries(WORDS, VALUES, min_size=1, max_size=3))
def test_parameters_of_any_kind(good, obeys, tmp_path, content):
    lines = [
        f"{json.dumps(key)} = {json.dumps(value).replace('NaN', 'nan').replace('Infinity', 'inf')}"
        for key, value in content.items()
    ]
    (tmp_path / "p.toml").write_text("\n".join(lines))
    code, _, _ = obeys("detect", good / "absent.ply", good / "test.ply", "--parameters", tmp_path / "p.toml")
    assert code == 2


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("waypionts = 9", "did you mean waypoints?"),
        ("waypoints = '9'", "waypoints is '9'; write a whole number"),
        ("waypoints = 9.5", "write a whole number"),
        ("unit = 'inch'", "choose from mm, cm, m, in"),
        ("viewpoint = [1, 2]", "give 3 values"),
        ("viewpoint = [1, 2, inf]", "write a number"),
        ("output = 'x'", "'output' is no parameter"),
        ("waypoints = ", "not a readable TOML file"),
        ("a = " + "[" * 50_000, "not a readable TOML file"),
        ("waypoints = 1", "--waypoints is 1; give at least 2"),
    ],
)
def test_parameters_that_are_refused(good, obeys, tmp_path, text, words):
    (tmp_path / "p.toml").write_text(text)
    code, error, _ = obeys("groove", good / "a.ply", "--parameters", tmp_path / "p.toml")
    assert code == 2 and words in error


# Files that lie about their size, or point elsewhere


def lying_files():
    ply = "ply\nformat {} 1.0\nelement vertex 1000000000000\nproperty float x\nproperty float y\nproperty float z\n"
    for form in ("ascii", "binary_little_endian", "binary_big_endian"):
        yield f"{form}.ply", (ply.format(form) + "end_header\n").encode() + bytes(60)
    head = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 1000000\nHEIGHT 1000000\n"
    for form in ("ascii", "binary", "binary_compressed"):
        yield f"{form}.pcd", f"{head}POINTS 1000000000000\nDATA {form}\n".encode() + b"\xff" * 60
    yield "a.stl", bytes(80) + struct.pack("<I", 4_000_000_000) + bytes(60)
    npy = b"\x93NUMPY\x01\x00v\x00" + b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000, 3), }"
    yield "a.npy", npy.ljust(127) + b"\n" + bytes(60)


@pytest.mark.parametrize("name", [name for name, _ in lying_files()])
def test_a_small_file_that_announces_a_million_million_points(good, obeys, tmp_path, name):
    (tmp_path / name).write_bytes(dict(lying_files())[name])
    tracemalloc.start()
    code, error, _ = obeys("groove", tmp_path / name)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert code == 2 and "announces" in error and peak < 20e6


def test_an_archive_that_unpacks_without_end(obeys, tmp_path):
    with zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("points.npy", bytes(50_000_000))
    code, error, _ = obeys("groove", tmp_path / "bomb.npz")
    assert code == 2 and "unpack to 50000000" in error


def test_no_other_file_is_opened(good, obeys, tmp_path):
    """An audit hook sees every file that Python opens; the materials that an OBJ names are not among them."""
    (tmp_path / "a.obj").write_text("mtllib secret.mtl\nusemtl x\n" + (good / "a.obj").read_text())
    (tmp_path / "secret.mtl").write_text("newmtl x\nmap_Kd /etc/passwd\n")
    opened = []
    watching = [True]
    sys.addaudithook(lambda event, details: opened.append(str(details[0])) if watching and event == "open" else None)
    obeys("groove", tmp_path / "a.obj", "--waypoints", 9)
    watching.clear()
    assert any("a.obj" in name for name in opened)
    assert not any("secret" in name or "passwd" in name for name in opened)


# Folders that cannot be written to, and interrupts


def earlier_result(out):
    out.mkdir()
    for name in ("report.json", "trajectory.csv", "trajectory_2.csv", "mine.txt"):
        (out / name).write_text("old")


def entries(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize("door", ["detect", "groove", "calibrate", "simulate"])
def test_a_place_that_takes_no_files(good, tmp_path, door, capfd):
    words = {
        "detect": [good / "sample.ply", good / "test.ply"],
        "groove": [good / "a.ply"],
        "calibrate": [good / "m.csv", "--robot", good / "r.csv"],
        "simulate": ["calibration"],
    }[door]
    (tmp_path / "file").write_text("no folder")
    for place in (tmp_path / "file", tmp_path / "file" / "deeper", Path("/proc/nowhere")):
        assert main([door, *map(str, words), "-o", str(place)]) == 2
        error = capfd.readouterr().err
        assert "cannot write to" in error and error.count("\n") == 1
    assert entries(tmp_path) == {"file": b"no folder"}


def test_a_new_result_leaves_nothing_of_an_old_one_but_what_is_not_ours(good, tmp_path):
    out = tmp_path / "out"
    earlier_result(out)
    assert main(["groove", str(good / "a.ply"), "-o", str(out)]) == 0
    assert entries(out)["mine.txt"] == b"old" and "trajectory_2.csv" not in entries(out)
    assert entries(out)["trajectory.csv"] != b"old"


@pytest.mark.parametrize("stop", ["tool_trajectory", "draw", "sha256"])
@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(28, "No space left on device"), MemoryError()])
def test_a_run_that_breaks_off_changes_nothing(good, tmp_path, monkeypatch, capfd, stop, error):
    def broken(*_, **__):
        raise error

    home = {
        "tool_trajectory": "grindvision.motion.trajectory",
        "draw": "grindvision.cli.groove_picture",
        "sha256": "grindvision.cli.report",
    }[stop]
    monkeypatch.setattr(f"{home}.{stop}", broken)
    out = tmp_path / "out"
    earlier_result(out)
    before = entries(out)
    code = main(["groove", str(good / "a.ply"), "-o", str(out)])
    said = capfd.readouterr().err
    assert code == (130 if isinstance(error, KeyboardInterrupt) else 2)
    assert said.count("\n") == 1 and "defect" not in said
    assert entries(out) == before
    assert main(["groove", str(good / "a.ply"), "-o", str(tmp_path / "new" / "deep")]) == code
    assert not (tmp_path / "new").exists()


def test_a_full_disk(good, tmp_path):
    """No file may grow beyond 2 kB: the result does not fit."""
    limit = (2000, 2000)
    process = command(
        "groove",
        good / "a.ply",
        "-o",
        tmp_path / "out",
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, limit),
    )
    _, error = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 2, error
    assert error.count(b"\n") == 1 and b"cannot write" in error and b"free space" in error
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_in_the_middle(good, tmp_path, number):
    process = command(
        "detect", good / "sample.ply", good / "test.ply", "-o", tmp_path / "out", run=("-c", ENDLESS),
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # ignored in a shell's background
    )  # fmt: skip
    wait_for(lambda: list(tmp_path.glob("out/.grindvision-*/")), process)
    os.kill(process.pid, number)
    _, error = process.communicate(timeout=PATIENCE_S)
    assert error == b"grindvision detect: interrupted; nothing half-written is left\n"
    assert process.returncode == 128 + number
    assert list(tmp_path.iterdir()) == []


def test_a_reader_that_goes_away_and_a_full_terminal(good, tmp_path):
    with open("/dev/full", "wb") as full:
        process = subprocess.run(
            [sys.executable, "-m", "grindvision", "groove", good / "a.ply", "-o", tmp_path / "out"],
            stdout=full, stderr=subprocess.PIPE, timeout=PATIENCE_S, check=False,
        )  # fmt: skip
    assert process.returncode == 2
    assert process.stderr.count(b"\n") == 1 and b"No space left" in process.stderr


def test_a_set_of_files_appears_whole(tmp_path):
    with write_set(tmp_path / "out", "last.txt") as place:
        (place / "sub").mkdir()
        (place / "sub" / "a.txt").write_text("a")
        (place / "last.txt").write_text("b")
        assert {path.name for path in (tmp_path / "out").iterdir()} == {place.name, LOCK}
    assert sorted(str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*.txt")) == ["out/last.txt", "out/sub/a.txt"]
