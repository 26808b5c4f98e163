"""Exercises that run in the browser: JupyterLite with Pyodide, NumPy, SciPy, pandas and the checker, served locally.

``lite/pyodide-lock.json`` is the part of Pyodide 0.27.7's own lock file (from its npm package) that the exercises
need, ``lite/runtime.sha256`` its interpreter. Whatever brings the files, only those with these hashes are used.
"""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Sequence
from pathlib import Path

from grindvision.errors import GrindvisionError
from grindvision.files import sha256, write_json
from grindvision_book.machinery.places import NOTEBOOKS, ROOT

#: Chapters whose exercises and checkers need NumPy, SciPy and pandas only.
IN_BROWSER = ("02", "03", "04", "07", "08", "09", "12")

_PINS = Path(__file__).with_name("lite")
_PACKAGE = "grindvision.zip"
_SOURCES = ("grindvision/**/*.py", "grindvision_book/__init__.py", "grindvision_book/exercises/*.py")


def build_in_browser(folder: Path, notebooks: Path = NOTEBOOKS / "exercises") -> Path:
    """Build the pages of the exercises that run in the browser; return their folder, ``folder/pages``.

    Args:
        folder: working folder; what was downloaded there once is used again.
        notebooks: exercises, or their solutions.

    Raises:
        GrindvisionError: a package cannot be installed or downloaded, or a file of it is not the one that is pinned.
    """
    tools, source = _tools(folder / "tools"), folder / "source"
    shutil.rmtree(source, ignore_errors=True)
    _lay_out_pyodide(_downloaded(folder / "downloaded"), source)
    contents = source / "contents"
    contents.mkdir()
    for number in IN_BROWSER:
        for notebook in notebooks.glob(f"{number}_*.ipynb"):
            # The chapters themselves are not there to be opened.
            text = re.sub(r"\[([^\[\]]*)\]\(\.\./\w+\.ipynb\)", r"\1", notebook.read_text(encoding="utf-8"))
            (contents / notebook.name).write_text(text, encoding="utf-8")
    # All cells in the page, so that the browser's own search and print find them.
    write_json(source / "overrides.json", {"@jupyterlab/notebook-extension:tracker": {"windowingMode": "defer"}})
    pages = folder / "pages"
    shutil.rmtree(pages, ignore_errors=True)
    options = ["--no-sourcemaps", "--apps", "notebooks", "--output-dir", str(pages), "--contents", str(contents)]
    _run([str(tools / "bin" / "jupyter"), "lite", "build", "--lite-dir", str(source), *options], source)
    return pages


def in_browser_link(notebook: str, root: str) -> str:
    """HTML that opens an exercise in the browser; ``root`` leads to the first folder of the site."""
    return f"<a class='try' href='{root}lite/notebooks/index.html?path={notebook}'>Run it in the browser</a>"


def _tools(place: Path) -> Path:
    wanted, made = (_PINS / "requirements.txt").read_text(encoding="utf-8"), place / "installed.txt"
    if not made.exists() or made.read_text(encoding="utf-8") != wanted:
        _run([sys.executable, "-m", "venv", "--clear", str(place)], ROOT)
        pip = [str(place / "bin" / "python"), "-m", "pip", "install", "-q", "--disable-pip-version-check"]
        _run([*pip, "-r", str(_PINS / "requirements.txt")], ROOT)
        made.write_text(wanted, encoding="utf-8")
    return place


def _downloaded(place: Path) -> Path:
    pins = _PINS / "distribution.txt"
    if not (place / pins.name).exists() or sha256(place / pins.name) != sha256(pins):
        shutil.rmtree(place, ignore_errors=True)
        pip = [sys.executable, "-m", "pip", "download", "-q", "--disable-pip-version-check", "--no-deps"]
        _run([*pip, "--require-hashes", "-d", str(place), "-r", str(pins)], ROOT)
        shutil.copyfile(pins, place / pins.name)
    return place


def _lay_out_pyodide(downloaded: Path, source: Path) -> None:
    """Pyodide where JupyterLite looks for it, ``source/static/pyodide``: pinned files, and this checkout's package."""
    lock = json.loads((_PINS / "pyodide-lock.json").read_text(encoding="utf-8"))
    wanted = {package["file_name"]: package["sha256"] for package in lock["packages"].values()}
    for line in (_PINS / "runtime.sha256").read_text(encoding="utf-8").splitlines():
        digest, name = line.split()
        wanted[name] = digest
    pyodide = source / "static" / "pyodide"
    pyodide.mkdir(parents=True)
    for wheel in downloaded.glob("*.whl"):
        with zipfile.ZipFile(wheel) as archive:
            members = {Path(name).name: name for name in archive.namelist()}
            for name, digest in wanted.items():
                if name in members:
                    content = archive.read(members[name])
                    if hashlib.sha256(content).hexdigest() == digest:
                        (pyodide / name).write_bytes(content)
    if missing := sorted(name for name in wanted if not (pyodide / name).exists()):
        raise GrindvisionError(
            f"{', '.join(missing)} of Pyodide {lock['info']['version']} not found, or with other bytes than "
            f"{_PINS / 'pyodide-lock.json'} says; name another source in {_PINS / 'distribution.txt'}"
        )
    (source / "pypi").mkdir()
    for wheel in downloaded.glob("comm-*.whl"):  # asked for by the kernel, not in Pyodide
        shutil.copyfile(wheel, source / "pypi" / wheel.name)
    lock["packages"]["grindvision"] = _packed_checkout(pyodide / _PACKAGE)
    write_json(pyodide / "pyodide-lock.json", lock)


def _packed_checkout(target: Path) -> dict[str, object]:
    """Pack the package and the checker; return their entry in Pyodide's lock file, by which ``import`` loads them."""
    files = sorted(path for pattern in _SOURCES for path in ROOT.glob(pattern))
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in files:
            moment = (1980, 1, 1, 0, 0, 0)  # the same bytes from the same sources
            archive.writestr(zipfile.ZipInfo(path.relative_to(ROOT).as_posix(), moment), path.read_bytes())
    return {
        "depends": ["numpy", "scipy", "pandas"],
        "file_name": target.name,
        "imports": ["grindvision", "grindvision_book"],
        "install_dir": "site",
        "name": "grindvision",
        "package_type": "package",
        "sha256": sha256(target),
        "unvendored_tests": False,
        "version": "0",
    }


def _run(command: Sequence[str], folder: Path) -> None:
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        said = (done.stderr.strip() or done.stdout.strip()).splitlines()
        raise GrindvisionError(f"{' '.join(command)} failed: {' '.join(said[-3:]) or 'without a reason'}")
