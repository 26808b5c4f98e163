"""A cloud in a robot's base frame, whose origin stands where no scanner did: its normals tell the side."""

import json

import numpy as np
import pytest

from grindvision import write_ply
from grindvision.cli import main
from grindvision.cli.facing import FACES_CAMERA
from grindvision.geometry import inverse, move_points, rigid
from tests.grinding_scene import arc_bead, pair

pytestmark = pytest.mark.usefixtures("blank_pictures")

T_BASE_PART = rigid(None, (50.0, 20.0, 400.0))
"""The plate lies over the arm's foot, seen from above."""


@pytest.fixture(scope="module")
def clouds():
    found = pair(2, n_points=15_000, beads=(arc_bead(),))
    T_sample_part = found.T_sample_test @ found.T_test_part
    places = (found.sample, T_sample_part), (found.test, found.T_test_part)
    return [move_points(T_BASE_PART @ inverse(pose), points) for points, pose in places]


def detected(clouds, folder, normal, comment):
    """What `detect` writes of clouds whose normals are all one, with a comment in their header."""
    paths = [folder / "good.ply", folder / "test.ply"]
    for path, points in zip(paths, clouds, strict=True):
        write_ply(path, points, np.tile(normal, (len(points), 1)), comment)
    code = main(["detect", *map(str, paths), "-o", str(folder / "out"), "--unit", "mm"])
    path = np.loadtxt(folder / "out" / "path.csv", delimiter=",", skiprows=1, ndmin=2)
    report = json.loads((folder / "out" / "report.json").read_text(encoding="utf-8"))
    return code, path, " ".join(report["warnings"])


def test_normals_that_merge_turned_to_its_cameras_tell_the_side(clouds, tmp_path):
    code, path, _ = detected(clouds, tmp_path, [0.0, 0.0, 1.0], FACES_CAMERA)
    assert code == 0 and len(path) == 6 and (path[:, 6] > 0.9).all()


def test_normals_of_other_software_that_face_away_from_the_origin_are_told(clouds, tmp_path):
    """The origin is believed, as estimated normals have any sign; but not silently: the bead passes for a pit."""
    _, _, told = detected(clouds, tmp_path, [0.0, 0.0, 1.0], "")
    assert "face away from the origin" in told and "--test-viewpoint" in told
    assert "face away" not in detected(clouds, tmp_path, [0.0, 0.0, -1.0], "")[2]


def test_where_nothing_else_tells_the_side_normals_do(clouds, tmp_path):
    """The origin lies in the middle of the plate: no scanner stood there."""
    middle = np.mean(clouds[0], axis=0)
    code, path, told = detected([one - middle for one in clouds], tmp_path, [0.0, 0.0, 1.0], "")
    assert code == 0 and (path[:, 6] > 0.9).all() and "face away" not in told
