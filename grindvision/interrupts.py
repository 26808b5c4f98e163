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
    exception is raised in a callback of a library that swallows it, it is raised again a moment later; where compiled
    code calls Python to make the objects that it returns, and would go on with what an exception leaves half-made, it
    is raised as soon as that code has returned. Any other error that follows a signal counts as its consequence.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    asked: list[int] = []

    def interrupt(number: int, frame: FrameType | None) -> None:
        signal.signal(number, signal.SIG_DFL)
        asked.append(number)
        caller = _waits_for_a_result(frame)
        if caller is None:
            raise Interrupted(number)
        _raise_in(caller, number)

    def swallowed(lost: sys.UnraisableHookArgs) -> None:
        if not isinstance(lost.exc_value, Interrupted):
            hook(lost)
        elif hasattr(signal, "setitimer"):
            again = lost.exc_value.number
            signal.signal(signal.SIGALRM, lambda _, frame: interrupt(again, frame))
            signal.setitimer(signal.ITIMER_REAL, AGAIN_S)

    hook, sys.unraisablehook = sys.unraisablehook, swallowed
    alarm = signal.getsignal(signal.SIGALRM) if hasattr(signal, "setitimer") else None
    before = {number: signal.getsignal(number) for number in ENDING}
    caught = [number for number, handler in before.items() if handler is not signal.SIG_IGN]
    for number in caught:
        signal.signal(number, interrupt)
    try:
        yield
    except Exception as error:
        if asked:
            raise Interrupted(asked[0]) from error
        raise
    finally:
        sys.unraisablehook = hook
        if asked and hasattr(signal, "setitimer"):
            signal.setitimer(signal.ITIMER_REAL, 0)
            signal.signal(signal.SIGALRM, alarm or signal.SIG_DFL)
        for number in caught:
            signal.signal(number, before[number] or signal.SIG_DFL)


def _waits_for_a_result(frame: FrameType | None) -> FrameType | None:
    """The frame that has called compiled code, where that code runs Python now to make what it returns.

    numba does so for types that it has pickled, and for named tuples. None where nothing of that kind is under way.
    """
    while frame is not None and not frame.f_globals.get("__name__", "").startswith(f"{__package__}."):
        is_unpickling = frame.f_code.co_name == "_numba_unpickle"
        if is_unpickling or frame.f_globals.get("__name__", "").startswith("namedtuple_"):
            return frame.f_back
        frame = frame.f_back
    return None


def _raise_in(caller: FrameType, number: int) -> None:
    """Let a frame raise ``Interrupted`` as soon as it goes on; at once where a debugger or a profile traces it."""
    if sys.gettrace() is not None:
        raise Interrupted(number)

    def goes_on(frame: FrameType, *_: object) -> None:
        sys.settrace(None)
        frame.f_trace = None
        raise Interrupted(number)

    caller.f_trace, caller.f_trace_opcodes = goes_on, True
    sys.settrace(lambda *_: None)


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
