"""Weave, run-on, passes and tacks: laws of the path, and every maker's programme of them read back."""

import json
from dataclasses import replace

import numpy as np
import pytest

from grindvision.errors import InputError
from grindvision.geometry import inverse, rigid
from grindvision.motion import (
    ArcOptions,
    GrooveSection,
    LoadRobotOptions,
    PlanMotionOptions,
    RobotProgrammeOptions,
    ToolTrajectoryOptions,
    Weave,
    WeldPathOptions,
    equal_tacks,
    fill_groove,
    known_robots,
    load_robot,
    plan_motion,
    programme_files,
    robot_programme,
    shifted_seam,
    stretches_between,
    tacks_at,
    tool_trajectory,
    weld_path,
    welding_programme,
)
from tests.motion_scene import distance, ring, seam
from tests.programme_readers import (
    read_jbi,
    read_krl,
    read_ls,
    read_rapid,
    read_steps_csv,
    read_steps_json,
    read_urscript,
)

ARMS = {"rapid": "irb1200_5_90", "krl": "kr6_r900", "ls": "lrmate200id", "jbi": "ar1440", "urscript": "ur5e"}
ARMS |= {"steps-json": "gp12", "steps-csv": "irb1200_5_90"}
READERS: dict = {"rapid": read_rapid, "krl": read_krl, "ls": read_ls, "jbi": read_jbi, "urscript": read_urscript}
READERS |= {"steps-json": read_steps_json, "steps-csv": read_steps_csv}


def straight_seam(length_mm=100.0, points=11, **settings):
    x = np.linspace(0.0, length_mm, points)
    return tool_trajectory(
        np.column_stack([x, 0 * x, 0 * x]), np.tile([0.0, 0.0, 1.0], (points, 1)), ToolTrajectoryOptions(**settings)
    )


def cornered_seam():
    """Two legs of 50 mm that meet in a right angle, with way points every 2 mm."""
    leg = np.arange(0.0, 50.1, 2.0)
    points = np.vstack([np.column_stack([leg, 0 * leg, 0 * leg]), np.column_stack([50 + 0 * leg, leg, 0 * leg])[1:]])
    return tool_trajectory(points, np.tile([0.0, 0.0, 1.0], (len(points), 1)))


@pytest.mark.parametrize("shape", ["sine", "triangle"])
@pytest.mark.parametrize("angles", [(0.0, 0.0), (0.3, -0.2), (-0.5, 0.4)])
def test_a_weave_swings_square_to_the_torch_and_comes_back_to_the_seam(shape, angles):
    trajectory = straight_seam(work_angle_rad=angles[0], travel_angle_rad=angles[1])
    path = weld_path(trajectory, WeldPathOptions(weave=Weave(4.0, 5.0, shape)))
    off = path.trajectory.positions_mm - trajectory.poses_at(path.seam_mm)[:, :3, 3]
    torch = path.trajectory.T_base_tool
    assert np.abs((off * torch[:, :3, 2]).sum(axis=1)).max() < 1e-9
    assert np.abs((off * torch[:, :3, 0]).sum(axis=1)).max() < 1e-9
    swing = (off * torch[:, :3, 1]).sum(axis=1)
    assert swing.max() == pytest.approx(2.0, abs=1e-6) and swing.min() == pytest.approx(-2.0, abs=1e-6)
    assert abs(swing[0]) < 1e-9 and abs(swing[-1]) < 1e-6
    # 20 swings of 5 mm: crossings from right to left and back
    assert np.count_nonzero(np.diff(np.sign(swing[np.abs(swing) > 1e-6]))) == 39
    want = 2 * np.sin(2 * np.pi * path.seam_mm / 5.0)
    if shape == "triangle":
        want = 4 / np.pi * np.arcsin(np.sin(2 * np.pi * path.seam_mm / 5.0))
    np.testing.assert_allclose(swing, want, atol=1e-6)


def test_the_speed_along_the_seam_stays_the_one_asked_for():
    for weave in (None, Weave(3.0, 4.0), Weave(5.0, 6.0, "triangle", 1.0)):
        path = weld_path(straight_seam(), WeldPathOptions(6.0, weave=weave))
        steps = np.linalg.norm(np.diff(path.trajectory.positions_mm, axis=0), axis=1)
        assert (steps / path.speeds_mm_s[1:]).sum() == pytest.approx(100.0 / 6.0, rel=1e-9)
        if weave is not None:  # the chords of a sine are a little slower than its steepest tangent
            highest = path.speeds_mm_s[1:].max()
            assert 0.97 * weave.tip_speed_mm_s(6.0) < highest <= weave.tip_speed_mm_s(6.0) * (1 + 1e-9)


def test_the_phase_runs_on_through_a_corner():
    trajectory = cornered_seam()
    whole = trajectory.arc_mm[-1]
    path = weld_path(trajectory, WeldPathOptions(weave=Weave(3.0, 8.0)))
    places = trajectory.poses_at(path.seam_mm)
    swing = ((path.trajectory.positions_mm - places[:, :3, 3]) * places[:, :3, 1]).sum(axis=1)
    np.testing.assert_allclose(swing, 1.5 * np.sin(2 * np.pi * path.seam_mm / path.weave.length_mm), atol=1e-6)
    assert whole / path.weave.length_mm * 2 == pytest.approx(round(whole / path.weave.length_mm * 2))


def test_a_weave_round_a_ring_meets_its_own_start():
    trajectory = ring()
    path = weld_path(trajectory, WeldPathOptions(weave=Weave(3.0, 5.0)))
    whole = trajectory.arc_mm[-1]
    assert whole / path.weave.length_mm == pytest.approx(round(whole / path.weave.length_mm))
    first, last = path.trajectory.T_base_tool[[0, -1]]
    np.testing.assert_allclose(first, last, atol=1e-6)
    lapped = weld_path(trajectory, WeldPathOptions(run_off_mm=12.0))
    assert lapped.lengths_mm[0] == pytest.approx(whole + 12.0)


def test_dwell_keeps_the_tip_at_the_toes():
    weave = Weave(4.0, 8.0, "triangle", dwell_mm=1.5)
    path = weld_path(straight_seam(80.0), WeldPathOptions(weave=weave))
    fine = np.linspace(0, 80, 8001)
    at_toe = np.abs(np.abs(weave.offsets_mm(fine)) - 2.0) < 1e-6
    assert at_toe.mean() == pytest.approx(3.0 / 8.0, abs=0.005)
    # between its positions the tip goes straight: the path is the weave itself
    y = np.interp(fine, path.seam_mm, -path.trajectory.positions_mm[:, 1])
    assert np.abs(y - weave.offsets_mm(fine)).max() < 1e-6


def test_sine_positions_cut_little_off_the_sine():
    weave = Weave(6.0, 4.0)
    path = weld_path(straight_seam(40.0), WeldPathOptions(weave=weave))
    fine = np.linspace(0, 40, 4001)
    y = np.interp(fine, path.seam_mm, -path.trajectory.positions_mm[:, 1])
    assert np.abs(y - weave.offsets_mm(fine)).max() < 0.02 * 6.0 / 2 * 1.05


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Weave(0.0, 4.0), "give a width above 0"),
        (lambda: Weave(4.0, 0.1), "give 0.5 to 200 mm"),
        (lambda: Weave(4.0, 4.0, "circle"), "choose one of sine, triangle"),
        (lambda: Weave(4.0, 4.0, "sine", 3.0), "dwell 1.6 mm at most"),
        (lambda: WeldPathOptions(50.0, weave=Weave(20.0, 10.0)), "mm/s; 250 is the most: weave at"),
        (lambda: WeldPathOptions(run_on_mm=-1.0), "a run-on of -1 mm"),
        (lambda: WeldPathOptions(speed_mm_s=0.0), "speed along the seam is 0"),
        (lambda: WeldPathOptions(lift_mm=0.0), "a lift of 0 mm"),
        (lambda: weld_path(straight_seam(), WeldPathOptions(stretches=((0, 200),))), "stretches lie on the seam"),
        (lambda: weld_path(straight_seam(), WeldPathOptions(stretches=((50, 60), (20, 30)))), "one behind the other"),
        (lambda: weld_path(straight_seam(5000.0), WeldPathOptions(weave=Weave(2.0, 4.0))), "4000 are the most"),
        (lambda: equal_tacks(straight_seam(), 20, 10.0), "take half of the seam at most"),
        (lambda: tacks_at(straight_seam(), [(50, 40, 0)], 10.0), "tack 1 is 40.0 mm from the seam"),
        (lambda: tacks_at(straight_seam(), [(50, 0, 0), (55, 0, 0)], 10.0), "two tacks overlap"),
        (lambda: stretches_between(straight_seam(), ((0.0, 100.0),)), "nothing is left to weld"),
        (lambda: fill_groove(GrooveSection(5, 5, 5), 0.0), "give its cross-section"),
        (lambda: fill_groove(GrooveSection(20, 20, 20), 1.0), "99 are the most"),
        (lambda: GrooveSection(5, 5, -1), "depth is -1 mm"),
        (lambda: GrooveSection(5, 5, 5, 12.0), "opens towards its edges"),
    ],
)
def test_what_cannot_be_meant_is_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()


def test_run_on_and_run_off_go_straight_on():
    trajectory = straight_seam(travel_angle_rad=0.3)
    path = weld_path(trajectory, WeldPathOptions(run_on_mm=12.0, run_off_mm=7.0))
    ends = path.trajectory.T_base_tool[[0, -1]]
    np.testing.assert_allclose(ends[:, :3, 3], [[-12, 0, 0], [107, 0, 0]], atol=1e-9)
    np.testing.assert_allclose(ends[:, :3, :3], trajectory.T_base_tool[[0, -1], :3, :3], atol=1e-9)
    assert path.lengths_mm == pytest.approx((119.0,)) and (path.welds == 1).all()


def test_tacks_are_spaced_evenly_and_what_is_between_them_is_the_rest():
    trajectory = straight_seam(120.0)
    tacks = equal_tacks(trajectory, 4, 10.0)
    np.testing.assert_allclose(tacks, [(10, 20), (40, 50), (70, 80), (100, 110)])
    np.testing.assert_allclose(tacks_at(trajectory, [(75, 1, 0), (15, 0, 2)], 10.0), [(10, 20), (70, 80)], atol=0.2)
    left = stretches_between(trajectory, tacks)
    np.testing.assert_allclose(left, [(0, 10), (20, 40), (50, 70), (80, 100), (110, 120)])
    ring_left = stretches_between(ring(), equal_tacks(ring(), 3, 10.0))
    assert sum(end - start for start, end in ring_left) == pytest.approx(ring().arc_mm[-1] - 30.0)
    path = weld_path(trajectory, WeldPathOptions(stretches=left, run_on_mm=5.0, lift_mm=25.0))
    assert path.count == 5 and path.lengths_mm[0] == pytest.approx(15.0)
    assert path.trajectory.positions_mm[path.welds == 0, 2].max() == pytest.approx(25.0)
    # over a tack the tip is in the air
    over = [(start + 0.5, end - 0.5) for start, end in tacks]
    for start, end in over:
        on_weld = path.welds > 0
        x = path.trajectory.positions_mm[on_weld, 0]
        assert not ((x > start) & (x < end)).any()


@pytest.mark.parametrize("seed", range(20))
def test_beads_fill_the_section_and_stand_in_it(seed):
    rng = np.random.default_rng(seed)
    gap = rng.choice([0.0, rng.uniform(0, 4)])
    left, right = gap / 2 + rng.uniform(0, 15, 2)
    section = GrooveSection(left, right + 0.5, rng.uniform(3, 25), gap)
    asked = rng.uniform(section.area_mm2 / 60, section.area_mm2)
    fill = fill_groove(section, asked)
    assert sum(one.area_mm2 for one in fill.passes) == pytest.approx(section.area_mm2, rel=1e-12)
    assert all(one.area_mm2 <= 1.1 * asked * (1 + 1e-9) for one in fill.passes)
    # feed times time per length is the bead: a slower torch lays the larger one
    assert all(one.area_mm2 * one.speed_factor == pytest.approx(asked) for one in fill.passes)
    assert fill.layer_tops_mm[-1] == pytest.approx(section.depth_mm)
    floors = (0.0, *fill.layer_tops_mm)
    for layer, top in enumerate(fill.layer_tops_mm, start=1):
        beads = [one for one in fill.passes if one.layer == layer]
        # the area between two heights, by its own integral
        heights = np.linspace(floors[layer - 1], top, 2001)
        widths = [sum(section.walls_mm(height)) for height in heights]
        assert np.trapezoid(widths, heights) == pytest.approx(sum(one.area_mm2 for one in beads), rel=1e-5)
        for one in beads:
            assert floors[layer - 1] - 1e-9 <= one.up_mm <= top + 1e-9
            reach = section.walls_mm(max(one.up_mm, floors[layer - 1]))
            assert -reach[0] - 1e-6 <= one.right_mm <= reach[1] + 1e-6
        assert [one.right_mm for one in beads] == sorted(one.right_mm for one in beads)
    assert [one.number for one in fill.passes] == list(range(1, len(fill.passes) + 1))


def test_layers_of_a_v_take_no_fewer_beads_further_up():
    for width, depth, bead in ((12, 7, 12), (16, 12, 9), (40, 25, 12), (30, 30, 20)):
        fill = fill_groove(GrooveSection(width / 2, width / 2, depth), bead)
        counts = np.bincount([one.layer for one in fill.passes])[1:]
        assert counts[0] == 1 and (np.diff(counts) >= 0).all()


def test_a_shifted_seam_lies_to_the_right_and_above():
    points, normals = seam(30)
    moved, outward = shifted_seam(points, normals, False, 3.0, 2.0)
    off = moved - points
    np.testing.assert_allclose((off * outward).sum(axis=1), 2.0, atol=1e-9)
    ahead = np.gradient(points, axis=0)
    right = np.cross(ahead, outward)
    assert (off * right).sum(axis=1) / np.linalg.norm(right, axis=1) == pytest.approx(3.0, abs=0.05)
    np.testing.assert_allclose(shifted_seam(points, normals, False, 0.0, 0.0)[0], points, atol=1e-12)


#: Where the seams lie ahead of arms of a longer reach, mm.
AHEAD = {"jbi": 800.0, "steps-json": 800.0}


def tenth_seam(seed, ahead_mm=420.0):
    """One of ten seams in an arm's reach, gently curved, with its way of being welded."""
    rng = np.random.default_rng(seed)
    y = np.linspace(-30.0, 30.0, 9)
    points = np.column_stack([ahead_mm + rng.uniform(-0.004, 0.004) * y**2, y, 120 + rng.uniform(-0.1, 0.1) * y])
    trajectory = tool_trajectory(
        points,
        np.tile([0.0, 0.0, 1.0], (9, 1)),
        ToolTrajectoryOptions(work_angle_rad=rng.uniform(-0.2, 0.2), travel_angle_rad=rng.uniform(-0.2, 0.2)),
    )
    ways = [
        WeldPathOptions(6.0, run_on_mm=5.0, run_off_mm=8.0),
        WeldPathOptions(6.0, weave=Weave(3.0, 6.0)),
        WeldPathOptions(6.0, weave=Weave(2.5, 5.0, "triangle", 0.5)),
        WeldPathOptions(8.0, stretches=equal_tacks(trajectory, 3, 8.0)),
        WeldPathOptions(8.0, stretches=((0.0, 20.0), (32.0, 58.0)), weave=Weave(2.0, 6.0)),
    ]
    return trajectory, weld_path(trajectory, ways[seed % 5])


#: Two of the five ways to weld for each language, each way with some of them, in every run.
EVERY_DAY = {language: (number % 5, (number + 3) % 5) for number, language in enumerate(ARMS)}


@pytest.fixture(
    scope="module",
    params=[
        *EVERY_DAY.items(),
        *(
            pytest.param((language, sorted({*range(10)} - {*EVERY_DAY[language]})), marks=pytest.mark.full)
            for language in ARMS
        ),
    ],
    ids=lambda asked: f"{asked[0]}-{asked[1][0]}",
)
def welded(request):
    """Paths of several ways to weld, followed by an arm of one maker, the torch's pose spun into its reach."""
    language, seeds = request.param
    robot = load_robot(ARMS[language], LoadRobotOptions())
    settings = PlanMotionOptions(table_top_mm=-500.0)
    planned = []
    for seed in seeds:
        _, path = tenth_seam(seed, AHEAD.get(language, 420.0))
        planned.append((path, plan_motion(robot, path.trajectory, path.plan_options(settings))))
    return language, planned


def test_every_language_puts_the_tip_on_the_path_at_its_speed(welded):
    language, planned = welded
    known = known_robots()[ARMS[language]]
    T_controller = np.array(known.T_controller_base)
    T_base_work = rigid(translation_mm=[300.0, -40.0, 90.0])
    options = RobotProgrammeOptions(T_base_work=T_base_work, placed=language in ("rapid", "krl", "ls", "jbi"))
    for path, motion in planned:
        files = programme_files(welding_programme(motion, path, options), language)
        tool, work, said = READERS[language](*files.values())
        poses = [step for step in said if step[0] == "pose"]
        assert len(poses) == len(path) + 1 and said[0][0] == "joints"
        assert distance(tool, motion.robot.tool.T_flange_tool)[0] < 1e-3
        for number, (_, T_work_tool, speed, *_) in enumerate(poses[:-1]):
            off_mm, off_deg = distance(inverse(T_controller) @ work @ T_work_tool, path.trajectory.T_base_tool[number])
            assert off_mm < 1e-3 and off_deg < 2e-3
            if number and path.welds[number] == path.welds[number - 1] > 0:
                assert speed <= path.speeds_mm_s[number] + 1e-3 and speed > 0.8 * path.speeds_mm_s[number] - 0.2
        away = poses[-1]
        back = inverse(T_controller) @ work @ away[1]
        along = back[:3, 3] - path.trajectory.positions_mm[-1]
        assert along @ path.trajectory.T_base_tool[-1, :3, 2] == pytest.approx(
            -40.0, abs=1e-2
        )  # along the torch's axis


def test_the_arc_burns_along_each_weld_and_nowhere_else(welded):
    language, planned = welded
    name = "doArc" if language == "rapid" else "5"
    gas = "doGas" if language == "rapid" else "6"
    arc = ArcOptions(name, gas=gas, start_s=0.3, crater_s=0.7, pre_flow_s=0.4, post_flow_s=0.9)
    options = RobotProgrammeOptions(arc=arc, placed=language in ("rapid", "krl", "ls", "jbi"))
    for path, motion in planned:
        said = READERS[language](*programme_files(welding_programme(motion, path, options), language).values())[2]
        burning, number, gas_open = False, -1, False
        weld = 0
        for at, step in enumerate(said):
            if step[0] == "pose":
                number += 1
                if burning:
                    assert gas_open and path.welds[number] == weld
            elif step[0] == "output" and step[1] == gas:
                gas_open = step[2]
                assert said[at + 1 if gas_open else at - 1] == ("wait", 0.4 if gas_open else 0.9)
            elif step[0] == "output" and step[1] == name:
                burning = step[2]
                weld = int(path.welds[number])
                if burning:
                    assert said[at + 1] == ("wait", 0.3) and (number == 0 or path.welds[number - 1] != weld)
                else:
                    assert said[at - 1] == ("wait", 0.7)
                    assert number == len(path) - 1 or path.welds[number + 1] != weld
        assert number == len(path) and not burning and not gas_open
        struck = [step for step in said if step[0] == "output" and step[1] == name and step[2]]
        assert len(struck) == path.count


def test_rapid_arcs_start_and_end_with_each_weld(welded):
    language, planned = welded
    if language != "rapid":
        return
    path, motion = next(one for one in planned if one[0].count == 3)
    programme = welding_programme(motion, path, RobotProgrammeOptions(arc=ArcOptions(data=("sm1", "wd1"))))
    arcs = [
        step[1].split()[0] for step in read_rapid(*programme_files(programme, "rapid").values())[2] if step[0] == "arc"
    ]
    assert arcs.count("ArcLStart") == arcs.count("ArcLEnd") == 3
    depth = 0
    for word in arcs:
        depth += {"ArcLStart": 1, "ArcL": 0, "ArcLEnd": -1}[word]
        assert 0 <= depth <= 1


def test_a_weave_that_the_joints_cannot_follow_is_refused_with_one_they_can():
    trajectory, _ = tenth_seam(0)
    robot, settings = load_robot("irb1200_5_90"), PlanMotionOptions(table_top_mm=-500.0)

    def at(hz):
        path = weld_path(trajectory, WeldPathOptions(8.0, weave=Weave(6.0, 8.0 / hz)))
        return welding_programme(plan_motion(robot, path.trajectory, path.plan_options(settings)), path)

    with pytest.raises(InputError, match=r"arm's joints hold .* weave at about") as refusal:
        at(6.0)
    remedy = float(str(refusal.value).split("weave at about ")[1].split(" Hz")[0])
    assert 0.5 < remedy < 6.0
    assert at(remedy).moves


def test_a_motion_of_another_path_is_refused(welded):
    _, planned = welded
    with pytest.raises(InputError, match="two jobs"):
        welding_programme(planned[0][1], planned[1][0])


def test_frames_of_the_controller_are_called_by_name_or_number(welded):
    language, planned = welded
    path, motion = planned[0]
    if language.startswith("steps"):
        return
    named = {"rapid": ("tGun", "wTable"), "krl": ("3", "7"), "urscript": ("torch", "")}.get(language, ("", ""))
    T_base_work = rigid(translation_mm=[300.0, -40.0, 90.0]) if language != "urscript" else np.eye(4)
    options = RobotProgrammeOptions(
        T_base_work=T_base_work, placed=language != "urscript", tool_number=4, work_number=8,
        kept_tool=named[0], kept_work=named[1],
    )  # fmt: skip
    files = programme_files(welding_programme(motion, path, options), language)
    text = "".join(files.values())
    for word in {
        "rapid": ("tGun\\WObj:=wTable;", "uframe of wTable"),
        "krl": ("BAS(#TOOL,3)", "BAS(#BASE,7)"),
        "ls": ("UTOOL_NUM=4", "UFRAME_NUM=8"),
        "jbi": ("///TOOL 4", "///USER 8"),
        "urscript": ("# TCP torch as this was made:",),
    }[language]:
        assert word in text
    for word in ("PERS ", "$TOOL=", "$BASE=", "set_tcp("):
        assert word not in text
    tool, work, said = READERS[language](*files.values())
    assert distance(tool, motion.robot.tool.T_flange_tool)[0] < 1e-3
    assert distance(work, T_base_work)[0] < 1e-3 and len([s for s in said if s[0] == "pose"]) == len(path) + 1


def test_names_that_a_controller_does_not_keep_are_refused(welded):
    language, planned = welded
    path, motion = planned[0]
    placed = language != "urscript" and not language.startswith("steps")
    programme = welding_programme(motion, path, RobotProgrammeOptions(placed=placed))
    for language_of, kept in (("rapid", "my gun"), ("krl", "17"), ("krl", "gun")):
        if language_of == language:
            with pytest.raises(InputError, match=r"takes no frame named|counts its frames"):
                programme_files(replace(programme, kept_tool=kept), language)


def test_the_common_form_says_all_that_the_programme_has(welded):
    language, planned = welded
    if language != "steps-json":
        return
    path, motion = next(one for one in planned if one[0].count == 3)
    programme = welding_programme(motion, path, RobotProgrammeOptions(arc=ArcOptions("5"), placed=False))
    content = json.loads(programme_files(programme, "steps-json")["program.json"])
    assert content["hot"] and content["robot"] == "gp12" and len(content["steps"]) == len(programme.steps)
    q = [step["q_rad"] for step in content["steps"] if step["kind"] == "linear move"]
    np.testing.assert_allclose(q[:-1], motion.path.q_rad)
    ((_, table),) = programme_files(programme, "steps-csv").items()
    rows = [line for line in table.splitlines() if not line.startswith("#")]
    assert len(rows) == len(programme.steps) + 1 and all(row.count(",") == rows[0].count(",") for row in rows)


def test_the_way_out_is_looked_at_all_along():
    """A bar over the seam's end, between the last pose and the place to which the torch is pulled back."""
    from grindvision.errors import CollisionError
    from grindvision.motion import box

    path = tenth_seam(0)[1]
    robot = load_robot("irb1200_5_90")
    free = plan_motion(robot, path.trajectory, path.plan_options(PlanMotionOptions(table_top_mm=-500.0)))
    assert len(free.clearance.distance_mm) == len(path) + 2
    tip = path.trajectory.T_base_tool[-1]
    shaft = tip @ rigid(translation_mm=[13.5, 0.0, -45.0])  # beside the nozzle on the seam, and where the holder passes
    bar = box("bar", [4.0, 4.0, 4.0], shaft)
    blocked = PlanMotionOptions(table_top_mm=-500.0, obstacles=(bar,), backed_off_mm=120.0)
    with pytest.raises(CollisionError, match="bar"):
        plan_motion(robot, path.trajectory, path.plan_options(replace(blocked, min_clearance_mm=4.0)))


def test_a_plain_programme_and_a_welding_one_say_the_same_along_a_plain_seam():
    trajectory, _ = tenth_seam(0)
    robot = load_robot("irb1200_5_90")
    path = weld_path(trajectory, WeldPathOptions(8.0))
    motion = plan_motion(robot, path.trajectory, path.plan_options(PlanMotionOptions(table_top_mm=-500.0)))
    one, other = robot_programme(motion), welding_programme(motion, path)
    assert [str(step.T_work_tool) for step in one.moves] == [str(step.T_work_tool) for step in other.moves]
    assert [step.zone_mm for step in one.moves] == [step.zone_mm for step in other.moves]
