"""A part that was put down anew on a table that both scans show: two bodies, and one pose fits only one of them."""

import json
from functools import cache

import numpy as np
import pytest

from grindvision.cell import StructuredLightScanner
from grindvision.cell.rays import target_of
from grindvision.cell.solids import assembled, box
from grindvision.cell.views import view_from
from grindvision.cell.workpiece_scene import workpiece_scene
from grindvision.cli import main
from grindvision.clouds import write_ply
from grindvision.errors import DegenerateError
from grindvision.geometry import inverse, move_points, rigid, rotation_about
from grindvision.vision.change.change_detection import find_change
from grindvision.vision.change.detection import detect
from grindvision.vision.change.moved_body import find_moved_body
from grindvision.vision.registration.scan_registration import RegisterOptions, register

pytestmark = [
    pytest.mark.filterwarnings("ignore::grindvision.errors.GrindvisionWarning"),
    pytest.mark.usefixtures("blank_pictures"),
]

PART_BOX = np.array([[-36.0, -29.0, 1.0], [36.0, 29.0, 60.0]])
"""Corners (2, 3) of a box about the part, frame of the part; the table's top is z = 0."""


def part(beaded):
    shape = box("base", (-35, -25, 0), (35, 25, 8)) + box("wall", (-35, -28, 0), (35, -22, 34))
    shape = shape + box("boss", (14, -2, 7), (28, 12, 22))
    return shape + box("bead", (-22, 8, 7), (6, 11, 9.2)) if beaded else shape


def table():
    top = box("table", (-150, -120, -10), (150, 120, 0))
    return top + box("stop", (48, -30, -1), (62, 10, 18)) + box("vice", (-80, 20, -1), (-52, 44, 14))


@cache
def scanned(seed, shift_mm, turn_deg, beaded):
    """Scans of the part on its table, without bead and moved, and the motion T_before_now, frame of the test scan."""
    rng = np.random.default_rng(seed)
    camera = StructuredLightScanner(serial=seed)
    direction = rng.normal(size=2)
    there = rigid(
        rotation_about([0.0, 0.0, 1.0], np.radians(turn_deg)), [*shift_mm * direction / np.hypot(*direction), 0]
    )
    poses = [view_from((0, 0, 8), 405.0, 0.75, about, 0.0) for about in (0.7, 0.7 + rng.uniform(0.0, 0.3))]
    scans = []
    for pose, motion, bead in zip(poses, (np.eye(4), there), (False, beaded), strict=True):
        scene = assembled([table().solid(), part(bead).solid().moved(motion)])
        scans.append(camera.scan(target_of(scene), pose, rng, 3).points)
    return scans, poses, there, inverse(poses[1]) @ inverse(there) @ poses[1]


def cut(points, T_world_scanner, T_world_part=None):
    """The points of the part, by its box."""
    T_world_part = np.eye(4) if T_world_part is None else T_world_part
    places = move_points(inverse(T_world_part) @ T_world_scanner, points)
    return points[((places > PART_BOX[0]) & (places < PART_BOX[1])).all(axis=1)]


#: Seed, shift in mm, turn in deg, and whether there is a bead: two motions in every run, the third by night.
PUT_DOWN = ((1, 1.0, 0.5, False), (3, 5.0, 2.0, True))
BY_NIGHT = ((4, 8.0, -1.0, True), (4, 8.0, -1.0, False), (1, 1.0, 0.5, True), (3, 5.0, 2.0, False))


@pytest.mark.parametrize(
    ("seed", "shift_mm", "turn_deg", "beaded"),
    [*PUT_DOWN, *(pytest.param(*one, marks=pytest.mark.full) for one in BY_NIGHT)],
)
def test_a_part_put_down_anew_is_named_with_its_motion(seed, shift_mm, turn_deg, beaded):
    (sample, test), poses, there, _ = scanned(seed, shift_mm, turn_deg, beaded)
    with pytest.raises(DegenerateError, match=r"two bodies.*--sample-box|moved against something that both scans show"):
        detect(sample, test)
    found = detect(cut(sample, poses[0]), cut(test, poses[1], there))
    assert len(found.beads) == beaded
    away = found.T_sample_test @ inverse(poses[1]) @ there @ poses[0] - np.eye(4)
    assert np.abs(away @ [0, 0, 400.0, 1.0]).max() < 0.3


def test_the_motion_is_near_the_true_one_and_the_same_in_any_frame(rng):
    (sample, test), _, _, T_before_now = scanned(1, 1.0, 0.5, True)
    moved = rigid(rotation_about([0.3, -0.5, 0.8], 0.7), [40.0, -60.0, 10.0])
    steps = []
    for frame, order in ((np.eye(4), slice(None)), (moved, rng.permutation(len(test)))):
        there_mm = move_points(frame, test)[order]
        found = register(there_mm, sample, RegisterOptions(0, frame[:3, 3], np.zeros(3)))
        difference = find_change(found.source, found.target, found.fine)
        body = find_moved_body(found.source, found.target, found.fine, difference)
        before_mm = move_points(inverse(body.T_now_before), body.middle_mm)
        middle, before = move_points(inverse(frame), np.stack([body.middle_mm, before_mm]))
        step = middle - before
        truths = inverse(T_before_now), T_before_now  # of the part on the table, and of the table under the part
        true_steps = [middle - move_points(inverse(truth), middle) for truth in truths]
        # a body of which few faces are seen is free to slide along them
        assert min(np.linalg.norm(step - true_step) for true_step in true_steps) < 1.0
        assert np.linalg.norm(body.motion_mm) == pytest.approx(np.linalg.norm(step), abs=1e-6)
        steps.append(step)
    assert np.linalg.norm(steps[1] - steps[0]) < 0.2


@pytest.mark.parametrize(
    ("kind", "change"),
    [
        ("bracket", "bead"),
        ("casting", "pit"),
        ("bracket", "none"),
        pytest.param("casting", "bead", marks=pytest.mark.full),
        pytest.param("bracket", "pit", marks=pytest.mark.full),
        pytest.param("casting", "none", marks=pytest.mark.full),
    ],
)
def test_one_body_is_not_taken_for_two(kind, change):
    scene = workpiece_scene(kind, np.random.default_rng(5), change, (10.0, 30.0))
    found = register(scene.test.points, scene.sample.points)
    difference = find_change(found.source, found.target, found.fine)
    assert find_moved_body(found.source, found.target, found.fine, difference) is None


def test_one_file_given_twice_holds_one_body():
    (sample, _), _, _, _ = scanned(5, 0.0, 0.0, True)
    assert detect(sample, sample).beads == ()


def test_a_part_that_was_not_moved_on_its_table_is_judged_with_it():
    (sample, test), poses, _, _ = scanned(5, 0.0, 0.0, True)
    found = detect(sample, test)
    assert len(found.beads) == 1
    ridge = move_points(poses[1], found.path_points)
    assert (np.abs(ridge - [-8.0, 9.5, 9.0]) < [16.0, 2.0, 1.0]).all()


def words(corners):
    return [f"{value:.3f}" for value in np.ravel(corners)]


def box_about(points):
    return np.stack([points.min(axis=0) - 0.01, points.max(axis=0) + 0.01])


def test_the_command_cuts_both_scans_to_a_box(tmp_path):
    (sample, test), poses, there, _ = scanned(3, 5.0, 2.0, True)
    write_ply(tmp_path / "good.ply", sample)
    write_ply(tmp_path / "test.ply", test)
    boxes = [box_about(cut(sample, poses[0])), box_about(cut(test, poses[1], there))]
    scans = ["detect", str(tmp_path / "good.ply"), str(tmp_path / "test.ply"), "-o"]
    cuts = ["--sample-box", *words(boxes[0]), "--test-box", *words(boxes[1][::-1])]
    assert main([*scans, str(tmp_path / "whole")]) == 2
    assert main([*scans, str(tmp_path / "cut"), *cuts]) == 0
    report = json.loads((tmp_path / "cut" / "report.json").read_text())
    away = np.array(report["T_sample_test"]) @ inverse(poses[1]) @ there @ poses[0] - np.eye(4)
    assert np.abs(away @ [0, 0, 400.0, 1.0]).max() < 0.5
    again = [*scans, str(tmp_path / "again"), "--parameters", str(tmp_path / "cut" / "parameters.toml")]
    assert main(again) == 0
    assert (tmp_path / "again" / "path.csv").read_bytes() == (tmp_path / "cut" / "path.csv").read_bytes()


@pytest.mark.parametrize("corners", [[1e4, 0, 0, 2e4, 1, 1], [0, 0, 0, 0, 0, 0]])
def test_a_box_that_holds_nothing_is_refused(tmp_path, capsys, corners):
    (sample, test), _, _, _ = scanned(3, 5.0, 2.0, True)
    write_ply(tmp_path / "good.ply", sample)
    write_ply(tmp_path / "test.ply", test)
    scans = ["detect", str(tmp_path / "good.ply"), str(tmp_path / "test.ply"), "-o", str(tmp_path / "result")]
    assert main([*scans, "--test-box", *(str(value) for value in corners)]) == 2
    assert "--test-box" in capsys.readouterr().err
    assert not (tmp_path / "result").exists()


def test_grind_says_that_it_knows_nothing_of_what_was_cut_off(tmp_path, capsys):
    (sample, test), poses, there, _ = scanned(3, 5.0, 2.0, True)
    write_ply(tmp_path / "good.ply", sample)
    write_ply(tmp_path / "test.ply", test)
    boxes = [words(box_about(cut(sample, poses[0]))), words(box_about(cut(test, poses[1], there)))]
    scans = [
        "grind",
        str(tmp_path / "good.ply"),
        str(tmp_path / "test.ply"),
        "-o",
        str(tmp_path / "passes"),
        "--wheel",
        "3",
        "--width",
        "3",
        "--lead",
        "1",
    ]
    assert main([*scans, "--sample-box", *boxes[0], "--test-box", *boxes[1]]) == 0
    assert "outside of --test-box is no obstacle" in capsys.readouterr().err
    told = json.loads((tmp_path / "passes" / "report.json").read_text())
    assert len(told["pieces"]) == 1
    assert any("--test-box" in warning for warning in told["warnings"])
    again = ["grind", "--again", str(tmp_path / "passes"), str(tmp_path / "test.ply"), "--test-box", *boxes[1]]
    assert main(again) == 0  # the job remembers SAMPLE's box
