"""The book's machinery: what it saves, how it judges, what it runs and what it refuses."""

import atexit
import base64
import json
import os
import re
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import joblib
import matplotlib.pyplot as plt
import nbformat
import numpy as np
import pandas as pd
import pytest
from jupyter_client.asynchronous.client import AsyncKernelClient
from matplotlib.figure import Figure
from nbclient import NotebookClient
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook

import grindvision_book as book
from grindvision import cli, paper
from grindvision.errors import FileError, GrindvisionWarning, InputError
from grindvision_book.machinery.answers import judged, summary, write_scoreboard
from grindvision_book.machinery.chapters import chosen
from grindvision_book.machinery.evidence import VERDICTS, count_by_class, trivial_answers_pass, verdict
from grindvision_book.machinery.kernels import kernel_environment
from grindvision_book.machinery.rebuilding import rebuild

EXPECTED, EVIDENCE = paper.expected(), paper.EVIDENCE
FIRST = EXPECTED.iloc[0]


@pytest.fixture
def figures(tmp_path, monkeypatch) -> Path:
    """A started chapter (the one that answers the first expected row) that writes to a folder of its own."""
    monkeypatch.setenv("GRINDVISION_FIGURES", str(tmp_path / "figures"))
    monkeypatch.setenv("GRINDVISION_FAST", "0")
    book.start(FIRST["chapter"])
    return tmp_path / "figures"


def drawn() -> tuple[Figure, pd.DataFrame]:
    data = pd.DataFrame({"x_mm": np.linspace(0, 1, 7), "y_mm": np.linspace(0, 1, 7) ** 2})
    fig, axes = plt.subplots()
    axes.plot(data["x_mm"], data["y_mm"], label="$y = x^2$")
    axes.fill_between(data["x_mm"], data["y_mm"], alpha=0.2)
    axes.legend()
    return fig, data


def notebook(path: Path, *cells: str) -> None:
    content = new_notebook(cells=[new_markdown_cell("# A chapter"), *map(new_code_cell, cells)])
    content.metadata["kernelspec"] = {"name": "python3", "display_name": "Python 3", "language": "python"}
    path.parent.mkdir(parents=True, exist_ok=True)
    nbformat.write(content, path)


def answers(value: float, setting: str = "full") -> pd.DataFrame:
    return pd.DataFrame(
        [[FIRST["item"], FIRST["quantity"], value, "synthetic", "fig", setting]],
        columns=["item", "quantity", "rebuilt", "kind", "figure", "settings"],
    )


# --- figures and tables


def test_a_figure_saved_twice_is_the_same_byte_for_byte(figures):
    contents, open_before = [], plt.get_fignums()
    for _ in range(2):
        fig, data = drawn()
        book.save_figure(fig, "parabola", data, "Scanner frame, mm; synthetic")
        contents.append({path.name: path.read_bytes() for path in figures.iterdir()})
    assert set(contents[0]) == {"parabola.svg", "parabola.png", "parabola.csv"}
    assert contents[0] == contents[1]
    assert plt.get_fignums() == open_before


def test_a_warning_in_a_chapter_names_no_place_on_this_machine(figures, monkeypatch):
    monkeypatch.setattr(warnings, "formatwarning", warnings.formatwarning)
    book.start("03")
    with pytest.warns(GrindvisionWarning) as seen:
        warnings.warn("the sample shows nothing there", GrindvisionWarning, stacklevel=1)
    shown = warnings.formatwarning(seen[0].message, seen[0].category, seen[0].filename, seen[0].lineno)
    assert shown == "GrindvisionWarning: the sample shows nothing there\n"


def test_the_csv_holds_what_is_drawn_and_the_svg_its_caption(figures):
    fig, data = drawn()
    book.save_figure(fig, "parabola", data, "Scanner frame, mm; synthetic, seed 4")
    np.testing.assert_allclose(pd.read_csv(figures / "parabola.csv"), data, rtol=1e-6)
    assert "Scanner frame, mm; synthetic, seed 4" in (figures / "parabola.svg").read_text()


@pytest.mark.parametrize("live", [True, False])
def test_a_live_notebook_gets_a_figure_no_wider_than_its_cell_and_a_page_the_drawing(figures, monkeypatch, live):
    from IPython import display

    shown: list = []
    monkeypatch.setattr("grindvision_book.machinery.figures.is_live", lambda: live)
    monkeypatch.setattr("grindvision_book.machinery.figures.shown_in", lambda: display)
    monkeypatch.setattr("IPython.display.display", lambda *things: shown.extend(things))
    fig, data = drawn()
    book.save_figure(fig, "parabola", data, 'Scanner frame, mm; "synthetic"')
    picture, caption = shown
    assert caption.data == '*Scanner frame, mm; "synthetic"*'
    if live:
        assert "max-width: 100%" in picture.data and "&quot;synthetic&quot;" in picture.data
        [encoded] = re.findall(r"data:image/svg\+xml;base64,([^']+)'", picture.data)
        assert base64.b64decode(encoded) == (figures / "parabola.svg").read_bytes()
    else:
        assert isinstance(picture, display.SVG)


def test_a_scene_is_saved_cropped_as_the_same_three_files(figures):
    import pyvista

    plotter = pyvista.Plotter(off_screen=True, window_size=(300, 200))
    plotter.add_mesh(pyvista.Cube(), color=book.COLOURS["ours"])
    book.save_scene(plotter, "cube", pd.DataFrame({"side_mm": [1.0]}), "No frame; synthetic")
    assert {path.name for path in figures.iterdir()} == {"cube.svg", "cube.png", "cube.csv"}
    height, width = plt.imread(figures / "cube.png").shape[:2]
    assert 20 < width < 300 and 20 < height <= 200


def test_an_empty_scene_is_refused(figures):
    import pyvista

    with pytest.raises(InputError, match="empty"):
        book.save_scene(pyvista.Plotter(off_screen=True), "void", pd.DataFrame({"x": [1]}), "Nothing")


def test_a_table_keeps_its_digits_in_csv_and_is_rounded_in_markdown(figures):
    book.save_table(pd.DataFrame({"point": ["P|1"], "x_mm": [1.23456789]}), "points", "Base frame, mm; printed")
    assert (figures / "points.csv").read_text() == "point,x_mm\nP|1,1.234568\n"
    markdown = (figures / "points.md").read_text()
    assert "| P\\|1 | 1.235 |" in markdown and "Base frame, mm; printed" in markdown


@pytest.mark.parametrize(
    "name, data, caption, complaint",
    [
        ("Fig 7", pd.DataFrame({"x": [1]}), "caption", "lower-case"),
        ("../fig", pd.DataFrame({"x": [1]}), "caption", "lower-case"),
        ("fig", pd.DataFrame(), "caption", "DataFrame"),
        ("fig", {"x": [1]}, "caption", "DataFrame"),
        ("fig", pd.DataFrame({"x": [1]}), " ", "caption"),
    ],
)
def test_unusable_names_data_and_captions_are_refused(figures, name, data, caption, complaint):
    with pytest.raises(InputError, match=complaint):
        book.save_table(data, name, caption)
    assert not figures.exists()


def test_no_colour_stands_for_two_things():
    assert len(set(book.COLOURS.values())) == len(book.COLOURS)


# --- answers and verdicts


@pytest.mark.parametrize("evidence", ["print alone", "paper's method on a twin", "ours on a twin"])
@pytest.mark.parametrize(
    "rebuilt, paper_value, claim, trivial, word",
    [
        (1.05, 1.0, "equal", "no", "reproduced"),
        (1.05, 1.0, "equal", "yes", "within its bound"),
        (1.2, 1.0, "equal", "no", "not reproduced"),
        (0.8, 1.0, "equal", "yes", "not reproduced"),
        (0.2, 1.0, "at most", "yes", "within its bound"),
        (1.2, 1.0, "at most", "yes", "not reproduced"),
        (0.95, 1.0, "at least", "no", "reproduced"),
        (0.8, 1.0, "at least", "no", "not reproduced"),
        (0.05, np.nan, "at most", "", "within its bound"),
        (0.2, np.nan, "at most", "", "outside its bound"),
        (0.2, np.nan, "at least", "", "within its bound"),
        (0.05, np.nan, "at least", "", "outside its bound"),
        (np.nan, 1.0, "equal", "no", "not yet"),
    ],
)
def test_reproduced_is_said_of_a_printed_value_that_no_trivial_answer_would_meet(
    rebuilt, paper_value, claim, trivial, word, evidence
):
    assert verdict(rebuilt, paper_value, 0.1, claim, evidence, trivial) == word


@pytest.mark.parametrize(
    "evidence, inside, outside",
    [
        ("recovers a planted truth", "recovered", "outside its bound"),
        ("follows from the print by construction", "within its bound", "outside its bound"),
        ("measured", "within its bound", "outside its bound"),
        ("own bound", "within its bound", "outside its bound"),
        ("not comparable", "not comparable", "not comparable"),
    ],
)
def test_other_classes_have_words_of_their_own(evidence, inside, outside):
    for printed in (1.0, np.nan):
        edge = 0.0 if np.isnan(printed) else printed
        assert verdict(edge + 0.1, printed, 0.1, "at most", evidence, "no") == inside
        assert verdict(edge + 0.2, printed, 0.1, "at most", evidence, "no") == outside
    assert verdict(1.0, 1.0, 0.1, "equal", "recovers a planted truth", "yes") == "within its bound"


def test_trivial_answers_are_zero_the_nominal_value_and_the_mean_of_the_print():
    row = {"item": "t", "unit": "mm", "evidence": "ours on a twin", "claim": "equal", "nominal": np.nan}
    rows = pd.DataFrame(
        [
            row | {"paper": 30.4, "nominal": 30.45, "tolerance": 0.1, "reason": "one"},
            row | {"paper": 30.4, "tolerance": 0.1, "reason": "alone"},
            row | {"paper": 0.05, "tolerance": 0.1, "reason": "small"},
            row | {"paper": 10.0, "tolerance": 1.5, "reason": "table"},
            row | {"paper": 12.0, "tolerance": 1.5, "reason": "table"},
            row | {"paper": 0.5, "tolerance": 0.0, "reason": "limit", "claim": "at most"},
            row | {"paper": np.nan, "tolerance": 0.1, "reason": "bound", "claim": "at most"},
            row | {"paper": 0.0, "tolerance": 0.1, "reason": "shown", "evidence": "not comparable"},
        ]
    )
    assert trivial_answers_pass(rows) == ["yes", "no", "yes", "yes", "yes", "yes", "", ""]


def test_what_a_trivial_answer_passes_is_never_called_reproduced_or_recovered():
    every = EXPECTED[["item", "quantity"]].assign(kind="synthetic", figure="", settings="full")
    for value in (0.0, 30.4, *EXPECTED["paper"].dropna().unique()):
        table = judged(every.assign(rebuilt=value))
        good = table["verdict"].isin(["reproduced", "recovered"])
        assert not (good & (table["trivial answer passes"] == "yes")).any()
        refutable = table["paper"].notna() & table["evidence"].isin(EVIDENCE[:3])
        assert not (table["verdict"].isin(["reproduced", "not reproduced"]) & ~refutable).any()


def test_classes_are_counted_and_every_row_counts_once():
    table = judged(answers(1.0))
    counts = count_by_class(table).set_index("evidence")
    assert counts.loc["all", "numbers"] == len(EXPECTED) == counts["numbers"][:-1].sum()
    assert (counts[list(VERDICTS)].sum(axis=1) == counts["numbers"]).all()
    assert f"{len(EXPECTED)} numbers: " in summary(table)


def test_the_scoreboard_has_one_row_for_every_expected_row_in_its_order():
    table = judged(answers(1.0))
    pd.testing.assert_frame_equal(table[["item", "quantity"]], EXPECTED[["item", "quantity"]])
    assert (table["verdict"] == "not yet").sum() == len(EXPECTED) - 1


def test_the_fast_setting_is_judged_by_its_own_tolerance():
    assert judged(answers(1.0))["tolerance"].iloc[0] == FIRST["tolerance"]
    assert judged(answers(1.0, "fast"))["tolerance"].iloc[0] == FIRST["tolerance_fast"]


def test_an_answer_appears_in_the_verdicts_and_on_the_scoreboard(figures):
    value = float(FIRST["paper"]) + 0.5 * float(FIRST["tolerance"])
    book.answer(FIRST["item"], FIRST["quantity"], value + 1000, "synthetic")
    book.answer(FIRST["item"], FIRST["quantity"], value, "synthetic", "table1")
    own = book.verdicts()
    word = "within its bound"  # the nominal value would pass as well
    assert set(own["verdict"]) <= {word, "not yet"} and (own["verdict"] == word).sum() == 1
    assert book.missed() == []
    row = write_scoreboard(figures).iloc[0]
    assert (
        row["verdict"] == word
        and row["trivial answer passes"] == "yes"
        and row["kind"] == "synthetic"
        and row["figure"] == "table1"
    )
    assert row["difference"] == pytest.approx(value - FIRST["paper"])
    page = (figures / "scoreboard.md").read_text()
    assert f"{len(EXPECTED)} numbers: 0 reproduced" in page and f"1 {word}" in page
    assert page.index("## Print alone") < page.index("## Ours on a twin") < page.index("height at P1")
    book.answer(FIRST["item"], FIRST["quantity"], value + 1000, "synthetic")
    assert book.missed() == [FIRST["quantity"]]


def test_an_answer_nobody_expects_is_refused_with_near_names(figures):
    with pytest.raises(InputError, match=str(FIRST["quantity"])):
        book.answer(FIRST["item"], FIRST["quantity"] + "x", 1.0, "synthetic")


def test_an_answer_for_another_chapter_is_refused(figures):
    other = EXPECTED[EXPECTED["chapter"] != FIRST["chapter"]].iloc[0]
    with pytest.raises(InputError, match=f"answered by chapter {other['chapter']}"):
        book.answer(other["item"], other["quantity"], 1.0, "synthetic")


@pytest.mark.parametrize("value, kind", [(np.nan, "synthetic"), (np.inf, "synthetic"), (1.0, "guessed")])
def test_an_answer_without_a_number_or_with_an_unknown_kind_is_refused(figures, value, kind):
    with pytest.raises(InputError):
        book.answer(FIRST["item"], FIRST["quantity"], value, kind)


# --- running chapters


def test_a_failing_chapter_is_named_while_the_others_run(tmp_path):
    save = (
        "import grindvision_book as book\nimport pandas as pd\nbook.start('01')\n"
        "book.save_table(pd.DataFrame({'x_mm': [1.0]}), 'one', 'Base frame; synthetic')"
    )
    notebook(tmp_path / "notebooks" / "01_good.ipynb", save)
    notebook(tmp_path / "notebooks" / "02_bad.ipynb", save.replace("'one'", "'two'"), "raise ValueError('no rank')")
    notebook(tmp_path / "notebooks" / "03_dead.ipynb", "import os\nos._exit(3)")
    notebook(tmp_path / "notebooks" / "04_silent.ipynb", "rank = 19\nassert rank == 20")
    before = {path: path.read_bytes() for path in (tmp_path / "notebooks").iterdir()}
    outcomes = rebuild(
        notebooks=tmp_path / "notebooks", build=tmp_path / "build", figures=tmp_path / "figures", fast=True
    )

    assert [outcome.chapter for outcome in outcomes] == ["01_good", "02_bad", "03_dead", "04_silent"]
    assert outcomes[0].failure == ""
    assert outcomes[1].failure == "cell 3 failed: ValueError: no rank"
    assert "cell 2 ended its kernel" in outcomes[2].failure
    assert outcomes[3].failure == "cell 2 failed: AssertionError: assert rank == 20"
    names = {path.name for path in (tmp_path / "figures").iterdir()}
    assert names == {"one.csv", "one.md", "scoreboard.csv", "scoreboard.md"}
    assert before == {path: path.read_bytes() for path in (tmp_path / "notebooks").iterdir()}
    executed = nbformat.read(tmp_path / "build" / "executed" / "01_good.ipynb", as_version=4)
    assert any(cell.get("outputs") for cell in executed.cells)


def test_a_kernel_that_does_not_start_fails_its_chapter(tmp_path, monkeypatch):
    async def mute(client, timeout):
        raise RuntimeError(f"Kernel didn't respond in {timeout} seconds")

    monkeypatch.setattr(AsyncKernelClient, "wait_for_ready", mute)
    notebook(tmp_path / "notebooks" / "01_good.ipynb", "pass")
    at_end: list = []
    monkeypatch.setattr(atexit, "register", lambda function, *_, **__: at_end.append(function))
    monkeypatch.setattr(atexit, "unregister", lambda function: at_end.remove(function))
    outcomes = rebuild(
        notebooks=tmp_path / "notebooks", build=tmp_path / "build", figures=tmp_path / "figures", fast=True
    )
    assert outcomes[0].failure == "its kernel did not start (Kernel didn't respond in 900 seconds)"
    assert not [function for function in at_end if isinstance(getattr(function, "__self__", None), NotebookClient)]


def test_studies_of_chapters_that_share_the_cores_share_their_workers():
    for threads in (1, 2):
        asked = "import joblib; print(joblib.effective_n_jobs(-1))"
        answer = subprocess.run(
            [sys.executable, "-c", asked],
            env=kernel_environment(False, threads),
            capture_output=True,
            text=True,
            check=True,
        )
        assert int(answer.stdout) == min(threads, joblib.cpu_count())


def test_answers_of_a_chapter_that_no_longer_exists_are_forgotten(tmp_path):
    notebook(tmp_path / "notebooks" / "01_good.ipynb", "1 + 1")
    (tmp_path / "figures").mkdir()
    answers(1.0).to_csv(tmp_path / "figures" / f"answers_{FIRST['chapter']}.csv", index=False)
    assert write_scoreboard(tmp_path / "figures")["verdict"].iloc[0] != "not yet"
    rebuild(notebooks=tmp_path / "notebooks", build=tmp_path / "build", figures=tmp_path / "figures", fast=True)
    assert set(pd.read_csv(tmp_path / "figures" / "scoreboard.csv")["verdict"]) == {"not yet"}


def test_a_notebook_that_cannot_be_read_is_an_outcome(tmp_path):
    (tmp_path / "notebooks").mkdir()
    (tmp_path / "notebooks" / "01_torn.ipynb").write_text('{"cells": [')
    outcomes = rebuild(
        notebooks=tmp_path / "notebooks", build=tmp_path / "build", figures=tmp_path / "figures", fast=True
    )
    assert "not a readable notebook" in outcomes[0].failure


def test_chapters_are_chosen_by_number(tmp_path):
    for name in ("03_c", "01_a", "02_b"):
        notebook(tmp_path / f"{name}.ipynb")
    assert list(chosen([], tmp_path)) == ["01", "02", "03"]
    assert list(chosen(["3", "01"], tmp_path)) == ["01", "03"]
    with pytest.raises(InputError, match="there is no chapter '77'"):
        chosen(["77"], tmp_path)
    with pytest.raises(FileError, match="chapter 07 is missing"):
        chosen(["7"], tmp_path)
    notebook(tmp_path / "01_again.ipynb")
    with pytest.raises(FileError, match="both chapter 01"):
        chosen([], tmp_path)


# --- the command


def command(*words: str, build: Path | None = None, **environment: str) -> subprocess.CompletedProcess:
    """The command, which builds in a folder of its own where one is given: a checkout has one build at a time."""
    elsewhere = (
        "import pathlib, sys; from grindvision_book.machinery import places;"
        "places.BUILD = pathlib.Path(sys.argv.pop(1));"
        "from grindvision.cli import main; sys.exit(main())"
    )
    run = ["-m", "grindvision"] if build is None else ["-c", elsewhere, str(build)]
    return subprocess.run(
        [sys.executable, *run, *words],
        capture_output=True,
        text=True,
        env={**os.environ, **environment},
        timeout=600,
    )


def assert_one_line(answer: subprocess.CompletedProcess, *parts: str) -> None:
    lines = [line for line in answer.stderr.splitlines() if line.startswith("grindvision")]
    assert answer.returncode == 2, answer.stderr
    assert "Traceback" not in answer.stderr and len(lines) == 1
    assert all(part in lines[0] for part in parts), lines[0]


def test_an_unknown_chapter_is_one_line_and_exit_2():
    assert_one_line(command("book", "--only", "55"), "there is no chapter '55'", "the book has")


def test_a_damaged_table_in_data_is_one_line_and_exit_2(tmp_path):
    shutil.copytree(paper.data_folder(), tmp_path / "data")
    damaged = tmp_path / "data" / "paper" / "diao2018_table3.csv"
    damaged.write_text(re.sub(r"-?\d+\.\d+", "12.3.4", damaged.read_text(), count=1))
    answer = command("book", "--fast", build=tmp_path / "build", GRINDVISION_DATA=str(tmp_path / "data"))
    assert_one_line(answer, "diao2018_table3.csv", "row 1, column x_mm", "12.3.4")


def test_a_missing_table_in_data_is_one_line_and_exit_2(tmp_path):
    shutil.copytree(paper.data_folder(), tmp_path / "data")
    (tmp_path / "data" / "paper" / "expected.csv").unlink()
    answer = command("book", "--fast", build=tmp_path / "build", GRINDVISION_DATA=str(tmp_path / "data"))
    assert_one_line(answer, "expected.csv", "no such file")


def test_no_permission_to_write_is_named_before_any_chapter_runs(tmp_path):
    notebook(tmp_path / "notebooks" / "01_good.ipynb", "open('ran.txt', 'w')")
    (tmp_path / "figures").write_text("a file where the folder should be")
    with pytest.raises(FileError, match=r"cannot write .*figures"):
        rebuild(notebooks=tmp_path / "notebooks", build=tmp_path / "build", figures=tmp_path / "figures", fast=True)
    assert not list((tmp_path / "build" / "executed").iterdir())


@pytest.mark.parametrize("words", [["--help"], ["book", "--help"], ["--version"]])
def test_the_door_loads_no_heavy_module(words):
    code = (
        "import sys, json\nfrom grindvision.cli import main\n"
        f"try:\n    main({words!r})\nexcept SystemExit:\n    pass\n"
        "print('\\n' + json.dumps(sorted(sys.modules)))"
    )
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(json.loads(answer.stdout.splitlines()[-1]))
    heavy = {
        "numpy",
        "scipy",
        "pandas",
        "matplotlib",
        "pyvista",
        "vtkmodules",
        "open3d",
        "pinocchio",
        "numba",
        "sphinx",
    }
    assert not loaded & heavy


def test_every_command_is_listed_in_the_help(capsys):
    with pytest.raises(SystemExit):
        cli.main(["--help"])
    shown = capsys.readouterr().out
    assert all(name in shown for name in cli.COMMANDS)
