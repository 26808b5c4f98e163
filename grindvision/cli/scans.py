"""What the doors for clouds share: their options, scans read and judged, the scanner's pose, tables of path points."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from grindvision.cli.parameters import number
from grindvision.errors import FileError, UnitError

if TYPE_CHECKING:
    import numpy as np

    from grindvision.clouds import Cloud

CLOUD_FORMATS = "PLY, PCD, XYZ, ASC, TXT, PTS, CSV, NPY, NPZ, STL or OBJ"

#: A scanner nearer to a robot's base than this (mm) is one whose pose is in metres.
NEAREST_MM = 10.0


def add_unit_argument(group: argparse._ArgumentGroup) -> None:
    """``--unit``."""
    group.add_argument(
        "--unit",
        choices=("mm", "m"),
        help="unit of the numbers in the files (default: what the file says, else mm; asked for where the size of the"
        " cloud leaves it in doubt)",
    )


def add_viewpoint_argument(group: argparse._ArgumentGroup, option: str, what: str) -> None:
    """``--viewpoint`` or its kin."""
    group.add_argument(
        option,
        type=number,
        nargs=3,
        metavar=("X", "Y", "Z"),
        help=f"where the scanner stood, mm, in the frame of {what} (default from the data: the origin if a scanner"
        " could have stood there, else both sides of the surface are tried)",
    )


def read_scans(paths: Sequence[str], unit: str | None) -> list[Cloud]:
    """Clouds of some files, side by side in threads, each refused where its size says another unit.

    Raises:
        FileError, InputError, UnitError: see ``read_cloud``, ``finite_points`` and ``check_unit``.
    """
    from concurrent.futures import ThreadPoolExecutor

    from grindvision.clouds import check_unit, read_cloud

    with ThreadPoolExecutor(len(paths)) as pool:
        clouds = list(pool.map(lambda path: read_cloud(path, unit), paths))
    for cloud, path in zip(clouds, paths, strict=True):
        check_unit(cloud.points, path, unit)
    return clouds


def read_pose(path: str | Path) -> np.ndarray:
    """T_base_scanner (4, 4) from a JSON file: the matrix alone, or an object with that key.

    Raises:
        FileError: missing, no JSON, no such key. NotRigidError: no rigid transform. UnitError: metres, by its size.
    """
    import numpy as np

    from grindvision.clouds import FARTHEST_MM
    from grindvision.files import read_json
    from grindvision.geometry import check_rigid

    content = read_json(path)
    if isinstance(content, dict):
        if "T_base_scanner" not in content:
            known = ", ".join(list(content)[:8]) or "none"
            raise FileError(f"{path}: no key T_base_scanner; found {known[:80]}")
        content = content["T_base_scanner"]
    pose = check_rigid(content, f"{path}: T_base_scanner", tolerance=1e-3)
    shift = float(np.linalg.norm(pose[:3, 3]))
    if 0 < shift < NEAREST_MM or shift > FARTHEST_MM:
        raise UnitError(
            f"{path}: T_base_scanner shifts by {shift:.3g} mm, where no scanner stands: metres? give millimetres"
        )
    return pose


def where_it_stood(T_base_scanner: np.ndarray) -> str:
    """The scanner's pose (4, 4) in words, so that an inverse given by mistake can be seen."""
    x, y, z, a, b, c = *T_base_scanner[:3, 3], *T_base_scanner[:3, 2]
    return (
        f"scanner at ({x:.0f}, {y:.0f}, {z:.0f}) mm in the base frame, its z axis along ({a:.2f}, {b:.2f}, {c:.2f}):"
        " is that where it stood?"
    )


def rows_text(columns: str, points: np.ndarray, *directions: np.ndarray) -> str:
    """CSV text of numbered points (n, 3) in mm to 0.1 um, and of unit vectors or angles (n, k) to 1e-6."""
    rows = [
        f"{row}," + ",".join([*(f"{v:.4f}" for v in point), *(f"{v:.6f}" for part in parts for v in part)])
        for row, (point, *parts) in enumerate(zip(points, *directions, strict=True), start=1)
    ]
    return "\n".join([columns, *rows]) + "\n"
