"""Which of several poses is the right one, how sure that is, and which motion is free when it cannot be known.

Every proposed pose is refined by point-to-plane ICP and judged by what it says about each surfel of the source: it
agrees with the target's surface, contradicts it, or lies where the target shows nothing. Then rivals are sought on
purpose: the other proposals, the turns of a box about the scan's own axes, and slides along the motions the surface
resists least. A rival that fits as well as the best means that the scans do not determine the pose: refused.
"""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import permutations, product

import numpy as np
from numpy.typing import NDArray

from grindvision.errors import DegenerateError
from grindvision.geometry import angle_between, inverse, move_points, rigid, rotation_axis, small_motion, turn_vectors
from grindvision.geometry.neighbours import nearest
from grindvision.vision.icp import FineRegistration
from grindvision.vision.plane_icp import icp_planes
from grindvision.vision.proposals import distinct_poses
from grindvision.vision.scan import Scan
from grindvision.vision.surfels import Surfels

Floats = NDArray[np.float64]

LEAST_MARGIN = 0.03
"""A rival must agree with the target on at least this share of the source less than the best pose does."""

SURE_MARGIN = 0.15
"""Margin at which the confidence reaches 1."""

LEAST_AGREEMENT = 0.55
"""Least share of the overlapping surface that must agree; below, the scans show different surfaces."""

LEAST_OVERLAP = 0.2
"""Least share of the source that must lie over the target's surface; of a larger source, the share it could cover."""


MOST_WORSE = 1.25
"""A pose whose truncated squared residuals are less than so many times the best's fits as well."""

LEAST_SCORE = 0.2
"""Least difference between the agreeing and the contradicting share of the source."""

BOX_TURNS = tuple(
    turn
    for axes in permutations(range(3))
    for signs in product((1.0, -1.0), repeat=3)
    if np.linalg.det(turn := np.eye(3)[list(axes)] * signs) > 0 and np.trace(turn) < 3
)
"""The 23 rotations (3, 3) that bring a box back to its axes, but for none at all."""


@dataclass(frozen=True)
class Agreement:
    """What a pose says about the source's surfels, as shares of all: ``agreeing``, ``contradicting``; the rest lies
    where the target shows nothing."""

    agreeing: float
    contradicting: float

    @property
    def overlap(self) -> float:
        """Share of the source over the target's surface."""
        return self.agreeing + self.contradicting

    @property
    def share(self) -> float:
        """Agreeing share of the overlap."""
        return self.agreeing / self.overlap if self.overlap > 0 else 0.0

    @property
    def score(self) -> float:
        """Agreeing less contradicting share; the best pose has the largest."""
        return self.agreeing - self.contradicting

    def __str__(self) -> str:
        return f"overlap {self.overlap:.0%}, of it {self.share:.0%} in agreement"


@dataclass(frozen=True)
class VerifiedPose:
    """The pose that was chosen: its refinement, its ``agreement``, and ``confidence`` 0..1 from the best rival's."""

    registration: FineRegistration
    agreement: Agreement
    rival: Agreement
    confidence: float

    def __str__(self) -> str:
        return f"{self.agreement}; confidence {self.confidence:.2f}"


def _residuals(points: Floats, target: Surfels, T_target_source: Floats) -> tuple[Floats, NDArray[np.int64]]:
    """Distances (N,) of moved points along the target's normals, and the surfels met; -1 where none is shown."""
    moved = move_points(T_target_source, points)
    match, distances = nearest(target.grid, moved, 3 * target.grid.size_mm)
    along = ((moved - target.points[match]) * target.normals[match]).sum(axis=1)
    with np.errstate(invalid="ignore"):
        beside = ~(distances**2 - along**2 < (1.5 * target.grid.size_mm) ** 2)
    return along, np.where(beside, -1, match)


def agreement(points: Floats, normals: Floats, target: Surfels, T_target_source: Floats, within_mm: float) -> Agreement:
    """Judge a pose on source points (N, 3) with normals (N, 3): agreement means a distance along the target's normal of
    at most ``within_mm`` and normals less than 45 degrees apart."""
    along, match = _residuals(points, target, T_target_source)
    shown = match >= 0
    facing = (turn_vectors(T_target_source, normals) * target.normals[match]).sum(axis=1) > 0.7
    good = shown & facing & (np.abs(along) <= within_mm)
    return Agreement(float(good.mean()), float((shown & ~good).mean()))


def choose_pose(
    source: Scan, target: Scan, poses: Floats, rng: np.random.Generator, tried: int = 3, sample: int = 1000
) -> VerifiedPose:
    """Refine the first ``tried`` of ``poses`` (K, 4, 4), take the best, and make sure that no rival is as good.

    Args:
        source: the scan to be moved.
        target: the scan it is to meet.
        poses: T_target_source, likeliest first.
        sample: surfels of the source used.

    Raises:
        DegenerateError: no pose brings the scans together; the surfaces contradict each other; or a rival fits as well
            (the message names the motion that is free).
    """
    chosen = rng.permutation(len(source.surfels))[:sample]
    judge = _Judge(
        source.surfels.points[chosen],
        source.surfels.normals[chosen],
        target,
        _tolerance(source.surfels, target.surfels),
    )
    candidates = judge.refined_all(poses[:tried])
    if not candidates:
        raise DegenerateError("no pose brings the two scans together; do they show the same part, with overlap?")
    best, verdict = max(candidates, key=lambda candidate: candidate[1].score)
    covered = min(1.0, len(target.surfels) / len(source.surfels))
    if (
        verdict.score < LEAST_SCORE * covered
        or verdict.overlap < LEAST_OVERLAP * covered
        or verdict.share < LEAST_AGREEMENT
    ):
        raise DegenerateError(
            f"the two scans do not fit: at the best pose {verdict.overlap:.0%} overlap and {verdict.share:.0%} of that"
            f" agrees within {judge.within_mm:.2g} mm (at least {LEAST_OVERLAP:.0%} and {LEAST_AGREEMENT:.0%} needed);"
            " are they scans of the same part, from nearby views?"
        )
    judge.refuse_free_motions(best, verdict)
    candidates += judge.turned(best, verdict)
    first, (best, verdict) = best, max(candidates, key=lambda candidate: candidate[1].score)
    if best is not first:
        judge.refuse_free_motions(best, verdict)
    rival = max(
        (v for other, v in candidates if judge.differ(other.T_target_source, best.T_target_source)),
        key=lambda v: v.score,
        default=Agreement(0.0, 0.0),
    )
    margin = verdict.score - max(rival.score, 0.0)
    other = next((other for other, v in candidates if v is rival), best)
    if margin < LEAST_MARGIN * covered and judge.fits_as_well(other, best):
        raise DegenerateError(
            f"the registration is ambiguous: {judge.motion_name(other.T_target_source, best.T_target_source)} fits as"
            f" well ({rival.score:.2f} against {verdict.score:.2f}); a symmetric part needs a mark or a scan that shows"
            " what breaks the symmetry"
        )
    return VerifiedPose(best, verdict, rival, float(np.clip(margin / (SURE_MARGIN * covered), 0, 1)) * verdict.share)


class _Judge:
    """Refines and judges poses of one sample of source surfels on one target."""

    def __init__(self, points: Floats, normals: Floats, target: Scan, within_mm: float) -> None:
        self.points, self.normals, self.within_mm = points, normals, within_mm
        self.target, self.coarse_target = target.surfels, target.voxels
        self.centre = points.mean(axis=0)
        self.extent = float(np.sqrt(((points - self.centre) ** 2).sum(axis=1).mean()))

    def refined(self, pose: Floats, least_agreeing: float = 0.0) -> tuple[FineRegistration, Agreement] | None:
        """Coarse-to-fine ICP from ``pose`` and its agreement.

        None when the scans do not meet there, or when after the coarse stage less than ``least_agreeing`` of the source
        is anywhere near the target.
        """
        voxel, size = self.coarse_target.grid.size_mm, self.target.grid.size_mm
        few, few_normals = self.points[:400], self.normals[:400]
        try:
            found = icp_planes(few, few_normals, self.coarse_target, pose, 1.5 * voxel, self.within_mm, iterations=10)
            near = agreement(few, few_normals, self.coarse_target, found.T_target_source, 3 * self.within_mm)
            if near.agreeing < least_agreeing:
                return None
            found = icp_planes(
                self.points,
                self.normals,
                self.target,
                found.T_target_source,
                1.5 * size,
                self.within_mm / 3,
                iterations=8,
            )
        except DegenerateError:
            return None
        return found, agreement(self.points, self.normals, self.target, found.T_target_source, self.within_mm)

    def refined_all(
        self, poses: Iterable[Floats], least_agreeing: float = 0.0
    ) -> list[tuple[FineRegistration, Agreement]]:
        """``refined`` of several poses, in two threads; those where the scans do not meet are left out."""
        with ThreadPoolExecutor(2) as pool:
            refined = pool.map(lambda pose: self.refined(pose, least_agreeing), poses)
            return [found for found in refined if found]

    def differ(self, pose: Floats, other: Floats) -> bool:
        """Whether two poses are apart by more than 2 % of the extent or 3 degrees."""
        shift = np.linalg.norm(move_points(pose, self.centre) - move_points(other, self.centre))
        return bool(shift > 0.04 * self.extent or angle_between(pose, other) > np.radians(3))

    def fits_as_well(self, other: FineRegistration, best: FineRegistration) -> bool:
        """Whether another pose leaves residuals hardly larger than the best one's, on the points that both can judge.

        Sharper than the agreement: the scale of the truncated squares is that of the best pose's own residuals.
        """
        (best_residual, best_match), (residual, match) = (
            _residuals(self.points, self.target, pose.T_target_source) for pose in (best, other)
        )
        both = (best_match >= 0) & (match >= 0)
        if both.sum() < 30:
            return False
        cut = 4 * 1.4826 * max(float(np.median(np.abs(best_residual[both]))), 1e-9)
        costs = [np.minimum((one[both] / cut) ** 2, 1).mean() for one in (best_residual, residual)]
        return bool(costs[1] < MOST_WORSE * costs[0])

    def turned(self, best: FineRegistration, verdict: Agreement) -> list[tuple[FineRegistration, Agreement]]:
        """The best few of the 23 turns of a box about the source's principal axes, refined."""
        _, axes = np.linalg.eigh(np.cov(self.points.T))
        axes[:, 2] *= np.sign(np.linalg.det(axes))
        poses = np.stack(
            [
                best.T_target_source
                @ rigid(None, self.centre)
                @ rigid(axes @ turn @ axes.T)
                @ rigid(None, -self.centre)
                for turn in BOX_TURNS
            ]
        )
        rough = np.array(
            [
                agreement(self.points[:300], self.normals[:300], self.coarse_target, pose, 6 * self.within_mm).agreeing
                for pose in poses
            ]
        )
        order = np.argsort(-rough, kind="stable")
        order = order[rough[order] > 0.4 * rough.max(initial=0)]
        poses, _ = distinct_poses(poses[order], rough[order], self.centre, np.inf, np.radians(20), 4)
        return self.refined_all(poses, 0.6 * verdict.agreeing)

    def refuse_free_motions(self, best: FineRegistration, verdict: Agreement) -> None:
        """Slide along the three motions the surface resists least; refuse when the scans fit there as well."""
        scale = np.array([1, 1, 1, 1 / self.extent, 1 / self.extent, 1 / self.extent])
        _, directions = np.linalg.eigh(best.information * np.outer(scale, scale))
        to_centre, back = rigid(None, -best.centre_mm), rigid(None, best.centre_mm)
        resisted_least = directions[:, :3]
        slides = [small_motion(0.12 * self.extent * twist * scale) for twist in resisted_least.T]
        with ThreadPoolExecutor(2) as pool:
            slid = list(pool.map(self.refined, [back @ slide @ to_centre @ best.T_target_source for slide in slides]))
        free = [
            one is not None
            and self.differ(one[0].T_target_source, best.T_target_source)
            and one[1].share > verdict.share - LEAST_MARGIN
            and one[1].overlap > 0.7 * verdict.overlap
            and self.fits_as_well(one[0], best)
            for one in slid
        ]
        if any(free):
            names = _motion_names(resisted_least[:, free] * scale[:, None] * self.extent, self.extent, best.centre_mm)
            raise DegenerateError(
                f"the registration is ambiguous, free motion: {'; '.join(names)};"
                " the part shows nothing that fixes it there, scan more of the part or a part with features"
            )

    def motion_name(self, pose: Floats, reference: Floats) -> str:
        """In words, the motion in the target's frame that leads from ``reference`` to ``pose``."""
        motion = pose @ inverse(reference)
        angle = angle_between(motion, np.eye(4))
        centre = move_points(reference, self.centre)
        shift = move_points(motion, centre) - centre
        if angle * self.extent > 0.3 * np.linalg.norm(shift):
            axis = rotation_axis(motion[:3, :3])
            pivot = centre + np.linalg.pinv(np.eye(3) - motion[:3, :3], rcond=1e-6) @ shift
            x, y, z, a, b, c = *axis, *pivot
            return (
                f"a turn (here by {np.degrees(angle):.0f} deg) about the axis ({x:.2f}, {y:.2f}, {z:.2f})"
                f" through ({a:.0f}, {b:.0f}, {c:.0f}) mm"
            )
        x, y, z = shift / np.linalg.norm(shift)
        return f"a shift (here by {np.linalg.norm(shift):.1f} mm) along ({x:.2f}, {y:.2f}, {z:.2f})"


def _motion_names(twists: Floats, extent: float, centre: Floats) -> list[str]:
    """In words, a basis of the motions that columns of ``twists`` (6, k) span: pure shifts first, then turns.

    A twist is a shift in mm and a rotation vector in rad about ``centre`` (3,).
    """
    scaled = twists / np.array([1, 1, 1, 1 / extent, 1 / extent, 1 / extent])[:, None] / extent
    _, turning, mix = np.linalg.svd(scaled[3:])
    turning = np.pad(turning, (0, max(scaled.shape[1] - len(turning), 0)))[: scaled.shape[1]]
    basis = scaled @ mix.T
    shifts = basis[:3, turning < 0.3]
    names = ["a shift along ({:.2f}, {:.2f}, {:.2f})".format(*(shift / np.linalg.norm(shift))) for shift in shifts.T]
    along = np.linalg.qr(shifts)[0] if shifts.size else np.zeros((3, 0))
    for column in basis[:, turning >= 0.3].T:
        rotation = column[3:]
        shift = (column[:3] - along @ (along.T @ column[:3])) * extent
        pivot = centre + np.cross(rotation, shift) / (rotation @ rotation)
        axis = rotation / np.linalg.norm(rotation)
        names.append(
            "a turn about the axis ({:.2f}, {:.2f}, {:.2f}) through ({:.0f}, {:.0f}, {:.0f}) mm".format(*axis, *pivot)
        )
    return names


def _tolerance(source: Surfels, target: Surfels) -> float:
    """Distance in mm within which two surfaces count as the same: their roughness, and a little of the cell size."""
    rough = np.hypot(np.median(source.roughness_mm), np.median(target.roughness_mm))
    return float(3 * rough + 0.1 * target.grid.size_mm)
