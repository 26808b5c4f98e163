"""Every file is judged before it is opened, every set of results is whole, every end of a run is told by its code."""

import ctypes
import errno
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
import warnings
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from nbformat.v4 import new_code_cell, new_notebook, writes

from grindvision.cli import main
from grindvision.cli.scans import diagnose_pose, read_pose, read_scans
from grindvision.clouds import read_cloud, write_ply
from grindvision.errors import FileError, GrindvisionError, InputError, clipped, one_line
from grindvision.files import read_json, read_table, sha256, write_json
from grindvision.geometry import rigid
from grindvision.input_files import open_input, read_input
from grindvision.interrupts import Interrupted, ending_signals_interrupt, undisturbed
from grindvision.result_set import write_set
from grindvision_book.machinery.figures import markdown_table
from grindvision_book.machinery.one_at_a_time import only_build
from grindvision_book.studies.rows import RowsFile
from tests.doors_law import ENDLESS, PATIENCE_S, command, good, obeys, quickly, wait_for  # noqa: F401

pytestmark = pytest.mark.usefixtures("blank_pictures")

# What is no plain file


def other_things(folder):
    os.mkfifo(folder / "pipe")
    (folder / "folder").mkdir()
    (folder / "loop").symlink_to("loop")
    (folder / "to_pipe").symlink_to("pipe")
    (folder / "zero").symlink_to("/dev/zero")
    (folder / "terminal").symlink_to("/dev/tty")
    server = socket.socket(socket.AF_UNIX)
    with suppress(OSError):  # a path too long for a socket
        server.bind(str(folder / "socket"))
    return server


OTHERS = ["pipe", "to_pipe", "folder", "loop", "socket", "absent", "zero", "terminal", "n" * 300]


def doors(good, path):
    """Words of every command that opens a file, with ``path`` in its place."""
    cloud, sample, test = good / "a.ply", good / "sample.ply", good / "test.ply"
    yield "detect", path.with_name(path.name + ".ply"), test
    yield "detect", sample, test, "--scanner-pose", path
    yield "detect", sample, test, "--parameters", path
    yield "detect", sample, test, "--field-correction", path
    yield "groove", path.with_name(path.name + ".xyz")
    yield "groove", cloud, "--robot", path.with_name(path.name + ".csv"), "--scanner-pose", good / "pose.json"
    yield "groove", cloud, "--robot", path.with_name(path.name + ".urdf"), "--scanner-pose", good / "pose.json"
    yield "groove", cloud, "--robot", "ur3", "--scanner-pose", path
    yield "calibrate", path, "--robot", good / "r.csv"
    yield "calibrate", good / "m.csv", "--robot", path
    yield "calibrate-field", path.with_name(path.name + ".npy"), "--steps-mm", "0"
    yield "hand-eye", path, cloud, "--target", "sphere:38.1"
    yield "merge", path, sample, test, "--hand-eye", good / "camera.json"
    yield "merge", good / "poses.txt", path.with_name(path.name + ".ply"), test, "--hand-eye", good / "camera.json"
    yield "merge", good / "poses.txt", sample, test, "--hand-eye", path


_opened: list[str] | None = None


def _note(event, arguments):
    if _opened is not None and event == "open" and isinstance(arguments[0], str | bytes | os.PathLike):
        _opened.append(os.fsdecode(arguments[0]))


sys.addaudithook(_note)


@contextmanager
def opened_files():
    """Paths of all files that this process opens in the block."""
    global _opened
    _opened = []
    try:
        yield _opened
    finally:
        _opened = None


@pytest.mark.parametrize("name", OTHERS)
def test_what_is_no_plain_file_is_refused_at_once_at_every_door(good, obeys, tmp_path, name):
    write_json(good / "pose.json", rigid(translation_mm=[0, 0, 900.0]))
    with other_things(tmp_path), opened_files() as opened:
        for suffix in (".ply", ".xyz", ".csv", ".urdf", ".npy"):
            if os.path.exists(tmp_path / name):
                (tmp_path / f"{name}{suffix}").symlink_to(tmp_path / name)
        for door, *words in doors(good, tmp_path / name):
            code, error, _ = obeys(door, *words)
            assert code == 2, error
            if name in ("pipe", "folder", "zero"):
                assert "not a file" in error or "no such file" in error
        assert opened and not [path for path in opened if path.startswith(str(tmp_path / name))]


def test_a_pipe_that_takes_a_files_place_between_two_looks_does_not_hang(tmp_path, monkeypatch):
    path = tmp_path / "a.json"
    path.write_text("{}")
    judged = os.stat(path)
    path.unlink()
    os.mkfifo(path)
    monkeypatch.setattr("grindvision.input_files.check_file", lambda _: judged)
    with pytest.raises(FileError, match="a pipe, not a file"):
        read_json(path)


def test_files_whose_size_says_nothing(tmp_path):
    for path in ("/proc/self/environ", "/proc/self/status"):
        with pytest.raises(FileError, match="its size is given as 0 bytes"):
            read_input(path, 1000, "JSON")
    with open(tmp_path / "sparse.csv", "wb") as file:
        file.truncate(50 << 30)
    for suffix, words in ((".csv", "bytes; a CSV file"), (".xyz", "not a plain text"), (".obj", "not a plain text")):
        (tmp_path / f"s{suffix}").symlink_to(tmp_path / "sparse.csv")
        with pytest.raises(FileError, match=words):
            read_table(tmp_path / "s.csv", ["x_mm"]) if suffix == ".csv" else read_cloud(tmp_path / f"s{suffix}")


def test_what_needs_more_memory_than_is_free_is_not_begun(tmp_path, monkeypatch):
    monkeypatch.setattr("grindvision.input_files.free_memory", lambda: 2 << 30)
    head = b"ply\nformat binary_little_endian 1.0\nelement vertex 300000000\n"
    head += b"".join(b"property float %c\n" % axis for axis in b"xyz") + b"end_header\n"
    for name, begin in (("a.ply", head), ("a.xyz", b"1 2 3\n" * 5000), ("a.obj", b"v 1 2 3\n" * 5000), ("a.stl", b"x")):
        with open(tmp_path / name, "wb") as file:
            file.write(begin)
            file.truncate(4 << 30)
        with pytest.raises(FileError, match=r"GB of memory, 2\.15 GB are free"):
            read_cloud(tmp_path / name)


def test_a_file_that_grows_while_it_is_read(tmp_path):
    path = tmp_path / "a.xyz"
    path.write_text("1 2 3\n")
    with pytest.raises(FileError, match="it changed while it was read"), open_input(path) as file:
        file.read()
        path.write_text("1 2 3\n4 5 6\n")


def test_an_input_that_changes_during_the_run(good, obeys, tmp_path, monkeypatch):
    cloud = tmp_path / "a.ply"
    cloud.write_bytes((good / "a.ply").read_bytes())
    monkeypatch.setattr("grindvision.cli.groove_picture.draw", lambda *_: cloud.write_bytes(b"ply\n"))
    code, error, _ = obeys("groove", cloud)
    assert code == 2 and "it changed during the run" in error


def test_results_never_overwrite_their_input(good, tmp_path, capfd):
    robot = tmp_path / "robot.csv"
    robot.write_bytes((good / "r.csv").read_bytes())
    assert main(["calibrate", str(good / "m.csv"), "--robot", str(robot), "-o", str(tmp_path)]) == 2
    assert "would overwrite this input" in capfd.readouterr().err
    assert robot.read_bytes() == (good / "r.csv").read_bytes()
    assert [path.name for path in tmp_path.iterdir()] == ["robot.csv"]


# Numbers and names that are too long, or no text


DIGITS = st.sampled_from(["9" * 19, "9" * 400, "9" * 4299, "9" * 5000, "-" + "9" * 400, "1" + "0" * 309])


@quickly
@given(digits=DIGITS, row=st.integers(0, 3), column=st.integers(0, 3))
def test_a_whole_number_of_any_length_in_a_pose(tmp_path, digits, row, column):
    matrix = [[str(int(i == j)) for j in range(4)] for i in range(4)]
    matrix[row][column] = digits
    (tmp_path / "pose.json").write_text("[" + ",".join(f"[{','.join(line)}]" for line in matrix) + "]")
    with pytest.raises(GrindvisionError, match=r"pose\.json"):
        read_pose(tmp_path / "pose.json")


def test_one_message_never_repeats_a_megabyte(good, capfd, tmp_path):
    name = "n" * 1_000_000
    for words in (
        ["groove", name + ".ply", "-o", str(tmp_path / "out")],
        ["groove", str(good / "a.ply"), "-o", name],
        ["groove", str(good / "a.ply"), "-o", "x", "--unit", name],
        ["simulate", name, "-o", "x"],
        ["study", "compound", "-o", "x", "--jobs", name],
        ["calibrate", str(good / "m.csv"), "--robot", name, "-o", "x"],
        ["calibrate", str(good / "m.csv"), "--robot", str(good / "r.csv"), "-o", "x", "--columns", f"{name}=a"],
        ["calibrate", str(good / "m.csv"), "--robot", str(good / "r.csv"), "-o", "x", "--free", name],
        [name],
    ):
        try:
            code = main(words)
        except SystemExit as stop:
            code = int(stop.code or 0)
        error = capfd.readouterr().err
        assert code == 2 and error.count("\n") == 1 and len(error) < 1300
    (tmp_path / "keys.json").write_text(json.dumps({name: 1}))
    assert main(["detect", "a.ply", "b.ply", "-o", "x", "--scanner-pose", str(tmp_path / "keys.json")]) == 2
    assert len(capfd.readouterr().err) < 1300


@given(text=st.text(max_size=3000))
def test_a_message_is_one_short_line_that_a_terminal_can_show(text):
    line = one_line(text)
    assert line.isprintable() and "\n" not in line
    assert len(clipped(text)) <= 1000 and (len(text) > 200 or clipped(text) == text)
    assert str(InputError(text)) == clipped(text)


@pytest.mark.parametrize("door", ["groove", pytest.param("detect", marks=pytest.mark.full)])
def test_names_that_are_no_text(good, tmp_path, door):
    """Latin-1 bytes, markup, formulas and terminal commands in the names of inputs and of the folder of results."""
    odd = os.fsdecode(b"caf\xe9 <b>&amp; $x_{ \x1b[31m ")
    clouds = []
    for name in ("a.ply",) if door == "groove" else ("sample.ply", "test.ply"):
        clouds.append(tmp_path / (odd + name))
        points = read_cloud(good / name).points
        points = np.vstack([points, [[np.nan] * 3]])  # a warning that names the file stands in the picture too
        write_ply(clouds[-1], points)
    write_json(tmp_path / (odd + "pose.json"), rigid(translation_mm=[300.0, 0, 900]))
    words = ["--scanner-pose", tmp_path / (odd + "pose.json")] if door == "detect" else []
    out = tmp_path / (odd + "out")
    process = command(door, *clouds, *words, "-o", out, env={**os.environ, "PYTHONIOENCODING": "ascii"})
    said, error = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, error
    assert said.isascii() and b"\x1b" not in error
    assert all(line.startswith(b"warning: ") for line in error.splitlines())
    report = json.loads((out / "report.json").read_text(encoding="utf-8"))
    assert [one["name"] for one in report["inputs"]][: len(clouds)] == [cloud.name for cloud in clouds]
    if door == "detect":
        assert report["parameters"]["scanner-pose"] == str(words[1])
        again = command(door, *clouds, "-o", tmp_path / "again", "--parameters", out / "parameters.toml")
        assert again.wait(timeout=PATIENCE_S) == 0 and not (tmp_path / "again" / "path_base.csv").exists()
        assert "no UTF-8; give it on the command line" in (out / "parameters.toml").read_text(encoding="utf-8")


# Streams that are closed, full, or read by nobody


@pytest.mark.parametrize("words", [["--help"], ["detect", "--help"]])
def test_a_reader_who_has_gone_before_the_help_comes_is_no_fault(words):
    here, there = os.pipe()
    os.close(here)
    unbuffered = {**os.environ, "PYTHONUNBUFFERED": "1"}
    run = [sys.executable, "-m", "grindvision", *words]
    done = subprocess.run(run, stdout=there, stderr=subprocess.PIPE, env=unbuffered, timeout=PATIENCE_S, check=False)
    os.close(there)
    assert (done.returncode, done.stderr) == (0, b"")


no_locks = pytest.mark.skipif(
    sys.platform == "win32", reason="Windows has no such locks, and no folder is locked there"
)


@pytest.mark.parametrize(
    "moment", ["the folder is made", pytest.param("the folder is locked", marks=no_locks), "the hidden folder is made"]
)
def test_a_signal_while_folders_are_made_leaves_none(tmp_path, monkeypatch, moment):
    def then_a_signal(module, name):
        made = getattr(module, name)

        def disturbed(*words, **settings):
            result = made(*words, **settings)
            signal.raise_signal(signal.SIGINT)
            return result

        monkeypatch.setattr(module, name, disturbed)

    where = {
        "the folder is made": (Path, "mkdir"),
        "the folder is locked": (sys.modules.get("fcntl"), "flock"),
        "the hidden folder is made": (tempfile, "mkdtemp"),
    }
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        then_a_signal(*where[moment])
        with pytest.raises(Interrupted), ending_signals_interrupt(), write_set(tmp_path / "a" / "b", "last.txt"):
            pass
    finally:
        signal.signal(signal.SIGINT, before)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "closing",
    [
        "<&- >&- 2>&-",
        "| true",
        "2>/dev/full",
        *(pytest.param(one, marks=pytest.mark.full) for one in (">&-", "2>&-", ">&- 2>&-")),
    ],
)
def test_closed_streams_change_neither_the_results_nor_the_exit_code(good, tmp_path, closing):
    run = (
        f"{sys.executable} -m grindvision calibrate {good / 'm.csv'} --robot {good / 'r.csv'}"
        f" --beyond-geometry off -o {tmp_path / 'out'}"
    )
    bad = f"{sys.executable} -m grindvision calibrate absent.csv --robot {good / 'r.csv'} -o {tmp_path / 'none'}"
    for line, code in ((run, 0), (bad, 2), (f"{sys.executable} -m grindvision --help", 0)):
        done = subprocess.run(
            ["bash", "-c", f"{line} {closing}; exit ${{PIPESTATUS[0]}}"],
            capture_output=True,
            timeout=PATIENCE_S,
            check=False,
        )
        assert done.returncode == code and b"Traceback" not in done.stderr and b"Exception" not in done.stderr
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert {path.name for path in (tmp_path / "out").iterdir()} == set(report["files"])
    assert not (tmp_path / "none").exists()


# Sets of results: whole, alone, and after a kill


def fill(place, mark, names=("a.txt", "sub/b.txt", "last.json")):
    for name in names:
        (place / name).parent.mkdir(exist_ok=True)
        manifest = json.dumps({"command": "test", "files": list(names), "mark": mark})
        (place / name).write_text(manifest if name == "last.json" else mark)


def marks(folder):
    """What the files say, without the hidden ones."""
    files = [path for path in folder.rglob("*") if path.is_file() and ".grindvision" not in str(path)]
    return {
        str(path.relative_to(folder)): json.loads(path.read_text())["mark"]
        if path.suffix == ".json"
        else path.read_text()
        for path in files
    }


NEW = {"a.txt": "new", "sub/b.txt": "new", "last.json": "new"}
OLD = {"a.txt": "old", "sub/b.txt": "old", "old/c.txt": "old", "last.json": "old"}


KILLED, MIXED = 9, 11


def test_at_no_moment_do_old_and_new_stand_together_and_a_kill_at_any_moment_is_mended(tmp_path, monkeypatch):
    """A process is killed at every call of the system in turn; then the next run comes, and fails on its own."""
    calls = ("replace", "unlink", "rmdir", "mkdir")
    real = {name: getattr(os, name) for name in calls}
    outcomes = []
    for moment in range(60):
        out = tmp_path / f"out{moment}"
        with write_set(out, "last.json") as place:
            fill(place, "old", tuple(OLD))
        left = iter(range(moment))

        def killed(name, left=left, out=out):
            def call(*arguments, **named):
                found = marks(out)
                if len(set(found.values())) > 1 or ("last.json" in found and found not in (NEW, OLD)):
                    os._exit(MIXED)
                if next(left, None) is None:
                    os._exit(KILLED)
                return real[name](*arguments, **named)

            return call

        child = os.fork()
        if child == 0:
            with write_set(out, "last.json") as place:
                fill(place, "new")
                for name in calls:
                    monkeypatch.setattr(os, name, killed(name))
            os._exit(0)
        ended = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        assert ended in (0, KILLED)
        with suppress(KeyError), write_set(out, "last.json"):
            raise KeyError
        outcomes.append(marks(out))
        assert outcomes[-1] in (OLD, NEW) and not list(out.glob(".grindvision*"))
        if ended == 0:
            break
    assert ended == 0 and outcomes[0] == OLD and outcomes[-1] == NEW and outcomes.count(NEW) > 4


def test_files_of_other_commands_and_of_the_user_stay(tmp_path):
    with write_set(tmp_path, "last.json") as place:
        fill(place, "old", tuple(OLD))
    (tmp_path / "mine.txt").write_text("mine")
    (tmp_path / "last.json").write_text((tmp_path / "last.json").read_text().replace('"test"', '"other"'))
    with write_set(tmp_path, "last.json") as place:
        fill(place, "new")
    assert marks(tmp_path) == {**NEW, "old/c.txt": "old", "mine.txt": "mine"}


def test_a_second_run_into_the_same_folder_is_refused_and_disturbs_nothing(tmp_path):
    out = tmp_path / "out"
    with write_set(out, "last.json") as place:
        fill(place, "new")
        with pytest.raises(FileError, match="another run is writing to it"), write_set(out, "last.json"):
            pass
        assert place.is_dir()
    assert marks(out) == NEW


def test_many_runs_at_once_leave_one_set(tmp_path):
    code = (
        "import sys, time\nfrom pathlib import Path\nfrom grindvision.result_set import write_set\n"
        "from grindvision.errors import FileError\n"
        "for turn in range(25):\n"
        "    try:\n"
        "        with write_set(Path(sys.argv[1]), 'last.json') as place:\n"
        "            for name in ('a.txt', 'b.txt', 'last.json'):\n"
        "                (place / name).write_text(f'{sys.argv[2]} {turn}')\n"
        "            if turn % 3 == 2: raise KeyError\n"
        "    except (FileError, KeyError): time.sleep(0.001)\n"
    )
    out = tmp_path / "deep" / "out"
    runs = [subprocess.Popen([sys.executable, "-c", code, str(out), str(k)], stderr=subprocess.PIPE) for k in range(4)]
    for run in runs:
        assert run.wait(timeout=PATIENCE_S) == 0, run.stderr.read().decode()
    assert len({path.read_text() for path in out.iterdir()}) == 1
    assert sorted(path.name for path in out.iterdir()) == ["a.txt", "b.txt", "last.json"]


def test_where_the_file_system_has_no_locks_nothing_is_swept(tmp_path, monkeypatch):
    def no_locks(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr("fcntl.flock", no_locks)
    (tmp_path / ".grindvision-other").mkdir()
    with write_set(tmp_path, "last.json") as place:
        fill(place, "new")
    assert marks(tmp_path) == NEW and [path.name for path in tmp_path.glob(".g*")] == [".grindvision-other"]


def test_the_report_names_every_file_with_its_digest(good, obeys):
    _, _, out = obeys("groove", good / "a.ply", "--waypoints", 9)
    report = json.loads((out / "report.json").read_text())
    assert {one["name"]: one["sha256"] for one in report["outputs"]} == {
        name: sha256(out / name) for name in report["files"] if name != "report.json"
    }


def test_a_killed_run_is_swept_by_the_next_but_a_live_one_is_not(good, tmp_path):
    out = tmp_path / "out"
    process = command("detect", good / "sample.ply", good / "test.ply", "-o", out, run=("-c", ENDLESS))
    wait_for(lambda: list(out.glob(".grindvision-*/")), process)
    assert main(["calibrate", str(good / "m.csv"), "--robot", str(good / "r.csv"), "-o", str(out)]) == 2
    assert list(out.glob(".grindvision-*/"))
    process.kill()
    process.communicate(timeout=PATIENCE_S)
    assert main(["calibrate", str(good / "m.csv"), "--robot", str(good / "r.csv"), "-o", str(out)]) == 0
    assert {path.name for path in out.iterdir()} == set(json.loads((out / "report.json").read_text())["files"])


def test_a_clock_that_is_set_back(good, obeys, tmp_path, monkeypatch):
    """Files from the future, and a clock that jumps: no negative times, nothing refused, nothing swept in error."""
    for name, then in (("a.ply", 4e9), ("b.ply", 0)):
        (tmp_path / name).write_bytes((good / "a.ply").read_bytes())
        os.utime(tmp_path / name, (then, then))
    jumps = iter(range(10**6))
    monkeypatch.setattr(time, "time", lambda: 2e9 - 1e6 * next(jumps))
    for name in ("a.ply", "b.ply"):
        code, _, out = obeys("groove", tmp_path / name, "--waypoints", 9)
        assert code == 0
        assert min(json.loads((out / "report.json").read_text())["timings_s"].values()) >= 0


@pytest.mark.skipif(os.geteuid() != 0, reason="needs the rights to become another user")
def test_an_unreadable_file_as_a_plain_user(good, tmp_path):
    """Every door says so in one line; run as a user without rights."""
    shown = {"m.csv": "calibrate", "r.csv": "calibrate"}
    code = (
        "import os, sys, pandas\nfrom grindvision.calibration import read_measurements\n"
        "from grindvision.arm import read_arm\nfrom grindvision.clouds import read_cloud\n"
        "from grindvision.errors import FileError\n"
        "from grindvision.result_set import write_set\n"
        "os.setgroups([]); os.setgid(65534); os.setuid(65534)\n"
        "for read, path in ((read_measurements, 'm.csv'), (read_arm, 'r.csv'), (read_cloud, 'a.ply')):\n"
        "    try: read(path)\n"
        "    except FileError as error: assert 'Permission denied' in str(error), error\n"
        "    else: raise AssertionError(path)\n"
        "try:\n"
        "    with write_set('closed/out', 'report.json'): pass\n"
        "except FileError as error: assert 'cannot write to' in str(error), error\n"
        "else: raise AssertionError('written')\n"
    )
    for name in (*shown, "a.ply"):
        (tmp_path / name).write_bytes((good / name).read_bytes())
        (tmp_path / name).chmod(0)
    (tmp_path / "closed").mkdir(mode=0o755)
    for parent in (tmp_path, *tmp_path.parents):
        if parent.owner() == "root" and not parent.stat().st_mode & 0o005 and "pytest" in str(parent):
            parent.chmod(0o755)
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, timeout=PATIENCE_S, check=False
    )
    assert done.returncode == 0, done.stderr.decode()


# Signals


@pytest.mark.parametrize(
    "number",
    [signal.SIGTERM, *(pytest.param(number, marks=pytest.mark.full) for number in (signal.SIGINT, signal.SIGHUP))],
)
def test_a_signal_ends_a_study_with_its_own_code_and_all_finished_rows(tmp_path, number):
    """The signal goes to the whole group, as from a keyboard or a closed terminal; no worker says a word either."""
    rows = tmp_path / "rows.csv"
    process = command(
        "study", "path", "-o", rows, "--cases", 512, "--jobs", 2, start_new_session=True,
        preexec_fn=lambda: [signal.signal(one, signal.SIG_DFL) for one in (signal.SIGINT, signal.SIGHUP)],
    )  # fmt: skip
    wait_for(lambda: rows.exists() and rows.read_bytes().count(b"\n") > 1, process)
    os.killpg(process.pid, number)
    _, error = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 128 + number
    assert error == b"grindvision study: interrupted; nothing half-written is left\n"
    assert [path.name for path in tmp_path.iterdir()] == ["rows.csv"]
    with RowsFile(rows) as found:
        assert 1 <= len(found.stored) < 512


BOOK = """
import pathlib, sys
from grindvision_book.machinery import places
folder = pathlib.Path(sys.argv.pop(1))
places.NOTEBOOKS, places.BUILD = folder / "notebooks", folder / "build"
places.FAST_FIGURES = places.BUILD / "fast" / "figures"
from grindvision.cli import main
sys.exit(main())
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_a_build_of_the_book_and_its_kernels(tmp_path, number):
    chapter = new_notebook(cells=[new_code_cell("import os, time\nopen('begun', 'w').write('now')\ntime.sleep(3600)")])
    chapter.metadata["kernelspec"] = {"name": "python3", "display_name": "Python 3", "language": "python"}
    (tmp_path / "notebooks").mkdir()
    (tmp_path / "notebooks" / "01_one.ipynb").write_text(writes(chapter))
    begun = tmp_path / "build" / "fast" / "executed" / "begun"
    process = command(
        tmp_path, "book", "--fast", run=("-c", BOOK), start_new_session=True,
        preexec_fn=lambda: [signal.signal(one, signal.SIG_DFL) for one in (signal.SIGINT, signal.SIGHUP)],
    )  # fmt: skip
    wait_for(begun.exists, process)
    kernels = children(process.pid)
    assert kernels
    os.killpg(process.pid, number)
    said, error = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 128 + number
    assert error == b"grindvision book: interrupted; nothing half-written is left\n"
    assert said.count(b"\n") == 1 and b"failed" not in said
    assert not [kernel for kernel in kernels if alive(kernel)]
    assert "interrupted" in (tmp_path / "build" / "reading" / "index.html").read_text()
    left = {path.name for path in (tmp_path / "build").rglob("*") if path.is_file()}
    assert left == {"lock", "begun", "index.html"}
    with only_build(tmp_path / "build"):
        pass


def children(process_id: int) -> list[int]:
    """Processes that this one has started, where the system lists them."""
    listed = Path(f"/proc/{process_id}/task/{process_id}/children")
    return [int(child) for child in listed.read_text().split()]


def alive(process_id: int) -> bool:
    """Whether this process runs; one that has ended and that nobody has asked for does not."""
    try:
        return Path(f"/proc/{process_id}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def test_signals_wait_while_results_are_put_in_place(tmp_path):
    seen = []
    before = signal.signal(signal.SIGTERM, lambda *_: seen.append("then"))
    try:
        with undisturbed():
            signal.raise_signal(signal.SIGTERM)
            seen.append("first")
    finally:
        signal.signal(signal.SIGTERM, before)
    assert seen == ["first", "then"]


def test_an_interrupt_that_a_callback_swallows_comes_again():
    """C code that calls Python prints and drops what is raised there; the run would go on as if nothing had been."""

    def raises() -> int:
        signal.raise_signal(signal.SIGTERM)
        return 0

    callback = ctypes.CFUNCTYPE(ctypes.c_int)(raises)
    with pytest.raises(Interrupted) as caught, ending_signals_interrupt():
        callback()
        time.sleep(PATIENCE_S)
    assert caught.value.exit_code == 143


#: A command that does nothing but call a compiled kernel, which takes a while and returns named tuples in a tuple.
IN_A_KERNEL = """
import sys
from pathlib import Path
from typing import NamedTuple
import numba
import numpy as np
from grindvision.cli import main, robots
class Found(NamedTuple):
    values: np.ndarray
    is_found: bool
@numba.njit
def search(count):
    values = np.zeros(3)
    for at in range(count):
        values[at % 3] += np.sqrt(at)
    return Found(values, True), Found(values, False), values > 1.0
def run(options):
    search(3)
    Path(begun).touch()
    while True:
        search(300_000_000)
begun = sys.argv.pop(1)
robots.run = run
sys.exit(main())
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_inside_a_compiled_kernel_ends_the_run_like_any_other(tmp_path, number):
    """The exception must not be raised while the kernel's result is made: numba goes on with a null pointer there."""
    process = command(
        tmp_path / "begun", "robots", run=("-c", IN_A_KERNEL),
        preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL),
    )  # fmt: skip
    wait_for((tmp_path / "begun").exists, process)
    time.sleep(0.1)
    os.kill(process.pid, number)
    said, error = process.communicate(timeout=PATIENCE_S)
    assert error == b"grindvision robots: interrupted; nothing half-written is left\n"
    assert process.returncode == 128 + number and said == b""


def test_an_error_that_follows_a_signal_is_its_consequence():
    alarm = signal.getsignal(signal.SIGALRM)
    with pytest.raises(Interrupted) as caught, ending_signals_interrupt():
        try:
            signal.raise_signal(signal.SIGTERM)
        except Interrupted:
            raise SystemError("a result with an exception set") from None
    assert caught.value.exit_code == 143
    assert signal.getsignal(signal.SIGALRM) == alarm
    with pytest.raises(SystemError, match="of its own"), ending_signals_interrupt():
        raise SystemError("of its own")


# A study's file


@pytest.mark.parametrize("content", [b"my notes", b"\x00" * 300_000, b"a,b\n1,2\n", b"caseload of the year"])
def test_a_study_does_not_write_over_what_is_none(tmp_path, content):
    path = tmp_path / "rows.csv"
    path.write_bytes(content)
    with pytest.raises(FileError, match="not a study's results"), RowsFile(path):
        pass
    assert path.read_bytes() == content


def test_a_study_sweeps_what_a_killed_one_left_and_refuses_a_pipe(tmp_path):
    (tmp_path / ".grindvision-rows-x1.csv").write_text("half")
    (tmp_path / ".grindvision-mine-x1.csv").write_text("of another study")
    with RowsFile(tmp_path / "rows.csv"):
        pass
    assert not (tmp_path / ".grindvision-rows-x1.csv").exists() and (tmp_path / ".grindvision-mine-x1.csv").exists()
    os.mkfifo(tmp_path / "pipe.csv")
    with pytest.raises(FileError, match="a pipe, not a file"), RowsFile(tmp_path / "pipe.csv"):
        pass


# What the data cannot tell is asked; what they can is said


def test_the_questions_stand_in_the_report_and_on_stdout(good, tmp_path, capfd):
    write_json(tmp_path / "pose.json", rigid(translation_mm=[800.0, 10, 900]))
    words = ["detect", str(good / "sample.ply"), str(good / "test.ply"), "--scanner-pose", str(tmp_path / "pose.json")]
    assert main([*words, "-o", str(tmp_path / "out")]) == 0
    said = capfd.readouterr().out
    assert main([*words, "-o", str(tmp_path / "out"), "--json"]) == 0
    report = json.loads(capfd.readouterr().out)
    assert len(report["questions"]) == 2 and all(text in said for text in report["questions"])
    size = np.ptp(read_cloud(good / "sample.ply").points, axis=0)
    assert f"SAMPLE {' x '.join(f'{side:.4g}' for side in size)} mm" in report["questions"][0]
    assert "scanner at (800, 10, 900) mm" in report["questions"][1]


@pytest.mark.parametrize(
    ("pose", "words"),
    [
        (np.eye(4), "the identity"),
        (rigid(np.diag([1.0, -1, -1]), [80.0, 3, 95]), "centimetres"),
        (rigid(np.diag([1.0, -1, -1]), [12_000.0, 0, 900]), "12.0 m from the base"),
        (rigid(np.eye(3), [0, 0, -2000.0]), "below the robot's base"),
        (rigid(np.diag([1.0, -1, -1]), [800.0, 0, 900]), ""),
    ],
)
def test_poses_that_place_the_part_where_none_can_be_are_told(pose, words):
    points = np.random.default_rng(0).normal(size=(500, 3)) * [60, 40, 3] + [0, 0, 600]
    found = diagnose_pose(pose, points)
    assert len(found) == bool(words) and words in "".join(found)


def test_an_inverted_pose_is_named_where_only_its_inverse_places_the_part_in_reach():
    true = rigid(np.array([[0, -0.6, -0.8], [-1, 0, 0], [0, 0.8, -0.6]]), [1400.0, 0, 700])
    points = np.random.default_rng(0).normal(size=(500, 3)) * [60, 40, 3] + [0, 0, 1100]
    assert diagnose_pose(true, points) == []
    found = diagnose_pose(np.linalg.inv(true), points)
    assert len(found) <= 1 and all("is it T_scanner_base?" in text for text in found)


def test_a_pose_without_translation_is_refused(tmp_path):
    write_json(tmp_path / "pose.json", rigid(np.diag([1.0, -1, -1])))
    with pytest.raises(InputError, match="no translation"):
        read_pose(tmp_path / "pose.json")


@pytest.mark.parametrize("axis", ["x", *(pytest.param(axis, marks=pytest.mark.full) for axis in "yz")])
def test_a_left_handed_scan_read_as_such_gives_the_same_answer(good, obeys, tmp_path, axis):
    signs = np.where(np.array(list("xyz")) == axis, -1.0, 1.0)
    for name in ("sample", "test"):
        write_ply(tmp_path / f"{name}.ply", read_cloud(good / f"{name}.ply").points * signs)
    _, _, plain = obeys("detect", good / "sample.ply", good / "test.ply")
    words = (tmp_path / "sample.ply", tmp_path / "test.ply", "--mirrored", axis)
    code, _, out = obeys("detect", *words)
    assert code == 0 and (out / "path.csv").read_bytes() == (plain / "path.csv").read_bytes()
    code, _, out = obeys(
        "detect", good / "sample.ply", tmp_path / "test.ply", "--mirrored", axis, "--mirrored-only", "test"
    )
    assert code == 0 and (out / "path.csv").read_bytes() == (plain / "path.csv").read_bytes()


def test_a_camera_image_that_runs_as_in_a_mirror_is_told(tmp_path):
    down, right = np.mgrid[-1:1:40j, -1:1:60j]
    image = np.dstack([200 * right, 150 * down, 600 + 20 * right**2])
    for name, pixels, told in (("as_seen", image, ""), ("mirrored", image * [-1, 1, 1], "as in a mirror image")):
        np.save(tmp_path / f"{name}.npy", pixels)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            (cloud,) = read_scans([str(tmp_path / f"{name}.npy")], "mm")
        assert len(caught) == bool(told) and all(told in str(one.message) for one in caught)
    (again,) = read_scans([str(tmp_path / "mirrored.npy")], "mm", ["x"])
    np.testing.assert_array_equal(again.points, cloud.points * [-1, 1, 1])


@pytest.mark.parametrize(("unit", "per_mm"), [("cm", 0.1), ("in", 1 / 25.4), ("m", 0.001)])
def test_centimetres_and_inches_are_read_when_said_or_named(tmp_path, unit, per_mm):
    points = np.random.default_rng(0).normal(size=(100, 3)) * 100
    table = pd.DataFrame(points * per_mm, columns=[f"x [{unit}]", f"y [{unit}]", f"z [{unit}]"])
    table.to_csv(tmp_path / "named.csv", index=False)
    np.save(tmp_path / "said.npy", points * per_mm)
    np.testing.assert_allclose(read_cloud(tmp_path / "named.csv").points, points, rtol=1e-12)
    np.testing.assert_allclose(read_cloud(tmp_path / "said.npy", unit).points, points, rtol=1e-12)


def test_a_part_of_three_centimetres_is_doubted_until_its_unit_is_said(tmp_path):
    np.save(tmp_path / "a.npy", np.random.default_rng(0).uniform(0, 1, (1000, 3)) * [30, 20, 5])
    with pytest.warns(match=r"36\.\d mm across: are its numbers centimetres"):
        read_scans([str(tmp_path / "a.npy")], None)
    read_scans([str(tmp_path / "a.npy")], "mm")


def test_a_file_name_with_markup_is_text_in_the_tables_of_the_book():
    table = pd.DataFrame({"file": ["<script>x()</script>|a\n| b |.ply", "plain.ply"], "points": [1, 2]})
    lines = markdown_table(table).splitlines()
    assert lines[2:] == ["| &lt;script&gt;x()&lt;/script&gt;\\|a \\| b \\|.ply | 1 |", "| plain.ply | 2 |"]
