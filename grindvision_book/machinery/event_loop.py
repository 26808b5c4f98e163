"""Running the chapters' kernels side by side so that a signal ends all of it, and leaves no kernel behind."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

Result = TypeVar("Result")


class _Loop(asyncio.SelectorEventLoop):
    """An event loop that leaves the signals alone: nbclient would clean up one kernel and let the build go on.

    ``ending`` is true from the moment when all that runs is told to end.
    """

    ending = False

    def add_signal_handler(self, sig: int, callback: Callable[..., object], *args: object) -> None:
        raise NotImplementedError("the signals that end a build belong to the command")

    def remove_signal_handler(self, *_: Any) -> bool:
        return False


def run_all(work: Coroutine[Any, Any, Result]) -> Result:
    """Run a coroutine to its end; whatever ends it, all tasks that it began are cancelled and clean up first."""
    loop = _Loop()
    asyncio.set_event_loop(loop)
    try:
        return loop.run_until_complete(work)
    finally:
        loop.ending = True
        try:
            tasks = asyncio.all_tasks(loop)
            for task in tasks:
                task.cancel()
            loop.run_until_complete(asyncio.gather(*tasks, return_exceptions=True))
            loop.run_until_complete(loop.shutdown_asyncgens())
            loop.run_until_complete(loop.shutdown_default_executor())
        finally:
            asyncio.set_event_loop(None)
            loop.close()


def is_ending() -> bool:
    """Whether the work that asks is told to end; nbclient takes that for a kernel that died."""
    return getattr(asyncio.get_running_loop(), "ending", False)
