"""What the printed numbers of diao2018 reveal: the findings of chapter 07, recomputed with the package's functions."""

import numpy as np
import pytest

from grindvision import arm as arms
from grindvision import calibration, cell, geometry, paper
from grindvision_book.chapter_00 import GRINDING, WELDING, as_table
from grindvision_book.chapter_07 import HALF_DIGIT, tried_readings


@pytest.fixture(scope="module")
def fit():
    return geometry.fit_rigid(paper.path_points(3)[0], paper.path_points(4)[0])


def nearest(arm, T_base_joint4):
    return arms.nearest_angles(arm, T_base_joint4, np.random.default_rng(0), starts=25)[0]


def test_tables_3_and_4_are_one_rigid_motion_apart(fit):
    assert fit.rms_mm == pytest.approx(0.000174, abs=1e-6)
    assert np.abs(fit.residuals_mm).max() < 0.0003
    assert fit.T_target_source[:3, 3] == pytest.approx([431.519, -362.003, 304.814], abs=0.001)


@pytest.mark.parametrize(("matrix", "left_mm", "left_deg"), [("coarse", 0.282, 0.423), ("accurate", 0.129, 0.439)])
def test_an_er3a_c60_can_stand_as_the_print_implies(fit, matrix, left_mm, left_deg):
    arm, T_joint4_scanner = cell.nominal_arm(), paper.hand_eye(matrix)
    best = nearest(arm, fit.T_target_source @ geometry.inverse(T_joint4_scanner))
    assert best.position_error_mm == pytest.approx(left_mm, abs=0.002)
    assert np.degrees(best.angle_error_rad) == pytest.approx(left_deg, abs=0.002)
    assert nearest(arm, fit.T_target_source @ T_joint4_scanner).position_error_mm > 20


def test_the_mirrored_zero_is_the_same_arm(fit):
    pose = fit.T_target_source @ geometry.inverse(paper.hand_eye("accurate"))
    arm = cell.nominal_arm()
    table = arm.table.copy()
    table[[1, 3], 0] *= -1
    table[1, 3] *= -1
    one, other = nearest(arm, pose), nearest(arm.with_table(table), pose)
    assert other.q_rad == pytest.approx(one.q_rad * [1, -1, -1, 1], abs=1e-6)
    assert other.position_error_mm == pytest.approx(one.position_error_mm, abs=1e-6)


def test_printed_normals_of_table_3_need_a_half_turn():
    points, normals = paper.path_points(3)
    tangents = np.gradient(points, axis=0)
    assert np.linalg.norm(normals, axis=1) == pytest.approx(1, abs=1e-4)
    off = [np.abs(np.degrees(geometry.vector_angle(normals * s, tangents)) - 90) for s in ([1, 1, 1], [-1, -1, 1])]
    assert off[0].min() > 35
    assert off[1].max() < 12


def test_no_usual_reading_leads_to_the_triples_of_table_4(fit):
    normals, triples = paper.path_points(3)[1], paper.path_points(4)[1]
    left = tried_readings(normals, triples, fit.T_target_source)["left_rms"]
    assert left[:-1].min() > 5 * HALF_DIGIT
    assert left.iloc[-1] < HALF_DIGIT


@pytest.mark.parametrize("family", [0, 3, 4])
def test_a_reading_that_is_right_would_have_been_found(fit, family):
    """Triples made by a known reading leave nothing in its family, so the search can succeed."""
    from scipy.spatial.transform import Rotation

    normals = paper.path_points(3)[1]
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    turn, other = Rotation.from_rotvec([0.3, -0.2, 0.5]), Rotation.from_rotvec([0.1, 0.4, -0.2])
    if family == 0:
        triples = geometry.rotate_vectors(fit.T_target_source, normals * [-1, -1, 1])
    elif family == 3:
        side = np.cross(normals, [0.0, 0.0, 1.0])
        side /= np.linalg.norm(side, axis=1, keepdims=True)
        frames = Rotation.from_matrix(np.stack([side, np.cross(normals, side), normals], axis=-1))
        triples = (turn * frames).as_euler("ZYX")
    else:
        triples = (turn * Rotation.from_euler("xyz", normals) * other).as_euler("ZYX")
    assert tried_readings(normals, triples, fit.T_target_source)["left_rms"][family] < 1e-9


def test_of_23_unknowns_20_can_be_known_and_one_less_with_the_tilt_behind_the_joint(rng):
    robot = cell.GrindingRobot()
    plan = cell.calibration_plan(robot, rng, test_spheres=0)
    model = calibration.ScannerOnArm(robot.nominal, robot.T_joint4_scanner, np.eye(4))
    centres, T_base_scanner = plan.centres_mm[plan.sphere], arms.forward(model.arm, plan.q_rad) @ model.T_joint_scanner
    seen = np.einsum("kji,kj->ki", T_base_scanner[:, :3, :3], centres - T_base_scanner[:, :3, 3])
    unknowns = calibration.Unknowns(6, calibration.table_entries(model.arm), 0)
    design = calibration.design_matrix(model, plan.q_rad, seen, unknowns).reshape(-1, len(unknowns))
    assert np.linalg.matrix_rank(design, tol=1e-9 * np.linalg.norm(design)) == 20
    joint3 = arms.joint_transforms(model.arm, plan.q_rad)[:, 3]
    design[:, unknowns.names.index("beta3_rad")] = np.cross(joint3[:, :3, 1], centres - joint3[:, :3, 3]).ravel()
    assert np.linalg.matrix_rank(design, tol=1e-9 * np.linalg.norm(design)) == 19


@pytest.mark.parametrize("steps", [GRINDING, WELDING])
def test_flow_charts_name_only_steps_that_are_there(steps):
    table = as_table(steps)
    feeders = {name for names in table["after"] for name in names.split("; ") if name}
    assert feeders <= set(table["step"])
    assert table["step"].is_unique
    assert len({(s.column, s.row) for s in steps}) == len(steps)
