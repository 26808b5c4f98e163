"""Exercises that run in the browser: what their checkers need, what is packed, and a run offline where it was built."""

import functools
import http.server
import json
import re
import subprocess
import sys
import threading
import zipfile
from pathlib import Path

import pytest

from grindvision.errors import GrindvisionError
from grindvision_book.machinery.places import BUILD, NOTEBOOKS
from grindvision_book.site import in_browser
from grindvision_book.site.in_browser import IN_BROWSER, build_in_browser
from grindvision_book.site.pdf import installed_chromium

PAGES = BUILD / "lite" / "pages"
CHROMIUM = installed_chromium()

#: Imports every exercise, checks its right solution, and refuses all modules that Pyodide is not given.
CHECK_ALL = """
import sys

class NotHere:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {"numba", "llvmlite", "pinocchio", "matplotlib", "pyvista", "nbformat", "PIL"}:
            raise ImportError(name)

sys.meta_path.insert(0, NotHere())
sys.path.insert(0, sys.argv[1])
import grindvision_book as book
from grindvision_book.exercises.checking import exercises_of
for chapter in sys.argv[2:]:
    for exercise in exercises_of(chapter):
        print(book.check(exercise.number, exercise.right))
"""


def test_the_checkers_need_only_what_is_packed(tmp_path):
    in_browser._packed_checkout(tmp_path / "package.zip")
    with zipfile.ZipFile(tmp_path / "package.zip") as archive:
        archive.extractall(tmp_path / "packed")
    words = [sys.executable, "-c", CHECK_ALL, str(tmp_path / "packed"), *IN_BROWSER]
    said = subprocess.run(words, cwd=tmp_path, env={"PATH": ""}, capture_output=True, text=True, check=False)
    assert not said.returncode, said.stderr
    lines = said.stdout.splitlines()
    assert len(lines) >= 4 * len(IN_BROWSER) - 1 and all(" right: " in line for line in lines), said.stdout


def test_the_package_is_packed_with_the_same_bytes_again(tmp_path):
    first, again = (in_browser._packed_checkout(tmp_path / name) for name in ("a.zip", "b.zip"))
    assert first["sha256"] == again["sha256"]


def test_every_package_that_is_asked_for_is_in_the_lock_file():
    lock = json.loads((Path(in_browser.__file__).with_name("lite") / "pyodide-lock.json").read_text(encoding="utf-8"))
    named = {re.sub("[-_.]+", "-", name).lower() for name in lock["packages"]}
    asked = {re.sub("[-_.]+", "-", name).lower() for entry in lock["packages"].values() for name in entry["depends"]}
    assert {"numpy", "scipy", "pandas", "ipython"} <= named and asked <= named


def test_files_with_other_bytes_are_refused_by_name(tmp_path):
    lock = json.loads((Path(in_browser.__file__).with_name("lite") / "pyodide-lock.json").read_text(encoding="utf-8"))
    with zipfile.ZipFile(tmp_path / "brought.whl", "w") as archive:
        archive.writestr(lock["packages"]["numpy"]["file_name"], b"other bytes")
    with pytest.raises(GrindvisionError, match=lock["packages"]["numpy"]["file_name"]):
        in_browser._lay_out_pyodide(tmp_path, tmp_path / "source")


def test_a_failed_installation_says_why(tmp_path, monkeypatch):
    monkeypatch.setattr(in_browser, "_run", lambda command, folder: _refuse(command))
    with pytest.raises(GrindvisionError, match="venv"):
        build_in_browser(tmp_path)


def _refuse(command):
    raise GrindvisionError(f"{' '.join(command)} failed: no network")


LAST_CELL_HAS_RUN = """() => [...document.querySelectorAll('.jp-OutputArea-output')]
    .some((output) => /exercise\\s+title/.test(output.innerText))"""
#: A right answer, with the word that the test looks for after the reload.
SOLVED_08_1 = "def widest_spread(paths):  # a hypothesis\nreturn (paths.max(axis=0) - paths.min(axis=0)).max(axis=0)"


@pytest.fixture(scope="module")
def served():
    if not (PAGES / "notebooks" / "index.html").exists():
        pytest.skip("the exercises in the browser were not built here; ./run site --in-browser builds them")
    handler = functools.partial(_Quiet, directory=str(PAGES))
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()


class _Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, format, *args):
        pass


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine; install the package chromium")
def test_an_exercise_is_solved_and_checked_offline_and_is_still_there_after_a_reload(served):
    sync_api = pytest.importorskip("playwright.sync_api", reason="the browser tests need the package playwright")
    exercise = next(NOTEBOOKS.glob("exercises/08_*.ipynb")).name
    asked = []
    with sync_api.sync_playwright() as playwright:
        flags = ["--no-sandbox", "--disable-gpu", "--disable-background-networking"]
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=flags)
        page = browser.new_page(viewport={"width": 1280, "height": 900})
        page.on("request", lambda request: asked.append(request.url))
        page.goto(f"{served}/notebooks/index.html?path={exercise}")
        assert "08-1 not yet" in _run_all(page)
        first = page.locator(".jp-CodeCell .cm-content").nth(1)
        first.click()
        page.keyboard.press("Control+A")
        page.keyboard.type(SOLVED_08_1)
        page.keyboard.press("Control+S")
        said = _run_all(page)
        assert "08-1 right" in said and "08-2 not yet" in said
        page.keyboard.press("Control+S")
        page.wait_for_timeout(1500)
        page.reload()
        page.wait_for_selector(".jp-CodeCell .cm-content")
        page.wait_for_timeout(2000)
        assert "hypothesis" in page.locator(".jp-CodeCell .cm-content").nth(1).inner_text()
        assert "08-1 right" in _run_all(page)
        browser.close()
    assert asked and all(url.startswith((served, "data:", "blob:")) for url in asked)


def _run_all(page) -> str:
    """Run every cell and return what they print, once the last one has shown its table."""
    page.wait_for_selector(".jp-Notebook .jp-CodeCell", timeout=60_000)
    page.wait_for_timeout(1500)
    page.get_by_role("menuitem", name="Kernel").click()
    page.get_by_text("Restart Kernel and Run All Cells").first.click()
    page.locator("dialog .jp-mod-accept").click()
    page.wait_for_timeout(3000)
    page.wait_for_function(LAST_CELL_HAS_RUN, timeout=180_000)
    return "\n".join(page.locator(".jp-OutputArea-output").all_inner_texts())
