"""Common mistakes of hand-eye data, one by one, with every target and either mounting: refused in one line that names
them, and nothing written."""

from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from grindvision.calibration import plate_search, sphere_search, sphere_triple
from grindvision.cli import main
from grindvision.clouds import write_ply
from grindvision.geometry import inverse, rigid, rotation_about
from grindvision.vision.registration import views
from tests.hand_eye_scene import (
    looking_poses,
    part_view,
    plate_view,
    seen_poses,
    sphere_view,
    three_spheres_view,
)

pytestmark = pytest.mark.usefixtures("blank_pictures")

N = 7
TARGETS = {
    "sphere": "sphere:38.1",
    "spheres": "spheres:38.1",
    "board": "board:160x110",
    "part": "part",
    "poses": "poses",
}


@cache
def scene(target):
    """Carrier's poses (N, 4, 4) and what the camera sees: clouds, or poses."""
    rng = np.random.default_rng(21)
    carrier = looking_poses(rng, N)
    seen = seen_poses(carrier, rng, arm_mm=0.1, arm_rad=3e-4) @ rigid(rotation_about([0, 0, 1], 0.7))
    draw = {
        "sphere": lambda pose: sphere_view(pose[:3, 3], 19.05, rng, 500),
        "spheres": lambda pose: three_spheres_view(pose, rng)[0],
        "board": lambda pose: plate_view(pose, rng, n=5000),
        "part": lambda pose: part_view(inverse(pose), rng, 2000),
        "poses": lambda pose: pose,
    }[target]
    return carrier, [draw(pose) for pose in seen]


def numbers(poses, rotation="xyz", degrees=True):
    """Rows as a controller shows them."""
    turns = Rotation.from_matrix(poses[:, :3, :3])
    turned = turns.as_quat() if rotation == "xyzw" else turns.as_euler(rotation, degrees=degrees)
    return np.hstack([poses[:, :3, 3], turned])


def one_axis(poses):
    turned = [poses[0, :3, :3] @ rotation_about([0, 0, 1], angle) for angle in np.linspace(-0.6, 0.6, N)]
    return np.array([rigid(turn, pose[:3, 3]) for turn, pose in zip(turned, poses, strict=True)])


FANUC, ABB = ("--rotation", "fanuc"), ("--rotation", "abb")
SWAPPED = [0, 4, 2, 3, 1, 5, 6]
RADIANS = ("--rotation", "xyz", "--angles", "rad")
#: Mistake -> rows of the table, what the camera saw, words of the command, and what must be said.
MISTAKES = {
    "degrees for radians": lambda poses, seen: (numbers(poses), seen, RADIANS, "--angles deg"),
    "radians for degrees": lambda poses, seen: (numbers(poses, degrees=False), seen, FANUC, "--angles rad"),
    "metres for mm": lambda poses, seen: (numbers(poses) * np.repeat([1e-3, 1], 3), seen, FANUC, "--pose-unit m "),
    "order of a quaternion": lambda poses, seen: (numbers(poses, "xyzw"), seen, ABB, "quaternion-xyzw"),
    "order of Euler angles": lambda poses, seen: (numbers(poses, "ZYX"), seen, FANUC, "--rotation ZYX"),
    "inverse poses": lambda poses, seen: (numbers(inverse(poses)), seen, FANUC, "--inverse-poses"),
    "one cloud twice": lambda poses, seen: (numbers(poses), [*seen[:4], seen[1], *seen[5:]], FANUC, "row twice"),
    "two rows swapped": lambda poses, seen: (numbers(poses)[SWAPPED], seen, FANUC, "(rows 2 and 5) swapped"),
    "two poses": lambda poses, seen: (numbers(poses[:2]), seen[:2], FANUC, "needs at least"),
    "one axis": lambda poses, seen: (numbers(one_axis(poses)), seen, FANUC, "all motions turn about one axis"),
    "no turns": lambda poses, seen: (numbers(np.repeat(poses[:1], N, axis=0)), seen, FANUC, "the poses hardly turn"),
}  # fmt: skip

#: Every mistake with these targets, the mounting in turns; all the other cases are for the night.
EVERY_DAY = ("sphere", "board", "poses")
CASES = [
    pytest.param(
        mistake,
        target,
        mounted,
        marks=[] if (row + column + turn) % 2 == 0 and target in EVERY_DAY else pytest.mark.full,
    )
    for row, mistake in enumerate(MISTAKES)
    for column, target in enumerate(TARGETS)
    for turn, mounted in enumerate(("on-arm", "fixed"))
]


@pytest.fixture(scope="module", autouse=True)
def found_once():
    """The search for targets sees every cloud of a scene once; mistakes of the poses change none."""

    def kept(function):
        results = {}

        def found(*given):
            clouds = given[0] if isinstance(given[0], list) else [given[0]]
            key = tuple(np.asarray(cloud).tobytes() for cloud in clouds)
            if key not in results:
                results[key] = function(*given)
            return results[key]

        return found

    with pytest.MonkeyPatch.context() as patch:
        for module, name in (
            (sphere_search, "cut_out_sphere"),
            (sphere_triple, "find_three_spheres"),
            (plate_search, "find_plate"),
            (views, "register_views"),
        ):
            patch.setattr(module, name, kept(getattr(module, name)))
        yield


@pytest.mark.parametrize(("mistake", "target", "mounted"), CASES)
def test_a_mistake_is_named_in_one_line_and_nothing_is_written(mistake, target, mounted, tmp_path, capsys):
    carrier, seen = scene(target)
    rows, shown, words, said = MISTAKES[mistake](carrier if mounted == "on-arm" else inverse(carrier), seen)
    np.savetxt(tmp_path / "poses.txt", rows, fmt="%.9f")
    if target == "poses":
        vectors = [np.append(pose[:3, 3], Rotation.from_matrix(pose[:3, :3]).as_rotvec()) for pose in shown]
        np.savetxt(tmp_path / "seen.txt", vectors, fmt="%.9f")
        files, words = ["seen.txt"], (*words, "--target-rotation", "rotation-vector")
    else:
        files = [f"v{row}.ply" for row in range(len(shown))]
        for name, cloud in zip(files, shown, strict=True):
            write_ply(tmp_path / name, cloud)
    given = [str(tmp_path / name) for name in ("poses.txt", *files)]
    options = ["--target", TARGETS[target], "--mounted", mounted, *words]
    assert main(["hand-eye", *given, *options, "-o", str(tmp_path / "camera")]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1
    assert not (tmp_path / "camera").exists()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda poses: poses * np.repeat([1e-3, 1], 3), "--target-unit m "),
        (lambda poses: poses * np.repeat([1, 180 / np.pi], 3), "--target-angles deg"),
    ],
)
def test_another_reading_of_the_target_s_table_is_named(change, said, tmp_path, capsys):
    carrier, seen = scene("poses")
    np.savetxt(tmp_path / "poses.txt", numbers(carrier))
    vectors = [np.append(pose[:3, 3], Rotation.from_matrix(pose[:3, :3]).as_rotvec()) for pose in seen]
    np.savetxt(tmp_path / "seen.txt", change(np.array(vectors)))
    words = ["--target", "poses", *FANUC, "--target-rotation", "rotation-vector", "-o", str(tmp_path / "camera")]
    assert main(["hand-eye", str(tmp_path / "poses.txt"), str(tmp_path / "seen.txt"), *words]) == 2
    assert said in capsys.readouterr().err


def test_inverse_poses_of_the_target_are_one_of_the_readings_that_are_named(tmp_path, capsys):
    """Inverting either table fits alike, so the message must not send the user to one of them alone."""
    carrier, seen = scene("poses")
    np.savetxt(tmp_path / "poses.txt", numbers(carrier))
    turned = inverse(np.array(seen))
    vectors = [np.append(pose[:3, 3], Rotation.from_matrix(pose[:3, :3]).as_rotvec()) for pose in turned]
    np.savetxt(tmp_path / "seen.txt", vectors)
    words = ["--target", "poses", *FANUC, "--target-rotation", "rotation-vector", "-o", str(tmp_path / "camera")]
    assert main(["hand-eye", str(tmp_path / "poses.txt"), str(tmp_path / "seen.txt"), *words]) == 2
    error = capsys.readouterr().err
    assert "--inverse-poses" in error and "T_target_camera" in error and "--mounted" in error
