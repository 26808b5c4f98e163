"""What the doors for clouds share: their options, scans read and judged, the scanner's pose, tables of path points."""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from grindvision.cli.parameters import number
from grindvision.errors import FileError, GrindvisionWarning, InputError, UnitError

if TYPE_CHECKING:
    import numpy as np

    from grindvision.clouds import Cloud
    from grindvision.vision.depth_calibration.field_correction import FieldCorrection

CLOUD_FORMATS = "PLY, PCD, XYZ, ASC, TXT, PTS, CSV, NPY, NPZ, STL or OBJ"

#: A scanner nearer to a robot's base than this (mm) is one whose pose is in metres.
NEAREST_MM = 10.0

#: Share of a scan outside the calibrated volume that is worth a word.
MUCH_OUTSIDE = 0.1


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


def add_field_argument(group: argparse._ArgumentGroup) -> None:
    """``--field-correction``."""
    group.add_argument(
        "--field-correction",
        metavar="FILE.npz",
        help="take the scanner's own depth error off first, as `grindvision calibrate-field` learned it; for clouds in"
        " the scanner's frame as it measured them, not for meshes",
    )


def read_correction(path: str | None, viewpoint: Sequence[float] | None) -> FieldCorrection | None:
    """The field correction of ``--field-correction``, if given, for a cloud seen from ``viewpoint``.

    Raises:
        FileError: see ``read_field``. InputError: see ``check_own_frame``.
    """
    if path is None:
        return None
    check_own_frame(viewpoint)
    from grindvision.vision.depth_calibration.field_correction import read_field

    return read_field(path)


def check_own_frame(viewpoint: Sequence[float] | None) -> None:
    """Refuse to correct a cloud whose viewpoint (3,), where given, is not the origin of the scanner's frame.

    Raises:
        InputError: it is another.
    """
    if any(viewpoint or ()):
        raise InputError(
            "--field-correction is for clouds in the scanner's own frame, where the viewpoint is 0 0 0; leave one out"
        )


def corrected(
    correction: FieldCorrection, cloud: Cloud, points: np.ndarray, name: str, advice: str = "export it as measured"
) -> np.ndarray:
    """Points (N, 3) of a cloud without the scanner's depth error; those at the origin, pixels without depth, stay.

    Raises:
        InputError: the cloud is a mesh, or has points behind the scanner; the message ends in ``advice``.

    Warns:
        GrindvisionWarning: many points outside the calibrated volume.
    """
    front = points[:, 2] > 0
    if cloud.mesh:
        raise InputError(f"{name}: a mesh; --field-correction is for points as the scanner measured them: {advice}")
    if points[~front].any() or not front.any():
        raise InputError(
            f"{name}: points with z <= 0 lie behind the scanner; --field-correction is for its own frame: {advice}"
        )
    moved = points.copy()
    moved[front] = correction.apply(points[front])
    outside = 1 - correction.holds(points[front]).mean()
    if outside > MUCH_OUTSIDE:
        low, high = correction.low[2], correction.high[2]
        text = (
            f"{name}: {outside:.0%} of the points lie outside the volume that the plates calibrated ({low:.0f} to"
            f" {high:.0f} mm deep) and are corrected as at its rim; scan plates there; or is it another scanner's?"
        )
        warnings.warn(text, GrindvisionWarning, stacklevel=2)
    return moved


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
