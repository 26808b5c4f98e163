"""What a running chapter is: its number, its fast setting, its look, and where it comes from."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
import warnings
from dataclasses import dataclass, field
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from grindvision.errors import InputError
from grindvision.files import write_text
from grindvision.open3d_import import leave_out_plotly
from grindvision_book.machinery.places import ROOT, figures_folder
from grindvision_book.machinery.shown_tables import table_html

if TYPE_CHECKING:
    import pandas as pd

#: One colour for one thing in the whole book (Okabe and Ito's palette: safe for colour-blind readers).
COLOURS = {
    "printed": "#000000",
    "ours": "#0072B2",
    "paper_variant": "#E69F00",
    "truth": "#009E73",
    "peer": "#CC79A7",
    "sample": "#56B4E9",
    "test": "#D55E00",
    "grey": "#999999",
}

#: A file of this name beside a chapter's figures says why they are not to be published.
UNPUBLISHED = "unpublished.txt"

_LIBRARIES = ("numpy", "scipy", "pandas", "matplotlib", "numba", "pin", "open3d-cpu", "open3d", "pyvista", "vtk")
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")


@dataclass
class _Session:
    chapter: str = ""
    answers: dict[tuple[str, str], dict[str, object]] = field(default_factory=dict)


_session = _Session()


def start(chapter: str) -> None:
    """Begin a chapter, named by its two digits: style of the figures, static 3D views, fixed threads, no chatter.

    Numerical libraries get one thread each where the environment does not say otherwise, so call it before NumPy
    is imported.

    Raises:
        InputError: not two digits.
    """
    if not (len(chapter) == 2 and chapter.isdigit()):
        raise InputError(f'chapter {chapter!r} is not a number of two digits; write book.start("03")')
    for variable in _THREADS:
        os.environ.setdefault(variable, "1")
    os.environ.setdefault("PYVISTA_OFF_SCREEN", "true")
    os.environ.setdefault("OPEN3D_DISABLE_WEB_VISUALIZER", "true")

    import matplotlib.pyplot as plt
    import pandas as pd

    plt.style.use(Path(__file__).with_name("book.mplstyle"))
    pd.set_option("display.float_format", "{:.5g}".format, "display.max_rows", 100, "display.max_colwidth", 80)
    if shell := _shell():
        shell.display_formatter.formatters["text/html"].for_type(pd.DataFrame, table_html)
    if pyvista := sys.modules.get("pyvista"):
        _look_of_scenes(pyvista)
    elif not any(isinstance(finder, _ScenesToCome) for finder in sys.meta_path):
        sys.meta_path.insert(0, _ScenesToCome())
    leave_out_plotly()
    warnings.formatwarning = _without_path
    _session.chapter = chapter
    _session.answers.clear()
    (figures_folder() / UNPUBLISHED).unlink(missing_ok=True)


def _without_path(message: Warning | str, category: type[Warning], *_: object, **__: object) -> str:
    """A warning as a page may show it: what it says, and not where on this machine."""
    return f"{category.__name__}: {message}\n"


def _shell() -> Any:
    """The IPython session or kernel that this runs in, else None."""
    ipython = sys.modules.get("IPython")
    return ipython.get_ipython() if ipython else None


class _ScenesToCome(MetaPathFinder):
    """Gives PyVista the look of the book once a chapter imports it; most draw no 3D scene, and it takes its time."""

    def find_spec(self, name: str, path: object = None, target: object = None) -> ModuleSpec | None:
        """Where PyVista is, and after its import its settings; None for any other module."""
        if name != "pyvista":
            return None
        sys.meta_path.remove(self)
        spec = find_spec(name)
        if spec is None or spec.loader is None:
            return None
        execute = spec.loader.exec_module

        def execute_and_set(module: ModuleType) -> None:
            execute(module)
            _look_of_scenes(module)

        spec.loader.exec_module = execute_and_set  # type: ignore[method-assign]
        return spec


def _look_of_scenes(pyvista: Any) -> None:
    """Static views on white, and no chatter of VTK's."""
    from vtkmodules.vtkCommonCore import vtkLogger

    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_ERROR)
    pyvista.set_jupyter_backend("static")
    pyvista.global_theme.background = "white"
    pyvista.global_theme.font.color = "black"
    pyvista.global_theme.window_size = [1200, 800]
    pyvista.global_theme.anti_aliasing = "ssaa"


def fast() -> bool:
    """Whether the fast setting is asked for (``GRINDVISION_FAST=1``): fewer trials, wider stated tolerances."""
    return os.environ.get("GRINDVISION_FAST", "0") not in ("", "0")


def current_chapter() -> str:
    """Two digits of the chapter that runs.

    Raises:
        InputError: no chapter has been started.
    """
    if not _session.chapter:
        raise InputError('no chapter runs; begin with book.start("03") (the number of your chapter)')
    return _session.chapter


def leave_as_committed(reason: str) -> None:
    """Show what this chapter makes here, but leave its committed figures, tables and answers as they are."""
    write_text(figures_folder() / UNPUBLISHED, reason)


def given_answers() -> dict[tuple[str, str], dict[str, object]]:
    """What the running chapter has answered so far: (item, quantity) -> row of its ``answers_NN.csv``."""
    return _session.answers


def provenance() -> pd.DataFrame:
    """What this chapter ran on: seed, setting, commit, Python and library versions."""
    import pandas as pd

    caller: dict[str, Any] = sys._getframe(1).f_globals
    rows = [
        ("chapter", current_chapter()),
        ("seed", str(caller.get("SEED", "none: nothing random"))),
        ("setting", "fast" if fast() else "full"),
        ("commit", _commit()),
        ("machine", f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores"),
        ("python", platform.python_version()),
        ("grindvision", version("grindvision")),
    ]
    for library in _LIBRARIES:
        try:
            rows.append((library, version(library)))
        except PackageNotFoundError:
            continue
    return pd.DataFrame(rows, columns=["what", "value"])


def _commit() -> str:
    """The commit, and whether what the numbers are computed from differs from it (rebuilt figures do not count)."""
    commit = _git("rev-parse", "--short", "HEAD")
    changed = _git("status", "--porcelain", "--", "grindvision", "grindvision_book", "notebooks", "data")
    return f"{commit} and changes that are not committed" if commit and changed else commit or "unknown"


def _git(*words: str) -> str:
    try:
        answer = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, timeout=10)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return answer.stdout.strip()
