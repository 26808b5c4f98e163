"""A seam all round a tube: found in merged views, welded with an overlap, and every maker's programme read back."""

import warnings
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial import cKDTree

from grindvision.cell import DepthCamera, JointSize, joint_piece
from grindvision.cell.rays import target_of
from grindvision.cell.views import view_from
from grindvision.cli.weld_job import within_reach
from grindvision.errors import GrindvisionWarning, InputError, UnreachableError
from grindvision.geometry import inverse, move_points, vector_angle
from grindvision.motion import (
    ArcOptions,
    PlanMotionOptions,
    RobotProgrammeOptions,
    ToolTrajectoryOptions,
    WeldPathOptions,
    known_robots,
    load_robot,
    plan_motion,
    programme_files,
    tool_trajectory,
    weld_path,
    welding_programme,
)
from grindvision.vision.seam.seam_path import root_path
from grindvision.vision.seam.seams import find_seams
from tests.motion_scene import distance
from tests.seam_scenes import tube_all_round
from tests.test_welding_path import READERS

OVERLAP_MM = 10.0
#: An arm whose last joint turns more than twice, and one that spins the torch and whose wrist is a ball.
ARMS = {False: "ur5e", True: "irb1200_5_90"}


@pytest.fixture(scope="module")
def around():
    """Way points round a tube of 20 mm radius about (400, 0, 0), as the detector gives them."""
    (seam,) = find_seams(tube_all_round(np.random.default_rng(5))).seams
    return root_path(seam, 40)


def torch_path(around, ahead_mm):
    """The way points as a seam of the torch, ``ahead_mm`` in front of the arm and 120 mm up, and the welding path."""
    points = around.points + [ahead_mm - 400.0, 0.0, 120.0]
    seam = tool_trajectory(points, around.normals, ToolTrajectoryOptions(closed=True))
    return seam, weld_path(seam, WeldPathOptions(8.0, run_off_mm=OVERLAP_MM))


def test_the_path_goes_all_round_and_over_its_own_start(around):
    seam, path = torch_path(around, 400.0)
    whole = float(seam.arc_mm[-1])
    assert whole == pytest.approx(2 * np.pi * 20.0, rel=0.01)
    assert path.lengths_mm == pytest.approx((whole + OVERLAP_MM,))
    frames = path.trajectory.T_base_tool
    turns = [distance(*pair)[1] for pair in pairwise(frames)]
    assert max(turns) < np.degrees(0.1) + 0.1
    again = path.seam_mm > whole - 1e-6
    off = [
        distance(seam.poses_at([at - whole])[0], frame)[0]
        for at, frame in zip(path.seam_mm[again], frames[again], strict=True)
    ]
    assert again.sum() >= 2 and max(off) < 1e-6


@pytest.fixture(scope="module")
def welded(around):
    """Two arms go once round the tube and on, from a start from which both can: one turns the torch with the seam, one
    spins it about its wire."""
    settings = {spin: PlanMotionOptions(table_top_mm=-500.0, spin_free=spin) for spin in (False, True)}

    def planned(begun):
        path = torch_path(begun, 420.0)[1]
        return path, {
            spin: plan_motion(load_robot(ARMS[spin]), path.trajectory, path.plan_options(settings[spin]))
            for spin in (False, True)
        }

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GrindvisionWarning)
        return within_reach(around, planned)


def test_a_ring_is_begun_where_the_arm_can_go_round_from(around):
    tried = []

    def from_one_place_only(path):
        tried.append(path)
        if len(tried) < 4:
            raise UnreachableError(f"attempt {len(tried)}")
        return path

    with pytest.warns(GrindvisionWarning, match="begins and ends at way point 16"):
        begun = within_reach(around, from_one_place_only)
    assert np.array_equal(begun.points[-15:], around.points[:15]) and np.array_equal(begun.points[0], around.points[15])
    assert begun.closed and begun.length_mm == pytest.approx(around.length_mm)

    def from_nowhere(path):
        tried.append(path)
        raise UnreachableError(f"attempt {len(tried)}")

    tried.clear()
    with pytest.raises(UnreachableError, match=r"attempt 1$"):
        within_reach(around, from_nowhere)
    assert len(tried) == 8


def test_an_open_path_is_begun_at_its_ends_only(around):
    half = replace(around, points=around.points[:20], normals=around.normals[:20], closed=False)
    with pytest.raises(InputError, match="only a closed one can begin elsewhere"):
        half.begun_at(3)

    def refuse(path):
        raise UnreachableError("once")

    with pytest.raises(UnreachableError, match="once"):
        within_reach(half, refuse)


@pytest.mark.parametrize("language", list(READERS))
def test_every_language_welds_all_round_and_fills_the_crater_behind_the_overlap(welded, language):
    path, motions = welded
    by_placement = language in ("rapid", "krl", "ls", "jbi")
    motion = motions[by_placement]
    name = "doArc" if language == "rapid" else "5"
    arc = ArcOptions(name, start_s=0.3, crater_s=0.7)
    options = RobotProgrammeOptions(arc=arc, placed=by_placement)
    if language == "ls":  # whose turn numbers are not written: joint 4 goes past 180 deg
        with pytest.raises(InputError, match="joint 4 turns past 180 deg"):
            programme_files(welding_programme(motion, path, options), language)
        return
    files = programme_files(welding_programme(motion, path, options), language)
    tool, work, said = READERS[language](*files.values())
    T_controller = np.array(known_robots()[ARMS[by_placement]].T_controller_base)
    poses = [inverse(T_controller) @ work @ step[1] for step in said if step[0] == "pose"]
    tips = np.array(poses)[:-1, :3, 3]
    assert len(tips) == len(path) and distance(tool, motion.robot.tool.T_flange_tool)[0] < 1e-3
    assert np.abs(tips - motion.path.T_base_tool[:, :3, 3]).max() < 1e-3
    assert np.abs(tips - path.trajectory.positions_mm).max() < 0.01
    axes = np.array(poses)[:-1, :3, 2]
    assert np.degrees(vector_angle(axes, path.trajectory.T_base_tool[:, :3, 2])).max() < 0.02
    switched = [at for at, step in enumerate(said) if step[:2] == ("output", name)]
    assert [said[at][2] for at in switched] == [True, False]
    first, last = switched
    assert said[first + 1] == ("wait", 0.3) and said[last - 1] == ("wait", 0.7)
    burnt = [step for step in said[first:last] if step[0] == "pose"]
    assert sum(step[0] == "pose" for step in said[:first]) == 1 and len(burnt) == len(path) - 1


def views_round(kind, size, azimuths_deg, seed, tilt_deg=40.0):
    """A piece seen from several sides, each view moved into the piece's frame: what a merge makes."""
    rng = np.random.default_rng(seed)
    piece = joint_piece(kind, size)
    target, camera = target_of(piece.solid), DepthCamera(serial=seed)
    clouds = []
    for azimuth in azimuths_deg:
        pose = view_from(piece.root_mm.mean(axis=0), 450.0, np.radians(tilt_deg), np.radians(azimuth), 0.0)
        clouds.append(move_points(pose, camera.scan(target, pose, rng, 2).points))
    return piece, np.concatenate(clouds) + [400.0, 0.0, 100.0]


def test_a_saddle_in_merged_views_is_followed_all_round():
    size = JointSize(length_mm=160, radius_mm=40, branch_mm=25, height_mm=60)
    piece, points = views_round("saddle", size, (-90, 0, 90, 180), 3)
    seam = find_seams(points).seams[0]
    truth = piece.root_mm + [400.0, 0.0, 100.0]
    assert seam.kind == "saddle" and seam.closed
    assert cKDTree(truth).query(seam.root)[0].mean() < 1.0
    assert (cKDTree(seam.root).query(truth)[0] < 3.0).mean() > 0.95
