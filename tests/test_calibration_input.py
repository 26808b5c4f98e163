"""Bad measurements are refused or named, never calibrated in silence; the command line keeps its contract."""

import json
import re
from dataclasses import replace
from functools import partial

import numpy as np
import pandas as pd
import pytest

from grindvision.arm import forward, read_arm, write_arm
from grindvision.calibration import Measurements, Options, calibrate, cross_validated, read_measurements
from grindvision.cli import main
from grindvision.errors import DegenerateError, FileError, InputError, UnitError
from grindvision.geometry import inverse, move_points
from tests.calibration_rig import as_table, er3a, rig, ur5

#: A case of a law that ``./run laws`` alone holds.
by_night = partial(pytest.param, marks=pytest.mark.full)


@pytest.fixture
def folder(tmp_path, rng):
    made = rig(er3a(), rng, test=12)
    as_table(made.measurements).to_csv(tmp_path / "m.csv", index=False)
    write_arm(er3a(), tmp_path / "r.csv")
    return tmp_path


def command(folder, *more) -> int:
    words = [str(folder / "m.csv"), "--robot", str(folder / "r.csv"), "-o", str(folder / "out")]
    return main(["calibrate", *words, *more])


def changed(folder, **columns) -> None:
    table = pd.read_csv(folder / "m.csv")
    for name, change in columns.items():
        table[name] = change(table[name])
    table.to_csv(folder / "m.csv", index=False)


@pytest.mark.parametrize("joint", [0, 3])
def test_degrees_in_a_radian_column(joint, rng):
    measurements = rig(er3a(), rng).measurements
    q = measurements.q_rad * np.where(np.arange(4) == joint, 180 / np.pi, 1)
    with pytest.raises(UnitError, match=rf"q{joint + 1}_rad .*degrees"):
        calibrate(replace(measurements, q_rad=q), er3a())


def test_small_angles_in_degrees_are_found_by_the_fit(rng):
    made = rig(er3a(), rng)
    narrow = np.where(np.arange(4) == 2, 0.05 * made.measurements.q_rad, made.measurements.q_rad)
    tracker = made.cell.points_tracker(narrow, made.measurements.scanner_mm)
    degrees = narrow * np.where(np.arange(4) == 2, 180 / np.pi, 1)
    with pytest.raises(UnitError, match="q3_rad looks like degrees"):
        calibrate(Measurements(degrees, made.measurements.scanner_mm, tracker), er3a())


@pytest.mark.parametrize("column", ["scanner_mm", "tracker_mm"])
def test_metres_in_all_columns(column, rng):
    measurements = rig(er3a(), rng).measurements
    with pytest.raises(UnitError, match="metres"):
        calibrate(replace(measurements, **{column: getattr(measurements, column) / 1000}), er3a())


@pytest.mark.parametrize(("column", "name"), [("scanner_mm", "sz_mm"), by_night("tracker_mm", "bx_mm")])
def test_metres_in_one_column(column, name, rng):
    measurements = rig(er3a(), rng).measurements
    scale = np.where(np.arange(3) == "xyz".index(name[1]), 1e-3, 1)
    with pytest.raises(UnitError, match=rf"{name} .*metres"):
        calibrate(replace(measurements, **{column: getattr(measurements, column) * scale}), er3a())


def test_an_arm_in_metres(rng):
    arm = er3a().with_table(er3a().table * [1, 1e-3, 1e-3, 1, 1])
    with pytest.raises(UnitError, match=r"robot table looks like metres"):
        calibrate(rig(er3a(), rng).measurements, arm)


def test_fewer_measurements_than_unknowns(rng):
    with pytest.raises(DegenerateError, match="9 different training measurements give 27 equations for 29 unknowns"):
        calibrate(rig(er3a(), rng, rows=9).measurements, er3a())


def test_one_pose_only(rng):
    measurements = rig(er3a(), rng).measurements
    still = np.broadcast_to(measurements.q_rad[0], measurements.q_rad.shape)
    with pytest.raises(DegenerateError, match="same joint angles"):
        calibrate(replace(measurements, q_rad=still), er3a())


def test_not_a_number(rng):
    measurements = rig(er3a(), rng).measurements
    bad = measurements.tracker_mm.copy()
    bad[6, 1] = np.nan
    with pytest.raises(InputError, match="tracker_mm: row 7 holds NaN"):
        replace(measurements, tracker_mm=bad)


def test_copied_rows_are_named_and_counted_once(rng):
    measurements = rig(er3a(), rng).measurements
    doubled = measurements.rows(np.r_[np.arange(54), 3, 4])
    result, plain = calibrate(doubled, er3a()), calibrate(measurements, er3a())
    assert any("2 rows are copies" in sentence and "row 55" in sentence for sentence in result.warnings)
    assert np.allclose(result.covariance, plain.covariance)


@pytest.mark.parametrize(
    ("column", "shift"),
    [
        ("tracker_mm", 1),
        ("q_rad", -1),
        ("scanner_mm", 1),
        by_night("tracker_mm", -1),
        by_night("q_rad", 1),
        by_night("scanner_mm", -1),
    ],
)
def test_a_shifted_pairing(column, shift, rng):
    measurements = rig(er3a(), rng).measurements
    with pytest.raises(InputError, match="shifted by"):
        calibrate(replace(measurements, **{column: np.roll(getattr(measurements, column), shift, axis=0)}), er3a())


@pytest.mark.parametrize("shift", [1, by_night(-1)])
def test_a_shift_is_told_from_slipped_reflectors(shift, rng):
    """Six looks at each sphere: shifted by one, five of six rows still fit, so most of the data look right."""
    made = rig(er3a(), rng, noise_mm=0, joint_rad=0)
    tracker = np.repeat(made.measurements.tracker_mm[::6], 6, axis=0)
    q = made.measurements.q_rad
    poses = made.cell.T_tracker_base @ forward(made.cell.arm, q) @ made.cell.T_joint_scanner
    seen = np.array([move_points(inverse(pose), point) for pose, point in zip(poses, tracker, strict=True)])
    seen = seen + 0.03 * rng.normal(size=seen.shape)
    assert calibrate(Measurements(q, seen, tracker), er3a()).dropped == ()
    with pytest.raises(InputError, match=f"tracker readings are shifted by {shift} "):
        calibrate(Measurements(q, seen, np.roll(tracker, shift, axis=0)), er3a())


def test_a_shift_in_rows_split_at_random(rng):
    made = rig(er3a(), rng, rows=60, test=30)
    mixed = made.measurements.rows(rng.permutation(90))
    with pytest.raises(InputError, match="joint angles are shifted by 1 "):
        calibrate(replace(mixed, q_rad=np.roll(mixed.q_rad, 1, axis=0)), er3a())


def test_wrong_test_rows_are_named(rng):
    made = rig(er3a(), rng, test=20)
    tracker = made.measurements.tracker_mm.copy()
    tracker[60] += [2.0, 0, 0]
    result = calibrate(replace(made.measurements, tracker_mm=tracker), er3a())
    assert result.dropped == ()
    assert result.warnings == ("a test row contradicts the calibration: row 61 (pose 60, sphere 60), 2 mm off",)


def test_a_joint_that_counts_the_other_way(rng):
    measurements = rig(er3a(), rng).measurements
    with pytest.raises(InputError, match="q2_rad counts the other way"):
        calibrate(replace(measurements, q_rad=measurements.q_rad * [1, -1, 1, 1]), er3a())


def test_a_joint_that_counts_the_other_way_where_the_fit_runs_away():
    measurements = rig(er3a(), np.random.default_rng(2), test=12).measurements
    with pytest.raises(InputError, match="q2_rad counts the other way"):
        calibrate(replace(measurements, q_rad=measurements.q_rad * [1, -1, 1, 1]), er3a())


MIRRORED, SWAPPED = np.diag([1.0, 1, -1]), np.eye(3)[[1, 0, 2]]


@pytest.mark.parametrize(
    ("column", "name", "mirror"),
    [
        ("scanner_mm", "sx_mm", MIRRORED),
        ("tracker_mm", "bx_mm", SWAPPED),
        by_night("scanner_mm", "sx_mm", SWAPPED),
        by_night("tracker_mm", "bx_mm", MIRRORED),
    ],
)
def test_a_left_handed_frame(column, name, mirror, rng):
    measurements = rig(er3a(), rng).measurements
    with pytest.raises(InputError, match=f"columns {name} to .* are mirrored"):
        calibrate(replace(measurements, **{column: getattr(measurements, column) @ mirror.T}), er3a())


def test_another_arm(rng):
    with pytest.raises(InputError, match="no arm of this structure fits"):
        calibrate(rig(er3a(), rng).measurements, ur5().first(4))


def test_a_wrong_link_length_is_found_and_named(rng):
    made = rig(er3a(), rng)
    table = er3a().table.copy()
    table[2, 1] = 300.0
    result = calibrate(made.measurements, er3a().with_table(table))
    assert result.arm.table[2, 1] == pytest.approx(made.cell.arm.table[2, 1], abs=0.3)
    assert any("a3_mm moved by" in sentence for sentence in result.warnings)


def test_wrong_rows_are_dropped_and_named(rng):
    made = rig(er3a(), rng, test=50)
    tracker = made.measurements.tracker_mm.copy()
    tracker[[7, 20]] = tracker[[20, 7]]
    tracker[33] += [0.0, 1.5, 0.0]
    result = calibrate(replace(made.measurements, tracker_mm=tracker), er3a())
    assert result.dropped == (7, 20, 33)
    assert sum("contradicts the others: row" in sentence for sentence in result.warnings) == 3
    clean = calibrate(made.measurements, er3a())
    assert clean.dropped == ()
    assert result.errors(train=False).mean < 1.1 * clean.errors(train=False).mean
    with pytest.raises(InputError, match="no arm of this structure fits"):
        calibrate(replace(made.measurements, tracker_mm=tracker), er3a(), Options(robust=False))


def test_too_many_wrong_rows_are_refused(rng):
    measurements = rig(er3a(), rng).measurements
    order = np.where(np.arange(54) < 22, np.random.default_rng(1).permutation(54), np.arange(54))
    with pytest.raises((InputError, DegenerateError)):
        calibrate(replace(measurements, tracker_mm=measurements.tracker_mm[order]), er3a())


def test_one_label_cannot_be_cross_validated(rng):
    measurements = replace(rig(er3a(), rng).measurements, sphere=["a"] * 54, pose=["b"] * 54)
    with pytest.raises(DegenerateError, match="label them"):
        cross_validated(calibrate(measurements, er3a()), Options())


def test_the_command_writes_what_it_promises(folder, capsys):
    assert command(folder) == 0
    assert capsys.readouterr().err == ""
    assert read_arm(folder / "out" / "robot.csv").n == 4
    hand_eye = json.loads((folder / "out" / "hand_eye.json").read_text())
    assert all(np.shape(hand_eye[name]) == (4, 4) for name in ("T_joint_scanner", "T_tracker_base"))
    report = json.loads((folder / "out" / "report.json").read_text())
    assert (report["rank"], report["unknowns"], len(report["singular_values"])) == (22, 29, 29)
    for part in ("train", "test"):
        for when in ("before", "after"):
            assert {"mean", "rms", "max", "std"} <= set(report["errors_mm"][part][when])
    assert report["errors_mm"]["test"]["after"]["mean"] < report["errors_mm"]["test"]["before"]["mean"] / 4
    assert report["standard_deviations"]["d4_mm"] is None
    assert report["standard_deviations"]["a3_mm"] > 0
    assert {"total", "read", "calibrate"} <= set(report["timings_s"])
    assert [item["name"] for item in report["inputs"]] == ["m.csv", "r.csv"]
    assert (folder / "out" / "report.png").stat().st_size > 20_000


@pytest.mark.usefixtures("blank_pictures")
def test_the_command_without_a_split_says_how_it_held_out(folder):
    pd.read_csv(folder / "m.csv").drop(columns="split").to_csv(folder / "m.csv", index=False)
    assert command(folder, "--base-fixed", "--beyond-geometry", "off") == 0
    report = json.loads((folder / "out" / "report.json").read_text())
    assert report["held_out"] == "5-fold cross-validation, whole spheres left out together, seed 0"
    assert report["unknowns"] == 23


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"q1_rad": np.degrees}, "q1_rad"),
        ({"sx_mm": lambda c: c.astype(object).where(c.index != 4, "wrong")}, "row 5, column sx_mm"),
        ({"by_mm": lambda c: c.where(c.index != 2)}, "row 3, column by_mm"),
        ({"split": lambda c: c.where(c.index != 1, "valid")}, "row 2, column split: 'valid'"),
        ({"q1_rad": lambda c: 0 * c, "q2_rad": lambda c: 0 * c, "q3_rad": lambda c: 0 * c, "q4_rad": lambda c: 0 * c},
         "same joint angles"),
    ],
)  # fmt: skip
def test_the_command_refuses_in_one_line(folder, columns, message, capsys):
    changed(folder, **columns)
    assert command(folder) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert not (folder / "out").exists()


@pytest.mark.usefixtures("blank_pictures")
def test_a_table_parted_by_blanks_gives_the_same_cell(folder):
    assert command(folder) == 0
    first = json.loads((folder / "out" / "hand_eye.json").read_text())
    for name in ("m.csv", "r.csv"):
        pd.read_csv(folder / name).to_csv(folder / name, index=False, sep=" ")
    assert command(folder) == 0
    again = json.loads((folder / "out" / "hand_eye.json").read_text())
    for name, pose in first.items():
        np.testing.assert_allclose(again[name], pose, atol=1e-9)


def test_a_file_of_another_arm(folder):
    with pytest.raises(FileError, match=r"m.csv: 4 columns of joint angles .* but the robot table has 6 joints"):
        read_measurements(folder / "m.csv", 6)
    table = pd.read_csv(folder / "m.csv").rename(columns={"q2_rad": "q9_rad"})
    table.to_csv(folder / "m.csv", index=False)
    with pytest.raises(FileError, match="column q2_rad missing"):
        read_measurements(folder / "m.csv", 4)


def test_covariance_columns_are_read(folder):
    table = pd.read_csv(folder / "m.csv")
    for name, value in {"sxx": 1, "sxy": 0.1, "sxz": 0.2, "syy": 2, "syz": 0.3, "szz": 3}.items():
        table[f"{name}_mm2"] = value
    table.to_csv(folder / "m.csv", index=False)
    covariance = read_measurements(folder / "m.csv", 4).scanner_covariance_mm2
    assert covariance is not None and covariance[5].tolist() == [[1, 0.1, 0.2], [0.1, 2, 0.3], [0.2, 0.3, 3]]


def test_a_column_that_is_named_goes_before_the_files_own_in_another_unit(tmp_path):
    """It was read from the file's own column, without a word."""
    head = "q1_rad,joint,sx_mm,sy_mm,sz_mm,bx_mm,bx_m,by_mm,bz_mm"
    (tmp_path / "m.csv").write_text(f"{head}\n9,90,0,0,0,1,7,2,3\n9,45,0,0,0,1,7,2,4\n")
    found = read_measurements(tmp_path / "m.csv", 1, {"q1_deg": "joint", "bx_m": "bx_m"})
    np.testing.assert_allclose(found.q_rad[:, 0], np.radians([90, 45]))
    assert found.tracker_mm[0, 0] == 7000


def test_a_tracked_arm_needs_neither_labels_nor_scanner_columns(tmp_path, rng):
    made = rig(er3a(), rng, rows=80, on_tool=True, off_mm=0, off_rad=0)
    table = as_table(made.measurements, split=False).drop(columns=["pose", "sphere", "sx_mm", "sy_mm", "sz_mm"])
    for i in range(1, 5):
        table[f"joint {i}"] = np.degrees(table.pop(f"q{i}_rad"))
    table["half"] = table["bx_mm"] / 2
    table["other half"] = table.pop("bx_mm") / 2
    table.to_csv(tmp_path / "m.csv", index=False)
    columns = {f"q{i}_deg": f"joint {i}" for i in range(1, 5)} | {"bx_mm": "half+other half"}
    found = read_measurements(tmp_path / "m.csv", 4, columns)
    assert found.on_tool and read_measurements(tmp_path / "m.csv", columns=columns).q_rad.shape == (80, 4)
    np.testing.assert_allclose(found.q_rad, made.measurements.q_rad, atol=1e-12)
    np.testing.assert_allclose(found.tracker_mm, made.measurements.tracker_mm, atol=1e-9)
    with pytest.raises(InputError, match="'q1' is no column of a measurement table"):
        read_measurements(tmp_path / "m.csv", 4, {"q1": "joint 1"})


def test_a_pose_visited_again_counts_as_one_pose(tmp_path, rng):
    """Its readings share the arm's error there: held out one by one, they would flatter the result."""
    made = rig(er3a(), rng, rows=20, on_tool=True).measurements
    order = rng.permutation(60) % 20
    again = replace(made.rows(order), q_rad=made.q_rad[order] + rng.uniform(-4e-5, 4e-5, (60, 4)))
    table = as_table(again, split=False).drop(columns=["pose", "sphere", "sx_mm", "sy_mm", "sz_mm"])
    table.to_csv(tmp_path / "m.csv", index=False)
    found = read_measurements(tmp_path / "m.csv", 4)
    assert all(len(set(labels)) == 20 for labels in (found.pose, found.sphere))
    assert ((found.pose[:, None] == found.pose) == (order[:, None] == order)).all()
    drawn = found.drawn(31, rng).train
    assert all(len(set(drawn[order == pose])) == 1 for pose in range(20))


def test_rows_drawn_to_train_keep_poses_together(rng):
    measurements = rig(er3a(), rng, rows=60).measurements
    pose = np.repeat(np.arange(20), 3).astype(str)
    drawn = replace(measurements, pose=pose).drawn(31, np.random.default_rng(4))
    assert drawn.train.sum() == 33
    assert (drawn.train.reshape(20, 3) == drawn.train.reshape(20, 3)[:, :1]).all()
    assert replace(measurements, pose=None).drawn(31, rng).train.sum() == 31
    with pytest.raises(InputError, match="choose 1 to 59"):
        measurements.drawn(60, rng)


def test_a_mirrored_tracker_is_not_taken_for_a_joint_that_counts_the_other_way(rng):
    made = rig(ur5(), rng, rows=60, on_tool=True)
    q = np.hstack([made.measurements.q_rad[:, :3], 0.1 * made.measurements.q_rad[:, 3:]])  # the wrist hardly turns
    tracker = made.cell.points_tracker(q, made.measurements.scanner_mm)
    mirrored = replace(made.measurements, q_rad=q, tracker_mm=tracker * [1, -1, 1])
    with pytest.raises(InputError, match="bx_mm to bz_mm are mirrored"):
        calibrate(mirrored, ur5())


@pytest.mark.parametrize("pair", [by_night((0, 1)), (1, 2), by_night((3, 4))])
def test_two_columns_of_joints_swapped(pair, rng):
    made = rig(ur5(), rng, rows=60, on_tool=True)
    order = np.arange(6)
    order[list(pair)] = pair[::-1]
    with pytest.raises(InputError, match=f"columns q{pair[0] + 1} and q{pair[1] + 1} are swapped"):
        calibrate(replace(made.measurements, q_rad=made.measurements.q_rad[:, order]), ur5())


def test_a_standard_table_that_no_fit_mends(rng):
    standard = ur5().table.copy()
    standard[:, :2] = np.roll(standard[:, :2], -1, axis=0)
    with pytest.raises(InputError, match="a standard DH table: move alpha and a one row down"):
        calibrate(rig(ur5(), rng, on_tool=True).measurements, ur5().with_table(standard), Options(free=("d1_mm",)))


@pytest.mark.parametrize("seed", [2, by_night(3), by_night(4)])
def test_a_tracked_tool_has_no_scans_that_could_be_shifted(seed):
    """Its scanner's columns are constant: shifting them changes nothing, and so explains nothing."""
    rng = np.random.default_rng(seed)
    made = rig(ur5(), rng, rows=60, on_tool=True)
    tracker = made.measurements.tracker_mm.copy()
    tracker[:6] += 0.27 * np.sign(rng.normal(size=(6, 3)))
    result = calibrate(replace(made.measurements, tracker_mm=tracker), ur5())
    assert set(result.dropped) <= set(range(6))


def test_many_dropped_rows_are_named_in_one_sentence(rng):
    made = rig(er3a(), rng, rows=80)
    tracker = made.measurements.tracker_mm.copy()
    tracker[:12] += rng.normal(0, 20, (12, 3))
    result = calibrate(replace(made.measurements, tracker_mm=tracker), er3a())
    assert len(result.dropped) == 12
    (said,) = (sentence for sentence in result.warnings if "left out, they" in sentence)
    assert re.match(r"12 rows were left out, they contradict the others, \S+ to \S+ mm: row 1 ", said)


def test_few_rows_are_cross_validated_one_by_one(rng):
    made = rig(ur5(), rng, rows=13, on_tool=True)
    result = calibrate(made.measurements, ur5())
    assert cross_validated(result, Options()).how.startswith("13-fold")


@pytest.mark.usefixtures("blank_pictures")
def test_a_robot_table_without_tilts_and_names(folder):
    table = pd.read_csv(folder / "r.csv")
    assert (table["beta_rad"] == 0).all()
    table.drop(columns=["beta_rad", "joint"]).to_csv(folder / "r.csv", index=False)
    assert command(folder) == 0
    assert read_arm(folder / "r.csv").joints == ("J1", "J2", "J3", "J4")


def test_a_first_line_of_numbers_is_told_from_names(folder, capsys):
    pd.read_csv(folder / "m.csv").drop(columns=["pose", "sphere", "split"]).to_csv(
        folder / "m.csv", index=False, header=False
    )
    assert command(folder) == 2
    assert "the first line holds numbers; write the columns' names above it" in capsys.readouterr().err
