"""Laws of the arm model: against Pinocchio, against finite differences, and the way back from pose to joint angles."""

import numpy as np
import pinocchio as pin
import pytest
from scipy.spatial.transform import Rotation

from grindvision import arm as arms
from grindvision import geometry, paper
from grindvision.arm.inverse import _log_slope
from grindvision.arm.model import pinocchio_model, urdf_model
from grindvision.errors import FileError, GrindvisionError, InputError, NotRigidError, UnitError

STEP = 1e-6


@pytest.fixture(scope="module")
def nominal():
    return arms.read_arm(paper.data_folder() / "robots" / "er3a_c60.csv")


@pytest.fixture
def bent(nominal, rng):
    """The arm with every parameter, beta included, off its nominal value."""
    return nominal.changed_by(rng.normal(size=(6, 5)) * [0.1, 20.0, 20.0, 0.1, 0.1])


def twist_between(before, after):
    """Twist in the base frame, shift of the point at its origin first, of a small motion."""
    return pin.log6(after @ geometry.inverse(before)).vector


def test_forward_kinematics_agree_with_pinocchio_at_every_joint(bent, rng):
    model = pinocchio_model(bent)
    data = model.createData()
    for q in rng.uniform(-np.pi, np.pi, (10, 6)):
        pin.forwardKinematics(model, data, q)
        ours = arms.joint_transforms(bent, q)
        assert ours[0] == pytest.approx(np.eye(4))
        for joint in range(1, 7):
            assert ours[joint] == pytest.approx(data.oMi[joint].homogeneous, abs=1e-9)


def test_poses_are_rigid_and_a_batch_is_its_single_poses(bent, rng):
    q = rng.uniform(-np.pi, np.pi, (4, 5, 6))
    poses = arms.forward(bent, q)
    assert poses.shape == (4, 5, 4, 4)
    assert poses[2, 3] == pytest.approx(arms.forward(bent, q[2, 3]))
    for pose in poses.reshape(-1, 4, 4):
        geometry.check_rigid(pose, "T_base_joint", tolerance=1e-12)
    assert arms.forward(bent.first(3), q[0, 0, :3]) == pytest.approx(arms.joint_transforms(bent, q[0, 0])[3])


def test_a_full_turn_changes_nothing_and_theta_is_a_joint_angle(bent, rng):
    q = rng.uniform(-np.pi, np.pi, 6)
    assert arms.forward(bent, q + 2 * np.pi) == pytest.approx(arms.forward(bent, q), abs=1e-9)
    offset = np.zeros((6, 5))
    offset[:, 3] = 0.2
    assert arms.forward(bent.changed_by(offset), q) == pytest.approx(arms.forward(bent, q + 0.2), abs=1e-9)


def test_an_arm_drawn_in_metres_is_the_same_arm(bent, rng):
    q, metres = rng.uniform(-np.pi, np.pi, 6), bent.with_table(bent.table * [1, 1e-3, 1e-3, 1, 1])
    assert arms.forward(metres, q)[:3, :3] == pytest.approx(arms.forward(bent, q)[:3, :3])
    assert 1000 * arms.forward(metres, q)[:3, 3] == pytest.approx(arms.forward(bent, q)[:3, 3])


def test_joint_twists_are_the_finite_differences(bent, rng):
    q = rng.uniform(-np.pi, np.pi, 6)
    twists = arms.joint_twists(bent, q)
    for joint, step in enumerate(STEP * np.eye(6)):
        numeric = twist_between(arms.forward(bent, q - step), arms.forward(bent, q + step)) / (2 * STEP)
        assert twists[:, joint] == pytest.approx(numeric, rel=1e-6, abs=1e-5)


def test_parameter_twists_are_the_finite_differences(bent, rng):
    q = rng.uniform(-np.pi, np.pi, 6)
    twists = arms.parameter_twists(bent, q)
    assert twists.shape == (6, 30)
    for entry, step in enumerate(STEP * np.eye(30)):
        before, after = arms.forward(bent.changed_by(-step), q), arms.forward(bent.changed_by(step), q)
        assert twists[:, entry] == pytest.approx(twist_between(before, after) / (2 * STEP), rel=1e-6, abs=1e-5)


def test_parameter_twists_agree_with_pinocchios_kinematic_regressor(bent, rng):
    """Pinocchio differentiates by six numbers of each joint's placement; the chain rule leads to the five of MDH."""
    q, model = rng.uniform(-np.pi, np.pi, 6), pinocchio_model(bent)
    data = model.createData()
    pin.computeJointJacobians(model, data, q)
    regressor = pin.computeJointKinematicRegressor(model, data, 6, pin.ReferenceFrame.WORLD)
    for joint, (alpha, a, _, _, _) in enumerate(bent.table):
        tilt = pin.SE3(pin.utils.rotate("x", alpha), np.array([a, 0.0, 0.0]))
        ex, ey, ez = np.eye(3)
        zero = np.zeros(3)
        parent = [pin.Motion(zero, ex), pin.Motion(ex, zero), tilt.act(pin.Motion(zero, ey))]
        by_alpha, by_a, by_beta = (model.jointPlacements[joint + 1].actInv(motion).vector for motion in parent)
        by_d, by_theta = pin.Motion(ez, zero).vector, pin.Motion(zero, ez).vector
        theirs = regressor[:, 6 * joint : 6 * joint + 6] @ np.column_stack([by_alpha, by_a, by_d, by_theta, by_beta])
        ours = arms.parameter_twists(bent, q)[:, 5 * joint : 5 * joint + 5]
        assert ours == pytest.approx(theirs, abs=1e-8)


def test_moved_by_twist_is_the_speed_of_a_point_of_the_last_link(bent, rng):
    q, point = rng.uniform(-np.pi, np.pi, 6), rng.uniform(-100, 100, 3)
    velocities = arms.moved_by_twist(arms.joint_twists(bent, q), geometry.move_points(arms.forward(bent, q), point))
    for joint, step in enumerate(STEP * np.eye(6)):
        ahead, behind = (geometry.move_points(arms.forward(bent, q + s), point) for s in (step, -step))
        assert velocities[:, joint] == pytest.approx((ahead - behind) / (2 * STEP), rel=1e-6, abs=1e-4)


@pytest.mark.parametrize("joints", [4, 6])
def test_nearest_angles_recover_joint_angles(nominal, joints, rng):
    arm = nominal.first(joints)
    for q in rng.uniform(-2.5, 2.5, (3, joints)):
        solutions = arms.nearest_angles(arm, arms.forward(arm, q), rng)
        assert solutions[0].position_error_mm < 1e-5
        assert solutions[0].angle_error_rad < 1e-7
        assert arms.forward(arm, solutions[0].q_rad) == pytest.approx(arms.forward(arm, q), abs=1e-4)
        apart = [np.abs((s.q_rad - q + np.pi) % (2 * np.pi) - np.pi).max() for s in solutions]
        assert min(apart) < 1e-5
        costs = [s.position_error_mm**2 + (100 * s.angle_error_rad) ** 2 for s in solutions]
        assert costs == sorted(costs)


def test_an_unreachable_pose_is_met_as_nearly_as_possible(nominal, rng):
    arm = nominal.first(4)
    pose = geometry.small_motion([2.0, 0, 0, 0, 0, 0.02]) @ arms.forward(arm, [0.3, -1.0, 0.4, 0.5])
    best = arms.nearest_angles(arm, pose, rng)[0]

    def cost(q):
        reached = arms.forward(arm, q)
        shift = np.linalg.norm(reached[:3, 3] - pose[:3, 3])
        return shift**2 + (100 * geometry.angle_between(reached, pose)) ** 2

    assert cost(best.q_rad) == pytest.approx(best.position_error_mm**2 + (100 * best.angle_error_rad) ** 2)
    assert all(cost(best.q_rad + 1e-3 * rng.standard_normal(4)) >= cost(best.q_rad) for _ in range(30))


def test_a_robot_table_survives_its_file(bent, tmp_path):
    arms.write_arm(bent, tmp_path / "robot.csv")
    again = arms.read_arm(tmp_path / "robot.csv")
    assert again.table.tolist() == bent.table.tolist()
    assert again.joints == bent.joints


HEAD = "joint,alpha_rad,a_mm,d_mm,theta_rad,beta_rad\n"
DAMAGED: dict[str, tuple[str | bytes, type[GrindvisionError], str]] = {
    "degrees": (HEAD + "J1,0,0,321.5,0,0\nJ2,90,50,0,90,0\n", UnitError, "90 in the MDH table looks like degrees"),
    "column": ("joint,alpha_rad,a_mm,theta_rad,beta_rad\nJ1,0,0,0,0\n", FileError, "column d_mm missing"),
    "text": (HEAD + "J1,0,0,abc,0,0\n", FileError, "row 1, column d_mm: 'abc'"),
    "hole": (HEAD + "J1,0,0,1,0,0\nJ2,0,,1,0,0\n", FileError, "row 2, column a_mm"),
    "no rows": (HEAD, FileError, "no rows"),
    "binary": (b"\xff\xfe\x00\x81\x00", FileError, "not a readable CSV"),
}


@pytest.mark.parametrize("case", DAMAGED)
def test_a_damaged_robot_file_is_refused_with_its_place(case, tmp_path):
    content, error, reason = DAMAGED[case]
    path = tmp_path / "robot.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(error, match=f"robot.csv.*{reason}"):
        arms.read_arm(path)


def test_bad_arguments_are_refused(nominal, rng, tmp_path):
    with pytest.raises(FileError, match="no such file"):
        arms.read_arm(tmp_path / "none.csv")
    with pytest.raises(FileError, match="no such file"):
        urdf_model(tmp_path / "none.urdf")
    with pytest.raises(InputError, match=r"this arm needs \(..., 6\)"):
        arms.forward(nominal, np.zeros(4))
    with pytest.raises(InputError, match="NaN"):
        arms.forward(nominal, [0, 0, 0, np.nan, 0, 0])
    with pytest.raises(InputError, match="NaN"):
        nominal.with_table(np.full((6, 5), np.nan))
    with pytest.raises(InputError, match="joints 1 to 6"):
        nominal.first(7)
    with pytest.raises(NotRigidError, match="T_base_joint is a reflection"):
        arms.nearest_angles(nominal, np.diag([1, 1, -1, 1]), rng)
    with pytest.raises(InputError, match="at least one"):
        arms.nearest_angles(nominal, np.eye(4), rng, starts=0)
    with pytest.raises(ValueError, match="read-only"):
        nominal.table[0, 0] = 1.0


@pytest.mark.parametrize("angle_rad", [0.0, 1e-7, 0.01, 1.0, 2.0, 3.0])
def test_the_slope_of_a_rotation_vector_is_its_finite_difference(rng, angle_rad):
    vector = angle_rad * np.array([2.0, -1.0, 2.0]) / 3
    for small in 1e-5 * np.eye(3):
        ahead, behind = (Rotation.from_rotvec(sign * small) * Rotation.from_rotvec(vector) for sign in (1.0, -1.0))
        slope = (ahead.as_rotvec() - behind.as_rotvec()) / 2
        np.testing.assert_allclose(_log_slope(vector) @ small, slope, atol=1e-13)
