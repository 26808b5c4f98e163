"""What the four tools share: options, stage times, warnings, and the set of files that appears whole or not at all."""

from __future__ import annotations

import argparse
import json
import os
import platform
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
from grindvision.cli.streams import complain, say, shown_warnings
from grindvision.errors import FileError, GrindvisionWarning, one_line
from grindvision.files import plain, sha256, write_text
from grindvision.result_set import write_set

if TYPE_CHECKING:
    from types import TracebackType

REPORT, PARAMETERS = "report.json", "parameters.toml"


def add_output_arguments(parser: argparse.ArgumentParser, required: bool = True) -> None:
    """Options of every tool: where results go, and parameters from a file."""
    group = parser.add_argument_group("output and parameters")
    group.add_argument(
        "-o", "--output", required=required, metavar="DIR", help="folder for the results, made if needed"
    )
    group.add_argument(
        "--parameters",
        metavar="FILE.toml",
        help="read options from a file: keys are the long names without dashes; the command line goes before the file,"
        " the file before the defaults. What was used is written to DIR/parameters.toml",
    )
    group.add_argument("--json", action="store_true", help="print report.json on stdout, and nothing else")


def _stamp(path: Path) -> tuple[int, int, int] | None:
    """What changes when a file is written again; None where it is gone."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_ino, found.st_size, found.st_mtime_ns


class Run:
    """One run of a tool, a context: on success its files stand in the output folder, on failure nothing does.

    ``place`` is where to write files meanwhile. Warnings are collected, and shown when all went well; its reports also
    hold those that the command has shown before, of its poses or of a calibration.
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
        self._shown = tuple(shown_warnings)
        self._stamps = {path: _stamp(path) for path in self._input_files()}

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
            for text in told[len(dict.fromkeys(self._shown)) :]:
                complain(f"warning: {text}")
            say(self._output, complete=self._options.output)
        return handled

    @property
    def warnings(self) -> list[str]:
        """What the user should know, a line each, in order."""
        texts = [one_line(str(one.message)) for one in self._caught if issubclass(one.category, GrindvisionWarning)]
        return list(dict.fromkeys((*self._shown, *texts)))

    def _input_files(self) -> list[Path]:
        """The inputs, and the files that options name."""
        given = [getattr(self._options, name) for name in self._inputs]
        given += [value for name, value in vars(self._options).items() if name not in (*NO_PARAMETERS, *self._inputs)]
        words = [word for one in given for word in (one if isinstance(one, list) else [one]) if isinstance(word, str)]
        return [Path(word) for word in dict.fromkeys(words) if os.path.isfile(word)]

    def _check_inputs(self) -> None:
        """Refuse results of inputs that changed meanwhile, or that the results would overwrite."""
        for path, before in self._stamps.items():
            if _stamp(path) != before:
                raise FileError(f"{path}: it changed during the run; wait until it is written, then run again")
            for made in self.place.rglob(path.name):
                target = Path(self._options.output) / made.relative_to(self.place)
                if os.path.exists(target) and os.path.samefile(target, path):
                    raise FileError(f"{path}: a result would overwrite this input; choose another folder with -o")

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
        questions: Sequence[str] = (),
    ) -> None:
        """Write parameters.toml and report.json; what is to be read is printed at the end with the names of all files.

        Args:
            message: the result in one line.
            results: what this tool found.
            from_the_data: parameters that were not given but followed from the data.
            times_s: seconds of stages that another room timed.
            shown: further lines for a person.
            questions: what the data cannot tell and a person should look at: sizes, places; in report.json too.
        """
        parameters = {
            name.replace("_", "-"): value
            for name, value in vars(self._options).items()
            if name not in ("command", *NO_PARAMETERS, *self._inputs)
        }
        with self.stage("hash"):
            text = parameters_text(self._options.command, parameters, plain(from_the_data))
            write_text(self.place / PARAMETERS, text)
            hashes = [{"name": path.name, "sha256": sha256(path)} for path in self._stamps]
            self._check_inputs()
        names = sorted({str(path.relative_to(self.place)) for path in self.place.rglob("*") if path.is_file()})
        names.append(REPORT)
        total = time.perf_counter() - self._begin
        content = {
            "command": self._options.command,
            "message": message,
            "warnings": self.warnings,
            "questions": list(questions),
            **results,
            "timings_s": {
                name: round(value, 6) for name, value in ({**self._times_s, **(times_s or {}), "total": total}).items()
            },
            "versions": {"grindvision": __version__, "python": platform.python_version()} | _versions(self._libraries),
            "parameters": parameters,
            "from_the_data": from_the_data,
            "inputs": hashes,
            "files": names,
            "outputs": [{"name": name, "sha256": sha256(self.place / name)} for name in names if name != REPORT],
        }
        text = json.dumps(plain(content), indent=2, ensure_ascii=False)
        write_text(self.place / REPORT, text + "\n")
        lines = [message, shown, *questions, f"in {self._options.output}: {', '.join(names)}"]
        self._output = text if self._options.json else "\n".join(line for line in lines if line)


def _versions(libraries: Sequence[str]) -> dict[str, str]:
    """Versions of those that are installed."""
    found = {}
    for name in libraries:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found
