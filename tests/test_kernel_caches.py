"""Compiled kernels whose callee, in another file, has changed are compiled anew."""

import os
import subprocess
import sys
from pathlib import Path

from grindvision.kernel_caches import drop_stale_caches

CALLEE = "from numba import njit\n\n\n@njit(cache=True)\ndef one():\n    return {}\n"
CALLER = (
    "from numba import njit\n\nfrom grindvision.callee import one\n\n\n"
    "@njit(cache=True)\ndef twice():\n    return 2 * one()\n"
)


def _twice(folder: Path) -> int:
    forgetting = "from grindvision.kernel_caches import drop_stale_caches; drop_stale_caches()"
    code = f"{forgetting}; from grindvision.caller import twice; print(twice())"
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    environment.pop("NUMBA_CACHE_DIR", None)
    run = subprocess.run(
        [sys.executable, "-c", code], cwd=folder, env=environment, capture_output=True, text=True, check=True
    )
    return int(run.stdout)


def test_a_kernel_notices_that_the_kernel_it_calls_has_changed(tmp_path: Path) -> None:
    package = tmp_path / "grindvision"
    package.mkdir()
    (package / "__init__.py").write_text("")
    source = Path(drop_stale_caches.__code__.co_filename)
    (package / "kernel_caches.py").write_text(source.read_text(encoding="utf-8"), encoding="utf-8")
    for name in ("__init__.py", "kernel_caches.py"):
        os.utime(package / name, (0, 0))
    (package / "callee.py").write_text(CALLEE.format(1))
    (package / "caller.py").write_text(CALLER)
    assert _twice(tmp_path) == 2
    (package / "callee.py").write_text(CALLEE.format(10))
    assert _twice(tmp_path) == 20
    assert drop_stale_caches(package) == []


def test_caches_stay_while_only_other_files_change(tmp_path: Path) -> None:
    cache = tmp_path / "vision" / "__pycache__" / "caller.twice-6.py311.nbi"
    cache.parent.mkdir(parents=True)
    files = {
        "geometry/callee.py": "",
        "vision/caller.py": "from grindvision.geometry.callee import one\n",
        "other.py": "",
    }
    for name, text in files.items():
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
        os.utime(path, (1000, 1000))
    cache.write_bytes(b"")
    os.utime(cache, (2000, 2000))
    assert drop_stale_caches(tmp_path) == []
    os.utime(tmp_path / "other.py", (3000, 3000))
    assert drop_stale_caches(tmp_path) == []
    os.utime(tmp_path / "geometry" / "callee.py", (3000, 3000))
    assert drop_stale_caches(tmp_path) == [cache] and not cache.exists()
