"""Experiment 1 of diao2018: a block of known height on a flat bench, at five places of the scanner's field."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from grindvision.cell.rays import Target
from grindvision.cell.scan import Sighting
from grindvision.cell.scanners import Scanner
from grindvision.cell.solids import Solid, assembled, box, check_size
from grindvision.errors import InputError
from grindvision.geometry import rigid

HEIGHT_MM = 30.40

#: Edge of the block and half the edge of the bench around it that is read out with it, mm.
BLOCK_MM = 40.0
NEARBY_MM = 42.0

#: The five places in x, y of the scanner frame, mm: P3 in the centre, the others evenly around it; ours, the paper
#: gives no numbers.
POSITIONS_MM = {
    "P1": (-55.0, 35.0),
    "P2": (55.0, 35.0),
    "P3": (0.0, 0.0),
    "P4": (-55.0, -35.0),
    "P5": (55.0, -35.0),
}


def height_target(position_mm: ArrayLike = (0.0, 0.0), height_mm: float = HEIGHT_MM) -> Solid:
    """Block of ``height_mm`` at ``position_mm`` (2,) on a bench of 260 x 200 mm whose face is z = 0; faces top, bench.

    Raises:
        InputError: the height is not positive, or the block leaves the bench.
    """
    check_size("target height", height_mm)
    x, y = np.asarray(position_mm, dtype=float)
    half = BLOCK_MM / 2
    if max(abs(x) - 130, abs(y) - 100) > -half:
        raise InputError(f"the target at ({x:.0f}, {y:.0f}) mm leaves the bench of 260 x 200 mm; move it inwards")
    bench = box("bench", [-130, -100, -20], [130, 100, 0])
    block = box("block", [x - half, y - half, 0], [x + half, y + half, height_mm])
    return assembled([bench.solid(), block.solid()])


def flat_plate(length_mm: float = 300.0, width_mm: float = 240.0) -> Solid:
    """A flat plate, its face at z = 0 and centred at the origin."""
    x, y = length_mm / 2, width_mm / 2
    return box("plate", [-x, -y, -10], [x, y, 0]).solid()


def height_sighting(scanner: Scanner, position_mm: ArrayLike, every: int = 1, height_mm: float = HEIGHT_MM) -> Sighting:
    """What an errorless scanner would see of the block at ``position_mm`` (2,) of its field, and of the bench nearby.

    The scanner looks straight down; block and bench lie evenly about its best distance.

    Raises:
        InputError: see ``height_target``. SightError: the block is outside the measuring range.
    """
    target = Target(height_target(position_mm, height_mm))
    bench_mm = scanner.reference_mm + height_mm / 2
    pose = rigid(np.diag([1.0, -1.0, -1.0]), [0, 0, bench_mm])
    # The scanner's y axis points against the bench's.
    centre = np.asarray(position_mm, dtype=float) * [1, -1]
    middle = np.array([scanner.columns - 1, scanner.rows - 1]) / 2
    low, high = (middle + (centre + side * NEARBY_MM) / bench_mm * scanner.focal_px for side in (-1, 1))
    return scanner.sight(target, pose, every, (int(low[0]), int(high[0]), int(low[1]), int(high[1])))
