"""Rebuilds the book: runs the chapters that have changed, several at once, and takes over what they made.

A chapter that fails is named, and the others still run.
"""

from __future__ import annotations

import asyncio
import os
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from grindvision.errors import FileError
from grindvision.files import write_whole
from grindvision_book.machinery import kept
from grindvision_book.machinery.agreement import Files, files_in
from grindvision_book.machinery.answers import write_scoreboard
from grindvision_book.machinery.chapters import OVERVIEW, chapters, chosen
from grindvision_book.machinery.committed import committed_figures
from grindvision_book.machinery.contents import listed, missing_or_unlisted
from grindvision_book.machinery.dependencies import modules_of_notebook
from grindvision_book.machinery.event_loop import run_all
from grindvision_book.machinery.kernels import kernel_environment, run_notebook
from grindvision_book.machinery.places import BUILD, FAST_FIGURES, FIGURES, NOTEBOOKS, ROOT
from grindvision_book.machinery.publishing import Publication, publish
from grindvision_book.machinery.reading import write_page
from grindvision_book.machinery.readme import write_readme
from grindvision_book.machinery.schedule import longest_first, recorded_seconds
from grindvision_book.machinery.session import UNPUBLISHED


@dataclass(frozen=True)
class Outcome:
    """What became of one chapter.

    ``seconds`` that building it took, ``failure`` (empty: nothing went wrong), ``published`` files, whether it was
    ``kept`` from an earlier build, and the ``note`` why it was built anew, or why it is not kept. ``left`` says why its
    figures stay as they are committed, where the chapter asked for that.
    """

    chapter: str
    seconds: float
    failure: str = ""
    published: tuple[Publication, ...] = ()
    kept: bool = False
    note: str = ""
    left: str = ""

    def __str__(self) -> str:
        """One line for the terminal."""
        if self.failure:
            return f"{self.chapter}: {self.failure}"
        left = f"; its figures stay as committed: {self.left}" if self.left else ""
        if self.kept:
            return f"{self.chapter}: unchanged since it was built here in {self.seconds:.1f} s{left}"
        return f"{self.chapter}: done in {self.seconds:.1f} s" + (f" ({self.note})" if self.note else "") + left


class Watcher:
    """Somebody who is told how a build goes on; all do nothing here."""

    def planned(self, numbers: Sequence[str], workers: int) -> None:
        """Chapters that this build comes to, and how many of them at a time."""

    def started(self, number: str) -> None:
        """A chapter is being built."""

    def finished(self, number: str, outcome: Outcome, page: Path | None) -> None:
        """A chapter has come to its end; ``page`` shows it, where there is one."""


def rebuild(
    numbers: Sequence[str] = (),
    fast: bool = False,
    notebooks: Path = NOTEBOOKS,
    build: Path | None = None,
    figures: Path | None = None,
    watcher: Watcher | None = None,
    redraw: bool = False,
    force: bool = False,
) -> list[Outcome]:
    """Run chapters on copies, collect what they draw, and judge the answers.

    A chapter of which nothing has changed since it was last built in ``build`` is taken from there. The figures of a
    chapter reach ``figures`` only when it has run to its end, and in the checkout's own ``figures`` only where their
    data disagree with the commit; answers of a chapter that no longer exists are removed there. ``build/executed``
    keeps the copies with their outputs, also of a chapter that failed.

    Args:
        numbers: chapters to run; none means all.
        fast: run fewer trials; the results go to ``build/fast/figures`` and leave ``figures`` alone.
        notebooks: folder of the chapters.
        build: working folder, ``build`` or ``build/fast`` of the checkout by default.
        figures: where finished figures and the scoreboard go.
        watcher: told what happens.
        redraw: replace committed figures also where the data agree.
        force: build every chapter anew, changed or not.

    Returns:
        One outcome per chapter, in order.

    Raises:
        InputError, FileError: unknown or missing chapter, damaged data, no write permission; nothing has run then.
    """
    there, picked = chapters(notebooks), chosen(numbers, notebooks)
    _check_data()
    build = build or (FAST_FIGURES.parent if fast else BUILD)
    figures = figures or (FAST_FIGURES if fast else FIGURES)
    for folder in (build / "executed", build / "kept", figures):
        _check_writable(folder)
    for answers in figures.glob("answers_*.csv"):
        if answers.stem.removeprefix("answers_") not in there:
            answers.unlink()
    kept.clear_unfinished(build / "kept")
    book = _Build(
        picked=picked,
        fast=fast,
        build=build,
        figures=figures,
        committed=committed_figures().files if figures == FIGURES else {},
        listed=notebooks == NOTEBOOKS and not fast,
        redraw=redraw,
        force=force,
        watcher=watcher or Watcher(),
    )
    outcomes = run_all(book.run())
    table = write_scoreboard(figures)
    if figures == FIGURES:
        write_readme(table)
    return outcomes


def is_up_to_date(number: str, notebooks: Path = NOTEBOOKS, build: Path = BUILD) -> bool:
    """Whether nothing has changed since a chapter was built here in the full setting, so that ``rebuild`` takes it from
    there. Not for the chapter that looks back on all others, which depends on their answers.

    Raises:
        FileError: the notebook cannot be read.
    """
    environment = kernel_environment(fast=False, threads=1)
    entry, _ = kept.find(build / "kept", number, kept.parts_of(number, chapters(notebooks)[number], environment))
    return entry is not None


@dataclass(frozen=True)
class _Build:
    picked: Mapping[str, Path]
    fast: bool
    build: Path
    figures: Path
    committed: Files
    listed: bool
    redraw: bool
    force: bool
    watcher: Watcher

    async def run(self) -> list[Outcome]:
        """Run all chapters, the one that looks back on the others after them."""
        cores = os.cpu_count() or 1
        workers = min(cores, max(1, len(self.picked)))
        environment = kernel_environment(self.fast, threads=max(1, cores // workers)) | {
            "GRINDVISION_FINISHED": str(self.figures),
            "GRINDVISION_STUDIES": str(self.build / "studies"),
        }
        places = asyncio.Semaphore(workers)
        order = longest_first(self.picked, recorded_seconds(self.fast))
        self.watcher.planned(order, workers)

        async def one(number: str) -> Outcome:
            async with places:
                return await self._chapter(number, environment)

        outcomes = list(await asyncio.gather(*(one(number) for number in order if number != OVERVIEW)))
        if OVERVIEW in self.picked:
            write_scoreboard(self.figures)
            outcomes.append(await one(OVERVIEW))
        return sorted(outcomes, key=lambda outcome: outcome.chapter)

    async def _chapter(self, number: str, environment: dict[str, str]) -> Outcome:
        notebook, folder = self.picked[number], self.build / "kept"
        answers = self.figures if number == OVERVIEW else None

        def parts() -> kept.Parts:
            return kept.parts_of(number, notebook, environment, answers)

        try:
            wanted = parts()
        except FileError as error:
            return self._end(number, Outcome(notebook.stem, 0.0, str(error)), None)
        entry, note = (None, "asked for") if self.force else kept.find(folder, number, wanted)
        if entry is not None:
            outcome = Outcome(notebook.stem, entry.seconds, kept=True)
            return self._end(number, self._take_over(outcome, entry.folder), entry.folder / "page.html")
        self.watcher.started(number)
        with kept.new_entry(folder) as fresh:
            started = time.perf_counter()
            told = environment | {"GRINDVISION_FIGURES": str(fresh / "figures")}
            run = await run_notebook(notebook, fresh / "executed.ipynb", told, self.build / "executed")
            outcome = Outcome(notebook.stem, time.perf_counter() - started, run.failure, note=note)
            if not outcome.failure and self.listed and not _left_as_committed(fresh / "figures"):
                outcome = replace(outcome, failure=missing_or_unlisted(number, files_in(fresh / "figures")))
            await asyncio.to_thread(write_page, fresh / "executed.ipynb", fresh / "page.html", notebook.stem)
            made = fresh
            if not outcome.failure:
                unseen = run.loaded - modules_of_notebook(notebook)
                if unseen:
                    outcome = replace(outcome, note=f"not kept: its imports do not show {min(unseen)}")
                elif parts() != wanted:
                    outcome = replace(outcome, note="not kept: its sources changed while it ran")
                else:
                    made = kept.keep(fresh, number, wanted, outcome.seconds).folder
            return self._end(number, self._take_over(outcome, made), made / "page.html")

    def _take_over(self, outcome: Outcome, made: Path) -> Outcome:
        """Publish what a chapter made, and lay out its copy, failed ones included."""
        if (made / "executed.ipynb").exists():
            with write_whole(self.build / "executed" / f"{outcome.chapter}.ipynb") as path:
                shutil.copyfile(made / "executed.ipynb", path)
        if outcome.failure:
            return outcome
        if left := _left_as_committed(made / "figures"):
            self._restore(outcome.chapter[:2])
            return replace(outcome, left=left)
        aside = self.build / "put_aside"
        return replace(
            outcome, published=tuple(publish(made / "figures", self.figures, self.committed, aside, self.redraw))
        )

    def _restore(self, number: str) -> None:
        """Lay out the committed files of a chapter where they are not there."""
        committed = (self.committed or committed_figures().files) if self.listed else {}
        for name in (name for name, of in listed().items() if of == number and name in committed):
            if not (self.figures / name).exists():
                with write_whole(self.figures / name) as path:
                    path.write_bytes(committed[name])

    def _end(self, number: str, outcome: Outcome, page: Path | None) -> Outcome:
        self.watcher.finished(number, outcome, page if page is not None and page.exists() else None)
        return outcome


def _left_as_committed(made: Path) -> str:
    """Why a chapter's committed figures stay as they are (``session.leave_as_committed``); empty where they do not."""
    path = made / UNPUBLISHED
    return path.read_text(encoding="utf-8").strip() if path.is_file() else ""


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
