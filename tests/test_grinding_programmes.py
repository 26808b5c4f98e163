"""Grinding passes as programmes of all makers: read back, the tool stands over the ground with its lead angle."""

import numpy as np
import pytest

pytest.importorskip("pinocchio", reason="needs the extra robot")

from grindvision.cli.grind_robot import GrindRobot
from grindvision.geometry import rigid
from grindvision.motion import LoadRobotOptions, grinding_spindle, load_robot
from grindvision.motion.grinding import plan_grinding
from grindvision.motion.grinding_options import GrindingOptions
from grindvision.motion.grinding_path import CUT, driven, tool_path
from grindvision.motion.known import known_robots
from tests.flat_stock import flat_work
from tests.programme_readers import read_jbi, read_krl, read_ls, read_rapid

ARMS = {"rapid": "irb1200_5_90", "krl": "kr6_r900", "ls": "lrmate200id", "jbi": "gp7"}
READERS: dict = {"rapid": read_rapid, "krl": read_krl, "ls": read_ls, "jbi": read_jbi}
LEAD_RAD = 0.1


@pytest.mark.parametrize("language", list(ARMS))
def test_the_tool_s_axis_stands_opposite_to_the_normal_with_its_lead_angle(language, tmp_path):
    options = GrindingOptions(tool="disc", radius_mm=20.0, depth_mm=0.8, leave_mm=0.05)
    way = tool_path(plan_grinding(flat_work(), options))
    T_base_scanner = rigid(translation_mm=[420.0, -15.0, 150.0])
    robot = load_robot(ARMS[language], LoadRobotOptions(grinding_spindle()))
    job = GrindRobot(robot, language, T_base_scanner, LEAD_RAD, 0.0, spin_free=True)
    points = np.array([[x, y, 0.0] for x in range(0, 60, 3) for y in range(0, 30, 3)], dtype=float)
    (fact,) = job.write([way], points, tmp_path)
    assert fact["position_error_mm"] < 0.01
    texts = [(tmp_path / name).read_bytes().decode("ascii") for name in fact["files"]]
    texts = texts[::-1] if language == "krl" and fact["files"][0].endswith(".dat") else texts
    _, work, said = READERS[language](*texts)
    poses = np.array([one[1] for one in said if one[0] == "pose"])
    to_base = np.linalg.inv(np.array(known_robots()[ARMS[language]].T_controller_base)) @ work
    path = driven(way.thinned(5.0).moved(T_base_scanner))
    found = (to_base @ poses)[: len(path)]
    np.testing.assert_allclose(found[:, :3, 3], path.points, atol=2e-3)
    cut = path.kinds == CUT
    cosines = -np.einsum("ij,ij->i", found[cut, :3, 2], path.normals[cut])
    np.testing.assert_allclose(np.arccos(cosines), LEAD_RAD, atol=1e-3)
    speeds = np.array([one[2] for one in said if one[0] == "pose"])[: len(path)]
    assert (speeds <= path.feeds_mm_s + 1e-3).all() and speeds.min() > 0
