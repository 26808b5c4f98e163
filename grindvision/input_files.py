"""The one way into a file that a user names: judged before it is opened, bounded while it is read, the same at the end.

Only plain files are read. A pipe or a device could keep a run waiting or never end, and what a run read could not be
named by its digest.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from grindvision.errors import FileError

#: What a path may lead to instead of a file.
OTHER_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
    (stat.S_ISSOCK, "a socket"),
)

#: Needs below this (bytes) are met by every machine; nobody asks how much memory is free.
LITTLE_MEMORY = 1 << 30


def check_file(path: str | Path) -> os.stat_result:
    """What the system says of a path that leads, links followed, to a plain file; nothing is opened.

    Raises:
        FileError: there is no such file, it is a folder, a pipe, a device or a socket, or it may not be looked at.
    """
    try:
        found = os.stat(path)
    except (FileNotFoundError, ValueError):
        raise FileError(f"{path}: no such file; check the path") from None
    except OSError as error:
        raise FileError(f"{path}: cannot be read ({error.strerror or error}); check the path and its rights") from None
    _refuse_other_kinds(path, found)
    return found


def check_output_file(path: str | Path) -> None:
    """Refuse to write to what exists and is no plain file, before anything waits for its reader.

    Raises:
        FileError: it is a folder, a pipe, a device or a socket, or may not be looked at.
    """
    try:
        found = os.stat(path)
    except FileNotFoundError:
        return
    except (OSError, ValueError) as error:
        raise FileError(f"cannot write {path}: {getattr(error, 'strerror', error)}; choose another place") from None
    _refuse_other_kinds(path, found)


@contextmanager
def open_input(path: str | Path) -> Iterator[BinaryIO]:
    """Open a plain file that a user names for reading.

    Raises:
        FileError: see ``check_file``; it may not be read, or not to its end; it changed meanwhile.
    """
    check_file(path)
    try:
        # Should the path lead to a pipe by now, opening does not wait for somebody to write into it.
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
        with open(handle, "rb") as file:
            before = os.fstat(file.fileno())
            _refuse_other_kinds(path, before)
            yield file
            after = os.fstat(file.fileno())
    except OSError as error:
        raise FileError(f"{path}: cannot be read ({error.strerror or error}); check the file and its rights") from None
    if (before.st_size, before.st_mtime_ns) != (after.st_size, after.st_mtime_ns):
        raise FileError(f"{path}: it changed while it was read; wait until it is written, then try again")


def read_input(path: str | Path, largest: int, kind: str) -> bytes:
    """All bytes of a plain file of no more than ``largest`` bytes; ``kind`` is what it should be, for the message.

    Raises:
        FileError: see ``open_input``; it is larger, or holds more than the system says, as files under /proc do.
    """
    with open_input(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > largest:
            raise FileError(f"{path}: {size} bytes; a {kind} file of this kind is small, check the path")
        data = file.read(size + 1)
    if len(data) != size:
        raise FileError(f"{path}: its size is given as {size} bytes, which it has not; copy it into a plain file")
    return data


def read_rest(path: str | Path, file: BinaryIO, memory_per_byte: float) -> bytes:
    """All bytes behind the place that was read up to, where so much memory per byte is free.

    Raises:
        FileError: it is not.
    """
    left = bytes_left(file)
    check_memory(path, memory_per_byte * left)
    return file.read(left)


def bytes_left(file: BinaryIO) -> int:
    """Bytes of an open file behind the place that was read up to."""
    return os.fstat(file.fileno()).st_size - file.tell()


def check_memory(path: str | Path, needed: float) -> None:
    """Refuse to begin what would need more memory than is free, in bytes; without a word where that is not known.

    Raises:
        FileError: too little is free.
    """
    if needed > LITTLE_MEMORY and (free := free_memory()) is not None and needed > free:
        raise FileError(
            f"{path}: reading it takes {needed / 1e9:.3g} GB of memory, {free / 1e9:.3g} GB are free; thin it out, or"
            " use a larger machine"
        )


def free_memory() -> int | None:
    """Bytes of memory that this process may still take, as Linux tells it; None elsewhere."""
    free: list[int] = []
    with suppress(OSError, ValueError, StopIteration):
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        free.append(1024 * next(int(line.split()[1]) for line in lines if line.startswith("MemAvailable")))
    group = Path("/sys/fs/cgroup")
    with suppress(OSError, ValueError):  # of a container; without a limit the word is "max"
        limit, used = (int((group / name).read_text(encoding="ascii")) for name in ("memory.max", "memory.current"))
        free.append(max(limit - used, 0))
    return min(free, default=None)


def _refuse_other_kinds(path: str | Path, found: os.stat_result) -> None:
    for is_kind, name in OTHER_KINDS:
        if is_kind(found.st_mode):
            raise FileError(f"{path}: {name}, not a file; check the path")
    if not stat.S_ISREG(found.st_mode):
        raise FileError(f"{path}: not a file; check the path")
