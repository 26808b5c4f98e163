"""Runs one notebook in a kernel of its own, and says what went wrong in one line."""

from __future__ import annotations

import asyncio
import atexit
import json
import os
import re
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from grindvision.files import write_whole
from grindvision_book.machinery.arithmetic import PINS, pins
from grindvision_book.machinery.event_loop import is_ending
from grindvision_book.machinery.notebook_files import nbformat

#: A cell that takes longer than this has hung.
CELL_TIMEOUT_S = 3600
#: A kernel on a loaded machine takes a minute and more to answer.
START_TIMEOUT_S = 900
NO_MESSAGE = "no message"

_LOADED = """
import json as _json, sys as _sys
print(_json.dumps([name for name in _sys.modules if name.split(".")[0] in ("grindvision", "grindvision_book")]))
"""


@dataclass(frozen=True)
class Run:
    """What became of a notebook: what failed (empty: nothing), and names of our modules that its kernel had loaded."""

    failure: str
    loaded: frozenset[str] = frozenset()


async def run_notebook(source: Path, copy: Path, environment: Mapping[str, str], folder: Path) -> Run:
    """Execute one notebook and write the copy with its outputs, whether it succeeds or not; cells count from 1.

    Args:
        source: the notebook.
        copy: where it goes with its outputs.
        environment: of the kernel.
        folder: that the kernel works in.

    Raises:
        asyncio.CancelledError: the build was told to end; no copy is written then.
    """
    from nbclient import NotebookClient
    from nbclient.exceptions import CellExecutionError, CellTimeoutError, DeadKernelError

    try:
        notebook = nbformat.read(source, as_version=4)
    except (OSError, ValueError, nbformat.ValidationError) as error:
        return Run(f"not a readable notebook ({_last_line(str(error))})")
    begun = [0]
    client = NotebookClient(
        notebook,
        timeout=CELL_TIMEOUT_S,
        startup_timeout=START_TIMEOUT_S,
        kernel_name="python3",
        extra_arguments=["--log-level=ERROR"],
        on_cell_start=lambda cell, cell_index: begun.append(cell_index + 1),
    )
    failure = ""
    asked = nbformat.v4.new_code_cell(_LOADED)
    notebook.cells.append(asked)
    with tempfile.TemporaryFile() as said:  # by the kernel itself and by C code; what Python says is in the notebook
        try:
            await client.async_execute(env=dict(environment), cwd=str(folder), stderr=said)
        except CellExecutionError as error:
            reason = error.evalue.strip() or _failing_line(error.traceback)
            failure = f"cell {begun[-1]} failed: {error.ename}: {_first_line(reason)}"
        except CellTimeoutError:
            failure = f"cell {begun[-1]} took longer than {CELL_TIMEOUT_S} s"
        except DeadKernelError:
            if is_ending():
                raise asyncio.CancelledError from None
            said.seek(0)
            last = _last_line(said.read().decode(errors="replace"))
            words = "" if last == NO_MESSAGE else f"; its last words: {last}"
            failure = f"cell {begun[-1]} ended its kernel (out of memory, or a crash in a library{words})"
        except RuntimeError as error:
            if begun != [0]:
                raise
            atexit.unregister(client._cleanup_kernel)  # left by nbclient, which has ended the kernel already
            failure = f"its kernel did not start ({_first_line(str(error))})"
    notebook.cells.remove(asked)
    with write_whole(copy) as path:
        nbformat.write(notebook, path)
    loaded = json.loads(asked.outputs[0]["text"]) if not failure and asked.outputs else []
    return Run(failure, frozenset(loaded))


def kernel_environment(fast: bool, threads: int) -> dict[str, str]:
    """Environment of a kernel: the setting, its share of the cores for numerical threads and studies, no chatter."""
    environment = {name: value for name, value in os.environ.items() if name != "MPLBACKEND"}
    one_thread = {name: "1" for name in PINS if name.endswith("_NUM_THREADS")}
    return environment | {
        "GRINDVISION_FAST": "1" if fast else "0",
        **pins(environment),
        **one_thread,
        "NUMBA_NUM_THREADS": str(threads),
        "LOKY_MAX_CPU_COUNT": str(threads),
        "TQDM_DISABLE": "1",
        "PYDEVD_DISABLE_FILE_VALIDATION": "1",
    }


def _failing_line(traceback: str) -> str:
    """The line of the cell that a traceback points at, for errors that say nothing themselves."""
    pointed = re.search(r"^-+> *\d+ (.+)$", re.sub(r"\x1b\[[\d;]*m", "", traceback), re.MULTILINE)
    return pointed[1] if pointed else ""


def _first_line(text: str) -> str:
    return next((line.strip() for line in text.splitlines() if line.strip()), NO_MESSAGE)


def _last_line(text: str) -> str:
    return _first_line("\n".join(reversed(text.splitlines())))
