"""A stop-watch with laps."""

from __future__ import annotations

import time
from typing import Any, TypeAlias

#: What a racer gives back: named arrays, ``laps_s``, and ``measured`` where it has a clock of its own.
Answer: TypeAlias = dict[str, Any]


class Laps:
    """Seconds of named stages: ``lap("icp")`` ends the stage that ran until now."""

    def __init__(self) -> None:
        self.laps_s: dict[str, float] = {}
        self._last = time.perf_counter()

    def __call__(self, name: str) -> None:
        now = time.perf_counter()
        self.laps_s[name] = now - self._last
        self._last = now
