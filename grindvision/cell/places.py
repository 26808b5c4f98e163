"""Where simulated parts stand in a robot's base frame, so that a simulated scan has a pose there."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grindvision.errors import InputError
from grindvision.geometry import rigid, rotation_about

Floats = NDArray[np.float64]

#: Where a weld piece's own frame stands in the UR3's base: x, y, z of its upper side in mm, rotation about z in deg.
PLACES = {
    "line": (300.0, 0.0, 12.0, 90.0),
    "curve": (300.0, 0.0, 12.0, 90.0),
    "box": (300.0, 0.0, 60.0, 90.0),
    "cylinder": (300.0, 0.0, 150.0, 0.0),
}

#: Where the grinding part's own frame stands in the base of an arm that grinds it (4, 4).
T_BASE_PART = rigid(translation_mm=[450.0, 0.0, 50.0])


def T_base_piece(kind: str) -> Floats:
    """Pose (4, 4) of a weld piece on the UR3's table, its underside on the table's top at z = 0.

    Raises:
        InputError: no such piece.
    """
    if kind not in PLACES:
        raise InputError(f"no place for a piece {kind!r}; there are {', '.join(PLACES)}")
    x_mm, y_mm, top_mm, rotation_deg = PLACES[kind]
    return rigid(rotation_about([0, 0, 1], np.radians(rotation_deg)), [x_mm, y_mm, top_mm])
