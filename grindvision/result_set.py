"""A set of result files that changes as one: at no moment do files of an earlier run and of this one stand together.

A run writes into a hidden folder inside the folder of the results. When it has succeeded, one rename of that folder
decides: from then on the new set counts. Then the earlier set's files go, its manifest first; the new ones come, their
manifest last. A run that is killed in between leaves the decided set to the next run into that folder, which finishes
it; one that is killed before leaves a hidden folder, which the next run removes. A lock keeps two runs out of one
folder; the system lets go of it when a run ends, however it ends.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path, PurePosixPath

from grindvision.errors import FileError
from grindvision.interrupts import undisturbed
from grindvision.records import by_content

try:
    import fcntl
except ImportError:  # no such locks: two runs at once are the user's to avoid
    fcntl = None  # type: ignore[assignment]

LOCK, STAGING = ".grindvision-lock", ".grindvision-"
DECIDED, MOVING = ".grindvision-decided", ".grindvision-moving"
PLAN = ".grindvision-plan.json"

#: So often a folder may vanish under the run that locks it before that run gives up.
TRIES = 20


@by_content
@dataclass(frozen=True)
class _Plan:
    """What a decided set still has to do: its manifest's name, and the names of the earlier set's files."""

    last: str
    old: list[str]


@contextmanager
def write_set(folder: str | Path, last: str, outdated: Sequence[str] = ()) -> Iterator[Path]:
    """Yield an empty folder; when the block succeeds its files move into ``folder``, when not nothing is left of them.

    Files of an earlier set go: those that the new set has too, those named by ``outdated``, and those that the earlier
    manifest lists, if the same command wrote it. Everything else in the folder stays.

    Args:
        folder: made when it does not exist, and removed again when the block fails.
        last: the manifest, which goes first and comes last: where it stands, the set is complete.
        outdated: names, with wildcards, of files that an earlier set may have left and this one has not.

    Raises:
        FileError: the folder cannot be made or written to, or another run is writing to it, before the block; or a file
            cannot be put in place.
    """
    folder = Path(folder)
    with _folder_of_ours(folder) as alone:
        place = None
        try:
            if alone:
                _finish_or_remove_earlier(folder)
            with undisturbed():
                place = Path(tempfile.mkdtemp(prefix=STAGING, dir=folder))
            yield place
            with undisturbed():
                place = _decide(place, folder, last, outdated)
                _put_in_place(place, folder)
        except FileError as error:
            raise FileError(str(error).replace(f"{place}{os.sep}", f"{folder}{os.sep}")) from None
        except OSError as error:
            advice = "free space or choose another folder"
            if place is not None and place.name == DECIDED:
                advice = "make room there and run again; then the results of this run are put in place first"
            raise FileError(f"cannot write to {folder}: {error.strerror or error}; {advice}") from None
        finally:
            if place is not None and place.name != DECIDED:
                with undisturbed():
                    shutil.rmtree(place, ignore_errors=True)


@contextmanager
def _folder_of_ours(folder: Path) -> Iterator[bool]:
    """Make the folder and lock it; yields whether nobody else can be in it. Removes what it made and nobody filled."""
    new: list[Path] = []
    handle = None
    try:
        try:
            with undisturbed():
                new += [parent for parent in (folder, *folder.parents) if not parent.exists()]
                handle = _locked(folder)
        except OSError as error:
            raise FileError(f"cannot write to {folder}: {error.strerror}; choose a folder you may write to") from None
        yield handle is not None
    finally:
        if handle is not None:
            try:
                (folder / LOCK).unlink(missing_ok=True)  # still locked: who opened it finds that it is gone
            finally:
                os.close(handle)
        _remove_empty(new)


def _locked(folder: Path) -> int | None:
    """Handle of the folder's lock file; None where the file system has no locks.

    Raises:
        FileError: another run holds it. OSError: the folder cannot be made or written to.
    """
    for _ in range(TRIES):
        folder.mkdir(parents=True, exist_ok=True)
        try:
            handle = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o644)
        except FileNotFoundError:  # another run made the folder, failed, and removed it
            continue
        try:
            if fcntl is None:
                raise OSError
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(handle)
            raise FileError(f"{folder}: another run is writing to it; wait for it or choose another folder") from None
        except OSError:
            os.close(handle)
            (folder / LOCK).unlink(missing_ok=True)
            return None
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(handle), os.stat(folder / LOCK)):
                return handle
        os.close(handle)
    raise FileError(f"{folder}: other runs are writing to it; wait for them or choose another folder")


def _finish_or_remove_earlier(folder: Path) -> None:
    """Finish a set that was decided but not put in place, and remove what killed runs left; the folder is locked."""
    for name in (MOVING, DECIDED):
        if (folder / name / PLAN).is_file():
            _put_in_place(folder / name, folder)
    for left in folder.glob(f"{STAGING}*"):
        if left.is_dir() and not left.is_symlink():
            shutil.rmtree(left, ignore_errors=True)


def _decide(place: Path, folder: Path, last: str, outdated: Sequence[str]) -> Path:
    """Write down what has to go, and make the set count by one rename; returns where it stands then."""
    names = [str(path.relative_to(place)) for path in place.rglob("*") if path.is_file()]
    blocked = next((folder / name for name in names if (folder / name).is_dir()), None)
    if blocked is not None:
        raise FileError(f"cannot write {blocked}: it is a folder; remove it or choose another place")
    earlier = {str(path.relative_to(folder)) for pattern in outdated for path in folder.glob(pattern)}
    earlier |= {*names, *_listed(folder / last, place / last)}
    old = sorted(name for name in earlier if (folder / name).is_file())
    (place / PLAN).write_text(json.dumps(asdict(_Plan(last, old))), encoding="utf-8")
    os.replace(place, folder / DECIDED)
    return folder / DECIDED


def _put_in_place(decided: Path, folder: Path) -> None:
    """Remove the earlier set's files, its manifest first, then move the new ones in, their manifest last."""
    plan = _Plan(**json.loads((decided / PLAN).read_text(encoding="utf-8")))
    if decided.name == DECIDED:
        for name in sorted(plan.old, key=lambda name: name != plan.last):
            (folder / name).unlink(missing_ok=True)
            _remove_empty([parent for parent in (folder / name).parents if folder in parent.parents])
        os.replace(decided, folder / MOVING)
        decided = folder / MOVING
    files = [path for path in decided.rglob("*") if path.is_file() and path.name != PLAN]
    for path in sorted(files, key=lambda path: path.name == plan.last):
        target = folder / path.relative_to(decided)
        target.parent.mkdir(parents=True, exist_ok=True)
        os.replace(path, target)
    shutil.rmtree(decided, ignore_errors=True)


def _listed(earlier: Path, new: Path) -> list[str]:
    """Files of the earlier set by its manifest, where both manifests name the same command; only names below it."""
    with suppress(OSError, ValueError, KeyError, TypeError):
        before, now = (json.loads(path.read_text(encoding="utf-8")) for path in (earlier, new))
        if before["command"] == now["command"]:
            names = [PurePosixPath(name) for name in before["files"]]
            return [str(name) for name in names if not name.is_absolute() and ".." not in name.parts]
    return []


def _remove_empty(folders: Sequence[Path]) -> None:
    for folder in folders:
        with suppress(OSError):
            folder.rmdir()
