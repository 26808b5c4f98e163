"""Grinding passes over a height map: what is cut, what must stay, Preston's law, and what cannot be planned."""

import time
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from grindvision.errors import InputError
from grindvision.geometry import move_points
from grindvision.geometry.height_map import HeightMap
from grindvision.motion.grinding import plan_grinding, preston_depth, simulate_passes
from grindvision.motion.grinding_beside import check_beside
from grindvision.motion.grinding_contact import envelope_of, lifts_over, nodes_of, tool_shape
from grindvision.motion.grinding_lines import _signed_distance
from grindvision.motion.grinding_options import PATTERNS, GrindingOptions
from grindvision.motion.grinding_path import CUT, driven, tool_path
from grindvision.motion.removal import learn_removal
from tests.flat_stock import flat_work


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize(("tool", "radius_mm"), [("wheel", 20.0), ("disc", 25.0)])
def test_passes_take_the_stock_down_to_what_is_left_and_never_below(pattern, tool, radius_mm):
    work = flat_work()
    plan = plan_grinding(
        work,
        GrindingOptions(tool=tool, radius_mm=radius_mm, width_mm=3.0, pattern=pattern, depth_mm=0.3, leave_mm=0.04),
    )
    assert len(plan.passes) == 5
    # a loop round a narrow bead leaves its corners to the tilted disc
    assert plan.remaining_mm[work.inside].max() < (0.35 if (tool, pattern) == ("disc", "contour") else 0.12)
    assert np.quantile(plan.remaining_mm[work.inside], 0.95) < 0.1
    cut = plan.remaining_mm < work.heights.heights_mm - 1e-9
    assert plan.remaining_mm[cut].min() > 0.04 - 1e-9
    assert not cut[~work.inside].any()
    floors = [one.floor_mm for one in plan.passes]
    assert np.allclose(floors, [1.2, 0.9, 0.6, 0.3, 0.04])
    removed = (work.heights.heights_mm - plan.remaining_mm) * work.heights.areas_mm2
    assert sum(one.removed_mm3 for one in plan.passes) == pytest.approx(removed.sum())
    assert plan.unreached.mean() < 0.01


@pytest.mark.parametrize("bend_per_mm", [-0.01, 0.02, 0.04])
def test_on_a_curved_surface_a_wide_wheel_leaves_more_but_cuts_nothing_away(bend_per_mm):
    narrow, wide = (
        plan_grinding(flat_work(bend_per_mm=bend_per_mm), GrindingOptions(width_mm=width, depth_mm=0.3, leave_mm=0.02))
        for width in (2.0, 8.0)
    )
    inside = narrow.work.inside
    for plan in (narrow, wide):
        assert np.min((plan.remaining_mm - np.minimum(plan.work.heights.heights_mm, 0.02))[inside]) > -1e-6
    assert wide.remaining_mm[inside].max() > narrow.remaining_mm[inside].max() - 0.02
    if bend_per_mm > 0:  # in a hollow the wheel rests on its edges: the sagitta of its width stays
        assert wide.remaining_mm[inside].max() == pytest.approx(0.02 + bend_per_mm * 8.0**2 / 8, abs=0.06)


def test_the_kernels_agree_with_the_tool_s_geometry(rng):
    """A wheel's lowest lift over floors is that at which it touches one of them and cuts none; a plain loop says so."""
    work = flat_work(bend_per_mm=0.02)
    options = GrindingOptions(radius_mm=8.0, width_mm=4.0)
    shape, nodes = tool_shape(options, 3.0), nodes_of(work.heights)
    pose = np.array([[30.2, 14.6, 0.0, *np.eye(3).ravel()]])
    floors = np.full(work.heights.shape, 0.1) + rng.uniform(0, 0.05, work.heights.shape)
    (lift,) = lifts_over(nodes, floors, pose, shape)
    points = (work.heights.feet_mm + floors[..., None] * work.heights.normals).reshape(-1, 3) - pose[0, :3]
    under = (np.abs(points[:, 0]) <= shape.along_mm) & (np.abs(points[:, 1]) <= 2.0)
    plain = (points[under, 2] - (8.0 - np.sqrt(64.0 - points[under, 0] ** 2))).max()
    assert lift == pytest.approx(plain, abs=1e-12)
    gaps = envelope_of(nodes, pose, np.array([lift]), shape) - floors
    assert abs(gaps.min()) < 0.02  # a normal's line is met a little beside the node


def test_turning_the_world_turns_the_path_with_it():
    plan = plan_grinding(flat_work(), GrindingOptions(depth_mm=0.5, width_mm=3.0))
    T_scan_map = np.array([[0.0, -1, 0, 5], [1, 0, 0, -7], [0, 0, 1, 300], [0, 0, 0, 1]])
    turned = plan_grinding(replace(plan.work, heights=replace(plan.work.heights, T_scan_map=T_scan_map)), plan.options)
    here, there = tool_path(plan).moved(T_scan_map), tool_path(turned)
    assert np.allclose(here.points, there.points) and np.allclose(here.normals, there.normals)


def test_a_way_leads_in_cuts_leads_out_and_retracts():
    options = GrindingOptions(depth_mm=0.5, width_mm=3.0, lead_mm=4.0, lead_height_mm=1.0, retract_mm=15.0)
    path = tool_path(plan_grinding(flat_work(), options))
    for number in np.unique(path.passes):
        for line in np.unique(path.lines[path.passes == number]):
            kinds = path.kinds[(path.passes == number) & (path.lines == line)]
            assert kinds[0] == kinds[-1] == 0 and kinds[1] == 1 and kinds[-2] == 3 and (kinds[2:-2] == CUT).all()
    up = path.points[:, 2]
    assert (
        up[path.kinds == 0].min() > 15
        and up[path.kinds == CUT].min() > 0
        and (path.forces_n[path.kinds != CUT] == 0).all()
    )
    poses = path.trajectory(0.1).T_base_tool
    assert np.allclose(np.einsum("ij,ij->i", poses[:, :3, 2], -path.normals), np.cos(0.1))
    assert (np.einsum("ij,ij->i", poses[1:, :3, 0], poses[:-1, :3, 0]) > 0.5).all()  # never turned round
    fine = driven(path.thinned(4.0))
    assert np.linalg.norm(np.diff(fine.points, axis=0), axis=1).max() <= 10.0 + 1e-9


@pytest.mark.parametrize("tool", ["wheel", "disc"])
def test_between_its_points_a_path_over_a_rounded_surface_cuts_no_deeper_than_at_them(tool):
    """Along the rounding, with a step of half a metre and with few places: the chords stay on the planned way."""
    work = flat_work(bend_per_mm=-0.05)
    middle = work.heights.shape[0] // 2
    inside = np.zeros_like(work.inside)
    inside[middle - 2 : middle + 3] = work.inside[middle - 2 : middle + 3].any()
    stock = replace(work.heights, heights_mm=np.where(inside, 1.0, 0.0))
    course = np.column_stack([np.full(40, 30.0), np.linspace(5, 25, 40)])
    options = GrindingOptions(tool=tool, width_mm=3.0, depth_mm=0.5, leave_mm=0.02, step_mm=500.0)
    way = tool_path(plan_grinding(replace(work, heights=stock, inside=inside, centreline_mm=course), options))
    for path in (way, way.thinned(5.0)):
        cut = np.flatnonzero((path.kinds[1:] == CUT) & (path.kinds[:-1] == CUT))
        middles = (path.points[cut] + path.points[cut + 1]) / 2
        radius = np.hypot(middles[:, 1] - 15.0, middles[:, 2] + 20.0)
        at_points = np.hypot(path.points[path.kinds == CUT][:, 1] - 15.0, path.points[path.kinds == CUT][:, 2] + 20.0)
        assert len(cut) > 4
        assert radius.min() > at_points.min() - 0.03


def test_preston_s_feed_and_force_cut_the_planned_depth():
    options = GrindingOptions(depth_mm=0.2, width_mm=3.0, force_n=20.0, feed_max_mm_s=30.0)
    plan = plan_grinding(flat_work(), options)
    for one in plan.passes:
        length = sum(stroke.length_mm for stroke in one.strokes)
        width = min(max(one.removed_mm3 / (length * 0.2), 0.1), 3.0)
        assert preston_depth(options, one.force_n, one.feed_mm_s, width) == pytest.approx(0.2)
        assert one.feed_mm_s <= 30.0 and one.force_n <= 20.0 + 1e-9


def fine_bead(heights, times):
    """The bead of ``flat_work``, and the nodes around it, on a grid so many times as fine as a map."""
    fine = heights.refined(times)
    x, y = np.meshgrid(fine.x_mm, fine.y_mm, indexing="ij")
    bead = 1.5 * np.clip(1 - ((y - heights.y_mm[-1] / 2) / 2.5) ** 2, 0, None) * ((x > 15) & (x < 45))
    return replace(fine, heights_mm=bead)


def as_scanned(fine, times):
    """Heights of a surface as a scan has them at the nodes of a map: means around them."""
    return gaussian_filter(fine, times / np.sqrt(6))[::times, ::times]


def scanned_work(times=8):
    """``flat_work`` as a scan shows it."""
    work = flat_work()
    heights = as_scanned(fine_bead(work.heights, times).heights_mm, times)
    return replace(work, heights=replace(work.heights, heights_mm=heights), inside=heights > 0.02)


def scanned_after(plan, factor, offset_mm=0.0, times=8):
    """Heights after the passes as a scan of a part shows them: neither wheel nor bead is a set of nodes."""
    fine = fine_bead(plan.work.heights, times)
    inside = fine.heights_mm >= 0
    exact = replace(plan, work=replace(plan.work, heights=fine, inside=inside, keep=~inside))
    *_, left = simulate_passes(exact, fine.heights_mm - offset_mm, factor)
    return as_scanned(left + offset_mm, times)


@pytest.mark.parametrize("factor", [0.6, pytest.param(0.85, marks=pytest.mark.full)])
def test_k_is_learnt_from_two_maps_within_its_sigma(rng, factor):
    plan = plan_grinding(scanned_work(), GrindingOptions(depth_mm=0.3, width_mm=3.0, passes_max=3))
    truth = scanned_after(plan, factor)
    off, sigma = [], []
    for _ in range(6):
        after = truth + rng.normal(scale=0.03, size=truth.shape)
        learnt = learn_removal(plan, after, np.full(truth.shape, 0.03))
        off.append(learnt.factor / factor - 1)
        sigma.append(learnt.k_sigma_mm2_n / learnt.k_mm2_n)
    assert np.abs(off).max() < 0.05 and not learnt.at_least
    assert np.sqrt(np.mean((np.array(off) / sigma) ** 2)) < 2.5


def test_k_is_only_bounded_where_the_passes_cut_down_to_their_floors():
    work = flat_work()
    plan = plan_grinding(work, GrindingOptions(depth_mm=0.3, width_mm=3.0))
    *_, after = simulate_passes(plan, work.heights.heights_mm, 2.5)
    learnt = learn_removal(plan, after, np.full(after.shape, 0.03))
    assert learnt.at_least and learnt.factor <= 1.0 and "or more" in str(learnt)


def test_what_the_simulated_passes_miss_of_the_scan_is_no_slow_process():
    """Heights that no factor explains, as on a map that is coarse against the wheel, must not pass for a sure one."""
    work = flat_work()
    plan = plan_grinding(work, GrindingOptions(depth_mm=0.3, width_mm=3.0))
    *_, floors = simulate_passes(plan, work.heights.heights_mm, 2.5)
    x, y = np.indices(floors.shape)
    after = floors + 0.06 + 0.12 * np.sin(0.3 * x) * np.cos(0.9 * y)
    learnt = learn_removal(plan, after, np.full(floors.shape, 0.03))
    assert learnt.at_least and not np.isfinite(learnt.k_sigma_mm2_n)


def test_nothing_taken_off_teaches_nothing():
    plan = plan_grinding(flat_work(), GrindingOptions(depth_mm=0.3, width_mm=3.0))
    with pytest.raises(InputError, match="scan after the passes"):
        learn_removal(plan, plan.work.heights.heights_mm, np.full(plan.work.inside.shape, 0.03))


def test_what_must_stay_is_kept_clear_of():
    def bar(x, y):
        return (np.abs(y - 18.0) < 0.6) & (x > 25) & (x < 35)

    options = GrindingOptions(depth_mm=0.5, width_mm=2.0, keep_out_mm=1.0, leave_mm=0.02)
    free, kept = (plan_grinding(flat_work(keep=keep), options) for keep in (None, bar))
    near = kept.work.keep
    assert (kept.remaining_mm == kept.work.heights.heights_mm)[near].all()
    assert kept.remaining_mm[kept.work.inside].sum() > free.remaining_mm[free.work.inside].sum()
    assert kept.unreached.sum() > free.unreached.sum() == 0


@pytest.mark.parametrize(
    ("work", "options", "said"),
    [
        ({}, {"depth_mm": 0.01}, "below the level of detection of 0.05 mm"),
        ({"keep": lambda x, y: np.ones_like(x, dtype=bool)}, {}, "closes the stock on all sides"),
        ({"bend_per_mm": 0.3}, {"width_mm": 20.0}, "wider than the place"),
        ({"height": lambda x, y: np.full_like(x, 0.03)}, {"leave_mm": 0.1}, "nothing stands above"),
        ({}, {"force_n": 1e-4}, "slower than the least feed"),
        ({"height": lambda x, y: np.full_like(x, 900.0)}, {}, "passes; cut deeper"),
        ({"sigma": np.nan}, {}, "NaN|nan"),
    ],
)
def test_what_cannot_be_ground_is_named_in_one_line(work, options, said):
    with pytest.raises(InputError, match=said) as refusal:
        plan_grinding(flat_work(**work), GrindingOptions(**options))
    assert "\n" not in str(refusal.value)


def wall(work, away_mm, high_mm, rng):
    """Points of a scan of flat ground around a map and of a wall along its x axis, beside the middle of the map."""
    across = work.heights.y_mm[-1] / 2
    ground = np.column_stack([rng.uniform(-100, 160, (20_000, 2)), 0.03 * rng.normal(size=20_000)])
    x, z = rng.uniform(-40, 100, 4000), rng.uniform(0, high_mm, 4000)
    side = np.column_stack([x, np.full(4000, across + away_mm), z])
    return move_points(work.heights.T_scan_map, np.vstack([ground, side]))


@pytest.mark.parametrize(
    ("options", "reach_mm"), [({"width_mm": 6.0}, 3.0), ({"width_mm": 80.0}, 40.0), ({"tool": "disc"}, 20.0)]
)
def test_a_tool_that_would_run_into_a_wall_beyond_the_map_is_refused(options, reach_mm):
    work, rng = flat_work(), np.random.default_rng(0)
    plan = plan_grinding(work, GrindingOptions(depth_mm=0.3, leave_mm=0.05, **options))
    tips = np.vstack([stroke.poses for stroke in plan.passes[-1].strokes])
    reach_mm += np.abs(tips[:, 1] - work.heights.y_mm[-1] / 2).max()
    check_beside(plan, wall(work, reach_mm + 3.0, 15.0, rng))
    with pytest.raises(InputError, match="wider than the place: on its way") as refusal:
        check_beside(plan, wall(work, reach_mm - 1.0, 15.0, rng))
    assert "\n" not in str(refusal.value)


def test_heights_that_are_no_numbers_are_refused():
    work = flat_work()
    heights = work.heights.heights_mm.copy()
    heights[60, 30] = np.nan
    with pytest.raises(InputError, match="1 heights of the stock are NaN"):
        plan_grinding(replace(work, heights=replace(work.heights, heights_mm=heights)))


@pytest.mark.parametrize(
    "setting",
    [
        {"tool": "file"},
        {"pattern": "spiral"},
        {"radius_mm": 0.0},
        {"depth_mm": float("nan")},
        {"overlap": 1.0},
        {"feed_min_mm_s": 60.0},
        {"passes_max": 0},
        {"leave_mm": -0.1},
        {"depth_mm": 30.0},
    ],
)
def test_settings_that_cannot_be_are_refused(setting):
    with pytest.raises(InputError):
        GrindingOptions(**setting)


def test_nothing_is_planned_below_what_is_known_of_the_wheel():
    work = flat_work()
    blind = plan_grinding(replace(work, offset_sigma_mm=0.1), GrindingOptions(depth_mm=0.3, width_mm=3.0))
    assert blind.leave_mm >= 0.3 and blind.remaining_mm[blind.work.inside].max() >= 0.3
    known = plan_grinding(replace(work, offset_mm=0.07, offset_sigma_mm=0.005), blind.options)
    straight = plan_grinding(replace(work, offset_sigma_mm=0.005), blind.options)
    lower = (tool_path(straight).points - tool_path(known).points)[:, 2]
    assert np.allclose(lower, 0.07)  # sent lower by what it runs too high
    with pytest.raises(InputError, match=r"offset is known to 1 mm only"):
        plan_grinding(replace(work, offset_sigma_mm=1.0), blind.options)


@pytest.mark.parametrize("factor", [0.7, 1.5])
@pytest.mark.parametrize("true_mm", [-0.12, 0.06])
def test_the_wheel_s_offset_is_learnt_from_its_own_cut(rng, factor, true_mm):
    work = replace(scanned_work(), offset_sigma_mm=0.1)
    plan = plan_grinding(work, GrindingOptions(depth_mm=0.3, width_mm=3.0))
    high = scanned_after(plan, factor, true_mm)
    after = high + rng.normal(scale=0.03, size=high.shape)
    learnt = learn_removal(plan, after, np.full(high.shape, 0.03))
    assert abs(learnt.offset_mm - true_mm) < 3 * learnt.offset_sigma_mm + 0.01 and learnt.offset_sigma_mm < 0.1
    assert learnt.at_least == (factor > 1) and "the wheel ran" in str(learnt)
    if factor < 1:
        assert learnt.factor == pytest.approx(factor, rel=0.05)


@pytest.mark.parametrize(
    ("high_mm", "factor"),
    [
        (0.15, 0.6),
        pytest.param(0.05, 0.6, marks=pytest.mark.full),
        pytest.param(0.05, 1.5, marks=pytest.mark.full),
        pytest.param(0.15, 1.5, marks=pytest.mark.full),
    ],
)
def test_a_wheel_that_runs_higher_than_it_was_touched_off_is_no_slow_process(rng, factor, high_mm):
    """Worn, or bent aside by its force: heights above the floors alone do not tell it from a process that lags."""
    plan = plan_grinding(scanned_work(), GrindingOptions(depth_mm=0.3, width_mm=3.0))
    high = scanned_after(plan, factor, high_mm)
    for _ in range(3):
        after = high + rng.normal(scale=0.03, size=high.shape)
        learnt = learn_removal(plan, after, np.full(high.shape, 0.03))
        assert abs(learnt.offset_mm - high_mm) < 3 * learnt.offset_sigma_mm + 0.01
        assert learnt.at_least == (factor > 1) and learnt.refuted == (high_mm > 0.1)
        if learnt.at_least:
            assert learnt.factor <= factor
        else:
            sigma = learnt.k_sigma_mm2_n / plan.options.k_mm2_n
            assert abs(learnt.factor - factor) < 3 * sigma and sigma < 0.1 * factor


def test_a_patch_of_100_mm_is_covered_within_two_seconds():
    work = flat_work(lambda x, y: np.full_like(x, 0.2), size=(100.0, 100.0))
    options = GrindingOptions(pattern="raster", width_mm=6.0, depth_mm=0.2, leave_mm=0.02)
    plan_grinding(flat_work(), options)  # compiles
    started = time.process_time()
    plan = plan_grinding(work, options)
    assert time.process_time() - started < 2.0
    assert plan.remaining_mm[work.inside].max() < 0.03 and not plan.unreached.any()


def bare_map(rows: int, columns: int, spacing_mm: float) -> HeightMap:
    """A flat map without stock."""
    flat = np.zeros((rows, columns))
    return HeightMap(np.eye(4), spacing_mm, flat, np.tile([0.0, 0.0, 1.0], (rows, columns, 1)), flat)


@pytest.mark.parametrize("points", [2, 3, 4, 5, 9])
@pytest.mark.parametrize("angle_deg", [0.0, 35.0, 200.0])
def test_the_distance_from_a_straight_centreline_is_that_from_its_whole_line(points, angle_deg):
    """Also beyond its ends, and however few points it has; to the left it is above zero."""
    heights = bare_map(40, 30, 0.5)
    along = np.array([np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))])
    middle = np.array([10.0, 7.0])
    found = _signed_distance(heights, middle + np.linspace(-2, 2, points)[:, None] * along)
    x, y = np.meshgrid(heights.x_mm, heights.y_mm, indexing="ij")
    wanted = along[0] * (y - middle[1]) - along[1] * (x - middle[0])
    np.testing.assert_allclose(found, wanted, atol=0.07)  # the line stands as points 0.125 mm apart


@pytest.mark.parametrize("backwards", [False, True])
def test_a_centreline_goes_straight_on_along_its_last_four_points(backwards):
    """Not along its last two, which a noisy place turns."""
    centreline = np.array([[8.0, 7], [9, 7.4], [10, 7.4], [11, 7], [12, 7.3], [13, 7], [14, 7.4], [15, 7.4], [16, 7]])
    heights = bare_map(49, 30, 0.5)
    found = _signed_distance(heights, centreline[::-1] if backwards else centreline)
    x, y = np.meshgrid(heights.x_mm, heights.y_mm, indexing="ij")
    beyond = (x < 7) | (x > 17)
    wanted = (y - 7.0) * (-1 if backwards else 1)
    np.testing.assert_allclose(found[beyond & (abs(y - 7) < 4)], wanted[beyond & (abs(y - 7) < 4)], atol=0.07)
