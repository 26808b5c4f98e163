"""The command line. Each command is a module of this folder with ``add_arguments`` and ``run``, loaded when called."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
import warnings
from collections.abc import Sequence
from typing import NoReturn

from grindvision import __version__
from grindvision.errors import GrindvisionError, GrindvisionWarning

COMMANDS = {
    "book": "rebuild chapters, figures and the scoreboard (and the HTML book)",
    "detect": "two scans in, grinding path out",
    "groove": "a scan in, weld groove and torch trajectory out",
    "calibrate": "sphere measurements in, calibrated arm and scanner out",
    "simulate": "make inputs for the three above, with the truth beside them",
    "study": "run a study of the book over many cases, here or on a Dask cluster",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns 0 when done, 2 on bad input (one line on stderr), 1 on anything else."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    parser = _Parser(
        prog="grindvision",
        description="Robot vision for grinding and welding, and the experiment book of both papers.",
        epilog="`grindvision COMMAND --help` explains a command.",
    )
    parser.add_argument("--version", action="version", version=f"grindvision {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    chosen = next((word for word in words if not word.startswith("-")), None)
    for name, summary in COMMANDS.items():
        command = commands.add_parser(name, help=summary, description=summary[0].upper() + summary[1:] + ".")
        if name == chosen:
            module = importlib.import_module(f"grindvision.cli.{name}")
            module.add_arguments(command)
    options = parser.parse_args(words)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("always", GrindvisionWarning)
            warnings.showwarning = _one_line
            return int(module.run(options))
    except GrindvisionError as error:
        print(f"grindvision {options.command}: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"grindvision {options.command}: interrupted; nothing half-written is left", file=sys.stderr)
        return 1
    except Exception as error:
        if os.environ.get("GRINDVISION_DEBUG"):
            raise
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:300]
        hint = "a defect of grindvision; please report it with the traceback that GRINDVISION_DEBUG=1 shows"
        print(f"grindvision {options.command}: {reason} ({hint})", file=sys.stderr)
        return 1


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message}; `{self.prog} --help` lists what it takes\n")


def _one_line(message: Warning | str, category: type[Warning], *_: object, **__: object) -> None:
    if issubclass(category, GrindvisionWarning):
        print(f"warning: {' '.join(str(message).split())}", file=sys.stderr)
