"""One build of the book at a time: a second one in the same folder is refused."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from grindvision.errors import FileError


@contextmanager
def only_build(build: Path) -> Iterator[None]:
    """Hold the folder's lock while the block runs; the system frees it when the process ends, however it ends.

    Raises:
        FileError: another process holds it, or the folder cannot be written to.
    """
    try:
        build.mkdir(parents=True, exist_ok=True)
        lock = open(build / "lock", "a+", encoding="utf-8")  # noqa: SIM115
    except OSError as error:
        raise FileError(f"cannot write to {build}: {error.strerror}; choose a checkout you may write to") from None
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            lock.seek(0)
            raise FileError(
                f"another build of the book runs in {build} (process {lock.read().strip() or 'unknown'}); "
                "wait for it, or stop it"
            ) from None
        lock.truncate(0)
        lock.write(f"{os.getpid()}\n")
        lock.flush()
        yield
