"""What of two scans is the part (``--sample-box``, ``--test-box``), and what fixes its pose (``--datum``)."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from grindvision.cli.parameters import number
from grindvision.cli.scans import diagnose_pose
from grindvision.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from grindvision.clouds import Cloud


def add_box_arguments(group: argparse._ArgumentGroup) -> None:
    """``--sample-box`` and ``--test-box``."""
    for option, what in (("--sample-box", "SAMPLE"), ("--test-box", "TEST")):
        group.add_argument(
            option,
            type=number,
            nargs=6,
            metavar=("X", "Y", "Z", "X2", "Y2", "Z2"),
            help=f"two opposite corners, mm, in the frame of {what}, of a box about the part: what lies outside is left"
            " out, as a table on which the part was put down anew",
        )


def cut_to_box(
    cloud: Cloud, points: np.ndarray, box: Sequence[float] | None, path: str, option: str
) -> tuple[Cloud, np.ndarray]:
    """A cloud and its finite ``points`` (N, 3) without what lies outside of ``box``: x y z of two opposite corners, mm.

    Raises:
        InputError: a corner is no place, or no point lies inside.
    """
    if box is None:
        return cloud, points
    import numpy as np

    corners = np.sort(np.array(box).reshape(2, 3), axis=0)
    if not np.isfinite(corners).all():
        raise InputError(f"{option} has a number that is none; give x y z of two opposite corners in mm")
    inside = ((points >= corners[0]) & (points <= corners[1])).all(axis=1)
    if not inside.any():
        low, high = (", ".join(f"{value:.4g}" for value in corner) for corner in (points.min(0), points.max(0)))
        raise InputError(f"no point of {path} lies in {option}; its points reach from ({low}) to ({high}) mm")
    points = points[inside]
    return replace(cloud, points=points, normals=None, grid=None), points


def add_datum_argument(group: argparse._ArgumentGroup, region: bool = False) -> None:
    """``--datum``, and ``--region`` with ``--skin`` where asked for."""
    group.add_argument(
        "--datum",
        nargs="+",
        metavar="FILE",
        help="the faces that fix the pose, in SAMPLE's frame: a file of points on them, in SAMPLE's unit, or six"
        " numbers, two opposite corners of a box in mm (default: all faces, less one that the others contradict)",
    )
    if region:
        _add_region_argument(group)


def _add_region_argument(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--region",
        nargs="+",
        metavar="FILE",
        help="where there is something to be ground, in TEST's frame: a file of points on it, in TEST's unit, or six"
        " numbers, two opposite corners of a box in mm; what stands out elsewhere is left, and what may be bending of a"
        " deformed part counts as stock there (default: wherever something stands out)",
    )
    group.add_argument(
        "--skin",
        type=number,
        metavar="MM",
        help="with --region: take so much off the surface there as it lies, whatever SAMPLE says; for a part so"
        " deformed that what stands out of it cannot be told",
    )


def read_datum(words: list[str] | None, unit: str | None, option: str = "--datum") -> np.ndarray | None:
    """The datum of ``--datum``, or the region of ``--region``, if given: corners (2, 3) in mm of a box, or points
    (K, 3) in mm of a file.

    Raises:
        InputError: neither a file nor six numbers. FileError: see ``read_cloud``.
    """
    if words is None:
        return None
    import numpy as np

    from grindvision.clouds import finite_points, read_cloud

    if len(words) == 1:
        points = finite_points(read_cloud(words[0], unit), words[0])
        if len(points) < 3:
            raise InputError(f"{option} {words[0]} holds {len(points)} points; give some on every face that it means")
        return points
    try:
        corners = np.array([float(word) for word in words])
    except ValueError:
        corners = np.empty(0)
    if len(corners) != 6 or not np.isfinite(corners).all():
        raise InputError(
            f"{option} has {len(words)} words; give one file, or six numbers: x y z of two opposite corners"
        )
    return corners.reshape(2, 3)


def doubts_before_grinding(
    options: argparse.Namespace, T_base_scanner: np.ndarray | None, test: np.ndarray
) -> list[str]:
    """In words, what speaks against the pose of TEST's points (N, 3), and what passes know nothing of."""
    found = [] if T_base_scanner is None else diagnose_pose(T_base_scanner, test)
    if options.test_box is not None:
        found.append(
            "what lies outside of --test-box is no obstacle to wheel and arm: give a cloud of it with --keep-out, and"
            " look at the ways yourself"
        )
    return found
