"""Every command from the built wheel, in a folder outside the checkout: with the core alone, and with the extras."""

import json
import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

from grindvision import __version__, kernels
from grindvision.arm import write_arm
from grindvision.clouds import write_ply
from tests.calibration_rig import as_table, er3a, rig
from tests.grinding_scene import arc_bead, pair
from tests.groove_scenes import straight_groove

ROOT = Path(__file__).resolve().parent.parent
NOT_CORE = [
    "matplotlib", "tqdm", "pinocchio", "coal", "pink", "daqp", "toppra", "open3d", "manifold3d", "small_gicp",
    "pyvista", "joblib", "distributed", "grindvision_book", "IPython", "sklearn", "cv2",
]  # fmt: skip

#: Runs each command line of a JSON list with some packages hidden, and prints exit codes and what was said.
RUNNER = """
import contextlib, io, json, sys
hidden, commands = json.loads(sys.argv[1]), json.loads(sys.argv[2])
class Hidden:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in hidden:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Hidden())
import grindvision
from grindvision.cli import main
answers = [grindvision.__file__]
for words in commands:
    error = io.StringIO()
    with contextlib.redirect_stderr(error), contextlib.redirect_stdout(io.StringIO()):
        code = main(words)
    answers.append([code, error.getvalue()])
print(json.dumps(answers))
"""


@pytest.fixture(scope="session")
def wheel(tmp_path_factory) -> Path:
    """The wheel, built from a copy of what git would ship."""
    folder = tmp_path_factory.mktemp("wheel")
    tree = folder / "tree"
    names = ["grindvision", "data", "pyproject.toml", "setup.py", "MANIFEST.in", "README.md", "LICENSE"]
    for name in names:
        files = [ROOT / name] if (ROOT / name).is_file() else (ROOT / name).rglob("*")
        for file in files:
            if file.is_file() and "__pycache__" not in file.parts and "synthetic" not in file.parts:
                copy = tree / file.relative_to(ROOT)
                copy.parent.mkdir(parents=True, exist_ok=True)
                copy.write_bytes(file.read_bytes())
    command = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", str(folder), str(tree)]
    made = subprocess.run(command, capture_output=True, text=True)
    if "setuptools" in made.stderr and made.returncode:
        pytest.skip(f"pip cannot fetch what builds the wheel: {made.stderr[-200:]}")
    assert made.returncode == 0, made.stderr[-2000:]
    return next(folder.glob("grindvision-*.whl"))


@pytest.fixture(scope="session")
def site(wheel) -> Path:
    """The wheel, unpacked."""
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(wheel.parent / "site")
    return wheel.parent / "site"


@pytest.fixture(scope="session")
def inputs(tmp_path_factory) -> Path:
    folder, rng = tmp_path_factory.mktemp("inputs"), np.random.default_rng(1)
    case = pair(seed=11, n_points=20_000, beads=[arc_bead()])
    write_ply(folder / "sample.ply", case.sample)
    write_ply(folder / "test.ply", case.test)
    write_ply(folder / "groove.ply", straight_groove(rng)[0])
    x, y = np.meshgrid(np.arange(-60, 60, 1.5), np.arange(-40, 40, 1.5))
    for number in range(3):
        flat = np.full(x.size, 400.0 + 15 * number)
        write_ply(folder / f"plate{number}.ply", np.column_stack([x.ravel(), y.ravel(), flat]))
    made = rig(er3a(), rng, test=12)
    as_table(made.measurements).to_csv(folder / "spheres.csv", index=False)
    write_arm(er3a(), folder / "robot.csv")
    (folder / "pose.json").write_text(json.dumps({"T_base_scanner": np.eye(4).tolist(), "base": "model"}))
    return folder


def _kernels_of_here(folder: Path) -> Path:
    """A cache of kernels that is this checkout's: the wheel's files are the same, and compiling takes long."""
    place = folder / "compiled"
    place.mkdir(exist_ok=True)
    if not (place / "grindvision").exists():
        kernels.folder().mkdir(parents=True, exist_ok=True)
        (place / "grindvision").symlink_to(kernels.folder())
    return place


def _run(site: Path, folder: Path, hidden: list[str], commands: list[list[str]]) -> list[tuple[int, str]]:
    environment = {name: value for name, value in os.environ.items() if name not in ("GRINDVISION_DATA", "PYTHONPATH")}
    run = subprocess.run(
        [sys.executable, "-c", RUNNER, json.dumps(hidden), json.dumps(commands)],
        cwd=folder,
        env=environment | {"PYTHONPATH": str(site), "NUMBA_CACHE_DIR": str(_kernels_of_here(site.parent))},
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stderr
    place, *answers = json.loads(run.stdout.splitlines()[-1])
    assert Path(place).is_relative_to(site)
    return [(code, error) for code, error in answers]


def test_the_core_runs_the_four_tools_and_names_what_the_others_need(site, inputs, tmp_path):
    at = {file.stem: str(file) for file in inputs.iterdir()}
    plates = [at[f"plate{number}"] for number in range(3)]
    works = [
        ["detect", at["sample"], at["test"], "-o", "detect"],
        ["groove", at["groove"], "-o", "groove"],
        ["calibrate", at["spheres"], "--robot", at["robot"], "-o", "calibrate"],
        ["calibrate-field", *plates, "--steps-mm", "0", "15", "30", "-o", "field"],
    ]
    pose = at["pose"]
    needs = {
        "robot": [["groove", at["groove"], "-o", "no", "--robot", "ur3", "--scanner-pose", pose]],
        "sim": [["simulate", subject, "-o", "no"] for subject in ("grinding", "welding", "calibration")],
    }
    commands = works + [words for several in needs.values() for words in several]
    commands += [["book"], ["study", "path", "-o", "rows.csv"]]
    answers = _run(site, tmp_path, NOT_CORE, commands)
    for words, (code, error) in zip(works, answers, strict=False):
        assert code == 0, (words, error)
        assert "report.png is left out" in error and "pip install 'grindvision[plot]'" in error
        assert (tmp_path / words[-1] / "report.json").is_file() and not (tmp_path / words[-1] / "report.png").exists()
    assert (tmp_path / "detect" / "path.csv").is_file() and (tmp_path / "groove" / "trajectory.csv").is_file()
    said = answers[len(works) :]
    for name in ("robot", "sim", "sim", "sim"):
        code, error = said.pop(0)
        assert code == 2 and f"pip install 'grindvision[{name}]'" in error and "defect" not in error, error
    for code, error in said:
        assert code == 2 and "checkout" in error and error.count("\n") == 1, error
    assert not (tmp_path / "no").exists()


def test_simulated_measurements_need_no_checkout(site, tmp_path):
    ((code, error),) = _run(site, tmp_path, ["grindvision_book"], [["simulate", "calibration", "-o", "cell"]])
    assert code == 0, error
    assert (tmp_path / "cell" / "report.png").is_file()


def test_the_wheel_holds_the_data_and_not_the_book(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        info = archive.read(f"grindvision-{__version__}.dist-info/METADATA").decode()
    assert not [name for name in names if name.startswith(("grindvision_book", "tests", "notebooks", "benchmarks"))]
    for file in [*(ROOT / "data" / "paper").iterdir(), *(ROOT / "data" / "robots").rglob("*")]:
        if file.is_file():
            assert f"grindvision/data/{file.relative_to(ROOT / 'data').as_posix()}" in names
    core = {
        re.split("[<>]", line.split()[1])[0]
        for line in info.splitlines()
        if line.startswith("Requires-Dist") and "extra" not in line
    }
    assert core == {"numpy", "scipy", "pandas", "numba", "threadpoolctl", "tomli"}
    assert f"version: {__version__}\n" in (ROOT / "CITATION.cff").read_text()
    assert f'version = "{__version__}"' in (ROOT / "grindvision_book" / "pyproject.toml").read_text()
