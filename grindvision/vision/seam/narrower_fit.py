"""What faces that bend miss of their meeting: they are fitted to less of themselves, and where that moves the meeting
by more than noise does, as much is missed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from grindvision.records import by_content
from grindvision.vision.seam.face_fit import (
    FaceFit,
    Faces,
    Scale,
    bent_at_root,
    fit_faces,
    intersections,
    window_mm,
)
from grindvision.vision.seam.joint_extent import leg_lengths
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
#: A fit that begins a cell farther from the seam shows at least this part of a face's own bend, at most its inverse:
#: a third of what a camera's blur makes of a corner, and 5 times what the rim of a cloud makes of a strip of a wall.
ALIKE = 0.5


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


def bent_where_clear(points: Floats, curve: SeamCurve, faces: Faces, sides: FaceFit, scale: Scale) -> FaceFit:
    """The fit ``sides``, with those faces as parabolas too whose bend stands out at the root (``bent_at_root``) and is
    their own: alike beyond the reach of a blurred corner, of a face that is seen over all the width of the fit. What
    remains of a groove's wall at the cloud's rim is a strip too narrow to tell a bend."""
    bending = np.array(bent_at_root(sides, window_mm(scale) / curve.step_mm))
    added = np.flatnonzero(bending & ~np.array(sides.bent))
    if not len(added):
        return sides
    farther = replace(scale, rounding=scale.near + scale.cell)
    bent, beyond = (fit_faces(points, curve, faces, one, (True, True)) for one in (scale, farther))
    if bent is None or beyond is None:
        return sides
    legs = np.median(leg_lengths(points, curve, faces, bent, scale), axis=1)
    for side in added:
        whole, part = bent.coefficients[side, :, 2], beyond.coefficients[side, :, 2]
        own = ALIKE * (whole @ whole) < whole @ part < (whole @ whole) / ALIKE
        bending[side] = own and legs[side] >= scale.far
    told = bool(bending[0]), bool(bending[1])
    return sides if told == sides.bent else fit_faces(points, curve, faces, scale, told) or sides


def narrower_move(
    points: Floats, curve: SeamCurve, faces: Faces, sides: FaceFit, meeting: Meeting, scale: Scale
) -> NarrowerMove:
    """How far the meeting of faces, fitted as ``sides``, moves where they are fitted to ``NARROW`` of their width and
    of the window along the seam, again as lines or parabolas: a line to part of a bent face misses more than a parabola
    to all of it.

    Where surfaces bend, a parabola over a window misses by what grows with the third power and more of both. By noise
    alone the meetings of a fit and of one to a part of its points differ by the difference of their variances.
    """
    narrow = replace(scale, cell=NARROW * scale.cell)
    fitted = fit_faces(points, curve, faces, narrow, sides.bent)
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
