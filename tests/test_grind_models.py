"""A model as the good part of ``grind``: stock, passes, datum, a corrected field, and a new scan judged against it."""

import json

import numpy as np
import pytest

from grindvision.cli import main
from grindvision.clouds import read_cloud, write_ply
from grindvision.geometry import inverse, move_points, rigid, rotation_about
from grindvision.grinding_files import read_job
from grindvision.vision.depth_calibration.field_correction import FieldCorrection, write_field
from grindvision_book.chapter_16.ground_scans import ground_points
from tests.grinding_scene import Bead, pair, plate_height
from tests.test_models import stl

#: Where the model's frame stands in the part's.
T_MODEL_PART = rigid(rotation_about([1.0, 2.0, 0.5], 0.9), (5.0, -300.0, 80.0))
BEAD = Bead(np.column_stack([np.linspace(-45, 25, 60), np.full(60, 48.0)]), width_mm=6.0)


def solid(step_mm=1.0, low_mm=-25.0):
    """Corners (T, 3, 3) of a closed model of the good part: its surface, straight walls and a flat bottom."""
    x, y = np.arange(-100, 100.1, step_mm), np.arange(-70, 70.1, step_mm)
    top = np.stack([*np.meshgrid(x, y, indexing="ij"), plate_height(*np.meshgrid(x, y, indexing="ij"))], axis=-1)
    bottom = top.copy()
    bottom[..., 2] = low_mm

    def sheet(grid):
        a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
        return np.concatenate([np.stack(corners, axis=2).reshape(-1, 3, 3) for corners in ((a, b, c), (a, c, d))])

    def wall(edge):
        return sheet(np.stack([top[edge], bottom[edge]], axis=1))

    first, last = np.s_[:, 0], np.s_[:, -1]
    walls = [wall(first)[:, ::-1], wall(last), wall(np.s_[0]), wall(np.s_[-1])[:, ::-1]]
    return move_points(T_MODEL_PART, np.concatenate([sheet(top), sheet(bottom)[:, ::-1], *walls]).reshape(-1, 3))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A model, a scan with a bead, the job planned from both, and scans after its passes: done, and only begun."""
    place = tmp_path_factory.mktemp("grind_models")
    (place / "good.stl").write_bytes(stl(solid().reshape(-1, 3, 3)))
    scene, fresh = (pair(seed, 40_000, beads=[BEAD]) for seed in (0, 5))
    write_ply(place / "test.ply", scene.test)
    words = [str(place / "good.stl"), str(place / "test.ply"), "--depth", "0.3"]
    assert main(["grind", *words, "-o", str(place / "job")]) == 0
    (plan,) = read_job(place / "job").plans
    T_test_fresh = scene.T_test_part @ inverse(fresh.T_test_part)
    for name, factor in (("done", 1.2), ("begun", 0.4)):
        write_ply(place / f"{name}.ply", ground_points(fresh.test, plan, factor, T_test_fresh, times=2))
    return place


def volume_mm3(job):
    (piece,) = json.loads((job / "report.json").read_text())["pieces"]
    return piece["volume_mm3"]


def again(folder, out, *words):
    code = main(["grind", "--again", str(folder / "job"), *map(str, words), "--tolerance-mm", "0.25", "-o", str(out)])
    return code, json.loads((out / "report.json").read_text())


def test_the_bead_over_a_model_is_found_with_its_volume(folder):
    round_ends_mm3 = np.pi / 8 * BEAD.width_mm**2 * BEAD.height_mm
    true_mm3 = 2 / 3 * BEAD.width_mm * BEAD.height_mm * 70 + round_ends_mm3
    assert volume_mm3(folder / "job") == pytest.approx(true_mm3, rel=0.05)


@pytest.mark.usefixtures("blank_pictures")
def test_a_scan_after_too_little_is_judged_against_the_model_and_the_rest_is_planned(folder, tmp_path):
    code, report = again(folder, tmp_path / "begun", folder / "begun.ply")
    (piece,) = report["pieces"]
    assert code == 3 and piece["remaining"]["over_mm2"] > 20
    assert piece["learnt"]["factor"] == pytest.approx(0.4, rel=0.15)
    assert read_job(tmp_path / "begun").plans[0] is not None


@pytest.mark.full
def test_a_scan_after_the_passes_meets_the_tolerance_over_the_model(folder, tmp_path):
    code, report = again(folder, tmp_path / "done", folder / "done.ply")
    assert code == 0 and report["met"] and report["pieces"][0]["remaining"]["gouged_mm2"] == 0


@pytest.mark.full
@pytest.mark.usefixtures("blank_pictures")
def test_datum_and_field_of_the_scanner_go_through_to_the_stock(folder, tmp_path, capsys):
    """A scan that the scanner bent gives, with its field, the stock of the straight one; the model stays as it is."""
    u, v = np.meshgrid(np.linspace(-0.5, 0.5, 41), np.linspace(-0.5, 0.5, 41), indexing="ij")
    error = np.repeat((0.4 * np.cos(9 * u + 1) * np.cos(7 * v))[:, :, None], 2, axis=2)
    field = FieldCorrection(error, np.array([-0.5, -0.5, 200]), np.array([0.5, 0.5, 600]), np.array([0.0, 0, 1]))
    write_field(field, tmp_path / "field.npz")
    straight = read_cloud(folder / "test.ply", "mm").points
    write_ply(tmp_path / "bent.ply", straight * (1 + field.error_mm(straight) / straight[:, 2])[:, None])
    part = solid().reshape(-1, 3)
    box = [f"{value:.2f}" for value in (*(part.min(axis=0) - 1), *(part.max(axis=0) + 1))]
    words = ["--depth", "0.3", "--datum", *box, "--field-correction", str(tmp_path / "field.npz")]
    scans = [str(folder / "good.stl"), str(tmp_path / "bent.ply")]
    assert main(["grind", *scans, *words, "-o", str(tmp_path / "job")]) == 0
    assert volume_mm3(tmp_path / "job") == pytest.approx(volume_mm3(folder / "job"), rel=0.02)
    wrong = ["--datum", "1", "2", "-o", str(tmp_path / "none")]
    assert main(["grind", *scans, "--depth", "0.3", *wrong]) == 2
    assert "--datum" in capsys.readouterr().err and not (tmp_path / "none").exists()
