"""Views joined in the base frame by the camera's calibration, and scanner's poses from the controller's."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from grindvision.calibration.pose_conventions import convention
from grindvision.cli import main
from grindvision.cli.camera_pose import Camera, camera_content, read_camera, scanner_pose
from grindvision.clouds import read_cloud, write_ply
from grindvision.errors import DegenerateError, FileError, InputError, UnitError
from grindvision.files import write_json
from grindvision.geometry import inverse, move_points, rigid
from grindvision.vision.registration.meeting import merge
from grindvision.vision.registration.view_fit import fit_views
from tests.hand_eye_scene import TARGET, X, looking_poses, part_view

N = 4


def scene(seed=0, mounted="on-arm"):
    """The flange's poses and views of a part that rests at TARGET (on the flange at TARGET)."""
    rng = np.random.default_rng(seed)
    carrier = looking_poses(rng, N)
    clouds = [part_view(rigid(None, -TARGET) @ pose @ X, rng) for pose in carrier]
    return (carrier if mounted == "on-arm" else inverse(carrier)), clouds


def fanuc(poses):
    return np.hstack([poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_euler("xyz", degrees=True)])


def folder_of(folder, mounted="on-arm", camera=X):
    poses, clouds = scene(0, mounted)
    for row, cloud in enumerate(clouds):
        write_ply(folder / f"v{row}.ply", cloud)
    np.savetxt(folder / "poses.txt", fanuc(poses), fmt="%.9f")
    write_json(folder / "camera.json", camera_content(camera, mounted, convention("fanuc")))
    views = [str(folder / f"v{row}.ply") for row in range(N)]
    return [str(folder / "poses.txt"), *views, "--hand-eye", str(folder / "camera.json")]


def test_views_at_their_true_poses_meet_and_others_by_what_they_are_off():
    poses, clouds = scene()
    meeting = merge(clouds, poses @ X)
    assert meeting.overall_mm < 0.1
    off = rigid(None, [0, 0, 2.0])
    pushed = np.array([off @ pose if row == 2 else pose for row, pose in enumerate(poses @ X)])
    moved = merge(clouds, pushed)
    assert 2 in moved.worst
    assert moved.pair_mm[moved.worst] == pytest.approx(1.8, abs=0.3)
    assert np.isnan(np.diag(moved.pair_mm)).all() and len(moved.alone) == 0
    world = rigid(Rotation.from_rotvec([0.2, 1.0, -0.4]).as_matrix(), [500, -300, 20])
    assert merge(clouds, world @ poses @ X).overall_mm == pytest.approx(meeting.overall_mm, abs=1e-6)


def test_views_are_fitted_to_each_other_and_stay_where_the_arm_puts_them_in_the_mean():
    poses, clouds = scene()
    rng = np.random.default_rng(1)
    turns = Rotation.from_rotvec(np.radians(0.03) * rng.normal(size=(N, 3))).as_matrix()
    erring = np.array([rigid(turn, 0.3 * rng.normal(size=3)) for turn in turns]) @ poses @ X
    before = merge(clouds, erring)
    fitted = fit_views(clouds, erring, before)
    assert fitted.meeting.overall_mm < 0.3 * before.overall_mm
    motions = fitted.T_common_view @ inverse(erring)
    moved = np.array([move_points(one, TARGET) - TARGET for one in motions])
    assert np.linalg.norm(moved.mean(axis=0)) < 0.25 * np.linalg.norm(moved, axis=1).mean()
    between = inverse(fitted.T_common_view[0]) @ fitted.T_common_view
    true = inverse(poses[0] @ X) @ poses @ X
    off = [np.linalg.norm(move_points(one @ inverse(other), clouds[0]) - clouds[0], axis=1).max()
           for one, other in zip(between, true, strict=True)]  # fmt: skip
    assert max(off) < 0.1
    assert fit_views(clouds, poses @ X, replace(before, overall_mm=0.0)) is None


def test_where_the_surfaces_hold_no_motion_the_arm_decides():
    rng = np.random.default_rng(2)
    flat = np.column_stack([rng.uniform(-60, 60, (4000, 2)), np.zeros(4000)])
    clouds = [flat + [0, 0, 400] + 0.02 * rng.normal(size=flat.shape) for _ in range(3)]
    posed = np.array([rigid(None, shift) for shift in ([0, 0, 0.0], [2.0, 0, 0.4], [0, 1.0, -0.4])])
    fitted = fit_views(clouds, posed, merge(clouds, posed))
    assert np.abs(np.ptp(fitted.T_common_view[:, 2, 3])) < 0.02
    assert np.abs(fitted.T_common_view[:, :2, 3] - posed[:, :2, 3]).max() < 0.1


def test_views_that_meet_nowhere_are_refused():
    _, clouds = scene()
    apart = np.array([rigid(None, [1000.0 * row, 0, 0]) for row in range(N)])
    with pytest.raises(DegenerateError, match="no two views overlap"):
        merge(clouds, apart)


@pytest.mark.parametrize(("mounted", "frame"), [("on-arm", "base"), ("fixed", "flange")])
def test_the_command_joins_the_views_where_the_part_is(tmp_path, mounted, frame):
    words = folder_of(tmp_path, mounted)
    assert main(["merge", *words, "-o", str(tmp_path / "part")]) == 0
    report = json.loads((tmp_path / "part" / "report.json").read_text())
    assert report["frame"] == frame
    assert report["meeting_mm"]["median"] < 0.1
    written = read_cloud(tmp_path / "part" / "merged.ply", "mm")
    joined = written.points
    assert written.normals is not None
    assert np.abs(np.linalg.norm(written.normals, axis=1) - 1).max() < 1e-5
    at = np.repeat(np.array(report[f"T_{frame}_camera"])[:, :3, 3], 4000, axis=0)
    assert ((at - joined) * written.normals).sum(axis=1).min() > 0
    assert len(joined) == report["points"] == N * 4000
    assert np.abs(joined[:, :2].mean(axis=0) - TARGET[:2]).max() < 1.0
    assert joined[:, 2].min() == pytest.approx(TARGET[2], abs=0.3)


@pytest.mark.usefixtures("blank_pictures")
def test_a_view_whose_pose_is_wrong_is_named(tmp_path, capsys):
    words = folder_of(tmp_path)
    rows = np.loadtxt(tmp_path / "poses.txt")
    rows[1, 2] += 6.0
    np.savetxt(tmp_path / "poses.txt", rows, fmt="%.9f")
    assert main(["merge", *words, "-o", str(tmp_path / "part")]) == 0
    told = capsys.readouterr()
    assert "v1.ply" in told.out.split("worst pair")[1].split("within")[0]


@pytest.mark.usefixtures("blank_pictures")
def test_the_report_repeats_what_was_said_of_the_camera_before_the_run(tmp_path, capsys):
    words = folder_of(tmp_path)
    camera = json.loads((tmp_path / "camera.json").read_text())
    (tmp_path / "camera.json").write_text(json.dumps(camera | {"poorly_known": "the camera is known poorly"}))
    for name in ("first", "second"):
        assert main(["merge", *words, "-o", str(tmp_path / name)]) == 0
        assert capsys.readouterr().err.count("known poorly") == 1
        said = json.loads((tmp_path / name / "report.json").read_text())["warnings"]
        assert sum("known poorly" in one for one in said) == 1
    (tmp_path / "camera.json").write_text(json.dumps(camera))
    assert main(["merge", *words, "-o", str(tmp_path / "third")]) == 0
    assert json.loads((tmp_path / "third" / "report.json").read_text())["warnings"] == []


def test_what_cannot_be_merged_is_refused_in_one_line(tmp_path, capsys):
    words = folder_of(tmp_path)
    (tmp_path / "other.json").write_text('{"T_joint_scanner": 1}')
    np.savetxt(tmp_path / "metres.txt", np.loadtxt(tmp_path / "poses.txt") * [1e-3, 1e-3, 1e-3, 1, 1, 1])
    refused = {
        "4 poses and 3 clouds": [words[0], *words[1:4], *words[5:]],
        "one cloud or row twice": [words[0], words[1], *words[1:4], *words[5:]],
        "metres": [str(tmp_path / "metres.txt"), *words[1:]],
        "one of `calibrate`": [*words[:-1], str(tmp_path / "other.json")],
        "say --rotation too": [*words, "--angles", "deg"],
    }
    for said, given in refused.items():
        assert main(["merge", *given, "-o", str(tmp_path / "part")]) == 2
        error = capsys.readouterr().err
        assert said in error and error.count("\n") == 1
        assert not (tmp_path / "part").exists()


def options(folder, pose=None, **more):
    given = {"scanner_pose": None, "hand_eye": str(folder / "camera.json"), "robot_pose": pose}
    given |= {"rotation": None, "angles": None, "pose_unit": None, "rotation_first": False, "inverse_poses": False}
    return SimpleNamespace(**(given | more))


def test_the_scanner_s_pose_follows_from_the_controller_s(tmp_path):
    poses, _ = scene()
    write_json(tmp_path / "camera.json", camera_content(X, "on-arm", convention("fanuc")))
    (row,) = fanuc(poses[:1])
    found = np.array(scanner_pose(options(tmp_path, list(row))))
    assert np.abs(found - poses[0] @ X).max() < 1e-9
    vector = [*poses[0][:3, 3] / 1000, *Rotation.from_matrix(poses[0][:3, :3]).as_rotvec()]
    found = np.array(scanner_pose(options(tmp_path, vector, rotation="ur", pose_unit="m")))
    assert np.abs(found - poses[0] @ X).max() < 1e-9
    assert scanner_pose(options(tmp_path, hand_eye=None)) is None


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({}, "give --robot-pose"),
        ({"pose": [1.0, 2.0, 3.0]}, "3 numbers"),
        ({"pose": [0.4, 0.1, 0.3, 0.0, 90.0, 0.0]}, "metres"),
        ({"pose": [400.0, 0, 300, 1, 0, 0, 0]}, "7 numbers a row"),
        ({"pose": [400.0, 0, 300, 0, 0, 0], "scanner_pose": "pose.json"}, "leave one out"),
        ({"pose": [400.0, 0, 300, 0, 0, 0], "hand_eye": None}, "needs --hand-eye"),
    ],
)
def test_a_pose_that_cannot_be_is_refused(tmp_path, change, said):
    write_json(tmp_path / "camera.json", camera_content(X, "on-arm", convention("fanuc")))
    with pytest.raises((InputError, UnitError), match=said):
        scanner_pose(options(tmp_path, **change))


def test_a_fixed_camera_needs_no_pose_of_the_robot(tmp_path):
    write_json(tmp_path / "camera.json", camera_content(X, "fixed", None))
    assert np.abs(np.array(scanner_pose(options(tmp_path))) - X).max() < 1e-12
    with pytest.raises(InputError, match="no pose moves it"):
        scanner_pose(options(tmp_path, [1.0] * 6))


def test_hand_eye_files_are_read_as_written_and_damaged_ones_refused(tmp_path):
    path = tmp_path / "camera.json"
    write_json(path, camera_content(X, "on-arm", convention("kuka")))
    read = read_camera(path)
    assert isinstance(read, Camera) and read.mounted == "on-arm" and read.convention == convention("kuka")
    path.write_text(json.dumps({"T_flange_camera": X.tolist(), "pose_convention": {"axes": 1}}))
    with pytest.raises(FileError, match="damaged"):
        read_camera(path)


def test_views_of_a_real_part_meet_with_the_sphere_s_calibration(real_data, tmp_path):
    folder = real_data("reghec")
    said = ["--unit", "m", "--rotation", "xyz", "--angles", "rad", "--rotation-first"]
    views = {name: [str(folder / name / f"view{k}d.pcd") for k in range(1, 10)] for name in ("Sphere", "David")}
    poses = {name: str(folder / name / "RobotPoses.dat") for name in views}
    sphere = ["hand-eye", poses["Sphere"], *views["Sphere"], *said, "--target", "sphere:96.752"]
    assert main([*sphere, "-o", str(tmp_path / "camera")]) == 0
    words = ["merge", poses["David"], *views["David"], "--unit", "m"]
    words += ["--hand-eye", str(tmp_path / "camera" / "hand_eye.json"), "-o", str(tmp_path / "part")]
    assert main(words) == 0
    report = json.loads((tmp_path / "part" / "report.json").read_text())
    assert report["meeting_mm"]["median"] <= 1.0
