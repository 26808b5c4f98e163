"""The list of the figures and tables that the chapters make: ``contents.csv`` beside this file."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from pathlib import Path

CONTENTS = Path(__file__).with_name("contents.csv")


@cache
def listed() -> dict[str, str]:
    """Every file that the chapters commit, answers included: name -> two digits of its chapter.

    Raises:
        FileError: the list is damaged.
    """
    from grindvision.files import read_table
    from grindvision.paper import expected

    rows = read_table(CONTENTS, (), ("chapter", "name", "files"))
    found = {f"answers_{number}.csv": number for number in sorted(set(expected()["chapter"]))}
    for number, name, kinds in zip(rows["chapter"], rows["name"], rows["files"], strict=True):
        found |= {f"{name}.{kind}": f"{int(number):02d}" for kind in kinds.split()}
    return found


def missing_or_unlisted(chapter: str, made: Iterable[str]) -> str:
    """What a chapter failed to make, or made though it is not listed, in one line; empty where all is right."""
    wanted, made = {name for name, number in listed().items() if number == chapter}, set(made)
    complaints = [f"makes {name}, which {CONTENTS.name} does not list" for name in sorted(made - wanted)]
    complaints += [f"does not make {name}, which {CONTENTS.name} lists" for name in sorted(wanted - made)]
    return "; ".join(complaints[:3])


def stray(files: Iterable[str]) -> list[str]:
    """Files of ``figures/`` that neither a chapter nor the scoreboard nor a race makes."""
    known = listed().keys() | {"scoreboard.csv", "scoreboard.md"}
    return sorted(name for name in files if name not in known and not name.startswith("bench_"))
