"""What a scan shows beside the pieces of a grinding job: what stands out there and is not ground, what is missing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from grindvision.geometry import inverse, move_points
from grindvision.vision.change.change_detection import Difference
from grindvision.vision.change.comparison import Comparison
from grindvision.vision.change.diagnostics import missing_pieces
from grindvision.vision.change.pieces import Cluster
from grindvision.vision.change.stock import StockPiece
from grindvision.words import counted

Floats = NDArray[np.float64]

OF_THE_JOB = 0.5
"""What lies by so much at a piece of the job belongs to it."""


def left_standing(difference: Difference) -> tuple[str, ...]:
    """In words, what stands out and is too small for a piece: it is not ground."""
    specks = [speck for speck in difference.specks if not speck.floating]
    if not specks:
        return ()
    return (
        f"{counted(len(specks), 'place stands', 'places stand')} out that are too small for a piece and are not ground,"
        f" the largest {specks[0]}: spatter? Scan it more finely, or take it off by hand",
    )


def found_elsewhere(compared: Comparison, pieces: Sequence[StockPiece], tolerance_mm: float) -> tuple[str, ...]:
    """In words, what a scan after the passes shows beside all ``pieces`` of the job: on it the verdicts are silent."""
    found, difference = compared.registration, compared.difference
    high = [one for one in difference.clusters if one.peak_mm > tolerance_mm and not _at_a_piece(_feet(one), pieces)]
    places = [(one.points.mean(axis=0), one.peak_mm) for one in high]
    places += [
        (speck.middle_mm, speck.height_mm)
        for speck in difference.specks
        if speck.height_mm > tolerance_mm and not speck.floating and not _at_a_piece(speck.middle_mm[None], pieces)
    ]
    said = []
    if places:
        said.append(
            f"{counted(len(places), 'place stands', 'places stand')} out beside the pieces of this job, up to"
            f" {_highest(places)}: the verdict does not hold there; plan it with `grindvision grind SAMPLE NEWSCAN`"
        )
    back = inverse(found.T_target_source)
    pits = [
        (move_points(back, _feet(pit)), pit.peak_mm) for pit in missing_pieces(found.source, found.target, found.fine)
    ]
    deep = [(feet.mean(axis=0), depth) for feet, depth in pits if not _at_a_piece(feet, pieces)]
    if deep:
        said.append(
            f"material is missing in {counted(len(deep), 'place')} beside the pieces of this job, up to"
            f" {_highest(deep)}: gouged, unless it was so before"
        )
    return tuple(said)


def _feet(cluster: Cluster) -> Floats:
    """Points (N, 3) of a piece's surface, brought down to the other scan's."""
    return cluster.points - cluster.signed_mm[:, None] * cluster.normals


def _at_a_piece(points: Floats, pieces: Sequence[StockPiece]) -> bool:
    """Whether points (N, 3) lie mostly on what is mapped as a piece, or next to one."""
    of_one = np.zeros(len(points), dtype=bool)
    for piece in pieces:
        there = move_points(inverse(piece.map.T_scan_map), points)
        at = np.rint(there[:, :2] / piece.map.spacing_mm).astype(np.int64)
        rows = np.flatnonzero(((at >= 0) & (at < piece.map.shape)).all(axis=1))
        of_one[rows] |= ~piece.unchanged[at[rows, 0], at[rows, 1]]
    return bool(of_one.mean() >= OF_THE_JOB)


def _highest(places: Sequence[tuple[Floats, float]]) -> str:
    middle, height_mm = max(places, key=lambda place: place[1])
    return f"{height_mm:.2g} mm about ({', '.join(f'{value:.0f}' for value in middle)}) mm"
