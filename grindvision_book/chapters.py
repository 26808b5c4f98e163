"""Runs copies of the chapters, several at once; a chapter that fails is named, and the others still run."""

from __future__ import annotations

import asyncio
import os
import re
import shutil
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from grindvision.errors import FileError, InputError
from grindvision.files import write_whole
from grindvision_book.agreement import Files, files_in
from grindvision_book.answers import write_scoreboard
from grindvision_book.committed import committed_figures
from grindvision_book.contents import missing_or_unlisted
from grindvision_book.places import BUILD, FAST_FIGURES, FIGURES, NOTEBOOKS, ROOT
from grindvision_book.publishing import Publication, publish
from grindvision_book.readme import write_readme

#: The chapter that looks back on all others runs last.
OVERVIEW = "00"

#: The longest chapters, longest first: they start first, so that no core waits for the last one.
LONGEST = ("08", "09", "11", "10", "05", "06", "04", "02", "07")

#: A cell that takes longer than this has hung.
CELL_TIMEOUT_S = 900


@dataclass(frozen=True)
class Outcome:
    """What became of one chapter: its name, seconds it took, what went wrong (empty: nothing), and its files."""

    chapter: str
    seconds: float
    failure: str = ""
    published: tuple[Publication, ...] = ()

    def __str__(self) -> str:
        """One line for the terminal."""
        return f"{self.chapter}: {self.failure or f'done in {self.seconds:.1f} s'}"


def chapters(notebooks: Path = NOTEBOOKS) -> dict[str, Path]:
    """Every chapter there is, in order: two digits -> notebook.

    Raises:
        FileError: two notebooks with one number, or none at all.
    """
    found: dict[str, Path] = {}
    for path in sorted(notebooks.glob("[0-9][0-9]_*.ipynb")):
        number = path.name[:2]
        if number in found:
            raise FileError(f"{found[number].name} and {path.name} are both chapter {number}; rename one")
        found[number] = path
    if not found:
        raise FileError(f"{notebooks}: no chapter there (a chapter is a notebook like 03_calibration.ipynb)")
    return found


def chosen(numbers: Sequence[str], notebooks: Path = NOTEBOOKS) -> dict[str, Path]:
    """The chapters with these numbers (``3`` means ``03``), or all of them when none is given.

    Raises:
        InputError: a number the book does not have. FileError: a chapter the book should have, but its file is missing.
    """
    from grindvision.paper import expected

    there = chapters(notebooks)
    if not numbers:
        return there
    picked = {}
    for number in (word.zfill(2) for word in numbers):
        if number not in there:
            if number in set(expected()["chapter"]):
                raise FileError(f"chapter {number} is missing: there is no notebook {notebooks}/{number}_*.ipynb")
            raise InputError(f"there is no chapter {number!r}; the book has {', '.join(there)}")
        picked[number] = there[number]
    return dict(sorted(picked.items()))


def rebuild(
    numbers: Sequence[str] = (),
    fast: bool = False,
    notebooks: Path = NOTEBOOKS,
    build: Path | None = None,
    figures: Path | None = None,
    report: Callable[[Outcome], None] = lambda outcome: None,
    redraw: bool = False,
) -> list[Outcome]:
    """Run chapters on copies, collect what they draw, and judge the answers.

    The figures of a chapter reach ``figures`` only when it has run to its end, and in the checkout's own ``figures``
    only where their data disagree with the commit; answers of a chapter that no longer exists are removed there.
    ``build/executed`` keeps the copies with their outputs, also of a chapter that failed.

    Args:
        numbers: chapters to run; none means all.
        fast: run fewer trials; the results go to ``build/fast/figures`` and leave ``figures`` alone.
        notebooks: folder of the chapters.
        build: working folder, ``build`` or ``build/fast`` of the checkout by default.
        figures: where finished figures and the scoreboard go.
        report: called with each outcome as it comes.
        redraw: replace committed figures also where the data agree.

    Returns:
        One outcome per chapter, in order.

    Raises:
        InputError, FileError: unknown or missing chapter, damaged data, no write permission; nothing has run then.
    """
    there, picked = chapters(notebooks), chosen(numbers, notebooks)
    _check_data()
    build = build or (FAST_FIGURES.parent if fast else BUILD)
    figures = figures or (FAST_FIGURES if fast else FIGURES)
    for folder in (build / "executed", build / "fresh", figures):
        _check_writable(folder)
    for answers in figures.glob("answers_*.csv"):
        if answers.stem.removeprefix("answers_") not in there:
            answers.unlink()
    committed = committed_figures().files if figures == FIGURES else {}
    listed = notebooks == NOTEBOOKS and not fast
    collect = partial(_collect, figures, committed, build / "put_aside", redraw, listed)
    outcomes = asyncio.run(_run_all(picked, fast, build, figures, collect, report))
    table = write_scoreboard(figures)
    if figures == FIGURES:
        write_readme(table)
    return outcomes


def _collect(
    figures: Path, committed: Files, aside: Path, redraw: bool, listed: bool, number: str, made: Path, outcome: Outcome
) -> Outcome:
    """Take over what a chapter has made, if it ran to its end and made what the book lists for it."""
    if not outcome.failure and listed:
        outcome = replace(outcome, failure=missing_or_unlisted(number, files_in(made)))
    if outcome.failure:
        return outcome
    return replace(outcome, published=tuple(publish(made, figures, committed, aside, redraw)))


async def _run_all(
    picked: dict[str, Path],
    fast: bool,
    build: Path,
    figures: Path,
    collect: Callable[[str, Path, Outcome], Outcome],
    report: Callable[[Outcome], None],
) -> list[Outcome]:
    cores = os.cpu_count() or 1
    workers = min(cores, max(1, len(picked)))
    places = asyncio.Semaphore(workers)
    environment = _environment(fast, threads=max(1, cores // workers)) | {"GRINDVISION_FINISHED": str(figures)}

    async def run(number: str) -> Outcome:
        async with places:
            fresh = build / "fresh" / number
            shutil.rmtree(fresh, ignore_errors=True)
            fresh.mkdir(parents=True)
            copy = build / "executed" / picked[number].name
            outcome = await _run(picked[number], copy, environment | {"GRINDVISION_FIGURES": str(fresh)})
        outcome = collect(number, fresh, outcome)
        shutil.rmtree(fresh)
        report(outcome)
        return outcome

    outcomes = list(await asyncio.gather(*(run(number) for number in longest_first(picked) if number != OVERVIEW)))
    if OVERVIEW in picked:
        write_scoreboard(figures)
        outcomes.append(await run(OVERVIEW))
    return sorted(outcomes, key=lambda outcome: outcome.chapter)


def longest_first(numbers: Iterable[str]) -> list[str]:
    """Chapters in the order in which they start."""
    return sorted(numbers, key=lambda number: (LONGEST.index(number) if number in LONGEST else len(LONGEST), number))


async def _run(source: Path, copy: Path, environment: dict[str, str]) -> Outcome:
    """Execute one notebook and write the copy with its outputs, whether it succeeds or not; cells count from 1."""
    import nbformat
    from nbclient import NotebookClient
    from nbclient.exceptions import CellExecutionError, CellTimeoutError, DeadKernelError

    started = time.perf_counter()
    try:
        notebook = nbformat.read(source, as_version=4)
    except (OSError, ValueError, nbformat.ValidationError) as error:
        return Outcome(source.stem, 0.0, f"not a readable notebook ({_last_line(str(error))})")
    begun = [0]
    client = NotebookClient(
        notebook,
        timeout=CELL_TIMEOUT_S,
        kernel_name="python3",
        extra_arguments=["--log-level=ERROR"],
        on_cell_start=lambda cell, cell_index: begun.append(cell_index + 1),
    )
    failure = ""
    try:
        await client.async_execute(env=environment, cwd=str(copy.parent))
    except CellExecutionError as error:
        reason = error.evalue.strip() or _failing_line(error.traceback)
        failure = f"cell {begun[-1]} failed: {error.ename}: {_first_line(reason)}"
    except CellTimeoutError:
        failure = f"cell {begun[-1]} took longer than {CELL_TIMEOUT_S} s"
    except DeadKernelError:
        failure = f"cell {begun[-1]} ended its kernel (out of memory, or a crash in a library)"
    with write_whole(copy) as path:
        nbformat.write(notebook, path)
    return Outcome(source.stem, time.perf_counter() - started, failure)


def _failing_line(traceback: str) -> str:
    """The line of the cell that a traceback points at, for errors that say nothing themselves."""
    pointed = re.search(r"^-+> *\d+ (.+)$", re.sub(r"\x1b\[[\d;]*m", "", traceback), re.MULTILINE)
    return pointed[1] if pointed else ""


def _first_line(text: str) -> str:
    return next((line.strip() for line in text.splitlines() if line.strip()), "no message")


def _last_line(text: str) -> str:
    return _first_line("\n".join(reversed(text.splitlines())))


def _environment(fast: bool, threads: int) -> dict[str, str]:
    """Environment of a kernel: the setting, its share of the cores for numerical threads and studies, no chatter."""
    environment = {name: value for name, value in os.environ.items() if name != "MPLBACKEND"}
    pinned = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")
    return environment | {
        "GRINDVISION_FAST": "1" if fast else "0",
        **dict.fromkeys(pinned, "1"),
        "NUMBA_NUM_THREADS": str(threads),
        "LOKY_MAX_CPU_COUNT": str(threads),
        "TQDM_DISABLE": "1",
        "PYDEVD_DISABLE_FILE_VALIDATION": "1",
    }


def _check_writable(folder: Path) -> None:
    trial = folder / "trial.txt"
    with write_whole(trial):
        pass
    trial.unlink()


def _check_data() -> None:
    """Read every table in ``data`` once, so that a damaged one is refused before any work."""
    from grindvision import paper
    from grindvision.arm import read_arm

    for name in paper.TABLES:
        paper.table(name)
    for matrix in ("coarse", "accurate"):
        paper.hand_eye(matrix)
    paper.expected()
    robots = sorted((paper.data_folder() / "robots").glob("*.csv"))
    if not robots:
        raise FileError(
            f"{paper.data_folder() / 'robots'}: no robot table there; restore it from {ROOT.name}'s repository"
        )
    for robot in robots:
        read_arm(robot)
