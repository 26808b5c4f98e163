"""Two scans registered and compared: what ``detect``, ``grind`` and ``grind_again`` have in common."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from grindvision.errors import InputError
from grindvision.models import Model
from grindvision.records import by_content
from grindvision.vision.change.bent_pieces import bending_doubts
from grindvision.vision.change.change_detection import Difference, find_change
from grindvision.vision.change.diagnostics import NAMES, diagnose
from grindvision.vision.change.mixed_pixels import diagnose_mixed_pixels
from grindvision.vision.change.moved_body import check_one_body
from grindvision.vision.change.smoothed_edges import SmoothedEdges, find_smoothed_edges, smoothing_doubts
from grindvision.vision.registration.datum import refine_on_datum
from grindvision.vision.registration.deformed_registration import DeformedPart, register_deformed
from grindvision.vision.registration.face_offsets import FaceReading, read_faces
from grindvision.vision.registration.model_registration import diagnose_model
from grindvision.vision.registration.scan_registration import Registration, StageClock
from grindvision.vision.surface.model_surface import ModelSurface


class CompareOptions(Protocol):
    """What a comparison asks of the options of a command; see ``DetectOptions`` for each."""

    @property
    def seed(self) -> int:
        """Of the random draws."""

    @property
    def viewpoint_sample_mm(self) -> ArrayLike | None:
        """Place (3,) of the sample's scanner, where it is known."""

    @property
    def viewpoint_test_mm(self) -> ArrayLike | None:
        """Place (3,) of the test's scanner, where it is known."""

    @property
    def datum_mm(self) -> ArrayLike | None:
        """The faces that fix the pose: corners (2, 3) of a box, or points (K, 3)."""


@by_content
@dataclass(frozen=True)
class Comparison:
    """Two scans, registered, and what differs.

    ``faces``: which faces fixed the pose, and which are off as a whole. ``model``: the whole surface, where the sample
    was a model. ``deformed``: how the part is bent against the sample, where no rigid pose fits; the registration's
    target is then bent like it. ``doubted``: pieces of the difference, by their number from 0, that may be bending or
    smoothing and not stock, and why: none of them is ground. ``smoothed``: how the scans differ along their rims, where
    that is more than noise explains and pieces were found.
    """

    registration: Registration
    difference: Difference
    faces: FaceReading
    model: ModelSurface | None
    deformed: DeformedPart | None
    doubted: dict[int, str]
    seed: int
    smoothed: SmoothedEdges | None = None

    def diagnose(self) -> tuple[str, ...]:
        """What speaks against the comparison, in words."""
        found, difference = self.registration, self.difference
        against = self.faces.diagnose(nothing_found=not difference.clusters)
        if not self.faces.off:  # a face that is off looks like another scale, and like missing material elsewhere
            against += diagnose(found.source, found.target, found.fine, difference, self.seed, bool(self.faces.sole))
        if self.smoothed is None:
            against += diagnose_mixed_pixels(found.source, found.target, found.fine, difference)
        else:
            against += (str(self.smoothed),)
        against += () if self.model is None else diagnose_model(self.model.facets)
        return against + (() if self.deformed is None else self.deformed.diagnose())


def compare(sample: ArrayLike | Model, test: ArrayLike, options: CompareOptions, clock: StageClock) -> Comparison:
    """Register a pair and find what differs.

    Args:
        sample: scan of the good part, points (N, 3) in mm in its own scanner's frame, or its ``Model``.
        test: scan of the part to be judged, points (M, 3) in mm in its own scanner's frame.
        options: seed, viewpoints and datum.
        clock: is told each stage of the registration, and ``difference``, when it is done.

    Raises:
        InputError, DegenerateError: see ``detect``.
    """
    viewpoints_mm = options.viewpoint_test_mm, options.viewpoint_sample_mm
    registered = register_deformed(test, sample, viewpoints_mm, np.random.default_rng(options.seed), clock, NAMES)
    deformed = registered.deformed
    faces = _faces(registered.registration, options.datum_mm, options.seed, deformed)
    found = replace(registered.registration, fine=faces.registration)
    of_field = None if deformed is None else deformed.place_variances
    difference = find_change(found.source, found.target, found.fine, settled=faces.settled, place_variance=of_field)
    if deformed is None and options.datum_mm is None:
        check_one_body(found.source, found.target, found.fine, difference, faces)
    smoothed = None
    if difference.clusters and deformed is None and not faces.off:  # a face that is off differs along its rims, too
        smoothed = find_smoothed_edges(found.source, found.target, found.fine, difference)
    doubted = smoothing_doubts(difference, smoothed)
    if deformed is not None:
        doubted = bending_doubts(difference, found.source.surfels.normals, deformed)
    clock.lap("difference")
    return Comparison(found, difference, faces, registered.surface, deformed, doubted, options.seed, smoothed)


def _faces(found: Registration, datum_mm: ArrayLike | None, seed: int, deformed: DeformedPart | None) -> FaceReading:
    """The pose by the datum, where one is given, else by all faces but one that the others contradict; that of a
    ``deformed`` part goes with its field."""
    if deformed is not None:
        if datum_mm is not None:
            raise InputError(f"a datum fixes no pose of a part that is {deformed}; leave --datum out")
        return FaceReading(found.fine, (), True, None, ())
    if datum_mm is None and found.fine.by_rims:  # a fit of the faces would slide along what they leave open
        return FaceReading(found.fine, (), True, None, ())
    if datum_mm is None:
        return read_faces(found.source, found.target, found.fine, seed)
    fine, settled = refine_on_datum(found.source, found.target, found.fine, datum_mm)
    return FaceReading(fine, (), True, settled, ())
