"""``python -m mutants``: the chosen faults, then some drawn at random; every one has to be noticed by the tests."""

from __future__ import annotations

import argparse
import csv
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mutants.operators import Mutant, mutants_of
from mutants.running import Laboratory, Verdict

ROOT = Path(__file__).resolve().parent.parent


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
    options = parser.parse_args()
    chosen = [] if options.no_chosen else list(chosen_mutants())
    drawn = drawn_mutants(options.count, options.seed, options.under)
    with tempfile.TemporaryDirectory(prefix="grindvision-mutants-") as place:
        laboratory = Laboratory(ROOT, Path(place))
        verdicts = [list(_judged(laboratory, part)) for part in (chosen, drawn)]
    for title, part in zip(("chosen", "drawn"), verdicts, strict=True):
        survivors = [one for one in part if not one.noticed]
        print(f"{title}: {len(part) - len(survivors)} of {len(part)} noticed")
        for one in survivors:
            print(f"    {one}")
    share = np.mean([one.noticed for one in verdicts[1]]) if verdicts[1] else 1.0
    return int(not all(one.noticed for one in verdicts[0]) or share < options.least)


def _judged(laboratory: Laboratory, part: list[tuple[Mutant, list[str]]]) -> Iterator[Verdict]:
    for mutant, tests in part:
        if " ".join(tests) not in laboratory.usual_s and not laboratory.sound(tests):
            raise SystemExit(f"{' '.join(tests)} fail without a fault; mend that first")
        verdict = laboratory.judge(mutant, tests)
        print(verdict, flush=True)
        yield verdict


if __name__ == "__main__":
    raise SystemExit(main())
