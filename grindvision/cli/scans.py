"""What the doors for clouds share: their options, scans read and judged, the scanner's pose, tables of path points."""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Sequence
from dataclasses import replace
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING

from grindvision.cli.parameters import number
from grindvision.errors import FileError, GrindvisionWarning, InputError, UnitError

if TYPE_CHECKING:
    import numpy as np

    from grindvision.clouds import Cloud
    from grindvision.models import Model
    from grindvision.vision.depth_calibration.field_correction import FieldCorrection

CLOUD_FORMATS = "PLY, PCD, XYZ, ASC, TXT, PTS, CSV, NPY, NPZ, STL or OBJ"

#: A scanner nearer to a robot's base than this (mm) is one whose pose is in metres.
NEAREST_MM = 10.0

#: A scanner nearer than this (mm) would stand within the arm's foot; parts farther off or deeper are out of its reach.
INSIDE_ARM_MM, FARTHEST_REACH_MM, DEEPEST_MM = 150.0, 5000.0, -500.0

#: Parts that are smaller (mm) and whose unit nobody stated may be in centimetres.
SMALL_MM = 60.0

#: Pixels that tell something at least, and the fraction of them that tells that an image is mirrored.
FEWEST_PIXELS, NEARLY_ALL = 200, 0.99

#: Share of a scan outside the calibrated volume that is worth a word.
MUCH_OUTSIDE = 0.1


UNITS = ("mm", "cm", "m", "in")


def add_unit_argument(group: argparse._ArgumentGroup) -> None:
    """``--unit``."""
    group.add_argument(
        "--unit",
        choices=UNITS,
        help="unit of the numbers in the files (default: what the file says, else mm; asked for where the size of the"
        " cloud leaves it in doubt)",
    )


def add_mirrored_argument(group: argparse._ArgumentGroup, what: str) -> None:
    """``--mirrored``."""
    group.add_argument(
        "--mirrored",
        choices=("x", "y", "z"),
        help=f"the axis of {what} that counts the wrong way, where the file was exported left-handed: its numbers"
        " change their sign before all else, and everything is told in the right-handed frame",
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


def read_scans(paths: Sequence[str], unit: str | None, mirrored: Sequence[str | None] = ()) -> list[Cloud]:
    """Clouds of some files, side by side in threads, each refused where its size says another unit.

    Args:
        paths: of the files.
        unit: as in ``read_cloud``.
        mirrored: for each file the axis whose numbers change their sign, as it was exported left-handed, or None.

    Raises:
        FileError, InputError, UnitError: see ``read_cloud``, ``finite_points`` and ``check_unit``.

    Warns:
        GrindvisionWarning: a cloud is small for a part in the unit that nobody stated; its pixels run as in a mirror.
    """
    from concurrent.futures import ThreadPoolExecutor

    from grindvision.clouds import read_cloud

    with ThreadPoolExecutor(len(paths)) as pool:
        clouds = list(pool.map(lambda path: read_cloud(path, unit), paths))
    clouds = [right_handed(cloud, axis) for cloud, axis in zip_longest(clouds, mirrored)]
    return [_judged(cloud, path, unit) for cloud, path in zip(clouds, paths, strict=True)]


def _judged(cloud: Cloud, path: str, unit: str | None) -> Cloud:
    """The cloud itself, refused or doubted where its size or its pixels say so; as ``read_scans``."""
    from grindvision.clouds import check_unit

    check_unit(cloud.points, path, unit)
    for finding in (_small(cloud, unit), _mirrored(cloud)):
        if finding:
            warnings.warn(f"{path}: {finding}", GrindvisionWarning, stacklevel=3)
    return cloud


def read_pair(
    paths: tuple[str, str], units: tuple[str | None, str | None], mirrored: tuple[str | None, str | None]
) -> tuple[Cloud | Model, Cloud]:
    """SAMPLE and TEST, as ``read_scans`` has them; the first is a model where its file holds faces: by the second its
    size is judged later."""
    from concurrent.futures import ThreadPoolExecutor

    from grindvision.models import Model, read_cloud_or_model

    with ThreadPoolExecutor(1) as pool:
        reading = pool.submit(read_cloud_or_model, paths[0], units[0])
        (test,) = read_scans(paths[1:], units[1], mirrored[1:])
        good = reading.result()
    if isinstance(good, Model):
        return good if mirrored[0] is None else good.mirrored(mirrored[0]), test
    return _judged(right_handed(good, mirrored[0]), paths[0], units[0]), test


def right_handed(cloud: Cloud, axis: str | None) -> Cloud:
    """A cloud whose numbers along ``axis`` counted the wrong way; None: as it is."""
    if axis is None:
        return cloud
    import numpy as np

    signs = np.where(np.array(["x", "y", "z"]) == axis, -1.0, 1.0)
    return replace(cloud, points=cloud.points * signs, normals=None if cloud.normals is None else cloud.normals * signs)


def size_question(names: Sequence[str], clouds: Sequence[Cloud | Model]) -> str:
    """The size of every cloud or model in words, so that a file in another unit can be seen."""
    from grindvision.clouds import Cloud, extent

    sizes = []
    for name, one in zip(names, clouds, strict=True):
        sides = extent(one.points if isinstance(one, Cloud) else one.corners.reshape(-1, 3))
        kind = "" if isinstance(one, Cloud) and not one.mesh else " (a mesh)"
        sizes.append(f"{name} {' x '.join(f'{side:.4g}' for side in sides)} mm{kind}")
    return f"along x, y, z: {', '.join(sizes)}: is that {'its' if len(sizes) == 1 else 'their'} size?"


def _small(cloud: Cloud, unit: str | None) -> str:
    """In words, where a cloud whose unit nobody stated is small for a part that an arm works on."""
    import numpy as np

    from grindvision.clouds import extent

    diagonal = float(np.linalg.norm(extent(cloud.points)))
    if unit is not None or cloud.stated_unit or diagonal >= SMALL_MM:
        return ""
    return f"{diagonal:.3g} mm across: are its numbers centimetres? Then say --unit cm, else --unit mm"


def _mirrored(cloud: Cloud) -> str:
    """In words, where rows and columns of an organised cloud run as no camera at the origin stores them."""
    if cloud.grid is None or min(cloud.grid) < 2:
        return ""
    import numpy as np

    pixels = cloud.points.reshape(*cloud.grid, 3)
    corner = pixels[:-1, :-1]
    with np.errstate(all="ignore"):
        facing = np.cross(pixels[:-1, 1:] - corner, pixels[1:, :-1] - corner)
        along = (facing * corner).sum(axis=2)
    told = np.isfinite(along) & (along != 0)
    if told.sum() < FEWEST_PIXELS or (along[told] < 0).mean() < NEARLY_ALL:
        return ""
    return (
        "its rows and columns run as in a mirror image: exported left-handed? Then say --mirrored with the axis that"
        " counts the wrong way; or was the image stored upside down, or moved out of the scanner's frame?"
    )


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
    distance_mm = float(np.linalg.norm(pose[:3, 3]))
    if distance_mm == 0 and not np.array_equal(pose, np.eye(4)):
        raise InputError(
            f"{path}: T_base_scanner has no translation: the scanner would stand in the robot's base; give all of it"
        )
    if 0 < distance_mm < NEAREST_MM or distance_mm > FARTHEST_MM:
        raise UnitError(
            f"{path}: T_base_scanner shifts by {distance_mm:.3g} mm, where no scanner stands: metres? give millimetres"
        )
    return pose


def diagnose_pose(T_base_scanner: np.ndarray, points: np.ndarray) -> list[str]:
    """What speaks against a scanner's pose (4, 4) for scanned points (N, 3): identity, centimetres, its inverse."""
    import numpy as np

    from grindvision.geometry import inverse, move_points

    if np.array_equal(T_base_scanner, np.eye(4)):
        return ["T_base_scanner is the identity: right only for a scan that is in the robot's base frame already"]
    found = []
    distance_mm = float(np.linalg.norm(T_base_scanner[:3, 3]))
    if distance_mm < INSIDE_ARM_MM:
        found.append(
            f"by T_base_scanner the scanner stands {distance_mm:.0f} mm from the origin of the robot's base, within the"
            " arm's foot: centimetres? give millimetres"
        )
    part, other = (np.median(move_points(pose, points), axis=0) for pose in (T_base_scanner, inverse(T_base_scanner)))
    away, other_away = float(np.linalg.norm(part)), float(np.linalg.norm(other))
    inverse_fits = other_away <= FARTHEST_REACH_MM and other[2] >= DEEPEST_MM
    hint = (
        f"; with its inverse the part would lie {other_away / 1000:.1f} m away, {other[2]:.0f} mm high: is it"
        " T_scanner_base?"
        if inverse_fits
        else ""
    )
    if away > FARTHEST_REACH_MM:
        found.append(f"by T_base_scanner the part lies {away / 1000:.1f} m from the base, where no arm reaches{hint}")
    elif part[2] < DEEPEST_MM and inverse_fits:
        found.append(f"by T_base_scanner the part lies {-part[2]:.0f} mm below the robot's base{hint}")
    return found


def rows_text(columns: str, points: np.ndarray, *directions: np.ndarray) -> str:
    """CSV text of numbered points (n, 3) in mm to 0.1 um, and of unit vectors or angles (n, k) to 1e-6."""
    rows = [
        f"{row}," + ",".join([*(f"{v:.4f}" for v in point), *(f"{v:.6f}" for part in parts for v in part)])
        for row, (point, *parts) in enumerate(zip(points, *directions, strict=True), start=1)
    ]
    return "\n".join([columns, *rows]) + "\n"
