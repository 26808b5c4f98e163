"""Every command as a service runs it: a plain user, a read-only installation, no home."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import grindvision
from grindvision.caches import matplotlib_has_a_folder
from tests.doors_law import good  # noqa: F401

#: As root the rights of files count for nothing, unless that right is given up.
WITHOUT_RIGHTS = ["setpriv", "--bounding-set=-all"] if hasattr(os, "getuid") and os.getuid() == 0 else []

pytestmark = pytest.mark.skipif(
    os.name != "posix" or bool(WITHOUT_RIGHTS and shutil.which("setpriv") is None),
    reason="needs POSIX rights, and as root setpriv to give up the right to overrule them",
)

COMMANDS = {
    "detect": "sample.ply test.ply",
    "groove": "a.ply",
    "calibrate": "m.csv --robot r.csv",
    "verify": "{calibrate} m.csv --limit-mm 5",
    "simulate": "welding --joint t-joint --camera d415",
}


@pytest.fixture(scope="module")
def installation(tmp_path_factory):
    """The package with the kernels that are compiled already, where nobody may write."""
    place = tmp_path_factory.mktemp("installed")
    package = Path(grindvision.__file__).parent
    shutil.copytree(package, place / "grindvision")
    shutil.copytree(package.parent / "data", place / "data")
    folders = [place, *(path for path in place.rglob("*") if path.is_dir())]
    for folder in folders:
        folder.chmod(0o555)
    yield place
    for folder in folders:
        folder.chmod(0o755)


def test_every_command_on_a_read_only_installation_without_a_home(installation, good, tmp_path):
    temporary, work = tmp_path / "tmp", tmp_path / "work"
    temporary.mkdir(mode=0o777)
    work.mkdir(mode=0o777)
    environment = {name: value for name, value in os.environ.items() if name not in ("MPLCONFIGDIR", "NUMBA_CACHE_DIR")}
    environment |= {"HOME": "/dev/null/home", "XDG_CACHE_HOME": "", "XDG_CONFIG_HOME": "", "TMPDIR": str(temporary)}
    environment |= {"PYTHONPATH": str(installation), "PYTHONDONTWRITEBYTECODE": "1"}
    for name, words in COMMANDS.items():
        asked = [str(good / word) if (good / word).is_file() else word for word in words.split()]
        asked = [word.format(**{one: work / one for one in COMMANDS}) for word in asked]
        done = subprocess.run(
            [*WITHOUT_RIGHTS, sys.executable, "-m", "grindvision", name, *asked, "-o", str(work / name)],
            env=environment, cwd=work, capture_output=True, text=True, timeout=300, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        assert not [line for line in done.stderr.splitlines() if not line.startswith("warning: ")], done.stderr
        assert "cache" not in done.stderr and "atplotlib" not in done.stderr
        assert ((work / name / "report.json").is_file() and (work / name / "report.png").is_file()) or name == "verify"
    assert list(temporary.glob("grindvision-*/*/matplotlib/fontlist*"))


def test_matplotlibs_folder_is_left_alone_where_it_has_one_and_the_environment_as_it_was(tmp_path, monkeypatch):
    for name in [name for name in sys.modules if name.partition(".")[0] == "matplotlib"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.delenv("MPLCONFIGDIR", raising=False)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    before = dict(os.environ)
    with matplotlib_has_a_folder():
        assert dict(os.environ) == before
    monkeypatch.setenv("XDG_CACHE_HOME", "/dev/null/none")
    before = dict(os.environ)
    with matplotlib_has_a_folder():
        assert Path(os.environ["MPLCONFIGDIR"]).is_dir()
    assert dict(os.environ) == before
    monkeypatch.setenv("MPLCONFIGDIR", str(tmp_path / "own"))
    with matplotlib_has_a_folder():
        assert os.environ["MPLCONFIGDIR"] == str(tmp_path / "own")
