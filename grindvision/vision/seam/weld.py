"""From a cloud to the torch's way points, as the second paper's flow chart reads: detect the groove, then trace it."""

from __future__ import annotations

import time
import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import GrindvisionWarning, InputError
from grindvision.parallel import one_blas_thread
from grindvision.vision.seam.gfh_groove import GfhSettings, find_groove_gfh
from grindvision.vision.seam.groove import find_grooves
from grindvision.vision.seam.groove_diagnostics import doubts_about
from grindvision.vision.seam.groove_lines import DetectedGroove
from grindvision.vision.seam.seam_path import SeamPath, root_path, slab_path

Flags = NDArray[np.bool_]
VARIANTS = ("ours", "paper")


@dataclass(frozen=True)
class Weld:
    """What was found in a cloud: ``labels`` in its shape, ``paths`` one per groove, as in ``find_grooves``.

    ``grooves`` belong to the paths one by one; the paper's variant measures none and has one path. ``timings_s`` holds
    seconds per stage, ``spacing_mm`` the distance of neighbouring points as ours found it. ``left_out`` are
    grooves that were found too, but are too small against the first to count.
    """

    variant: str
    labels: Flags
    paths: tuple[SeamPath, ...]
    grooves: tuple[DetectedGroove, ...]
    timings_s: dict[str, float]
    spacing_mm: float | None = None
    left_out: tuple[DetectedGroove, ...] = ()

    @property
    def path(self) -> SeamPath:
        """The path of the first groove."""
        return self.paths[0]

    def __str__(self) -> str:
        what = self.grooves[0] if self.grooves else f"groove of {int(self.labels.sum()):,} points"
        return f"{what}; {self.path}{_also('also', self.grooves[1:])}{_also('left out as too small', self.left_out)}"


@one_blas_thread()
def trace_weld(
    points: ArrayLike,
    waypoints: int = 50,
    variant: str = "ours",
    viewpoint_mm: ArrayLike | None = None,
    settings: GfhSettings | None = None,
    width_mm: float | None = None,
) -> Weld:
    """Find the groove of a cloud (N, 3) or (R, C, 3) in mm and put way points along it.

    Args:
        points: rows with NaN belong to no groove.
        waypoints: number of way points; of slabs in the paper's variant.
        variant: ``ours`` or ``paper``.
        viewpoint_mm: the camera (3,), where it is not the origin.
        settings: of the paper's variant.
        width_mm: rough width of the groove, of our variant; estimated when left out.

    Raises:
        InputError: unknown variant, too few way points, an unusable cloud. UnitError: its size is no part's in mm.
        NoGrooveError: there is no groove.

    Warns:
        GrindvisionWarning: a groove is doubtful (partly outside the cloud, walls unseen, few points); larger hollows in
            the scene are no grooves.
    """
    if variant not in VARIANTS:
        raise InputError(f"variant {variant!r} is unknown; choose one of {', '.join(VARIANTS)}")
    if waypoints < 2:
        raise InputError(f"{waypoints} way points make no path; ask for at least 2")
    grooves: tuple[DetectedGroove, ...] = ()
    left_out: tuple[DetectedGroove, ...] = ()
    spacing: float | None = None
    paths: tuple[SeamPath, ...]
    begin = time.perf_counter()
    if variant == "paper":
        detection = find_groove_gfh(points, settings, viewpoint_mm)
        found = time.perf_counter()
        inside = detection.labels.ravel()[detection.finite]
        paths = (slab_path(detection.smoothed[inside], detection.normals[inside], waypoints),)
        labels = detection.labels
    else:
        detected = find_grooves(points, viewpoint_mm, width_mm)
        found = time.perf_counter()
        labels, grooves, left_out = detected.labels, detected.grooves, detected.left_out
        spacing = detected.spacing_mm
        paths = tuple(root_path(groove, waypoints) for groove in grooves)
        if detected.cluttered:
            warnings.warn(
                "the largest hollows of the scene are gaps between things, no grooves: see in the picture that the path"
                " lies in the groove, else crop the cloud to the part",
                GrindvisionWarning,
                stacklevel=2,
            )
        for number, groove in enumerate(grooves, start=1):
            for doubt in doubts_about(groove, points, detected.spacing_mm):
                warnings.warn(f"groove {number} {doubt}", GrindvisionWarning, stacklevel=2)
    end = time.perf_counter()
    return Weld(variant, labels, paths, grooves, {"detect": found - begin, "path": end - found}, spacing, left_out)


def _also(words: str, grooves: tuple[DetectedGroove, ...]) -> str:
    """What else was found: how many grooves, and how long."""
    if not grooves:
        return ""
    lengths = ", ".join(f"{groove.length_mm:.0f}" for groove in grooves)
    return f"; {words}: {len(grooves)} more groove{'s' if len(grooves) > 1 else ''} ({lengths} mm long)"
