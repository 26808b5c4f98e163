"""Chapters that were built on this machine, kept in ``build/kept`` while nothing that they depend on has changed.

A chapter's entry holds what it drew, its executed copy and its page, and ``made.json``: a hash of everything the
chapter depends on, and one of every file of the entry. An entry is renamed into place when it is whole. One that is
damaged, of another version of this format, or of other sources counts as not there, and the chapter is built again.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import platform
import re
import shutil
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib.metadata import distributions
from pathlib import Path

from grindvision import paper
from grindvision.errors import FileError
from grindvision.files import sha256, write_json
from grindvision.measured import absent_sets, measured_sets
from grindvision_book.machinery.dependencies import modules_of, modules_of_notebook, source_of
from grindvision_book.machinery.places import FIGURES, ROOT

FORMAT = 1

#: Settings of a kernel that change no number: places, and how many threads work.
_NO_MATTER = re.compile(r"GRINDVISION_(FIGURES|FINISHED|STUDIES|DATA|DEBUG)$|.*_NUM_THREADS$")
_SETTINGS = ("GRINDVISION_", "NUMBA_", "OPENBLAS_", "NPY_", "MKL_", "OMP_")

#: What a chapter depends on: name of the thing -> hash.
Parts = dict[str, str]


@dataclass(frozen=True)
class Entry:
    """A kept chapter: its folder, and the seconds that building it took."""

    folder: Path
    seconds: float

    @property
    def figures(self) -> Path:
        """Folder of what the chapter drew."""
        return self.folder / "figures"

    @property
    def executed(self) -> Path:
        """Notebook with its outputs."""
        return self.folder / "executed.ipynb"


def parts_of(number: str, notebook: Path, environment: Mapping[str, str], answers: Path | None = None) -> Parts:
    """Everything that the result of a chapter depends on.

    Args:
        number: two digits.
        notebook: the chapter.
        environment: of its kernel.
        answers: folder with the answers of the other chapters, for the chapter that looks back on them.

    Raises:
        FileError: the notebook cannot be read.
    """
    parts = {"format": str(FORMAT), "notebook": sha256(notebook), "installed packages": installed()}
    texts = [notebook.read_text(encoding="utf-8")]
    for module in sorted(modules_of_notebook(notebook)):
        path = source_of(module)
        if path is not None:
            parts[f"module {module}"] = sha256(path)
            texts.append(path.read_text(encoding="utf-8"))
    for race in sorted({name for text in texts for name in re.findall(r"\bbench_\w+(?=\.csv)", text)}):
        if (FIGURES / f"{race}.csv").is_file():
            parts[f"race {race}"] = sha256(FIGURES / f"{race}.csv")
    parts |= _data(number if answers is None else "")
    if any("measured import find_measured" in text for text in texts):
        parts["measured data"] = _digest(",".join(absent_sets(list(measured_sets()))).encode())
    parts["settings"] = _settings(environment)
    for path in sorted(answers.glob("answers_[0-9][0-9].csv")) if answers else ():
        parts[path.stem] = sha256(path)
    return parts


@cache
def study_inputs(module: str) -> str:
    """One hash of what the rows of a study depend on beside its cases: code, data, libraries and settings."""
    parts = {name: sha256(path) for name in modules_of(module) if (path := source_of(name)) is not None}
    parts |= {name: value for name, value in _data("").items() if name != "data expected.csv"}
    parts |= {"installed packages": installed(), "settings": _settings(os.environ)}
    return _digest(json.dumps(parts, sort_keys=True).encode())


def find(kept: Path, number: str, parts: Parts) -> tuple[Entry | None, str]:
    """The entry of a chapter if it is whole and everything it depends on is as it was; else None and why, in words."""
    folder = kept / number
    try:
        made = json.loads((folder / "made.json").read_text(encoding="utf-8"))
        then, files, seconds = dict(made["parts"]), dict(made["files"]), float(made["seconds"])
    except FileNotFoundError:
        return None, "never built here"
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None, "what was kept of it is damaged"
    if changed := sorted(name for name in {*then, *parts} if then.get(name) != parts.get(name)):
        more = f" and {len(changed) - 1} more" if len(changed) > 1 else ""
        return None, f"changed: {changed[0]}{more}"
    if files != _files(folder) or not math.isfinite(seconds):
        return None, "what was kept of it is damaged"
    return Entry(folder, seconds), ""


@contextmanager
def new_entry(kept: Path) -> Iterator[Path]:
    """Yield an empty folder to build a chapter in; what has not been put into place by ``keep`` is removed."""
    kept.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(prefix=".building-", dir=kept))
    (folder / "figures").mkdir()
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def keep(folder: Path, number: str, parts: Parts, seconds: float) -> Entry:
    """Put a folder of ``new_entry`` into place as the entry of a chapter, instead of whatever stands there.

    Raises:
        FileError: what stands there cannot be removed.
    """
    write_json(folder / "made.json", {"parts": parts, "files": _files(folder), "seconds": round(seconds, 1)})
    place = folder.parent / number
    try:
        if place.is_symlink() or place.is_file():
            place.unlink()
        shutil.rmtree(place, ignore_errors=True)
        folder.rename(place)
    except OSError as error:
        raise FileError(f"{place} cannot be replaced: {error.strerror}; remove it and build again") from None
    return Entry(place, seconds)


def clear_unfinished(kept: Path) -> None:
    """Remove what builds that were killed have left."""
    for folder in kept.glob(".building-*"):
        shutil.rmtree(folder, ignore_errors=True)


def _files(folder: Path) -> dict[str, str]:
    found = (path for path in sorted(folder.rglob("*")) if path.is_file() and path.name != "made.json")
    return {path.relative_to(folder).as_posix(): sha256(path) for path in found}


def _data(number: str) -> Parts:
    """Data files of the book and of the package; of the expected numbers the chapter's own rows, or all for ``""``."""
    parts = {}
    roots = {paper.data_folder(), ROOT / "grindvision"}
    for root in sorted(roots):
        for path in sorted(root.rglob("*")):
            if (
                not path.is_file()
                or path.suffix in (".py", ".pyc", ".nbi", ".nbc", ".md")
                or "__pycache__" in path.parts
            ):
                continue
            name = f"data {path.name}"
            if path.name == "expected.csv" and number:
                rows = paper.expected()
                parts[name] = _digest(rows[rows["chapter"] == number].to_csv(index=False).encode())
            else:
                parts[name] = _digest(f"{parts.get(name, '')}{sha256(path)}".encode())
    return parts


def _settings(environment: Mapping[str, str]) -> str:
    """One hash of the settings of a process that may change a number."""
    counting = {
        name: value for name, value in environment.items() if name.startswith(_SETTINGS) and not _NO_MATTER.match(name)
    }
    return _digest(json.dumps(counting, sort_keys=True).encode())


@cache
def installed() -> str:
    """Python and every installed package, but not our own: those count by their sources."""
    packages = {f"{dist.name}=={dist.version}" for dist in distributions() if "grindvision" not in (dist.name or "")}
    return _digest("\n".join([sys.version, platform.machine(), *sorted(packages)]).encode())


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
