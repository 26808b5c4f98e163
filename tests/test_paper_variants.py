"""The papers' own methods: how far boxes are from the print, and the table that sets them beside ours."""

import numpy as np
import pandas as pd
import pytest
from scipy.spatial import ConvexHull

from grindvision import paper
from grindvision.vision.change.oriented_box import minimal_box
from grindvision_book.chapter_00 import VARIANTS, paper_variants
from grindvision_book.chapter_06.boxes import misses
from grindvision_book.machinery.answers import judged


def test_misses_are_zero_for_the_print_itself_and_do_not_mind_the_direction():
    printed = paper.path_points(3)
    for points, normals in (printed, (printed[0][::-1], printed[1][::-1])):
        found = misses(printed, points, normals)
        assert found.nearest_mm.max() < 0.005 and found.one_to_one_mm.max() == 0 and found.normals_deg.max() < 1e-5
    shifted = misses(printed, printed[0] + [0.0, 0.0, 2.0], -printed[1])
    np.testing.assert_allclose(shifted.one_to_one_mm, 2.0)
    np.testing.assert_allclose(shifted.normals_deg, 180.0)
    assert (shifted.nearest_mm <= 2.0 + 1e-9).all() and shifted.nearest_mm.min() > 0


def test_the_minimal_box_is_the_least_of_all_faces(rng):
    for _ in range(5):
        points = rng.normal(size=(60, 3)) * [8.0, 3.0, 1.0]
        hull = ConvexHull(points)
        least = np.inf
        for normal in hull.equations[:, :3]:
            across = np.linalg.svd(normal[None])[2][1:]
            flat = (points @ across.T)[ConvexHull(points @ across.T).vertices]
            for edge in np.diff(np.vstack([flat, flat[:1]]), axis=0):
                turn = np.array([edge, [-edge[1], edge[0]]]) / np.linalg.norm(edge)
                least = min(least, np.prod(np.ptp(flat @ turn.T, axis=0)) * np.ptp(points @ normal))
        assert np.prod(minimal_box(points).size_mm) == pytest.approx(least, rel=1e-9)


def test_every_row_of_the_variants_is_there_and_shows_what_was_answered():
    expected = paper.expected()
    answers = expected[["item", "quantity"]].assign(rebuilt=np.arange(len(expected)) + 1.0)
    table = paper_variants(judged(answers.assign(kind="synthetic", figure="", settings="full")))
    assert len(table) == len(VARIANTS) and table[["paper_method", "ours"]].notna().all(axis=None)
    given = answers.set_index(["item", "quantity"])["rebuilt"]
    row = table.set_index("what").loc["Figure 5, mean error"]
    assert row["printed"] == 0.154 and row["ours"] == given["fig05", "mean error after accurate calibration"]
    assert row["paper_method"] == given["fig05", "mean error after accurate calibration, Eq 18"]
    six = [given["table3", f"printed point {k} to rebuilt path"] for k in range(1, 7)]
    assert table.set_index("what").loc["Tables 3 and 4, points to path", "ours"] == max(six)
    none = paper_variants(judged(pd.DataFrame(columns=["item", "quantity", "rebuilt", "kind", "figure", "settings"])))
    assert none[["paper_method", "ours"]].isna().all(axis=None)
