"""How long the chapters take: the order in which they start, and the time that is left."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path

from grindvision.errors import FileError
from grindvision.files import read_table, write_text

#: Seconds of each chapter in the last build that was recorded (`grindvision book --record-seconds`).
SECONDS = Path(__file__).with_name("chapter_seconds.csv")


@cache
def recorded_seconds(fast: bool = False, path: Path = SECONDS) -> dict[str, float]:
    """Seconds of each chapter as they were recorded: two digits -> seconds; empty where there is no usable record."""
    column = "fast_s" if fast else "full_s"
    try:
        table = read_table(path, ("full_s", "fast_s"), ("chapter",))
    except FileError:
        return {}
    return {f"{int(chapter):02d}": seconds for chapter, seconds in zip(table["chapter"], table[column], strict=True)}


def record_seconds(seconds: Mapping[str, float], fast: bool, path: Path = SECONDS) -> None:
    """Write what chapters took; those that are not named keep their record."""
    columns = {False: dict(recorded_seconds(False, path)), True: dict(recorded_seconds(True, path))}
    columns[fast] |= seconds
    numbers = sorted({*columns[False], *columns[True]})
    lines = [f"{number},{columns[False].get(number, 0):.0f},{columns[True].get(number, 0):.0f}" for number in numbers]
    write_text(path, "\n".join(["chapter,full_s,fast_s", *lines, ""]))
    recorded_seconds.cache_clear()


def longest_first(numbers: Iterable[str], seconds: Mapping[str, float]) -> list[str]:
    """Chapters in the order in which they start: the longest first, so that no core waits for the last one."""
    return sorted(numbers, key=lambda number: (-seconds.get(number, 0.0), number))


class Remaining:
    """The time that is left of a build, from the seconds that chapters took before and the pace of this build.

    Args:
        seconds: expected of each chapter that is to be built.
        workers: chapters at a time.
        last: a chapter that waits for all others, or "".
    """

    def __init__(self, seconds: Mapping[str, float], workers: int, last: str = "") -> None:
        self._expected = dict(seconds)
        self._waiting, self._last, self._workers = set(seconds), last, workers
        self._started: dict[str, float] = {}
        self._done: dict[str, float] = {}

    def start(self, number: str, now: float) -> None:
        """A chapter begins."""
        self._waiting.discard(number)
        self._started[number] = now

    def finish(self, number: str, now: float) -> None:
        """A chapter has come to its end."""
        self._waiting.discard(number)
        self._done[number] = now - self._started.pop(number, now)

    def seconds(self, now: float) -> float:
        """Seconds that are left: the work shared by the workers, and no less than the longest chapter still needs."""
        pace = self._pace(now)
        last = self._expected.get(self._last, 0.0) * pace if self._last in self._waiting else 0.0
        running = [max(pace * self._expected[number] - (now - begun), 0.0) for number, begun in self._started.items()]
        waiting = [pace * self._expected[number] for number in self._waiting if number != self._last]
        return max((sum(running) + sum(waiting)) / self._workers, max([*running, *waiting], default=0.0)) + last

    def share_done(self, now: float) -> float:
        """How much of the work is done, 0 to 1."""
        pace = self._pace(now)
        whole = sum(self._expected.values())
        done = sum(self._expected[number] for number in self._done)
        done += sum(min(self._expected[number], (now - begun) / pace) * 0.99 for number, begun in self._started.items())
        return done / whole if whole else 1.0

    def _pace(self, now: float) -> float:
        """How much longer than expected the chapters take here."""
        expected = sum(self._expected[number] for number in self._done)
        taken = sum(self._done.values())
        for number, begun in self._started.items():
            if now - begun > self._expected[number]:
                expected += self._expected[number]
                taken += now - begun
        return max(taken / expected, 0.1) if expected else 1.0
