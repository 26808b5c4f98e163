"""Kernels keep their machine code: never a stale or damaged one, and without a word where nothing can be kept."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from grindvision import caches
from grindvision.clouds import write_ply
from grindvision.kernels import sources_of
from tests.grinding_scene import arc_bead, pair
from tests.groove_scenes import straight_groove
from tests.hand_eye_scene import looking_poses, seen_points, sphere_view
from tests.seam_scenes import corner

#: Root obeys no rights, unless it gives that up.
UNPRIVILEGED = ["setpriv", "--bounding-set=-all"] if os.name == "posix" and os.getuid() == 0 else []
CALLEE = "from grindvision.kernels import njit\n\n\n@njit(cache=True)\ndef one():\n    return {}\n"
CALLER = (
    "from grindvision.kernels import njit\n\nfrom grindvision.callee import one\n\n\n"
    "@njit(cache=True)\ndef twice():\n    return 2 * one()\n"
)


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A package of two kernels in two files, of which one calls the other."""
    package = tmp_path / "grindvision"
    package.mkdir()
    home = Path(caches.__file__).parent
    for name in ("caches.py", "kernels.py"):
        (package / name).write_text((home / name).read_text(encoding="utf-8"), encoding="utf-8")
    (package / "__init__.py").write_text('__version__ = "0"\n')
    (package / "callee.py").write_text(CALLEE.format(1))
    (package / "caller.py").write_text(CALLER)
    return package


def _twice(package: Path, **environment: str) -> tuple[int, int]:
    """What the kernel returns in a new process, and how many kernels were compiled for it."""
    code = (
        "import os, tempfile; tempfile.tempdir = os.environ.get('TMPDIR');"
        "import grindvision.kernels as k, numba.core.dispatcher as d; keep = k.KernelCache.save_overload; n = [];"
        "k.KernelCache.save_overload = lambda *a: (n.append(1), keep(*a));"
        "from grindvision.caller import twice; print(twice(), len(n))"
    )
    clean = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    run = subprocess.run(
        [*(UNPRIVILEGED if "HOME" in environment else []), sys.executable, "-c", code],
        cwd=package.parent,
        # Python's own cache takes a file of the same size and time for unchanged
        env=clean | {"PYTHONPATH": str(package.parent), "PYTHONDONTWRITEBYTECODE": "1"} | environment,
        capture_output=True,
        text=True,
        check=True,
    )
    assert run.stderr == ""
    result, compiled = run.stdout.split()
    return int(result), int(compiled)


def test_nothing_stale_and_nothing_damaged_is_used(package):
    assert _twice(package) == (2, 2)
    first, second = (package / "__pycache__" / "kernels").iterdir()
    content = first.read_bytes()
    first.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    second.write_bytes(content[:100])
    assert _twice(package) == (2, 2)
    (caller,) = (package / "__pycache__" / "kernels").glob("caller*")
    caller.unlink()
    assert _twice(package) == (2, 1)  # what is kept of a kernel serves the compilation of one that calls it
    (package / "other.py").write_text("")
    assert _twice(package) == (2, 0)
    time = (package / "callee.py").stat().st_mtime
    (package / "callee.py").write_text(CALLEE.format(9))  # as long as before, and as old, as two wheels may have it
    os.utime(package / "callee.py", (time, time))
    assert _twice(package) == (18, 2)
    assert len(list((package / "__pycache__" / "kernels").iterdir())) == 2  # what nothing asks for any more is gone


USE = """
from grindvision import kernels
from grindvision.cli import main
assert main(["compile"]) == 0
before = kernels.compiled
doors = ["detect s.ply t.ply", "grind s.ply t.ply", "groove g.ply", "groove g.ply --variant paper", "groove c.ply"]
doors.append("hand-eye poses.csv " + " ".join(f"v{k}.ply" for k in range(8)) + " --rotation ur --target sphere:38.1")
for door in doors:
    assert main([*door.split(), "-o", "out"]) == 0
assert kernels.compiled == before, "compiled by a tool, not beforehand"
"""


def test_after_compile_no_tool_compiles(tmp_path):
    scene = pair(seed=3, n_points=12_000, beads=[arc_bead()])
    rng = np.random.default_rng(1)
    clouds = {
        "s": scene.sample,
        "t": scene.test,
        "g": straight_groove(rng)[0],
        "c": corner(rng) * [1.0, -1.0, -1.0] + [0, 0, 400.0],
    }
    poses = looking_poses(rng, 8)
    clouds |= {f"v{k}": sphere_view(seen, 19.05, rng, 400) for k, seen in enumerate(seen_points(poses, rng))}
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_rotvec()
    np.savetxt(tmp_path / "poses.csv", np.hstack([poses[:, :3, 3], turns]), delimiter=",")
    for name, points in clouds.items():
        write_ply(tmp_path / f"{name}.ply", points)
    run = subprocess.run([sys.executable, "-c", USE], cwd=tmp_path, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr


LOAD_ALL = """
import pickle, sys
from numba.core.registry import cpu_target
from numba.core.runtime.nrt import rtsys
from grindvision.kernels import folder, restored
rtsys.initialize(cpu_target.target_context)
entries = sorted(folder().glob("*.kernel"))
for entry in entries:
    assert restored(cpu_target.target_context, pickle.loads(entry.read_bytes()[16:])).entry_point
assert "numba.typed.typeddict" not in sys.modules
print(len(entries))
"""


def test_kept_machine_code_needs_nothing_that_only_compilation_loads():
    # a symbol that is missing ends the process
    run = subprocess.run([sys.executable, "-c", LOAD_ALL], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    if not int(run.stdout):
        pytest.skip("no kernel has been compiled here")


def test_another_cache_folder_may_be_asked_for(package, tmp_path):
    assert _twice(package, NUMBA_CACHE_DIR=str(tmp_path / "mine")) == (2, 2)
    assert len(list((tmp_path / "mine").rglob("*.kernel"))) == 2
    assert not (package / "__pycache__" / "kernels").exists()


def test_files_that_a_kernel_depends_on_are_followed_through_others(package):
    (package / "base.py").write_text("")
    (package / "callee.py").write_text("from grindvision.base import SIZE\n")
    found = {file.name for file in sources_of(package / "caller.py", package)}
    assert found == {"base.py", "callee.py", "caches.py", "caller.py", "kernels.py"}


def test_a_read_only_installation_without_a_home(package, tmp_path):
    """As in a container: what the owner prepared is read, else temporary files are used, else nothing is kept."""
    if os.name != "posix" or (UNPRIVILEGED and shutil.which("setpriv") is None):
        pytest.skip("needs POSIX rights, and as root setpriv to give up the right to overrule them")
    assert _twice(package) == (2, 2)
    prepared = package / "__pycache__" / "kernels"
    temporary = tmp_path / "tmp"
    temporary.mkdir(mode=0o555)
    without = {
        "HOME": "/proc/nonexistent",
        "TMPDIR": str(temporary),
        "PYTHONDONTWRITEBYTECODE": "1",
        "XDG_CACHE_HOME": "",
    }
    try:
        _set_rights(package, 0o555)
        assert _twice(package, **without) == (2, 0)
        _set_rights(package, 0o755)
        shutil.rmtree(prepared)
        _set_rights(package, 0o555)
        assert _twice(package, **without) == (2, 2)
        assert _twice(package, **without) == (2, 2)
        temporary.chmod(0o777)
        assert _twice(package, **without) == (2, 2)
        assert _twice(package, **without) == (2, 0)
        assert not prepared.exists()
    finally:
        _set_rights(package, 0o755)


def _set_rights(package: Path, mode: int) -> None:
    for folder in (package, *(path for path in package.rglob("*") if path.is_dir())):
        folder.chmod(mode)


def test_folders_of_others_among_temporary_files_are_not_trusted(tmp_path, monkeypatch):
    monkeypatch.setattr(caches, "temporary_folder", lambda: tmp_path / "shared")
    folder = tmp_path / "shared" / "kernels"
    assert caches.made(folder) and caches.is_ours(folder)
    (tmp_path / "shared").chmod(0o777)
    assert not caches.made(folder) and not caches.is_ours(folder)


def test_a_section_is_the_same_compiled_and_from_the_cache(tmp_path):
    code = (
        "import numpy as np; from grindvision.vision.seam.profile_fit import fit_stations;"
        "rng = np.random.default_rng(1); across = np.sort(rng.uniform(-9, 9, (20, 61)), axis=1);"
        "up = rng.normal(0, 0.1, across.shape) - np.maximum(5 - np.abs(across), 0);"
        "start = np.tile([0, 0, 0, 4.0, -6, 0.5, 6], (20, 1));"
        "args = np.ones_like(up) * 50, start, np.ones_like(start), np.array([0.04, 0.04, 0.0]), 0.1, 0.5;"
        "print([part.tobytes().hex() for part in fit_stations(across, up, *args)])"
    )
    env = dict(os.environ, NUMBA_CACHE_DIR=str(tmp_path))
    runs = [subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, check=True) for _ in range(2)]
    assert runs[0].stdout == runs[1].stdout != b""
