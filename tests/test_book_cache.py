"""What is kept of a build: taken again only when nothing has changed, and never half of it."""

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook, writes

from grindvision.cli import main
from grindvision.errors import FileError
from grindvision_book.machinery import kept, places
from grindvision_book.machinery.chapters import chapters
from grindvision_book.machinery.dependencies import modules_of, modules_of_notebook
from grindvision_book.machinery.one_at_a_time import only_build
from grindvision_book.machinery.reading import ReadingPage, write_page
from grindvision_book.machinery.rebuilding import Outcome, is_up_to_date, rebuild
from grindvision_book.machinery.schedule import Remaining, longest_first, record_seconds, recorded_seconds

TABLE = (
    "import grindvision_book as book\nimport pandas as pd\nbook.start('01')\n"
    "book.save_table(pd.DataFrame({{'x_mm': [{value}]}}), 'one', 'Base frame; synthetic')\n"
    "open({log!r}, 'a').write('ran ')"
)


class Book:
    """A book of one chapter that notes each run."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.log = folder, folder / "log.txt"
        self.log.touch()
        self.figures, self.entry = folder / "figures", folder / "build" / "kept" / "01"
        self.write(1.0)

    def write(self, value: float, more: str = "") -> None:
        (self.folder / "notebooks").mkdir(exist_ok=True)
        code = new_code_cell(TABLE.format(value=value, log=str(self.log)) + more)
        content = new_notebook(cells=[new_markdown_cell("# First\n\n$x^2$"), code])
        content.metadata["kernelspec"] = {"name": "python3", "display_name": "Python 3", "language": "python"}
        (self.folder / "notebooks" / "01_first.ipynb").write_text(writes(content))

    def rebuild(self, **options) -> Outcome:
        (outcome,) = rebuild(
            notebooks=self.folder / "notebooks", build=self.folder / "build", figures=self.figures, fast=True, **options
        )
        return outcome

    @property
    def runs(self) -> int:
        return len(self.log.read_text().split())


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> Book:
    book = Book(tmp_path_factory.mktemp("book"))
    assert book.rebuild().failure == "" and book.runs == 1
    return book


@pytest.fixture
def book(built, tmp_path) -> Iterator[Book]:
    """A copy of a book that has been built once, at the same place for its kernel."""
    saved = tmp_path / "saved"
    shutil.copytree(built.folder, saved)
    built.log.write_text("")
    yield built
    shutil.rmtree(built.folder)
    shutil.copytree(saved, built.folder)


def test_an_unchanged_chapter_is_taken_as_it_is(book):
    (book.figures / "one.csv").unlink()
    outcome = book.rebuild()
    assert outcome.kept and "unchanged" in str(outcome) and book.runs == 0
    assert (book.figures / "one.csv").read_text() == "x_mm\n1\n"


def test_force_runs_it_all_the_same(book):
    assert not book.rebuild(force=True).kept and book.runs == 1


def test_a_changed_notebook_runs_and_says_why(book):
    book.write(2.0)
    outcome = book.rebuild()
    assert not outcome.kept and outcome.note == "changed: notebook" and book.runs == 1
    assert (book.figures / "one.csv").read_text() == "x_mm\n2\n"


def test_up_to_date_is_what_the_full_setting_has_built_as_it_is(book, tmp_path):
    notebooks = book.folder / "notebooks"
    assert not is_up_to_date("01", notebooks, book.folder / "build")  # by the fast setting alone
    rebuild(notebooks=notebooks, build=tmp_path / "full", figures=tmp_path / "figures")
    assert is_up_to_date("01", notebooks, tmp_path / "full")
    book.write(2.0)
    assert not is_up_to_date("01", notebooks, tmp_path / "full")


@pytest.mark.parametrize("harm", ["torn list", "no list", "other figure", "no copy", "stray file", "other format"])
def test_a_damaged_entry_or_one_of_another_version_counts_as_not_there(book, harm):
    made = book.entry / "made.json"
    parts = json.loads(made.read_text())["parts"]
    assert kept.find(book.entry.parent, "01", parts)[0] is not None
    if harm == "torn list":
        made.write_bytes(made.read_bytes()[:-40])
    elif harm == "no list":
        made.write_text("[]")
    elif harm == "other figure":
        (book.entry / "figures" / "one.csv").write_text("x_mm\n7\n")
    elif harm == "no copy":
        (book.entry / "executed.ipynb").unlink()
    elif harm == "stray file":
        (book.entry / "figures" / "two.csv").write_text("x_mm\n7\n")
    else:
        made.write_text(json.dumps(json.loads(made.read_text()) | {"parts": parts | {"format": "0"}}))
    entry, why = kept.find(book.entry.parent, "01", parts)
    assert entry is None and why in ("what was kept of it is damaged", "changed: format")


def test_a_damaged_entry_is_built_anew(book):
    (book.entry / "figures" / "one.csv").write_text("x_mm\n7\n")
    (book.entry / "figures" / "two.csv").write_text("x_mm\n7\n")
    outcome = book.rebuild()
    assert outcome.note == "what was kept of it is damaged" and book.runs == 1
    assert (book.figures / "one.csv").read_text() == "x_mm\n1\n" and not (book.figures / "two.csv").exists()


@pytest.mark.parametrize("foreign", ["file", "link", "dangling link", "endless list", "no seconds"])
def test_what_is_no_entry_is_replaced_and_what_a_link_points_at_stays(tmp_path, foreign):
    parts = {"format": "1"}

    def built() -> kept.Entry:
        with kept.new_entry(tmp_path / "kept") as folder:
            (folder / "figures" / "one.csv").write_text("x_mm\n1\n")
            return kept.keep(folder, "01", parts, 1.0)

    place = built().folder
    theirs = tmp_path / "theirs"
    theirs.mkdir()
    (theirs / "precious.txt").write_text("mine")
    if foreign == "endless list":
        (place / "made.json").write_text("[" * 100_000)
    elif foreign == "no seconds":
        (place / "made.json").write_text((place / "made.json").read_text().replace("1.0", "NaN"))
    else:
        shutil.rmtree(place)
        if foreign == "file":
            place.write_text("no folder")
        else:
            place.symlink_to(theirs if foreign == "link" else tmp_path / "nowhere")
    assert kept.find(place.parent, "01", parts)[0] is None
    assert built().folder == place and not place.is_symlink()
    assert kept.find(place.parent, "01", parts)[0] is not None
    assert (theirs / "precious.txt").read_text() == "mine"


def test_an_entry_that_cannot_be_replaced_is_named_in_one_line(tmp_path, monkeypatch):
    with kept.new_entry(tmp_path / "kept") as folder:
        (tmp_path / "kept" / "01").mkdir()
        (tmp_path / "kept" / "01" / "held").write_text("")
        monkeypatch.setattr(shutil, "rmtree", lambda *_, **__: None)
        with pytest.raises(FileError, match=r"kept.01 cannot be replaced: .*; remove it and build again"):
            kept.keep(folder, "01", {}, 1.0)


def test_what_a_killed_build_left_is_removed(book):
    left = book.entry.parent / ".building-abc" / "figures"
    left.mkdir(parents=True)
    (left / "one.csv").write_text("x_mm\n9\n")
    assert book.rebuild().kept and not left.parent.exists()


def test_a_chapter_that_fails_is_not_kept(book):
    book.write(3.0, "\nassert False")
    assert book.rebuild().failure and book.rebuild().failure and book.runs == 2
    assert (book.figures / "one.csv").read_text() == "x_mm\n1\n"


def test_a_chapter_whose_imports_cannot_be_seen_is_not_kept(book):
    book.write(4.0, "\n__import__('grind' + 'vision.vision.registration.free_motions')")
    outcome = book.rebuild()
    assert not outcome.failure and "not kept: its imports do not show grindvision." in outcome.note
    assert (book.figures / "one.csv").read_text() == "x_mm\n4\n"
    assert not book.rebuild().kept


def test_a_changed_setting_or_library_counts_a_thread_or_a_place_does_not():
    path = chapters()["02"]
    plain = kept.parts_of("02", path, {"GRINDVISION_FAST": "0", "NUMBA_NUM_THREADS": "1", "HOME": "a"})
    assert plain == kept.parts_of("02", path, {"GRINDVISION_FAST": "0", "NUMBA_NUM_THREADS": "2", "HOME": "b"})
    assert plain != kept.parts_of("02", path, {"GRINDVISION_FAST": "1"})
    assert plain != kept.parts_of("02", path, {"GRINDVISION_FAST": "0", "NUMBA_CPU_NAME": "generic"})


def test_a_chapter_depends_on_its_own_expected_rows_its_race_and_the_answers_of_all(tmp_path):
    paths = chapters()
    of_two, of_three = (kept.parts_of(number, paths[number], {}) for number in ("02", "03"))
    assert of_two["data expected.csv"] != of_three["data expected.csv"]
    assert "race bench_groove" in kept.parts_of("11", paths["11"], {}) and "race bench_groove" not in of_two
    (tmp_path / "answers_02.csv").write_text("a")
    before = kept.parts_of("00", paths["00"], {}, tmp_path)
    (tmp_path / "answers_02.csv").write_text("b")
    assert before["answers_02"] != kept.parts_of("00", paths["00"], {}, tmp_path)["answers_02"]


# --- what a chapter depends on


def test_imports_are_followed_through_rooms_functions_and_names_fetched_late():
    of = {number: modules_of_notebook(path) for number, path in chapters().items()}
    assert "grindvision.vision.seam.groove" in of["10"] and "grindvision.vision.seam.groove" not in of["03"]
    assert "grindvision.vision.change.detection" in of["06"] and "grindvision.motion.follow" in of["11"]
    assert "grindvision.cli.detect" in of["12"], "the command line names its modules as texts"
    assert not any("grindvision_book.exercises.chapter_05" in found for found in of.values() if found is not of["12"])


@pytest.mark.parametrize("module", ["grindvision.cli.detect", "grindvision_book.site.building", "grindvision.motion"])
def test_what_a_module_loads_is_found_in_its_sources(module):
    code = f"import {module}, sys; print(*(m for m in sys.modules if m.split('.')[0].startswith('grindvision')))"
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert set(told.split()) <= modules_of(module)


# --- one build at a time


def test_a_second_build_is_refused_in_one_line(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr(places, "BUILD", tmp_path)
    with only_build(tmp_path):
        assert main(["book", "--only", "00"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "another build of the book runs" in line and "wait for it" in line


def test_the_lock_is_free_again_after_a_kill(tmp_path):
    code = (
        "import os, pathlib, sys\n"
        "from grindvision_book.machinery.one_at_a_time import only_build\n"
        "with only_build(pathlib.Path(sys.argv[1])):\n"
        "    os.kill(os.getpid(), 9)"
    )
    assert subprocess.run([sys.executable, "-c", code, str(tmp_path)]).returncode == -9
    with only_build(tmp_path), pytest.raises(FileError, match="another build"), only_build(tmp_path):
        pass


# --- the page that fills, and the time left


def test_the_page_fills_while_the_book_is_built(tmp_path, book):
    page = ReadingPage(tmp_path / "reading", {"01": "A <b>", "02": "B"})
    page.planned(["01", "02"])
    text = (tmp_path / "reading" / "index.html").read_text()
    assert text.count("waits") == 2 and "refresh" in text and "A &lt;b&gt;" in text
    page.started("01")
    assert "is being built" in (tmp_path / "reading" / "index.html").read_text()
    page.finished("01", Outcome("01_first", 2.0), book.entry / "page.html")
    page.finished("02", Outcome("02_second", 2.0, "cell 3 failed: a < b"), None)
    text = (tmp_path / "reading" / "index.html").read_text()
    assert "href='01.html'" in text and "failed: cell 3 failed: a &lt; b" in text
    page.ended(tmp_path / "site" / "index.html")
    text = (tmp_path / "reading" / "index.html").read_text()
    assert "refresh" not in text and (tmp_path / "site" / "index.html").as_uri() in text


def test_a_chapter_s_page_needs_no_network(book, tmp_path):
    write_page(book.entry / "executed.ipynb", tmp_path / "page.html", "First")
    text = (tmp_path / "page.html").read_text()
    assert "x_mm" in text and "$x^2$" in text
    assert not re.findall(r"(?:src|href)=['\"](?!file:|#|data:)[^'\"]+", text)


def test_the_longest_chapter_starts_first_by_the_record(tmp_path):
    record = tmp_path / "seconds.csv"
    record_seconds({"03": 12.4, "08": 300.0}, False, record)
    record_seconds({"03": 2.0}, True, record)
    assert recorded_seconds(False, record) == {"03": 12.0, "08": 300.0}
    assert longest_first(["00", "03", "08"], recorded_seconds(False, record)) == ["08", "03", "00"]
    assert set(recorded_seconds()) == set(chapters())
    assert recorded_seconds(False, tmp_path / "absent.csv") == {}


def test_the_time_left_is_the_work_left_at_the_pace_of_this_build():
    left = Remaining({"08": 300.0, "09": 200.0, "03": 100.0, "00": 20.0}, workers=2, last="00")
    assert left.seconds(0.0) == pytest.approx(320.0) and left.share_done(0.0) == 0.0
    left.start("08", 0.0)
    left.start("09", 0.0)
    assert left.seconds(100.0) == pytest.approx(200 + 20)
    left.finish("09", 100.0)  # twice as fast as it was recorded
    left.start("03", 100.0)
    assert left.seconds(100.0) == pytest.approx((50 + 50) / 2 + 10)
    left.finish("08", 150.0)
    left.finish("03", 150.0)
    left.start("00", 150.0)
    left.finish("00", 160.0)
    assert left.seconds(160.0) == 0.0 and left.share_done(160.0) == 1.0


# --- the site


def test_the_site_is_built_again_only_when_something_has_changed_and_never_half(tmp_path, monkeypatch):
    from grindvision.errors import GrindvisionError
    from grindvision_book.site import building

    calls: list[Path] = []
    fails: list[int] = []

    def sphinx(sources: Path, doctrees: Path, pages: Path, extra: list[str]) -> None:
        pages.mkdir()
        (pages / "index.html").write_text(f"page {len(calls)}")
        calls.append(pages)
        if fails:
            raise GrindvisionError("the HTML book cannot be built")

    monkeypatch.setattr(building, "_run_sphinx", sphinx)
    monkeypatch.setattr(building, "_gather", lambda *_: {})
    monkeypatch.setattr(building, "_write_index", lambda *_: None)
    for folder in ("executed", "figures", "notebooks"):
        (tmp_path / folder).mkdir()

    def build() -> tuple[str, int]:
        asked = {"site": tmp_path / "site", "scenes": (), "reference": False}
        page = building.build_site(tmp_path, tmp_path / "figures", tmp_path / "notebooks", **asked)
        return page.read_text(), len(calls)

    assert build() == ("page 0", 1)
    assert build() == ("page 0", 1)
    (tmp_path / "executed" / "01_first.ipynb").write_text("{}")
    assert build() == ("page 1", 2)
    (tmp_path / "site" / "index.html").write_text("torn")
    assert build() == ("page 2", 3)
    (tmp_path / "site_made.json").write_text("[")
    assert build() == ("page 3", 4)
    (tmp_path / "executed" / "01_first.ipynb").write_text("[]")
    fails.append(1)
    with pytest.raises(GrindvisionError):
        build()
    assert (tmp_path / "site" / "index.html").read_text() == "page 3"
    fails.clear()
    assert build() == ("page 5", 6)
