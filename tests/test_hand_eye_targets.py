"""A plate and three spheres as hand-eye targets: their whole pose in clutter, either mounting, symmetry, refusals."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from grindvision.calibration.plate_search import find_plate
from grindvision.calibration.plate_symmetry import fold_of, resolve, upright
from grindvision.calibration.sphere_triple import find_three_spheres, poses_of_triples
from grindvision.cli import main
from grindvision.cli.hand_eye_targets import read_target
from grindvision.clouds import write_ply
from grindvision.errors import AmbiguousError, DegenerateError, InputError
from grindvision.geometry import angle_between, inverse, rigid, rotation_about
from tests.hand_eye_scene import TARGET, X, looking_poses, plate_view, seen_poses, sphere_view, three_spheres_view

pytestmark = pytest.mark.usefixtures("blank_pictures")

SIDES = (160.0, 110.0)


def turned(angle_rad):
    return rigid(rotation_about([0, 0, 1], angle_rad))


def off_deg(found, true, fold=2):
    return min(np.degrees(angle_between(found, true @ turned(2 * np.pi * k / fold))) for k in range(fold))


def scene(seed, n=8):
    rng = np.random.default_rng(seed)
    poses = looking_poses(rng, n)
    return rng, poses, inverse(poses @ X) @ rigid(rotation_about([0, 0, 1], 0.7), TARGET)


@pytest.mark.parametrize("seed", range(3))
def test_a_plate_is_found_in_clutter_with_its_whole_pose(seed):
    rng, _, views = scene(seed, 3)
    for true in views:
        found = find_plate(plate_view(true, rng), SIDES, rng, "view")
        assert np.linalg.norm(found[:3, 3] - true[:3, 3]) < 0.5
        assert off_deg(found, true) < 0.3
        assert found[:3, 2] @ found[:3, 3] < 0  # the face that is seen


def test_order_of_points_and_of_sides_moves_the_plate_by_less_than_its_error():
    rng, _, views = scene(5, 1)
    points = plate_view(views[0], rng)
    found = find_plate(points, SIDES, np.random.default_rng(0), "view")
    for other in (points[::-1], points[rng.permutation(len(points))]):
        again = find_plate(other, SIDES[::-1], np.random.default_rng(1), "view")
        assert np.linalg.norm(again[:3, 3] - found[:3, 3]) < 0.2 and off_deg(again, found) < 0.2


def test_another_size_or_a_plate_that_is_cut_is_refused_with_what_was_seen():
    rng, _, views = scene(6, 1)
    whole = plate_view(views[0], rng, n=2000)
    with pytest.raises(DegenerateError, match=r"no rectangular plate of 200 x 100 mm.* measures 1\d\d x 1\d\d mm"):
        find_plate(whole, (200.0, 100.0), rng, "view")
    local = (whole - views[0][:3, 3]) @ views[0][:3, :3]
    with pytest.raises(DegenerateError, match="all four edges"):
        find_plate(whole[local[:, 0] < 50], SIDES, rng, "view")


@pytest.mark.parametrize(("sides", "fold"), [((160.0, 110.0), 2), ((120.0, 120.0), 4), ((120.0, 116.0), 4)])
def test_the_way_round_follows_from_the_arm(sides, fold):
    assert fold_of(sides) == fold
    rng = np.random.default_rng(7)
    poses = looking_poses(rng, 9)
    true = seen_poses(poses, rng)
    ways = rng.integers(fold, size=9)
    seen = np.array([one @ turned(2 * np.pi * k / fold) for one, k in zip(true, ways, strict=True)])
    found = resolve(poses, seen, fold, ["v"] * 9)
    apart = inverse(true) @ found
    assert np.abs(apart - apart[0]).max() < 1e-9
    away = looking_poses(np.random.default_rng(8), 9)
    assert np.abs(resolve(away, seen, fold, ["v"] * 9) - upright(seen, fold)).max() < 1e-12


def test_a_way_round_that_the_arm_cannot_tell_is_refused():
    poses = np.array([turned(k * np.pi / 2) for k in (0, 1, 0, 1, 0)])
    with pytest.raises(AmbiguousError, match="turned by 180 deg about its normal"):
        resolve(poses, inverse(poses), 2, ["v"] * 5)


def test_three_spheres_give_a_pose_and_are_told_apart():
    rng, _, views = scene(9, 4)
    seen = [three_spheres_view(view, rng) for view in views]
    found = [find_three_spheres(points, 38.1, rng, "view")[0] for points, _ in seen]
    for one, (_, centres) in zip(found, seen, strict=True):
        assert np.linalg.norm(one[:, None] - centres[None], axis=2).min(axis=1).max() < 0.3
    apart = inverse(views) @ poses_of_triples(np.array(found), ["v"] * 4)
    assert np.abs(apart[:, :3, 3] - apart[0, :3, 3]).max() < 0.4
    assert max(np.degrees(angle_between(one, apart[0])) for one in apart) < 0.3


@pytest.mark.parametrize(
    ("corners", "error", "said"),
    [
        ([[0, 0, 0], [100, 0, 0], [50, 80, 0]], AmbiguousError, "two distances are equal"),
        ([[0, 0, 0], [100, 0, 0], [160, 2, 0]], DegenerateError, "in a line"),
    ],
)
def test_spheres_that_leave_a_rotation_free_are_refused(corners, error, said):
    with pytest.raises(error, match=said):
        poses_of_triples(np.array([corners, corners, corners], dtype=float), ["a", "b", "c"])


def test_other_spheres_in_a_view_are_named_and_two_are_too_few():
    one = np.array([[0.0, 0, 0], [150, 0, 0], [54, 72, 0]])
    with pytest.raises(DegenerateError, match="c: the three spheres"):
        poses_of_triples(np.array([one, one, one * 1.1]), ["a", "b", "c"])
    rng = np.random.default_rng(0)
    with pytest.raises(DegenerateError, match="1 of three spheres"):
        find_three_spheres(sphere_view(np.array([0.0, 0, 400]), 19.05, rng), 38.1, rng, "view")


def folder_of(folder, kind, mounted, n=7, of_plate=9000):
    rng, carrier, views = scene(11, n)
    for row, view in enumerate(views):
        points = plate_view(view, rng, n=of_plate) if kind == "board" else three_spheres_view(view, rng)[0]
        write_ply(folder / f"v{row}.ply", points)
    poses = carrier if mounted == "on-arm" else inverse(carrier)
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_euler("xyz", degrees=True)
    np.savetxt(folder / "poses.txt", np.hstack([poses[:, :3, 3], turns]), fmt="%.9f")
    clouds = [str(folder / f"v{row}.ply") for row in range(n)]
    return ["hand-eye", str(folder / "poses.txt"), *clouds, "--mounted", mounted]


@pytest.mark.parametrize(("mounted", "parent"), [("on-arm", "flange"), ("fixed", "base")])
@pytest.mark.parametrize("target", ["board:160x110", "spheres:38.1"])
def test_the_command_finds_the_camera_by_either_target(tmp_path, mounted, parent, target):
    words = [*folder_of(tmp_path, target.partition(":")[0], mounted), "--target", target]
    assert main([*words, "--rotation", "fanuc", "-o", str(tmp_path / "camera")]) == 0
    found = np.array(json.loads((tmp_path / "camera" / "hand_eye.json").read_text())[f"T_{parent}_camera"])
    assert np.linalg.norm(found[:3, 3] - X[:3, 3]) < 1.5
    assert np.degrees(angle_between(found, X)) < 0.25
    errors = json.loads((tmp_path / "camera" / "report.json").read_text())["errors"]
    assert set(errors) == {"place_mm", "depth_mm", "arm_rad", "camera_rad"}


def test_misread_poses_of_a_plate_are_named_and_nothing_is_written(tmp_path, capsys):
    words = folder_of(tmp_path, "board", "on-arm", of_plate=2000)
    out = ["-o", str(tmp_path / "camera")]
    refused = {
        "xyz --angles deg": ["--target", "board:160x110", "--rotation", "kuka"],
        "no rectangular plate of 300 x 200 mm": ["--target", "board:300x200", "--rotation", "fanuc"],
        "board:LENGTHxWIDTH_MM": ["--target", "board", "--rotation", "fanuc"],
        "--rotation is missing.* xyz --angles deg": ["--target", "board:160x110"],
    }
    for said, given in refused.items():
        assert main([*words, *given, *out]) == 2
        error = capsys.readouterr().err
        assert all(part in error for part in said.split(".*"))
        assert not (tmp_path / "camera").exists()


@pytest.mark.parametrize(
    "text", ["board:160", "board:160x0", "sphere:30x20", "spheres", "plate:1x2", "board:ax", "part:3"]
)
def test_targets_that_cannot_be_are_refused(text):
    with pytest.raises(InputError, match="say sphere:DIAMETER_MM"):
        read_target(text)
