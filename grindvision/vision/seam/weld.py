"""From a cloud to the torch's way points, as the second paper's flow chart reads: detect the groove, then trace it."""

from __future__ import annotations

import time
import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import GrindvisionWarning, InputError
from grindvision.loose_settings import settings_in
from grindvision.parallel import one_blas_thread
from grindvision.records import by_content
from grindvision.vision.seam.gfh_groove import GfhSettings, find_groove_gfh
from grindvision.vision.seam.groove_diagnostics import diagnose_groove
from grindvision.vision.seam.groove_lines import DetectedGroove
from grindvision.vision.seam.joints import Seam
from grindvision.vision.seam.seam_path import SeamPath, root_path, slab_path
from grindvision.vision.seam.seams import FindSeamsOptions, SeamDetection, find_seams

Flags = NDArray[np.bool_]
VARIANTS = ("ours", "paper")


@by_content
@dataclass(frozen=True)
class TraceWeldOptions:
    """Settings of ``trace_weld``, in mm and in the cloud's frame.

    ``waypoints``: their number along each seam; of slabs in the paper's variant. ``variant``: ``ours`` or ``paper``.
    ``viewpoint_mm``: the camera (3,), where it is not the origin. ``settings``: of the paper's variant. Of our variant
    are ``width_mm``, the rough width of the groove, estimated when left out, and ``joint``, a kind of seam or a family
    of kinds (see ``joint_names``).
    """

    waypoints: int = 50
    variant: str = "ours"
    viewpoint_mm: ArrayLike | None = None
    settings: GfhSettings | None = None
    width_mm: float | None = None
    joint: str = "any"

    def __post_init__(self) -> None:
        if self.variant not in VARIANTS:
            raise InputError(f"variant {self.variant!r} is unknown; choose one of {', '.join(VARIANTS)}")
        if self.waypoints < 2:
            raise InputError(f"{self.waypoints} way points make no path; ask for at least 2")


@by_content
@dataclass(frozen=True)
class Weld:
    """What was found in a cloud: ``labels`` in its shape, ``paths`` one per seam, as in ``find_seams``.

    ``seams`` belong to the paths one by one, and ``grooves`` are those of them that are grooves; the paper's variant
    measures none and has one path. ``timings_s`` holds seconds per stage, ``spacing_mm`` the distance of neighbouring
    points as ours found it. ``left_out`` are grooves that were found too, but are too small against the first to count;
    ``weaker`` are seams of less certain kinds.
    """

    variant: str
    labels: Flags
    paths: tuple[SeamPath, ...]
    grooves: tuple[DetectedGroove, ...]
    timings_s: dict[str, float]
    spacing_mm: float | None = None
    left_out: tuple[DetectedGroove, ...] = ()
    seams: tuple[Seam, ...] = ()
    weaker: tuple[Seam, ...] = ()

    @property
    def path(self) -> SeamPath:
        """The path of the first seam."""
        return self.paths[0]

    def __str__(self) -> str:
        if self.seams and not self.grooves:
            more = "".join(f"; also: {seam}" for seam in self.seams[1:])
            return f"{self.seams[0]}; {self.path}{more}"
        what = self.grooves[0] if self.grooves else f"groove of {int(self.labels.sum()):,} points"
        others = "".join(f"; also: {seam}" for seam in self.seams if seam.groove is None)
        also, left_out = _also("also", self.grooves[1:]), _also("left out as too small", self.left_out)
        return f"{what}; {self.path}{also}{left_out}{others}"


@settings_in(TraceWeldOptions, 1, ("waypoints", "variant", "viewpoint_mm", "settings", "width_mm", "joint"))
@one_blas_thread()
def trace_weld(points: ArrayLike, options: TraceWeldOptions | None = None) -> Weld:
    """Find the weld seams of a cloud and put way points along them; what ``grindvision groove`` does.

    Args:
        points: (N, 3) or organised (R, C, 3), mm; rows with NaN belong to no seam.
        options: way points, variant, viewpoint, kind of joint; see ``TraceWeldOptions``.

    Returns:
        A path per seam, way points (K, 3) in mm and outward unit normals (K, 3) in the frame of the points; ``labels``
        in the shape of the cloud.

    Raises:
        InputError: an unusable cloud. UnitError: its size is no part's in mm. NoGrooveError: there is no seam, or none
            of the kind.

    Warns:
        GrindvisionWarning: a groove is doubtful (partly outside the cloud, walls unseen, few points); larger hollows in
            the scene are no grooves; nothing tells from which side the scan was taken; a seam is interrupted.

    Example:
        >>> import numpy as np
        >>> from grindvision import TraceWeldOptions, trace_weld
        >>> x, y = np.meshgrid(np.arange(-60.0, 60.0), np.arange(-30.0, 30.0, 0.5))
        >>> plate = np.stack([x, y, 400 + np.maximum(0, 6 - 1.2 * abs(y))], axis=-1).reshape(-1, 3)
        >>> weld = trace_weld(plate, TraceWeldOptions(waypoints=10, joint="groove"))
        >>> weld.path.points.shape, weld.path.normals.shape
        ((10, 3), (10, 3))
    """
    options = TraceWeldOptions() if options is None else options
    waypoints, variant, viewpoint_mm = options.waypoints, options.variant, options.viewpoint_mm
    grooves: tuple[DetectedGroove, ...] = ()
    left_out: tuple[DetectedGroove, ...] = ()
    spacing: float | None = None
    seams: tuple[Seam, ...] = ()
    weaker: tuple[Seam, ...] = ()
    paths: tuple[SeamPath, ...]
    begin = time.perf_counter()
    if variant == "paper":
        detection = find_groove_gfh(points, options.settings, viewpoint_mm)
        found = time.perf_counter()
        inside = detection.labels.ravel()[detection.finite]
        paths = (slab_path(detection.smoothed[inside], detection.normals[inside], waypoints),)
        labels = detection.labels
    else:
        detected = find_seams(points, FindSeamsOptions(viewpoint_mm, options.joint, options.width_mm))
        found = time.perf_counter()
        seams, weaker, spacing = detected.seams, detected.weaker, detected.spacing_mm
        labels, grooves = detected.labels, tuple(seam.groove for seam in seams if seam.groove is not None)
        left_out = detected.grooves.left_out if grooves and detected.grooves is not None else ()
        paths = tuple(root_path(seam.groove or seam, waypoints) for seam in seams)
        for finding in _findings(detected, points):
            warnings.warn(finding, GrindvisionWarning, stacklevel=2)
    end = time.perf_counter()
    timings = {"detect": found - begin, "path": end - found}
    return Weld(variant, labels, paths, grooves, timings, spacing, left_out, seams, weaker)


def _findings(detected: SeamDetection, points: ArrayLike) -> list[str]:
    """What makes the seams doubtful, a sentence each."""
    findings = []
    grooves = [seam.groove for seam in detected.seams if seam.groove is not None]
    if grooves and detected.grooves is not None and detected.grooves.cluttered:
        findings.append(
            "the largest hollows of the scene are gaps between things, no grooves: see in the picture that the path"
            " lies in the groove, else crop the cloud to the part"
        )
    for number, (groove, judged) in enumerate(zip(grooves, detected.judged, strict=True), start=1):
        told = diagnose_groove(groove, points, detected.spacing_mm, judged)
        findings += [f"groove {number} {finding}" for finding in told]
    for number, seam in enumerate(detected.seams, start=1):
        findings += [f"seam {number} ({seam.kind}) {doubt}" for doubt in seam.doubts]
        if seam.interruptions:
            where = ", ".join(map(str, seam.interruptions))
            findings.append(f"seam {number} ({seam.kind}) is not seen at {where} of its length: the path bridges it")
    if detected.view_assumed:
        findings.append(
            "nothing tells from which side the scan was taken, one was assumed: give the viewpoint, or a corner may be"
            " taken inside out and a ridge for a groove"
        )
    if detected.weaker:
        findings.append(f"less certain, and not followed: {'; '.join(map(str, detected.weaker))}; ask for them by kind")
    return findings


def _also(words: str, grooves: tuple[DetectedGroove, ...]) -> str:
    """What else was found: how many grooves, and how long."""
    if not grooves:
        return ""
    lengths = ", ".join(f"{groove.length_mm:.0f}" for groove in grooves)
    return f"; {words}: {len(grooves)} more groove{'s' if len(grooves) > 1 else ''} ({lengths} mm long)"
