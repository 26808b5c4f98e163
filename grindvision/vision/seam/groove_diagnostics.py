"""What makes a found groove doubtful: no surface on one side, walls that nobody saw, too few points for its size."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from grindvision.vision.seam.groove_lines import DetectedGroove

Floats = NDArray[np.float64]

#: Below this fraction of stations with surface on both sides, the groove lies partly outside the cloud.
MIN_BOTH_SIDES = 0.9
#: Points on the walls lie between these fractions of the depth. A V has 60 % of its points there, a U with walls 11
#: degrees from upright 14 %, a gap between upright faces none. So many points tell.
WALL_DEPTHS, MIN_WALL_FRACTION, POINTS_ASKED = (0.2, 0.8), 0.08, 2000
#: A groove holds at least this fraction of the points that the cloud's spacing gives to its area.
MIN_FILLING = 0.45


def diagnose_groove(groove: DetectedGroove, points: ArrayLike, spacing_mm: float) -> list[str]:
    """Sentences without their subject that say why a groove of a cloud (N, 3) or (R, C, 3) is doubtful, and what to do.

    None for a groove that is well seen.
    """
    doubts = []
    if groove.edges_seen < MIN_BOTH_SIDES:
        doubts.append(
            f"lies partly outside the cloud: only {groove.edges_seen:.0%} of its length shows"
            " the surface on both sides, its outer edge is a guess; scan again with the groove inside the view"
        )
    width = float(np.median(groove.width_mm))
    on_walls = wall_fraction(groove, np.asarray(points, dtype=float).reshape(-1, 3))
    if on_walls < MIN_WALL_FRACTION:
        doubts.append(
            f"({width:.3g} mm wide) may be a gap between two things: only {on_walls:.0%} of its points lie on its"
            " walls, so that its edges and its root are guesses; see in the picture that it is a groove, else crop the"
            " cloud to the part"
        )
    filling = len(groove.members) * spacing_mm**2 / (width * groove.length_mm)
    if filling < MIN_FILLING:
        doubts.append(
            f"holds only {filling:.0%} of the points that its {width:.3g} mm x {groove.length_mm:.3g} mm would show at"
            f" {spacing_mm:.2g} mm spacing; scan again from where the camera looks into it, or crop the cloud to the"
            " part"
        )
    return doubts


def wall_fraction(groove: DetectedGroove, cloud: Floats) -> float:
    """Fraction of a groove's points in its cloud (N, 3) that lie on its walls, away from surface and root.

    Below ``MIN_WALL_FRACTION`` it may be a gap between two things.
    """
    members = cloud[groove.members[:: len(groove.members) // POINTS_ASKED + 1]]
    middle = (groove.left + groove.right) / 2
    nearest = cKDTree(middle).query(members)[1]
    below = ((middle[nearest] - members) * groove.normals[nearest]).sum(axis=1) / groove.depth_mm[nearest]
    return float(((below > WALL_DEPTHS[0]) & (below < WALL_DEPTHS[1])).mean())
