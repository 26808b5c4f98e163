"""Detection of what has to be ground away, stage by stage as in the paper's flow chart (Figure 2)."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import AmbiguousError, DegenerateError, GrindvisionWarning, InputError, TooSmallError
from grindvision.geometry import check_points
from grindvision.vision.change.change_detection import Difference, find_difference
from grindvision.vision.change.diagnostics import check_same_unit, doubts, mirrored_refusal, table_doubt
from grindvision.vision.change.ridge_path import BeadPath, trace_bead
from grindvision.vision.registration.deformable import refine_bent
from grindvision.vision.registration.global_registration import propose_poses
from grindvision.vision.registration.icp import FineRegistration
from grindvision.vision.registration.plane_icp import icp_planes
from grindvision.vision.registration.verification import VerifiedPose, choose_pose
from grindvision.vision.surface.scan import Scan, choose_resolution, prepare_pair, reversed_scan
from grindvision.vision.surface.surfels import build_surfels

Floats = NDArray[np.float64]

FEWEST_POINTS = 500
STAGES = ("features", "coarse", "verification", "icp", "difference", "path")


@dataclass(frozen=True)
class DetectOptions:
    """Settings of ``detect``: path ``points`` per bead, ``seed`` of the random draws, the scanners' places if known."""

    points: int = 6
    seed: int = 0
    viewpoint_sample_mm: ArrayLike | None = None
    viewpoint_test_mm: ArrayLike | None = None


@dataclass(frozen=True)
class Detection:
    """Result of ``detect``; everything but ``T_sample_test`` is in the frame of the test scan.

    ``coarse`` and ``registration`` are the two stages of the registration, ``difference`` what stands out, ``beads``
    its paths, largest first; ``timings_s`` the stages' times.
    """

    sample: Scan
    test: Scan
    coarse: VerifiedPose
    registration: FineRegistration
    difference: Difference
    beads: tuple[BeadPath, ...]
    timings_s: dict[str, float] = field(compare=False)

    @property
    def T_sample_test(self) -> Floats:
        """Registration (4, 4): T_sample_test @ p_test = p_sample."""
        return self.registration.T_target_source

    @property
    def confidence(self) -> float:
        """How sure the registration is, 0..1."""
        return self.coarse.confidence

    @property
    def path_points(self) -> Floats:
        """Path points (n, 3) of all beads, one bead after the other."""
        return np.concatenate([bead.points for bead in self.beads] or [np.empty((0, 3))])

    @property
    def path_normals(self) -> Floats:
        """Unit normals (n, 3) at the path points."""
        return np.concatenate([bead.normals for bead in self.beads] or [np.empty((0, 3))])

    def __str__(self) -> str:
        pieces = len(self.difference.clusters)
        if pieces and not self.beads:
            return f"no path: {pieces} piece(s) stand out, none to be followed; {self.registration}"
        if not pieces:
            return f"nothing to grind above the level of detection of {self.difference.level_of_detection_mm:.2f} mm"
        return f"{len(self.beads)} bead(s), {len(self.path_points)} path points; {self.registration}"


def detect(
    sample: ArrayLike,
    test: ArrayLike,
    options: DetectOptions | None = None,
    finished: Callable[[str], None] | None = None,
) -> Detection:
    """Compare a test scan (M, 3) with the scan of a good part (N, 3), both in mm and in their own scanner frames.

    The stages: voxels and surfels, normals and FPFH, first alignment (SAC-IA), verification, ICP, difference, paths.
    ``finished`` is told the name of each stage (``STAGES``) when it is done.

    Raises:
        InputError: NaN points, numbers that are no points, or a scan that fits as its mirror image only. UnitError: one
            scan is many times larger than the other.
        DegenerateError: too few points; the scans do not fit, do not overlap enough, or leave a motion free; another
            part; a largest bead that branches.

    Warns:
        GrindvisionWarning: something speaks against the result (``doubts``); a piece that is too small to be followed,
            or that branches and is not the largest.
    """
    options = DetectOptions() if options is None else options
    if options.points < 1:
        raise InputError(f"{options.points} path points asked for; at least 1 is needed")
    clock = _Clock(finished)
    sample = check_points(sample, "sample points", FEWEST_POINTS)
    test = check_points(test, "test points", FEWEST_POINTS)
    rng = np.random.default_rng(options.seed)
    check_same_unit(sample, test)

    def register(test: Floats, viewpoint_test_mm: ArrayLike | None) -> tuple[Scan, Scan, VerifiedPose]:
        good, seen = prepare_pair(sample, test, (options.viewpoint_sample_mm, viewpoint_test_mm))
        clock.lap("features")
        seen, poses = propose(good, seen, rng)
        clock.lap("coarse")
        return good, seen, choose_pose(seen, good, poses, rng)

    try:
        good, seen, coarse = register(test, options.viewpoint_test_mm)
    except DegenerateError as refusal:
        coarse_surfels = (build_surfels(points, choose_resolution(points).voxel_mm) for points in (sample, test))
        if table := table_doubt(*coarse_surfels):
            raise type(refusal)(f"{refusal}; and {table}") from None
        if isinstance(refusal, AmbiguousError):  # what leaves a motion free mostly fits its mirror image too
            raise
        raise mirrored_refusal(test, options.viewpoint_test_mm, register, refusal) from None
    clock.lap("verification")
    registration = refine(good, seen, coarse, rng)
    clock.lap("icp")
    difference = find_difference(good, seen, registration)
    clock.lap("difference")
    said = doubts(good, seen, registration, difference)
    try:
        beads = _follow(difference, options.points)
    except DegenerateError as error:
        raise DegenerateError("; and ".join((str(error), *said))) from None
    clock.lap("path")
    for sentence in said:
        warnings.warn(sentence, GrindvisionWarning, stacklevel=2)
    return Detection(good, seen, coarse, registration, difference, beads, clock.laps_s)


def propose(sample: Scan, test: Scan, rng: np.random.Generator) -> tuple[Scan, Floats]:
    """Likely poses T_sample_test (K, 4, 4); where no viewpoint tells the test's outside, the side that fits better.

    Returns the test scan, reversed if that fits better, and the poses.
    """
    poses, votes = propose_poses(test.keypoints, sample.keypoints, rng)
    if sample.viewpoint_mm is None or test.viewpoint_mm is None:
        other = reversed_scan(test)
        try:
            other_poses, other_votes = propose_poses(other.keypoints, sample.keypoints, rng)
        except DegenerateError:
            return test, poses
        if other_votes[0] > votes[0]:
            return other, other_poses
    return test, poses


def refine(
    sample: Scan, test: Scan, coarse: VerifiedPose, rng: np.random.Generator, points: int = 6_000
) -> FineRegistration:
    """Point-to-plane ICP on fine surfels from the verified pose, then once more with a smooth bending allowed."""
    chosen = np.sort(rng.permutation(len(test.surfels))[:points])  # neighbours in a row share the cache
    places, normals = test.surfels.points[chosen], test.surfels.normals[chosen]
    size = sample.surfels.grid.size_mm
    found = icp_planes(places, normals, sample.surfels, coarse.registration.T_target_source, 2 * size)
    return refine_bent(places, normals, sample.surfels, found)


def _follow(difference: Difference, points: int) -> tuple[BeadPath, ...]:
    """Paths of all pieces; one that is too small, or branches and is not the largest, is left out with a warning."""
    beads = []
    for rank, cluster in enumerate(difference.clusters):
        try:
            beads.append(trace_bead(cluster, points))
        except DegenerateError as error:
            if rank == 0 and not isinstance(error, TooSmallError):
                raise
            warnings.warn(f"piece {rank + 1} of the difference is left out: {error}", GrindvisionWarning, stacklevel=3)
    return tuple(beads)


class _Clock:
    def __init__(self, finished: Callable[[str], None] | None) -> None:
        self.finished = finished
        self.laps_s: dict[str, float] = {}
        self.last = time.perf_counter()

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.laps_s[name] = now - self.last
        self.last = now
        if self.finished is not None:
            self.finished(name)
