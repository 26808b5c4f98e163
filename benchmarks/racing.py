"""Runs a race: every racer in its own process, in turn (A B A B ...), judged against a truth that it never sees."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from grindvision_book.machinery.places import ROOT

Arrays = Mapping[str, np.ndarray]
Judge = Callable[[Arrays, Any], dict[str, float]]

TOO_SLOW = 10.0
"""A racer so many times slower than the fastest of the first round rests after it."""


@dataclass(frozen=True)
class Racer:
    """Who races: ``task`` is ``module:function`` below ``benchmarks.peers``, ``kind`` ours, paper_variant or peer.

    ``settings`` are handed to the function; ``about`` states them for the reader; ``needs`` names a Python module, or
    one of its functions, PCL or CloudCompare, without which the racer is absent. ``warm_up``: run once before,
    uncounted; not for a program that is a process of its own in every run, or where compiled code is all there is and
    a run is long.
    """

    name: str
    task: str
    kind: str = "peer"
    settings: dict[str, Any] = field(default_factory=dict)
    about: str = ""
    needs: str = ""
    warm_up: bool = True


@dataclass(frozen=True)
class Case:
    """One input: ``inputs`` are what racers get, ``truth()`` is what their answers are judged against."""

    label: str
    points: int
    inputs: dict[str, Any]
    truth: Callable[[], Any]


@dataclass(frozen=True)
class Measurement:
    """One run of one racer on one case; ``accuracy`` as the race's judge finds it.

    ``timed``: raced in turn against all others; else only the answer counts.
    """

    racer: Racer
    case: Case
    round: int
    wall_s: float
    cpu_s: float
    peak_mib: float
    growth_mib: float
    laps_s: dict[str, float]
    error: str
    accuracy: dict[str, float]
    timed: bool = True

    @property
    def failed(self) -> bool:
        """Whether it gave no answer or a wrong one."""
        return bool(self.error) or bool(self.accuracy.get("failed", 0.0))

    def without_reading(self) -> Measurement:
        """The same without the time to read the files."""
        return replace(self, wall_s=self.wall_s - self.laps_s.get("read", 0.0))


class Worker:
    """A racer's process; one that dies is followed by another."""

    def __init__(self, racer: Racer) -> None:
        self.racer = racer
        self._start()

    def _start(self) -> None:
        self.errors = tempfile.TemporaryFile()  # noqa: SIM115  closed with the worker
        self.process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.worker", f"benchmarks.peers.{self.racer.task}"],
            cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self.errors, text=True,
        )  # fmt: skip
        assert self.process.stdin is not None and self.process.stdout is not None
        self.jobs, self.replies = self.process.stdin, self.process.stdout

    def run(self, inputs: dict[str, Any], answer: Path) -> dict[str, Any]:
        """Hand over one job and wait for its numbers; the arrays of the answer are in the file ``answer``."""
        job = {"inputs": inputs, "settings": self.racer.settings, "answer": str(answer)}
        with suppress(BrokenPipeError):
            self.jobs.write(json.dumps(job) + "\n")
            self.jobs.flush()
        line = self.replies.readline()
        if line:
            return json.loads(line)
        code = self.process.wait()
        self.errors.seek(0)
        said = self.errors.read().decode(errors="replace").strip().splitlines()
        self.close()
        self._start()
        unknown = dict.fromkeys(("wall_s", "cpu_s", "peak_mib", "growth_mib"), float("nan"))
        return {**unknown, "laps_s": {}, "error": f"the process died ({code}): {said[-1] if said else 'no word'}"}

    def close(self) -> None:
        """End the process."""
        with suppress(BrokenPipeError):
            self.jobs.close()
        self.process.wait()
        self.replies.close()
        self.errors.close()


def race(racers: Sequence[Racer], rounds: Sequence[Case], judge: Judge, spare: bool = True) -> list[Measurement]:
    """Let the racers run the cases of ``rounds`` in turn, after an uncounted warm-up on the first one.

    Memory is that of a racer's first run in a fresh process, so our kernels are compiled in another one before.

    Args:
        spare: racers that were ``TOO_SLOW`` in the first round rest after it.
    """
    found: list[Measurement] = []
    resting: set[str] = set()
    with ExitStack() as stack:
        answer = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "answer.npz"
        for racer in racers:
            if racer.kind != "peer" and racer.task not in _compiled:
                _compiled.add(racer.task)
                with closing(Worker(racer)) as worker:
                    worker.run(rounds[0].inputs, answer)
        workers = {racer.name: stack.enter_context(closing(Worker(racer))) for racer in racers}
        memory = {}
        for racer in racers:
            if racer.warm_up:
                reply = workers[racer.name].run(rounds[0].inputs, answer)
                memory[racer.name] = {name: reply[name] for name in ("peak_mib", "growth_mib")}
        for number, case in enumerate(rounds, start=1):
            for racer in racers:
                if racer.name not in resting:
                    one = _measure(workers[racer.name], case, number, judge, answer)
                    found.append(replace(one, **memory.get(racer.name, {})))
                    print(_line(found[-1]), flush=True)
            if number == 1 and spare:
                fastest = min(one.wall_s for one in found)
                resting = {one.racer.name for one in found if one.wall_s > TOO_SLOW * fastest}
    return found


_compiled: set[str] = set()


def judge_more(racers: Sequence[Racer], cases: Sequence[Case], judge: Judge, first: int) -> list[Measurement]:
    """One untimed run of each racer on further cases, whose rounds are numbered from ``first`` on."""
    found = race(racers, cases, judge, spare=False) if cases else []
    return [replace(one, round=one.round + first - 1, timed=False) for one in found]


def _measure(worker: Worker, case: Case, number: int, judge: Judge, answer: Path) -> Measurement:
    reply = worker.run(case.inputs, answer)
    accuracy = {}
    if not reply["error"]:
        with np.load(answer) as arrays:
            accuracy = judge(arrays, case.truth())
    return Measurement(worker.racer, case, number, accuracy=accuracy, **reply)


def _line(one: Measurement) -> str:
    accuracy = ", ".join(f"{name} {value:.3g}" for name, value in one.accuracy.items())
    name = f"{one.case.label:>12} {one.round} {one.racer.name:<34}"
    return f"  {name} {one.wall_s:8.3f} s {one.growth_mib:6.0f} MiB  {one.error or accuracy}"
