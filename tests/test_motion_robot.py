import numpy as np
import pytest

from grindvision.arm import forward, read_arm
from grindvision.errors import FileError, InputError
from grindvision.motion import (
    ER3A_LIMITS,
    JointLimits,
    Tool,
    grinding_spindle,
    mdh_robot,
    urdf_robot,
    welding_torch,
)
from tests.motion_scene import ER3A_TABLE, distance, grinder, ur3_flange_mm, welder

LINK = '<link name="{}"/>'
JOINT = (
    '<joint name="{0}" type="{1}"><parent link="{2}"/><child link="{3}"/><origin xyz="0 0 0.2"/><axis xyz="0 1 0"/>'
    '<limit effort="1" lower="-1" upper="1" velocity="{4}"/></joint>'
)


def urdf(folder, *joints, body=""):
    """A URDF of joints (name, type, parent, child, speed)."""
    links = dict.fromkeys(link for _, _, parent, child, _ in joints for link in (parent, child))
    text = "".join(LINK.format(link) for link in links if f'name="{link}"' not in body) + body
    path = folder / "arm.urdf"
    path.write_text(f'<robot name="arm">{text}{"".join(JOINT.format(*joint) for joint in joints)}</robot>')
    return path


def test_the_urdf_is_the_ur3_of_the_makers_table(rng):
    robot = welder()
    for q in rng.uniform(-np.pi, np.pi, (20, 6)):
        T_controller_tool = robot.T_controller_base @ robot.forward(q)
        off_mm, off_deg = distance(T_controller_tool, ur3_flange_mm(q) @ robot.tool.T_flange_tool)
        assert off_mm < 1e-6 and off_deg < 1e-6


def test_an_mdh_arm_reaches_where_its_table_says(rng):
    robot, arm = grinder(), read_arm(ER3A_TABLE)
    q = rng.uniform(-np.pi, np.pi, (5, 6))
    assert np.allclose(robot.forward(q), forward(arm, q) @ robot.tool.T_flange_tool)


def test_joint_angles_of_another_arm_are_refused():
    with pytest.raises(InputError, match=r"\(\.\.\., 6\)"):
        welder().forward(np.zeros(4))


def test_a_robot_file_without_the_joint_is_named(tmp_path):
    path = urdf(tmp_path, ("shoulder", "revolute", "base", "arm", 1), ("elbow", "revolute", "arm", "hand", 1))
    assert urdf_robot(path, welding_torch(), flange="elbow").joints == ("shoulder", "elbow")
    with pytest.raises(FileError, match=r"arm.urdf: no joint or link named wrist for the flange; it has .*elbow"):
        urdf_robot(path, welding_torch(), flange="wrist")
    with pytest.raises(FileError, match="no joint or link named zero for the controller"):
        urdf_robot(path, welding_torch(), flange="elbow", controller="zero")


@pytest.mark.parametrize(
    ("joints", "complaint"),
    [
        ([("a", "revolute", "base", "left", 1), ("b", "revolute", "base", "right", 1)], "single chain"),
        ([("a", "continuous", "base", "hand", 1)], "single chain"),
        ([("a", "fixed", "base", "hand", 1)], "single chain"),
        ([("a", "revolute", "base", "hand", 0)], "joint 1: speed_rad_s is 0"),
    ],
)
def test_a_robot_file_that_is_no_arm_is_named(tmp_path, joints, complaint):
    with pytest.raises(FileError, match=complaint):
        urdf_robot(urdf(tmp_path, *joints), welding_torch(), flange="a")


def test_missing_files_are_named(tmp_path):
    with pytest.raises(FileError, match="no such file"):
        urdf_robot(tmp_path / "none.urdf", welding_torch(), flange="a")
    mesh = '<collision><geometry><mesh filename="package://shapes/arm.stl"/></geometry></collision>'
    path = urdf(tmp_path, ("a", "revolute", "base", "hand", 1), body=f'<link name="hand">{mesh}</link>')
    with pytest.raises(FileError, match="collision meshes not found"):
        urdf_robot(path, welding_torch(), flange="a")


def test_a_torch_is_solid_from_the_flange_to_the_nozzle_and_clear_of_its_wire():
    torch = welding_torch(length_mm=200.0, wire_mm=12.0)
    ends = np.array([(start, end) for start, end, _ in torch.capsules])
    assert np.array_equal(ends[0, 0], [0, 0, 0])
    assert np.array_equal(ends[1:, 0], ends[:-1, 1])
    assert not ends[..., :2].any()
    assert (np.diff(ends[..., 2], axis=1) > 0).all()
    assert ends[-1, 1, 2] + torch.capsules[-1][2] == pytest.approx(200.0 - 12.0)


def test_a_spindle_is_solid_from_its_mount_to_its_stone():
    (capsule,) = grinding_spindle(length_mm=230.0, mount_mm=80.0, stone_mm=20.0).capsules
    start, end, radius_mm = np.array(capsule[0]), np.array(capsule[1]), capsule[2]
    assert not start[:2].any() and not end[:2].any()
    assert (start[2] - radius_mm, end[2] + radius_mm) == pytest.approx((80.0, 210.0))


def test_limits_and_tools_that_make_no_sense_are_refused():
    with pytest.raises(InputError, match="joint 2: the lower limit"):
        JointLimits([-1, 1], [1, -1], [1, 1], [1, 1])
    with pytest.raises(InputError, match="joint 1: acceleration"):
        JointLimits([-1], [1], [1], [np.inf])
    with pytest.raises(InputError, match="6 joints given; the arm has 4"):
        mdh_robot("short", read_arm(ER3A_TABLE).first(4), grinding_spindle(), ER3A_LIMITS)
    with pytest.raises(InputError, match="shorter than its parts"):
        welding_torch(length_mm=50)
    with pytest.raises(InputError, match="capsule of stick"):
        Tool("stick", np.eye(4), (((0, 0, 0), (0, 0, 0), 5.0),))
