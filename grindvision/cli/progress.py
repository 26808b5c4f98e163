"""A bar on stderr that counts the stages of a command: on a terminal, when it takes a while, where tqdm is."""

from __future__ import annotations

import sys
import threading
import time

PATIENCE_S = 2.0

COMPILING = "compiling for this processor, once: some half a minute (`grindvision compile` does it beforehand)"


class Progress:
    """Counts ``stages``; the time that has passed goes on while a stage runs."""

    def __init__(self, stages: int) -> None:
        self._stages = stages
        self._done = 0
        self._name = ""
        self._begin = time.monotonic()
        self._stop = threading.Event()
        self._watcher = threading.Thread(target=self._watch, daemon=True) if sys.stderr.isatty() else None
        if self._watcher is not None:
            self._watcher.start()

    def finished(self, name: str) -> None:
        """Count a stage as done."""
        self._done, self._name = self._done + 1, name

    def close(self) -> None:
        """Take the bar away."""
        self._stop.set()
        if self._watcher is not None:
            self._watcher.join()

    def _watch(self) -> None:
        if self._stop.wait(PATIENCE_S):
            return
        try:
            from tqdm import tqdm
        except ImportError:
            return

        shape = "{desc:>14} {bar:30} {n_fmt} of {total_fmt} stages, {elapsed}"
        with tqdm(total=self._stages, bar_format=shape, file=sys.stderr, leave=False) as bar:
            told = False
            bar.start_t -= time.monotonic() - self._begin
            while not self._stop.wait(0.2):
                bar.n = min(self._done, self._stages)
                kernels = sys.modules.get("grindvision.kernels")
                if not told and kernels is not None and kernels.compiled:
                    told = True
                    bar.write(COMPILING, file=sys.stderr)
                bar.set_description_str(f"{self._name} done" if self._name else "")
