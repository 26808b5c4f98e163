import re

import numpy as np
import pytest

from grindvision.arm import read_arm
from grindvision.errors import CollisionError, InputError, UnreachableError
from grindvision.geometry import rigid, rotation_about, vector_angle
from grindvision.motion import (
    ER3A_LIMITS,
    JointLimits,
    PlanMotionOptions,
    Trajectory,
    box,
    follow_trajectory,
    grinding_spindle,
    mdh_robot,
    measure_clearance,
    mesh,
    plan_motion,
    scanned,
    start_angles,
    table,
    time_law,
)
from tests.motion_scene import (
    ER3A_TABLE,
    distance,
    grinder,
    ring,
    s_trajectory,
    shifted,
    ur3_flange_mm,
    welder,
)


@pytest.fixture(scope="module")
def ur3():
    return welder()


@pytest.fixture(scope="module")
def motion(ur3):
    return plan_motion(ur3, s_trajectory(), PlanMotionOptions(tool_speed_mm_s=8.0, seed=4))


def test_every_branch_of_the_ur3_is_found(ur3, rng):
    wanted = s_trajectory().T_base_tool[0]
    branches = start_angles(ur3, wanted, rng)
    assert len(branches) == 8
    assert all(max(distance(ur3.forward(q), wanted)) < 1e-3 for q in branches)
    assert min(np.abs(a - b).max() for i, a in enumerate(branches) for b in branches[:i]) > 0.1


def test_the_tool_follows_by_the_makers_kinematics(ur3, motion):
    T_base_controller = np.linalg.inv(ur3.T_controller_base)
    for q, wanted in zip(motion.path.q_rad, motion.trajectory.T_base_tool, strict=True):
        off_mm, off_deg = distance(T_base_controller @ ur3_flange_mm(q) @ ur3.tool.T_flange_tool, wanted)
        assert off_mm < 0.05 and off_deg < 0.1
    assert (motion.path.q_rad > ur3.limits.lower_rad).all() and (motion.path.q_rad < ur3.limits.upper_rad).all()


@pytest.mark.parametrize("joints", [4, 5, 6])
def test_a_path_the_arm_has_driven_is_found_again(joints, rng):
    limits = JointLimits(*(values[:joints] for values in vars(ER3A_LIMITS).values()))
    robot = mdh_robot("arm", read_arm(ER3A_TABLE).first(joints), grinding_spindle(), limits)
    q_start = np.array([0.2, -0.5, -0.4, 0.5, 0.7, -0.3])[:joints]
    step = rng.normal(0, 0.02, joints)
    driven = q_start + step * np.arange(25)[:, None]
    path = follow_trajectory(robot, Trajectory(robot.forward(driven)), q_start)
    assert np.abs(path.q_rad - driven).max() < 1e-5
    assert path.position_error_mm.max() < 1e-3 and path.angle_error_rad.max() < 1e-5


def test_a_ring_turns_the_wrist_once_and_stays_inside_its_limits(ur3, rng):
    closed = ring()
    start = next(q for q in start_angles(ur3, closed.T_base_tool[0], rng))
    turned_up = start.copy()
    turned_up[5] += 2 * np.pi * (1 if start[5] < 0 else 0)  # above zero: a full turn up would break the limit
    for q in (start, turned_up):
        path = follow_trajectory(ur3, closed, q)
        assert abs(path.q_rad[-1, 5] - path.q_rad[0, 5]) == pytest.approx(2 * np.pi, abs=1e-6)
        assert np.abs(path.q_rad[-1, :5] - path.q_rad[0, :5]).max() < 1e-6
        assert (np.abs(path.q_rad) <= ur3.limits.upper_rad).all()


def test_a_grinding_tool_may_spin_freely_but_keeps_its_axis(rng):
    robot, trajectory = grinder(), s_trajectory(centre=(380.0, 0.0, 120.0))
    motion = plan_motion(robot, trajectory, PlanMotionOptions(tool_speed_mm_s=20.0, spin_free=True, seed=rng))
    reached = robot.forward(motion.path.q_rad)
    assert np.linalg.norm(reached[:, :3, 3] - trajectory.positions_mm, axis=1).max() < 0.05
    assert np.degrees(vector_angle(reached[:, :3, 2], trajectory.T_base_tool[:, :3, 2])).max() < 0.1
    held = follow_trajectory(robot, Trajectory(reached), motion.path.q_rad[0])
    assert np.abs(held.q_rad - motion.path.q_rad).max() < 1e-4  # held fast, the same frames give the same angles


def test_the_same_seed_gives_the_same_motion(ur3, motion):
    again = plan_motion(ur3, s_trajectory(), PlanMotionOptions(tool_speed_mm_s=8.0, seed=4))
    assert np.array_equal(again.path.q_rad, motion.path.q_rad)
    assert np.array_equal(again.timing.time_s, motion.timing.time_s)


def test_an_unreachable_groove_says_where_why_and_what_to_move(ur3, rng):
    far = s_trajectory(centre=(640.0, 0.0, 60.0))
    with pytest.raises(
        UnreachableError, match=r"way point 0 at \(637, -70, 53\).*30 of 30.*beyond the arm's reach"
    ) as no:
        plan_motion(ur3, far, PlanMotionOptions(tool_speed_mm_s=8.0, seed=rng))
    shift = np.array(
        [float(x) for x in re.search(r"move the work by about \(([^)]*)\)", str(no.value)).group(1).split(",")]
    )
    assert 0 < np.linalg.norm(shift) < 400
    towards = shift / np.linalg.norm(shift)
    nearer = far.moved(shifted(*(shift + 20 * towards)))
    assert start_angles(ur3, nearer.T_base_tool[0], rng)
    follow_trajectory(ur3, nearer, start_angles(ur3, nearer.T_base_tool[0], rng)[0])


def test_a_joint_at_its_limit_is_named(rng):
    free = grinder()
    wanted = s_trajectory(centre=(380.0, 0.0, 120.0))
    start = plan_motion(free, wanted, PlanMotionOptions(tool_speed_mm_s=20.0, seed=rng)).path.q_rad[0]
    upper = ER3A_LIMITS.upper_rad.copy()
    upper[0] = start[0] + 0.05
    tight = JointLimits(ER3A_LIMITS.lower_rad, upper, ER3A_LIMITS.speed_rad_s, ER3A_LIMITS.acceleration_rad_s2)
    robot = mdh_robot("tight", read_arm(ER3A_TABLE), grinding_spindle(), tight)
    with pytest.raises(UnreachableError, match="J1 at"):
        follow_trajectory(robot, wanted, start)


def test_a_jump_to_the_other_side_is_not_taken_for_a_seam(ur3, rng):
    here = s_trajectory().T_base_tool[0]
    # Not half a turn: there the arm may as well fold over its shoulder, and rounding decides.
    behind = rigid(rotation_about((0, 0, 1), np.radians(140))) @ here
    start = start_angles(ur3, here, rng)[0]
    with pytest.raises(
        UnreachableError, match=r"between way points 0 and 1 the arm would swing.*shoulder_pan_joint turns by"
    ):
        follow_trajectory(ur3, Trajectory(np.stack([here, behind])), start)


def test_bad_starts_are_refused(ur3, rng):
    trajectory = s_trajectory()
    with pytest.raises(InputError, match="6 finite numbers"):
        follow_trajectory(ur3, trajectory, np.zeros(5))
    with pytest.raises(InputError, match=r"elbow_joint is 200.0 deg"):
        follow_trajectory(ur3, trajectory, np.radians([0, 0, 200, 0, 0, 0]))
    with pytest.raises(InputError, match="starts is 0"):
        start_angles(ur3, trajectory.T_base_tool[0], rng, starts=0)


def test_clearance_to_a_table_is_the_height_of_the_nozzle(ur3, motion):
    q = motion.path.q_rad
    free = measure_clearance(ur3, q, [table(0.0), table(10.0)])
    assert free.against == ("itself", "table", "table")
    assert np.allclose(free.distance_mm[:, 1] - free.distance_mm[:, 2], 10.0, atol=1e-3)
    upright = motion.trajectory.T_base_tool.copy()
    upright[:, :3, :3] = np.diag([1.0, -1.0, -1.0])
    straight_down = follow_trajectory(ur3, Trajectory(upright), q[0])
    height = measure_clearance(ur3, straight_down.q_rad, [table(0.0)]).distance_mm[:, 1]
    assert height == pytest.approx(upright[:, 2, 3] + 15.0, abs=1e-3)  # the wire stands out by 15 mm


def test_box_mesh_and_scan_of_one_block_keep_the_same_distance(ur3, motion):
    T_base_block = rigid(translation_mm=[310.0, 0.0, 20.0])
    corners = np.array([[x, y, z] for x in (-40, 40) for y in (-90, 90) for z in (-20, 20)], dtype=float)
    sides = [
        [0, 1, 3],
        [0, 3, 2],
        [4, 6, 7],
        [4, 7, 5],
        [0, 4, 5],
        [0, 5, 1],
        [2, 3, 7],
        [2, 7, 6],
        [0, 2, 6],
        [0, 6, 4],
    ]
    sides += [[1, 5, 7], [1, 7, 3]]
    x, y = np.meshgrid(np.arange(270.5, 350), np.arange(-89.5, 90))
    top = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 39.5)])
    obstacles = [
        box("box", [80, 180, 40], T_base_block),
        mesh("mesh", corners, sides, T_base_block),
        scanned("scan", top, cell_mm=2.0),
    ]
    free = measure_clearance(ur3, motion.path.q_rad, obstacles).distance_mm
    assert np.allclose(free[:, 1], free[:, 2], atol=1e-3)
    assert np.abs(free[:, 1] - free[:, 3]).max() <= 2.0


def test_obstacles_that_make_no_sense_are_refused(ur3):
    with pytest.raises(InputError, match="three edges above 0"):
        box("flat", [10, 10, 0], np.eye(4))
    with pytest.raises(InputError, match="numbers of its vertices"):
        mesh("torn", np.eye(3), [[0, 1, 3]], np.eye(4))
    with pytest.raises(InputError, match="cell is 0"):
        scanned("fine", np.eye(3), 0.0)
    with pytest.raises(InputError, match=r"\(N, 6\)"):
        measure_clearance(ur3, np.zeros(6))


def test_a_groove_behind_the_table_is_named(ur3, rng):
    with pytest.raises(CollisionError, match=r"behind the table: way point 0 is 27.4 mm below its top.*30 of 30"):
        plan_motion(ur3, s_trajectory(centre=(310, 0, -20)), PlanMotionOptions(tool_speed_mm_s=8.0, seed=rng))


def test_a_wall_in_the_way_is_named(ur3, rng):
    wall = box("wall", [200, 10, 300], rigid(translation_mm=[310.0, 0.0, 150.0]))
    with pytest.raises(CollisionError, match=r"and wall come within .* on the best of .* branches of ur3"):
        plan_motion(ur3, s_trajectory(), PlanMotionOptions(tool_speed_mm_s=8.0, obstacles=[wall], seed=rng))
    with pytest.raises(InputError, match="way in and out is 0"):
        PlanMotionOptions(backed_off_mm=0.0)


def test_the_motion_backs_off_along_the_tool_and_stays_clear(ur3, motion):
    for q, at in ((motion.q_approach_rad, 0), (motion.q_retreat_rad, -1)):
        touching = motion.path.T_base_tool[at]
        back = ur3.forward(q)
        assert back[:3, 3] == pytest.approx(touching[:3, 3] - 40 * touching[:3, 2], abs=1e-2)
        assert np.allclose(back[:3, :3], touching[:3, :3], atol=1e-4)
    assert len(motion.clearance.distance_mm) == len(motion.path.q_rad) + 2
    assert motion.clearance.min_mm >= 2.0


@pytest.mark.parametrize("tool_speed_mm_s", [8.0, 60.0, 2000.0])
def test_no_limit_is_broken_at_any_speed(ur3, motion, tool_speed_mm_s):
    timing = time_law(motion.path, ur3.limits, tool_speed_mm_s, samples=4001)
    assert (np.abs(timing.speed_rad_s) <= ur3.limits.speed_rad_s).all()
    assert (np.abs(timing.acceleration_rad_s2) <= ur3.limits.acceleration_rad_s2).all()
    assert (timing.q_rad >= ur3.limits.lower_rad).all() and (timing.q_rad <= ur3.limits.upper_rad).all()
    assert timing.tool_speed_mm_s.max() <= tool_speed_mm_s * (1 + 1e-6)
    assert (np.diff(timing.arc_mm) >= 0).all()
    assert np.abs(timing.speed_rad_s[[0, -1]]).max() < 1e-3
    assert timing.time_s[-1] >= motion.trajectory.arc_mm[-1] / tool_speed_mm_s


def test_limits_hold_between_grid_points_on_a_jagged_path(ur3, motion, rng):
    jagged = motion.trajectory.T_base_tool.copy()
    jagged[:, :3, 3] += rng.normal(0, 0.5, (len(jagged), 3))
    path = follow_trajectory(ur3, Trajectory(jagged), motion.path.q_rad[0])
    timing = time_law(path, ur3.limits, 100.0, samples=8001)
    assert (np.abs(timing.speed_rad_s) <= ur3.limits.speed_rad_s).all()
    assert (np.abs(timing.acceleration_rad_s2) <= ur3.limits.acceleration_rad_s2).all()
    assert timing.steady_fraction < 0.5  # the joints, not the torch, set the pace


def test_the_time_law_is_consistent_with_itself_and_the_path(ur3, motion):
    timing = motion.timing
    assert np.gradient(timing.q_rad, timing.time_s, axis=0)[20:-20] == pytest.approx(
        timing.speed_rad_s[20:-20], abs=2e-3
    )
    at_way_points = np.stack([np.interp(timing.waypoint_time_s, timing.time_s, q) for q in timing.q_rad.T], axis=1)
    assert np.abs(at_way_points - motion.path.q_rad).max() < 1e-3
    assert timing.steady_fraction > 0.97  # a slow torch runs steadily but for the two ends
    assert time_law(motion.path, ur3.limits, 2000.0).steady_fraction == 0.0


def test_between_way_points_the_tool_stays_on_the_seam(ur3, motion):
    dense = s_trajectory(points=581)  # 20 steps for each of the 29 between way points
    on_path = np.stack([np.interp(dense.arc_mm, motion.timing.arc_mm, q) for q in motion.timing.q_rad.T], axis=1)
    off_mm = np.linalg.norm(ur3.forward(on_path)[:, :3, 3] - dense.positions_mm, axis=1)
    assert off_mm.max() < 0.25


def test_a_speed_that_is_none_is_refused(ur3, motion):
    for speed in (0.0, -1.0, np.nan):
        with pytest.raises(InputError, match="tool's speed"):
            time_law(motion.path, ur3.limits, speed)
    with pytest.raises(InputError, match="samples is 1"):
        time_law(motion.path, ur3.limits, 8.0, samples=1)
