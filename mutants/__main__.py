"""``python -m mutants``: the chosen faults, then some drawn at random; every one has to be noticed by the tests.

Verdicts on drawn faults are kept in ``mutants/verdicts.csv``, to be committed: a draw goes on where it was stopped.
"""

from __future__ import annotations

import argparse
import csv
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mutants.operators import Mutant, mutants_of
from mutants.record import Record, Verdict
from mutants.running import Laboratory

ROOT = Path(__file__).resolve().parent.parent
VERDICTS = ROOT / "mutants" / "verdicts.csv"


def chosen_mutants() -> Iterator[tuple[Mutant, list[str]]]:
    """The faults of ``chosen.csv``, each with the tests that have to notice it."""
    with open(ROOT / "mutants/chosen.csv", encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            text = (ROOT / row["path"]).read_text(encoding="utf-8")
            if text.count(row["before"]) != 1:
                raise ValueError(f"{row['path']} holds {row['before']!r} {text.count(row['before'])} times, not once")
            start = text.index(row["before"])
            line = text.count("\n", 0, start) + 1
            end = start + len(row["before"])
            yield Mutant(row["path"], start, end, line, row["before"], row["after"]), row["tests"].split()


def drawn_mutants(count: int, seed: int, under: str = "") -> list[tuple[Mutant, list[str]]]:
    """So many of all faults that the files of ``tests_of.csv`` have room for, each file with its tests."""
    with open(ROOT / "mutants/tests_of.csv", encoding="utf-8", newline="") as file:
        tests_of = {row["path"]: row["tests"].split() for row in csv.DictReader(file)}
    everything = []
    for package in ("grindvision", "grindvision_book"):
        for module in sorted((ROOT / package).rglob("*.py")):
            path = module.relative_to(ROOT).as_posix()
            names = next((names for prefix, names in tests_of.items() if path.startswith(prefix)), None)
            if names is not None and path.startswith(under):
                everything += [(mutant, names) for mutant in mutants_of(ROOT, path)]
    picked = np.random.default_rng(seed).permutation(len(everything))[:count]
    return [everything[at] for at in picked]


def main() -> int:
    """Judge and report; 1 where a chosen fault, or too many of the drawn ones, went unnoticed."""
    parser = argparse.ArgumentParser(prog="./run mutants", description=__doc__)
    parser.add_argument("--count", type=int, default=40, help="how many to draw at random (default 40)")
    parser.add_argument("--seed", type=int, default=1, help="of the draw (default 1)")
    parser.add_argument("--under", default="", metavar="PATH", help="draw under this path only: grindvision/geometry")
    parser.add_argument("--no-chosen", action="store_true", help="leave out the faults of chosen.csv")
    parser.add_argument("--least", type=float, default=0.0, help="share of the drawn ones that must be noticed")
    parser.add_argument("--again", action="store_true", help="judge those that have survived before once more")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="begin no more faults after so long")
    parser.add_argument("--costs", type=Path, help="file (JSON) of what tests cost, to sort them by; it learns")
    options = parser.parse_args()
    chosen = [] if options.no_chosen else list(chosen_mutants())
    drawn = drawn_mutants(options.count, options.seed, options.under)
    with tempfile.TemporaryDirectory(prefix="grindvision-mutants-") as place:
        laboratory = Laboratory(ROOT, Path(place), options.costs)
        verdicts = [
            list(_judged(laboratory, chosen, None, options)),
            list(_judged(laboratory, drawn, Record(VERDICTS), options)),
        ]
    for title, part in zip(("chosen", "drawn"), verdicts, strict=True):
        survivors = [one for one in part if not one.noticed]
        print(f"{title}: {len(part) - len(survivors)} of {len(part)} noticed")
        for one in survivors:
            print(f"    {one}")
    share = np.mean([one.noticed for one in verdicts[1]]) if verdicts[1] else 1.0
    return int(not all(one.noticed for one in verdicts[0]) or share < options.least)


def _judged(
    laboratory: Laboratory, part: list[tuple[Mutant, list[str]]], record: Record | None, options: argparse.Namespace
) -> Iterator[Verdict]:
    end = time.monotonic() + options.seconds
    for mutant, tests in part:
        text = (ROOT / mutant.path).read_text(encoding="utf-8")
        known = record.found(text, mutant) if record else None
        if known and (known.noticed or not options.again):
            yield known
            continue
        if time.monotonic() > end:
            continue
        try:
            verdict = laboratory.judge(mutant, tests, record.killers(mutant.path) if record else ())
        except ValueError as error:
            raise SystemExit(str(error)) from None
        print(verdict, flush=True)
        if record:
            record.add(text, verdict, options.seed)
        yield verdict


if __name__ == "__main__":
    raise SystemExit(main())
