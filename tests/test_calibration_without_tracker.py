"""Spheres that rest in unknown places calibrate the arm as well as a tracker does; what they cannot tell is said."""

import json

import numpy as np
import pytest

from grindvision import cell
from grindvision.arm import write_arm
from grindvision.calibration import Measurements, Options, calibrate
from grindvision.cli import main
from grindvision.geometry import fit_rigid

JOINTS = [f"q{i}_rad" for i in range(1, 5)]
SEEN, TRACKED = ([f"{frame}{axis}_mm" for axis in "xyz"] for frame in "sb")


def twin(seed, spheres, directions):
    """The table of the twin's experiment, and which rows are for the fit."""
    made = cell.calibration_experiment(np.random.default_rng(seed), spheres, directions, 10 if spheres > 1 else 3)
    return made.table, made.plan.train


def measured(table, tracked):
    """Rows of a table as tracked, or as spheres that rest where nobody knows."""
    q, seen, places = (table[names].to_numpy(dtype=float) for names in (JOINTS, SEEN, TRACKED))
    if tracked:
        return Measurements(q, seen, places)
    names = list(dict.fromkeys(table["sphere"]))
    fixture = np.array([names.index(name) for name in table["sphere"]])
    return Measurements(q, seen, 0 * places, fixture=fixture, fixtures=tuple(("socket", str(name)) for name in names))


def held_out_mm(found, table):
    """Mean distance of held-out spheres from their true places, base and tracker laid onto each other."""
    placed = found.cell.points_tracker(table[JOINTS].to_numpy(), table[SEEN].to_numpy())
    return np.linalg.norm(fit_rigid(placed, table[TRACKED].to_numpy()).residuals_mm, axis=1).mean()


@pytest.mark.parametrize(
    ("spheres", "directions", "seed"),
    [
        (9, 6, 1),
        (1, 54, 2),
        pytest.param(9, 6, 2, marks=pytest.mark.full),
        pytest.param(1, 54, 1, marks=pytest.mark.full),
    ],
)
def test_within_one_and_a_half_times_the_tracker(spheres, directions, seed):
    table, train = twin(seed, spheres, directions)
    options = Options(diagnose=False)
    tracker, alone = (
        calibrate(measured(table[train], tracked), cell.nominal_arm(), options) for tracked in (True, False)
    )
    with_tracker, without = (held_out_mm(found, table[~train]) for found in (tracker, alone))
    assert with_tracker < 0.15 and without < 1.5 * with_tracker
    assert without < 0.5 * alone.errors(train=True, before=True).mean


def test_the_command_takes_a_sphere_at_rest_and_says_what_it_cannot_know(tmp_path):
    table, train = twin(3, 1, 54)
    rows = table[train].drop(columns=[*TRACKED, "split"], errors="ignore").assign(socket="ball")
    rows.to_csv(tmp_path / "m.csv", index=False)
    write_arm(cell.nominal_arm(), tmp_path / "r.csv")
    words = ["calibrate", str(tmp_path / "m.csv"), "--robot", str(tmp_path / "r.csv"), "-o", str(tmp_path / "arm")]
    assert main(words) == 0
    report = json.loads((tmp_path / "arm" / "report.json").read_text())
    assert report["rank"] < report["unknowns"]
    assert report["errors_mm"]["train"]["after"]["mean"] < 0.1 < report["errors_mm"]["train"]["before"]["mean"]
