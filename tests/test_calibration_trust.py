"""What a calibration says of itself: structure in residuals, errors predicted, units, couplings, sockets, verdicts."""

import json
import re
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from benchmarks.coverage import coverage
from grindvision.arm import MdhArm, forward, write_arm
from grindvision.arm.controllers import common_normal_table, standard_table, ur_deltas_text
from grindvision.arm.urdf_chain import urdf_chain, write_corrected_urdf
from grindvision.arm.urdf_masses import link_masses
from grindvision.calibration import (
    Measurements,
    Options,
    calibrate,
    diagnose_trust,
    error_statistics,
    on_test_rows,
    predict_errors,
    read_measurements,
    residuals_of,
    suggest_poses,
)
from grindvision.calibration.joint_terms import GravityLoad, JointCorrections, JointTerm, sag_terms, uniform_load
from grindvision.calibration.model import carry, moved_cell
from grindvision.calibration.unknowns import Unknowns
from grindvision.cli import main
from grindvision.errors import DegenerateError, FileError, InputError, UnitError
from grindvision.geometry import inverse, rigid, rotation_about
from grindvision.paper import data_folder
from tests.calibration_rig import er3a, rig, ur5


def test_joint_terms_have_the_jacobian_of_finite_differences(rng):
    made = rig(ur5(), rng, rows=5, on_tool=True)
    q = made.measurements.q_rad
    terms = (JointTerm(1, "cos", 2.0), JointTerm(2, "coupling", source=1), *sag_terms(uniform_load(ur5()), 3 * q))
    cell = replace(made.cell, corrections=JointCorrections(terms, (0.0,) * len(terms)))
    unknowns = Unknowns(0, (), 0, terms)
    design = carry(cell, q, made.measurements.scanner_mm).design(unknowns)
    for number in range(len(terms)):
        step = 1e-6 * np.eye(len(terms))[number]
        ahead, behind = (moved_cell(cell, unknowns, sign * step) for sign in (1, -1))
        ends = [one.points_tracker(q, made.measurements.scanner_mm) for one in (ahead, behind)]
        np.testing.assert_allclose(design[:, :, number], (ends[0] - ends[1]) / 2e-6, atol=1e-3)


def kinds(measurements, arm) -> list[str]:
    return [finding.kind for finding in calibrate(measurements, arm).findings]


def test_clean_measurements_have_no_structure():
    assert [kinds(rig(ur5(), np.random.default_rng(seed), on_tool=True).measurements, ur5()) for seed in range(4)] == [
        []
    ] * 4


def test_a_drift_a_jump_and_a_wrong_scale_are_named_with_their_size(rng):
    made = rig(er3a(), rng, rows=60)
    tracker, rows = made.measurements.tracker_mm, np.arange(60)
    drift = replace(made.measurements, tracker_mm=tracker + np.outer(rows / 59, [0.0, 1.0, 0.0]))
    (found,) = calibrate(drift, er3a()).findings
    assert found.kind == "drift" and "drifts by 1 mm" in found.sentence
    jump = calibrate(replace(made.measurements, tracker_mm=tracker + np.outer(rows >= 37, [0.6, 0, 0.8])), er3a())
    assert jump.findings[0].kind == "jump" and "at row 38" in jump.findings[0].sentence
    assert jump.findings[0].size_mm == pytest.approx(np.sqrt(23 / 60), rel=0.1)
    scaled = calibrate(replace(made.measurements, scanner_mm=1.01 * made.measurements.scanner_mm), er3a())
    assert scaled.findings[0].kind == "scanner scale" and "too long" in scaled.findings[0].sentence


def test_the_chance_of_a_drift_is_that_of_the_f_test_times_how_many_structures_were_tried(rng):
    made = rig(er3a(), rng, rows=30)
    drift = np.outer(np.linspace(0, 1, 30), [0.0, 0.6, 0.0])
    result = calibrate(replace(made.measurements, tracker_mm=made.measurements.tracker_mm + drift), er3a())
    found = next(finding for finding in result.findings if finding.kind == "drift")
    spare = 3 * 30 - 6  # each unknown has a prior, an equation of its own
    ratio = (found.explained / 6) / ((1 - found.explained) / spare)
    tried = found.p_value / stats.f.sf(ratio, 6, spare)
    assert 10 < tried < 500 and tried == pytest.approx(round(tried), rel=1e-9)


def wavy(rng, rows=80):
    made = rig(ur5(), rng, rows=rows, on_tool=True)
    terms = (JointTerm(1, "sin", 2.0), JointTerm(2, "cos"), JointTerm(0, "cos", 2.0))
    cell = replace(made.cell, corrections=JointCorrections(terms, (5e-4, 4e-4, 5e-4)))
    noise = 0.03 * rng.normal(size=(rows, 3))
    tracker = cell.points_tracker(made.measurements.q_rad, made.measurements.scanner_mm) + noise
    return replace(made.measurements, tracker_mm=tracker)


def test_waves_widen_sigmas_and_are_taken_only_where_held_out_poses_gain(rng):
    measurements = wavy(rng)
    result = calibrate(measurements, ur5(), Options(beyond_geometry=True))
    assert "wave" in [finding.kind for finding in result.findings]
    assert result.beyond is not None and "gear waves" in result.beyond.kind
    assert result.beyond.tried[result.beyond.kind].rms < 0.7 * result.beyond.tried["geometry alone"].rms
    plain = calibrate(measurements, ur5(), Options(diagnose=False))
    known = np.isfinite(result.std) & result.unknowns.in_table
    assert np.mean(result.std[known] / plain.std[known]) > 1.2
    clean = rig(ur5(), rng, rows=60, on_tool=True).measurements
    assert calibrate(clean, ur5(), Options(beyond_geometry=True)).beyond is None


def test_waves_of_any_number_a_turn_are_found_and_lower_the_error_of_poses_never_fitted(rng):
    made = rig(ur5(), rng, rows=80, test=400, on_tool=True, noise_mm=0.03)
    planted = {0: 12.0, 1: 21.0}
    terms = tuple(JointTerm(joint, "cos", order) for joint, order in planted.items())
    cell = replace(made.cell, corrections=JointCorrections(terms, (3e-4, 3e-4)))
    rows = made.measurements
    tracker = cell.points_tracker(rows.q_rad, rows.scanner_mm) + 0.03 * rng.normal(size=(480, 3))
    result = calibrate(replace(rows, tracker_mm=tracker), ur5(), Options(beyond_geometry=True))
    assert result.beyond is not None and result.beyond.kind.startswith("gear waves found")
    assert all(min(abs(np.subtract(result.beyond.waves[joint], order))) <= 1 for joint, order in planted.items())
    unseen = on_test_rows(result)
    assert unseen.beyond.mean < 0.6 * unseen.after.mean
    told = [finding.sentence for finding in result.findings if finding.kind == "wave"]
    assert any("12 times a turn of joint 1" in sentence for sentence in told)
    assert any("21 times a turn of joint 2" in sentence for sentence in told)


@pytest.mark.parametrize(("factor", "unit"), [(25.4, "inches"), (10, "centimetres"), (304.8, "feet"), (3.7, "3.7")])
def test_tracker_lengths_in_another_unit(factor, unit, rng):
    measurements = rig(ur5(), rng, rows=60, on_tool=True, base="far").measurements
    with pytest.raises(UnitError, match=unit):
        calibrate(replace(measurements, tracker_mm=measurements.tracker_mm / factor), ur5())


@pytest.mark.parametrize("ratio", [1.0, -1.0])
def test_a_coupled_joint_in_a_sweep_is_refused_by_name(ratio, rng):
    made = rig(ur5(), rng, rows=60, on_tool=True)
    q = np.tile([0.2, -0.8, 0.9, 0.3, 0.8, 0.1], (60, 1))
    for joint in range(6):
        q[10 * joint : 10 * joint + 10, joint] += np.linspace(-1, 1, 10)
    tracker = made.cell.points_tracker(q, made.measurements.scanner_mm) + 0.02 * rng.normal(size=(60, 3))
    shown = q.copy()
    shown[:, 2] -= ratio * q[:, 1]
    with pytest.raises((InputError, DegenerateError), match="joint 3 is coupled to joint 2"):
        calibrate(Measurements(shown, made.measurements.scanner_mm, tracker), ur5())


def test_errors_foreseen_tell_near_from_far_and_suggested_poses_help(rng):
    made = rig(ur5(), rng, rows=60, on_tool=True)
    q = 0.1 * made.measurements.q_rad + [0.3, -0.9, 0.9, 0.2, 0.7, 0.1]
    tracker = made.cell.points_tracker(q, made.measurements.scanner_mm) + 0.05 * rng.normal(size=(60, 3))
    result = calibrate(replace(made.measurements, q_rad=q, tracker_mm=tracker), ur5())
    predicted = predict_errors(result, rng, count=300)
    assert predicted.mean_mm > 5 * predicted.measured_mean_mm
    assert diagnose_trust(predicted, 0.08) and not diagnose_trust(predicted, 10.0)
    true = made.cell.points_tracker(predicted.q_rad, made.measurements.scanner_mm[:1].repeat(300, axis=0))
    found = result.cell.points_tracker(predicted.q_rad, made.measurements.scanner_mm[:1].repeat(300, axis=0))
    actual = np.linalg.norm(found - true, axis=1).mean()
    assert actual / 3 < predicted.mean_mm < 6 * actual
    suggestion = suggest_poses(result, predicted, 6, rng)
    assert (np.diff(suggestion.mean_mm) <= 1e-9).all() and suggestion.mean_mm[-1] < 0.5 * predicted.mean_mm
    with pytest.raises(InputError, match="name a box"):
        predict_errors(result, rng, [[5000, 0, 0], [6000, 1, 1]])


def test_a_prismatic_joint_slides_along_its_axis(rng, tmp_path):
    track = MdhArm(np.vstack([[-np.pi / 2, 0, 0, 0, 0], ur5().table]), ("track", *ur5().joints), (True,) + 6 * (False,))
    write_arm(track, tmp_path / "r.csv")
    q = rng.uniform(-1, 1, (1, 7))
    ends = forward(track, q + [[100.0, 0, 0, 0, 0, 0, 0]]), forward(track, q)
    np.testing.assert_allclose((ends[0] - ends[1])[0, :3, 3], [0, 100, 0], atol=1e-9)
    made = rig(track, rng, rows=80, on_tool=True)
    q = made.measurements.q_rad * ([1000.0] + 6 * [1.0])
    tracker = made.cell.points_tracker(q, made.measurements.scanner_mm) + 0.02 * rng.normal(size=(80, 3))
    result = calibrate(replace(made.measurements, q_rad=q, tracker_mm=tracker), track)
    assert result.errors(train=True).mean < 0.05


def test_balls_in_sockets_bars_and_planes_are_constraints_of_the_same_fit(rng):
    made = rig(ur5(), rng, rows=200, noise_mm=0, joint_rad=0, on_tool=True, base="same", off_mm=0.3, off_rad=3e-4)
    q = made.measurements.q_rad
    frames = forward(made.cell.arm, q) @ made.cell.T_joint_scanner
    points = np.einsum("mij,mj->mi", frames[:, :3, :3], made.measurements.scanner_mm) + frames[:, :3, 3]
    socket = np.array([300.0, 200.0, 100.0])
    bar = np.linalg.norm(points - socket, axis=1) + 0.02 * rng.normal(size=200)
    measured = Measurements(
        q, made.measurements.scanner_mm, np.zeros((200, 3)), fixture=np.zeros(200, int), fixtures=(("socket", "a"),),
        bar_mm=bar,
    )  # fmt: skip
    result = calibrate(measured, ur5(), Options(diagnose=False))
    assert result.errors(train=True).mean < 0.1 < result.errors(train=True, before=True).mean
    assert np.abs(result.cell.fixtures_mm[0, :3] - socket).max() < 5


def test_whole_poses_are_read_as_points_of_one_pose(rng, tmp_path):
    made = rig(ur5(), rng, rows=4, on_tool=True)
    columns = {f"q{i + 1}_rad": made.measurements.q_rad[:, i] for i in range(6)}
    columns |= {f"b{axis}_mm": made.measurements.tracker_mm[:, i] for i, axis in enumerate("xyz")}
    columns |= {f"br{axis}_deg": np.array([0, 0, 90 * (axis == "z"), 0]) for axis in "xyz"}
    pd.DataFrame(columns).to_csv(tmp_path / "m.csv", index=False)
    found = read_measurements(tmp_path / "m.csv")
    assert len(found) == 16 and len(set(found.pose)) == 4
    np.testing.assert_allclose(found.tracker_mm[9] - found.tracker_mm[8], [0, 150, 0], atol=1e-9)


def test_columns_may_be_subtracted(rng, tmp_path):
    pd.DataFrame({"A": [1.0, 2], "B-x": [0.5, 0.25], "c": [1.0, 1]}).to_csv(tmp_path / "t.csv", index=False)
    from grindvision.files import read_table

    read = read_table(tmp_path / "t.csv", ("d",), (), {"d": "A-B-x-c"})
    assert read["d"].tolist() == [-0.5, 0.75]
    assert read_table(tmp_path / "t.csv", ("d",), (), {"d": "-A"})["d"].tolist() == [-1, -2]
    with pytest.raises(FileError, match="column nothing missing"):
        read_table(tmp_path / "t.csv", ("d",), (), {"d": "A-nothing"})


def chain(table, q):
    T = np.eye(4)
    for (theta, d, a, alpha, *beta), angle in zip(table, q, strict=True):
        T = T @ rigid(rotation_about([0, 0, 1], theta + angle), [0, 0, 0]) @ rigid(translation_mm=[0, 0, d])
        T = T @ rigid(rotation_about([1, 0, 0], alpha), [0, 0, 0]) @ rigid(translation_mm=[a, 0, 0])
        T = T @ rigid(rotation_about([0, 1, 0], beta[0] if beta else 0.0), [0, 0, 0])
    return T


def test_standard_tables_make_the_same_arm(rng):
    arm = rig(ur5(), rng).cell.arm
    for q in rng.uniform(-2, 2, (3, 6)):
        np.testing.assert_allclose(chain(standard_table(arm), [0, *q]), forward(arm, q), atol=1e-9)
    normal = common_normal_table(arm)
    bases = [forward(arm, q) @ inverse(chain(normal, q)) for q in rng.uniform(-2, 2, (3, 6))]
    np.testing.assert_allclose(bases[1:], [bases[0]] * 2, atol=1e-6)
    assert "delta_theta" in ur_deltas_text(ur5(), arm) and ur_deltas_text(er3a(), er3a()) == ""


def test_a_corrected_urdf_moves_as_the_corrected_table(rng, tmp_path):
    source = data_folder() / "robots" / "ur3" / "ur3.urdf"
    found = urdf_chain(source)
    arm = found.arm.changed_by(rng.normal(0, [1e-3, 1, 1, 1e-3, 0], (6, 5)))
    write_corrected_urdf(source, found, arm, tmp_path / "c.urdf")
    again = urdf_chain(tmp_path / "c.urdf")
    for q in rng.uniform(-1.5, 1.5, (4, 6)):
        ours = found.T_base_table @ forward(arm, q) @ inverse(forward(arm, np.zeros(6)))
        theirs = again.T_base_table @ forward(again.arm, q) @ inverse(forward(again.arm, np.zeros(6)))
        ours = ours @ inverse(found.T_base_table)
        theirs = theirs @ inverse(again.T_base_table)
        np.testing.assert_allclose(theirs, ours, atol=1e-6)
    np.testing.assert_allclose(again.arm.limits, found.arm.limits)


@pytest.mark.usefixtures("blank_pictures")
def test_verify_passes_and_fails_by_exit_code(rng, tmp_path):
    made = rig(er3a(), rng, rows=60)
    table = pd.DataFrame(made.measurements.q_rad, columns=[f"q{i}_rad" for i in range(1, 5)])
    for frame, points in (("s", made.measurements.scanner_mm), ("b", made.measurements.tracker_mm)):
        table[[f"{frame}{axis}_mm" for axis in "xyz"]] = points
    table.to_csv(tmp_path / "m.csv", index=False)
    write_arm(er3a(), tmp_path / "r.csv")
    words = ["calibrate", str(tmp_path / "m.csv"), "--robot", str(tmp_path / "r.csv"), "-o", str(tmp_path / "cell")]
    assert main([*words, "--suggest", "3", "--beyond-geometry", "off"]) == 0
    report = json.loads((tmp_path / "cell" / "report.json").read_text())
    assert report["predicted_mm"]["p95"] > 0 and report["structure"] == []
    assert len((tmp_path / "cell" / "suggested_poses.csv").read_text().splitlines()) == 4
    verify = ["verify", str(tmp_path / "cell"), str(tmp_path / "m.csv"), "-o", str(tmp_path / "v"), "--limit-mm"]
    assert main([*verify, "0.5"]) == 0 and main([*verify, "0.01"]) == 3
    assert main(verify[:-1]) == 2
    moved = table.assign(bx_mm=table["bx_mm"] + 5)
    moved.to_csv(tmp_path / "m.csv", index=False)
    assert main([*verify, "0.5"]) == 3 and main([*verify, "0.5", "--tracker-moved"]) == 0


def test_only_where_the_scanner_sits(rng):
    made = rig(er3a(), rng, rows=10, off_mm=0, off_rad=0)
    result = calibrate(made.measurements, er3a(), Options(free=()))
    assert (result.arm.table == er3a().table).all() and len(result.unknowns) == 12
    assert np.abs(result.cell.T_joint_scanner - made.cell.T_joint_scanner)[:3, 3].max() < 0.2
    assert error_statistics(residuals_of(result.cell, made.measurements)).mean < 0.2


@pytest.mark.usefixtures("blank_pictures")
def test_a_track_that_the_table_leaves_out_is_named_and_the_advice_works(rng, tmp_path, capsys):
    made = rig(ur5(), rng, rows=60, on_tool=True)
    q, travel = made.measurements.q_rad, rng.uniform(0, 1500, 60)
    tracker = made.measurements.tracker_mm + np.outer(travel, made.cell.T_tracker_base[:3, :3] @ [0.6, 0.8, 0.0])
    table = pd.DataFrame(np.degrees(q), columns=[f"q{i}_deg" for i in range(1, 7)])
    table[["bx_mm", "by_mm", "bz_mm"]] = tracker
    table.assign(rail_m=travel / 1000, note="x", speed=3.0).to_csv(tmp_path / "m.csv", index=False)
    write_arm(ur5(), tmp_path / "r.csv")
    command = ["calibrate", str(tmp_path / "m.csv"), "-o", str(tmp_path / "out"), "--beyond-geometry", "off"]
    assert main([*command, "--robot", str(tmp_path / "r.csv")]) == 2
    said = capsys.readouterr().err
    assert "column rail_m" in said and "by 1 m a unit along (0.60, 0.80" in said and "theta -143 deg" in said
    rows = np.vstack([np.zeros(5), ur5().table])
    rows[1, [0, 3]] = -np.pi / 2, np.radians(-143)
    write_arm(MdhArm(rows, ("rail", *ur5().joints), (True,) + 6 * (False,)), tmp_path / "r.csv")
    names = ["q1_m=rail_m", *(f"q{i + 1}_deg=q{i}_deg" for i in range(1, 7))]
    assert main([*command, "--robot", str(tmp_path / "r.csv"), "--columns", *names]) == 0
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["errors_mm"]["test"]["after"]["mean"] < 0.15


def test_a_small_coupling_in_a_sweep_is_not_blamed_on_another_pair(rng):
    made = rig(ur5(), rng, rows=48, on_tool=True, noise_mm=0.02)
    q = np.tile([0.2, -0.8, 0.9, 0.3, 0.8, 0.1], (48, 1))
    for joint in range(6):
        q[8 * joint : 8 * joint + 8, joint] += np.linspace(-1, 1, 8)
    tracker = made.cell.points_tracker(q, made.measurements.scanner_mm) + 0.02 * rng.normal(size=(48, 3))
    shown = q.copy()
    shown[:, 2] -= 0.02 * q[:, 1]
    with pytest.raises(InputError, match=r"joint 3 is coupled to joint 2: with q3 = q3 \+0\.0(2|19|20)"):
        calibrate(Measurements(shown, made.measurements.scanner_mm, tracker), ur5())


def test_stated_sigmas_hold_where_gears_wave_and_links_sag():
    within, _ = coverage(4, clean=False)
    plain, _ = coverage(4, clean=False, diagnose=False)
    assert 0.5 < within < 0.85 and plain < within


@pytest.mark.full
def test_stated_sigmas_hold_in_two_hundred_cells():
    within, table = coverage(200, clean=False)
    assert table["known"].sum() > 1500 and 0.60 < within < 0.76


def test_masses_of_a_urdf_pull_at_its_joints_as_pinocchio_has_it(rng, tmp_path):
    pin = pytest.importorskip("pinocchio", reason="gravity is compared with Pinocchio's, of the extra robot")
    text = (data_folder() / "robots" / "ur3" / "ur3.urdf").read_text(encoding="utf-8")

    def with_mass(match):
        x, y, z = rng.uniform(-0.1, 0.1, 3)
        inertia = '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
        own = f'<inertial><origin xyz="{x} {y} {z}"/><mass value="{rng.uniform(1, 5)}"/>{inertia}</inertial>'
        return f'<link name="{match[1]}">{own}' + ("</link>" if match[2] else "")

    (tmp_path / "r.urdf").write_text(re.sub(r'<link name="([^"]+)"\s*(/)?>', with_mass, text), encoding="utf-8")
    chain = urdf_chain(tmp_path / "r.urdf")
    found = link_masses(tmp_path / "r.urdf", chain)
    assert found is not None
    masses, centres = found
    load = GravityLoad(chain.arm, tuple(masses), tuple(map(tuple, centres)))
    model = pin.buildModelFromUrdf(str(tmp_path / "r.urdf"))
    q = rng.uniform(-2, 2, (5, 6))
    true = np.array([pin.computeGeneralizedGravity(model, model.createData(), angles) for angles in q])
    ours = load.torques(q)
    np.testing.assert_allclose(
        ours * (true[:, 1:].ravel() @ ours[:, 1:].ravel()) / (ours[:, 1:] ** 2).sum(), true, atol=1e-6
    )
    assert link_masses(data_folder() / "robots" / "ur3" / "ur3.urdf", chain) is None


def test_tables_of_other_arms_and_scales_of_the_tracker_are_named_with_their_size(rng):
    made = rig(ur5(), rng, rows=60, on_tool=True, noise_mm=0.02, off_mm=0.3)
    scaled = replace(made.measurements, tracker_mm=1.005 * made.measurements.tracker_mm)
    (found,) = calibrate(scaled, ur5()).findings
    assert found.kind == "tracker scale" and re.search(r"0\.[45]\d% too long", found.sentence)
    other = ur5().table.copy()
    other[3, 2] += 24.0
    told = calibrate(made.measurements, ur5().with_table(other)).warnings
    assert any("d2_mm + d3_mm + d4_mm moved by 2" in sentence for sentence in told)
    radians = made.measurements.q_rad * np.where(np.arange(6) == 3, np.pi / 180, 1.0)
    with pytest.raises(UnitError, match="q4_rad looks like radians"):
        calibrate(replace(made.measurements, q_rad=radians), ur5())


def test_where_the_first_of_several_reflectors_sits_is_no_error_elsewhere(rng):
    made = rig(ur5(), rng, rows=90, on_tool=True, noise_mm=0.02)
    q = made.measurements.q_rad.repeat(3, axis=0)
    places = np.tile([[0.0, 0, 0], [120, 0, 10], [-30, 110, -20]], (90, 1))
    tracker = made.cell.points_tracker(q, places) + 0.02 * rng.normal(size=places.shape)
    rows = Measurements(
        q, np.zeros_like(places), tracker, pose=np.repeat(np.arange(90), 3).astype(str), reflectors=("a", "b", "c"),
        reflector=np.tile([0, 1, 2], 90),
    )  # fmt: skip
    assert predict_errors(calibrate(rows, ur5()), rng, count=200).mean_mm < 0.15
