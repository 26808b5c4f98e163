"""The detector of seams: each kind of joint is found where it is and named; no seam where there is none."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from grindvision.errors import InputError, NoGrooveError
from grindvision.vision.seam.joint_names import FAMILIES, KINDS, kinds_of
from grindvision.vision.seam.seam_path import root_path
from grindvision.vision.seam.seams import FindSeamsOptions, find_seams
from tests.groove_scenes import straight_groove
from tests.seam_scenes import (
    box_corner,
    butt,
    corner,
    noisy,
    outside,
    plate,
    step,
    tube_all_round,
    tube_on_plate,
    turned,
)

#: From where the scenes are seen: over the base, in front of the wall.
EYE = np.array([20.0, -220.0, 320.0])
FROM_EYE = FindSeamsOptions(EYE)


def off_x_axis(line):
    return np.hypot(line[:, 1], line[:, 2])


@pytest.mark.parametrize("angle_deg", [60, 90, 120, 140])
@pytest.mark.parametrize("noise_mm", [0.0, 0.3])
def test_a_corner_is_found_to_its_sigma_and_its_angle(angle_deg, noise_mm):
    rng = np.random.default_rng([angle_deg, int(10 * noise_mm)])
    found = find_seams(corner(rng, angle_deg, noise_mm), FROM_EYE)
    (seam,) = found.seams
    assert seam.kind in FAMILIES["fillet"] and "two planes meet in a concave corner" in seam.evidence
    assert off_x_axis(seam.root).mean() < 0.02 + 0.5 * noise_mm
    assert off_x_axis(seam.root).max() < 5 * max(np.median(seam.sigma_mm), 0.02) + 0.02
    assert abs(np.median(seam.opening_deg) - angle_deg) < 0.3 + 4 * seam.opening_sigma_deg
    assert seam.length_mm == pytest.approx(89, abs=3)
    assert (found.labels == (found.seam_id == 0)).all() and found.labels.sum() == len(seam.members)


def test_what_is_seen_behind_a_corner_names_it():
    rng = np.random.default_rng(0)
    front = corner(rng, leg=15.0, noise_mm=0.05)
    behind = front[(front[:, 2] < 1) & (front[:, 1] < -2)] * [1, -1, 1] + [0, 30, 0]
    (tee,) = find_seams(np.concatenate([front, behind]), FindSeamsOptions([0, -60, 400])).seams
    assert tee.kind == "t-joint" and "goes on behind" in tee.evidence


@pytest.mark.parametrize("height_mm", [3.0, 6.0, 10.0])
def test_a_step_is_a_lap_joint(height_mm):
    rng = np.random.default_rng(int(height_mm))
    (seam,) = find_seams(step(rng, height_mm), FROM_EYE).seams
    assert seam.kind == "lap-joint"
    assert np.median(seam.step_mm) == pytest.approx(height_mm, abs=0.1)
    assert np.abs(seam.root[:, 1] + 0.5).max() < 0.6 and np.abs(seam.root[:, 2]).max() < 0.2


@pytest.mark.parametrize("hi_lo_mm", [0.0, 0.6])
def test_a_narrow_gap_is_a_butt_joint(hi_lo_mm):
    rng = np.random.default_rng(5)
    (seam,) = find_seams(butt(rng, 3.0, hi_lo_mm=hi_lo_mm), FindSeamsOptions([0, 0, 400])).seams
    assert seam.kind == "butt-gap"
    assert np.median(seam.gap_mm) == pytest.approx(3.0, abs=0.8)
    assert np.median(seam.step_mm) == pytest.approx(hi_lo_mm, abs=0.1)
    # Plates end up to a spacing before their edge: the middle is known to half of that.
    assert np.abs(seam.root[:, 1]).mean() < 0.6


def test_a_few_mixed_pixels_in_a_gap_make_no_groove_of_it(rng):
    """One of three points half-way down is no wall; most of many are."""
    points = butt(rng, 2.0, spacing=0.45)
    points = points[points[:, 2] > -20]
    stray = np.column_stack([[-20.0, 5.0, 30.0], [0.0, 0.2, -0.1], [-1.5, -3.0, -3.2]])
    (seam,) = find_seams(np.concatenate([points, stray]), FindSeamsOptions([0, 0, 400])).seams
    assert seam.kind == "butt-gap" and np.median(seam.gap_mm) == pytest.approx(2.0, abs=0.4)


def test_the_stated_sigma_of_a_gap_holds_errors_that_pixels_share():
    """Two plates whose heights err alike over some pixels, in rows along the gap that end anywhere before its edges."""
    inside, within = [], []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        first, last = rng.uniform(0.0, 0.5, 2)
        sides = [
            plate((-60.0, 60.0), (-30.0 - last, -1.0), spacing=0.5),
            plate((-60.0, 60.0), (1.0 + first, 30.0), spacing=0.5),
        ]
        points = np.concatenate(sides)
        cells = np.round((points[:, :2] - points[:, :2].min(axis=0)) / 0.5).astype(int)
        errors = gaussian_filter(rng.standard_normal(cells.max(axis=0) + 1), 2.5) * np.sqrt(4 * np.pi) * 2.5
        points[:, 2] += 0.2 * errors[cells[:, 0], cells[:, 1]]
        (seam,) = find_seams(points, FindSeamsOptions([0, 0, 400], "butt")).seams
        off = np.linalg.norm(seam.root[:, 1:], axis=1)
        inside.append((off < seam.sigma_mm).mean())
        within.append((off < 2 * seam.sigma_mm).mean())
    assert np.mean(inside) > 0.45 and np.mean(within) > 0.8


@pytest.mark.parametrize(("wide_mm", "rib"), [(22.0, True), (60.0, False)])
def test_a_rib_that_stands_on_a_plate_is_not_surely_a_lap(wide_mm, rib):
    """The plate is seen to go on behind both; what is as narrow as a rib may stand on it, what is wide lies on it."""
    rng, high = np.random.default_rng(8), 8.0
    parts = [
        plate((-45.0, 45.0), (-50.0, 0.0), spacing=0.5),
        plate((-45.0, 45.0), (0.0, high), second=(0.0, 0.0, 1.0), spacing=0.5),
        plate((-45.0, 45.0), (0.0, wide_mm), origin=(0.0, 0.0, high), spacing=0.5),
        plate((-45.0, 45.0), (wide_mm + high, wide_mm + 50.0), spacing=0.5),
    ]
    seams = find_seams(noisy(np.concatenate(parts), rng, 0.05), FindSeamsOptions([0, -300, 300], "fillet")).seams
    (seam,) = (seam for seam in seams if np.abs(seam.root[:, 1]).max() < 1)
    if rib:
        assert seam.kind == "t-joint" or any("undecided between lap-joint and t-joint" in one for one in seam.doubts)
    else:
        assert seam.kind == "lap-joint" and not seam.doubts


def test_a_gap_that_the_spacing_hides_is_refused_with_the_spacing_it_takes():
    with pytest.raises(NoGrooveError, match=r"a gap 2 mm: for smaller ones scan more"):
        find_seams(butt(np.random.default_rng(0), 1.0), FindSeamsOptions([0, 0, 400], "butt"))


def test_an_edge_of_two_faces_is_an_outside_corner():
    (seam,) = find_seams(outside(np.random.default_rng(1)), FindSeamsOptions([20.0, 220.0, 220.0])).seams
    assert seam.kind == "outside-corner" and off_x_axis(seam.root).mean() < 0.1
    assert np.median(seam.opening_deg) == pytest.approx(270, abs=1)


@pytest.mark.parametrize("radius_mm", [20.0, 30.0])
def test_a_tube_on_a_plate_by_the_shapes_of_its_faces_and_its_seam_to_the_very_ends(radius_mm):
    (seam,) = find_seams(tube_on_plate(np.random.default_rng(2), radius_mm), FROM_EYE).seams
    assert seam.kind == "tube-on-plate" and "cylinder of radius" in seam.evidence
    off = np.abs(np.hypot(seam.root[:, 0], seam.root[:, 1]) - radius_mm)
    assert off.mean() < 0.1 and off.max() < 0.4
    assert seam.length_mm > 0.7 * radius_mm * np.pi


def test_no_result_depends_on_frame_order_or_nan():
    rng = np.random.default_rng(3)
    points = corner(rng)
    (here,) = find_seams(points, FROM_EYE).seams
    moved, rotation, shift = turned(points, rng)
    (there,) = find_seams(moved, FindSeamsOptions(rotation @ EYE + shift)).seams
    assert there.kind == here.kind
    assert off_x_axis((there.root - shift) @ rotation).mean() < 0.08
    order = rng.permutation(len(points))
    (again,) = find_seams(points[order], FROM_EYE).seams
    np.testing.assert_allclose(again.root, here.root, atol=1e-6)
    holed = np.concatenate([points, np.full((5, 3), np.nan)])
    (third,) = find_seams(holed, FROM_EYE).seams
    np.testing.assert_allclose(third.root, here.root, atol=1e-9)


def test_a_clamp_interrupts_a_seam_and_tacks_do_not_move_it():
    rng = np.random.default_rng(4)
    points = corner(rng, noise_mm=0.1)
    clamped = points[np.abs(points[:, 0] - 5) > 7]
    (seam,) = find_seams(clamped, FROM_EYE).seams
    assert len(seam.interruptions) == 1 and seam.length_mm > 80
    (hole,) = seam.interruptions
    assert hole.end_mm - hole.start_mm == pytest.approx(14, abs=5)
    near = (np.hypot(points[:, 1], points[:, 2]) < 4) & (np.abs(points[:, 0] - 20) < 4)
    tacked = points.copy()
    tacked[near] += [0.0, -2.0, 2.0]
    (seam,) = find_seams(tacked, FROM_EYE).seams
    assert off_x_axis(seam.root).max() < 0.3


def test_a_groove_stays_the_groove_it_is():
    rng = np.random.default_rng(6)
    points, truth = straight_groove(rng)
    found = find_seams(points)
    assert [seam.kind for seam in found.seams] == ["v-groove"] and not found.weaker
    assert (found.labels & truth).sum() / (found.labels | truth).sum() > 0.9


@pytest.mark.parametrize("radius", [25.0, 60.0, 150.0])
@pytest.mark.parametrize("noise_mm", [0.0, 0.3])
def test_no_seam_on_a_pipe(radius, noise_mm):
    rng = np.random.default_rng(int(radius))
    angle, x = np.meshgrid(np.arange(-1.2, 1.2, 1.0 / radius), np.arange(-60.0, 60.0))
    pipe = np.stack([x, radius * np.sin(angle), radius * np.cos(angle)], axis=-1).reshape(-1, 3)
    with pytest.raises(NoGrooveError):
        find_seams(pipe + noise_mm * rng.standard_normal(pipe.shape), FindSeamsOptions([0, 0, 400]))


@pytest.mark.parametrize("seed", range(4))
def test_no_seam_on_a_wavy_sheet(seed):
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(-80.0, 80.0), np.arange(-60.0, 60.0))
    waves = [(rng.uniform(70, 200), rng.uniform(0, np.pi), rng.uniform(0, 6)) for _ in range(5)]
    z = sum(0.02 * w * np.cos(2 * np.pi / w * (x * np.cos(t) + y * np.sin(t)) + p) for w, t, p in waves)
    sheet = np.stack([x, y, z], axis=-1) + 0.1 * rng.standard_normal((*x.shape, 3))
    with pytest.raises(NoGrooveError):
        find_seams(sheet, FindSeamsOptions([0, 0, 400]))


def test_a_kind_can_be_asked_for():
    rng = np.random.default_rng(7)
    points = corner(rng)
    assert find_seams(points, FindSeamsOptions(EYE, "fillet")).seams[0].kind in FAMILIES["fillet"]
    with pytest.raises(NoGrooveError, match=r"no butt in the cloud"):
        find_seams(points, FindSeamsOptions(EYE, "butt"))
    with pytest.raises(InputError, match="joint 'bolt' is unknown"):
        find_seams(points, FindSeamsOptions(EYE, "bolt"))
    assert set(FAMILIES["any"]) == set(KINDS) and kinds_of("saddle") == ("saddle",)


def test_a_seam_seen_all_round_is_closed():
    points = tube_all_round(np.random.default_rng(5))
    (seam,) = find_seams(points).seams
    assert seam.kind == "tube-on-plate" and seam.closed
    assert seam.length_mm == pytest.approx(2 * np.pi * 20, rel=0.03)
    away = np.hypot(seam.root[:, 0] - 400, seam.root[:, 1])
    assert np.abs(away - 20).mean() < 0.15 and np.abs(away - 20).max() < 0.8
    path = root_path(seam, 40)
    steps = np.linalg.norm(np.diff(path.points, axis=0, append=path.points[:1]), axis=1)
    assert path.closed and np.ptp(steps) < 0.3 * steps.mean()


def test_seams_that_meet_are_separate_ones():
    """The three edges of a box's corner, each along its own axis, none turning into another."""
    found = find_seams(box_corner(np.random.default_rng(6)), FindSeamsOptions([200.0, 250.0, 300.0]))
    axes = []
    for seam in found.seams:
        assert seam.kind in FAMILIES["fillet"]
        extent = np.ptp(seam.root, axis=0)
        axes.append(int(extent.argmax()))
        off = np.delete(seam.root, axes[-1], axis=1)
        assert np.linalg.norm(off[5:-5], axis=1).max() < 1.0 and extent.max() > 35
    assert sorted(axes) == [0, 1, 2]
