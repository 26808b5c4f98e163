"""What is done in a process that runs one command and nothing else, and nowhere else: it starts and ends sooner."""

from __future__ import annotations

import gc
import os
import sys
from importlib import import_module
from types import ModuleType
from typing import Any

#: Whether this process was started for one command.
ours = False

#: Modules that numba, SciPy and Matplotlib import for what no command does: test helpers, Fortran, a settings file in
#: YAML, the names of all glyphs. They are read when something asks for what they hold.
SELDOM_ASKED = ("numpy.f2py", "numpy.testing", "yaml", "fontTools.agl")

#: New objects between two searches for rings of them that nobody holds; Python's own 700 let a twentieth of a start go
#: into looking at what has just been imported.
NEW_OBJECTS = 50_000


def take_over() -> None:
    """Say that this process is for one command: called before anything large has been imported."""
    global ours
    ours = True
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # no threads that one_blas_thread rests
    sys.modules.setdefault("coverage", None)  # type: ignore[arg-type]  # numba would import it where it is there
    gc.set_threshold(NEW_OBJECTS, 20, 100)


def postpone() -> None:
    """In such a process, let modules that are seldom asked be imported when something first asks for what they hold;
    those of NumPy where it is there, because it would look for them."""
    if not ours:
        return
    for name in SELDOM_ASKED:
        package, _, part = name.rpartition(".")
        if name in sys.modules or (package == "numpy" and package not in sys.modules):
            continue
        sys.modules[name] = _postponed(name)
        if package in sys.modules:
            setattr(sys.modules[package], part, sys.modules[name])


def _postponed(name: str) -> ModuleType:
    postponed = ModuleType(name)

    def read(attribute: str) -> Any:
        if attribute == "__file__":  # asked of all modules by who looks for one of them
            raise AttributeError(attribute)
        if sys.modules.get(name) is postponed:
            del sys.modules[name]
        return getattr(import_module(name), attribute)

    postponed.__getattr__ = read  # type: ignore[method-assign]
    return postponed
