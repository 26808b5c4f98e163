"""What faces that bend miss of their meeting: they are fitted to less of themselves, and where that moves the meeting
by more than noise does, as much is missed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from grindvision.records import by_content
from grindvision.vision.seam.face_fit import FaceFit, Faces, Scale, fit_faces, intersections, window_mm
from grindvision.vision.seam.seam_curve import SeamCurve
from grindvision.vision.seam.seam_smoothing import smooth_along

Floats = NDArray[np.float64]

#: What a fit over too much of a bent surface misses shows when it is fitted over this part of it.
NARROW = 0.75
#: After the move so many times as much is still missed: 0.73 and 0.46 where the miss grows with the third and the
#: fourth power of the part.
STILL_MISSED = 0.6
#: A move is smoothed along the seam over so many cells.
SMOOTHED_CELLS = 2.0


@by_content
@dataclass(frozen=True)
class Meeting:
    """Where two faces meet beside S stations: ``displacement`` (S, 2), across and up, mm, with ``weight`` (S,) of each,
    and ``sine`` (S,) of the angle between the faces."""

    displacement: Floats
    weight: Floats
    sine: Floats


@by_content
@dataclass(frozen=True)
class NarrowerMove:
    """How far (S, 2), across and up, faces fitted to less of themselves meet from where they met, and the standard
    deviation (S,) of each by noise alone, mm."""

    moved: Floats
    noise: Floats

    @property
    def share(self) -> Floats:
        """The share (S,) of the move that is no noise."""
        squared = (self.moved**2).sum(axis=1)
        return np.asarray(np.clip(1 - 2 * self.noise**2 / np.maximum(squared, 1e-300), 0.0, 1.0))

    @property
    def missed(self) -> Floats:
        """What is missed (S, 2): the move less its noise."""
        return self.share[:, None] * self.moved

    @property
    def sigma(self) -> Floats:
        """The standard deviation (S,) of a root that was moved by ``missed``: its noise, and what is still missed."""
        return np.asarray(np.sqrt(2 * self.share * self.noise**2 + STILL_MISSED**2 * (self.missed**2).sum(axis=1)))


def narrower_move(
    points: Floats, curve: SeamCurve, faces: Faces, sides: FaceFit, meeting: Meeting, scale: Scale
) -> NarrowerMove:
    """How far the meeting of faces, fitted as ``sides``, moves where they are fitted to ``NARROW`` of their width and
    of the window along the seam.

    Where surfaces bend, a parabola over a window misses by what grows with the third power and more of both. By noise
    alone the meetings of a fit and of one to a part of its points differ by the difference of their variances; the
    narrower one has the smaller where it is a line and the other one a parabola.
    """
    narrow = replace(scale, cell=NARROW * scale.cell)
    fitted = fit_faces(points, curve, faces, narrow)
    if fitted is None:
        return NarrowerMove(np.zeros_like(meeting.displacement), np.zeros(len(curve)))
    raw = intersections(curve, faces, fitted)[0] - meeting.displacement
    length_mm = SMOOTHED_CELLS * scale.cell
    moved = smooth_along(raw, meeting.weight, length_mm, curve.step_mm, robust=True)
    more = np.abs(fitted.covariance[..., 0, 0] - sides.covariance[..., 0, 0]).sum(axis=0)
    noise = np.sqrt(more) / meeting.sine
    kept = smooth_along(np.eye(len(curve)), meeting.weight, length_mm, curve.step_mm)
    number = np.arange(len(curve)) * curve.step_mm
    alike_mm = 2 * np.sqrt(np.pi) * window_mm(narrow)
    shared = np.exp(-np.pi * (np.subtract.outer(number, number) / alike_mm) ** 2)
    smoothed = np.einsum("ij,ij->i", kept @ shared, kept)
    return NarrowerMove(moved, noise * np.sqrt(np.clip(smoothed, 0.0, 1.0)))
