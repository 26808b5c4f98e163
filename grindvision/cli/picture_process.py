"""A report's picture by a process of its own, which loads Matplotlib and lays the sheet out while the tool computes."""

from __future__ import annotations

import atexit
import os
import pickle
import signal
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import NoReturn

from grindvision.cli import own_process, pictures
from grindvision.interrupts import ENDING, undisturbed
from grindvision.parallel import usable_cores

DONE = b"."


def drawing_beside(module: str) -> Callable[..., None]:
    """Function ``draw`` of a module of this folder, run by a process that begins at once to make itself ready: it loads
    the module, and calls its function ``blank`` for the sheet that ``draw`` gets as its last argument.

    What is drawn goes to that process: plain numbers and words, of no class whose module loads what computes. Without
    a second core, where nobody started this process for one command, or it runs threads, this is ``drawing``.
    """
    alone = own_process.ours and threading.active_count() == 1
    if not (pictures.are_wanted() and alone and sys.platform == "linux" and usable_cores() > 1):
        return pictures.drawing(module)
    try:
        return _Draughtsman(module)
    except OSError:  # no more processes or files
        return pictures.drawing(module)


class _Draughtsman:
    """A process that draws one picture when it is told what, and ends; where it fails, this one draws."""

    def __init__(self, module: str) -> None:
        self._module = module
        theirs_to_read, self._orders = os.pipe()
        self._answers, theirs_to_write = os.pipe()
        with undisturbed():
            self._process = os.fork()
            if self._process == 0:
                _draw_one(module, theirs_to_read, theirs_to_write, (self._orders, self._answers))
        os.close(theirs_to_read)
        os.close(theirs_to_write)
        atexit.register(self._dismiss)

    def __call__(self, *what: object) -> None:
        try:
            with open(self._orders, "wb") as orders, open(self._answers, "rb") as answers:
                pickle.dump(what, orders, protocol=5)
                orders.close()
                done = answers.read() == DONE
        except OSError:
            done = False
        if not done:
            pictures.drawing(self._module)(*what)

    def _dismiss(self) -> None:
        """Let nothing of it outlast this process."""
        with suppress(OSError):
            os.kill(self._process, signal.SIGKILL)
            os.waitpid(self._process, 0)


def _draw_one(module: str, orders: int, answers: int, others: tuple[int, ...]) -> NoReturn:
    """Life of the process that draws; it ends with the other one, whose ends of the pipes are ``others``, and is silent
    where it fails."""
    try:
        for number in ENDING:
            signal.signal(number, signal.SIG_IGN if number == signal.SIGINT else signal.SIG_DFL)
        for one in others:
            os.close(one)
        nowhere = os.open(os.devnull, os.O_RDWR)
        for stream in range(3):
            os.dup2(nowhere, stream)
        artist = pictures.loaded(module)
        sheet = artist.blank()
        with open(orders, "rb") as file:
            what = pickle.load(file)
        artist.draw(*what, sheet)
        os.write(answers, DONE)
    finally:
        os._exit(0)
