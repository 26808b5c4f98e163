"""Registration of two scans, stage by stage: features, first alignment, verification, ICP."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import AmbiguousError, DegenerateError, GrindvisionWarning, InputError
from grindvision.geometry import check_points, move_points
from grindvision.geometry.hash_grid import random_order
from grindvision.parallel import one_blas_thread
from grindvision.records import by_content
from grindvision.vision.registration.deformable import refine_bent
from grindvision.vision.registration.free_motions import rms_extent
from grindvision.vision.registration.global_registration import propose_poses
from grindvision.vision.registration.held_motion import SLID, hold_where_verified
from grindvision.vision.registration.icp import FineRegistration
from grindvision.vision.registration.layered_scans import allow_for_layers
from grindvision.vision.registration.pair_diagnostics import PairNames, check_same_unit, diagnose_table
from grindvision.vision.registration.plane_icp import icp_planes
from grindvision.vision.registration.pose_findings import LEFT_HANDED, warn_of_findings
from grindvision.vision.registration.rim_fit import hold_by_rims
from grindvision.vision.registration.verification import VerifiedPose, choose_pose
from grindvision.vision.surface.scan import Scan, choose_resolution, prepare_pair, reversed_scan
from grindvision.vision.surface.stray_points import stray_points
from grindvision.vision.surface.surfels import build_surfels, same_within
from grindvision.words import counted

Floats = NDArray[np.float64]
Viewpoints = tuple[ArrayLike | None, ArrayLike | None]

STAGES = ("features", "coarse", "verification", "icp")
"""What ``register`` does, in order."""

MIN_POINTS = 500
"""A scan of fewer points shows too few surfels to be registered."""

CERTAIN = 0.5
"""Only a mirror image that fits with this confidence is no chance: nearly flat parts fit their mirror image anyhow."""

ALONE = 0.9
"""Scans that are ambiguous as they are do fit as a mirror image where that fits in one pose alone, this surely."""


@by_content
@dataclass(frozen=True)
class RegisterOptions:
    """Settings of ``register``: ``seed`` of the random draws; the scanners' places (3,) in mm, each in the frame of its
    scan, where they are known."""

    seed: int = 0
    viewpoint_source_mm: ArrayLike | None = None
    viewpoint_target_mm: ArrayLike | None = None


@by_content
@dataclass(frozen=True)
class Registration:
    """Result of ``register``: both scans as they were compared, the two stages of the pose, and the stages' times.

    ``coarse`` is the verified first alignment with its rivals, ``fine`` the pose after ICP with its covariance.
    """

    source: Scan
    target: Scan
    coarse: VerifiedPose
    fine: FineRegistration
    timings_s: dict[str, float] = field(compare=False)

    @property
    def T_target_source(self) -> Floats:
        """The pose (4, 4): T_target_source @ p_source = p_target."""
        return self.fine.T_target_source

    @property
    def confidence(self) -> float:
        """How sure the pose is, 0..1: how much better it fits than its best rival."""
        return self.coarse.confidence

    @property
    def overlap(self) -> float:
        """Fraction of the source that lies on the target's surface."""
        return self.fine.overlap

    def __str__(self) -> str:
        return f"{self.fine}; confidence {self.confidence:.2f}"


class StageClock:
    """Seconds that each stage took, ``laps_s``; ``finished`` is told the name of each when it is done."""

    def __init__(self, finished: Callable[[str], None] | None = None) -> None:
        self.finished = finished
        self.laps_s: dict[str, float] = {}
        self.last = time.perf_counter()

    def lap(self, name: str) -> None:
        """The stage ``name`` is done."""
        now = time.perf_counter()
        self.laps_s[name] = now - self.last
        self.last = now
        if self.finished is not None:
            self.finished(name)


@one_blas_thread()
def register(
    source: ArrayLike,
    target: ArrayLike,
    options: RegisterOptions | None = None,
    finished: Callable[[str], None] | None = None,
) -> Registration:
    """Find the pose that brings a scan (N, 3) onto another one (M, 3), both in mm, wherever they were taken from.

    Nothing needs to be known of the pose. Two scans that leave it open (symmetric parts, bare planes) are refused, and
    the motion that is free is named.

    Args:
        source: points (N, 3) of the scan that is moved.
        target: points (M, 3) of the scan that it is brought onto.
        options: seed and viewpoints.
        finished: is told the name of each stage (``STAGES``) when it is done.

    Returns:
        The pose ``T_target_source`` (4, 4) with its covariance, confidence and overlap, and both scans as they were
        compared.

    Raises:
        InputError: NaN points, numbers that are no points, or scans of which only a mirror image fits. UnitError: one
            scan is many times larger than the other.
        DegenerateError: too few points; the scans do not fit or do not overlap enough. AmbiguousError: a motion is
            free.

    Example:
        >>> import numpy as np
        >>> from grindvision import register
        >>> from grindvision.geometry import move_points
        >>> x, y = np.meshgrid(np.arange(-60.0, 60.0), np.arange(-40.0, 40.0))
        >>> bumps = [(25, -10, 6.0), (-30, 15, 4.0)]
        >>> z = 0.004 * x**2 + sum(h * np.exp(-((x - a) ** 2 + (y - b) ** 2) / 100) for a, b, h in bumps)
        >>> target = np.column_stack([x.ravel(), y.ravel(), 400 - z.ravel()])
        >>> source = target - [3.0, -2.0, 5.0]
        >>> found = register(source, target)
        >>> moved = move_points(found.T_target_source, source)
        >>> bool(np.abs(moved - target).max() < 0.05)
        True
    """
    options = RegisterOptions() if options is None else options
    clock = StageClock(finished)
    viewpoints_mm = options.viewpoint_source_mm, options.viewpoint_target_mm
    rng = np.random.default_rng(options.seed)
    return register_pair(source, target, viewpoints_mm, rng, clock, PairNames("source", "target"))


def register_pair(
    source: ArrayLike,
    target: ArrayLike,
    viewpoints_mm: Viewpoints,
    rng: np.random.Generator,
    clock: StageClock,
    names: PairNames,
) -> Registration:
    """``register`` with its draws from ``rng`` and ``names`` for the two scans in its messages."""
    source = check_points(source, f"{names.source} points", MIN_POINTS)
    target = check_points(target, f"{names.target} points", MIN_POINTS)
    source, target = (without_strays(*one) for one in ((source, names.source), (target, names.target)))
    check_same_unit(source, target, names)
    try:
        prepared_source, prepared_target, coarse = _first_alignment(source, target, viewpoints_mm, rng, clock)
        clock.lap("verification")
        fine = refine(prepared_source, prepared_target, coarse, rng.spawn(1)[0])
        verified = coarse.registration.T_target_source
        fine, held = hold_by_rims(prepared_source, prepared_target, fine, verified)
        fine = fine if fine.by_rims else hold_where_verified(prepared_source, prepared_target, fine, verified)
        warn_of_findings(prepared_source, coarse, fine, names, held)
        fine = allow_for_layers(fine, {names.source: prepared_source, names.target: prepared_target})
    except DegenerateError as refusal:
        coarse_source, coarse_target = (
            build_surfels(points, choose_resolution(points).voxel_mm) for points in (source, target)
        )
        if table := diagnose_table(coarse_source, coarse_target, names, int(rng.integers(2**32))):
            raise type(refusal)(f"{refusal}; and {table}") from None
        mirrored = _mirrored_fit(source, target, viewpoints_mm, rng)
        if isinstance(refusal, AmbiguousError):
            if mirrored is not None and mirrored.confidence >= ALONE:
                raise AmbiguousError(
                    f"{refusal}; the mirror image of the {names.source} scan fits in one pose alone"
                    f" ({mirrored.agreement}): if one of the two was {LEFT_HANDED}, say --mirrored"
                ) from None
        elif mirrored is not None and mirrored.confidence >= CERTAIN:
            raise InputError(
                f"no pose was found in which the {names.source} scan fits the {names.target} as it is, but one in which"
                f" its mirror image does ({mirrored.agreement}): if one of the two was {LEFT_HANDED}, export it again,"
                " or say --mirrored; if none was, the part is nearly symmetric and they show its two sides: scan from"
                " nearer views"
            ) from None
        raise
    clock.lap("icp")
    return Registration(prepared_source, prepared_target, coarse, fine, clock.laps_s)


def without_strays(points: Floats, name: str) -> Floats:
    """Points (N, 3) of a scan less those that lie alone (``stray_points``).

    Warns:
        GrindvisionWarning: how many were left out, and where the farthest lies.
    """
    stray = stray_points(points)
    if not stray.any():
        return points
    kept = points[~stray]
    middle = kept.mean(axis=0)
    away = np.linalg.norm(points[stray] - middle, axis=1)
    x, y, z = points[stray][np.argmax(away)]
    warnings.warn(
        f"{name}: {counted(int(stray.sum()), 'point lies', 'points lie')} alone, the farthest at"
        f" ({x:.4g}, {y:.4g}, {z:.4g}) mm, {away.max():.4g} mm from the middle of the rest, and were left out",
        GrindvisionWarning,
        stacklevel=2,
    )
    return kept


def propose(source: Scan, target: Scan, rng: np.random.Generator) -> tuple[Scan, Floats]:
    """Likely poses T_target_source (K, 4, 4); where no viewpoint tells the source's outside, the side that fits better.

    Returns the source, reversed if that fits better, and the poses.
    """
    poses, votes = propose_poses(source.keypoints, target.keypoints, rng)
    if not all(scan.sided or scan.viewpoint_mm is not None for scan in (source, target)):
        other = reversed_scan(source)
        try:
            other_poses, other_votes = propose_poses(other.keypoints, target.keypoints, rng)
        except DegenerateError:
            return source, poses
        if other_votes[0] > votes[0]:
            return other, other_poses
    return source, poses


def refine(
    source: Scan, target: Scan, coarse: VerifiedPose, rng: np.random.Generator, n_surfels: int = 6_000
) -> FineRegistration:
    """Point-to-plane ICP on fine surfels from the verified pose, then with a smooth bending allowed, until it rests."""
    return refine_from(source, target, coarse.registration.T_target_source, rng, n_surfels)


def refine_from(
    source: Scan, target: Scan, T_target_source: Floats, rng: np.random.Generator, n_surfels: int = 6_000
) -> FineRegistration:
    """``refine`` from a pose (4, 4) that is known well.

    Where most of the surface is flat and sharply measured, the last ICP's own spread is so small that steps and walls
    which the first pose misses by a little count for nothing, and it slides along the flat. Where it ends far from that
    pose it is repeated with a spread that holds them, and the end at which more of the scans meets is kept.
    """
    chosen = np.sort(random_order(source.surfels.grid.keys, rng)[:n_surfels])  # neighbours in a row share the cache
    places, normals = source.surfels.points[chosen], source.surfels.normals[chosen]

    def refined(floor: float) -> FineRegistration:
        reach = 2 * target.surfels.grid.size_mm
        found = icp_planes(places, normals, target.surfels, T_target_source, reach, floor, iterations=100)
        return refine_bent(places, normals, target.surfels, found, min_spread_mm=max(floor, 1e-9))

    found = refined(0.0)
    away = move_points(found.T_target_source, places) - move_points(T_target_source, places)
    if np.linalg.norm(away, axis=1).max() < SLID * rms_extent(places):
        return found
    again = refined(same_within(source.surfels, target.surfels) / 3)
    return again if again.overlap > found.overlap else found


def _first_alignment(
    source: Floats,
    target: Floats,
    viewpoints_mm: Viewpoints,
    rng: np.random.Generator,
    clock: StageClock,
    insist: bool = True,
) -> tuple[Scan, Scan, VerifiedPose]:
    """Both scans made ready, and the verified pose between them; ``insist``: see ``choose_pose``."""
    prepared_source, prepared_target = prepare_pair(source, target, viewpoints_mm)
    clock.lap("features")
    proposing, choosing = rng.spawn(2)  # how much one stage draws changes nothing in the next
    prepared_source, poses = propose(prepared_source, prepared_target, proposing)
    clock.lap("coarse")
    pose = choose_pose(prepared_source, prepared_target, poses, choosing, insist=insist)
    return prepared_source, prepared_target, pose


def _mirrored_fit(
    source: Floats, target: Floats, viewpoints_mm: Viewpoints, rng: np.random.Generator
) -> VerifiedPose | None:
    """The pose in which the mirror image of the source (N, 3) fits the target (M, 3); None where it fits in none."""
    mirror = np.array([1.0, -1.0, 1.0])
    seen_from = None if viewpoints_mm[0] is None else np.asarray(viewpoints_mm[0], dtype=float) * mirror
    try:
        views = seen_from, viewpoints_mm[1]
        *_, pose = _first_alignment(source * mirror, target, views, rng, StageClock(), insist=False)
    except DegenerateError:
        return None
    return pose
