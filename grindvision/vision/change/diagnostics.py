"""What speaks against a comparison that came to an end: little overlap, another scale, missing material."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from grindvision.errors import DegenerateError
from grindvision.geometry import inverse, move_points
from grindvision.vision.change.change_detection import Difference, find_change
from grindvision.vision.change.pieces import Cluster
from grindvision.vision.registration.icp import FineRegistration
from grindvision.vision.registration.pair_diagnostics import PairNames, diagnose_table
from grindvision.vision.registration.relative_scale import relative_scale
from grindvision.vision.surface.scan import Scan
from grindvision.words import counted, rounded

Floats = NDArray[np.float64]

NAMES = PairNames("test", "sample")
"""What the source and the target of a detection are called at its doors."""

#: Registrations of less than this fraction of the test scan may be chance.
MIN_OVERLAP = 0.35

#: Two sound scanners agree on a length to about a thousandth; this is four times as much.
MAX_SCALE = 0.004

#: From twice what two sound scanners agree to another scale is told where it moves the part's ends by more than the
#: level of detection and by what planes through coarse cells may err, a tenth of the cell.
SMALL_SCALE, OF_CELL = 0.002, 0.1

#: Where scans differ by more than so many times what the noise of their points explains, noise is a quarter of the
#: variance or less.
BEYOND_NOISE = 2.0

#: From this fraction of a bead's height on, what good surfaces differ by moves the path across the bead by more than
#: the 0.1 to 0.2 mm that it errs by anyhow: it was 0.02 to 0.08 in sound scans, and of 18 beads beyond 16 had no path
#: point farther off than so many times the difference.
OF_HEIGHT, TIMES_OFF = 0.1, 3.0


@dataclass(frozen=True)
class Unevenness:
    """By how much two good surfaces differ, ``spread_mm`` (one standard deviation, robust), and by how much the noise
    of both scans alone would let them, ``noise_mm``."""

    spread_mm: float
    noise_mm: float

    @classmethod
    def between(cls, source: Scan, target: Scan, difference: Difference) -> Unevenness:
        """That of two scans by their ``difference``."""
        signed = difference.signed_mm[np.isfinite(difference.signed_mm)]
        spread = 1.4826 * float(np.median(np.abs(signed - np.median(signed))))
        square = sum(float(np.median(one.surfels.noise_mm**2 / one.surfels.counts)) for one in (source, target))
        return cls(spread, math.sqrt(square))

    @property
    def is_noise(self) -> bool:
        """Whether noise is what explains it, or much of it."""
        return self.spread_mm <= BEYOND_NOISE * self.noise_mm

    def doubt_of_path(self, height_mm: float) -> str:
        """In words, how far off the path along a bead of that height may lie; empty where that is little."""
        if self.spread_mm <= OF_HEIGHT * height_mm:
            return ""
        return f"{self}; on beads {height_mm:.2g} mm high path points may be off by {TIMES_OFF * self.spread_mm:.2g} mm"

    def __str__(self) -> str:
        differ = f"beside what stands out the scans differ by {self.spread_mm:.2g} mm (one standard deviation)"
        cause = "" if self.is_noise else "; the rest are rough skins, or scanners that distort"
        return f"{differ}, where their noise explains {self.noise_mm:.2g} mm{cause}"


def diagnose(
    source: Scan,
    target: Scan,
    registration: FineRegistration,
    difference: Difference,
    seed: int = 0,
    faces_may_be_off: bool = False,
) -> tuple[str, ...]:
    """What speaks against a comparison that came to an end, one sentence each; ``registration`` is T_target_source.

    ``faces_may_be_off``: a face that is off as a whole would not be seen, and leaves missing material at its rim.
    """
    found = [table] if (table := diagnose_table(source.voxels, target.voxels, NAMES, seed)) else []
    if registration.overlap < MIN_OVERLAP:
        found.append(
            f"only {registration.overlap:.0%} of the test scan lies on the sample: the rest was compared with nothing,"
            " and so little hardly fixes the pose; scan with more overlap"
        )
    scale, deviation = relative_scale(source, target, registration, seed=seed)
    ends_mm = float(np.linalg.norm(source.surfels.points - source.surfels.points.mean(axis=0), axis=1).max())
    shows = abs(scale - 1) * ends_mm > difference.level_of_detection_mm + OF_CELL * difference.cell_mm
    if abs(scale - 1) > max(SMALL_SCALE if shows else MAX_SCALE, 5 * deviation):
        found.append(
            f"the test scan is {abs(scale - 1):.1%} {'larger' if scale > 1 else 'smaller'} than the sample: two"
            " scanners, an old calibration or a warm part; what stands out may be nothing else, so mend that first"
        )
    if not difference.clusters and (missing := _missing_material(source, target, registration)):
        swapped = (
            "a face that is off as a whole leaves such places at its rim"
            if faces_may_be_off
            else ("if that is the bead, SAMPLE and TEST were swapped")
        )
        found.append(f"{missing}; {swapped}")
    return tuple(found)


def missing_pieces(source: Scan, target: Scan, registration: FineRegistration) -> tuple[Cluster, ...]:
    """Where the target stands out of the source: pieces of missing material, in the frame of the target.

    ``registration`` is T_target_source.
    """
    back = inverse(registration.T_target_source)
    rotation = np.kron(np.eye(2), back[:3, :3])
    backwards = replace(
        registration,
        T_target_source=back,
        covariance=rotation @ registration.covariance @ rotation.T,
        hidden_covariance=rotation @ registration.hidden_covariance @ rotation.T,
        centre_mm=move_points(back, registration.centre_mm),
    )
    try:
        return find_change(target, source, backwards).clusters
    except DegenerateError:
        return ()


def _missing_material(source: Scan, target: Scan, registration: FineRegistration) -> str:
    """In words, where material is missing, or the two scans were swapped; empty where nothing is."""
    pieces = missing_pieces(source, target, registration)
    if not pieces:
        return ""
    return (
        f"nothing stands out of the good part, but in {counted(len(pieces), 'place')} material is missing (the largest:"
        f" {rounded(pieces[0].area_mm2)} mm2, {pieces[0].peak_mm:.2f} mm deep)"
    )
