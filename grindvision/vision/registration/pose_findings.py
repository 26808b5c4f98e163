"""What speaks against a pose that was found: rivals, mirror images, and motions that hardly anything resists."""

from __future__ import annotations

import warnings

import numpy as np

from grindvision.errors import AmbiguousError, GrindvisionWarning, InputError
from grindvision.vision.registration.free_motions import (
    HARDLY_KNOWN,
    motion_name,
    rms_extent,
    spread_out,
    weakest_motion,
)
from grindvision.vision.registration.icp import FineRegistration
from grindvision.vision.registration.pair_diagnostics import PairNames
from grindvision.vision.registration.verification import VerifiedPose
from grindvision.vision.surface.scan import Scan

OPEN = 0.06
"""Standard deviation of a point's place, as a fraction of the scan's extent, above which the pose is refused."""

LEFT_HANDED = "exported left-handed (two axes swapped, or one with the wrong sign)"

SURE = 0.9
"""A pose of less confidence is given with a warning that names its rival's motion."""


def warn_of_findings(
    source: Scan, coarse: VerifiedPose, fine: FineRegistration, names: PairNames, held: str = ""
) -> None:
    """Say what the pose may be instead: a rival's, a mirror image's, one along a motion that hardly anything resists;
    and by what that motion is ``held``.

    Raises:
        AmbiguousError: along that motion nearly anything fits. InputError: the mirror image fits far better.

    Warns:
        GrindvisionWarning: a rival that fits nearly as well; a mirror image that does; a standard deviation that is
            large.
    """
    points = spread_out(source.surfels.points)
    extent = rms_extent(points)
    sigma, deviated = weakest_motion(fine, points)
    motion = motion_name(deviated, fine.T_target_source, points.mean(axis=0), extent) if np.isfinite(sigma) else ""
    if sigma > OPEN * extent:
        raise AmbiguousError(
            f"the registration is ambiguous: {motion or 'some motion'} fits as well, as the scanners' own small errors"
            " say; scan more of the part, or a side that fixes it there"
        )
    findings = [*_findings_of_mirror(coarse, names), *filter(None, [held])]
    if coarse.in_gaps > 0:
        findings.append(
            f"a share of {coarse.in_gaps:.1%} of the surface that one scan shows lies in holes of the other: these are"
            " taken for gaps of a scan (dark, shiny or shaded places), did not count for the pose, and nothing is"
            " compared in them; if the part has these holes, look whether it is the same part"
        )
    if sigma > HARDLY_KNOWN * extent:
        findings.append(
            f"the pose is known to {sigma:.2g} mm only (one standard deviation), along {motion}: the part shows little"
            " that fixes it there, and path points may be off by as much; scan more of the part"
        )
    if coarse.confidence < SURE:
        rival = f"{coarse.rival_motion} fits nearly as well" if coarse.rival_motion else "much contradicts it"
        findings.append(
            f"the pose is right with a confidence of {coarse.confidence:.2f} only: {rival}; look at the picture before"
            " the part is ground, or scan what tells the two apart"
        )
    for finding in findings:
        warnings.warn(finding, GrindvisionWarning, stacklevel=3)


def _findings_of_mirror(coarse: VerifiedPose, names: PairNames) -> list[str]:
    """In words, that a mirror image of the source fits as well.

    Raises:
        InputError: it fits far better.
    """
    if coarse.mirror is None:
        return []
    if coarse.mirror.better:
        raise InputError(
            f"the {names.source} scan fits the {names.target} better as its mirror image ({coarse.mirror.agreement};"
            f" as it is, {coarse.agreement}): one of the two was {LEFT_HANDED}; export it again, or say --mirrored;"
            " or the part is nearly symmetric and another pose is right: scan what tells its sides apart"
        )
    return [
        f"the mirror image of the {names.source} scan fits as well ({coarse.mirror.agreement}), so that it would not"
        f" show if one of the two files was {LEFT_HANDED}; the path would then be off by up to"
        f" {coarse.mirror.apart_mm:.3g} mm: check the export once, or scan what is not alike on both sides"
    ]
