"""The picture that a process of its own draws is the one that is drawn here, and that process outlasts nothing."""

import os
import pickle
import select
import subprocess
import sys

import matplotlib
import numpy as np
import pytest

from grindvision.cli.detect_picture import draw
from grindvision.cli.detect_shown import Shown, ShownBead
from grindvision.parallel import usable_cores

PATIENCE_S = 60

BESIDE = """
import os, pickle, signal, sys
from pathlib import Path
from grindvision.cli import own_process
own_process.take_over()
import numpy
from grindvision.cli.picture_process import drawing_beside
draw = drawing_beside("detect_picture")
if sys.argv[1] == "kill it":
    os.kill(draw._process, signal.SIGKILL)
if sys.argv[1] == "be killed":
    os.kill(os.getpid(), signal.SIGKILL)
draw(pickle.loads(sys.stdin.buffer.read()), ["look"], Path(sys.argv[2]))
print("matplotlib.figure" in sys.modules)
"""

linux_only = pytest.mark.skipif(
    sys.platform != "linux" or usable_cores() < 2,
    reason="pictures are drawn beside on Linux, with 2 cores",
)


@pytest.fixture
def shown(rng):
    x, y = (part.ravel() for part in np.meshgrid(np.arange(-30, 30, 1.0), np.arange(-20, 20, 1.0)))
    plate = np.column_stack([x, y, 400 + 0.01 * x**2])
    bead = ShownBead(np.column_stack([np.arange(9.0), np.zeros(9), np.full(9, 399)]), False, plate[:5])
    signed = rng.normal(0, 0.1, len(plate))
    comparable = rng.random(len(plate)) < 0.9
    return Shown(
        "Found 1 bead", "Registration: certain", plate, np.tile([0, 0, -1.0], (len(plate), 1)), plate + 5, plate,
        plate, signed, comparable, plate[signed > 0.15], (0.4,), 1, 0.2, (bead,), plate, 15.0,
    )  # fmt: skip


def beside(what, path, shown=None, **options):
    return subprocess.run(
        [sys.executable, "-c", BESIDE, what, str(path)],
        input=pickle.dumps(shown), capture_output=True, check=False, timeout=PATIENCE_S, **options,
    )  # fmt: skip


@linux_only
@pytest.mark.parametrize(("what", "drawn_here"), [("let it draw", b"False\n"), ("kill it", b"True\n")])
def test_the_picture_is_the_same_whoever_draws_it(what, drawn_here, shown, tmp_path):
    with matplotlib.rc_context():
        matplotlib.rcdefaults()  # another test may have left the book's style
        draw(shown, ["look"], tmp_path / "here.png")
    run = beside(what, tmp_path / "there.png", shown)
    assert (run.returncode, run.stdout, run.stderr) == (0, drawn_here, b"")
    assert (tmp_path / "there.png").read_bytes() == (tmp_path / "here.png").read_bytes()


@linux_only
def test_what_keeps_it_from_drawing_is_told(shown, tmp_path):
    (tmp_path / "file").write_text("")
    run = beside("let it draw", tmp_path / "file" / "there.png", shown)
    assert run.returncode == 1 and run.stdout == b""
    assert b"FileError: cannot write" in run.stderr


@linux_only
def test_it_ends_with_the_process_that_it_draws_for(tmp_path):
    ours, theirs = os.pipe()
    with open(ours, "rb"):
        run = beside("be killed", tmp_path / "there.png", pass_fds=(theirs,))
        os.close(theirs)
        assert run.returncode == -9
        ready, *_ = select.select([ours], [], [], PATIENCE_S)
        assert ready and os.read(ours, 1) == b""  # nobody holds the other end any more
    assert not list(tmp_path.iterdir())
