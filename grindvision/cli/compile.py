"""``grindvision compile``: the machine code of all tools made once, so that no first call waits for it."""

from __future__ import annotations

import argparse
import contextlib
import io
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from grindvision.cli.streams import say
from grindvision.errors import GrindvisionError

if TYPE_CHECKING:
    import numpy as np

EPILOG = """\
Kernels are compiled for this processor where they are first used, some two minutes in all, and kept. This does it
beforehand, by running the tools on small scans of its own; what is compiled already is not compiled again.

exit code: 0 done, 1 anything else

example:
  grindvision compile
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command: none."""
    parser.formatter_class, parser.epilog = argparse.RawDescriptionHelpFormatter, EPILOG


def run(_: argparse.Namespace) -> int:
    """Run it."""
    from grindvision import kernels
    from grindvision.cli import main
    from grindvision.cli.pictures import without_pictures

    before = kernels.compiled
    with tempfile.TemporaryDirectory() as folder, without_pictures(), _bar():
        for number, words in enumerate(_works(Path(folder))):
            said = io.StringIO()
            with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
                code = main([*words, "-o", str(Path(folder, f"result{number}"))])
            if code != 0:
                raise GrindvisionError(f"{words[0]} failed on a scan made for it: {said.getvalue().strip()}")
    say(f"{kernels.compiled - before} kernels compiled, kept in {kernels.folder()}")
    return 0


@contextlib.contextmanager
def _bar() -> Iterator[None]:
    """Counts the kernels that are ready, where tqdm is and a terminal watches."""
    from grindvision import kernels
    from grindvision.geometry import neighbours, ransac  # noqa: F401  their kernels count
    from grindvision.vision import change, depth_calibration, seam  # noqa: F401

    try:
        from tqdm import tqdm
    except ImportError:
        yield
        return
    ready: set[str] = set()
    with tqdm(total=len(kernels.known), desc="compiling, once", unit="kernel", disable=None) as bar:

        def told(name: str) -> None:
            ready.add(name)
            bar.n = len(ready)
            bar.refresh()

        kernels.listener = told
        try:
            yield
        finally:
            kernels.listener = None
        bar.n = bar.total


def _works(folder: Path) -> Iterator[list[str]]:
    """Command lines, without the output, that use every kernel of the tools; their inputs are written to ``folder``."""
    import numpy as np

    from grindvision.clouds import write_ply
    from grindvision.geometry import move_points, rigid, rotation_about

    rng = np.random.default_rng(0)
    facing = np.diag([1.0, -1.0, -1.0])
    for name, turn_rad, bead_mm in (("sample", 0.15, 0.0), ("test", 0.45, 1.5)):
        T_scanner_part = rigid(rotation_about([1.0, 0.3, 0.2], turn_rad) @ facing, (0, 0, 400.0))
        write_ply(folder / f"{name}.ply", move_points(T_scanner_part, _plate(rng, bead_mm)))
    write_ply(folder / "groove.ply", _groove(rng))
    x, y = (part.ravel() for part in np.meshgrid(np.arange(-60, 60, 1.5), np.arange(-40, 40, 1.5)))
    plates = [str(folder / f"plate{number}.ply") for number in range(3)]
    for number, plate in enumerate(plates):
        write_ply(plate, np.column_stack([x, y, 400.0 + 15 * number + 0.02 * rng.standard_normal(x.size)]))
    yield ["calibrate-field", *plates, "--steps-mm", "0", "15", "30", "--distance-mm", "400"]
    yield ["detect", str(folder / "sample.ply"), str(folder / "test.ply")]
    yield ["detect", _model(folder), str(folder / "test.ply")]
    yield ["grind", str(folder / "sample.ply"), str(folder / "test.ply")]
    yield ["groove", str(folder / "groove.ply")]
    yield ["groove", str(folder / "groove.ply"), "--variant", "paper"]
    write_ply(folder / "corner.ply", _corner(rng))
    yield ["groove", str(folder / "corner.ply")]
    yield ["hand-eye", *_sphere_views(folder, rng), "--rotation", "rotation-vector", "--target", "sphere:40"]


def _plate(rng: np.random.Generator, bead_mm: float) -> np.ndarray:
    """Points (N, 3) of a plate with a boss, a rib and a pocket, and a bead of the height given."""
    import numpy as np

    x, y = (part.ravel() for part in np.meshgrid(np.arange(-100, 100, 1.2), np.arange(-70, 70, 1.2)))
    x, y = x + rng.uniform(-0.4, 0.4, x.size), y + rng.uniform(-0.4, 0.4, x.size)
    z = _plate_height(x, y, bead_mm)
    return np.column_stack([x, y, z + 0.03 * rng.standard_normal(x.size)])


def _plate_height(x: np.ndarray, y: np.ndarray, bead_mm: float) -> np.ndarray:
    """Heights (N,) of that plate at places (N,)."""
    import numpy as np

    z = 4 * np.sin(x / 55 + 0.4) * np.cos(y / 47 - 0.3)
    z += 6 / (1 + np.exp(np.hypot(x - 55, y - 25) - 16))
    z += 5 / (1 + np.exp((np.abs(0.94 * y + 0.34 * x + 44) - 4) / 0.8)) / (1 + np.exp((np.abs(x + 20) - 45) / 1.5))
    z -= 5 / (1 + np.exp(np.maximum(np.abs(x + 55) - 18, np.abs(y - 30) - 12) / 0.8))
    z += bead_mm * np.clip(1 - ((y - 5 - x**2 / 100) / 2.5) ** 2, 0, None) * (np.abs(x) < 20)
    return z


def _model(folder: Path) -> str:
    """A file with the same plate's upper surface as a mesh, without a bead."""
    import numpy as np

    u, v = np.arange(-100, 100, 1.2), np.arange(-70, 70, 1.2)
    x, y = (part.ravel() for part in np.meshgrid(u, v))
    at = np.arange(x.size).reshape(len(v), len(u))
    corners = [at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]]
    faces = np.stack([corner.ravel() for corner in corners], axis=1) + 1
    path = folder / "model.obj"
    rows = np.column_stack([x, y, _plate_height(x, y, 0.0)])
    lines = ["v {:.4f} {:.4f} {:.4f}".format(*row) for row in rows] + ["f {} {} {} {}".format(*face) for face in faces]
    path.write_text("\n".join(lines))
    return str(path)


def _groove(rng: np.random.Generator) -> np.ndarray:
    """Points (N, 3) of a plate with a V-groove along x, seen from 500 mm above."""
    import numpy as np

    x, y = (part.ravel() for part in np.meshgrid(np.arange(-60, 60, 0.8), np.arange(-40, 40, 0.8)))
    x, y = x + rng.uniform(-0.3, 0.3, x.size), y + rng.uniform(-0.3, 0.3, x.size)
    depth = np.clip(6 * (1 - np.abs(y) / 5), 0, None)
    return np.column_stack([x, y, 500.0 + depth + 0.05 * rng.standard_normal(x.size)])


def _corner(rng: np.random.Generator) -> np.ndarray:
    """Points (N, 3) of two plates that meet at a right angle, seen from 500 mm above."""
    import numpy as np

    x, y = (part.ravel() for part in np.meshgrid(np.arange(-45, 45, 1.0), np.arange(-28, 28, 0.7)))
    return np.column_stack([x, y, 500.0 - np.abs(y)]) + 0.1 * rng.standard_normal((x.size, 3))


def _sphere_views(folder: Path, rng: np.random.Generator) -> list[str]:
    """Files of eight poses of a flange, as rotation vectors, and of what a camera on it sees of a sphere."""
    import numpy as np

    from grindvision.clouds import write_ply
    from grindvision.geometry import inverse, move_points, rigid, rotation_about

    T_flange_camera = rigid(translation_mm=(60.0, -30.0, 80.0))
    rows, clouds = [], []
    for number in range(8):
        turn = np.array([np.pi, 0.0, 0.0]) + rng.uniform(-0.4, 0.4, 3)
        rotation = rotation_about(turn, float(np.linalg.norm(turn)))
        seen_at = np.array([*rng.uniform(-60, 60, 2), rng.uniform(330, 470)])
        T_base_flange = rigid(rotation, np.array([500.0, 100.0, 50.0]) - rotation @ seen_at) @ inverse(T_flange_camera)
        rays = rng.standard_normal((6000, 3))
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        cap = seen_at + 20.0 * rays[rays @ seen_at < -0.25 * np.linalg.norm(seen_at)]
        rows.append([*move_points(T_base_flange, np.zeros(3)), *turn])
        clouds.append(str(folder / f"sphere{number}.ply"))
        write_ply(clouds[-1], cap + 0.1 * rng.standard_normal(cap.shape))
    np.savetxt(folder / "poses.csv", rows, "%.6f", ",")
    return [str(folder / "poses.csv"), *clouds]
