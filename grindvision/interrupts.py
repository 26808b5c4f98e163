"""Requests to end a run (SIGINT, SIGTERM, SIGHUP): one exception, one exit code each, and moments they wait for."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

#: The signals that ask a run to end, where the system has them.
ENDING = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))


#: So long (s) after its exception was swallowed a signal is told again.
AGAIN_S = 0.02


class Interrupted(KeyboardInterrupt):
    """A signal asks the run to end; ``exit_code`` is the one that a shell gives such an end (130, 143, 129)."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number
        self.exit_code = 128 + number


@contextmanager
def ending_signals_interrupt() -> Iterator[None]:
    """Inside the block a signal to end raises ``Interrupted``, so that what is half-written is removed.

    A second one ends the process at once. Signals that the caller ignores (as under nohup) stay ignored. Where the
    exception is raised in a callback of a library that swallows it, it is raised again a moment later.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(number: int, _: FrameType | None) -> None:
        signal.signal(number, signal.SIG_DFL)
        raise Interrupted(number)

    def swallowed(lost: sys.UnraisableHookArgs) -> None:
        if not isinstance(lost.exc_value, Interrupted):
            hook(lost)
            return
        again = lost.exc_value.number
        if hasattr(signal, "setitimer"):
            signal.signal(signal.SIGALRM, lambda *_: interrupt(again, None))
            signal.setitimer(signal.ITIMER_REAL, AGAIN_S)

    hook, sys.unraisablehook = sys.unraisablehook, swallowed
    before = {number: signal.getsignal(number) for number in ENDING}
    caught = [number for number, handler in before.items() if handler is not signal.SIG_IGN]
    for number in caught:
        signal.signal(number, interrupt)
    try:
        yield
    finally:
        sys.unraisablehook = hook
        for number in caught:
            signal.signal(number, before[number] or signal.SIG_DFL)


@contextmanager
def undisturbed() -> Iterator[None]:
    """Inside the block, which must be short, signals to end wait; they take effect at its end."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    waiting: list[int] = []
    before = {number: signal.getsignal(number) for number in ENDING}
    held = [number for number, handler in before.items() if handler is not None]
    for number in held:
        signal.signal(number, lambda number, _: waiting.append(number))
    try:
        yield
    finally:
        for number in held:
            signal.signal(number, before[number])
        for number in waiting[:1]:
            signal.raise_signal(number)
