"""What report.png of ``grindvision detect`` shows, as plain numbers and words: another process may draw it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from grindvision.geometry import inverse, move_points
from grindvision.records import by_content
from grindvision.words import counted

if TYPE_CHECKING:
    from grindvision.vision.change.detection import Detection

Floats = NDArray[np.float64]


class View:
    """Looks at a scan along its direction of least spread, from the side to which the normals point."""

    def __init__(self, points: Floats, normals: Floats) -> None:
        self.middle = points.mean(axis=0)
        _, axes = np.linalg.eigh(np.cov((points - self.middle).T))
        self.axes = axes[:, [2, 1]] * np.sign(axes[np.abs(axes[:, [2, 1]]).argmax(axis=0), [2, 1]])
        self.towards_eye = np.cross(*self.axes.T)
        if self.towards_eye @ normals.mean(axis=0) < 0:
            self.axes[:, 1] *= -1
            self.towards_eye *= -1

    def __call__(self, points: Floats) -> Floats:
        """Places (N, 2), mm, of points (N, 3) in the picture."""
        return np.asarray((points - self.middle) @ self.axes)

    def heights(self, points: Floats) -> Floats:
        """How far points (N, 3) are towards the eye (N,), mm."""
        return np.asarray((points - self.middle) @ self.towards_eye)

    def around(self, points: Floats, place: Floats, reach_mm: float) -> Floats:
        """Those of points (N, 3) that are shown within ``reach_mm`` of a place (2,) along both axes of the picture."""
        near = np.ones(len(points), dtype=bool)
        for along, at in zip(self.axes.T, place + self.middle @ self.axes, strict=True):
            near &= np.abs(points @ along - at) < reach_mm
        return points[near]


@by_content
@dataclass(frozen=True)
class ShownBead:
    """A bead's ``ridge`` (M, 3), and whether it is ``closed``, with the path ``points`` (K, 3) on it."""

    ridge: Floats
    closed: bool
    points: Floats


@by_content
@dataclass(frozen=True)
class Shown:
    """What the picture shows of a ``Detection``, mm, in the scanner frame of TEST but for ``sample``.

    ``test`` and ``sample``: surfels of both scans, ``registered`` those of the sample after registration; ``normals``
    belong to ``test``. ``compared`` (N, 3) stands ``signed_mm`` (N,) above the good surface, NaN or not ``comparable``
    where that is not known. ``standing``: points that stand out of it, ``peaks_mm`` for each piece of them, ``pieces``
    in all. ``near``: points around the largest bead, within ``reach_mm``.
    """

    verdict: str
    facts: str
    test: Floats
    normals: Floats
    sample: Floats
    registered: Floats
    compared: Floats
    signed_mm: Floats
    comparable: NDArray[np.bool_]
    standing: Floats
    peaks_mm: tuple[float, ...]
    pieces: int
    level_of_detection_mm: float
    beads: tuple[ShownBead, ...]
    near: Floats
    reach_mm: float


def to_show(found: Detection) -> Shown:
    """What the picture shows of a detection."""
    test, sample, difference = found.test.surfels, found.sample.surfels.points, found.difference
    near, reach_mm = np.empty((0, 3)), 0.0
    if found.beads:
        bead, view = found.beads[0], View(test.points, test.normals)
        reach_mm = 0.75 * bead.length_mm + 3 * bead.width_mm
        near = view.around(found.test.points, view(bead.points).mean(axis=0), reach_mm)
    return Shown(
        *_verdict(found), test.points, test.normals, sample, move_points(inverse(found.T_sample_test), sample),
        difference.surfels, difference.signed_mm, difference.comparable, difference.points,
        tuple(cluster.peak_mm for cluster in difference.clusters), len(difference.clusters) + len(difference.specks),
        difference.level_of_detection_mm,
        tuple(ShownBead(bead.ridge, bead.closed, bead.points) for bead in found.beads), near, reach_mm,
    )  # fmt: skip


def _verdict(found: Detection) -> tuple[str, str]:
    registration = found.registration
    facts = (
        f"Registration: confidence {found.confidence:.2f}, overlap {registration.overlap:.0%},"
        f" rms {registration.rms_mm:.3f} mm. Frame: scanner frame of the test scan."
    )
    standing = len(found.difference.clusters) or len(found.difference.specks)
    if not found.beads and standing:
        return f"No path: {counted(standing, 'piece stands', 'pieces stand')} out, none to be followed", facts
    if not found.beads:
        level, cell = found.difference.level_of_detection_mm, found.test.surfels.grid.size_mm
        return f"Nothing to grind: no difference above {level:.2f} mm, compared in cells of {cell:.2g} mm", facts
    bead = found.beads[0]
    size = f"{bead.length_mm:.1f} x {bead.width_mm:.1f} mm, {bead.height_mm:.2f} mm high"
    beads = counted(len(found.beads), "bead")
    largest = "it measures" if len(found.beads) == 1 else "the largest measures"
    return f"Found {beads} to grind, {len(found.path_points)} path points; {largest} {size}", facts
