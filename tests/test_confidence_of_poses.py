"""The reliability of chapter 05: shares by confidence with intervals that hold, and rows that can be measured again."""

import numpy as np
import pandas as pd
import pytest

pytest.importorskip("open3d", reason="needs the extra sim")
pytest.importorskip("manifold3d", reason="needs the extra sim")

from grindvision_book.chapter_05.confidence import case, committed_rows, draw, pairs, reliability, warned_of


def rows_of(confidence, right):
    return pd.DataFrame({"confidence": confidence, "right": right, "refused": ""})


def test_confidence_that_means_what_it_says_lies_within_the_intervals(rng):
    held = 0
    for _ in range(40):
        confidence = rng.uniform(0.5, 1.0, 200)
        table = reliability(rows_of(confidence, rng.uniform(size=200) < confidence))
        inside = (table["low_percent"] <= 100 * table["mean_confidence"]) & (
            100 * table["mean_confidence"] <= table["high_percent"]
        )
        held += int(inside.sum())
        assert table["answers"].sum() == 200
    assert held >= 0.92 * 3 * 40


def test_overstated_confidence_lies_outside_them(rng):
    table = reliability(rows_of(np.full(60, 0.95), rng.uniform(size=60) < 0.6))
    assert table.loc[1, "answers"] == 60 and table.loc[1, "high_percent"] < 95


def test_refused_pairs_count_for_no_bin():
    rows = pd.DataFrame({"confidence": [0.95, np.nan], "right": [True, False], "refused": ["", "ambiguous"]})
    table = reliability(rows)
    assert table["answers"].tolist() == [0, 1, 0] and np.isnan(table.loc[0, "right_percent"])


def test_the_standard_deviation_is_read_from_the_warning():
    assert warned_of(["the pose is known to 2.4 mm only (one standard deviation), along ...", "else"]) == 2.4
    assert warned_of(["else"]) == 0


def test_every_row_has_an_answer_or_a_refusal_and_the_figure_draws_them():
    rows = committed_rows()
    assert set(rows["pair"]) <= set(pairs(100)) and len(rows) > 30
    answered = rows["refused"] == ""
    assert rows.loc[answered, ["confidence", "pose_mm"]].notna().all().all()
    assert rows.loc[~answered, "confidence"].isna().all()
    assert (rows.loc[answered, "confidence"] >= 0.5).all()  # less is refused
    figure = draw(reliability(rows))
    assert len(figure.axes[0].lines) > 2


@pytest.mark.parametrize("pair", [7, 17])
def test_rows_are_as_measured_again(pair):
    there = committed_rows().set_index("pair").loc[pair]
    again = case(pair)
    assert again["kind"] == there["kind"] and again["refused"] == there["refused"]
    assert again["confidence"] == pytest.approx(there["confidence"], abs=0.02)
    assert again["pose_mm"] == pytest.approx(there["pose_mm"], abs=0.05)
