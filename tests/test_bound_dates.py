"""When bounds were written: worked out from git, committed, and told on the scoreboard."""

import os
import subprocess
from pathlib import Path

import pandas as pd
import pytest

from grindvision import paper
from grindvision.errors import FileError
from grindvision_book.machinery import bound_dates
from grindvision_book.machinery.bound_dates import BOUND_DATES, ORDERS, bounds_by_row, events_in_git
from grindvision_book.machinery.places import ROOT


def test_the_committed_dates_are_those_of_git():
    """After a commit that changes expected.csv: python -m grindvision_book.machinery.bound_dates, and amend it."""
    if not (ROOT / ".git").exists():
        pytest.skip("no history of git here: unpacked from an archive")
    if (ROOT / ".git" / "shallow").exists():
        pytest.skip("a shallow clone has no history of the bounds: git fetch --unshallow")
    events = events_in_git()
    listed = pd.read_csv(BOUND_DATES, dtype=str, keep_default_na=False).to_dict("records")
    assert listed == events, "run python -m grindvision_book.machinery.bound_dates"


def test_every_row_has_a_date_and_what_came_after_a_result_says_so():
    rows = bounds_by_row()
    expected = paper.expected()
    assert set(zip(rows["item"], rows["quantity"], strict=True)) == set(
        zip(expected["item"], expected["quantity"], strict=True)
    )
    assert rows["bound written"].str.fullmatch(r"\d{4}-\d\d-\d\d \d\d:\d\d").all()
    orders = {ORDERS[0], *(f"{what} {order}" for what in ("written", "changed") for order in ORDERS[1:])}
    assert set(rows["bound order"]) <= orders
    order = rows.set_index(["item", "quantity"])["bound order"]
    assert order["hand-eye", "angle between coarse and accurate matrix"] == "changed after its result"
    assert order["fig07", "registration shift error, whole instrument"] == "written after its result"
    assert order["own_files", "way points to the true root, mean"] == "written with its result"


OLD = "item,quantity,paper,tolerance,tolerance_fast,better\n"
NEW = "item,quantity,evidence,claim,paper,nominal,tolerance,tolerance_fast\n"


@pytest.fixture
def history(tmp_path):
    """A repository, and a function that commits one version of the bounds, and answers, at an hour of one day."""

    def commit(hour: int, bounds: str = "", answers: str = "") -> None:
        for name, text in (("data/paper/expected.csv", bounds), ("figures/answers_02.csv", answers)):
            if text:
                (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
                (tmp_path / name).write_text(text, encoding="utf-8")
        date = f"2026-01-02T{hour:02d}:00:00+00:00"
        environment = os.environ | {"GIT_AUTHOR_DATE": date, "GIT_COMMITTER_DATE": "2026-01-03T00:00:00+00:00"}
        given = ["-c", "user.name=t", "-c", "user.email=t@t", "-c", "commit.gpgsign=false"]
        for words in (["add", "."], [*given, "commit", "-qm", "bounds"]):
            subprocess.run(["git", *words], cwd=tmp_path, env=environment, check=True, capture_output=True)

    subprocess.run(["git", "init", "-q"], cwd=tmp_path, check=True)
    return tmp_path, commit


def told(root: Path) -> list[tuple[str, ...]]:
    return [(one["quantity"], one["date"][-5:], one["change"], one["order"]) for one in events_in_git(root)]


def test_a_bound_is_dated_by_its_author_and_ordered_against_its_first_result(history):
    root, commit = history
    commit(1, OLD + "t,early,1,0.1,0.2,\nt,gone,1,0.1,0.2,\n")
    commit(2, answers="item,quantity,rebuilt\nt,early,1.05\n")
    commit(3, OLD + "t,early,1,0.20,0.2,\nt,late,,3,3,lower\n", "item,quantity,rebuilt\nt,late,2\n")
    commit(4, NEW + "t,early,ours on a twin,equal,1,,0.2,0.2\nt,late,own bound,at most,,,3,3\n")
    commit(5, NEW + "t,late,own bound,at least,,,3,3\nt,early,ours on a twin,equal,1,,0.2,0.2\n")
    assert told(root) == [
        ("late", "03:00", "written", "with its result"),
        ("late", "05:00", "claim at most to at least", "after its result"),
        ("early", "01:00", "written", "before its result"),
        ("early", "03:00", "tolerance 0.1 to 0.2", "after its result"),
    ]


def test_a_row_with_another_name_keeps_its_dates(history, monkeypatch):
    root, commit = history
    monkeypatch.setattr(bound_dates, "_FORMER", {("t", "new"): "old"})
    commit(1, OLD + "t,old,1,0.1,0.2,\n")
    commit(2, answers="item,quantity,rebuilt\nt,old,1.05\n")
    commit(3, OLD + "t,new,1,0.1,0.2,\n")
    assert told(root) == [
        ("new", "01:00", "written", "before its result"),
        ("new", "03:00", "was called 'old'", "after its result"),
    ]


def test_without_a_whole_history_one_line_says_so(history, tmp_path_factory):
    root, commit = history
    commit(1, OLD)
    commit(2, OLD + "t,one,1,0.1,0.2,\n")
    shallow = tmp_path_factory.mktemp("clone") / "c"
    subprocess.run(["git", "clone", "-q", "--depth=1", root.as_uri(), str(shallow)], check=True)
    with pytest.raises(FileError, match="shallow"):
        events_in_git(shallow)
    with pytest.raises(FileError, match="git rev-parse"):
        events_in_git(tmp_path_factory.mktemp("bare"))
