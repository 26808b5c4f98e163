"""Which of several poses is the right one, how sure that is, and which motion is free when it cannot be known.

Every proposed pose is refined until it rests and judged by what both scanners could see, which must agree
(``pose_candidates``, ``evidence``). Then ``rivals`` are sought on purpose. What the scans say for the best pose against
a rival is a likelihood ratio over all surfels; a rival that is not clearly worse leaves the pose open: refused.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from grindvision.errors import AmbiguousError, DegenerateError
from grindvision.parallel import one_blas_thread
from grindvision.vision.registration.agreement import Agreement
from grindvision.vision.registration.evidence import HARD, LOST
from grindvision.vision.registration.face_poses import face_poses
from grindvision.vision.registration.free_motions import motion_name
from grindvision.vision.registration.free_surface import UNRESISTED, free_all_over, free_motion
from grindvision.vision.registration.icp import FineRegistration
from grindvision.vision.registration.mirror_image import MirrorImage, mirrored_fit
from grindvision.vision.registration.plates import lies_beside, plate_poses
from grindvision.vision.registration.pose_candidates import SURE_AGREEMENT, Candidate, PoseJudge, unlike_poses
from grindvision.vision.registration.rivals import OVERLAPS, is_contradicted, weak_motions, with_rivals
from grindvision.vision.registration.wider_features import wider_poses
from grindvision.vision.surface.scan import Scan

Floats = NDArray[np.float64]

MIN_AGREEMENT = 0.7
"""Least share of what both scanners could see that must agree; below, the scans show different surfaces."""

MIN_OVERLAP = 0.2
"""Least share of the smaller scan that both scanners must have seen."""

MIN_SCORE = 0.15
"""Least agreeing share of the scan less the contradicting one: of a small overlap more must agree."""

MIN_CONFIDENCE = 0.5
"""A pose less sure than this is refused."""

TRUE_AGREEMENT = 0.88
"""Share of agreement at true poses: a pose that is open and agrees less is no fit but a chance one."""

TWO_BODIES = (
    " Or has the part moved against something that both scans show? Then cut both to the part (--sample-box,"
    " --test-box)"
)
"""What else may keep scans apart that agree nearly everywhere."""

USUAL_HARD = 0.01
"""Fraction of surfels in front of what the other scanner saw that new material may explain; above, the confidence
falls."""

ALIKE = 12.0
"""So many neighbouring surfels err alike and count as one."""

CHANCE = 1.5
"""Logarithm of the odds that the best of several equal poses has by chance."""

COINCIDING_RAD, COUNTED = np.radians(10), 0.1
"""Of two poses the one at which the lines of sight are nearer by more than the angle has the smaller misfit anyhow:
what a scanner sees wrongly at edges and slants, it sees wrongly in the same way there. So much of the gain counts."""

UNDECIDED = 9.0
"""Logarithm of the odds up to which more is asked than surfels: all points of a scan, where the other is a model."""

MOST_ADDED, MIN_AFTER_REFUSAL = 6, 0.9
"""So many more candidates are brought to rest before a refusal, and only a pose as sure as that comes in its place."""

GAPS = 0.005
"""Of surfels that agree, so many may lie in holes of the other scan: under a bead the other part may have a hole. Where
more do, the holes are gaps of a scan, which tell no pose from another."""

NEAR = 6.0
"""Poses apart by less than so many of the least differences (``PoseJudge.differ``) are neighbours."""


@dataclass(frozen=True)
class VerifiedPose:
    """The pose that was chosen: its refinement, its ``agreement``, the best rival's, and in words the motion to that
    rival; ``confidence`` 0..1 that no rival is right; ``mirror``: a mirror image of the source that fits as well;
    ``in_gaps``: share of the agreeing surfels' number that lies in holes of the other scan, where these did not count
    for the pose, else 0."""

    registration: FineRegistration
    agreement: Agreement
    rival: Agreement
    confidence: float
    rival_motion: str = ""
    mirror: MirrorImage | None = None
    in_gaps: float = 0.0

    def __str__(self) -> str:
        return f"{self.agreement}; confidence {self.confidence:.2f}"


@one_blas_thread()
def choose_pose(
    source: Scan,
    target: Scan,
    poses: Floats,
    rng: np.random.Generator,
    tried: int = 10,
    sample: int = 4000,
    insist: bool = True,
) -> VerifiedPose:
    """Refine the first ``tried`` of ``poses`` (K, 4, 4), take the best, and make sure that no rival is as good.

    Args:
        source: the scan to be moved.
        target: the scan it is to meet.
        poses: T_target_source, likeliest first.
        sample: most surfels of each scan that are judged.
        insist: before a refusal, all ``poses`` and those of flat faces are tried; only a sure one counts.

    Raises:
        DegenerateError: no pose brings the scans together; the surfaces contradict each other. AmbiguousError: a rival
            fits as well (the message names the motion that is free).
    """
    judge = PoseJudge(source, target, rng, sample)
    searched = []
    refusal: DegenerateError | None = None
    for one in [judge, judge.without_holes()] if judge.shows_holes else [judge]:
        candidates = _first_candidates(one, source, target, poses, tried, rng)
        if one is judge and candidates:
            _check_features(judge, source, target, candidates[0])
        searched.append((one, candidates))
        try:
            found = _chosen(one, candidates)
        except DegenerateError as error:
            refusal = refusal or error
            continue
        if one is not judge:
            return replace(found, in_gaps=_in_holes(judge, found))
        if not judge.shows_holes or _in_holes(judge, found) <= GAPS:
            return found
    for one, candidates in searched if insist else ():
        later = _insisted(one, candidates, poses[tried:])
        if later is None:
            continue
        if one is not judge:
            return replace(later, in_gaps=_in_holes(judge, later))
        if _in_holes(judge, later) <= GAPS:
            return later
    raise refusal or DegenerateError("no pose was found that both scans bear out")


def _check_features(judge: PoseJudge, source: Scan, target: Scan, best: Candidate) -> None:
    """Refuse scans that fit, but by surfaces of which no rival can tell more (``free_all_over``).

    Raises:
        AmbiguousError: the motion that is free is named.
    """
    free = free_all_over(judge, source, target, best)
    if free.size and judge.agreement(best.pose).fraction_of_overlap >= TRUE_AGREEMENT:
        _check_fit(judge, best)
        raise AmbiguousError(free_motion(judge, best, free))


def _in_holes(judge: PoseJudge, found: VerifiedPose) -> float:
    """Fraction of the surfels in the other scan's holes, of those that agree."""
    seen = judge.evidence(found.registration.T_target_source, None)
    return seen.in_holes / max(seen.met, 1e-9)


def _insisted(judge: PoseJudge, candidates: list[Candidate], poses: Floats) -> VerifiedPose | None:
    """The best of the candidates and of all other ``poses`` (K, 4, 4) and those of flat faces, where it is sure."""
    others = [*judge.refined_all(face_poses(judge), far=True), *judge.refined_all(poses)]
    added = judge.distinct([*candidates, *judge.settled(others, MOST_ADDED)])
    if all(any(one is old for old in candidates) for one in added):
        return None
    try:
        found = _chosen(judge, added)
    except DegenerateError:
        return None
    return found if found.confidence >= MIN_AFTER_REFUSAL else None


def _first_candidates(
    judge: PoseJudge, source: Scan, target: Scan, poses: Floats, tried: int, rng: np.random.Generator
) -> list[Candidate]:
    """Candidates at rest, best first; the longer nothing fits, the more kinds of poses are tried."""
    first = judge.refined_all(poses[:tried])
    candidates = judge.settled([*first, *judge.refined_all(unlike_poses(judge, poses[tried:], first))])
    if candidates:
        candidates = judge.distinct([*candidates, *_from_farther(judge, candidates[0])])
    if not candidates or judge.is_uncertain(candidates[0]):
        candidates = judge.distinct([*candidates, *judge.settled(judge.refined_all(poses[tried:]))])
    if not candidates or judge.is_uncertain(candidates[0]):
        wider = wider_poses(source, target, rng.spawn(1)[0])[:tried]
        candidates = judge.distinct([*candidates, *judge.settled(judge.refined_all(wider))])
    if not candidates or judge.is_uncertain(candidates[0]):
        candidates = judge.distinct([*candidates, *judge.settled(judge.refined_all(face_poses(judge), far=True))])
    if candidates:
        candidates = judge.distinct([*candidates, *plate_poses(judge, candidates[0])])
    return _overlapping(judge, candidates)


def _chosen(judge: PoseJudge, candidates: list[Candidate]) -> VerifiedPose:
    """The best of the candidates and of their rivals, with its confidence.

    Raises:
        DegenerateError, AmbiguousError: see ``choose_pose``.
    """
    if not candidates:
        raise DegenerateError("no pose brings the two scans together; do they show the same part, with overlap?")
    for attempt in range(3):
        best = candidates[0]
        candidates = judge.ranked(_overlapping(judge, with_rivals(judge, best, candidates)))
        # rivals that were found tell the axes of symmetry, about which the right pose may lie
        if not judge.differ(best.pose, candidates[0].pose) and (attempt or not is_contradicted(judge, best)):
            break
    best, *candidates = candidates
    _check_fit(judge, best)
    if said := lies_beside(judge, best):
        raise AmbiguousError(f"the registration is ambiguous: {said}")
    found = _verdict(judge, best, [other for other in candidates if judge.differ(other.pose, best.pose)])
    return replace(found, mirror=mirrored_fit(judge, best))


def _from_farther(judge: PoseJudge, best: Candidate) -> list[Candidate]:
    """Where the best pose comes to rest when farther surface may pull, if that is elsewhere: in finely sampled channels
    and on steps ICP rests between two walls."""
    found = judge.settled(judge.refined_all([best.pose], far=True))
    return [one for one in found if judge.differ(one.pose, best.pose)]


def _overlapping(judge: PoseJudge, candidates: list[Candidate]) -> list[Candidate]:
    """The candidates that overlap enough, all where none does: of scans turned away from each other nothing can be
    seen, and nothing speaks against them."""
    enough = [one for one in candidates if judge.agreement(one.pose).overlap >= MIN_OVERLAP]
    return enough or candidates


def _check_fit(judge: PoseJudge, best: Candidate) -> None:
    """Refuse a best pose at which the surfaces contradict each other, or do not meet.

    Raises:
        DegenerateError: less overlap or agreement than needed.
    """
    found = judge.agreement(best.pose)
    least = min(max(MIN_AGREEMENT, 0.5 + MIN_SCORE / (2 * max(found.overlap, 1e-9))), 1.0)
    if found.overlap < MIN_OVERLAP or found.fraction_of_overlap < least:
        raise DegenerateError(
            f"the two scans do not fit: at the best pose {found.overlap:.0%} overlap and"
            f" {found.fraction_of_overlap:.0%} of that agrees within {judge.within_mm:.2g} mm"
            f" (at least {MIN_OVERLAP:.0%} and {least:.0%} needed); are they scans of the same part, from nearby views?"
        )


def _verdict(judge: PoseJudge, best: Candidate, rivals: list[Candidate]) -> VerifiedPose:
    """The best pose with its confidence, from all samples.

    Raises:
        AmbiguousError: a rival is not clearly worse. DegenerateError: the fit may be chance.
    """
    ratios = _log_ratios(judge, best, rivals)
    for _ in range(2):
        if (
            not ratios
            or min(ratios) > 0
            or (judge.differ(rivals[int(np.argmin(ratios))].pose, best.pose, NEAR) and not judge.whole)
        ):
            break
        better = int(np.argmin(ratios))  # a neighbour whose residuals are smaller, or that small holes tell
        best, rivals = rivals[better], [best, *rivals[:better], *rivals[better + 1 :]]
        ratios = _log_ratios(judge, best, rivals)
    found = judge.agreement(best.pose)
    fits = np.clip((found.fraction_of_overlap - 0.5) / (SURE_AGREEMENT - 0.5), 0, 1)
    fits *= min(1.0, USUAL_HARD / max(judge.evidence(best.pose, None).hard, 1e-9))
    posterior = 1 / (1 + np.exp(np.clip(CHANCE - np.array(ratios), -50, 50)).sum()) if ratios else 1.0
    confidence = float(posterior * fits)
    unresisted = weak_motions(judge, best, UNRESISTED)
    unlike_chance = found.fraction_of_overlap >= TRUE_AGREEMENT
    if fits < MIN_CONFIDENCE or ((unresisted.size > 0 or confidence < MIN_CONFIDENCE) and not unlike_chance):
        raise DegenerateError(
            f"the two scans do not fit: of what both scanners could see, {found.overlap:.0%},"
            f" {found.fraction_of_overlap:.0%} agrees: this may be chance;"
            " are they scans of the same part, from nearby views?" + (TWO_BODIES if unlike_chance else "")
        )
    if unresisted.size and not (judge.whole and _is_refuted_along(rivals, ratios)):
        raise AmbiguousError(free_motion(judge, best, unresisted))
    if not rivals:
        return VerifiedPose(best.found, found, Agreement(0.0, 0.0), confidence)
    rival = rivals[int(np.argmin(ratios))]
    if confidence < MIN_CONFIDENCE:
        raise AmbiguousError(_ambiguity(judge, best, rival, min(ratios)))
    motion = motion_name(rival.pose, best.pose, judge.centre, judge.extent)
    return VerifiedPose(best.found, found, judge.agreement(rival.pose), confidence, motion)


def _log_ratios(judge: PoseJudge, best: Candidate, rivals: Sequence[Candidate]) -> list[float]:
    """Logarithms of the odds for the best pose against its rivals.

    What lies beside a scan's outline decides nothing; beside a whole model's there is no part, and in its holes, of
    which small ones are asked where the rest does not decide. Between poses near each other the residuals where the
    surfaces meet in both tell more than the rest; between others, the misfit tells less for the one at which the two
    scanners look along nearly the same line.
    """
    one, sharp = judge.evidence(best.pose, None), judge.residuals(best.pose)
    sizes = np.abs(sharp[np.isfinite(sharp)])
    spread = max(1.4826 * float(np.median(sizes)), 0.01 * judge.within_mm) if len(sizes) else 1.0
    ratios = []
    for rival in rivals:
        other = judge.evidence(rival.pose, None)
        # what lies beside an outline decides nothing, unless nearly all of it does, or the other is a whole model
        absent = 0.0 if other.met > OVERLAPS * one.met and not judge.whole else LOST
        ratio = judge.surfels * (other.cost(absent) - one.cost(absent))
        if not judge.differ(rival.pose, best.pose, NEAR):
            both = np.stack([sharp, judge.residuals(rival.pose)])
            both = both[:, np.isfinite(both).all(axis=0)]
            costs = np.minimum((both / spread) ** 2, 9).sum(axis=1)
            ratio += 0.5 * (costs[1] - costs[0]) * judge.surfels / (2 * len(judge.source.points)) / ALIKE
        elif judge.angle_of_sight(best.pose) < judge.angle_of_sight(rival.pose) - COINCIDING_RAD:
            misfit = judge.surfels * (other.misfit_cost() - one.misfit_cost())
            ratio -= (1 - COUNTED) * max(misfit, 0.0)
        if judge.whole and ratio < UNDECIDED:
            ratio += HARD * judge.off_model_at(rival.pose, best.pose)
        ratios.append(float(ratio))
    return ratios


def _is_refuted_along(rivals: Sequence[Candidate], ratios: Sequence[float]) -> bool:
    """Whether the poses all along a motion that the surface does not resist are clearly worse, as the ends of a bar on
    its model make them; how well these hold it, the fine registration says. Between two scans an end may be where the
    picture ends, and a part that hardly resists is too small in it."""
    along = [ratio for rival, ratio in zip(rivals, ratios, strict=True) if rival.free]
    return bool(along) and min(along) > UNDECIDED


def _ambiguity(judge: PoseJudge, best: Candidate, rival: Candidate, ratio: float) -> str:
    """In words, which motion is open."""
    if rival.free:
        return free_motion(judge, best, weak_motions(judge, best))
    motion = motion_name(rival.pose, best.pose, judge.centre, judge.extent)
    odds = f" as well (odds {np.exp(min(ratio, 9)):.2g} to 1)" if ratio > 0 else ", too, by other signs even better"
    return (
        f"the registration is ambiguous: {motion} fits{odds};"
        " a symmetric part needs a mark or a scan that shows what breaks the symmetry"
    )
