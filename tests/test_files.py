"""Files are read checked and written whole or not at all."""

import json

import numpy as np
import pytest

from grindvision.errors import FileError
from grindvision.files import column_names, read_json, read_table, sha256, write_json, write_text, write_whole


def test_an_interrupted_write_leaves_the_old_file_and_no_other(tmp_path):
    target = tmp_path / "report.txt"
    write_text(target, "old")
    with pytest.raises(KeyboardInterrupt), write_whole(target) as temporary:
        temporary.write_text("half")
        raise KeyboardInterrupt
    assert target.read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["report.txt"]


def test_writing_below_a_file_is_one_clear_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(FileError, match=r"cannot write .*choose a folder"):
        write_text(tmp_path / "file" / "report.txt", "x")


def test_json_holds_plain_numbers_and_null_for_nan(tmp_path):
    write_json(
        tmp_path / "a.json", {"T": np.eye(2), "sd": float("nan"), "n": np.int64(3), "row": np.array([1.0, np.nan])}
    )
    assert json.loads((tmp_path / "a.json").read_text()) == {
        "T": [[1.0, 0.0], [0.0, 1.0]],
        "sd": None,
        "n": 3,
        "row": [1.0, None],
    }


def test_the_digest_of_a_known_text(tmp_path):
    (tmp_path / "abc").write_bytes(b"abc")
    assert sha256(tmp_path / "abc") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "not a readable CSV"),
        ("x_mm\n", "no rows"),
        ("y_mm\n1\n", "column x_mm missing; found y_mm"),
        ("x_mm\n1\nfar\n", "row 2, column x_mm: 'far' is not a finite number"),
        ("x_mm,y\n1,1\nnan,1\n", "is not a finite number"),
        ("x_mm\ninf\n", "is not a finite number"),
    ],
)
def test_a_damaged_table_is_refused_with_its_place(tmp_path, content, message):
    path = tmp_path / "table.csv"
    path.write_text(content)
    with pytest.raises(FileError, match=message) as caught:
        read_table(path, ["x_mm"])
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_table_and_a_binary_one_are_named(tmp_path):
    with pytest.raises(FileError, match="no such file"):
        read_table(tmp_path / "none.csv", ["x_mm"])
    (tmp_path / "binary.csv").write_bytes(bytes(range(256)))
    with pytest.raises(FileError):
        read_table(tmp_path / "binary.csv", ["x_mm"])


def test_columns_are_found_by_name_and_converted_by_unit(tmp_path):
    path = tmp_path / "table.csv"
    path.write_text('\ufeff# exported\n"q1_deg", "x_m" , "own y"\n180, 0.5, 3\n"90",1, 4\n')
    table = read_table(path, ["q1_rad", "x_mm", "y_mm"], columns={"y_mm": "own y"})
    assert table["q1_rad"].tolist() == pytest.approx([np.pi, np.pi / 2])
    assert table["x_mm"].tolist() == [500, 1000]
    assert table["y_mm"].tolist() == [3, 4]
    assert read_table(path, ["z_mm"], columns={"z_mm": "x_m + own y"})["z_mm"].tolist() == [3.5, 5]
    with pytest.raises(FileError, match="column far missing; found q1_deg, x_m, own y"):
        read_table(path, ["z_mm"], columns={"z_mm": "far"})


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("x_mm,y\n1,2,3\n", "more columns than the first line names"),
        ("x_mm,x_mm\n1,2\n", "column x_mm stands in the first line 2 times"),
        ("x_deg,y\n1,2\n", "column x_mm missing"),
        ('x_mm\n"1,5"\n', "'1,5' is not a finite number"),
    ],
)
def test_a_table_that_would_be_misread_is_refused(tmp_path, content, message):
    (tmp_path / "table.csv").write_text(content)
    with pytest.raises(FileError, match=message):
        read_table(tmp_path / "table.csv", ["x_mm"])


@pytest.mark.parametrize("content", ["", "{", "[" * 100_000, "\x00", " " * 1_000_001])
def test_json_that_is_none_is_refused(tmp_path, content):
    (tmp_path / "a.json").write_text(content)
    with pytest.raises(FileError, match="JSON"):
        read_json(tmp_path / "a.json")


@pytest.mark.parametrize("gap", [";", "\t", " "])
def test_decimal_commas_where_something_else_parts_the_columns(tmp_path, gap):
    (tmp_path / "table.csv").write_text(f"x_mm{gap}y_mm{gap}n\n1,5{gap}2.25{gap}a\n-3,25{gap}1e-2{gap}b,c\n")
    table = read_table(tmp_path / "table.csv", ["x_mm", "y_mm"], ["n"])
    assert table["x_mm"].tolist() == [1.5, -3.25] and table["y_mm"].tolist() == [2.25, 0.01]
    assert table["n"].tolist() == ["a", "b,c"]


def test_a_table_reads_alike_whatever_parts_its_columns(tmp_path, rng):
    """Commas, semicolons, tabs, one blank or many, ragged like a printed table: the same numbers and names."""
    numbers, names = rng.normal(size=(7, 3)) * 10.0 ** rng.integers(-3, 4, (7, 3)), ["x_mm", "own y", "z_mm"]
    tables, ours = {}, ["x_mm", "y_mm", "z_mm"]
    for name, gap in (("comma", ","), ("semicolon", ";"), ("tab", "\t"), ("blank", " "), ("blanks", "   ")):
        lines = [gap.join(f'"{word}"' if " " in word else word for word in names)]
        lines += [gap.join(map(repr, row)) for row in numbers.tolist()]
        (tmp_path / name).write_text("# exported\n" + "\n".join(lines) + "\n")
        tables[name] = read_table(tmp_path / name, ours, columns={"y_mm": "own y"})
    ragged = [" ".join(f"{value!r:>{9 + 3 * column}}" for column, value in enumerate(row)) for row in numbers.tolist()]
    (tmp_path / "ragged").write_text('  x_mm "own y"      z_mm\n' + "\n".join(f"{line}  " for line in ragged) + "\n")
    tables["ragged"] = read_table(tmp_path / "ragged", ours, columns={"y_mm": "own y"})
    for table in tables.values():
        assert list(table.columns) == [*names, "y_mm"]
        np.testing.assert_allclose(table[ours].to_numpy(), numbers, rtol=1e-14)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("x_mm y_mm\n1 2\n3\n", "row 2, column y_mm: an empty cell is not a finite number"),
        ("x_mm y_mm\n1 2 3\n", "more columns than the first line names"),
        ("x mm y mm\n1 2\n", "column mm stands in the first line 2 times"),
        ("1.0 2.0\n3.0 4.0\n", "the first line holds numbers; write the columns' names above it"),
        ("# x_mm y_mm\n1,2\n3,4\n", "the first line holds numbers; write the columns' names above it"),
        ("x_mm y_mm\n1 far\n", "row 1, column y_mm: 'far' is not a finite number"),
    ],
)
def test_a_table_parted_by_blanks_is_refused_with_its_place(tmp_path, content, message):
    (tmp_path / "table.txt").write_text(content)
    with pytest.raises(FileError, match=message):
        read_table(tmp_path / "table.txt", ["x_mm", "y_mm"])


def test_a_table_of_a_hundred_thousand_columns_is_refused_at_once(tmp_path):
    """It kept a command busy for minutes."""
    (tmp_path / "a.csv").write_text(",".join(f"c{k}" for k in range(100_000)) + "\n" + ",".join("1" * 100_000) + "\n")
    with pytest.raises(FileError, match="100,000 columns"):
        column_names(tmp_path / "a.csv")
