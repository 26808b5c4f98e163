"""What a wheel touches that it should not, and what its passes leave between the nodes of a map."""

from dataclasses import replace

import numpy as np
import pytest

from grindvision.errors import InputError
from grindvision.motion.grinding import plan_grinding, simulate_passes
from grindvision.motion.grinding_beside import check_beside, with_free_leads
from grindvision.motion.grinding_contact import WHEEL, reach_into, tool_shape
from grindvision.motion.grinding_options import GrindingOptions
from grindvision.motion.grinding_path import CUT, LEAD_IN, LEAD_OUT, tool_path
from grindvision.motion.removal import learn_removal
from grindvision.vision.change.remaining import judge_remaining
from grindvision.vision.change.stock import StockPiece
from tests.flat_stock import flat_work


def ground(rng, count=30_000):
    return np.column_stack([rng.uniform(-60, 120, (count, 2)), 0.02 * rng.normal(size=count)])


def block(rng, x_from, high_mm, count=6000):
    """A block across the way, whose near face stands at ``x_from``."""
    face = np.column_stack([np.full(count, x_from), rng.uniform(-10, 40, count), rng.uniform(0, high_mm, count)])
    top = np.column_stack([x_from + rng.uniform(0, 20, count), rng.uniform(-10, 40, count), np.full(count, high_mm)])
    return np.vstack([face, top])


def touched_mm(plan, path, kind, points):
    """How deep the wheel comes over points on its straight ways in (``LEAD_IN``) or out."""
    shape, deepest = tool_shape(plan.options, plan.options.radius_mm), -np.inf
    for at in np.flatnonzero(path.kinds == kind):
        other = at + 1 if kind == LEAD_IN else at - 1
        on = np.linspace(0, 1, 20)[:, None]
        places = path.points[at] * (1 - on) + path.points[other] * on
        axes = np.hstack([path.ahead[other], np.cross(path.normals[other], path.ahead[other]), path.normals[other]])
        poses = np.hstack([places, np.repeat(axes[None], 20, axis=0)])
        deepest = max(deepest, reach_into(points, np.ascontiguousarray(poses), np.zeros(20), shape).max())
    return deepest


def test_leads_stop_before_what_stands_where_a_line_ends(rng):
    """A block 6 mm high stands where the wheel just clears it at the end of its lines, but not 5 mm farther on."""
    options = GrindingOptions(depth_mm=0.5, width_mm=3.0, leave_mm=0.05)
    plan = plan_grinding(flat_work(), options)
    end = max(stroke.poses[:, 0].max() for one in plan.passes for stroke in one.strokes)
    clear = np.sqrt(20.0**2 - (20.0 - 6.0) ** 2)
    points = np.vstack([ground(rng), block(rng, end + clear + 0.5, 6.0)])
    check_beside(plan, points)
    assert touched_mm(plan, tool_path(plan), LEAD_OUT, points) + touched_mm(plan, tool_path(plan), LEAD_IN, points) > 1
    freed = with_free_leads(plan, points)
    path = tool_path(freed)
    assert max(touched_mm(freed, path, kind, points) for kind in (LEAD_IN, LEAD_OUT)) < 0.15
    free = with_free_leads(plan, ground(rng))
    assert np.allclose(tool_path(free).points, tool_path(plan).points)  # nothing stands there: as asked for


def test_the_foot_of_a_wall_is_no_wall_under_the_wheel(rng):
    """Cells of points at the foot of a wall mix it with the ground: their mean stands over ground that is free."""
    work = flat_work()
    plan = plan_grinding(work, GrindingOptions(depth_mm=0.3, leave_mm=0.05, width_mm=3.0))
    side = max(np.abs(s.poses[:, 1] - 15.0).max() for s in plan.passes[-1].strokes) + 1.5
    for away in (0.1, 0.3, 0.8, 1.5):
        wall = np.column_stack([rng.uniform(-20, 80, 2000), np.full(2000, 15 + side + away), rng.uniform(0, 15, 2000)])
        floor = ground(rng, 200_000)
        check_beside(plan, np.vstack([floor[floor[:, 1] < wall[0, 1]], wall]))


@pytest.mark.parametrize("width_mm", [3.7, 4.0, 4.4])
def test_the_sides_of_a_wheel_do_not_cut_into_a_hollow(width_mm):
    """In a groove of 5 mm radius the wheel's two sides touch first, and they stand between nodes."""
    x, y = np.meshgrid(np.arange(81) * 0.9, np.arange(21) * 0.9, indexing="ij")
    across = y - 9.0
    hollow = np.sqrt(across**2 + 25.0) - 5.0
    normals = np.stack([0 * x, -across / np.sqrt(across**2 + 25.0), np.ones_like(x)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    heights = 1.2 * np.clip(1 - (across / 2.5) ** 2, 0, None) * ((x > 15) & (x < 45))
    work = flat_work()
    grid = replace(work.heights, spacing_mm=0.9, ground_mm=hollow, normals=normals, heights_mm=heights)
    course = np.column_stack([np.linspace(15, 45, 40), np.full(40, 9.0)])
    none = np.zeros(heights.shape, dtype=bool)
    work = replace(work, heights=grid, inside=heights > 0.02, keep=none, centreline_mm=course)
    options = GrindingOptions(radius_mm=10.0, width_mm=width_mm, depth_mm=0.2, leave_mm=0.02)
    path = tool_path(plan_grinding(work, options))
    shape = tool_shape(options, 10.0)
    assert shape.kind == WHEEL
    v = np.arange(-6, 6, 0.05)
    fine = np.array([(u, 9.0 + w, np.sqrt(w**2 + 25.0) - 5.0) for u in np.arange(28, 32, 0.2) for w in v])
    cut = path.kinds == CUT
    normals, ahead = path.normals[cut], path.ahead[cut]
    poses = np.ascontiguousarray(np.hstack([path.points[cut], ahead, np.cross(normals, ahead), normals]))
    assert reach_into(fine, poses, np.zeros(len(poses)), shape).max() < 0.03


@pytest.mark.parametrize("radius_mm", [1.5, 2.5])
def test_a_ring_round_a_speck_has_a_direction_everywhere(radius_mm):
    """Two steps out and back: the mean direction at the turn is none."""
    work = flat_work(height=lambda x, y: 1.2 * np.clip(1 - np.hypot(x - 30.1, y - 15.05) ** 2 / radius_mm**2, 0, None))
    path = tool_path(plan_grinding(work, GrindingOptions(pattern="contour", leave_mm=0.02)))
    assert np.allclose(np.linalg.norm(path.ahead, axis=1), 1.0)
    assert np.isfinite(path.trajectory().T_base_tool).all()


def piece(work, heights, sigma_mm):
    """Heights over a map as a piece that was measured again."""
    from grindvision.vision.change.local_datum import fit_datum

    heights = replace(work.heights, heights_mm=heights)
    shape = heights.shape
    datum = fit_datum(np.zeros(shape), ~work.inside, np.eye(3) * 1e-6, sigma_mm, 3)
    none = np.zeros(shape, dtype=bool)
    return StockPiece(
        heights, np.full(shape, sigma_mm), work.inside, none, ~work.inside, datum, 0.05, *[0.0] * 10,
    )  # fmt: skip


def test_a_ridge_of_one_node_that_stands_above_the_tolerance_is_seen(rng):
    work = flat_work()
    noise = rng.normal(scale=0.02, size=work.heights.shape)
    ridge = np.zeros_like(noise)
    ridge[40:80, 31] = 0.3
    verdict = judge_remaining(piece(work, noise + ridge, 0.02), 0.15)
    assert not verdict.met and verdict.over_mm2 > 0.5 * 40 * 0.25 and verdict.height_max_mm > 0.25
    assert judge_remaining(piece(work, noise + 0.05, 0.02), 0.15).met  # noise is no ridge


@pytest.mark.parametrize("factor", [0.95, pytest.param(0.97, marks=pytest.mark.full)])
def test_a_coefficient_that_is_only_bounded_is_not_below_its_bound(rng, factor):
    work = flat_work(height=lambda x, y: 0.4 * np.clip(1 - ((y - 15) / 3) ** 2, 0, None) * ((x > 15) & (x < 45)))
    plan = plan_grinding(work, GrindingOptions(depth_mm=0.1, width_mm=6.0))
    *_, after = simulate_passes(plan, work.heights.heights_mm, factor)
    bounds = []
    for _ in range(8):
        told = learn_removal(plan, after + rng.normal(scale=0.03, size=after.shape), np.full(after.shape, 0.03))
        bounds += [told.factor] if told.at_least else []
    assert len(bounds) > 3 and np.mean(np.array(bounds) <= factor) > 0.8


@pytest.mark.parametrize(("bend_per_mm", "told"), [(1 / 4.5, False), (1 / 20, True), (-1 / 20, True)])
def test_a_hollow_tighter_than_the_map_s_nodes_tell_teaches_no_coefficient(rng, bend_per_mm, told):
    """Between two nodes the ground rises under the wheel's sides by more than they cut: k came out 40 % off."""
    work = flat_work(bend_per_mm=bend_per_mm)
    plan = plan_grinding(work, GrindingOptions(depth_mm=0.1, width_mm=4.0))
    *_, after = simulate_passes(plan, work.heights.heights_mm, 0.6)
    after, sigma = after + rng.normal(scale=0.02, size=after.shape), np.full(after.shape, 0.02)
    if told:
        assert learn_removal(plan, after, sigma).factor == pytest.approx(0.6, rel=0.1)
        return
    with pytest.raises(InputError, match=r"not determined: in a hollow of 4\.\d mm radius nodes 0\.5 mm apart"):
        learn_removal(plan, after, sigma)
