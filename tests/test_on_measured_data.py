"""Chapter 13: its judges, on data whose truth is known; and that nothing committed is touched without the data."""

import ast
import json
import os

import nbformat
import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

import grindvision_book as book
from grindvision.arm import forward, read_arm
from grindvision.calibration import Measurements
from grindvision.data_files import data_folder
from grindvision.errors import FileError
from grindvision.geometry import inverse, move_points, random_rotation, rigid
from grindvision.measured import measured_sets
from grindvision.paper import expected
from grindvision_book.chapter_13 import arms, judged_rows, scans, sets_here, sphere, twin, views
from grindvision_book.machinery.contents import listed
from grindvision_book.machinery.places import NOTEBOOKS
from grindvision_book.machinery.rebuilding import rebuild
from grindvision_book.machinery.session import UNPUBLISHED


def test_angle_and_pitch_of_a_motion_do_not_depend_on_where_the_camera_sits(rng):
    for _ in range(20):
        motion, camera = (rigid(random_rotation(rng), rng.normal(0, 200, 3)) for _ in range(2))
        np.testing.assert_allclose(views.screw(inverse(camera) @ motion @ camera), views.screw(motion), atol=1e-9)
    assert views.screw(np.eye(4)) == (0.0, 0.0)
    assert views.screw(rigid(Rotation.from_rotvec([0, 0, 0.5]).as_matrix(), [3, 4, 7])) == pytest.approx(
        (np.degrees(0.5), 7.0)
    )


def test_scipys_fit_of_base_and_tool_finds_a_planted_one(rng):
    arm = read_arm(data_folder() / "robots" / "ur5.csv")
    q = rng.uniform(-2, 2, (60, 6))
    base, tool = rigid(random_rotation(rng), [100, -50, 20]), np.array([5.0, -3.0, 80.0])
    seen = move_points(base, np.array([move_points(T, tool) for T in forward(arm, q)]))
    train = np.arange(60) < 40
    made = arms.TrackedArm(arm, Measurements(q, np.zeros((60, 3)), seen, train=train))
    assert arms.scipy_mean_mm(made) < 1e-6
    off = arms.TrackedArm(arm, Measurements(q, np.zeros((60, 3)), seen + rng.normal(0, 0.1, seen.shape), train=train))
    assert 0.1 < arms.scipy_mean_mm(off) < 0.25


def test_scipys_radius_is_that_of_a_known_cap(rng):
    rays = rng.normal(size=(400, 3))
    rays[:, 2] = -np.abs(rays[:, 2])
    cap = [10, 20, 400] + 48.4 * rays / np.linalg.norm(rays, axis=1)[:, None]
    assert sphere.scipy_radius_mm(cap) == pytest.approx(48.4, abs=1e-6)


def test_noise_and_waviness_are_told_apart(rng):
    points = np.column_stack([rng.uniform(0, 100, (20_000, 2)), np.zeros(20_000)])
    white = rng.normal(0, 0.03, len(points))
    wavy = 0.1 * np.sqrt(2) * np.sin(points[:, 0] * 2 * np.pi / 60)
    noise = twin.noise_and_waviness(points, white)
    assert noise["noise_mm"] == pytest.approx(0.03, rel=0.1) and noise["waviness_mm"] < 0.005
    both = twin.noise_and_waviness(points, white + wavy)
    assert both["noise_mm"] == pytest.approx(0.03, rel=0.2) and both["waviness_mm"] == pytest.approx(0.1, rel=0.1)


def test_a_published_pose_is_read_as_its_file_means_it(tmp_path):
    turn = Rotation.from_rotvec([0.1, -0.4, 0.2])
    numbers = " ".join(str(value) for value in (0.01, 0.02, -0.03, *turn.as_quat()))
    (tmp_path / "x.conf").write_text(f"camera 0 0 0 0 0 0 1\nbmesh a.ply 0 0 0 0 0 0 1\nbmesh b.ply {numbers}\n")
    pose = scans.published_pose(tmp_path / "x.conf", "b.ply")
    np.testing.assert_allclose(pose, rigid(turn.as_matrix().T, [10, 20, -30]), atol=1e-12)
    with pytest.raises(FileError, match=r"no pose of c.ply"):
        scans.published_pose(tmp_path / "x.conf", "c.ply")


def test_distance_between_poses(rng):
    true = rigid(random_rotation(rng), [1, 2, 3])
    points = rng.normal(0, 50, (30, 3))
    turned = true @ rigid(Rotation.from_rotvec([0, 0, np.radians(2)]).as_matrix(), [0, 0, 0.5])
    off = scans.away_from(turned, true, points - points.mean(axis=0))
    assert off["off_deg"] == pytest.approx(2) and off["off_mm"] == pytest.approx(0.5)


# --- without the data


@pytest.fixture
def nothing_here(tmp_path, monkeypatch):
    monkeypatch.setenv("GRINDVISION_DATA", str(tmp_path))
    monkeypatch.setenv("GRINDVISION_FIGURES", str(tmp_path / "made"))
    monkeypatch.setattr("grindvision.measured.user_cache", lambda: None)


def test_what_is_not_here_is_named_and_its_rows_say_so(nothing_here, tmp_path):
    book.start("13")
    sets = sets_here()
    assert sets.absent == list(measured_sets()) and "ur5" not in sets
    assert all(name in sets.box() for name in measured_sets()) and "grindvision data" in sets.box()
    assert "ur5" in (tmp_path / "made" / UNPUBLISHED).read_text()
    rows = judged_rows(sets)
    assert len(rows) == (expected()["chapter"] == "13").sum() >= 15 and set(rows["verdict"]) == {"data not here"}


def test_a_chapter_may_leave_what_is_committed_alone(tmp_path, monkeypatch):
    cells = ['import grindvision_book as book\nbook.start("13")', 'book.leave_as_committed("the data are not here")']
    cells += ['import pandas as pd\nbook.save_table(pd.DataFrame({"x_mm": [1.0]}), "measured_arms", "Made up")']
    for folder, code in (("first", cells[:1] + cells[2:]), ("again", cells)):
        (tmp_path / folder).mkdir()
        notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(text) for text in code])
        notebook.metadata.kernelspec = {"name": "python3", "display_name": "Python 3", "language": "python"}
        nbformat.write(notebook, tmp_path / folder / "13_data.ipynb")
    places = {"build": tmp_path / "build", "figures": tmp_path / "figures", "fast": True}
    (first,) = rebuild(notebooks=tmp_path / "first", **places)
    assert first.failure == "" and first.left == ""
    (tmp_path / "figures" / "measured_arms.csv").write_text("x_mm\n2.0\n")
    for _ in range(2):
        (again,) = rebuild(notebooks=tmp_path / "again", **places)
        assert again.failure == "" and again.left == "the data are not here"
        assert "stay as committed: the data are not here" in str(again)
        assert (tmp_path / "figures" / "measured_arms.csv").read_text() == "x_mm\n2.0\n"
    assert again.kept


def test_every_row_of_the_chapter_is_answered_in_its_notebook():
    cells = json.loads((NOTEBOOKS / "13_on_data_that_others_measured.ipynb").read_text(encoding="utf-8"))["cells"]
    code = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
    strings = [node.value for node in ast.walk(ast.parse(code)) if isinstance(node, ast.Constant)]
    rows = expected()
    mine = rows[rows["chapter"] == "13"]
    assert set(mine["evidence"]) == {"measured"} and len(mine) >= 15
    assert set(mine["item"]) == set(measured_sets())
    assert [quantity for quantity in mine["quantity"] if quantity not in strings] == []
    assert [name for name, chapter in listed().items() if chapter == "13" and "measured" not in name] == [
        "answers_13.csv"
    ]


def test_a_run_without_the_data_ends_well(nothing_here, tmp_path):
    """The notebook itself, cell by cell, but for the twin, which needs no data."""
    cells = json.loads((NOTEBOOKS / "13_on_data_that_others_measured.ipynb").read_text(encoding="utf-8"))["cells"]
    names: dict[str, object] = {}
    for cell in cells:
        source = "".join(cell["source"])
        if cell["cell_type"] == "code" and "twin." not in source and "measured_sets" not in source:
            exec(source, names)
    assert isinstance(names["results"], pd.DataFrame) and set(names["results"]["verdict"]) == {"data not here"}
    assert os.listdir(tmp_path / "made") == [UNPUBLISHED]
