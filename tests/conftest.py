"""Settings of the whole test run: pinned arithmetic, no display, and where real data may be found."""

import contextlib
import gc
import io
import os
import runpy
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent

# by its file: it must stand before anything imports NumPy
runpy.run_path(str(ROOT / "grindvision_book" / "machinery" / "arithmetic.py"))["pin"]()
os.environ.setdefault("MPLBACKEND", "Agg")

# Measured data of others, where somebody has laid them beside the checkout.
if (ROOT.parent / "shared" / "real").is_dir():
    os.environ.setdefault("GRINDVISION_DATA", str(ROOT.parent / "shared" / "real"))

import hypothesis
import numpy as np
import pytest

# The same examples every time (`./run fuzz` draws new ones), and as much time for each as the machine takes.
hypothesis.settings.register_profile("tests", derandomize=True, deadline=None, print_blob=True)
hypothesis.settings.load_profile("tests")


def pytest_collection_modifyitems(items):
    """A long chapter that this machine has built in the full setting, as it is, has no need of the fast one."""
    from grindvision_book.machinery.chapters import LONG
    from grindvision_book.machinery.rebuilding import is_up_to_date

    for item in items:
        number = item.path.name[:2]
        if item.path.parent == ROOT / "notebooks" and number in LONG and is_up_to_date(number):
            item.add_marker(pytest.mark.skip(reason=f"chapter {number} was built here in the full setting as it is"))


def pytest_collection_finish():
    """What has been collected stays until the end: the search for garbage need not go through it again and again."""
    gc.collect()
    gc.freeze()


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20180913)


@pytest.fixture
def blank_pictures(monkeypatch):
    """Pictures take longer than all the rest of many commands, and the tests that look at them draw them."""
    from importlib import import_module

    def blank(*arguments):
        (path,) = (one for one in arguments if isinstance(one, Path))
        for name in ("report.png", "report.pdf") if path.is_dir() else (path.name,):
            ((path if path.is_dir() else path.parent) / name).write_bytes(b"picture")

    for path in sorted((ROOT / "grindvision" / "cli").glob("*_picture.py")):
        monkeypatch.setattr(import_module(f"grindvision.cli.{path.stem}"), "draw", blank)


@pytest.fixture(scope="session")
def real_data():
    """Path of a file of real measured data, or a skip with the reason where it is absent."""
    folder = Path(os.environ.get("GRINDVISION_DATA") or ROOT.parent / "shared" / "real")

    def find(name: str) -> Path:
        path = folder / name
        if not path.exists():
            pytest.skip(
                f"real data set {name} is not part of the project; GRINDVISION_DATA names no folder that has it"
            )
        return path

    return find


@pytest.fixture(scope="session")
def _site_and_warnings(tmp_path_factory):
    import fcntl

    from tests.built_site import build_whole_site

    # the workers of one run share what one of them has built
    root = tmp_path_factory.getbasetemp()
    folder = (root.parent if "PYTEST_XDIST_WORKER" in os.environ else root) / "whole_site"
    folder.mkdir(exist_ok=True)
    with open(folder / "lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / "said.txt").exists():
            complaints = io.StringIO()
            with contextlib.redirect_stderr(complaints):
                build_whole_site(folder)
            (folder / "said.txt").write_text(complaints.getvalue(), encoding="utf-8")
    return folder / "site", (folder / "said.txt").read_text(encoding="utf-8")


@pytest.fixture(scope="session")
def whole_site(_site_and_warnings) -> Path:
    """Every page of the HTML book, built once."""
    return _site_and_warnings[0]


@pytest.fixture(scope="session")
def site_warnings(_site_and_warnings) -> str:
    """What the build of the HTML book said."""
    return _site_and_warnings[1]
