"""``grindvision groove``: the files it writes, and one line with exit code 2 for what it cannot use."""

import json

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from grindvision.cli import main
from grindvision.clouds import write_ply
from grindvision.errors import GrindvisionWarning, InputError
from grindvision.vision.seam.weld import TraceWeldOptions, trace_weld
from tests.groove_scenes import cloud, grid, straight_groove, vee


@pytest.fixture
def scan(tmp_path, rng):
    points, truth = straight_groove(rng)
    write_ply(tmp_path / "cloud.ply", points)
    return tmp_path / "cloud.ply", truth


@pytest.mark.parametrize("variant", ["ours", "paper"])
def test_files_of_a_run(scan, tmp_path, variant):
    path, truth = scan
    out = tmp_path / "out"
    assert main(["groove", str(path), "-o", str(out), "--waypoints", "20", "--variant", variant]) == 0
    labels = np.load(out / "labels.npy")
    assert labels.dtype == bool and len(labels) == len(truth) and labels[truth].mean() > 0.9
    table = pd.read_csv(out / "trajectory.csv")
    assert list(table["waypoint"]) == list(range(1, 21))
    turns = Rotation.from_euler("xyz", table[["roll_rad", "pitch_rad", "yaw_rad"]]).as_matrix()
    np.testing.assert_allclose(turns[:, :, 2], -table[["nx", "ny", "nz"]].to_numpy(), atol=2e-2)
    along = np.diff(table[["x_mm", "y_mm", "z_mm"]], axis=0)
    assert (np.einsum("ij,ij->i", turns[:-1, :, 0], along) > 0).all()
    report = json.loads((out / "report.json").read_text())
    assert {"timings_s", "versions", "parameters", "inputs", "grooves"} <= set(report)
    assert "total" in report["timings_s"] and report["variant"] == variant
    assert (out / "report.png").stat().st_size > 10_000


def test_two_grooves_two_trajectories(tmp_path, rng):
    places = grid()
    points = cloud(places, vee(places[:, 1] - 18, 12, 7) + vee(places[:, 1] + 20, 8, 4), rng)
    write_ply(tmp_path / "two.ply", points)
    assert main(["groove", str(tmp_path / "two.ply"), "-o", str(tmp_path / "out")]) == 0
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert [round(groove["width_mm"]) for groove in report["grooves"]] == [12, 8]
    assert (tmp_path / "out" / "trajectory_2.csv").exists()
    assert "also: 1 more groove (120 mm long)" in str(trace_weld(points))


def test_grooves_too_small_to_count_are_said(rng):
    places = grid()
    short = vee(places[:, 1] + 22, 6, 3) * (np.abs(places[:, 0]) < 14)
    weld = trace_weld(cloud(places, vee(places[:, 1] - 18, 14, 9) + short, rng))
    assert len(weld.paths) == 1 and "left out as too small: 1 more groove (" in str(weld)


def test_bad_input_is_one_line_and_exit_code_two(tmp_path, rng, capsys):
    places = grid()
    flat = cloud(places, 0 * places[:, 0], rng)
    write_ply(tmp_path / "plate.ply", flat)
    write_ply(tmp_path / "metres.ply", straight_groove(rng)[0] / 1000)
    for name, words in (("plate.ply", "no groove in the cloud"), ("metres.ply", "--unit m"), ("absent.ply", "no such")):
        assert main(["groove", str(tmp_path / name), "-o", str(tmp_path / "out")]) == 2
        error = capsys.readouterr().err
        assert words in error and error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_groove_partly_outside_is_a_warning(rng):
    points, _ = straight_groove(rng)
    with pytest.warns(GrindvisionWarning, match="partly outside"):
        trace_weld(points[grid()[:, 1] < 4])


def test_bad_requests_are_named():
    with pytest.raises(InputError, match="variant"):
        TraceWeldOptions(variant="theirs")
    with pytest.raises(InputError, match="way points"):
        TraceWeldOptions(1)
