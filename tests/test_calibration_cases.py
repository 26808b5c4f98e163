"""Every kind of rig and of mistake that ``calibrate`` has met: right, or named with its size, or refused by name."""

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from grindvision.arm import MdhArm, read_arm, write_arm
from grindvision.calibration import Measurements, Options, calibrate, predict_errors, residuals_of
from grindvision.calibration.joint_terms import JointCorrections, JointTerm
from grindvision.errors import GrindvisionError, GrindvisionWarning
from tests.calibration_rig import Rig, er3a, rig, ur5

RNG_SEED = 11


def tracked(rng, rows=60, **more) -> Rig:
    return rig(ur5(), rng, rows=rows, on_tool=True, base="far", **more)


def scanned(rng, rows=54, **more) -> Rig:
    return rig(er3a(), rng, rows=rows, base="far", **more)


def measured_again(made: Rig, q=None, points=None, rng=None) -> Measurements:
    """The rows with the tool at other angles ``q`` or the ball at other ``points`` than the file says."""
    rows = made.measurements
    where = made.cell.points_tracker(rows.q_rad if q is None else q, rows.scanner_mm if points is None else points)
    return replace(rows, tracker_mm=where + 0.05 * rng.normal(size=where.shape))


def with_columns(made: Rig, change: Callable[[np.ndarray], np.ndarray], column: str = "q_rad") -> Measurements:
    return replace(made.measurements, **{column: change(getattr(made.measurements, column).copy())})


def bars(made: Rig, rng, too_long_mm=0.0, from_row=0) -> Measurements:
    rows, socket = made.measurements, np.array([300.0, 200.0, 100.0])
    length = np.linalg.norm(made.cell.points_tracker(rows.q_rad, rows.scanner_mm) - socket, axis=1)
    length += 0.02 * rng.normal(size=len(rows)) + too_long_mm * (np.arange(len(rows)) >= from_row)
    number, names = np.zeros(len(rows), int), (("socket", "a"),)
    nowhere = np.zeros((len(rows), 3))
    return Measurements(rows.q_rad, rows.scanner_mm, nowhere, fixture=number, fixtures=names, bar_mm=length)


def for_bars(rng) -> Rig:
    return rig(ur5(), rng, 150, noise_mm=0, joint_rad=0, on_tool=True, base="same", off_mm=0.3, off_rad=3e-4)


def shuffled(rng) -> Measurements:
    made = tracked(rng)
    return with_columns(made, lambda points: points[rng.permutation(len(points))], "tracker_mm")


def turned(factor, column="q_rad") -> Callable[[np.random.Generator], Measurements]:
    return lambda rng: with_columns(tracked(rng), lambda values: values * factor, column)


REFUSED = {
    "one joint in gradians": (turned(np.where(np.arange(6) == 2, 1 / 0.9, 1.0)), "q3_rad looks like gradians"),
    "all joints in gradians": (turned(1 / 0.9), "q1_rad to q6_rad look like gradians"),
    "all joints in radians, named degrees": (turned(np.pi / 180), "q1_rad to q6_rad look like radians"),
    "milliradians": (turned(1000.0), "milliradians"),
    "one axis in inches": (turned([1.0, 1 / 25.4, 1.0], "tracker_mm"), "by_mm in inches"),
    "rows shuffled": (shuffled, "every row pairs a pose with its own point"),
    "no row to train": (lambda rng: replace(tracked(rng).measurements, train=np.zeros(60, bool)), "marked train"),
}


#: That of all joints takes longest, and one joint is like it.
BY_NIGHT = ("all joints in gradians",)


@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=pytest.mark.full) if kind in BY_NIGHT else kind for kind in REFUSED]
)
def test_what_cannot_be_used_is_refused_by_name(kind):
    make, said = REFUSED[kind]
    measurements = make(np.random.default_rng(RNG_SEED))
    with pytest.raises(GrindvisionError, match=said):
        calibrate(measurements, ur5())


def slipped(rng, size_mm=0.9) -> Measurements:
    made = tracked(rng)
    after = (np.arange(60) >= 30)[:, None]
    return measured_again(
        made, points=made.measurements.scanner_mm + after * size_mm * np.array([0.6, 0, 0.8]), rng=rng
    )


def bumped(rng) -> Measurements:
    made = scanned(rng)
    after = np.arange(54) >= 27
    moved = made.measurements.scanner_mm + after[:, None] * [0.6, 0.0, 0.8]
    return measured_again(made, points=moved, rng=rng)


def moved_twice(rng) -> Measurements:
    between = (np.arange(60) >= 20) & (np.arange(60) < 40)
    return with_columns(tracked(rng), lambda points: points + np.outer(between, [1.0, 0, 0]), "tracker_mm")


def growing(rng) -> Measurements:
    made = tracked(rng)
    tracker = made.measurements.tracker_mm
    away = tracker - tracker.mean(axis=0)
    return replace(made.measurements, tracker_mm=tracker + away * np.linspace(0, 1e-3, 60)[:, None])


def track() -> MdhArm:
    table = np.vstack([np.zeros(5), ur5().table])
    table[1, [0, 3]] = -np.pi / 2
    return MdhArm(table, ("track", *ur5().joints), (True,) + 6 * (False,))


def slow_track(rng) -> Measurements:
    made = rig(track(), rng, rows=80, on_tool=True)
    q = made.measurements.q_rad * ([1000.0] + 6 * [1.0])
    rows = measured_again(made, q=q, rng=rng)
    return replace(rows, q_rad=q * [1.002, *6 * [1.0]])


def deep(rng) -> Measurements:
    return with_columns(scanned(rng), lambda points: points * [1, 1, 1.01], "scanner_mm")


def long_bar(rng) -> Measurements:
    return bars(for_bars(rng), rng, 10.0)


def other_bar(rng) -> Measurements:
    return bars(for_bars(rng), rng, 1.0, 75)


NAMED = {
    "reflector slips by 0.9 mm": (slipped, ur5, "slip", r"by 0\.(8\d|9\d?) mm at row 31 .*the reflector or the tip"),
    "scanner moved on its flange": (bumped, er3a, "slip", r"at row 28 .*the scanner was moved on it"),
    "tracker moved and moved back": (moved_twice, ur5, "jump", r"by (1|0\.9\d?|1\.\d) mm .* at row (21|41)"),
    "arm warms up": (growing, ur5, "drift", r"lengths grow by 0\.(09|1)\d?%"),
    "scanner's depth 1 % too long": (deep, er3a, "scanner depth", r"(0\.9\d|1\.0\d)% too long"),
    "ball bar 10 mm too long": (long_bar, ur5, "bar", r"\d mm shorter than bar_mm"),
    "another ball bar from the middle on": (other_bar, ur5, "bar", r"row 76 .*along the ball bar"),
    "a track whose unit is 0.2 % off": (slow_track, track, "joint scale", r"joint 1: it moves 0\.998"),
}


@pytest.mark.parametrize("kind", NAMED)
def test_what_went_wrong_in_the_session_is_named_with_its_size(kind):
    make, arm, cause, said = NAMED[kind]
    findings = calibrate(make(np.random.default_rng(RNG_SEED)), arm()).findings
    assert cause in [finding.kind for finding in findings]
    assert any(re.search(said, finding.sentence) for finding in findings if finding.kind == cause)


def test_rows_of_ball_bars_are_not_dropped_for_saying_one_thing_each(rng):
    assert calibrate(bars(for_bars(rng), rng), ur5()).dropped == ()


def test_a_zero_counted_from_elsewhere_is_mended_and_named(rng):
    made = tracked(rng)
    result = calibrate(with_columns(made, lambda q: q - np.radians(30) * np.eye(6)[2]), ur5())
    assert np.abs(residuals_of(result.cell, result.measurements)).max() < 0.5
    assert any("theta3_rad moved by 0.52" in told and "its zero is counted from" in told for told in result.warnings)


def test_one_mistyped_length_is_mended_and_named(rng):
    made = tracked(rng)
    table = ur5().table.copy()
    table[2, 1] = -452.0
    told = calibrate(made.measurements, ur5().with_table(table)).warnings
    assert any(re.search(r"a3_mm moved by 2\d(\.\d+)? mm .*mistyped there", sentence) for sentence in told)


def test_an_arm_that_is_held_says_what_it_leaves_and_predicts_no_less(rng):
    made = scanned(rng, rows=12, off_mm=1.5, off_rad=2e-3)
    result = calibrate(made.measurements, er3a(), Options(free=()))
    assert any("with the robot table held as it is" in told for told in result.warnings)
    assert predict_errors(result, rng, count=200).mean_mm > 0.8 * result.errors(train=True).mean


def test_the_table_of_a_calibrated_positioner_can_be_read_again(tmp_path):
    write_arm(MdhArm([[0, 0, 0, 0, 0], [-np.pi / 2, 0.64, 0.1, np.pi / 2, 0]], ("tilt", "turn")), tmp_path / "r.csv")
    with pytest.warns(GrindvisionWarning, match="as of a positioner"):
        assert read_arm(tmp_path / "r.csv").table[1, 1] == 0.64


def test_a_known_distance_of_sockets_is_held_against_the_arm(rng):
    made = rig(ur5(), rng, rows=60, on_tool=True, base="same", noise_mm=0, joint_rad=0, off_mm=0.3, off_rad=3e-4)
    places = np.array([[350.0, 250.0, 200.0], [350.0, 550.0, 200.0]])
    number = np.arange(60) % 2
    q = _angles_that_touch(made, places[number], rng)
    rows = Measurements(
        q, made.measurements.scanner_mm, np.zeros((60, 3)), fixture=number,
        fixtures=(("socket", "a"), ("socket", "b")), distances_mm=((0, 1, 310.0),),
    )  # fmt: skip
    told = calibrate(rows, ur5(), Options(diagnose=False)).warnings
    assert any("distance_mm is 310 between sockets a and b" in sentence for sentence in told)
    good = replace(rows, distances_mm=((0, 1, 300.0),))
    assert not any("distance_mm" in sentence for sentence in calibrate(good, ur5(), Options(diagnose=False)).warnings)
    with pytest.raises(GrindvisionError, match="distance_mm is 30 between"):
        calibrate(replace(rows, distances_mm=((0, 1, 30.0),)), ur5())


def _angles_that_touch(made: Rig, places: np.ndarray, rng) -> np.ndarray:
    """Joint angles (M, 6) that bring the reflector to the places (M, 3): Newton steps from random starts."""
    from grindvision.calibration.model import carry

    q = np.empty((len(places), 6))
    for row, place in enumerate(places):
        for _ in range(50):
            angles = rng.uniform(-1.5, 1.5, (1, 6))
            for _ in range(30):
                points = carry(made.cell, angles, made.measurements.scanner_mm[:1])
                off = place - points.tracker_mm[0]
                angles = angles + np.linalg.lstsq(points.jacobian()[0], off, rcond=1e-3)[0]
            if np.linalg.norm(off) < 1e-6 and np.abs(angles).max() < 6:
                break
        q[row] = angles[0]
    return q + 2e-5 * rng.normal(size=q.shape)


def test_waves_that_look_like_slips_are_not_called_slips(rng):
    made = tracked(rng, rows=80)
    terms = (JointTerm(1, "sin", 2.0), JointTerm(2, "cos"))
    cell = replace(made.cell, corrections=JointCorrections(terms, (5e-4, 5e-4)))
    rows = measured_again(replace(made, cell=cell), rng=rng)
    assert {finding.kind for finding in calibrate(rows, ur5()).findings} <= {"wave", "sag"}
