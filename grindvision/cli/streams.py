"""What is said on stdout and stderr, also where one of them is closed, full, or read by nobody any more."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TextIO

from grindvision.errors import FileError, one_line


@contextmanager
def sound_streams() -> Iterator[None]:
    """Inside the block stdin, stdout and stderr exist, and take every character; what is left is written at its end.

    A stream that the caller has closed leads nowhere; else the next file that is opened would take its place, and what
    a library prints would end up in a result.
    """
    with suppress(OSError):
        while (handle := os.open(os.devnull, os.O_RDWR)) <= 2:
            pass
        os.close(handle)
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115
    before = [(stream, stream.errors) for stream in (sys.stdout, sys.stderr) if hasattr(stream, "reconfigure")]
    for stream, _ in before:
        stream.reconfigure(errors="backslashreplace")
    try:
        yield
    finally:
        for stream, errors in before:
            with suppress(OSError, ValueError):
                stream.reconfigure(errors=errors)
        try:
            sys.stdout.flush()
        except (OSError, ValueError):
            _lead_nowhere(sys.stdout)


def say(text: str, complete: str = "") -> None:
    """Print a result on stdout. A reader who has gone away had enough; a full disk is told.

    Args:
        text: lines to print.
        complete: where the results stand all the same, for the message.

    Raises:
        FileError: stdout takes no more.
    """
    try:
        print(text, flush=True)
    except BrokenPipeError:
        _lead_nowhere(sys.stdout)
    except OSError as error:
        _lead_nowhere(sys.stdout)
        stands = f"; the results stand complete in {complete}" if complete else "; free space or print elsewhere"
        raise FileError(f"{error.strerror or error} on stdout{stands}") from None


#: Warnings that this command has shown before its ``Run`` began, in order: its reports repeat them.
shown_warnings: list[str] = []


def complain(text: str) -> None:
    """One line on stderr; where nobody can read it, nothing."""
    with suppress(OSError, ValueError):
        sys.stderr.write(f"{one_line(text)}\n")
        sys.stderr.flush()


def _lead_nowhere(stream: TextIO) -> None:
    """Let Python end without trying once more to write what the stream did not take."""
    with suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)
        stream.flush()
