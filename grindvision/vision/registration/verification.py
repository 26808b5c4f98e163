"""Which of several poses is the right one, how sure that is, and which motion is free when it cannot be known.

Every proposed pose is refined by point-to-plane ICP and judged by what it says about each surfel of the source: it
agrees with the target's surface, contradicts it, or lies where the target shows nothing. Then rivals are sought on
purpose: the other proposals, the rotational symmetries of a box and of wheels about the scan's own axes, and steps
along the motions the surface resists least. A rival that fits as well as the best means that the scans leave the pose
open: refused.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import permutations, product

import numpy as np
from numpy.typing import NDArray

from grindvision.errors import AmbiguousError, DegenerateError
from grindvision.geometry import angle_between, move_points, rigid, rotation_about, small_motion
from grindvision.geometry.hash_grid import random_order
from grindvision.parallel import one_blas_thread, parallel_map
from grindvision.vision.registration.agreement import Agreement, agreeing_share, agreement
from grindvision.vision.registration.free_motions import motion_name, motion_names
from grindvision.vision.registration.global_registration import distinct_poses
from grindvision.vision.registration.icp import FineRegistration
from grindvision.vision.registration.plane_icp import icp_planes, plane_residuals
from grindvision.vision.surface.scan import Scan
from grindvision.vision.surface.surfels import Surfels

Floats = NDArray[np.float64]

LEAST_MARGIN = 0.03
"""A rival must agree with the target on at least this share of the source less than the best pose does."""

SURE_MARGIN = 0.15
"""Margin at which the confidence reaches 1."""

LEAST_AGREEMENT = 0.55
"""Least share of the overlapping surface that must agree; below, the scans show different surfaces."""

LEAST_OVERLAP = 0.2
"""Least share of the source that must lie over the target's surface; of a larger source, the share it could cover."""


CHANCE_OVERLAP, LEAST_CONFIDENCE = 0.4, 0.5
"""Any two surfaces meet somewhere over some of their extent: below this overlap a pose needs this confidence."""

MOST_WORSE = 1.25
"""A pose whose truncated squared residuals are less than so many times the best's fits as well."""

LEAST_SCORE = 0.2
"""Least agreeing share of the source less the contradicting one: of a small overlap more must agree."""

BOX_ROTATIONS = tuple(
    rotation
    for axes in permutations(range(3))
    for signs in product((1.0, -1.0), repeat=3)
    if np.linalg.det(rotation := np.eye(3)[list(axes)] * signs) > 0 and np.trace(rotation) < 3
)
"""The 23 rotations (3, 3) that bring a box back to its axes, but for none at all."""

WHEEL_ROTATIONS = tuple(
    rotation_about(axis, sign * 2 * np.pi / folds) for axis in np.eye(3) for folds in (3, 5, 7) for sign in (1, -1)
)
"""Rotations (3, 3) about the axes that bring wheels with 3, 5, 7 or so many times more spokes back to themselves; those
of 2 and 4 are among the box's."""


@dataclass(frozen=True)
class VerifiedPose:
    """The pose that was chosen: its refinement, its ``agreement``, and ``confidence`` 0..1 from the best rival's."""

    registration: FineRegistration
    agreement: Agreement
    rival: Agreement
    confidence: float

    def __str__(self) -> str:
        return f"{self.agreement}; confidence {self.confidence:.2f}"


@one_blas_thread()
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
        DegenerateError: no pose brings the scans together; the surfaces contradict each other. AmbiguousError: a rival
            fits as well (the message names the motion that is free).
    """
    chosen = random_order(source.surfels.grid.keys, rng)[:sample]
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
    least_overlap = LEAST_OVERLAP * covered
    least_share = max(LEAST_AGREEMENT, min(0.5 + LEAST_SCORE * covered / (2 * max(verdict.overlap, 1e-9)), 1.0))
    if verdict.overlap < least_overlap or verdict.share < least_share:
        raise DegenerateError(
            f"the two scans do not fit: at the best pose {verdict.overlap:.0%} overlap and {verdict.share:.0%} of that"
            f" agrees within {judge.within_mm:.2g} mm (at least {least_overlap:.0%} and {least_share:.0%} needed);"
            " are they scans of the same part, from nearby views?"
        )
    judge.refuse_free_motions(best, verdict)
    candidates += judge.rotated(best, verdict, BOX_ROTATIONS, 0.6) + judge.rotated(best, verdict, WHEEL_ROTATIONS, 0.9)
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
        motion = motion_name(other.T_target_source, best.T_target_source, judge.centre, judge.extent)
        raise AmbiguousError(
            f"the registration is ambiguous: {motion} fits as well ({rival.score:.2f} against {verdict.score:.2f}); a"
            " symmetric part needs a mark or a scan that shows what breaks the symmetry"
        )
    confidence = float(np.clip(margin / (SURE_MARGIN * covered), 0, 1)) * verdict.share
    if verdict.overlap < CHANCE_OVERLAP * covered and confidence < LEAST_CONFIDENCE:
        raise DegenerateError(
            f"the two scans do not fit: they meet over {verdict.overlap:.0%} only, and a rival hardly worse says that"
            " this may be chance; are they scans of the same part, from nearby views?"
        )
    return VerifiedPose(best, verdict, rival, confidence)


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
        refined = parallel_map(lambda pose: self.refined(pose, least_agreeing), poses)
        return [found for found in refined if found]

    def differ(self, pose: Floats, other: Floats) -> bool:
        """Whether two poses are apart by more than 2 % of the extent or 3 degrees."""
        translation = np.linalg.norm(move_points(pose, self.centre) - move_points(other, self.centre))
        return bool(translation > 0.04 * self.extent or angle_between(pose, other) > np.radians(3))

    def fits_as_well(self, other: FineRegistration, best: FineRegistration) -> bool:
        """Whether another pose leaves residuals hardly larger than the best one's, on the points that both can judge.

        Sharper than the agreement: the scale of the truncated squares is that of the best pose's own residuals.
        """
        most = 3 * self.target.grid.size_mm
        best_residual, residual = (
            plane_residuals(self.points, self.normals, self.target, pose.T_target_source, most)[0]
            for pose in (best, other)
        )
        both = ~np.isnan(best_residual) & ~np.isnan(residual)
        if both.sum() < 30:
            return False
        cut = 4 * 1.4826 * max(float(np.median(np.abs(best_residual[both]))), 1e-9)
        costs = [np.minimum((one[both] / cut) ** 2, 1).mean() for one in (best_residual, residual)]
        return bool(costs[1] < MOST_WORSE * costs[0])

    def rotated(
        self, best: FineRegistration, verdict: Agreement, rotations: Sequence[Floats], least: float
    ) -> list[tuple[FineRegistration, Agreement]]:
        """The best few ``rotations`` about the source's principal axes, refined; ``least`` is a share of what
        agrees."""
        _, axes = np.linalg.eigh(np.cov(self.points.T))
        axes[:, 2] *= np.sign(np.linalg.det(axes))
        poses = np.stack(
            [
                best.T_target_source
                @ rigid(None, self.centre)
                @ rigid(axes @ rotation @ axes.T)
                @ rigid(None, -self.centre)
                for rotation in rotations
            ]
        )
        rough = np.array(
            [
                agreeing_share(self.points[:300], self.normals[:300], self.coarse_target, pose, 6 * self.within_mm)
                for pose in poses
            ]
        )
        order = np.argsort(-rough, kind="stable")
        order = order[rough[order] > 0.4 * rough.max(initial=0)]
        poses, _ = distinct_poses(poses[order], rough[order], self.centre, np.inf, np.radians(20), 4)
        return self.refined_all(poses, least * verdict.agreeing)

    def refuse_free_motions(self, best: FineRegistration, verdict: Agreement) -> None:
        """Step along the three motions the surface resists least; refuse when the scans fit there as well."""
        scale = np.array([1, 1, 1, 1 / self.extent, 1 / self.extent, 1 / self.extent])
        _, directions = np.linalg.eigh(best.information * np.outer(scale, scale))
        to_centre, back = rigid(None, -best.centre_mm), rigid(None, best.centre_mm)
        resisted_least = directions[:, :3]
        trials = [small_motion(0.12 * self.extent * twist * scale) for twist in resisted_least.T]
        tried_poses = parallel_map(self.refined, [back @ trial @ to_centre @ best.T_target_source for trial in trials])
        free = [
            one is not None
            and self.differ(one[0].T_target_source, best.T_target_source)
            and one[1].share > verdict.share - LEAST_MARGIN
            and one[1].overlap > 0.7 * verdict.overlap
            and self.fits_as_well(one[0], best)
            for one in tried_poses
        ]
        if any(free):
            names = motion_names(resisted_least[:, free] * scale[:, None] * self.extent, self.extent, best.centre_mm)
            raise AmbiguousError(
                f"the registration is ambiguous, free motion: {'; '.join(names)};"
                " the part shows nothing that fixes it there, scan more of the part or a part with features"
            )


def _tolerance(source: Surfels, target: Surfels) -> float:
    """Distance in mm within which two surfaces count as the same: their roughness, and a little of the cell size."""
    rough = np.hypot(np.median(source.roughness_mm), np.median(target.roughness_mm))
    return float(3 * rough + 0.1 * target.grid.size_mm)
