"""The command line. Each command is a module of this folder with ``add_arguments`` and ``run``, loaded when called."""

from __future__ import annotations

import argparse
import atexit
import importlib
import os
import sys
import warnings
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, NoReturn

from grindvision import __version__
from grindvision.cli import own_process
from grindvision.cli.parameters import with_parameter_file
from grindvision.cli.streams import complain, say, shown_warnings, sound_streams
from grindvision.errors import GrindvisionError, GrindvisionWarning, MissingExtraError, clipped, one_line
from grindvision.interrupts import ending_signals_interrupt

COMMANDS = {
    "book": "rebuild chapters, figures and the scoreboard (and the HTML book)",
    "detect": "two scans in, grinding path out",
    "grind": "two scans in, grinding passes out; a scan afterwards in, verdict out",
    "groove": "a scan in, weld seams and torch trajectory out",
    "robots": "list the arms that are known by name",
    "calibrate": "sphere measurements in, calibrated arm and scanner out",
    "verify": "new measurements in, whether an old calibration still holds",
    "calibrate-field": "scans of a flat plate in, the depth error of the scanner out",
    "hand-eye": "clouds and controller poses in, where the camera sits on or beside the arm out",
    "data": "list or fetch the measured data that the book uses",
    "merge": "views and controller poses in, one cloud in the base frame out, and how well they meet",
    "compile": "compile the kernels of all tools, so that no first call waits for it",
    "simulate": "make inputs for detect, groove and calibrate, with the truth beside them",
    "study": "run a study of the book over many cases, here or on a Dask cluster",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns 0 when done, 2 on bad input (one line on stderr), 1 on anything else.

    A run that a signal ends returns 128 and the signal's number.
    """
    if arguments is None and "numpy" not in sys.modules:
        own_process.take_over()
    words = list(sys.argv[1:] if arguments is None else arguments)
    name = next((word for word in words if not word.startswith("-")), "")
    with sound_streams():
        code, interrupted = _judged(name, words)
    if arguments is None and (interrupted or own_process.ours):
        _end(code)
    return code


def _end(code: int) -> NoReturn:
    """End the process. Taking down what compiled code has loaded is left to the system: it takes a third of a second,
    and after an interruption it meets threads in that code, and aborts now and then."""
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            stream.flush()
    os._exit(code)


def _judged(name: str, words: list[str]) -> tuple[int, bool]:
    """The exit code, and whether a signal ended the run."""
    try:
        return _told(name, words), False
    except KeyboardInterrupt as error:
        return _failure(name, "interrupted; nothing half-written is left", getattr(error, "exit_code", 130)), True


def _told(name: str, words: list[str]) -> int:
    """The exit code of a run whose errors are told in one line each."""
    try:
        with ending_signals_interrupt(), warnings.catch_warnings():
            warnings.simplefilter("always", GrindvisionWarning)
            warnings.showwarning = _one_line
            shown_warnings.clear()
            return _run(name, words)
    except GrindvisionError as error:
        return _failure(name, str(error), 2)
    except MemoryError:
        return _failure(name, "not enough memory for this input; thin the cloud out or use a larger machine", 2)
    except OSError as error:
        what = f"{error.filename}: {error.strerror}" if error.filename else str(error.strerror or error)
        return _failure(name, f"{what}; check space, rights and paths", 2)
    except Exception as error:
        if os.environ.get("GRINDVISION_DEBUG"):
            raise
        hint = "a defect of grindvision; please report it with the traceback that GRINDVISION_DEBUG=1 shows"
        return _failure(name, f"{f'{type(error).__name__}: {error}'[:300]} ({hint})", 1)


def _run(name: str, words: list[str]) -> int:
    parser = _Parser(
        prog="grindvision",
        description="Robot vision for grinding and welding, and the experiment book of both papers.",
        epilog="`grindvision COMMAND --help` explains a command.",
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"grindvision {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for known, summary in COMMANDS.items():
        text = summary[0].upper() + summary[1:] + "."
        command = commands.add_parser(known, help=summary, description=text, allow_abbrev=False)
        if known == name:
            module = importlib.import_module(f"grindvision.cli.{known.replace('-', '_')}")
            module.add_arguments(command)
            at = words.index(name) + 1
            words = words[:at] + with_parameter_file(command, words[at:])
    options = parser.parse_args(words)
    own_process.postpone()
    try:
        return int(module.run(options))
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != "grindvision_book":
            raise
        raise MissingExtraError("it is no part of the installed package; run ./run book in a checkout") from error


def _failure(name: str, message: str, code: int) -> int:
    complain(f"grindvision {name}: {message}")
    return code


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        complain(f"{self.prog}: {clipped(message)}; `{self.prog} --help` lists what it takes")
        raise SystemExit(2)

    def print_help(self, file: Any = None) -> None:
        """On stdout, as every result is printed: a reader who has gone away had enough."""
        say(self.format_help().rstrip("\n"))


def _one_line(message: Warning | str, category: type[Warning], *_: object, **__: object) -> None:
    if issubclass(category, GrindvisionWarning):
        shown_warnings.append(one_line(str(message)))
        complain(f"warning: {message}")
