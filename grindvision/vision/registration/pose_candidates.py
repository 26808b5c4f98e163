"""Candidate poses of one scan on another: refined by point-to-plane ICP until they rest, and judged by ``evidence``."""

from __future__ import annotations

from collections.abc import Iterable
from copy import copy
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from grindvision.errors import DegenerateError
from grindvision.geometry import angle_between, move_points
from grindvision.geometry.hash_grid import build_cells, random_order
from grindvision.geometry.neighbours import nearest
from grindvision.parallel import parallel_map
from grindvision.vision.registration.agreement import Agreement, agreeing_fraction
from grindvision.vision.registration.depth_image import depth_image
from grindvision.vision.registration.evidence import AGREES, Evidence, judge, side
from grindvision.vision.registration.global_registration import distinct_poses
from grindvision.vision.registration.held_motion import Held, icp_across
from grindvision.vision.registration.icp import FineRegistration
from grindvision.vision.registration.plane_icp import icp_planes, plane_residuals
from grindvision.vision.surface.rims import point_spacing
from grindvision.vision.surface.scan import Scan
from grindvision.vision.surface.surfels import Surfels, same_within

Floats = NDArray[np.float64]

SURE_AGREEMENT = 0.8
"""Share of agreement from which nothing speaks against a pose itself."""

MAX_HARD = 0.002
"""Fraction of surfels in front of what the other scanner saw above which a better pose is sought longer."""

OFF_SPACINGS, ON_SPACINGS = 1.2, 0.6
"""A point that lies so many spacings of its scan off a whole model is none of its surface, and one within the second
is: the model's own points are 0.6 apart or nearer, and of a plate's rims at rest hardly a point was farther than 1."""

UNLIKE_RAD, ROUGHLY = np.radians(20), 0.4
"""Poses turned from each other by more come to rest at different places; one at which a smaller share of this of the
surface meets than at the best of them is not likely."""

MIN_HOLES = 0.005
"""Holes of fewer pixels, as a fraction of those with a depth, leave a pose as it is."""

REFINED, RESTING = 300, 1000
"""Surfels that bring a proposed pose near, and to rest."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """A refined pose and its ``cost`` by the samples it was judged on; ``free``: whether it was found by a step along a
    weak motion of the best pose."""

    found: FineRegistration
    cost: float
    free: bool = False

    @property
    def pose(self) -> Floats:
        """T_target_source (4, 4)."""
        return self.found.T_target_source


class PoseJudge:
    """Refines and judges poses of one source scan on one target; what was judged once is remembered.

    ``points`` and ``normals`` (N, 3) of some surfels of the source about ``centre``, ``extent`` their rms distance from
    it; surfaces agree within ``within_mm``; ``surfels`` is the number of all surfels of both scans; ``whole``:
    the target is a model, which shows all of the part.
    """

    def __init__(self, source: Scan, target: Scan, rng: np.random.Generator, sample: int) -> None:
        sides = [
            side(scan, random_order(scan.surfels.grid.keys, draws)[:sample], depth_image(scan))
            for scan, draws in zip((source, target), (rng, rng.spawn(1)[0]), strict=True)
        ]
        self.source, self.target = sides
        self.points, self.normals = self.source.points[:RESTING], self.source.normals[:RESTING]
        self.surfels = len(source.surfels) + len(target.surfels)
        self.fine, self.coarse = target.surfels, target.voxels
        self.whole = target.sided
        self.within_mm = same_within(source.surfels, target.surfels)
        self.centre = self.points.mean(axis=0)
        self.extent = float(np.sqrt(((self.points - self.centre) ** 2).sum(axis=1).mean()))
        self._judged: dict[tuple[bytes, int | None], Evidence] = {}
        self._scans = source, target
        self._off: dict[bytes, Floats] = {}
        self._came_to: dict[tuple[bytes, int, int, tuple[float, float, int]], FineRegistration | None] = {}

    @property
    def shows_holes(self) -> bool:
        """Whether a scan has holes that may be gaps of the scan and not of the part."""
        holes = (one.image.bridge > 0 for one in (self.source, self.target))
        filled = (~one.image.empty for one in (self.source, self.target))
        return any(bool(a.sum() > MIN_HOLES * b.sum()) for a, b in zip(holes, filled, strict=True))

    def without_holes(self) -> PoseJudge:
        """The same, for scans with gaps where the part has surface: what lies in a hole tells no more than what lies
        beside the outline. Where ICP comes to from a pose is remembered for both."""
        other = copy(self)
        other.source, other.target = (
            one._replace(image=one.image._replace(bridge=np.full_like(one.image.bridge, -np.inf)))
            for one in (self.source, self.target)
        )
        other._judged = {}
        return other

    def axes(self) -> Floats:
        """Columns (3, 3): the ``principal_axes`` of ``points``."""
        return principal_axes(self.points)

    def evidence(self, pose: Floats, count: int | None = RESTING) -> Evidence:
        """What the first ``count`` samples of both scans, or all, say about a pose (4, 4)."""
        asked = pose.tobytes(), count
        if asked not in self._judged:
            self._judged[asked] = judge(self.source, self.target, pose, self.within_mm, 0.5 * self.within_mm, count)
        return self._judged[asked]

    def agreement(self, pose: Floats) -> Agreement:
        """Agreement of the side of which more could be seen by the other scanner."""
        found = self.evidence(pose, None)
        parts = [
            Agreement(float((states == AGREES).mean()), float((states > AGREES).mean()))
            for states in (found.states[: found.split], found.states[found.split :])
        ]
        return max(parts, key=lambda part: part.overlap)

    def is_uncertain(self, best: Candidate) -> bool:
        """Whether so much contradicts a pose that better ones are worth a longer search."""
        return (
            self.evidence(best.pose).hard > MAX_HARD or self.agreement(best.pose).fraction_of_overlap < SURE_AGREEMENT
        )

    def refined(self, pose: Floats, free: bool = False, far: bool = False) -> Candidate | None:
        """Coarse-to-fine ICP of a few surfels from ``pose``, which may be ``far`` off; None when the scans do not meet
        there."""
        points, normals = self.points[:REFINED], self.normals[:REFINED]
        voxel, size = self.coarse.grid.size_mm, self.fine.grid.size_mm
        try:
            if far:
                pose = self.neared(pose)
            found = self._icp(points, normals, self.coarse, pose, (1.5 * voxel, self.within_mm, 10))
            pose = found.T_target_source
            found = self._icp(points, normals, self.fine, pose, (2 * size, self.within_mm / 3, 12))
        except DegenerateError:
            return None
        return Candidate(found, self.evidence(found.T_target_source, 500).cost(), free)

    def neared(self, pose: Floats) -> Floats:
        """The pose (4, 4) after some steps of ICP of very few surfels from one that may be far off.

        Raises:
            DegenerateError: the scans do not meet there.
        """
        fewer, normals = self.points[:REFINED:3].copy(), self.normals[:REFINED:3].copy()
        voxel = self.coarse.grid.size_mm
        return self._icp(fewer, normals, self.coarse, pose, (5 * voxel, voxel, 8)).T_target_source

    def _icp(
        self, points: Floats, normals: Floats, target: Surfels, pose: Floats, limits: tuple[float, float, int]
    ) -> FineRegistration:
        """``icp_planes`` of points (N, 3) with normals (N, 3), remembered; ``limits``: the reach, the floor of the
        residuals' spread, both mm, and the iterations.

        Raises:
            DegenerateError: the scans do not meet there.
        """
        asked = np.asarray(pose, dtype=float).tobytes(), id(target), len(points), limits
        if asked not in self._came_to:
            try:
                self._came_to[asked] = icp_planes(points, normals, target, pose, *limits)
            except DegenerateError:
                self._came_to[asked] = None
        found = self._came_to[asked]
        if found is None:
            raise DegenerateError("the scans do not meet there")
        return found

    def neared_all(self, poses: Iterable[Floats]) -> list[Floats]:
        """``neared`` of several poses, in two threads; those where the scans do not meet are left out."""

        def neared(pose: Floats) -> Floats | None:
            try:
                return self.neared(pose)
            except DegenerateError:
                return None

        return [one for one in parallel_map(neared, poses) if one is not None]

    def refined_all(self, poses: Iterable[Floats], free: bool = False, far: bool = False) -> list[Candidate]:
        """``refined`` of several poses, in two threads; those where the scans do not meet are left out."""
        return [one for one in parallel_map(lambda pose: self.refined(pose, free=free, far=far), poses) if one]

    def at_rest(self, one: Candidate) -> Candidate | None:
        """ICP of all ``points`` until the candidate rests."""
        limits = 1.5 * self.fine.grid.size_mm, self.within_mm / 3, 60
        try:
            found = self._icp(self.points, self.normals, self.fine, one.pose, limits)
        except DegenerateError:
            return None
        return Candidate(found, self.evidence(found.T_target_source).cost(), one.free)

    def stepped_across(self, pose: Floats, motion: Floats, held: Held, steps: int) -> list[Floats]:
        """Poses (4, 4) after one to so many steps of a ``motion`` (4, 4) from a pose, each with few surfels at rest
        across what is ``held``; up to where the scans do not meet."""
        points, normals = self.points[:REFINED], self.normals[:REFINED]
        limits = 1.5 * self.fine.grid.size_mm, self.within_mm / 3
        poses: list[Floats] = []
        try:
            for _ in range(steps):
                found = icp_across(points, normals, self.fine, motion @ pose, held, limits, rounds=1)
                pose = found.T_target_source
                poses.append(pose)
        except DegenerateError:
            pass
        return poses

    def at_rest_across(self, one: Candidate, held: Held) -> Candidate | None:
        """``at_rest``, but along nothing that is ``held``."""
        limits = 1.5 * self.fine.grid.size_mm, self.within_mm / 3
        try:
            found = icp_across(self.points, self.normals, self.fine, one.pose, held, limits)
        except DegenerateError:
            return None
        return Candidate(found, self.evidence(found.T_target_source).cost(), one.free)

    def settled(self, candidates: Iterable[Candidate], kept: int = 4) -> list[Candidate]:
        """The best few distinct candidates, brought to rest with more surfels, best first."""
        chosen = self.distinct(candidates)[:kept]
        return self.distinct(one for one in parallel_map(self.at_rest, chosen) if one)

    def distinct(self, candidates: Iterable[Candidate]) -> list[Candidate]:
        """Candidates, best first, less those that differ from no better one."""
        chosen: list[Candidate] = []
        for one in sorted(candidates, key=lambda candidate: candidate.cost):
            if all(self.differ(one.pose, other.pose) for other in chosen):
                chosen.append(one)
        return chosen

    def ranked(self, candidates: Iterable[Candidate]) -> list[Candidate]:
        """Candidates by the cost of all samples, best first."""
        return sorted(
            (replace(one, cost=self.evidence(one.pose, None).cost()) for one in candidates), key=lambda one: one.cost
        )

    def differ(self, pose: Floats, other: Floats, times: float = 1.0) -> bool:
        """Whether two poses are apart by more than so many ``times`` 2 % of the extent or 2 degrees."""
        translation = np.linalg.norm(move_points(pose, self.centre) - move_points(other, self.centre))
        return bool(translation > times * 0.02 * self.extent or angle_between(pose, other) > times * np.radians(2))

    def rough_fractions(self, poses: Floats) -> Floats:
        """Share (K,) of some surfels that agree roughly at each of ``poses`` (K, 4, 4)."""
        some, normals, within = self.points[:REFINED], self.normals[:REFINED], 6 * self.within_mm
        return np.array([agreeing_fraction(some, normals, self.coarse, pose, within) for pose in poses])

    def off_model_at(self, pose: Floats, other: Floats) -> float:
        """So many more of the source's surfels lie off a whole model at a ``pose`` than at ``other``, by all points of
        the scan: the planes of surfels about a small hole reach over it.

        Counted are points that are clearly off at one pose and clearly on at the other, so that a bead, a clamp or a
        pose a little off count at neither.
        """
        one, two = (self._distances_off(each) for each in (pose, other))
        more, fewer = ((a > OFF_SPACINGS) & (b < ON_SPACINGS) for a, b in ((one, two), (two, one)))
        return float(more.mean() - fewer.mean()) * len(self._scans[0].surfels)

    def _distances_off(self, pose: Floats) -> Floats:
        """Distances (P,) of the source's points from a whole model, infinite for far ones: in spacings of the points,
        or in the distance within which surfaces agree where that is larger."""
        if pose.tobytes() not in self._off:
            source, model = self._scans
            spacing = max(point_spacing(source), self.within_mm)
            cells = build_cells(model.points, OFF_SPACINGS * spacing)
            _, away = nearest(cells, move_points(pose, source.points), OFF_SPACINGS * spacing)
            self._off[pose.tobytes()] = away / spacing
        return self._off[pose.tobytes()]

    def angle_of_sight(self, pose: Floats) -> float:
        """Angle in rad between the directions in which both scanners saw the surface at a ``pose``; not a number where
        the place of one is not known."""
        source, target = (side.image for side in (self.source, self.target))
        if not (source.known and target.known):
            return float("nan")
        middle = move_points(pose, self.centre)
        ours, theirs = move_points(pose, source.viewpoint) - middle, target.viewpoint - middle
        cosine = ours @ theirs / (np.linalg.norm(ours) * np.linalg.norm(theirs))
        return float(np.arccos(np.clip(cosine, -1, 1)))

    def residuals(self, pose: Floats) -> Floats:
        """Distances (N,) of the source's samples along the target's normals, NaN where the surfaces do not meet."""
        points, normals = self.source.points, self.source.normals
        residuals, facing = plane_residuals(points, normals, self.fine, pose, 2 * self.fine.grid.size_mm)
        return np.where(facing, residuals, np.nan)


def unlike_poses(judge: PoseJudge, poses: Floats, known: Iterable[Candidate], kept: int = 4) -> Floats:
    """The likeliest few of ``poses`` (K, 4, 4) that are turned from all ``known`` candidates and from each other: of a
    part that is nearly symmetric, the right one may be among those that are not the likeliest."""
    turned = np.array([all(angle_between(pose, one.pose) > UNLIKE_RAD for one in known) for pose in poses], dtype=bool)
    if not turned.any():
        return np.empty((0, 4, 4))
    rough = judge.rough_fractions(poses)
    likely = np.flatnonzero(turned & (rough > ROUGHLY * rough.max()))
    order = likely[np.argsort(-rough[likely], kind="stable")]
    return distinct_poses(poses[order], rough[order], judge.centre, np.inf, UNLIKE_RAD, kept)[0]


def principal_axes(points: Floats) -> Floats:
    """Columns (3, 3): the principal axes of points (N, 3), right-handed, least extent first."""
    _, axes = np.linalg.eigh(np.cov(points.T))
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    return np.asarray(axes)
