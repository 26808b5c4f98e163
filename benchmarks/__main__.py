"""``python -m benchmarks``: runs the races and writes their tables and pictures."""

from __future__ import annotations

import argparse
import os
import sys
from dataclasses import replace
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from shutil import which

import pandas as pd

from benchmarks import inputs, machine, races, report, scenes
from benchmarks.floors import floors
from benchmarks.goals import NOTES, goals
from benchmarks.peers.programs import build_pcl
from benchmarks.races import Plan, Race
from benchmarks.racing import Measurement, Racer, judge_more, race
from grindvision.errors import GrindvisionError
from grindvision.files import writable_folder
from grindvision_book.machinery.places import FIGURES

JUDGED = (
    "judged: runs whose answers count for failures and errors; beyond the timed rounds, each of these was run once on"
    " another scene. Who rested after the first round was not: pairs on equal scenes are in bench_scenes."
)


def main(words: list[str] | None = None) -> int:
    """Run what is asked for; 0 done, 2 bad input."""
    known = {one.name: [one] for one in races.RACES} | {"large": list(races.LARGE)}
    parser = argparse.ArgumentParser(
        prog="./run bench", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="+", metavar="RACE", help=f"of {', '.join(known)}; the last only when named")
    parser.add_argument("--rounds", type=int, metavar="N", help="rounds of each racer, 5 if left out")
    parser.add_argument("--quick", action="store_true", help="one round, smallest inputs: to see that everything runs")
    parser.add_argument("--seed", type=int, default=10, help="of the synthetic inputs")
    parser.add_argument("-o", "--output", type=Path, metavar="DIR", help="figures/, for less than all build/benchmarks")
    asked = parser.parse_args(words)
    wrong = sorted(set(asked.only or ()) - set(known))
    if wrong:
        parser.error(f"no race {', '.join(wrong)}; there are {', '.join(known)}")
    if asked.rounds is not None and asked.rounds < 1:
        parser.error(f"{asked.rounds} rounds asked for; at least 1 is needed")
    plan = replace(races.QUICK if asked.quick else Plan(), seed=asked.seed)
    if asked.rounds:
        plan = replace(plan, rounds=asked.rounds)
    chosen = [one for name in asked.only for one in known[name]] if asked.only else list(races.RACES)
    try:
        folder = writable_folder(asked.output or (FIGURES if plan.complete else inputs.CACHE / "figures"))
        run(chosen, plan, folder)
    except GrindvisionError as error:
        print(f"bench: {error}", file=sys.stderr)
        return 2
    print(f"written to {os.path.relpath(folder)}")
    return 0


def run(chosen: list[Race], plan: Plan, folder: Path) -> None:
    """Run the races one after the other; each writes its files when it is done."""
    facts, no_pcl = machine.facts(plan.seed), build_pcl()
    for one in chosen:
        print(f"\n{one.title}")
        there, absent = present(one.racers, no_pcl)
        for note in absent:
            print(f"  {note}")
        found = []
        for rounds in one.cases(plan):
            found += race(there, rounds, one.judge, one.spare)
        further = one.more(plan)
        for cases in further:
            runs = [measured.racer for measured in found if measured.case.label == cases[0].label]
            raced = [racer for racer in there if runs.count(racer) >= plan.rounds]
            found += judge_more(raced, cases, one.judge, plan.rounds + 1)
        if one.stage:
            found = [measured.without_reading() for measured in found]
        table = report.table_of(found, one.accuracy, one.lap)
        notes = [f"{racer.name}: {racer.about}." for racer in there] + absent + [JUDGED] * bool(further)
        fig = report.race_picture(one.title, table, one.drawn) if one.drawn else None
        report.write_results(folder, one.name, one.title, table, notes, facts, fig)
        if one.name == races.DETECT.name:
            write_growth(folder, table, facts)
            write_scenes(folder, found, plan, facts)
            write_floors(folder, plan, facts)
    reached = goals(folder)
    if len(reached):
        report.write_results(folder, "goals", "What was asked of the races", reached, list(NOTES), facts)


def write_growth(folder: Path, table: pd.DataFrame, facts: dict[str, str]) -> None:
    """Slopes of time against points, where there is more than one size."""
    if table["case"].nunique() > 1:
        title = "Whole detection: growth of time with size"
        fig, slopes = report.growth_picture(title, table)
        notes = ["slope: of the straight line through log(time) over log(points)."]
        report.write_results(folder, "growth", title, slopes, notes, facts, fig)


def write_scenes(folder: Path, found: list[Measurement], plan: Plan, facts: dict[str, str]) -> None:
    """Errors over all scenes, pair by pair, of the sizes that were judged on all of them."""
    judged = [one for one in found if one.case.label in plan.stage_sizes]
    table = scenes.paired(judged)
    if len(table):
        title = f"Whole detection: errors over {plan.scenes} scenes"
        report.write_results(folder, "scenes", title, table, list(scenes.NOTES), facts)


def write_floors(folder: Path, plan: Plan, facts: dict[str, str]) -> None:
    """Measured stages of whole detection beside their floors."""
    table, rates = floors(plan)
    title = "Stages of whole detection and their floors"
    notes = ["A floor is what no method can do without: bytes over bandwidth, visits, multiply-adds.", *rates]
    report.write_results(folder, "floors", title, table, notes, facts)


def _lacking(needs: str) -> str:
    """Why a module, or ``module.function``, cannot be had here; empty where it can."""
    module, _, function = needs.partition(".")
    if find_spec(module) is None:
        return f"no Python module {module} (pip install -r benchmarks/requirements.txt)"
    if function and not hasattr(import_module(module), function):
        return f"the {module} installed here has no {function} (benchmarks/README.md says which has)"
    return ""


def present(racers: tuple[Racer, ...], no_pcl: str) -> tuple[list[Racer], list[str]]:
    """Who can race here, and for everyone else a line that says why not."""
    there, absent = [], []
    for racer in racers:
        if racer.needs == "PCL":
            reason = no_pcl
        elif racer.needs == "CloudCompare":
            reason = "" if which("CloudCompare") else "not installed (Debian, Ubuntu: apt-get install cloudcompare)"
        elif racer.needs:
            reason = _lacking(racer.needs)
        else:
            reason = ""
        if reason:
            absent.append(f"absent: {racer.name}: {reason}")
        else:
            there.append(racer)
    return there, absent


if __name__ == "__main__":
    sys.exit(main())
