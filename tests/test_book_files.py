"""Rebuilt files against committed ones: what agrees, what is replaced, what is kept, and the list of what there is."""

import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from grindvision.errors import FileError
from grindvision_book.machinery.agreement import TOLERANCES, differences, disagreements, tolerance
from grindvision_book.machinery.answers import write_scoreboard
from grindvision_book.machinery.committed import committed_figures
from grindvision_book.machinery.contents import listed, missing_or_unlisted, stray
from grindvision_book.machinery.places import FIGURES
from grindvision_book.machinery.publishing import publish, told

SVG = "<svg><dc:description>{}</dc:description></svg>"


def unit(csv: str, drawing: str = "drawn here", caption: str = "Base frame, mm; 12 of 20") -> dict[str, bytes]:
    text = SVG.format(caption) + drawing
    return {"fig.svg": text.encode(), "fig.png": drawing.encode(), "fig.csv": csv.encode()}


COMMITTED = unit("name,x_mm,y_deg,points,z\na,100.0,30.5,7,0.25\nb,,1e-07,2,3\n", "drawn there")


# --- agreement


@pytest.mark.parametrize(
    "csv",
    [
        "name,x_mm,y_deg,points,z\na,100.00009,30.5,7,0.25\nb,,1e-07,2,3\n",
        "name,x_mm,y_deg,points,z\na,99.9,30.5,7,0.25\nb,,1e-07,2,3\n",  # one unit in the last digit written
        "name,x_mm,y_deg,points,z\na,100.0,30.50009,7,0.25001\nb,,0.0,2,3\n",
    ],
)
def test_values_within_their_tolerance_and_other_pixels_agree(csv):
    assert differences(unit(csv), COMMITTED) == []


@pytest.mark.parametrize(
    "csv, complaint",
    [
        (
            "name,x_mm,y_deg,points,z\na,100.3,30.5,7,0.25\nb,,1e-07,2,3\n",
            "column x_mm: 1 of 2 values differ, first 100.3",
        ),
        ("name,x_mm,y_deg,points,z\na,100.0,30.5003,7,0.25\nb,,1e-07,2,3\n", "column y_deg"),
        ("name,x_mm,y_deg,points,z\na,100.0,30.5,8,0.25\nb,,1e-07,2,3\n", "column points"),
        ("name,x_mm,y_deg,points,z\na,100.0,30.5,7,0.25\nb,0,1e-07,2,3\n", "column x_mm"),
        ("name,x_mm,y_deg,points,z\nc,100.0,30.5,7,0.25\nb,,1e-07,2,3\n", "column name"),
        ("name,x_mm,y_deg,points,z\na,100.0,30.5,7,0.25\n", "1 rows; committed 2"),
        ("name,x_mm,y_rad,points,z\na,100.0,30.5,7,0.25\nb,,1e-07,2,3\n", "columns name, x_mm, y_rad"),
    ],
)
def test_other_values_texts_rows_or_columns_are_told(csv, complaint):
    (line,) = differences(unit(csv), COMMITTED)
    assert line.startswith("fig.csv") and complaint in line


@pytest.mark.parametrize(
    "caption, same",
    [("Base frame, mm; 12 of 21", False), ("Scanner frame, mm; 12 of 20", False), ("Base frame, mm; 12 of 20", True)],
)
def test_a_caption_is_compared_by_its_words(caption, same):
    changed = unit(COMMITTED["fig.csv"].decode(), caption=caption)
    assert (differences(changed, COMMITTED) == []) == same


def test_a_rounded_number_in_a_caption_may_fall_either_way():
    one, other = (unit("x_mm\n1\n", caption=f"rms {value} mm") for value in ("0.25", "0.26"))
    assert differences(one, other) == []
    assert differences(one, unit("x_mm\n1\n", caption="rms 0.28 mm")) != []


def test_files_that_only_one_side_has_are_told():
    lines = disagreements({**COMMITTED, "new.md": b"table"}, {**COMMITTED, "old.csv": b"x\n1\n"})
    assert lines == ["new.md: made, but not committed", "old.csv: committed, but not made"]


def test_a_table_with_a_column_of_units_is_compared_row_by_row():
    def table(length, percent, seconds):
        return {"t.csv": f"what,unit,ours,turn_deg\na,mm,{length},1\nb,%,{percent},1\nc,s,{seconds},1\n".encode()}

    assert differences(table(1.00000001, 98.0000001, 0.50000001), table(1.00009, 98.009, 0.5000009)) == []
    for change in ((1.0003, 98.0, 0.5), (1.0, 98.03, 0.5), (1.0, 98.0, 0.5001)):
        assert len(differences(table(*change), table(1.00000001, 98.0000001, 0.50000001))) == 1


def test_an_answer_is_compared_in_its_own_unit():
    head = "item,quantity,rebuilt,kind,figure,settings\n"
    mm, share = (
        "table1,mean absolute error,{},synthetic,,full\n",
        'peng_table2,"overlap on the line, ours",{},synthetic,,full\n',
    )

    def answers(a: float, b: float) -> dict[str, bytes]:
        return {"answers_02.csv": (head + mm.format(a) + share.format(b)).encode()}

    assert differences(answers(0.02000001, 98.00001), answers(0.0200500, 98.00901)) == []
    assert len(differences(answers(0.02000001, 98.00001), answers(0.0202500, 98.00901))) == 1


def test_every_column_has_a_tolerance_and_every_exception_a_reason():
    lines = TOLERANCES.read_text(encoding="utf-8").splitlines()
    assert all(len(line.split(",")) == 5 and len(line.split(",")[4]) > 5 for line in lines)
    assert lines[-1].startswith("*,*,")
    exceptions = [line.split(",")[:2] for line in lines[1:] if not line.startswith("*")]
    for file, column in exceptions:
        assert column in (FIGURES / f"{file}.csv").read_text(encoding="utf-8").splitlines()[0].split(","), file
    assert tolerance("any", "x_mm") == (1e-4, 1e-6) and tolerance("any", "points") == (0, 0)


def test_the_committed_scoreboard_follows_from_the_committed_answers(tmp_path):
    committed = committed_figures().files
    for name, content in committed.items():
        (tmp_path / name).write_bytes(content)
    write_scoreboard(tmp_path)
    for name in ("scoreboard.csv", "scoreboard.md"):
        assert (tmp_path / name).read_bytes() == committed[name], "stale: ./run book --only 00"


# --- publishing


@pytest.fixture
def folders(tmp_path) -> tuple[Path, Path, Path]:
    """Folders of rebuilt, published and put-aside files; published is as committed."""
    made, figures, aside = tmp_path / "made", tmp_path / "figures", tmp_path / "aside"
    for folder in (made, figures):
        folder.mkdir()
    write(figures, COMMITTED)
    return made, figures, aside


def write(folder: Path, files: dict[str, bytes]) -> None:
    for name, content in files.items():
        (folder / name).write_bytes(content)


def read(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_what_agrees_stays_as_committed_to_the_byte(folders):
    made, figures, aside = folders
    write(made, unit(COMMITTED["fig.csv"].decode().replace("100.0", "100.00001")))
    (done,) = publish(made, figures, COMMITTED, aside)
    assert done.action == "kept" and read(figures) == COMMITTED
    assert told([done], "the commit") == ["1 of 1 figures, tables and sets of answers agree with the commit"]


def test_what_says_something_else_is_replaced_as_a_whole(folders):
    made, figures, aside = folders
    new = unit(COMMITTED["fig.csv"].decode().replace("100.0", "101.0")) | {"fig.gif": b"moves"}
    write(made, new)
    write(figures, {"fig.md": b"once a table"})
    old = {**COMMITTED, "fig.md": b"once a table"}
    (done,) = publish(made, figures, old, aside)
    assert done.action == "replaced" and read(figures) == new
    said = told([done], "the commit")
    assert "first 101.0 (committed 100.0)" in said[0] and said[1].startswith("0 of 1 figures")
    assert told(publish(made, figures, old, aside), "the commit") == said  # and so once more, until it is committed


def test_a_file_that_is_missing_or_of_an_earlier_build_becomes_as_committed_again(folders):
    made, figures, aside = folders
    write(made, unit(COMMITTED["fig.csv"].decode().replace("100.0", "101.0")))
    publish(made, figures, COMMITTED, aside)
    (figures / "fig.png").unlink()
    write(made, unit(COMMITTED["fig.csv"].decode()))
    (done,) = publish(made, figures, COMMITTED, aside)
    assert (done.action, done.aside) == ("restored", ()) and read(figures) == COMMITTED
    assert [path.name for path in aside.iterdir()] == ["written.json"]


def test_an_edit_of_somebody_is_put_aside_and_told(folders):
    made, figures, aside = folders
    write(made, unit(COMMITTED["fig.csv"].decode()))
    (figures / "fig.svg").write_text("mine")
    (done,) = publish(made, figures, COMMITTED, aside)
    assert done.action == "restored" and read(figures) == COMMITTED
    assert (aside / "fig.svg").read_text() == "mine" and str(aside / "fig.svg") in str(done)


def test_redraw_replaces_what_agrees_and_new_files_are_written(folders):
    made, figures, aside = folders
    new = unit(COMMITTED["fig.csv"].decode(), "drawn in another colour") | {"more.csv": b"x_mm\n1\n"}
    write(made, new)
    assert [done.action for done in publish(made, figures, COMMITTED, aside, redraw=True)] == ["replaced", "new"]
    assert read(figures) == new


def test_a_damaged_list_of_what_was_written_costs_nothing(folders):
    made, figures, aside = folders
    aside.mkdir()
    (aside / "written.json").write_text("{")
    write(made, unit(COMMITTED["fig.csv"].decode()))
    assert publish(made, figures, COMMITTED, aside)[0].action == "kept"


# --- the commit


def git(folder: Path, *words: str) -> None:
    given = ["-c", "user.name=t", "-c", "user.email=t@t", "-c", "commit.gpgsign=false"]
    subprocess.run(["git", *given, *words], cwd=folder, check=True, capture_output=True)


def test_the_commit_is_read_whatever_stands_in_the_folder(tmp_path):
    (tmp_path / "figures").mkdir()
    write(tmp_path / "figures", COMMITTED)
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-qm", "figures")
    (tmp_path / "figures" / "fig.csv").write_text("x_mm\n5\n")
    git(tmp_path, "add", ".")
    (tmp_path / "figures" / "fig.svg").unlink()
    found = committed_figures(tmp_path / "figures", tmp_path, tmp_path / "unpacked.tar")
    assert found.files == COMMITTED and found.origin == "the commit"
    assert not (tmp_path / "unpacked.tar").exists()


def test_without_git_the_figures_of_before_the_first_build_count(tmp_path):
    (tmp_path / "figures").mkdir()
    write(tmp_path / "figures", COMMITTED)
    places = tmp_path / "figures", tmp_path, tmp_path / "unpacked.tar"
    first = committed_figures(*places)
    assert first.files == COMMITTED and "before the first build" in first.origin
    (tmp_path / "figures" / "fig.csv").write_text("x_mm\n5\n")
    assert committed_figures(*places).files == COMMITTED
    (tmp_path / "unpacked.tar").write_bytes(b"torn")
    with pytest.raises(FileError, match=r"unpacked\.tar: damaged"):
        committed_figures(*places)


# --- the list


def test_every_committed_file_is_listed_and_every_listed_one_committed():
    for there in (committed_figures().files, [path.name for path in FIGURES.iterdir()]):
        assert stray(there) == [], "neither a chapter, nor the scoreboard, nor a race makes these: remove or list them"
        assert [name for name in listed() if name not in there] == []


def test_a_stale_file_is_named():
    assert stray([*listed(), "fig06_old.svg", "bench_icp.csv", "scoreboard.md"]) == ["fig06_old.svg"]


def test_a_chapter_that_makes_other_files_than_its_own_is_told():
    own = [name for name, chapter in listed().items() if chapter == "05"]
    assert missing_or_unlisted("05", own) == ""
    assert missing_or_unlisted("05", [*own, "extra.csv"]) == "makes extra.csv, which contents.csv does not list"
    assert "does not make" in missing_or_unlisted("05", own[1:])


def test_no_chapter_commits_seconds_of_its_own():
    quoted = {"peng_table1.csv"}  # printed seconds, and those of the committed race
    for name in listed():
        if name.endswith(".csv") and name not in quoted:
            columns = (FIGURES / name).read_text(encoding="utf-8").splitlines()[0].split(",")
            assert not [column for column in columns if column.endswith("_s")], name


def test_table_one_takes_its_seconds_from_the_committed_race(tmp_path):
    from grindvision_book.chapter_11.times import RACE, raced_table

    table = raced_table()
    assert list(table["piece"]) == ["line", "curve", "box", "cylinder"]
    assert (table[["paper_s", "paper_variant_s", "ours_s"]] > 0).all(axis=None)
    text = RACE.read_text(encoding="utf-8")
    (tmp_path / "race.csv").write_text("\n".join(line for line in text.splitlines() if not line.startswith("box")))
    with pytest.raises(FileError, match="no row of grindvision on the box"):
        raced_table(tmp_path / "race.csv")


def test_a_build_loads_no_grammar_of_addresses_and_leaves_it_to_others():
    """It takes longer to load than everything else that reads a notebook."""
    code = (
        "import sys; from importlib.util import find_spec; from grindvision_book.machinery import kernels, reading;"
        "import nbclient, nbconvert; assert 'nbformat' in sys.modules and 'rfc3987_syntax' not in sys.modules;"
        "print(find_spec('rfc3987_syntax') is not None)"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    assert run.stdout.strip() == str(find_spec("rfc3987_syntax") is not None)
