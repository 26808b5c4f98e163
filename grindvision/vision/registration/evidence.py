"""What a pose says about a scan's surfels where the other scanner could see them: agreement, contradiction, nothing.

A surfel that lies on the other scan's surface agrees; one that stands off it, in front of what the other scanner saw,
or where that scanner looked through a hole, contradicts the pose. A surfel that faces away from the other scanner, or
is hidden behind what it saw, tells nothing, and neither does one beside the other scan's outline: that may be where the
part ends, or the picture.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from grindvision.geometry import inverse
from grindvision.geometry.hash_grid import CellGrid
from grindvision.geometry.neighbours import nearest_one
from grindvision.kernels import njit
from grindvision.records import by_content
from grindvision.vision.registration.depth_image import DepthImage
from grindvision.vision.registration.plane_icp import MAX_LATERAL_OFFSET, MIN_FACING
from grindvision.vision.surface.scan import Scan

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
States = NDArray[np.int8]

UNSEEN, ABSENT, AGREES, STANDS_OFF, IN_FRONT, IN_HOLE, CROSSES = range(7)
"""States of a surfel: the other scanner could not see it; it lies beside the other scan's outline; it agrees; it stands
off the other surface, in front of it, or where the other scan has a hole; it crosses the other surface."""

MIN_SIGHT = 0.25
"""Cosine of the angle between normal and ray below which a scanner cannot be counted on to see a surface."""

HARD, SOFT, LOST, MET = 1.0, 0.04, 0.03, 0.0015
"""Costs of a surfel in front of what the other scanner saw or in its hole; of one at full misfit on or across the other
surface, where edges, beads and curvature err as well; of one beside the other scan's outline; and the gain of one that
agrees. At a true pose nothing is in front of what was seen, while the overlap grows wherever the two views coincide."""

CROSSING_LOSS = 0.3
"""Misfit of a surfel that crosses the other surface: at edges many do."""


class Side(NamedTuple):
    """A scan as evidence: samples of its surfels, ``points`` (N, 3), ``normals`` (N, 3), ``roughness`` (N,); and, for
    the other scan's samples, the ``grid`` of all surfels with their ``grid_normals`` and ``grid_roughness``, and its
    depth ``image``."""

    points: Floats
    normals: Floats
    roughness: Floats
    grid: CellGrid
    grid_normals: Floats
    grid_roughness: Floats
    image: DepthImage


@by_content
@dataclass(frozen=True)
class Evidence:
    """Judgement of one pose: the ``states`` (N + M,) and ``losses`` (N + M,) in 0..1 of the source's samples, then of
    the target's; ``split`` is N."""

    states: States
    losses: Floats
    split: int

    @property
    def hard(self) -> float:
        """Fraction of the surfels that stand in front of what the other scanner saw, or in its holes."""
        return float(((self.states == IN_FRONT) | (self.states == IN_HOLE)).mean())

    @property
    def in_holes(self) -> float:
        """Fraction of the surfels that lie in holes of the other scan."""
        return float((self.states == IN_HOLE).mean())

    @property
    def beside(self) -> float:
        """Fraction of the source's surfels that lie beside the target's outline."""
        return float((self.states[: self.split] == ABSENT).mean())

    @property
    def met(self) -> float:
        """Fraction of the surfels that agree."""
        return float((self.states == AGREES).mean())

    def cost(self, absent: float = LOST) -> float:
        """What speaks against the pose less what speaks for it, per surfel of both scans; ``absent``: the cost of a
        surfel beside the outline."""
        hard = (self.states == IN_FRONT) | (self.states == IN_HOLE)
        lost = self.states == ABSENT
        return float(HARD * hard.sum() + absent * lost.sum()) / len(self.states) + self.misfit_cost()

    def misfit_cost(self) -> float:
        """The part of ``cost`` that is of where the surfaces meet: of the misfit there, less the gain."""
        soft = self.losses[self.states >= AGREES].sum()
        return float(SOFT * soft - MET * (self.states == AGREES).sum()) / len(self.states)


def side(scan: Scan, chosen: Integers, image: DepthImage) -> Side:
    """A scan as evidence, by the ``chosen`` of its surfels that have a normal."""
    surfels = scan.surfels
    chosen = chosen[np.abs(surfels.normals[chosen]).sum(axis=1) > 0]
    return Side(
        np.ascontiguousarray(surfels.points[chosen]),
        np.ascontiguousarray(surfels.normals[chosen]),
        np.ascontiguousarray(surfels.roughness_mm[chosen]),
        surfels.grid,
        surfels.normals,
        surfels.roughness_mm,
        image,
    )


def judge(
    source: Side, target: Side, T_target_source: Floats, within_mm: float, sigma_mm: float, count: int | None = None
) -> Evidence:
    """Judge a pose from both sides.

    Args:
        within_mm: agreement is a distance along the normal of at most so much.
        sigma_mm: errors of that size are usual; the losses grow with the squared distance and end at 1.
        count: samples of each scan to use, the first; all when left out.
    """
    source_pose, target_pose = (np.ascontiguousarray(pose) for pose in (T_target_source, inverse(T_target_source)))
    most = max(len(source.points), len(target.points)) if count is None else count
    judged = [
        _judged(source, target, source_pose, float(within_mm), float(sigma_mm), most),
        _judged(target, source, target_pose, float(within_mm), float(sigma_mm), most),
    ]
    states, losses = (np.concatenate(column) for column in zip(*judged, strict=True))
    return Evidence(states, losses, len(judged[0][0]))


@njit(cache=True, nogil=True)
def _judged(one: Side, other: Side, m: Floats, within: float, sigma: float, most: int) -> tuple[States, Floats]:
    """States (N,) and losses (N,) of the first samples of one scan, ``most`` at most, moved by a pose ``m`` (4, 4)."""
    points, normals, roughness = one.points[:most], one.normals[:most], one.roughness[:most]
    grid, image, target_normals, target_roughness = other.grid, other.image, other.grid_normals, other.grid_roughness
    number, size = len(points), grid.size_mm
    states, losses = np.zeros(number, dtype=np.int8), np.zeros(number)
    max_lateral = (MAX_LATERAL_OFFSET * size) ** 2
    place, up, ray = np.empty(3), np.empty(3), np.empty(3)
    for p in range(number):
        for k in range(3):
            place[k] = m[k, 0] * points[p, 0] + m[k, 1] * points[p, 1] + m[k, 2] * points[p, 2] + m[k, 3]
            up[k] = m[k, 0] * normals[p, 0] + m[k, 1] * normals[p, 1] + m[k, 2] * normals[p, 2]
        q, squared = nearest_one(place[0], place[1], place[2], 3 * size, grid)
        facing, along = 0.0, 0.0
        if q >= 0:
            for k in range(3):
                along += target_normals[q, k] * (place[k] - grid.points[q, k])
                facing += target_normals[q, k] * up[k]
            if squared - along * along >= max_lateral:
                q = -1
        if q >= 0 and facing > MIN_FACING:
            usual = sigma * sigma + 0.5 * (roughness[p] ** 2 + target_roughness[q] ** 2)
            fourth = (along * along / (4.0 * usual)) ** 2
            losses[p] = fourth / (1.0 + fourth)
            states[p] = AGREES if abs(along) <= within else STANDS_OFF
            continue
        if not image.known:
            if q >= 0:
                states[p], losses[p] = CROSSES, CROSSING_LOSS
            else:
                states[p] = ABSENT
            continue
        length = 0.0
        for k in range(3):
            ray[k] = place[k] - image.viewpoint[k]
            length += ray[k] * ray[k]
        if -(ray[0] * up[0] + ray[1] * up[1] + ray[2] * up[2]) < MIN_SIGHT * np.sqrt(length):
            continue
        axes = image.axes
        depth = axes[2, 0] * ray[0] + axes[2, 1] * ray[1] + axes[2, 2] * ray[2]
        if depth <= 0:
            continue
        right = axes[0, 0] * ray[0] + axes[0, 1] * ray[1] + axes[0, 2] * ray[2]
        above = axes[1, 0] * ray[0] + axes[1, 1] * ray[1] + axes[1, 2] * ray[2]
        i = int(np.round(right / depth / image.pixel)) - image.low[0]
        j = int(np.round(above / depth / image.pixel)) - image.low[1]
        if i < 0 or j < 0 or i >= image.front.shape[0] or j >= image.front.shape[1]:
            states[p] = ABSENT
        elif depth < image.front[i, j] - 3 * within:
            states[p] = IN_FRONT
        elif depth < image.bridge[i, j] + 0.5 * size:
            states[p] = IN_HOLE
        elif q >= 0:
            states[p], losses[p] = CROSSES, CROSSING_LOSS
        elif image.empty[i, j]:
            states[p] = ABSENT
    return states, losses
