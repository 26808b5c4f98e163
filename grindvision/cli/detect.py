"""``grindvision detect``: two scans in, the grinding path out."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

    from grindvision.vision.detection import Detection

#: No scanner stands so near to the origin of an arm's base, unless that is exactly its frame.
LEAST_SHIFT_MM = 10.0

PATH_COLUMNS = "point,x_mm,y_mm,z_mm,nx,ny,nz"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.add_argument("sample", metavar="SAMPLE", help="scan of the good part (PLY, PCD, XYZ, CSV, NPY, STL, OBJ)")
    parser.add_argument("test", metavar="TEST", help="scan of the part to be ground")
    parser.add_argument("-o", "--output", required=True, metavar="DIR", help="folder for the results")
    parser.add_argument("--points", type=int, default=6, help="path points per bead (default 6)")
    parser.add_argument(
        "--unit", choices=("mm", "m"), default="mm", help="unit of the numbers in both files (default mm)"
    )
    parser.add_argument(
        "--scanner-pose",
        metavar="FILE.json",
        help="4x4 matrix T_base_scanner of the TEST scan, bare or under that key; adds path_base.csv",
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the random draws (default 0)")


def run(options: argparse.Namespace) -> int:
    """Run it."""
    from grindvision.cli.report import Stopwatch, run_facts
    from grindvision.clouds import write_ply
    from grindvision.files import write_json, write_text
    from grindvision.vision.detection import DetectOptions, detect

    T_base_scanner = None if options.scanner_pose is None else read_pose(options.scanner_pose)
    stopwatch = Stopwatch()
    with stopwatch.stage("read"):
        sample, test = _read_scans(options)
    found = detect(sample, test, DetectOptions(points=options.points, seed=options.seed))
    folder = Path(options.output)
    with stopwatch.stage("write"):
        write_text(folder / "path.csv", path_table(found.path_points, found.path_normals))
        if T_base_scanner is not None:
            from grindvision.geometry import move_points, turn_vectors

            points, normals = (
                move_points(T_base_scanner, found.path_points),
                turn_vectors(T_base_scanner, found.path_normals),
            )
            write_text(folder / "path_base.csv", path_table(points, normals))
        write_ply(folder / "difference.ply", found.difference.points)
    facts = run_facts(options, [options.sample, options.test], ("numpy", "scipy", "numba", "matplotlib"), stopwatch)
    facts["timings_s"] = {**found.timings_s, **facts["timings_s"]}
    from grindvision.cli.detect_picture import draw

    draw(found, folder / "report.png")
    write_json(folder / "report.json", _results(found) | facts)
    if T_base_scanner is not None:
        print(where_it_stood(T_base_scanner))
    print(f"{found}\nwritten: path.csv, difference.ply, report.json, report.png in {folder}")
    return 0


def path_table(points: np.ndarray, normals: np.ndarray) -> str:
    """The CSV text of path points (n, 3) in mm and unit normals (n, 3); the header alone when there are none."""
    rows = [
        f"{number}," + ",".join(f"{value:.4f}" for value in point) + "," + ",".join(f"{value:.6f}" for value in normal)
        for number, (point, normal) in enumerate(zip(points, normals, strict=True), start=1)
    ]
    return "\n".join([PATH_COLUMNS, *rows]) + "\n"


def read_pose(path: str | Path) -> np.ndarray:
    """T_base_scanner (4, 4) from a JSON file: the matrix alone, or an object with that key.

    Raises:
        FileError: missing or no JSON. NotRigidError: no rigid transform. UnitError: a shift in metres.
    """
    import numpy as np

    from grindvision.errors import FileError, UnitError
    from grindvision.geometry import check_rigid

    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise FileError(f"{path}: not a readable JSON file ({' '.join(str(error).split())})") from None
    if isinstance(content, dict):
        if "T_base_scanner" not in content:
            raise FileError(f"{path}: no key T_base_scanner; found {', '.join(content) or 'none'}")
        content = content["T_base_scanner"]
    T_base_scanner = check_rigid(content, f"{path}: T_base_scanner", tolerance=1e-3)
    shift_mm = float(np.linalg.norm(T_base_scanner[:3, 3]))
    if 0 < shift_mm < LEAST_SHIFT_MM:
        raise UnitError(f"{path}: T_base_scanner shifts by only {shift_mm:.3g}: metres? give millimetres")
    return T_base_scanner


def where_it_stood(T_base_scanner: np.ndarray) -> str:
    """The scanner's pose (4, 4) in words, so that an inverse given by mistake can be seen."""
    x, y, z, a, b, c = *T_base_scanner[:3, 3], *T_base_scanner[:3, 2]
    return (
        f"scanner at ({x:.0f}, {y:.0f}, {z:.0f}) mm in the base frame, its z axis along ({a:.2f}, {b:.2f}, {c:.2f}):"
        " is that where it stood?"
    )


def _read_scans(options: argparse.Namespace) -> tuple[np.ndarray, np.ndarray]:
    from concurrent.futures import ThreadPoolExecutor

    from grindvision.clouds import check_unit, finite_points, read_cloud

    paths = (options.sample, options.test)
    with ThreadPoolExecutor(2) as pool:
        clouds = list(pool.map(lambda path: read_cloud(path, options.unit), paths))
    scans = [finite_points(cloud, path) for cloud, path in zip(clouds, paths, strict=True)]
    for scan, path in zip(scans, paths, strict=True):
        check_unit(scan, path, options.unit)
    return scans[0], scans[1]


def _results(found: Detection) -> dict[str, object]:
    registration = found.registration
    return {
        "T_sample_test": registration.T_target_source,
        "fitness": registration.overlap,
        "rmse": registration.rms_mm,
        "confidence": found.confidence,
        "covariance": registration.covariance,
        "level_of_detection_mm": found.difference.level_of_detection_mm,
        "message": str(found),
        "beads": [
            {
                "points": len(bead.points),
                "closed": bead.closed,
                "length_mm": bead.length_mm,
                "width_mm": bead.width_mm,
                "height_mm": bead.height_mm,
            }
            for bead in found.beads
        ],
    }
