"""What one sees while the book is being built: lines on the terminal, a bar with the time left, a page that fills."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path

from grindvision_book.machinery.chapters import OVERVIEW
from grindvision_book.machinery.reading import ReadingPage
from grindvision_book.machinery.rebuilding import Outcome, Watcher
from grindvision_book.machinery.schedule import Remaining, recorded_seconds

#: Seconds of a chapter that no build has recorded yet.
UNKNOWN_S = 60.0


class Progress(Watcher):
    """Tells of a build on the terminal and on the reading page; a context for as long as the build runs."""

    def __init__(self, page: ReadingPage, fast: bool) -> None:
        self._page, self._fast = page, fast
        self._lock, self._over = threading.Lock(), threading.Event()
        self._remaining = Remaining({}, 1)
        self._done, self._total = 0, 0

    def __enter__(self) -> Progress:
        from tqdm import tqdm

        shape = "{desc} {percentage:3.0f}%|{bar}| {postfix}"
        self._bar = tqdm(total=100, desc="book", bar_format=shape, file=sys.stderr, dynamic_ncols=True, disable=None)
        self._ticker = threading.Thread(target=self._tick, daemon=True)
        self._ticker.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._over.set()
        self._ticker.join()
        self._bar.close()
        if kind is not None and self._total:
            self._page.stopped()

    def planned(self, numbers: Sequence[str], workers: int) -> None:
        """Chapters of this build."""
        seconds = recorded_seconds(self._fast)
        with self._lock:
            self._total = len(numbers)
            expected = {number: seconds.get(number) or UNKNOWN_S for number in numbers}
            self._remaining = Remaining(expected, workers, last=OVERVIEW)
            self._page.planned(numbers)

    def started(self, number: str) -> None:
        """A chapter is being built."""
        with self._lock:
            self._remaining.start(number, time.monotonic())
            self._page.started(number)

    def finished(self, number: str, outcome: Outcome, page: Path | None) -> None:
        """A chapter has come to its end."""
        with self._lock:
            self._done += 1
            self._remaining.finish(number, time.monotonic())
            self._page.finished(number, outcome, page)
        self._bar.write(str(outcome), file=sys.stdout)
        sys.stdout.flush()

    def _tick(self) -> None:
        while not self._over.wait(1.0):
            with self._lock:
                now = time.monotonic()
                left = in_words(self._remaining.seconds(now))
                self._bar.n = round(100 * self._remaining.share_done(now))
                self._bar.set_postfix_str(f"{self._done} of {self._total} chapters, {left}")
                self._page.left(f"{self._done} of {self._total} are done, {left}.")


def in_words(seconds: float) -> str:
    """A time that is left, as exact as it can be known."""
    if seconds < 50:
        return f"about {max(10, round(seconds, -1)):.0f} s left"
    return f"about {max(1, round(seconds / 60))} min left"
