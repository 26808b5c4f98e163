"""Inputs that every door takes, the law that every door is held to, and runs that are stopped in the middle."""

import json
import struct
import subprocess
import sys
import time

import numpy as np
import pandas as pd
import pytest
from hypothesis import HealthCheck, settings

from grindvision.arm import write_arm
from grindvision.calibration.pose_conventions import convention
from grindvision.cli import main
from grindvision.cli.camera_pose import camera_content
from grindvision.clouds import write_ply
from grindvision.files import write_json
from grindvision.geometry import rigid
from tests.calibration_rig import as_table, er3a, rig
from tests.grinding_scene import arc_bead, pair
from tests.groove_scenes import straight_groove

CLOUDS = ("a.ply", "b.ply", "a.pcd", "b.pcd", "c.pcd", "a.xyz", "a.csv", "a.npy", "a.npz", "a.stl", "a.obj")
quickly = settings(
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow, HealthCheck.data_too_large],
)


def pcd(points, form):
    head = "VERSION .7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F U\nCOUNT 1 1 1 1\n"
    head += f"WIDTH {len(points)}\nHEIGHT 1\nPOINTS {len(points)}\nDATA {form}\n"
    if form == "ascii":
        return (head + "".join("{:.4f} {:.4f} {:.4f} 0\n".format(*row) for row in points)).encode()
    if form == "binary":
        return head.encode() + b"".join(struct.pack("<3fI", *row, 7) for row in points)
    columns = points.T.astype("<f4").tobytes() + bytes(4 * len(points))
    packed = b"".join(bytes([len(columns[i : i + 32]) - 1]) + columns[i : i + 32] for i in range(0, len(columns), 32))
    return head.encode() + struct.pack("<II", len(packed), len(columns)) + packed


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """Folder of inputs that every door takes; the cloud stands there in every format."""
    folder = tmp_path_factory.mktemp("good")
    points, _ = straight_groove(np.random.default_rng(0), spacing_mm=1.2)
    points = points.astype(np.float32).astype(float)
    write_ply(folder / "a.ply", points)
    head = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n" + "".join(f"property float {a}\n" for a in "xyz")
    rows = "".join("{:.4f} {:.4f} {:.4f}\n".format(*row) for row in points)
    (folder / "b.ply").write_text(head + "end_header\n" + rows)
    for name, form in (("a.pcd", "ascii"), ("b.pcd", "binary"), ("c.pcd", "binary_compressed")):
        (folder / name).write_bytes(pcd(points, form))
    (folder / "a.xyz").write_text(rows)
    (folder / "a.csv").write_text("x,y,z\n" + rows.replace(" ", ","))
    np.save(folder / "a.npy", points)
    np.savez(folder / "a.npz", points=points)
    triangles = np.repeat(points, 3, axis=0).reshape(-1, 3, 3)
    body = b"".join(struct.pack("<12fH", 0, 0, 1, *t.ravel(), 0) for t in triangles)
    (folder / "a.stl").write_bytes(bytes(80) + struct.pack("<I", len(triangles)) + body)
    (folder / "a.obj").write_text("mtllib /etc/passwd\n" + "".join("v {} {} {}\n".format(*row) for row in points))
    scene = pair(seed=11, n_points=3000, beads=[arc_bead()])
    write_ply(folder / "sample.ply", scene.sample)
    write_ply(folder / "test.ply", scene.test)
    np.save(folder / "T_sample_test.npy", scene.T_sample_test)
    made = rig(er3a(), np.random.default_rng(1), test=12)
    as_table(made.measurements).to_csv(folder / "m.csv", index=False)
    write_arm(er3a(), folder / "r.csv")
    write_json(folder / "camera.json", camera_content(rigid(None, [0, 50.0, 80]), "on-arm", convention("fanuc")))
    (folder / "poses.txt").write_text("500 0 600 180 0 0\n500 20 600 180 5 0\n")
    return folder


@pytest.fixture
def obeys(tmp_path, capfd):
    """Run a door and hold it to the law; returns the exit code, the line on stderr, and the output folder."""

    def run(*words, most=0):
        out = tmp_path / f"out{time.monotonic_ns()}"
        capfd.readouterr()
        try:
            code = main([*map(str, words), "-o", str(out)])
        except SystemExit as stop:
            code = int(stop.code or 0)
        error = capfd.readouterr().err
        assert code in (0, 2), error
        if code == 0:
            report = json.loads((out / "report.json").read_text())
            found = {str(path.relative_to(out)) for path in out.rglob("*") if path.is_file()}
            assert found == set(report["files"])
            assert all(line.startswith("warning: ") for line in error.splitlines())
        else:
            assert error.startswith(f"grindvision {words[0]}: ") and error.count("\n") == 1 and len(error) < 700
            assert "Traceback" not in error and "defect" not in error
            assert not out.exists()
        return code, error, out

    return run


def root_is_right(out):
    """The path of the straight groove: its root lies 6 mm deep along x at y = 0, in the frame of the cloud."""
    table = pd.read_csv(out / "trajectory.csv")
    points = table[["x_mm", "y_mm", "z_mm"]].to_numpy()
    line = points - points.mean(axis=0)
    _, sizes, _ = np.linalg.svd(line)
    return np.isfinite(table.to_numpy()).all() and sizes[1] < 0.05 * sizes[0]


#: A time no step takes, however busy the machine; it ends a test that hangs.
PATIENCE_S = 600
#: ``detect`` that registers over and over, so that whatever happens to it happens in the middle.
ENDLESS = """
import sys
from grindvision.cli import main
from grindvision.vision.registration import scan_registration
once = scan_registration.refine
def refine(*arguments):
    while True:
        once(*arguments)
scan_registration.refine = refine
sys.exit(main())
"""


def command(*words, run=("-m", "grindvision"), **options):
    return subprocess.Popen(
        [sys.executable, *run, *map(str, words)], stderr=subprocess.PIPE, stdout=subprocess.PIPE, **options
    )


def wait_for(happened, process):
    """Wait until something has happened, as long as the process is alive."""
    until = time.monotonic() + PATIENCE_S
    while not happened() and process.poll() is None and time.monotonic() < until:
        time.sleep(0.01)
    assert happened(), process.communicate(timeout=PATIENCE_S) if process.poll() is not None else "not in time"
