"""Programmes of four makers, read back by readers of their own and driven through the makers' kinematics."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from grindvision.arm import forward
from grindvision.errors import InputError, UnreachableError
from grindvision.geometry import inverse, rigid
from grindvision.motion import (
    ArcOptions,
    LoadRobotOptions,
    Motion,
    PlanMotionOptions,
    RobotProgrammeOptions,
    Tool,
    Trajectory,
    follow_trajectory,
    known_robots,
    load_robot,
    measure_clearance,
    placements,
    plan_motion,
    programme_files,
    robot_programme,
    table,
    time_law,
    welding_torch,
)
from grindvision.motion.programme_steps import LinearMove, euler_zyx_deg, plain, quaternion_wxyz
from grindvision.motion.writers.ls import speed_words
from tests.motion_scene import distance, grinder, s_trajectory, welder
from tests.programme_readers import by_quaternion, fixed_axes, kuka_frame, read_jbi, read_krl, read_ls, read_rapid

ARMS = {"rapid": "irb1200_5_90", "krl": "kr6_r900", "ls": "lrmate200id", "jbi": "gp7"}
READERS: dict = {"rapid": read_rapid, "krl": read_krl, "ls": read_ls, "jbi": read_jbi}
T_BASE_WORK = rigid(Rotation.from_euler("zyx", [0.4, -0.1, 0.2]).as_matrix(), [350.0, -40.0, 90.0])


def read(programme, language):
    files = programme_files(programme, language)
    assert all(text.isascii() for text in files.values())
    return READERS[language](*files.values())


def bent_torch():
    straight = welding_torch(180.0)
    bend = rigid(Rotation.from_euler("y", 0.3).as_matrix())
    return Tool("bent torch", straight.T_flange_tool @ bend, straight.capsules)


#: Joint angles in the middle of a seam, rad, without the wrist: arm bent, forearm ahead.
STANDING = {"rapid": (0.3, 0.1), "krl": (-1.2, 1.6), "ls": (0.3, -0.2), "jbi": (0.3, -0.2)}


def motion_along_a_seam(robot, language, seed):
    """A motion of the arm along a curved seam of 60 mm that turns by 6 deg; the arm stands anyhow, but not singular."""
    rng = np.random.default_rng(seed)
    wrist = rng.uniform(0.6, 1.2) * rng.choice([-1, 1])
    arm = np.array(STANDING[language]) + rng.uniform(-0.15, 0.15, 2)
    q = np.array([rng.uniform(-1, 1), *arm, rng.uniform(-0.5, 0.5), wrist, rng.uniform(-2, 2)])
    x = np.linspace(-30.0, 30.0, 8)
    turns = Rotation.from_euler("xyz", np.outer(x, rng.uniform(-1e-3, 1e-3, 3)))
    poses = np.tile(np.eye(4), (8, 1, 1))
    poses[:, :3, :3], poses[:, 0, 3], poses[:, 1, 3] = turns.as_matrix(), x, rng.uniform(-0.01, 0.01) * x**2
    start = follow_trajectory(robot, Trajectory(robot.forward(q) @ np.stack([np.eye(4), poses[0]])), q).q_rad[1]
    trajectory = Trajectory(robot.forward(q) @ poses)
    path = follow_trajectory(robot, trajectory, start)
    ends = []
    for row in (0, -1):
        back = path.T_base_tool[row] @ rigid(translation_mm=[0, 0, -30.0])
        away = Trajectory(np.stack([path.T_base_tool[row], back]))
        ends.append(follow_trajectory(robot, away, path.q_rad[row]).q_rad[1])
    free = measure_clearance(robot, np.stack(ends), [table(-5000.0)])
    return Motion(robot, path, ends[0], ends[1], free, time_law(path, robot.limits, 8.0))


@pytest.fixture(scope="module", params=list(ARMS))
def planned(request):
    """Ten seams followed by an arm of one maker."""
    robot = load_robot(ARMS[request.param], LoadRobotOptions(bent_torch()))
    return request.param, [motion_along_a_seam(robot, request.param, seed) for seed in range(10)]


def test_programmes_read_back_put_the_tip_on_the_plan(planned):
    language, motions = planned
    known = known_robots()[ARMS[language]]
    for motion in motions:
        robot = motion.robot
        programme = robot_programme(motion, RobotProgrammeOptions(T_base_work=T_BASE_WORK))
        tool, work, said = read(programme, language)
        assert [kind for kind, *_ in said] == ["joints", *["pose"] * (len(motion.path.q_rad) + 1)]
        angles = np.array(said[0][1])
        angles[2] += angles[1] if language == "ls" else 0.0  # a FANUC pendant counts joint 3 from the horizontal
        np.testing.assert_allclose(np.radians(angles), motion.q_approach_rad, atol=2e-6)
        wanted = [*motion.path.T_base_tool, robot.forward(motion.q_retreat_rad)]
        q_all = [*motion.path.q_rad, motion.q_retreat_rad]
        for (_, T_work_tool, speed, _), pose, q in zip(said[1:], wanted, q_all, strict=True):
            # the controller: its own base, flange and tool; the arm's table alone tells where the flange is
            flange = np.array(known.T_controller_base) @ forward(known.arm, q) @ np.array(known.T_last_flange)
            off_mm, off_deg = distance(work @ T_work_tool, flange @ tool)
            assert off_mm < 1e-3 and off_deg < 1e-3
            off_mm, off_deg = distance(inverse(np.array(known.T_controller_base)) @ work @ T_work_tool, pose)
            assert off_mm < 1e-3 and off_deg < 1e-3
            assert 0 < speed <= 20.0


def test_speed_along_the_seam_is_the_one_asked_for_or_the_next_below(planned):
    language, motions = planned
    for motion in motions[:2]:
        speeds = [step[2] for step in read(robot_programme(motion), language)[2][2:-1]]
        assert max(speeds) <= 8.0 + 1e-3 and np.median(speeds) > 7.8


def test_the_words_of_the_placement_follow_the_joints(planned):
    """Each maker's rule, applied to the planned joint angles by hand."""
    language, motions = planned
    for motion in motions:
        said = read(robot_programme(motion), language)[2][1:]
        for (*_, words), q in zip(said, [*motion.path.q_rad, motion.q_retreat_rad], strict=True):
            degrees = np.degrees(q)
            if language == "rapid":
                assert words[:3] == tuple(int(degrees[joint] // 90) for joint in (0, 3, 5))
                assert words[3] % 2 == (degrees[4] < 0)
            elif language == "krl":
                assert words[1] == sum(2**joint for joint in range(6) if degrees[joint] < 0)
                # A3 above phi, where the arm is stretched: phi = -atan(35 / 420)
                assert words[0] == 2 * (degrees[2] >= -np.degrees(np.arctan(35 / 420))) + 4 * (degrees[4] < 0)
            elif language == "ls":
                assert words[0] == ("N" if degrees[4] < 0 else "F") and words[2:] == "U T, 0, 0, 0"
            else:
                assert words[:3] == (int(abs(degrees[3]) > 90), 0, 0)


def test_placements_tell_the_eight_ways_to_a_pose_apart():
    """Turning joint 1 half way round and reaching back, bending the elbow the other way, turning the wrist over."""
    robot = load_robot("irb1600_10_145")
    rng = np.random.default_rng(3)
    for _ in range(20):
        q = rng.uniform([-1, 0.2, -0.3, -1, 0.3, -1], [1, 0.6, 0.3, 1, 1.2, 1])
        (one,) = placements(robot, q[None])
        assert (one.in_front, one.elbow_up, one.wrist_positive) == (True, True, True)
        over = q + [0, 0, 0, np.pi, 0, np.pi]
        over[4] = -q[4]
        assert distance(robot.forward(q), robot.forward(over))[0] < 1e-6
        (other,) = placements(robot, over[None])
        assert (other.in_front, other.elbow_up, other.wrist_positive) == (True, True, False)
        (back,) = placements(robot, np.array([[q[0], -1.2, -0.5, q[3], q[4], q[5]]]))
        assert not back.in_front
        (down,) = placements(robot, np.array([[q[0], 1.2, -2.4, q[3], q[4], q[5]]]))
        assert not down.elbow_up


ANGLES = [(0, 0, 0), (10, 90, 20), (10, -90, 20), (180, 0, 180), (-180, 45, 90), (30, 89.99999, -60), (0, 180, 0)]


@pytest.mark.parametrize("seed", range(3))
def test_angles_of_every_maker_turn_back_into_the_rotation(seed):
    some = [Rotation.from_euler("ZYX", angles, degrees=True) for angles in ANGLES]
    some += list(Rotation.random(200, random_state=seed))
    for rotation in some:
        matrix = rotation.as_matrix()
        z, y, x = euler_zyx_deg(matrix)
        words = ",".join(f"{k} {plain(v, 6)}" for k, v in zip("XYZABC", (1, 2, 3, z, y, x), strict=True))
        for back in (
            kuka_frame(words),
            fixed_axes(1, 2, 3, x, y, z),
            by_quaternion([1, 2, 3], *quaternion_wxyz(matrix)),
        ):
            assert np.abs(back[:3, :3] - matrix).max() < 1e-7


def test_a_dry_run_switches_nothing_and_a_hot_run_only_what_is_named(planned):
    language, motions = planned
    number = "doArc" if language == "rapid" else "5"
    volts = "aoVolts" if language == "rapid" else "2"
    dry = read(robot_programme(motions[0]), language)[2]
    assert {kind for kind, *_ in dry} == {"joints", "pose"}
    arc = ArcOptions(number, ((volts, 22.5),), start_s=0.3, crater_s=0.7)
    hot = read(robot_programme(motions[0], RobotProgrammeOptions(name="prog_arc", arc=arc)), language)[2]
    kinds = [kind for kind, *_ in hot]
    assert kinds[:2] == ["joints", "pose"] and kinds[-1] == "pose"  # it goes down, and leaves, without an arc
    assert hot[2:5] == [("output", volts, 22.5), ("output", number, True), ("wait", 0.3)]
    assert hot[-4:-1] == [("wait", 0.7), ("output", number, False), ("output", volts, 0.0)]
    poses = [step[1] for step in hot if step[0] == "pose"]
    np.testing.assert_array_equal(poses, [step[1] for step in dry if step[0] == "pose"])


def test_rapid_knows_the_arc_package(planned):
    language, motions = planned
    programme = robot_programme(motions[0], RobotProgrammeOptions(arc=ArcOptions(data=("sm1", "wd1"))))
    if language != "rapid":
        with pytest.raises(InputError, match="seam and weld data are for RAPID"):
            programme_files(programme, language)
        return
    arcs = [word for kind, word, *_ in read(programme, language)[2] if kind == "arc"]
    assert arcs[0] == "ArcLStart sm1,wd1,fine" and arcs[-1].startswith("ArcLEnd sm1,wd1,fine")
    assert len(arcs) == len(motions[0].path.q_rad) and all(word.startswith("ArcL sm1,wd1,") for word in arcs[1:-1])


@pytest.mark.parametrize("name", ["", "1st", "weld seam", "schweißen", "x" * 40, "a;b", "weld\n"])
def test_names_that_a_controller_does_not_take_are_refused(planned, name):
    language, motions = planned
    with pytest.raises(InputError, match="takes no programme named"):
        programme_files(robot_programme(motions[0], RobotProgrammeOptions(name=name)), language)


def test_outputs_that_a_controller_does_not_have_are_refused(planned):
    language, motions = planned
    for output in ("do arc", "0x5", "-1", "99999", "x;Stop"):
        programme = robot_programme(motions[0], RobotProgrammeOptions(arc=ArcOptions(output)))
        with pytest.raises(InputError, match=r"takes no signal|counts its outputs"):
            programme_files(programme, language)


def test_bad_options_are_refused():
    for bad, message in (
        ({}, "needs the digital output"),
        ({"output": "5", "data": ("a", "b")}, "one of them"),
        ({"data": ("a", "b"), "setpoints": (("1", 2.0),)}, "hold their own"),
        ({"output": "5", "start_s": -1.0}, "the start time"),
        ({"output": "5", "setpoints": (("1", float("nan")),)}, "the setpoint of 1"),
    ):
        with pytest.raises(InputError, match=message):
            ArcOptions(**bad)
    with pytest.raises(InputError, match="give 0 to 99"):
        RobotProgrammeOptions(tool_number=100)
    for value in (np.nan, np.inf):
        with pytest.raises(InputError, match="cannot hold"):
            plain(value, 3)
    assert plain(-1e-9, 4) == "0.0000" and plain(-12.5, 2) == "-12.50"


def test_arms_without_a_placement_are_refused():
    welding = plan_motion(welder(), s_trajectory(5), PlanMotionOptions(seed=8))
    with pytest.raises(InputError, match="ur3 miss one point by"):
        robot_programme(welding)
    programme = robot_programme(welding, RobotProgrammeOptions(placed=False))
    with pytest.raises(InputError, match="names no placement"):
        programme_files(programme, "krl")
    with pytest.raises(InputError, match="unknown language 'basic'"):
        programme_files(programme, "basic")
    ((name, text),) = programme_files(programme, "urscript").items()
    assert name == "program.script" and text.startswith("def program():\n") and text.endswith("\nend\n")
    with pytest.raises(InputError, match="no arm of Universal Robots"):
        programme_files(replace(programme, joints=("J1",) * 6), "urscript")
    with pytest.raises(InputError, match="singular"):
        placements(grinder(), np.zeros((1, 6)))


def test_slow_speeds_are_rounded_down_or_refused():
    assert [speed_words(v) for v in (8.0, 8.3, 0.5)] == ["8mm/sec", "49cm/min", "3cm/min"]
    with pytest.raises(InputError, match="below 1 cm/min"):
        speed_words(0.1)
    assert LinearMove(np.eye(4), np.zeros(6), 8.0).zone_mm == 0.0


@pytest.mark.parametrize("name", sorted(known_robots()))
def test_every_listed_arm_loads_and_stands_where_its_table_says(name):
    known = known_robots()[name]
    robot = load_robot(name)
    q = np.random.default_rng(1).uniform(-1.0, 1.0, 6)
    flange = forward(known.arm, q) @ np.array(known.T_last_flange)
    assert distance(robot.forward(q), flange @ robot.tool.T_flange_tool)[0] < 1e-6
    assert known.source.startswith("https://") and 400 < known.reach_mm < 2500
    assert np.isclose(np.linalg.det(np.array(known.T_last_flange)), 1.0)


def test_the_listed_arms_reach_where_their_makers_say():
    """The flange with all joints at zero, in the controller's base, from the lengths on the makers' drawings."""
    at_zero = {
        "irb1200_5_90": (533.0, 0.0, 889.1),
        "irb1600_10_145": (815.0, 0.0, 1186.5),
        "kr6_r900": (980.0, 0.0, 435.0),
        "kr10_r1420": (1500.0, 0.0, 470.0),
        "lrmate200id": (465.0, 0.0, 365.0),
        "m10ia": (890.0, 0.0, 800.0),
        "gp7": (560.0, 0.0, 485.0),
        "ur5e": (-817.2, -232.9, 62.8),
    }
    for name, place in at_zero.items():
        known = known_robots()[name]
        flange = np.array(known.T_controller_base) @ forward(known.arm, np.zeros(6)) @ np.array(known.T_last_flange)
        np.testing.assert_allclose(flange[:3, 3], place, atol=0.01, err_msg=name)


def test_a_seam_out_of_reach_is_refused():
    with pytest.raises(UnreachableError):
        plan_motion(load_robot("gp7"), s_trajectory(5, (1500.0, 0.0, 60.0)))
