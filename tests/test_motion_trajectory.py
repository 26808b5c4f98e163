import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from grindvision.errors import DegenerateError, InputError, NotRigidError
from grindvision.geometry import move_points, random_rotation, rigid, rotate_vectors, vector_angle
from grindvision.motion import (
    ToolTrajectoryOptions,
    Trajectory,
    angular_speed_rad_s,
    limit_angular_speed,
    tool_trajectory,
)
from tests.motion_scene import ring, s_trajectory, seam


def test_tool_points_into_the_surface_and_x_runs_along_the_seam():
    positions, normals = seam(200)
    poses = tool_trajectory(positions, normals).T_base_tool
    assert np.allclose(poses[:, :3, 3], positions)
    assert np.allclose(poses[:, :3, 2], -normals, atol=1e-12)
    along = np.gradient(positions, axis=0)
    across_surface = along - np.sum(along * normals, axis=1, keepdims=True) * normals
    assert np.degrees(vector_angle(poses[:, :3, 0], across_surface)).max() < 1.0
    assert np.allclose(np.linalg.det(poses[:, :3, :3]), 1.0)


def test_frames_turn_with_the_work(rng):
    positions, normals = seam()
    T_new_base = rigid(random_rotation(rng), [10.0, -300.0, 7.0])
    moved_before = tool_trajectory(move_points(T_new_base, positions), rotate_vectors(T_new_base, normals))
    assert np.allclose(moved_before.T_base_tool, tool_trajectory(positions, normals).moved(T_new_base).T_base_tool)


def test_metres_give_the_same_frames_as_millimetres():
    positions, normals = seam()
    in_mm, in_m = tool_trajectory(positions, normals), tool_trajectory(positions / 1000, normals)
    assert np.allclose(in_mm.T_base_tool[:, :3, :3], in_m.T_base_tool[:, :3, :3])


def test_the_seam_backwards_keeps_the_axis_and_turns_x_and_y():
    positions, normals = seam()
    there, back = tool_trajectory(positions, normals), tool_trajectory(positions[::-1], normals[::-1])
    assert np.allclose(there.T_base_tool[:, :3, :3] * [-1, -1, 1], back.T_base_tool[::-1, :3, :3])


def test_a_ring_has_no_seam_where_it_closes():
    trajectory = ring(36)
    poses = trajectory.T_base_tool
    tenth_turn = rigid(Rotation.from_euler("z", 10, degrees=True).as_matrix())
    centre = rigid(translation_mm=poses[:, :3, 3].mean(axis=0))
    about_centre = np.linalg.inv(centre) @ poses
    assert np.allclose(tenth_turn @ about_centre, np.roll(about_centre, -1, axis=0), atol=1e-9)
    assert np.allclose(trajectory.T_base_tool_worked[-1], poses[0]) and len(trajectory.T_base_tool_worked) == 37
    assert trajectory.arc_mm[-1] == pytest.approx(36 * 2 * 50 * np.sin(np.pi / 36))


def test_frames_do_not_spin_on_a_noisy_surface(rng):
    straight = np.linspace(0, 300, 60)[:, None] * [0.0, 1.0, 0.0]
    rough = np.array([0.0, 0.0, 1.0]) + rng.normal(0, 0.02, straight.shape)
    poses = tool_trajectory(straight, rough).T_base_tool
    steps = Rotation.from_matrix(np.swapaxes(poses[:-1, :3, :3], 1, 2) @ poses[1:, :3, :3]).as_rotvec()
    assert np.degrees(np.abs(steps[:, 2])).max() < 0.1  # second order in the tilt
    assert np.degrees(np.abs(steps[:, 0])).max() > 1.0


@pytest.mark.parametrize(("work_deg", "travel_deg"), [(0, 12), (15, 0), (-20, 0), (0, -30)])
def test_work_and_travel_angle_tilt_the_tool_about_a_fixed_tip(work_deg, travel_deg):
    positions, normals = seam()
    plain = tool_trajectory(positions, normals).T_base_tool
    tilted = tool_trajectory(
        positions,
        normals,
        ToolTrajectoryOptions(work_angle_rad=np.radians(work_deg), travel_angle_rad=np.radians(travel_deg)),
    ).T_base_tool
    assert np.array_equal(tilted[:, :3, 3], plain[:, :3, 3])
    assert np.degrees(vector_angle(tilted[:, :3, 2], -normals)) == pytest.approx(abs(work_deg + travel_deg), abs=1e-9)
    forward = np.sum(tilted[:, :3, 2] * plain[:, :3, 0], axis=1)
    sideways = np.sum(tilted[:, :3, 2] * plain[:, :3, 1], axis=1)
    assert forward == pytest.approx(np.sin(np.radians(travel_deg)))
    assert sideways == pytest.approx(-np.sin(np.radians(work_deg)))


def test_roll_pitch_yaw_rebuild_the_frames():
    trajectory = s_trajectory()
    roll, pitch, yaw = trajectory.rpy_rad.T

    def about(axis, angle):
        return Rotation.from_rotvec(np.outer(angle, axis)).as_matrix()

    turned = about([0, 0, 1], yaw) @ about([0, 1, 0], pitch) @ about([1, 0, 0], roll)
    assert np.allclose(turned, trajectory.T_base_tool[:, :3, :3])


def test_spinning_keeps_tip_and_axis_and_can_be_undone():
    trajectory = s_trajectory()
    spun = trajectory.spun(0.7)
    assert np.allclose(spun.T_base_tool[:, :3, 2:], trajectory.T_base_tool[:, :3, 2:])
    assert np.degrees(vector_angle(spun.T_base_tool[:, :3, 0], trajectory.T_base_tool[:, :3, 0])) == pytest.approx(
        np.degrees(0.7)
    )
    assert np.allclose(spun.spun(-0.7).T_base_tool, trajectory.T_base_tool)


@pytest.mark.parametrize("closed", [False, True])
def test_steadied_frames_forget_the_noise_and_keep_the_bend(rng, closed):
    angle = np.linspace(0, 2 * np.pi, 150, endpoint=False)[: None if closed else 60]
    outward = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    rough = 60 * outward + rng.normal(0, 0.1, outward.shape)
    shaken = outward + rng.normal(0, 0.05, outward.shape)
    true = tool_trajectory(60 * outward, outward, ToolTrajectoryOptions(closed=closed)).T_base_tool
    shaky, steady = (
        tool_trajectory(rough, shaken, ToolTrajectoryOptions(closed=closed, steady_mm=mm)).T_base_tool
        for mm in (0.0, 10.0)
    )
    for column in (0, 2):
        before, after = (vector_angle(poses[:, :3, column], true[:, :3, column]).mean() for poses in (shaky, steady))
        assert after < before / 2
    steadied = tool_trajectory(60 * outward, outward, ToolTrajectoryOptions(closed=closed, steady_mm=10.0)).T_base_tool
    assert np.degrees(vector_angle(steadied[:, :3, 2], true[:, :3, 2])).max() < 0.3  # no lag at open ends
    assert np.array_equal(steadied[:, :3, 3], true[:, :3, 3])


@pytest.mark.parametrize("trajectory", [s_trajectory(8), ring(12)], ids=["open", "closed"])
def test_a_refined_trajectory_keeps_its_poses_and_its_steps_small(trajectory):
    fine = trajectory.refined(step_mm=4.0, step_rad=0.05)
    gaps = np.linalg.norm(fine.positions_mm[:, None] - trajectory.positions_mm, axis=2)
    kept = fine.T_base_tool[gaps.argmin(axis=0)]
    assert np.allclose(kept, trajectory.T_base_tool, atol=1e-9)
    poses = fine.T_base_tool_worked
    turns = Rotation.from_matrix(np.swapaxes(poses[:-1, :3, :3], 1, 2) @ poses[1:, :3, :3]).magnitude()
    assert np.diff(fine.arc_mm).max() < 4.2 and turns.max() < 0.06  # the curve is a little longer than its chords
    assert fine.closed == trajectory.closed
    if trajectory.closed:
        assert np.linalg.norm(fine.positions_mm - [290.0, 20.0, 50.0], axis=1) == pytest.approx(50.0, abs=0.05)
    assert trajectory.refined(1e3, 10.0).positions_mm == pytest.approx(trajectory.positions_mm)


def test_bad_way_points_are_named():
    positions, normals = seam()
    with pytest.raises(InputError, match="29 normals"):
        tool_trajectory(positions, normals[:-1])
    with pytest.raises(DegenerateError, match="coincide at"):
        tool_trajectory(np.repeat(positions, 2, axis=0), np.repeat(normals, 2, axis=0))
    with pytest.raises(DegenerateError, match="normal of way point 3"):
        tool_trajectory(positions, np.where(np.arange(30)[:, None] == 3, 0.0, normals))
    with pytest.raises(DegenerateError, match="way point 0 the seam runs along the surface normal"):
        tool_trajectory(positions, np.gradient(positions, axis=0))
    with pytest.raises(InputError, match="NaN"):
        tool_trajectory(positions * np.nan, normals)
    with pytest.raises(DegenerateError, match="at least 2"):
        tool_trajectory(positions[:1], normals[:1])
    with pytest.raises(InputError, match="both must be above 0"):
        s_trajectory().refined(0.0, 0.1)
    with pytest.raises(InputError, match="steady_mm is -1"):
        tool_trajectory(positions, normals, ToolTrajectoryOptions(steady_mm=-1.0))
    with pytest.raises(InputError, match="travel angle"):
        tool_trajectory(positions, normals, ToolTrajectoryOptions(travel_angle_rad=15.0))
    with pytest.raises(NotRigidError, match="way point 1"):
        Trajectory(np.stack([np.eye(4), 2 * np.eye(4)]))
    with pytest.raises(InputError, match=r"\(4, 4\)"):
        Trajectory(np.eye(4))


@pytest.mark.parametrize("name", ["work_angle_rad", "travel_angle_rad"])
def test_a_tool_tilted_by_a_right_angle_is_refused_and_one_by_little_less_is_not(name):
    assert getattr(ToolTrajectoryOptions(**{name: -1.57}), name) == -1.57
    for angle in (1.571, -1.571, np.nan):
        with pytest.raises(InputError, match=f"{name.split('_')[0]} angle"):
            ToolTrajectoryOptions(**{name: angle})


def test_a_bound_on_turning_is_kept_by_steadying_and_refused_where_the_seam_bends_more(rng):
    x = np.linspace(0.0, 100.0, 51)
    way = np.column_stack([x, 0.1 * rng.normal(size=51), 0 * x])
    up = np.tile([0.0, 0.0, 1.0], (51, 1)) + 0.03 * rng.normal(size=(51, 3))
    options = ToolTrajectoryOptions(travel_angle_rad=-0.2)
    rough, bound = tool_trajectory(way, up, options), np.radians(1.0)
    calm = limit_angular_speed(way, up, options, 8.0, bound)
    assert angular_speed_rad_s(rough, 8.0) > 5 * bound and angular_speed_rad_s(calm, 8.0) <= bound
    np.testing.assert_array_equal(calm.positions_mm, way)
    assert limit_angular_speed(way, up, options, 8.0, 100.0) == rough  # nothing is steadied without need
    angle = np.linspace(0.0, np.pi, 40)
    arch = np.column_stack([20 * np.cos(angle), 20 * np.sin(angle), 0 * angle])
    with pytest.raises(InputError, match=r"the seam itself turns the tool at .* weld slower"):
        limit_angular_speed(arch, np.tile([0.0, 0.0, 1.0], (40, 1)), options, 8.0, np.radians(2.0))
    with pytest.raises(InputError, match="give both above 0"):
        limit_angular_speed(way, up, options, 8.0, 0.0)
