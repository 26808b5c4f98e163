"""Lines that come back to where they began: the seam all round a tube, whose ends must meet."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grindvision.geometry import vector_angle
from grindvision.vision.seam.face_fit import Scale
from grindvision.vision.seam.seam_smoothing import smooth_along

Floats = NDArray[np.float64]

#: A seam that comes back to within so many cells of its start and goes on there, within this angle, is a ring.
RING_CELLS, RING_TURN_RAD, RING_STATIONS = 6.0, np.radians(75.0), 3
#: The ends of a ring are fitted lying over each other by so many cells to both sides.
OVERLAP_CELLS = 4.0
#: On both sides of a ring's join its line is bridged over so many cells.
JOIN_CELLS = 2.0


def is_ring(path: Floats, scale: Scale) -> bool:
    """Whether a path (M, 3) comes back to where it began."""
    if len(path) < 8:
        return False
    away = np.linalg.norm(path - path[0], axis=1)
    return bool(away[-1] < 2.5 * scale.cell and away.max() > 4 * scale.cell)


def one_round(root: Floats, reach_mm: float) -> int | None:
    """How many stations of a root (S, 3) make one round of a ring; None where its end does not lead to its start."""
    away = np.linalg.norm(root - root[0], axis=1)
    far = int(np.argmax(away > reach_mm))
    back = far + int(np.argmin(away[far:]))
    if far == 0 or away[back] > reach_mm:
        return None
    start, end = root[RING_STATIONS] - root[0], root[back] - root[back - RING_STATIONS]
    gap = root[0] - root[back] if away[back] > np.linalg.norm(end) else end
    onward = vector_angle(start, end) < RING_TURN_RAD and vector_angle(gap, end) < RING_TURN_RAD
    return back + 1 if onward else None


def overlap(path: Floats, scale: Scale) -> int:
    """Places by which a ring's path (M, 3) is prolonged at both ends, which then lie over each other."""
    step = float(np.median(np.linalg.norm(np.diff(path, axis=0), axis=1)))
    return min(int(OVERLAP_CELLS * scale.cell / max(step, 1e-9)) + 1, len(path) // 2)


def wrapped(line: Floats, count: int) -> Floats:
    """A ring's line (M, ...) with its last ``count`` places before it and its first ones behind it."""
    if count == 0:
        return line
    return np.concatenate([line[-count:], line, line[:count]])


def joined_smoothly(root: Floats, cell_mm: float, step_mm: float) -> Floats:
    """A ring's root (S, 3) bridged over the few stations at its join, which were the free ends of a fit."""
    count = min(int(JOIN_CELLS * cell_mm / step_mm) + 1, len(root) // 6)
    pad = 3 * count
    known = np.ones(len(root))
    known[:count] = known[-count:] = 0.0
    line, weight = (np.concatenate([one[-pad:], one, one[:pad]]) for one in (root, known))
    smooth = smooth_along(line, weight, cell_mm, step_mm)[pad:-pad]
    return np.where(known[:, None] > 0, root, smooth)
