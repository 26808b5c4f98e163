"""What makes a found groove doubtful: no surface on one side, no edges, unseen walls, too few points for its size."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from grindvision.geometry import unit_vectors
from grindvision.vision.seam.groove_lines import DetectedGroove
from grindvision.vision.seam.seam_curve import beside_stations, in_frames
from grindvision.vision.seam.seam_smoothing import MAD_TO_STD
from grindvision.vision.seam.side_profiles import bin_medians, scattered, scattered_within

Floats = NDArray[np.float64]

#: Below this fraction of stations with surface on both sides, the groove lies partly outside the cloud.
MIN_BOTH_SIDES = 0.9
#: Points on the walls lie between these fractions of the depth. A V has 60 % of its points there, a U with walls 11
#: degrees from upright 14 %, a gap between upright faces none. So many points tell.
WALL_DEPTHS, MIN_WALL_FRACTION, POINTS_ASKED = (0.2, 0.8), 0.08, 2000
#: Distance from the root, in half widths: inner wall, outer wall, the surface beside the groove; and the bins there.
INNER_WALL, OUTER_WALL, BESIDE = (0.1, 0.5), (0.4, 0.9), (1.1, 1.7)
PROFILE_BINS = np.linspace(0.1, 1.75, 18)
#: At its edge a groove turns by at least this, and its walls bend back by at most this fraction of it: the hollow
#: between two round bodies has no edges. The surface beside it is nearly level.
MIN_EDGE_DEG, MAX_BEND, MAX_BESIDE_DEG = 8.0, 0.22, 14.0
#: A side ends at an edge where a wall and a surface that meet there (at these distances from the root, in half widths)
#: leave less than this fraction of what an arc leaves, over the whole side or over its outer part. Else it bends on,
#: unless what they leave is within so many times the medians' own noise, which then hides which of both it is.
EDGE_PLACES, SIDE_STARTS, ARC_FRACTION = np.linspace(0.6, 1.3, 15), (0.0, 0.35), 0.85
MIN_MISFIT_NOISE = 2.0
#: An edge is told from an arc by so many places of a profile at least.
MIN_PLACES = 7
#: A wall is upright whose edge lies within this fraction of the width, or so many stations, from the root: its slopes
#: are not resolved.
UPRIGHT, UPRIGHT_STEPS = 0.15, 1.5
#: So many points of the cloud are looked at, and so many beside the groove show its edges: with more a camera's blur
#: tells an edge from an arc.
CLOUD_POINTS, PROFILE_POINTS = 12_000, 2500
#: A groove holds at least this fraction of the points that the cloud's spacing gives to its area.
MIN_FILLING = 0.45
#: A groove shorter than so many widths is doubtful.
SHORT_WIDTHS = 3.0


class Edge(Enum):
    """How a groove's wall goes over into the surface beside it: it ends at an edge, it bends on, the noise hides which
    of both, or too little of it is seen."""

    ENDS = "ends at an edge"
    BENDS = "bends on"
    UNTOLD = "hidden by noise"
    UNSEEN = "not seen"


@dataclass(frozen=True)
class Judged:
    """A groove with the fraction of its points on its walls and how its left and its right wall end."""

    groove: DetectedGroove
    on_walls: float
    sides: tuple[Edge, Edge]

    @property
    def is_sure(self) -> bool:
        """Whether walls, edges and the surface on both sides are seen."""
        seen = self.groove.edges_seen >= MIN_BOTH_SIDES and self.on_walls >= MIN_WALL_FRACTION
        return seen and self.sides == (Edge.ENDS, Edge.ENDS)

    @property
    def bends_on(self) -> bool:
        """Whether a wall is seen to bend on and on instead of ending at an edge: the hollow where two tubes meet.

        Walls that nobody saw, as of a gap between two things, say nothing.
        """
        return self.on_walls >= MIN_WALL_FRACTION and Edge.BENDS in self.sides


def judge_groove(groove: DetectedGroove, cloud: Floats) -> Judged:
    """What the finite points (N, 3) of a cloud show of a groove whose members are counted among them."""
    return Judged(groove, wall_fraction(groove, cloud), edges_of_sides(groove, cloud))


def diagnose_groove(
    groove: DetectedGroove, points: ArrayLike, spacing_mm: float, judged: Judged | None = None
) -> list[str]:
    """Sentences without their subject that say why a groove of a cloud (N, 3) or (R, C, 3) is doubtful, and what to do.

    None for a groove that is well seen. ``judged`` is what ``judge_groove`` told, if that is known.
    """
    findings = []
    if groove.edges_seen < MIN_BOTH_SIDES:
        findings.append(
            f"lies partly outside the cloud: only {groove.edges_seen:.0%} of its length shows"
            " the surface on both sides, its outer edge is a guess; scan again with the groove inside the view"
        )
    width = float(np.median(groove.width_mm))
    cloud = np.asarray(points, dtype=float).reshape(-1, 3)
    on_walls = wall_fraction(groove, cloud) if judged is None else judged.on_walls
    if on_walls < MIN_WALL_FRACTION:
        findings.append(
            f"({width:.3g} mm wide) may be a gap between two things: only {on_walls:.0%} of its points lie on its"
            " walls, so that its edges and its root are guesses; see in the picture that it is a groove, else crop the"
            " cloud to the part"
        )
    else:
        finite = cloud[np.isfinite(cloud).all(axis=1)] if judged is None else cloud
        sides = edges_of_sides(groove, finite) if judged is None else judged.sides
        why = {
            Edge.UNTOLD: "the noise hides whether its sides end at edges or bend on",
            Edge.UNSEEN: "hardly any points show how it ends on one side",
        }
        why_not = [words for edge, words in why.items() if edge in sides]
        if why_not and groove.edges_seen >= MIN_BOTH_SIDES:
            findings.append(
                f"({width:.3g} mm wide) may be the hollow between two round bodies: {' and '.join(why_not)}; see in the"
                " picture that it is a groove, else scan from nearer, with its surroundings"
            )
    if not findings and groove.length_mm < SHORT_WIDTHS * width:
        findings.append(
            f"is only {groove.length_mm:.3g} mm long at a width of {width:.3g} mm, which may be a dent or the end of"
            " another thing: see in the picture that it is a groove, else crop the cloud to the part"
        )
    filling = filling_of(groove, spacing_mm)
    if filling < MIN_FILLING:
        findings.append(
            f"holds only {filling:.0%} of the points that its {width:.3g} mm x {groove.length_mm:.3g} mm would show at"
            f" {spacing_mm:.2g} mm spacing; scan again from where the camera looks into it, or crop the cloud to the"
            " part"
        )
    return findings


def filling_of(groove: DetectedGroove, spacing_mm: float) -> float:
    """Points of a groove, over those that its area holds at the cloud's spacing."""
    return float(len(groove.members) * spacing_mm**2 / (np.median(groove.width_mm) * groove.length_mm))


def wall_fraction(groove: DetectedGroove, cloud: Floats) -> float:
    """Fraction of a groove's points in its cloud (N, 3) that lie on its walls, away from surface and root.

    Below ``MIN_WALL_FRACTION`` it may be a gap between two things.
    """
    members = cloud[groove.members[:: len(groove.members) // POINTS_ASKED + 1]]
    middle = (groove.left + groove.right) / 2
    nearest = cKDTree(middle).query(members)[1]
    below = ((middle[nearest] - members) * groove.normals[nearest]).sum(axis=1) / groove.depth_mm[nearest]
    return float(((below > WALL_DEPTHS[0]) & (below < WALL_DEPTHS[1])).mean())


def edges_of_sides(groove: DetectedGroove, cloud: Floats) -> tuple[Edge, Edge]:
    """Whether left and right wall turn into a level surface at an edge.

    Judged by the median cross-section in the cloud (N, 3); an upright wall, which is hardly seen, counts as one.
    """
    half = max(np.median(np.linalg.norm(edge - groove.root, axis=1)) for edge in (groove.left, groove.right))
    reach = 1.2 * PROFILE_BINS[-1] * half
    low, high = groove.root.min(axis=0) - reach, groove.root.max(axis=0) + reach
    points = scattered_within(np.ascontiguousarray(cloud), 3 * CLOUD_POINTS, low, high)
    along = unit_vectors(np.gradient(groove.root, axis=0))
    across = unit_vectors(np.cross(groove.normals, along))
    for enough in (2 * PROFILE_POINTS, CLOUD_POINTS):
        some = points[scattered(len(points), enough)]
        near, station, _ = beside_stations(some, groove.root, along, reach, groove.step_mm)
        if len(near) >= PROFILE_POINTS:
            break
    kept = scattered(len(near), PROFILE_POINTS)
    near, station = near[kept], station[kept]
    place, height = in_frames(some[near], station, groove.root, (across, groove.normals)).T
    found: list[Edge] = []
    for edge in (groove.left, groove.right):
        side = ((edge - groove.root) * across).sum(axis=1)
        half = float(np.median(np.abs(side)))
        if half < max(UPRIGHT * float(np.median(groove.width_mm)), UPRIGHT_STEPS * groove.step_mm):
            found.append(Edge.ENDS)
            continue
        profile, noise = _median_profile(place / side[station], height)
        slopes = _slopes_deg(profile, half)
        turn, bend = slopes[1] - slopes[2], slopes[0] - slopes[1]
        is_edge = turn > MIN_EDGE_DEG and bend < MAX_BEND * turn and abs(slopes[2]) < MAX_BESIDE_DEG
        if not np.isfinite(slopes).all():
            found.append(Edge.UNSEEN)
        else:
            found.append(edge_or_arc(profile, noise) if is_edge else Edge.BENDS)
    return found[0], found[1]


def _median_profile(place: Floats, height: Floats) -> tuple[Floats, float]:
    """Median places and heights (B, 2) of points at ``place`` (N,), and the noise of the median heights.

    Places are in half widths from the root. Each bin has its own: the rows of a sparse scan do not lie in the middles.
    """
    medians = bin_medians(place, height, PROFILE_BINS)
    if not len(medians):
        return np.empty((0, 2)), 0.0
    return medians[:, :2], float(np.median(MAD_TO_STD * medians[:, 2] / np.sqrt(medians[:, 3])))


def _slopes_deg(profile: Floats, half_mm: float) -> Floats:
    """Slopes (3,) of inner wall, outer wall and surface in a profile (B, 2) of places in half widths and heights.

    Of a wall of so few places that one of its parts has none, both parts have the slope of all of it.
    """
    slopes = np.full(3, np.nan)
    for row, (low, high) in enumerate((INNER_WALL, OUTER_WALL, BESIDE)):
        part = profile[(profile[:, 0] > low) & (profile[:, 0] < high)]
        if len(part) > 1:
            slopes[row] = _slope_deg(part, half_mm)
    wall = profile[(profile[:, 0] > INNER_WALL[0]) & (profile[:, 0] < OUTER_WALL[1])]
    if np.isnan(slopes[:2]).any() and len(profile) >= MIN_PLACES and len(wall) > 1:
        slopes[:2] = _slope_deg(wall, half_mm)
    return slopes


def _slope_deg(places: Floats, half_mm: float) -> float:
    away = (places[:, 0] - places[:, 0].mean()) * half_mm
    return float(np.degrees(np.arctan(away @ places[:, 1] / (away @ away))))


def edge_or_arc(profile: Floats, noise_mm: float) -> Edge:
    """Whether a wall and a surface that meet at an edge explain a profile (B, 2) better than an arc does."""
    found = []
    for start in SIDE_STARTS:
        place, height = profile[profile[:, 0] > start].T
        if len(place) < MIN_PLACES:
            return Edge.ENDS
        edges = np.maximum(place[:, None] - EDGE_PLACES, 0)
        misfits = _misfits(place, height, np.column_stack([edges, place**2]))
        edge, arc = misfits[:-1].min(), misfits[-1]
        if edge < ARC_FRACTION * arc:
            return Edge.ENDS
        found.append(Edge.UNTOLD if edge < MIN_MISFIT_NOISE * noise_mm else Edge.BENDS)
    return Edge.UNTOLD if Edge.UNTOLD in found else Edge.BENDS


def _misfits(place: Floats, height: Floats, shapes: Floats) -> Floats:
    """Misfits (K,) of heights (B,) at ``place`` (B,) by a straight line and each of K ``shapes`` (B, K)."""
    away = place - place.mean()
    values = np.column_stack([height, shapes])
    values = values - values.mean(axis=0)
    values = values - np.outer(away, away @ values / (away @ away))
    off, shapes = values[:, 0], values[:, 1:]
    size = (shapes**2).sum(axis=0)
    share = np.where(size > 1e-20, off @ shapes / np.maximum(size, 1e-20), 0.0)
    return np.asarray(np.sqrt(((off[:, None] - share * shapes) ** 2).mean(axis=0)))
