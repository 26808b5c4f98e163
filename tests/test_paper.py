"""The printed numbers are complete, agree with each other where the papers say so, and are checked when loaded."""

import hashlib

import numpy as np
import pandas as pd
import pytest

from grindvision import paper
from grindvision.errors import FileError, InputError
from grindvision.geometry import check_rigid


@pytest.fixture
def damaged(tmp_path, monkeypatch):
    """A copy of the printed data in which one file may be damaged."""
    import shutil

    folder = tmp_path / "data"
    shutil.copytree(paper.data_folder(), folder)
    monkeypatch.setenv("GRINDVISION_DATA", str(folder))
    return folder / "paper"


@pytest.mark.parametrize("name", list(paper.TABLES))
def test_every_printed_table_loads_and_is_numeric(name):
    key, numbers = paper.TABLES[name]
    table = paper.table(name)
    assert list(table.columns) == [key, *numbers]
    assert np.isfinite(table[list(numbers)].to_numpy(dtype=float)).all()


def test_printed_errors_of_table_1_are_height_minus_target():
    table = paper.table("diao2018_table1")
    error = np.abs(table["measured_height_mm"] - paper.headline("target_height"))
    np.testing.assert_allclose(error, table["absolute_error_mm"], atol=1e-9)
    assert round(error.mean(), 4) == paper.headline("height_mean_absolute_error")


def test_printed_means_of_the_second_papers_table_2_follow_from_its_tests():
    table = paper.table("peng2020_table2")
    mean = table.filter(like="test").mean(axis=1)
    np.testing.assert_allclose(mean, table["mean_percent"], atol=0.0051)


@pytest.mark.parametrize("matrix", ["coarse", "accurate"])
def test_printed_hand_eye_matrices_are_rigid_to_the_rounding_of_print(matrix):
    printed = paper.hand_eye(matrix, as_printed=True)
    check_rigid(printed, matrix, tolerance=2e-4)
    rigid = check_rigid(paper.hand_eye(matrix), matrix, tolerance=1e-12)
    assert np.abs(rigid - printed).max() < 1e-4


def test_corrections_of_table_2_are_in_radians_and_millimetres():
    corrections = paper.mdh_corrections()
    assert corrections.shape == (4, 5)
    assert np.abs(corrections[:, [0, 3, 4]]).max() == pytest.approx(np.radians(0.0088))
    assert corrections[0, 2] == -3.1596


def test_every_expected_number_has_a_tolerance_a_reason_and_a_chapter():
    expected = paper.expected()
    assert (expected["tolerance"] >= 0).all()
    bound = np.where((expected["claim"] == "at least") & expected["paper"].isna(), -1, 1)
    wider = bound * expected["tolerance_fast"] >= bound * expected["tolerance"]
    assert wider[expected["unit"] != "pairs"].all(), "fast may be wider, never narrower, but for a count out of fewer"
    assert expected["reason"].str.len().gt(10).all()
    assert expected["chapter"].str.fullmatch(r"\d\d").all()
    assert set(expected["evidence"]) <= set(paper.EVIDENCE) and set(expected["claim"]) <= set(paper.CLAIMS)


def test_nominal_values_are_those_of_the_papers():
    expected = paper.expected()
    given = expected[expected["nominal"].notna()].groupby("item")["nominal"].unique().to_dict()
    assert given == {"table1": [paper.headline("target_height")], "table2": [0.0]}


def test_expected_values_are_those_of_the_printed_tables():
    expected = paper.expected().set_index(["item", "quantity"])["paper"]
    for position, height in paper.table("diao2018_table1")[["position", "measured_height_mm"]].itertuples(index=False):
        assert expected["table1", f"height at {position}"] == height
    for quantity in ("mean", "largest", "standard deviation"):
        row = {value for (item, name), value in expected.items() if item == "fig05" and name.startswith(quantity)}
        key = {"mean": "sphere_mean_absolute_error", "largest": "sphere_max_error"}.get(quantity, "sphere_error_std")
        assert row == {paper.headline(key)}


def test_unknown_names_list_the_known_ones():
    with pytest.raises(InputError, match="diao2018_table1"):
        paper.table("table9")
    with pytest.raises(InputError, match="coarse, accurate"):
        paper.hand_eye("fine")
    with pytest.raises(InputError, match="compound_error"):
        paper.headline("speed")


def test_damaged_expected_values_are_refused(damaged):
    path = damaged / "expected.csv"
    text = path.read_text()
    path.write_text(text.replace(",0.0277,", ",small,", 1))
    with pytest.raises(FileError, match="'small' is not a number"):
        paper.expected()
    for good, bad, complaint in (
        (",ours on a twin,", ",ours,", "'ours' is none of print alone"),
        (",at most,", ",below,", "none of"),
    ):
        path.write_text(text.replace(good, bad, 1))
        with pytest.raises(FileError, match=complaint):
            paper.expected()
    path.write_text(text.replace(",at most,,", ",equal,,", 1))
    with pytest.raises(FileError, match="needs a printed value"):
        paper.expected()
    lines = text.splitlines()
    path.write_text("\n".join([*lines, lines[1]]))
    with pytest.raises(FileError, match="repeats table1 / height at P1"):
        paper.expected()


def test_a_missing_data_folder_is_named(monkeypatch, tmp_path):
    monkeypatch.setenv("GRINDVISION_DATA", str(tmp_path / "none"))
    with pytest.raises(FileError, match="GRINDVISION_DATA must name"):
        paper.expected()


#: What a row of expected.csv promises; the words around it may change without a new signature.
PROMISES = ["item", "quantity", "evidence", "claim", "paper", "nominal", "tolerance", "tolerance_fast"]


def signature(path):
    """Hash of a printed table's text, and of what expected.csv promises."""
    if path.name != "expected.csv":
        return hashlib.sha256(path.read_text(encoding="utf-8").encode()).hexdigest()
    rows = pd.read_csv(path, dtype=str, keep_default_na=False)[PROMISES]
    return hashlib.sha256("\n".join(",".join(row) for row in rows.itertuples(index=False)).encode()).hexdigest()


def test_every_printed_digit_and_every_tolerance_is_signed_off():
    """A changed file is compared with the paper again, a changed tolerance gets its reason: then sign in the list."""
    folder = paper.data_folder() / "paper"
    signed = pd.read_csv(folder / "signed_off.csv", dtype=str)
    files = sorted(path for path in folder.glob("*.csv") if path.name != "signed_off.csv")
    assert [path.name for path in files] == sorted(signed["file"])
    found = {path.name: signature(path) for path in files}
    assert found == dict(zip(signed["file"], signed["sha256"], strict=True))
    assert signed["date"].str.fullmatch(r"\d{4}-\d\d-\d\d").all() and signed["why"].str.len().gt(10).all()


@pytest.mark.parametrize("name", ["diao2018_table3.csv", "expected.csv"])
def test_one_digit_more_or_less_is_noticed(damaged, name):
    before = signature(damaged / name)
    text = (damaged / name).read_text(encoding="utf-8")
    at = max(text.rfind(digit) for digit in "12345678") if name != "expected.csv" else text.index("0.1,") + 2
    changed = text[:at] + str(9 - int(text[at])) + text[at + 1 :]
    (damaged / name).write_text(changed, encoding="utf-8")
    assert signature(damaged / name) != before
