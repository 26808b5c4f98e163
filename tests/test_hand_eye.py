"""Hand-eye from poses alone: truth recovered within what is stated, in every convention; mistakes named."""

import json
import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from grindvision.calibration.hand_eye import HandEyeOptions, hand_eye
from grindvision.calibration.hand_eye_advice import further_poses, knowledge, poorly_known
from grindvision.calibration.hand_eye_checks import (
    outliers,
    refuse_better_reading,
    refuse_implausible,
    refuse_still_views,
)
from grindvision.calibration.hand_eye_starts import by_dual_quaternions, by_rotation_vectors, pair_motions
from grindvision.calibration.pose_conventions import MAKERS, convention, poses_from, read_pose_rows
from grindvision.calibration.sphere_search import cut_out_sphere
from grindvision.cli import main
from grindvision.cli.hand_eye_targets import pairs_of_views
from grindvision.clouds import finite_points, read_cloud, write_ply
from grindvision.errors import DegenerateError, FileError, InputError
from grindvision.geometry import angle_between, inverse, move_points, rigid
from grindvision.vision.registration.views import register_views
from tests.hand_eye_scene import TARGET, X, looking_poses, part_view, seen_points, seen_poses, sphere_view


def scene(seed=0, n=10, **errors):
    rng = np.random.default_rng(seed)
    poses = looking_poses(rng, n)
    return poses, seen_points(poses, rng, **errors)


def rows_of(poses, rotation="xyz", degrees=True, metres=False):
    """A table of poses as a controller shows it."""
    turns = Rotation.from_matrix(poses[:, :3, :3])
    if rotation == "rotation-vector":
        turned = turns.as_rotvec(degrees=degrees)
    elif rotation.startswith("quaternion"):
        turned = turns.as_quat()[:, [3, 0, 1, 2] if rotation.endswith("wxyz") else [0, 1, 2, 3]]
    else:
        turned = turns.as_euler(rotation, degrees=degrees)
    return np.hstack([poses[:, :3, 3] / (1000 if metres else 1), turned])


@pytest.mark.parametrize("mounted", ["on-arm", "fixed"])
@pytest.mark.parametrize("kind", ["points", "poses"])
def test_exact_data_give_the_truth(mounted, kind):
    rng = np.random.default_rng(1)
    poses = looking_poses(rng)
    target = seen_points(poses, rng) if kind == "points" else seen_poses(poses, rng)
    given = poses if mounted == "on-arm" else inverse(poses)
    found = hand_eye(given, target, HandEyeOptions(mounted))
    assert np.abs(found.T_parent_camera - X).max() < 1e-6
    assert np.abs(found.target[:3, 3] - TARGET).max() < 1e-5
    assert found.rms_mm < 1e-6


def test_two_closed_forms_agree_on_exact_motions():
    rng = np.random.default_rng(2)
    poses = looking_poses(rng, 6)
    A, B = pair_motions(poses, seen_poses(poses, rng))
    for closed in (by_rotation_vectors(A, B), by_dual_quaternions(A, B)):
        assert closed is not None and np.abs(closed - X).max() < 1e-6


def test_truth_lies_within_the_stated_uncertainty():
    off = []
    for seed in range(10):
        poses, points = scene(seed, 12, arm_mm=0.4)
        found = hand_eye(poses, points)
        change = np.concatenate(
            [
                X[:3, 3] - found.T_parent_camera[:3, 3],
                Rotation.from_matrix(X[:3, :3] @ found.T_parent_camera[:3, :3].T).as_rotvec(),
            ]
        )
        off.append(change @ np.linalg.solve(found.covariance, change))
    assert 3.0 < np.median(off) < 10.0  # chi squared of six: 5.3; the residuals' own scale widens it


def test_order_of_the_poses_and_the_place_of_the_base_change_nothing():
    poses, points = scene(3, arm_mm=0.3)
    found = hand_eye(poses, points)
    order = np.random.default_rng(0).permutation(len(poses))
    moved = rigid(Rotation.from_rotvec([0.3, -0.5, 1.0]).as_matrix(), [100.0, 2000.0, -50.0])
    for other in (hand_eye(poses[order], points[order]), hand_eye(moved @ poses, points)):
        assert np.abs(other.T_parent_camera - found.T_parent_camera).max() < 1e-5
        assert other.rms_mm == pytest.approx(found.rms_mm, abs=1e-6)


def test_one_wrong_pose_is_told_and_does_no_harm():
    poses, points = scene(4, 12, arm_mm=0.2)
    points[5] += [12.0, -8.0, 5.0]
    found = hand_eye(poses, points)
    assert np.linalg.norm(found.T_parent_camera[:3, 3] - X[:3, 3]) < 5 * found.sigma_mm.max()
    assert [text.split(" ")[1] for text in outliers(found, [f"v{k}" for k in range(12)])] == ["6"]


def test_motions_about_one_axis_are_refused_with_the_axis():
    poses = np.array(
        [rigid(Rotation.from_rotvec([0, 0, a]).as_matrix(), [a * 100, 50, 300]) for a in np.linspace(0, 2, 8)]
    )
    with pytest.raises(DegenerateError, match=r"one axis, \(0.00, 0.00, 1.00\) in the flange frame"):
        hand_eye(poses, np.random.default_rng(0).normal(size=(8, 3)))
    still = np.tile(np.eye(4), (6, 1, 1))
    with pytest.raises(DegenerateError, match="hardly turn"):
        hand_eye(still, np.zeros((6, 3)))


def one_place(rng, n, turn_deg, arm_mm=0.5):
    """Poses that see a sphere in one place of the view, and its centres."""
    poses = looking_poses(rng, n, turn_deg)
    middle = X[:3, :3] @ [0, 0, 400] + X[:3, 3]
    poses = np.array([rigid(pose[:3, :3], TARGET - pose[:3, :3] @ middle) for pose in poses])
    return poses, seen_points(poses, rng, arm_mm)


def test_a_target_in_one_place_of_the_view_leaves_the_camera_open_and_says_so():
    poses, points = one_place(np.random.default_rng(5), 9, 25.0)
    found = hand_eye(poses, points)
    known = knowledge(found, points)
    assert not known.useful and known.rotation_deg > 0.5
    told = poorly_known(found, poses, points)
    assert f"its rotation to {known.rotation_deg:.2g} deg" in told
    assert "in its corners" in told and "would leave" in told
    assert re.search(r"was seen within [01] mm \(rms\) of one place before the camera", told)
    worst, least = (
        float(one) for one in re.search(r"its place to (\S+) mm along \(.*?\), to (\S+) mm along", told).groups()
    )
    sigmas = np.sqrt(np.linalg.eigvalsh(found.covariance[:3, :3]))
    assert (least, worst) == pytest.approx((sigmas[0], sigmas[-1]), rel=0.06)
    left_out = np.sqrt(np.mean(found.left_out_mm**2))
    assert f"still meet within about {left_out:.2g} mm" in told


def test_poses_that_are_advised_bring_the_camera_to_what_is_said():
    gained = []
    for seed in range(4):
        rng = np.random.default_rng([seed, 31])
        poses, points = one_place(rng, 9, 25.0)
        found = hand_eye(poses, points)
        names, then = further_poses(found, poses, points)
        assert "in its corners" in names[0]
        straight = poses[:, :3, :3].mean(axis=0)
        turn = Rotation.from_matrix(straight).as_matrix()
        aside = np.array([[100.0, 100, 400], [100, -100, 400], [-100, 100, 400], [-100, -100, 400]])
        more = np.array([rigid(turn, TARGET - turn @ (X[:3, :3] @ place + X[:3, 3])) for place in aside])
        better = hand_eye(np.vstack([poses, more]), np.vstack([points, seen_points(more, rng, 0.5)]))
        gained.append(knowledge(better, np.vstack([points, aside])).rotation_deg / then.rotation_deg)
        assert then.excess < 0.7 * knowledge(found, points).excess
    assert 0.5 < np.median(gained) < 2.0


def test_a_camera_that_is_well_known_is_left_without_a_word():
    poses, points = scene(3, 12, arm_mm=0.1)
    assert poorly_known(hand_eye(poses, points), poses, points) == ""


@pytest.mark.parametrize("maker", MAKERS)
def test_every_maker_s_numbers_give_the_pose_back(maker):
    poses = looking_poses(np.random.default_rng(6), 5)
    stated = convention(maker)
    assert np.abs(poses_from(rows_of(poses, stated.rotation, stated.angles == "deg"), stated) - poses).max() < 1e-9


def test_inverse_and_metres_and_order_are_read_as_said():
    poses = looking_poses(np.random.default_rng(7), 4)
    rows = rows_of(inverse(poses), "rotation-vector", degrees=False, metres=True)
    stated = convention("ur", length="m", inverted=True)
    assert np.abs(poses_from(rows, stated) - poses).max() < 1e-9
    swapped = np.hstack([rows[:, 3:], rows[:, :3]])
    assert (
        np.abs(poses_from(swapped, convention("ur", length="m", inverted=True, rotation_first=True)) - poses).max()
        < 1e-9
    )


MISREAD = {
    "degrees": ("xyz", True, "xyz", {"angles": "rad"}, "--angles deg"),
    "radians": ("xyz", False, "xyz", {"angles": "deg"}, "--angles rad"),
    "order of Euler angles": ("ZYX", True, "fanuc", {}, "ZYX --angles deg .*kuka"),
    "rotation vector": ("rotation-vector", False, "ur-rpy", {}, "rotation-vector .*ur"),
    "quaternion": ("quaternion-xyzw", False, "abb", {}, "quaternion-xyzw"),
    "metres": ("xyz", True, "fanuc", {"length": "mm"}, "--pose-unit m "),
    "inverse": ("xyz", True, "fanuc", {"inverted": True}, "--mounted"),
}


@pytest.mark.parametrize("mistake", MISREAD)
def test_a_wrong_convention_is_named_with_how_much_better_the_right_one_is(mistake):
    rotation, degrees, stated, more, said = MISREAD[mistake]
    poses, points = scene(8, 9, arm_mm=0.3)
    rows = rows_of(poses, rotation, degrees, metres=mistake == "metres")
    with pytest.raises(InputError, match="times less") as refused:
        refuse_better_reading(rows, convention(stated, **more), points, "on-arm", [f"v{k}" for k in range(9)])
    assert re.search(said, str(refused.value))


def test_the_right_convention_and_order_are_left_alone():
    poses, points = scene(8, 9, arm_mm=0.3)
    names = [f"v{k}" for k in range(9)]
    refuse_better_reading(rows_of(poses), convention("fanuc"), points, "on-arm", names)


def test_swapped_rows_are_named():
    poses, points = scene(9, 9, arm_mm=0.3)
    points[[2, 6]] = points[[6, 2]]
    with pytest.raises(InputError, match=r"v2 and v6 \(rows 3 and 7\) swapped"):
        refuse_better_reading(rows_of(poses), convention("fanuc"), points, "on-arm", [f"v{k}" for k in range(9)])


def test_poses_of_another_day_are_refused():
    poses, _ = scene(10, 9)
    _, points = scene(11, 9)
    with pytest.raises(InputError, match="do not belong together"):
        refuse_implausible(hand_eye(poses, points))


@pytest.mark.parametrize("seed", range(4))
def test_a_sphere_is_cut_out_of_clutter(seed):
    rng = np.random.default_rng(seed)
    centre = np.array([10.0, -20.0, 400.0])
    view = sphere_view(centre, 19.05, rng)
    found = cut_out_sphere(view, 38.1, np.random.default_rng(seed), "view")
    assert np.linalg.norm(found.centre_mm - centre) < 0.15
    with pytest.raises(DegenerateError, match="no sphere of diameter 80 mm"):
        cut_out_sphere(view, 80.0, np.random.default_rng(seed), "view")


def test_a_round_thing_of_the_sphere_s_size_is_no_sphere():
    rng = np.random.default_rng(0)
    rays = rng.normal(size=(6000, 3))
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    rays = rays[rays[:, 2] < -0.2]
    bumps = 1 + 0.06 * np.sin(9 * rays[:, 0]) * np.cos(8 * rays[:, 1])
    with pytest.raises(DegenerateError, match="no sphere"):
        cut_out_sphere(50.0 * rays * bumps[:, None] + [0, 0, 400.0], 100.0, np.random.default_rng(0), "head")


def folder_of_views(folder, n=6):
    poses, points = scene(12, n, arm_mm=0.2)
    rng = np.random.default_rng(0)
    for row, point in enumerate(points):
        write_ply(folder / f"v{row}.ply", sphere_view(point, 19.05, rng, 500))
    np.savetxt(folder / "poses.txt", rows_of(poses), fmt="%.9f")
    return [str(folder / "poses.txt"), *(str(folder / f"v{row}.ply") for row in range(n))]


def test_the_command_writes_its_set_and_refuses_without_writing(tmp_path, capsys):
    words = folder_of_views(tmp_path)
    target, out = ["--target", "sphere:38.1"], ["-o", str(tmp_path / "camera")]
    refused = {
        "every cloud needs its pose": [*words[:-1], *target, "--rotation", "fanuc"],
        "one cloud or row twice": [*words[:-1], words[1], *target, "--rotation", "fanuc"],
        "--rotation is missing.* --rotation xyz --angles deg": [*words, *target],
        "say sphere:DIAMETER_MM": [*words, "--target", "sphere", "--rotation", "fanuc"],
        "is unknown": [*words, *target, "--rotation", "robot"],
    }
    for said, given in refused.items():
        assert main(["hand-eye", *given, *out]) == 2
        assert re.search(said, capsys.readouterr().err)
        assert not (tmp_path / "camera").exists()
    assert main(["hand-eye", *words, *target, "--rotation", "fanuc", *out]) == 0
    written = json.loads((tmp_path / "camera" / "hand_eye.json").read_text())
    sigma = np.sqrt(np.diag(written["covariance"]))
    found = np.array(written["T_flange_camera"])
    assert np.linalg.norm(found[:3, 3] - X[:3, 3]) < 5 * sigma[:3].max()
    assert angle_between(found, X) < 5 * sigma[3:].max()
    assert {path.name for path in (tmp_path / "camera").iterdir()} == {
        "hand_eye.json", "poses.csv", "report.png", "report.json", "parameters.toml",
    }  # fmt: skip


def test_a_camera_known_less_well_than_is_asked_for_ends_with_exit_code_3(tmp_path, capsys):
    rng = np.random.default_rng(16)
    poses = looking_poses(rng, 9)
    target = seen_poses(poses, rng, arm_mm=0.2, arm_rad=5e-4)
    np.savetxt(tmp_path / "poses.txt", rows_of(poses), fmt="%.9f")
    np.savetxt(tmp_path / "board.txt", rows_of(target, "rotation-vector", degrees=False), fmt="%.9f")
    words = ["hand-eye", str(tmp_path / "poses.txt"), str(tmp_path / "board.txt"), "--rotation", "fanuc"]
    words += ["--target", "poses", "--target-rotation", "rotation-vector", "-o", str(tmp_path / "camera")]
    assert main([*words, "--require-mm", "-1"]) == 2
    assert "--require-mm is -1" in capsys.readouterr().err and not (tmp_path / "camera").exists()
    assert main(words) == 0
    known = json.loads((tmp_path / "camera" / "report.json").read_text())["known_to"]
    needed = max(known["place_mm"], known["target_mm"])
    capsys.readouterr()
    asked = {
        ("--require-mm", f"{1.01 * needed:.6f}", "--require-deg", f"{1.01 * known['rotation_deg']:.6f}"): 0,
        ("--require-mm", f"{0.99 * needed:.6f}"): 3,
        ("--require-deg", f"{0.99 * known['rotation_deg']:.6f}"): 3,
    }
    for more, code in asked.items():
        (tmp_path / "camera" / "hand_eye.json").unlink(missing_ok=True)
        assert main([*words, *more]) == code
        assert (tmp_path / "camera" / "hand_eye.json").exists()
        assert (f"({more[0]})" in capsys.readouterr().err) == (code == 3)


def folder_of_parts(folder, mounted="on-arm", n=5, **kind):
    rng = np.random.default_rng(13)
    poses = looking_poses(rng, n)
    for row, pose in enumerate(poses):
        write_ply(folder / f"v{row}.ply", part_view(rigid(None, -TARGET) @ pose @ X, rng, **kind))
    np.savetxt(folder / "poses.txt", rows_of(poses if mounted == "on-arm" else inverse(poses)), fmt="%.9f")
    views = [str(folder / f"v{row}.ply") for row in range(n)]
    return [str(folder / "poses.txt"), *views, "--target", "part", "--rotation", "fanuc", "--mounted", mounted]


@pytest.mark.parametrize(
    ("mounted", "parent"), [("on-arm", "flange"), pytest.param("fixed", "base", marks=pytest.mark.full)]
)
def test_the_part_itself_tells_where_the_camera_is(tmp_path, mounted, parent):
    words = folder_of_parts(tmp_path, mounted)
    assert main(["hand-eye", *words, "-o", str(tmp_path / "camera")]) == 0
    found = np.array(json.loads((tmp_path / "camera" / "hand_eye.json").read_text())[f"T_{parent}_camera"])
    assert np.linalg.norm(found[:3, 3] - X[:3, 3]) < 0.5
    assert np.degrees(angle_between(found, X)) < 0.1


def test_pose_pairs_of_another_tool_give_the_camera(tmp_path, capsys):
    rng = np.random.default_rng(16)
    poses = looking_poses(rng, 9)
    target = seen_poses(poses, rng, arm_mm=0.1, arm_rad=2e-4)
    np.savetxt(tmp_path / "poses.txt", rows_of(poses), fmt="%.9f")
    np.savetxt(tmp_path / "board.txt", rows_of(target, "rotation-vector", degrees=False, metres=True), fmt="%.9f")
    words = ["hand-eye", str(tmp_path / "poses.txt"), str(tmp_path / "board.txt"), "--rotation", "fanuc"]
    words += ["--target", "poses", "-o", str(tmp_path / "camera")]
    read = ["--target-rotation", "rotation-vector", "--target-unit", "m"]
    assert main(words) == 2 and "say --target-rotation" in capsys.readouterr().err
    swapped = np.loadtxt(tmp_path / "poses.txt")[[0, 1, 6, 3, 4, 5, 2, 7, 8]]
    np.savetxt(tmp_path / "swapped.txt", swapped, fmt="%.9f")
    assert main([words[0], str(tmp_path / "swapped.txt"), *words[2:], *read]) == 2
    assert "row 3 and row 7 (rows 3 and 7) swapped" in capsys.readouterr().err
    np.savetxt(tmp_path / "two.txt", rows_of(poses[:2]), fmt="%.9f")
    np.savetxt(tmp_path / "two_seen.txt", rows_of(target[:2], "rotation-vector", degrees=False), fmt="%.9f")
    assert main([words[0], str(tmp_path / "two.txt"), str(tmp_path / "two_seen.txt"), *words[3:], *read]) == 2
    assert "needs at least 3" in capsys.readouterr().err
    assert not (tmp_path / "camera").exists()
    assert main([*words, *read]) == 0
    found = np.array(json.loads((tmp_path / "camera" / "hand_eye.json").read_text())["T_flange_camera"])
    assert np.linalg.norm(found[:3, 3] - X[:3, 3]) < 1.0
    assert np.degrees(angle_between(found, X)) < 0.1


def test_a_flat_part_is_refused_by_the_command(tmp_path, capsys):
    assert main(["hand-eye", *folder_of_parts(tmp_path, flat=True), "-o", str(tmp_path / "camera")]) == 2
    assert "free motion: a translation along" in capsys.readouterr().err
    assert not (tmp_path / "camera").exists()


def test_views_of_what_rests_with_the_camera_are_refused():
    poses = looking_poses(np.random.default_rng(14))
    with pytest.raises(InputError, match="background that rests with the camera"):
        refuse_still_views(poses, np.tile(rigid(None, [0, 0, 400]), (len(poses), 1, 1)))


def test_of_many_views_only_those_turned_little_against_each_other_are_registered():
    poses = looking_poses(np.random.default_rng(15), 30)
    pairs = pairs_of_views(30, poses)
    assert len(pairs) < 200 < 30 * 29 / 2
    assert all((k, k + 1) in pairs for k in range(29))
    assert len(pairs_of_views(9, None)) == 36


@pytest.mark.parametrize(
    ("text", "said"),
    [("", "no rows"), ("1 2 3\n", "3 numbers a line"), ("1 2 3 4 5 6\n1 2 3 4 5\n", "line 2 has 5"),
     ("1 2 3 4 5 6\na b c d e f\n", "line 2 is no row"), ("1 2 3 4 5 nan\n", "line 1 holds NaN"),
     ("1\0 \0002\0", "save it as UTF-8")],
)  # fmt: skip
def test_damaged_tables_are_refused(tmp_path, text, said):
    (tmp_path / "p.txt").write_text(text)
    with pytest.raises(FileError, match=said):
        read_pose_rows(tmp_path / "p.txt")


@pytest.mark.parametrize(
    ("parted", "point"), [(";", ","), ("; ", ","), ("\t", ","), (" ", ","), (",", "."), (", ", "."), (";", ".")]
)
def test_a_comma_is_the_decimal_point_where_something_else_parts_the_columns(tmp_path, parted, point):
    rows = np.random.default_rng(4).normal(0, 100, (9, 6)).round(6)
    lines = ["x y z rx ry rz".replace(" ", parted)]
    lines += [parted.join(str(value).replace(".", point) for value in row) for row in rows]
    (tmp_path / "p.csv").write_text("\n".join(lines) + "\n")
    assert np.array_equal(read_pose_rows(tmp_path / "p.csv"), rows)


def test_measured_views_of_a_part_give_the_camera_and_those_of_a_plane_are_refused(real_data, tmp_path, capsys):
    folder = real_data("reghec")
    said = ["--unit", "m", "--rotation", "xyz", "--angles", "rad", "--rotation-first", "--target", "part"]
    codes = {}
    for name in ("Duck", "Plane"):
        views = [str(folder / name / f"view{k}d.pcd") for k in range(1, 10)]
        words = [str(folder / name / "RobotPoses.dat"), *views, *said, "-o", str(tmp_path / name)]
        codes[name] = main(["hand-eye", *words])
    told = capsys.readouterr().err
    assert codes == {"Duck": 0, "Plane": 2}
    assert told.count("translation along") == 2
    report = json.loads((tmp_path / "Duck" / "report.json").read_text())
    assert report["rms_mm"] < 1.4
    assert report["pairs_disagreement_mm"] < 0.05
    assert report["pairs_refused"] == {}


@pytest.mark.full
def test_a_measured_sphere_and_a_measured_part_agree_within_what_both_say(real_data, tmp_path, capsys):
    """The sphere's own answer is known to several mm only, the part's to about one: errors of the arm that near poses
    share count in both, and the command says so."""
    folder = real_data("reghec")
    said = ["--unit", "m", "--rotation", "xyz", "--angles", "rad", "--rotation-first"]
    found, sigma = {}, {}
    for name, target in (("Sphere", "sphere:96.752"), ("Duck", "part")):
        views = [str(folder / name / f"view{k}d.pcd") for k in range(1, 10)]
        words = [str(folder / name / "RobotPoses.dat"), *views, *said, "--target", target, "-o", str(tmp_path / name)]
        assert main(["hand-eye", *words]) == 0
        assert "known poorly" in capsys.readouterr().err
        written = json.loads((tmp_path / name / "hand_eye.json").read_text())
        found[name], sigma[name] = (np.array(written[key]) for key in ("T_flange_camera", "covariance"))
        assert "poorly_known" in written
    sphere, duck = found["Sphere"], found["Duck"]
    turned = Rotation.from_matrix(duck[:3, :3] @ sphere[:3, :3].T).as_rotvec()
    apart = np.concatenate([duck[:3, 3] - sphere[:3, 3], turned])
    assert apart @ np.linalg.solve(sigma["Sphere"] + sigma["Duck"], apart) < 16.8  # chi squared of six, 99 %
    assert np.sqrt(np.diag(sigma["Duck"])[:3].max()) < 0.2 * np.sqrt(np.diag(sigma["Sphere"])[:3].max())


@pytest.mark.full
def test_measured_views_of_a_part_carry_the_measured_sphere_with_them(real_data):
    """The arm stood in the same poses before both: what the part's views say of the camera's motion, no arm needed,
    brings nine centres of the sphere together."""
    folder = real_data("reghec")
    views = {
        name: [finite_points(read_cloud(folder / name / f"view{k}d.pcd", "m"), name) for k in range(1, 10)]
        for name in ("Sphere", "Duck")
    }
    streams = np.random.default_rng(0).spawn(9)
    centres = [
        cut_out_sphere(one, 96.752, rng, "v").centre_mm for one, rng in zip(views["Sphere"], streams, strict=True)
    ]
    poses = register_views(views["Duck"]).T_part_view
    places = np.array([move_points(pose, centre) for pose, centre in zip(poses, centres, strict=True)])
    assert np.sqrt(((places - places.mean(axis=0)) ** 2).sum(axis=1).mean()) < 0.2  # 0.10; the arm's own 1.05 mm
