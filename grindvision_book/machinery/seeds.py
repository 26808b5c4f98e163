"""The chapters once more with other seeds: do their assertions hold, or were they true of one draw?"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path

from grindvision.errors import InputError
from grindvision.files import write_text
from grindvision_book.machinery.chapters import chosen
from grindvision_book.machinery.places import BUILD, NOTEBOOKS
from grindvision_book.machinery.rebuilding import Outcome, Watcher, rebuild

#: From one seed to the next; larger than what any chapter adds to its own.
STEP = 1000

_SEED = re.compile(r"^SEED = (\d+)", re.MULTILINE)


def rebuild_with_seeds(
    count: int, numbers: Sequence[str] = (), fast: bool = True, build: Path = BUILD, watcher: Watcher | None = None
) -> dict[int, list[Outcome]]:
    """Run chapters ``count`` times, ``SEED`` as it is written and then larger by ``STEP`` each time.

    Everything stays in ``build/seeds/ADDED``, beside the copies of the chapters; chapters without a seed run once.

    Returns:
        Outcomes by what was added to the seeds.

    Raises:
        InputError: fewer than one seed; see ``rebuild`` for the others.
    """
    if count < 1:
        raise InputError(f"--seeds {count}: at least one is needed; 1 runs the seeds as they are written")
    found = {}
    for added in range(0, STEP * count, STEP):
        folder = build / "seeds" / str(added)
        copies = folder / "notebooks"
        for path in NOTEBOOKS.glob("[0-9][0-9]_*.ipynb"):
            write_text(copies / path.name, with_seed_added(path.read_text(encoding="utf-8"), added))
        seeded = [number for number, path in chosen(numbers, copies).items() if added == 0 or has_seed(path)]
        if seeded:
            found[added] = rebuild(
                seeded, fast=fast, notebooks=copies, build=folder, figures=folder / "figures", watcher=watcher
            )
    return found


def has_seed(path: Path) -> bool:
    """Whether a chapter draws at random: its parameters set ``SEED``."""
    text = path.read_text(encoding="utf-8")
    return with_seed_added(text, 1) != with_seed_added(text, 0)


def with_seed_added(notebook: str, added: int) -> str:
    """The text of a notebook whose parameters set a larger ``SEED``."""
    content = json.loads(notebook)
    for cell in content["cells"]:
        if "parameters" in cell["metadata"].get("tags", []):
            source = _SEED.sub(lambda found: f"SEED = {int(found[1]) + added}", "".join(cell["source"]))
            cell["source"] = source.splitlines(keepends=True)
    return json.dumps(content, indent=1, ensure_ascii=False) + "\n"


def told(outcomes: dict[int, list[Outcome]]) -> str:
    """One line for each chapter: how many seeds it held for, and what failed first."""
    by_chapter: dict[str, list[tuple[int, Outcome]]] = {}
    for added, of_seed in outcomes.items():
        for outcome in of_seed:
            by_chapter.setdefault(outcome.chapter, []).append((added, outcome))
    lines = []
    for chapter, tried in sorted(by_chapter.items()):
        failed = [(added, outcome.failure) for added, outcome in tried if outcome.failure]
        line = f"{chapter}: {len(tried) - len(failed)} of {len(tried)} seeds"
        lines.append(line + "".join(f"; SEED + {added}: {failure}" for added, failure in failed))
    return "\n".join(lines)
