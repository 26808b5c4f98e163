"""The engineer's chapter: what is measured of a scan, slices across a path, and a run on files of one's own."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from grindvision.clouds import write_ply
from grindvision.errors import InputError
from grindvision.geometry import move_points, random_rotation, rigid, rotate_vectors
from grindvision.vision.seam.groove_diagnostics import MIN_BOTH_SIDES
from grindvision_book import chapter_12
from grindvision_book.machinery.places import NOTEBOOKS
from tests.grinding_scene import arc_bead, pair
from tests.groove_scenes import cloud, grid


def test_files_are_all_given_or_all_simulated(tmp_path):
    simulated = chapter_12.source("grinding", {"A": "", "B": ""}, ["a.ply", "b.ply"], tmp_path, 3)
    assert simulated.synthetic and simulated.origin == "synthetic (seed 3)"
    assert simulated.files == (tmp_path / "grinding_3" / "a.ply", tmp_path / "grinding_3" / "b.ply")
    own = chapter_12.source("grinding", {"A": "x.ply", "B": "y.ply"}, ["a.ply", "b.ply"], tmp_path, 3)
    assert not own.synthetic and own.origin == "your own" and own.files == (Path("x.ply"), Path("y.ply"))
    with pytest.raises(InputError, match=r"grinding: A is given, B is empty"):
        chapter_12.source("grinding", {"A": "x.ply", "B": ""}, ["a.ply", "b.ply"], tmp_path, 3)


@pytest.mark.parametrize(("spacing_mm", "noise_mm"), [(0.7, 0.1), (0.4, 0.02)])
@pytest.mark.parametrize("unit", ["mm", "m"])
def test_size_spacing_and_noise_are_those_of_the_scan(tmp_path, rng, spacing_mm, noise_mm, unit):
    places = grid(spacing_mm=spacing_mm)
    points = cloud(places, 0 * places[:, 0], rng, noise_mm)
    write_ply(tmp_path / "plate.ply", points / (1000 if unit == "m" else 1))
    facts = chapter_12.cloud_facts(tmp_path / "plate.ply", unit)
    assert facts["points"] == len(points)
    assert facts["spacing_mm"] == pytest.approx(spacing_mm, rel=0.06)
    assert facts["noise_mm"] == pytest.approx(noise_mm, rel=0.1)
    np.testing.assert_allclose([facts["x_mm"], facts["y_mm"]], np.ptp(places, axis=0), rtol=1e-4)


def test_a_slice_is_the_same_in_every_frame(rng):
    points = rng.uniform(-20, 20, (5000, 3))
    at, along, up = rng.uniform(-3, 3, 3), np.array([1.0, 0.2, 0.1]), np.array([0.0, 0.0, 1.0])
    cut = chapter_12.slice_across(points, at, along, up, 10, 4)
    assert 50 < len(cut) < 1000 and cut.abs().to_numpy().max() <= 10
    T = rigid(random_rotation(rng), (5.0, 6.0, 7.0))
    vectors = (rotate_vectors(T, along), rotate_vectors(T, up))
    moved = chapter_12.slice_across(move_points(T, points), move_points(T, at), *vectors, 10, 4)
    np.testing.assert_allclose(moved, cut, atol=1e-9)


def test_a_profile_is_the_median_height():
    across = np.repeat(np.arange(-3, 4), 5) + np.tile([-0.2, -0.1, 0, 0.1, 0.2], 7)
    heights = np.repeat(np.arange(7.0), 5) + np.tile([-9, 0, 0, 0, 9], 7)
    curve = chapter_12.profile(pd.DataFrame({"across_mm": across, "height_mm": heights}), 1.0)
    assert curve["across_mm"].tolist() == list(range(-3, 4)) and curve["height_mm"].tolist() == list(range(7))


def test_a_weak_result_is_doubted():
    good = {
        "confidence": 0.9,
        "fitness": 0.9,
        "rmse": 0.05,
        "level_of_detection_mm": 0.1,
        "beads": [{"height_mm": 1.5}],
    }
    assert set(chapter_12.judge_detection(good, 0.04)["verdict"]) == {"well"}
    weak = good | {"confidence": 0.2, "fitness": 0.3, "rmse": 0.5, "beads": [{"height_mm": 0.15}]}
    assert set(chapter_12.judge_detection(weak, 0.04)["verdict"]) == {"look"}


def test_the_table_doubts_a_groove_where_the_command_does():
    for edges_seen, verdict in ((MIN_BOTH_SIDES, "well"), (MIN_BOTH_SIDES - 0.01, "look")):
        groove = {"width_mm": 10.0, "depth_mm": 6.0, "length_mm": 120.0, "root_deviation_mm": 0.05}
        report = {"grooves": [groove | {"edges_seen": edges_seen}]}
        rows = chapter_12.judge_groove(report, 0.7, 0.1).set_index("quantity")["verdict"]
        assert rows.pop("share with both edges seen") == verdict
        assert set(rows) == {"well"}


@pytest.mark.book
def test_the_chapter_runs_on_files_of_ones_own(tmp_path):
    import papermill

    scene = pair(seed=11, n_points=40_000, beads=[arc_bead()])
    write_ply(tmp_path / "good.ply", scene.sample)
    write_ply(tmp_path / "test.ply", scene.test)
    (tmp_path / "pose.json").write_text(json.dumps(rigid(np.diag([1.0, -1, -1]), (450, 0, 500)).tolist()))
    given = {"SAMPLE_FILE": "good.ply", "TEST_FILE": "test.ply", "TEST_POSE_FILE": "pose.json", "PATH_POINTS": 4}
    done = papermill.execute_notebook(
        str(next(NOTEBOOKS.glob("12_*.ipynb"))),
        str(tmp_path / "mine.ipynb"),
        parameters={**given, "OUTPUT_FOLDER": str(tmp_path / "mine")},
        cwd=str(tmp_path),
        kernel_name="python3",
        progress_bar=False,
    )
    assert "Scans: your own" in str(done)
    assert len(pd.read_csv(tmp_path / "mine" / "ground" / "path_base.csv")) == 4
