"""What became of the faults, row by row in a committed file: sessions add up, and nothing is judged twice.

A fault is known by its file, the text of the statement that it stands in and its place there: it stays the same when
other lines of the file change, and is judged anew when its own statement does.
"""

from __future__ import annotations

import ast
import csv
import hashlib
from dataclasses import dataclass
from pathlib import Path

from mutants.operators import Mutant

COLUMNS = ("key", "seed", "path", "line", "before", "after", "outcome", "by", "seconds")


@dataclass(frozen=True)
class Verdict:
    """What became of a fault: ``killed``, ``timeout`` (a loop without end, killed too) or ``survived``.

    ``by`` is the test that noticed it.
    """

    mutant: Mutant
    outcome: str
    by: str
    seconds: float

    @property
    def noticed(self) -> bool:
        """Whether the tests noticed the fault."""
        return self.outcome != "survived"

    def __str__(self) -> str:
        return f"{self.outcome:8} {self.mutant} ({self.by}, {self.seconds:.0f} s)"


def key_of(text: str, mutant: Mutant) -> str:
    """Names a fault by its statement (of a class, the method) in the file's ``text``, and its place in it."""
    statement = statement_at(text, mutant.start)
    begin = statement[0] if statement else 0
    end = statement[1] if statement else len(text)
    parts = (mutant.path, text[begin:end], str(mutant.start - begin), mutant.before, mutant.after)
    return hashlib.blake2b("\n".join(parts).encode(), digest_size=8).hexdigest()


def statement_at(text: str, place: int) -> tuple[int, int] | None:
    """Begin and end of the outermost statement, not a class, around a place; decorators belong to it."""
    begins = [0]
    for row in text.splitlines(keepends=True):
        begins.append(begins[-1] + len(row))
    body = ast.parse(text).body
    while body:
        for one in body:
            first = min([one.lineno, *(at.lineno for at in getattr(one, "decorator_list", []))])
            assert one.end_lineno is not None
            span = begins[first - 1], begins[one.end_lineno]
            if span[0] <= place < span[1]:
                break
        else:
            return None
        if not isinstance(one, ast.ClassDef):
            return span
        body = one.body
    return None


class Record:
    """The file of verdicts."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.rows: dict[str, dict[str, str]] = {}
        if path.exists():
            with open(path, encoding="utf-8", newline="") as file:
                self.rows = {row["key"]: row for row in csv.DictReader(file)}

    def found(self, text: str, mutant: Mutant) -> Verdict | None:
        """What is known of a fault in the file's ``text``."""
        row = self.rows.get(key_of(text, mutant))
        return Verdict(mutant, row["outcome"], row["by"], float(row["seconds"])) if row else None

    def killers(self, path: str) -> list[str]:
        """Tests that have noticed faults of this file, the one that noticed most first."""
        names = [row["by"] for row in self.rows.values() if row["path"] == path and row["outcome"] == "killed"]
        return sorted(set(names), key=lambda name: -names.count(name))

    def add(self, text: str, verdict: Verdict, seed: int) -> None:
        """Write a verdict; an earlier one of the same fault makes way."""
        one, key = verdict.mutant, key_of(text, verdict.mutant)
        values = (
            seed,
            one.path,
            one.line,
            one.before,
            one.after,
            verdict.outcome,
            verdict.by,
            f"{verdict.seconds:.1f}",
        )
        self.rows[key] = dict(zip(COLUMNS, (key, *map(str, values)), strict=True))
        unfinished = self.path.with_suffix(".unfinished")
        with open(unfinished, "w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
            writer.writeheader()
            writer.writerows(sorted(self.rows.values(), key=lambda row: (row["path"], int(row["line"]), row["key"])))
        unfinished.replace(self.path)
