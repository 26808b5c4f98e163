"""A weld seam that was found, with its kind, its sizes and its evidence."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from grindvision.records import by_content
from grindvision.vision.seam.groove_lines import DetectedGroove
from grindvision.vision.seam.joint_names import BUTT, LAP

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


@dataclass(frozen=True)
class Interruption:
    """A stretch of a seam that the scan does not show as a joint: a clamp, a tack, a hole in the scan; mm along it."""

    start_mm: float
    end_mm: float

    def __str__(self) -> str:
        return f"{self.start_mm:.0f} to {self.end_mm:.0f} mm"


@by_content
@dataclass(frozen=True)
class Seam:
    """A weld seam at S stations, in the cloud's frame, mm.

    ``kind`` is one of ``joint_names.KINDS``, ``evidence`` says in words why. ``root`` (S, 3) is the line to weld with
    ``sigma_mm`` (S,) of its distance; ``normals`` (S, 3) lead out of the joint, half-way between its faces: a torch
    without work angle comes in against them. ``faces`` (2, S, 3) are the two surfaces' normals, ``opening_deg`` (S,)
    the angle of the air between them with ``opening_sigma_deg``; ``legs_mm`` (2, S) how far each face was followed.
    ``toes`` (2, S, 3) are where the joint ends on both sides: a groove's edges, a gap's edges, else the root.
    ``gap_mm`` and ``step_mm`` (S,) are the gap and the misalignment (hi-lo, or the step of a lap) with their standard
    deviations, zero where the kind has none. ``members`` (K,) are the points that belong to it. ``deviations`` is by
    how many standard deviations the faces of a corner turn, judged over its whole length. ``doubts`` are sentences
    without their subject that say what speaks against the kind or the line. ``glancing`` says that one face is seen so
    flat that it may be none.
    """

    kind: str
    evidence: str
    root: Floats
    sigma_mm: Floats
    normals: Floats
    faces: Floats
    opening_deg: Floats
    opening_sigma_deg: float
    legs_mm: Floats
    toes: Floats
    gap_mm: Floats
    gap_sigma_mm: float
    step_mm: Floats
    step_sigma_mm: float
    members: Integers
    interruptions: tuple[Interruption, ...] = ()
    closed: bool = False
    groove: DetectedGroove | None = None
    deviations: float = np.inf
    doubts: tuple[str, ...] = ()
    glancing: bool = False

    @property
    def length_mm(self) -> float:
        """Length of the root line, all round for a closed one."""
        if self.groove is not None:
            return self.groove.length_mm
        line = np.concatenate([self.root, self.root[:1]]) if self.closed else self.root
        return float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())

    @property
    def size(self) -> str:
        """What a welder asks for first, in words."""
        opening = f"{np.median(self.opening_deg):.0f} deg"
        if self.groove is not None:
            width, depth = np.median(self.groove.width_mm), np.median(self.groove.depth_mm)
            return f"{width:.1f} mm wide, {depth:.1f} mm deep"
        if self.kind == BUTT:
            return f"gap {np.median(self.gap_mm):.2f} mm, hi-lo {np.median(self.step_mm):.2f} mm"
        if self.kind == LAP:
            return f"step {np.median(self.step_mm):.1f} mm"
        return f"faces {opening} apart"

    def __str__(self) -> str:
        shape = ", closed" if self.closed else ""
        return f"{self.kind} {self.length_mm:.0f} mm long{shape}, {self.size}"
