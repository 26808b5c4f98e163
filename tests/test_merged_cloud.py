"""A cloud that ``merge`` joined from several views is an input like any scan: ``detect`` and ``groove`` take it."""

import json

import numpy as np
import pytest
from scipy.spatial import cKDTree

from grindvision.calibration.pose_conventions import convention
from grindvision.cli import main
from grindvision.cli.camera_pose import camera_content
from grindvision.clouds import read_cloud, write_ply
from grindvision.files import write_json
from grindvision.geometry import inverse, move_points, rigid, rotation_about
from grindvision.vision.surface.facing_side import faces_with, viewpoint_by_normals
from tests.grinding_scene import arc_bead, plate_height
from tests.groove_scenes import vee
from tests.hand_eye_scene import TARGET, X, looking_poses
from tests.test_hand_eye import rows_of

pytestmark = pytest.mark.usefixtures("blank_pictures")

VIEWS, POINTS, NOISE_MM = 3, 14_000, 0.03


def merged(folder, name, height, T_base_part, rng):
    """The command's joined cloud of a part (``height`` over x and y), of which no view sees the whole."""
    poses = looking_poses(rng, VIEWS)
    files = []
    for row, pose in enumerate(poses):
        x, y = rng.uniform([[-100], [-70]], [[100], [70]], (2, POINTS))
        x, y = (one[np.abs(x - 40 * (row - 1)) < 70] for one in (x, y))
        part = np.column_stack([x, y, height(x, y) + NOISE_MM * rng.normal(size=len(x))])
        files.append(str(folder / f"{name}{row}.ply"))
        write_ply(files[-1], move_points(inverse(pose @ X) @ T_base_part, part))
    np.savetxt(folder / f"{name}.txt", rows_of(poses), fmt="%.9f")
    write_json(folder / "camera.json", camera_content(X, "on-arm", convention("fanuc")))
    words = ["merge", str(folder / f"{name}.txt"), *files, "--hand-eye", str(folder / "camera.json")]
    assert main([*words, "-o", str(folder / name)]) == 0
    return folder / name / "merged.ply"


def columns(path):
    table = np.genfromtxt(path, delimiter=",", names=True)
    return np.column_stack([table[name] for name in ("x_mm", "y_mm", "z_mm")])


def test_detect_finds_the_bead_on_merged_clouds(tmp_path):
    rng, bead = np.random.default_rng(0), arc_bead(width_mm=6.0)
    good_at = rigid(None, TARGET)
    test_at = rigid(rotation_about([0.1, 0.2, 1.0], 0.3), TARGET + [15.0, -10.0, 4.0])
    good = merged(tmp_path, "good", plate_height, good_at, rng)
    test = merged(tmp_path, "test", lambda x, y: plate_height(x, y) + bead.height(x, y), test_at, rng)
    assert main(["detect", str(good), str(test), "-o", str(tmp_path / "out")]) == 0
    off = (
        np.array(json.loads((tmp_path / "out" / "report.json").read_text())["T_sample_test"])
        @ test_at
        @ inverse(good_at)
    )
    assert np.abs(move_points(off, TARGET[None]) - TARGET).max() < 0.1
    found, _ = cKDTree(move_points(test_at, bead.ridge())).query(columns(tmp_path / "out" / "path.csv"))
    assert found.max() < 0.5


def test_groove_finds_the_seam_in_a_merged_cloud(tmp_path):
    cloud = merged(tmp_path, "seam", lambda x, y: vee(y), rigid(None, TARGET), np.random.default_rng(1))
    assert main(["groove", str(cloud), "-o", str(tmp_path / "out")]) == 0
    root = columns(tmp_path / "out" / "trajectory.csv") - TARGET
    assert np.abs(root[:, 1]).max() < 0.5 and np.abs(root[:, 2] + 6).max() < 0.5
    assert np.ptp(root[:, 0]) > 150
    labels = np.load(tmp_path / "out" / "labels.npy")
    assert len(labels) == len(read_cloud(cloud, "mm").points)


def test_normals_of_the_file_tell_the_side_where_nothing_else_does(tmp_path, capsys):
    """A corner that opens downwards: without a word the side that looks up is taken."""
    rng, n = np.random.default_rng(2), 4000
    along, across = rng.uniform(-80, 80, 2 * n), rng.uniform(0, 60, 2 * n)
    first = np.arange(2 * n) < n
    corner = np.column_stack([along, np.where(first, across, 0.0), np.where(first, 0.0, -across)])
    normals = np.where(first[:, None], [0.0, 0, -1], [0.0, 1, 0])
    points = corner + TARGET + NOISE_MM * rng.normal(size=corner.shape)
    for name, given, sign in (("without", None, -1), ("with", normals, 1), ("away", -normals, -1)):
        write_ply(tmp_path / f"{name}.ply", points, given)
        assert main(["groove", str(tmp_path / f"{name}.ply"), "-o", str(tmp_path / name)]) == 0
        assumed = "from which side" in capsys.readouterr().err
        table = np.genfromtxt(tmp_path / name / "trajectory.csv", delimiter=",", names=True)
        assert assumed == (given is None)
        assert sign * np.mean(table["ny"] - table["nz"]) > 1.2
        if name == "with":
            assert np.abs(columns(tmp_path / name / "trajectory.csv")[:, 1:] - TARGET[1:]).max() < 0.5


def test_a_side_is_told_only_by_normals_that_one_place_faces():
    rng = np.random.default_rng(3)
    rays = rng.normal(size=(2000, 3))
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    cap = rays[rays[:, 0] > 0.2]
    seen = viewpoint_by_normals(500 + 40 * cap, cap)
    assert seen is not None
    assert ((seen - (500 + 40 * cap)) * cap).sum(axis=1).min() > 0 and seen[0] > 1000
    assert viewpoint_by_normals(500 + 40 * rays, rays) is None
    assert viewpoint_by_normals(500 + 40 * cap, cap * rng.choice([-1.0, 1.0], (len(cap), 1))) is None
    assert faces_with(cap, cap, cap[:20], cap[:20]) == 1.0 and faces_with(cap, cap, cap[:20], -cap[:20]) == 0.0
