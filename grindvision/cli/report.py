"""What the four tools share: options, stage times, warnings, and the set of files that appears whole or not at all."""

from __future__ import annotations

import argparse
import json
import platform
import sys
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from grindvision import __version__
from grindvision.cli.parameters import NO_PARAMETERS, parameters_text
from grindvision.cli.progress import Progress
from grindvision.errors import FileError, GrindvisionWarning
from grindvision.files import plain, sha256, write_set, write_text

if TYPE_CHECKING:
    from types import TracebackType

REPORT, PARAMETERS = "report.json", "parameters.toml"


def add_output_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of every tool: where results go, and parameters from a file."""
    group = parser.add_argument_group("output and parameters")
    group.add_argument("-o", "--output", required=True, metavar="DIR", help="folder for the results, made if needed")
    group.add_argument(
        "--parameters",
        metavar="FILE.toml",
        help="read options from a file: keys are the long names without dashes; the command line goes before the file,"
        " the file before the defaults. What was used is written to DIR/parameters.toml",
    )
    group.add_argument("--json", action="store_true", help="print report.json on stdout, and nothing else")


class Run:
    """One run of a tool, a context: on success its files stand in the output folder, on failure nothing does.

    ``place`` is where to write files meanwhile. Warnings are collected, and shown when all went well.
    """

    def __init__(
        self,
        options: argparse.Namespace,
        inputs: Sequence[str],
        libraries: Sequence[str],
        stages: int,
        outdated: Sequence[str] = (),
    ) -> None:
        self._options = options
        self._inputs = inputs
        self._libraries = libraries
        self._stages = stages
        self._outdated = (*outdated, "report.png")
        self._stack = ExitStack()
        self._times_s: dict[str, float] = {}
        self._output = ""

    def __enter__(self) -> Run:
        self._begin = time.perf_counter()
        with self._stack as stack:
            self.place = stack.enter_context(write_set(self._options.output, REPORT, self._outdated))
            self._caught = stack.enter_context(warnings.catch_warnings(record=True))
            warnings.simplefilter("always", GrindvisionWarning)
            self._progress = Progress(self._stages)
            stack.callback(self._progress.close)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool | None:
        told = self.warnings
        handled = self._stack.__exit__(kind, error, trace)
        if error is None:
            for text in told:
                print(f"warning: {text}", file=sys.stderr)
            try:
                print(self._output, flush=True)
            except BrokenPipeError:
                raise
            except OSError as failure:
                place = self._options.output
                raise FileError(f"{failure.strerror} on stdout; the results stand complete in {place}") from None
        return handled

    @property
    def warnings(self) -> list[str]:
        """What the user should know, a line each, in order."""
        texts = [
            " ".join(str(one.message).split()) for one in self._caught if issubclass(one.category, GrindvisionWarning)
        ]
        return list(dict.fromkeys(texts))

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time a block under ``name``."""
        begin = time.perf_counter()
        yield
        self.finished(name)
        self._times_s[name] = time.perf_counter() - begin

    def finished(self, name: str) -> None:
        """Count a stage that a function of another room reports as done."""
        self._progress.finished(name)

    def report(
        self,
        message: str,
        results: Mapping[str, Any],
        from_the_data: Mapping[str, Any],
        times_s: Mapping[str, float] | None = None,
        shown: str = "",
    ) -> None:
        """Write parameters.toml and report.json; ``shown`` is printed at the end with the names of all files.

        Args:
            message: the result in one line.
            results: what this tool found.
            from_the_data: parameters that were not given but followed from the data.
            times_s: seconds of stages that another room timed.
            shown: further lines for a person.
        """
        parameters = {
            name.replace("_", "-"): value
            for name, value in vars(self._options).items()
            if name not in ("command", *NO_PARAMETERS, *self._inputs)
        }
        with self.stage("hash"):
            text = parameters_text(self._options.command, parameters, plain(from_the_data))
            write_text(self.place / PARAMETERS, text)
            given = [getattr(self._options, name) for name in self._inputs]
            inputs = [Path(path) for paths in given for path in ([paths] if isinstance(paths, str) else paths)]
            inputs += [Path(value) for value in parameters.values() if isinstance(value, str) and Path(value).is_file()]
            hashes = [{"name": path.name, "sha256": sha256(path)} for path in dict.fromkeys(inputs)]
        names = sorted({str(path.relative_to(self.place)) for path in self.place.rglob("*") if path.is_file()})
        names.append(REPORT)
        total = time.perf_counter() - self._begin
        content = {
            "message": message,
            "warnings": self.warnings,
            **results,
            "timings_s": {
                name: round(value, 6) for name, value in ({**self._times_s, **(times_s or {}), "total": total}).items()
            },
            "versions": {"grindvision": __version__, "python": platform.python_version()} | _versions(self._libraries),
            "parameters": parameters,
            "from_the_data": from_the_data,
            "inputs": hashes,
            "files": names,
        }
        text = json.dumps(plain(content), indent=2, ensure_ascii=False)
        write_text(self.place / REPORT, text + "\n")
        lines = [message, shown, f"in {self._options.output}: {', '.join(names)}"]
        self._output = text if self._options.json else "\n".join(line for line in lines if line)


def _versions(libraries: Sequence[str]) -> dict[str, str]:
    """Versions of those that are installed."""
    found = {}
    for name in libraries:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found
