"""When each bound of ``expected.csv`` was written and changed, from git: ``bound_dates.csv`` beside this file.

``python -m grindvision_book.machinery.bound_dates`` writes the list anew, after a commit that changed ``expected.csv``
(``git commit --amend`` then takes the list into that commit: author dates, which are used, survive amending and
rebasing).
"""

from __future__ import annotations

import csv
import io
import subprocess
from datetime import datetime, timezone
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from grindvision.errors import FileError
from grindvision_book.machinery.places import ROOT

if TYPE_CHECKING:
    import pandas as pd

BOUND_DATES = Path(__file__).with_name("bound_dates.csv")
COLUMNS = ("item", "quantity", "date", "change", "order")
#: A bound was written or changed before any result of its row was committed, in the same commit, or after one.
ORDERS = ("before its result", "with its result", "after its result")

_EXPECTED, _ANSWERS = "data/paper/expected.csv", "figures/answers_*.csv"
_PROMISES = ("paper", "tolerance", "tolerance_fast", "claim")
_CLAIM_OF_BETTER = {"lower": "at most", "higher": "at least"}
#: Quantities that had another name: (item, name now) -> name then.
_FORMER = {
    ("table4 print", "largest deviation of a printed normal of Table 4 from unit length"):
        "smallest length of a printed normal",
    ("fig07", "registration rotation error, undistorted scanner"): "registration rotation error",
    ("fig07", "registration shift error, undistorted scanner"): "registration shift error",
    ("table3", "path points to true ridge, mean, undistorted scanner"): "path points to true ridge, mean",
    ("peng_fig14", "way points above the root, mean, the paper's medians of the true groove points"):
        "way points to the root line, mean, method of the paper",
    **{
        (item, f"widest spread in 95 % of cells of corresponding points in {plane}"):
            f"widest spread of corresponding points in {plane}"
        for item, plane in (("fig10", "XY"), ("fig11", "XZ"), ("fig12", "YZ"))
    },
}  # fmt: skip
#: Commits that say of themselves that results were known, though none was committed yet.
_RESULT_KNOWN = ("97f0b9e",)

Key = tuple[str, str]


def bounds_by_row() -> pd.DataFrame:
    """One line for each dated row: item, quantity, when its bound was written, when last changed, and in which order.

    ``bound order`` is ``before its result`` where the bound and all its changes came before any result, else what came
    with or after it.
    """
    import pandas as pd

    found: dict[Key, dict[str, str]] = {}
    for event in _listed():
        row = found.setdefault(
            (event["item"], event["quantity"]), {"bound written": "", "bound changed": "", "bound order": ORDERS[0]}
        )
        written = event["change"] == "written"
        row["bound written" if written else "bound changed"] = event["date"]
        if event["order"] != ORDERS[0]:
            row["bound order"] = f"{'written' if written else 'changed'} {event['order']}"
    rows = [{"item": item, "quantity": quantity, **row} for (item, quantity), row in found.items()]
    return pd.DataFrame(rows, columns=["item", "quantity", "bound written", "bound changed", "bound order"])


def events_in_git(root: Path = ROOT) -> list[dict[str, str]]:
    """Every writing and change of the bounds that ``expected.csv`` holds in the last commit, in the order of its rows.

    Raises:
        FileError: no history of git here, or only a shallow one.
    """
    if _git(root, "rev-parse", "--is-shallow-repository").strip() != "false":
        raise FileError(f"{root}: the clone is shallow; `git fetch --unshallow` brings the dates of the bounds")
    results = _first_results(root)
    events: dict[Key, list[dict[str, str]]] = {}
    bounds: dict[Key, dict[str, str]] = {}
    for commit, seconds in _commits(root, _EXPECTED):
        now = _bounds_of(_git(root, "show", f"{commit}:{_EXPECTED}"))
        for key, bound in now.items():
            was = key if key in bounds else (key[0], _FORMER.get(key, ""))
            before = bounds.get(was)
            if before == bound and was == key:
                continue
            known = [] if was == key or not before else [f"was called {was[1]!r}"]
            known += [
                f"{name} {before[name] or 'none'} to {bound[name] or 'none'}"
                for name in _PROMISES
                if before and before[name] != bound[name]
            ]
            if before and was != key:
                events[key] = [one | {"quantity": key[1]} for one in events[was]]
            first = min(results.get(key, seconds + 1), results.get(was, seconds + 1))
            order = ORDERS[0] if first > seconds else ORDERS[1] if first == seconds else ORDERS[2]
            if commit.startswith(_RESULT_KNOWN):
                order = ORDERS[2]
            line = (*key, _as_date(seconds), "; ".join(known) if before else "written", order)
            events.setdefault(key, []).append(dict(zip(COLUMNS, line, strict=True)))
        bounds = now
    return [event for key in bounds for event in events[key]]


def write(path: Path = BOUND_DATES, root: Path = ROOT) -> None:
    """Write the list anew from git."""
    from grindvision.files import write_text

    text = io.StringIO()
    lines = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    lines.writeheader()
    lines.writerows(events_in_git(root))
    write_text(path, text.getvalue())


@cache
def _listed() -> list[dict[str, str]]:
    with BOUND_DATES.open(encoding="utf-8", newline="") as lines:
        return list(csv.DictReader(lines))


def _bounds_of(text: str) -> dict[Key, dict[str, str]]:
    """What each row of one version of ``expected.csv`` promises, numbers and claims as they are written today."""
    found = {}
    for row in csv.DictReader(io.StringIO(text)):
        claim = row.get("claim")
        if claim is None:
            claim = _CLAIM_OF_BETTER.get(row["better"], "equal" if row["paper"] else "at most")
        numbers = {name: f"{float(row[name]):g}" if row[name] else "" for name in _PROMISES[:-1]}
        if numbers["paper"] == "0" and claim == "equal":  # not printed: a size within its bound
            numbers["paper"], claim = "", "at most"
        found[row["item"], row["quantity"]] = numbers | {"claim": claim}
    return found


def _first_results(root: Path) -> dict[Key, int]:
    """When the first answer to each row was committed, in seconds since 1970."""
    found: dict[Key, int] = {}
    for commit, seconds in _commits(root, _ANSWERS):
        changed = _git(root, "diff-tree", "--root", "--no-commit-id", "-r", "--name-only", "--diff-filter=AM", commit,
                       "--", _ANSWERS).split()  # fmt: skip
        for name in changed:
            for row in csv.DictReader(io.StringIO(_git(root, "show", f"{commit}:{name}"))):
                key = row["item"], row["quantity"]
                found[key] = min(found.get(key, seconds), seconds)
    return found


def _commits(root: Path, path: str) -> list[tuple[str, int]]:
    """Commits that changed a path, oldest first, each with its author date."""
    lines = _git(root, "log", "--reverse", "--format=%H %at", "--", path).splitlines()
    return [(line.split()[0], int(line.split()[1])) for line in lines]


def _as_date(seconds: int) -> str:
    return datetime.fromtimestamp(seconds, timezone.utc).strftime("%Y-%m-%d %H:%M")


def _git(root: Path, *words: str) -> str:
    try:
        answer = subprocess.run(["git", *words], cwd=root, capture_output=True, encoding="utf-8", timeout=60)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise FileError(f"{root}: git cannot be asked: {error}") from error
    if answer.returncode:
        raise FileError(f"{root}: git {words[0]}: {answer.stderr.strip().splitlines()[-1]}")
    return answer.stdout


if __name__ == "__main__":
    write()
