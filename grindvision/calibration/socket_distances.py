"""Known distances between sockets: whether the arm's own lengths agree, as nothing else does where no tracker looks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from grindvision.arm import MdhArm
from grindvision.calibration.coarse import best_fit
from grindvision.calibration.measurements import Measurements
from grindvision.errors import UnitError

#: A distance is doubted where the nominal arm finds it elsewhere by so many times what it leaves (rms) and by this
#: fraction; beyond the second fraction it is no distance of these sockets at all.
TIMES_RMS, FRACTION, NO_DISTANCE = 3.0, 0.005, 0.2


def doubt_distances(training: Measurements, arm: MdhArm, seed: int = 0) -> list[str]:
    """Sentences about known distances between sockets that the nominal ``arm`` contradicts, with their size.

    Without a tracker a wrong distance leaves nothing in the residuals: the whole arm is scaled by it.

    Raises:
        UnitError: a distance that is off by a fifth or more.
    """
    if not training.distances_mm or training.tracked.any():
        return []
    alone = best_fit(replace(training, distances_mm=()), arm, base_fixed=True, seed=seed)
    told = []
    for one, other, given in training.distances_mm:
        found = float(np.linalg.norm(np.subtract(*alone.cell.fixtures_mm[[one, other], :3])))
        names = f"{training.fixtures[one][1]} and {training.fixtures[other][1]}"
        off = abs(found - given)
        if off <= TIMES_RMS * alone.rms_mm + FRACTION * given:
            continue
        sentence = (
            f"distance_mm is {given:g} between sockets {names}, but the robot table has them {found:.4g} mm apart, give"
            f" or take {alone.rms_mm:.2g} mm"
        )
        if off > NO_DISTANCE * given:
            raise UnitError(f"{sentence}: mend the distance, its unit, or the names of the sockets")
        told.append(f"{sentence}: all lengths of the result follow that distance; measure it again")
    return told
