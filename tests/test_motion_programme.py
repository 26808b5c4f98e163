import csv
import json
import re

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from grindvision.arm import forward, read_arm
from grindvision.errors import FileError, InputError
from grindvision.geometry import vector_angle
from grindvision.motion import PlanMotionOptions, plan_motion, urscript, write_programme
from grindvision.motion.programme import blend_radii
from tests.motion_scene import ER3A_TABLE, distance, grinder, ring, s_trajectory, ur3_flange_mm, welder

#: How near a programme read back must come to the trajectory.
NEAR_MM, NEAR_DEG = 0.05, 0.1


@pytest.fixture(scope="module", params=["open", "closed"])
def welding(request):
    trajectory = s_trajectory() if request.param == "open" else ring()
    return plan_motion(welder(), trajectory, PlanMotionOptions(tool_speed_mm_s=8.0, seed=8))


@pytest.fixture(scope="module")
def grinding():
    trajectory = s_trajectory(points=6, centre=(380.0, 0.0, 120.0))
    return plan_motion(grinder(), trajectory, PlanMotionOptions(tool_speed_mm_s=20.0, spin_free=True, seed=8))


def pose_from_urscript(numbers):
    """T in mm from URScript's six numbers: metres and a rotation vector (Rodrigues, written out)."""
    x, y, z, *vector = numbers
    vector = np.array(vector)
    angle = np.linalg.norm(vector)
    a, b, c = vector / angle if angle > 0 else (1.0, 0.0, 0.0)
    cross = np.array([[0, -c, b], [c, 0, -a], [-b, a, 0]])
    pose = np.eye(4)
    pose[:3, :3] = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    pose[:3, 3] = 1000 * x, 1000 * y, 1000 * z
    return pose


def read_urscript(text):
    """What the script says, line by line: (command, numbers, options); refuses anything it does not know."""
    lines = [line.strip() for line in text.split("\n")]
    assert lines[0] == "def follow_seam():" and lines[-2:] == ["end", ""]
    said = []
    for line in lines[1:-2]:
        if line.startswith("#"):
            continue
        match = re.fullmatch(r"(set_tcp|movej|movel|movep)\((p?)\[([^\]]*)\]((?:, \w+=[-\d.]+)*)\)", line)
        assert match, line
        command, is_pose, numbers, options = match.groups()
        assert (is_pose == "p") == (command != "movej")
        said.append(
            (
                command,
                [float(number) for number in numbers.split(",")],
                {key: float(value) for key, value in re.findall(r"(\w+)=([-\d.]+)", options)},
            )
        )
    return said


def test_urscript_drives_the_tool_along_the_trajectory(welding, tmp_path):
    write_programme(welding, tmp_path / "weld.script", "urscript")
    said = read_urscript((tmp_path / "weld.script").read_text(encoding="ascii"))
    assert [command for command, _, _ in said[:3]] == ["set_tcp", "movej", "movel"] and said[-1][0] == "movel"
    T_flange_tool = pose_from_urscript(said[0][1])
    q = np.array(said[1][1])

    def drive_to(T_controller_tool, q):
        """The controller's part: the joint angles of the maker's arm nearest to the ones before."""

        def miss(q):
            reached = ur3_flange_mm(q) @ T_flange_tool
            turn = Rotation.from_matrix(T_controller_tool[:3, :3] @ reached[:3, :3].T).as_rotvec()
            return np.concatenate([reached[:3, 3] - T_controller_tool[:3, 3], 200 * turn])

        return least_squares(miss, q, xtol=1e-12, ftol=1e-12, gtol=1e-12).x

    T_base_controller = np.linalg.inv(welding.robot.T_controller_base)
    wanted = welding.trajectory.T_base_tool_worked
    assert len(said) - 3 == len(wanted)
    for (_, numbers, _), pose, planned in zip(said[2:-1], wanted, welding.path.q_rad, strict=True):
        q = drive_to(pose_from_urscript(numbers), q)
        off_mm, off_deg = distance(T_base_controller @ ur3_flange_mm(q) @ T_flange_tool, pose)
        assert off_mm < NEAR_MM and off_deg < NEAR_DEG
        assert np.abs(q - planned).max() < 1e-3  # the same branch as was checked for collisions


def test_urscript_keeps_the_torch_speed_and_blends_inside_the_tolerance(welding):
    said = read_urscript(urscript(welding))
    moves = [options for command, _, options in said if command == "movep"]
    speeds = np.array([options["v"] for options in moves])
    assert speeds.max() == pytest.approx(0.008, rel=1e-3) and np.median(speeds) == pytest.approx(0.008, rel=1e-3)
    gaps = np.diff(welding.trajectory.arc_mm)
    for options, gap_mm in zip(moves, gaps, strict=True):
        assert 1000 * options["r"] < gap_mm / 2
    assert moves[-1]["r"] == 0.0
    poses = welding.trajectory.T_base_tool_worked[:, :3, 3]
    along = np.diff(poses, axis=0) / gaps[:, None]
    corner = np.arccos(np.clip(np.sum(along[1:] * along[:-1], axis=1), -1, 1))
    radius_mm = 1000 * np.array([options["r"] for options in moves[:-1]])
    circle_mm = radius_mm / np.tan(corner / 2)  # the arc that leaves and meets both straight moves at radius_mm
    assert (circle_mm * (1 / np.cos(corner / 2) - 1) < 0.03).all()


def test_csv_replays_through_the_makers_kinematics(welding, tmp_path):
    write_programme(welding, tmp_path / "weld.csv", "csv")
    with open(tmp_path / "weld.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    T_base_controller = np.linalg.inv(welding.robot.T_controller_base)
    assert [int(row["waypoint"]) for row in rows] == list(range(len(welding.trajectory.T_base_tool_worked)))
    times = [float(row["time_s"]) for row in rows]
    assert times[0] == 0 and (np.diff(times) > 0).all()
    for row, wanted in zip(rows, welding.trajectory.T_base_tool_worked, strict=True):
        q = [float(row[f"{joint}_rad"]) for joint in welding.robot.joints]
        reached = T_base_controller @ ur3_flange_mm(q) @ welding.robot.tool.T_flange_tool
        written = np.eye(4)
        written[:3, :3] = Rotation.from_euler(
            "ZYX", [float(row[f"{a}_rad"]) for a in ("yaw", "pitch", "roll")]
        ).as_matrix()
        written[:3, 3] = [float(row[f"{axis}_mm"]) for axis in "xyz"]
        for pose in (reached, T_base_controller @ written):
            off_mm, off_deg = distance(pose, wanted)
            assert off_mm < NEAR_MM and off_deg < NEAR_DEG


def test_json_replays_through_the_mdh_table(grinding, tmp_path):
    write_programme(grinding, tmp_path / "grind.json", "json")
    said = json.loads((tmp_path / "grind.json").read_text(encoding="utf-8"))
    arm = read_arm(ER3A_TABLE)
    assert said["units"] == {"length": "mm", "angle": "rad", "time": "s"} and said["closed"] is False
    assert said["joints"] == list(arm.joints) and said["tool_speed_mm_s"] == 20.0
    everything = [said["approach"], *said["waypoints"], said["retreat"]]
    for place in everything:
        off_mm, off_deg = distance(forward(arm, place["q_rad"]) @ said["T_flange_tool"], np.array(place["T_base_tool"]))
        assert off_mm < NEAR_MM and off_deg < NEAR_DEG
    for place, wanted in zip(said["waypoints"], grinding.trajectory.T_base_tool, strict=True):
        pose = np.array(place["T_base_tool"])
        assert np.linalg.norm(pose[:3, 3] - wanted[:3, 3]) < NEAR_MM
        assert np.degrees(np.arccos(min(1.0, pose[:3, 2] @ wanted[:3, 2]))) < NEAR_DEG


def test_an_arm_that_speaks_another_language_is_refused(grinding, tmp_path):
    with pytest.raises(InputError, match="ER3A-C60 is no arm of Universal Robots"):
        write_programme(grinding, tmp_path / "grind.script", "urscript")
    with pytest.raises(InputError, match="'rapid'; choose one of csv, json, urscript"):
        write_programme(grinding, tmp_path / "grind.mod", "rapid")
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_left_of_a_programme_that_cannot_be_written(grinding, tmp_path):
    (tmp_path / "weld.csv").mkdir()
    with pytest.raises(FileError, match="cannot write"):
        write_programme(grinding, tmp_path / "weld.csv", "csv")
    assert [path.name for path in tmp_path.iterdir()] == ["weld.csv"]
    assert list((tmp_path / "weld.csv").iterdir()) == []


def test_a_blend_cuts_off_a_fiftieth_of_a_millimetre_and_leaves_half_of_every_piece(rng):
    points = np.cumsum(rng.normal(size=(60, 3)) * 10 ** rng.uniform(-2, 1.5, (60, 1)), axis=0)
    blends, lengths = blend_radii(points), np.linalg.norm(np.diff(points, axis=0), axis=1)
    inner, corners = blends[1:-1], vector_angle(np.diff(points[1:], axis=0), np.diff(points[:-1], axis=0))
    cut_off, room = inner * np.tan(corners / 4), np.minimum(lengths[1:], lengths[:-1]) / 4
    assert blends[0] == blends[-1] == 0 and (inner > 0).all() and inner.max() <= 1.001
    assert cut_off.max() == pytest.approx(0.02) and (inner / room).max() == pytest.approx(1.0)
    assert (np.isclose(cut_off, 0.02) | np.isclose(inner, room)).all()
    straight = blend_radii(np.outer(np.arange(5.0), [10.0, 0.0, 0.0]))
    np.testing.assert_allclose(straight[1:-1], 1.0, rtol=1e-3)
