"""What the faces of a joint are: plane, cylinder or free form; and whether a face goes on behind the other one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from grindvision.geometry import vector_angle
from grindvision.vision.seam.face_fit import FAR_CELLS
from grindvision.vision.seam.joint_fit import JointFit
from grindvision.vision.seam.joint_names import INSIDE, SADDLE, T_JOINT, TUBE_ON_PLATE
from grindvision.vision.seam.step_fit import EdgeFit
from grindvision.vision.surface.surfels import Surfels

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

PLANE, CYLINDER, FREE_FORM = "plane", "cylinder", "free form"

#: Surfels up to so many cells from the seam show the shape of a face.
REACH_CELLS = 8.0
#: A face is a plane while an arc turns by at most this over its extent (the waviness of a plate that a camera shows
#: turns by half of it, a tube by several times), or does not explain the surfels better: by this logarithm of the ratio
#: of likelihoods, of every second surfel, as neighbours share points and errors.
PLANE_TURN_RAD, MIN_LOG_RATIO, ALIKE = np.radians(12.0), 5.0, 2
#: A face whose points bend away from the seam by so many times this over the reach of their fit, less so many
#: standard deviations, is no plane.
BULGE_TURNS, BULGE_SIGMAS = 2.0, 5.0
#: A plane may bend as much as its curvature and so many standard deviations allow.
SURE_DEVIATIONS = 2.0
#: A cylinder leaves at most this fraction of what a plane leaves.
CYLINDER_FRACTION = 0.35
#: A free form bulges if an arc leaves less than this fraction of what a plane leaves.
BULGE_FRACTION = 0.95
#: Surfels that lie in the extension of a face, or on a parallel surface, have normals within this of the face's.
PARALLEL_RAD = np.radians(12.0)
#: A face that ends within this behind the other one is a corner's, if so much of that stretch is seen to be empty.
BEHIND_MM, MIN_EMPTY = 60.0, 0.3
#: A plate that lies on another is so many times as wide as its edge is high; where the other is seen to go on behind
#: it, what is not so many times as wide is a bar or a rib that stands on it.
PLATE_LEGS, BAR_LEGS = 2.5, 4.0
#: So many surfels are a surface.
MIN_SURFELS = 8
#: A bent face that turns by less than this is a tube or a warped plate: plates of 180 mm warped by 2 mm turn by 22
#: to 25 deg, tubes seen by a camera by 55 to 116 (a branch of 12 mm on one of 30 mm is the least).
WARPED_RAD = np.radians(40.0)


@dataclass(frozen=True)
class FaceShape:
    """Shape of a face: ``name`` is plane, cylinder or free form; a cylinder has ``radius_mm`` and ``axis`` (3,).

    ``bulges`` says that the face bends away from the side that is seen, like a tube's outside; ``may_bulge`` that a
    plane may do so as well, for all that its noise tells; ``turn_rad`` how far a cylinder is seen to turn.
    """

    name: str
    radius_mm: float = np.inf
    axis: tuple[float, float, float] | None = None
    bulges: bool = False
    may_bulge: bool = False
    turn_rad: float = np.inf

    def __str__(self) -> str:
        return f"cylinder of radius {self.radius_mm:.3g} mm" if self.name == CYLINDER else self.name


@dataclass(frozen=True)
class Surroundings:
    """What is around a concave joint: does face k go on behind the other (2,), is there a surface parallel to it at the
    height of the other's leg (2,), which makes the other a plate's edge; is nothing there where it would go on (2,)."""

    goes_on: tuple[bool, bool]
    parallel_above: tuple[bool, bool]
    ends_there: tuple[bool, bool]


def face_shapes(fit: JointFit, surfels: Surfels, normals: Floats) -> tuple[FaceShape, FaceShape]:
    """Shapes of the two faces, from the surfels (M) with normals (M, 3) that lie on them near the seam."""
    noise = float(np.median(surfels.noise_mm))
    found = [_shape(points, facing, noise) for points, facing in face_surfels(fit, surfels, normals)]
    # The points near the seam tell a bend that the few surfels there do not.
    surely = -fit.bend_per_mm - BULGE_SIGMAS * fit.bend_sigma_per_mm
    turn = surely * FAR_CELLS * surfels.grid.size_mm
    first, second = (
        FaceShape(FREE_FORM, bulges=True) if shape.name == PLANE and turn[k] > BULGE_TURNS * PLANE_TURN_RAD else shape
        for k, shape in enumerate(found)
    )
    return first, second


def undecided(kind: str, shapes: tuple[FaceShape, FaceShape]) -> tuple[str, ...]:
    """What to say of a corner whose one face bends away like a tube, while the noise hides whether the other does, or
    of a tube that may be a warped plate."""
    little = min(shape.turn_rad for shape in shapes)
    if kind in (TUBE_ON_PLATE, SADDLE) and little < WARPED_RAD:
        flat = T_JOINT if kind == TUBE_ON_PLATE else TUBE_ON_PLATE
        return (
            f"is undecided between {kind} and {flat}: a bent face turns by {np.degrees(little):.0f} deg over all that"
            " is seen of it, as a warped plate may; ask for the kind with --joint",
        )
    bent, other = sorted(shapes, key=lambda shape: shape.name == PLANE)
    if kind not in (T_JOINT, INSIDE) or not (bent.bulges and other.may_bulge):
        return ()
    return (
        f"is undecided between {kind} and {SADDLE}: one face bends away like a tube, and the noise hides whether the"
        " other one does; scan from nearer, or ask for the kind with --joint",
    )


def face_surfels(fit: JointFit, surfels: Surfels, normals: Floats) -> list[tuple[Floats, Floats]]:
    """Places and normals (K, 3) of the surfels on each of the two faces near the seam."""
    size = surfels.grid.size_mm
    station, offset, near = _near(fit, surfels, REACH_CELLS * size)
    found = []
    for side in range(2):
        outward = (offset * fit.faces.outward[side, station]).sum(axis=1)
        other = (offset * fit.faces.outward[1 - side, station]).sum(axis=1)
        height = (offset * fit.faces.normal[side, station]).sum(axis=1)
        facing = vector_angle(normals[near], fit.faces.normal[side, station])
        on = (outward > max(other.min(initial=0.0), 1.5 * size)) & (outward > other)
        on &= (np.abs(height) < 0.5 * outward) & (facing < np.radians(50))
        found.append((surfels.points[near[on]], normals[near[on]]))
    return found


def surroundings(fit: JointFit, surfels: Surfels, normals: Floats, towards: Floats | None) -> Surroundings:
    """What lies behind the two faces of a concave joint of planes, seen from ``towards`` (3,) where that is known."""
    size = surfels.grid.size_mm
    station, offset, near = _near(fit, surfels, np.inf)
    goes_on, parallel = [], []
    noise = 3 * float(np.median(surfels.noise_mm))
    for side in range(2):
        outward = (offset * fit.faces.outward[side, station]).sum(axis=1)
        height = (offset * fit.faces.normal[side, station]).sum(axis=1)
        behind = (offset * fit.faces.normal[1 - side, station]).sum(axis=1) < -1.5 * size
        like = vector_angle(normals[near], fit.faces.normal[side, station]) < PARALLEL_RAD
        tolerance = noise + 0.02 * np.abs(outward) + 0.05 * size
        goes_on.append(bool((behind & like & (np.abs(height) < tolerance)).sum() >= MIN_SURFELS))
        leg = float(np.median(fit.legs_mm[1 - side, fit.shown]))
        above = behind & like & (np.abs(height - leg) < tolerance + 0.25 * leg + 0.5 * size) & (height > 2 * tolerance)
        least = (BAR_LEGS if goes_on[side] else PLATE_LEGS) * leg
        wide = outward[above].size >= MIN_SURFELS and np.percentile(-outward[above], 90) > least
        parallel.append(bool(wide))
    ends = [towards is not None and _ends_there(fit, surfels, side, towards) for side in range(2)]
    return Surroundings((goes_on[0], goes_on[1]), (parallel[0], parallel[1]), (ends[0], ends[1]))


def _ends_there(fit: JointFit, surfels: Surfels, side: int, towards: Floats) -> bool:
    """Whether a face ends behind the other one: where it would go on, the scanner looks past both and sees nothing, or
    something farther away."""
    size = surfels.grid.size_mm
    behind = np.arange(2 * size, BEHIND_MM, size / 2)
    shown = np.flatnonzero(fit.shown)
    middle = shown[len(shown) // 4 : max(3 * len(shown) // 4, 1) : max(len(shown) // 20, 1)]
    places = fit.root[middle, None] - behind[None, :, None] * fit.faces.outward[side, middle, None]
    places = places.reshape(-1, 3)
    rays, seen = places - towards, surfels.points - towards
    depth, seen_depth = np.linalg.norm(rays, axis=1), np.linalg.norm(seen, axis=1)
    away, nearest = cKDTree(seen / seen_depth[:, None]).query(rays / depth[:, None])
    empty = (away * depth > 1.5 * size) | (seen_depth[nearest] > depth + 3 * size)
    return bool(empty.mean() > MIN_EMPTY)


def bar_width_mm(step: EdgeFit, surfels: Surfels, normals: Floats) -> float | None:
    """Width of what ends above a step, where it is that of a bar or a rib and the lower surface is seen to go on behind
    it; else None."""
    station, offset, near = _near(step, surfels, np.inf)
    size, high = surfels.grid.size_mm, float(np.median(step.step_mm[step.shown]))
    behind = -(offset * step.way[station]).sum(axis=1)
    height = (offset * step.normals[1, station]).sum(axis=1)
    like = vector_angle(normals[near], step.normals[1, station]) < PARALLEL_RAD
    tolerance = 3 * float(np.median(surfels.noise_mm)) + 0.02 * np.abs(behind) + 0.05 * size
    above = like & (behind > 0) & (np.abs(height - high) < tolerance + 0.25 * high)
    below = like & (behind > 1.5 * size) & (np.abs(height) < tolerance)
    if min(above.sum(), below.sum()) < MIN_SURFELS:
        return None
    width = float(np.percentile(behind[above], 95))
    return width if width < BAR_LEGS * high else None


def _near(
    fit: JointFit | EdgeFit, surfels: Surfels, reach: float
) -> tuple[NDArray[np.int64], Floats, NDArray[np.int64]]:
    """Nearest station and offset of the surfels beside the seam, and their numbers."""
    away, station = cKDTree(fit.root).query(surfels.points)
    offset = surfels.points - fit.root[station]
    ahead = np.abs((offset * fit.curve.along[station]).sum(axis=1))
    near = np.flatnonzero((away < reach) & (ahead < surfels.grid.size_mm))
    return station[near], offset[near], near


def _shape(points: Floats, normals: Floats, noise: float) -> FaceShape:
    if len(points) < MIN_SURFELS:
        return FaceShape(FREE_FORM)
    centred = points - points.mean(axis=0)
    values = np.linalg.svd(centred, compute_uv=False)
    flat = float(values[2] / np.sqrt(len(points)))
    axis = np.linalg.eigh(normals.T @ normals)[1][:, 0]
    first = np.linalg.svd(axis[None])[2][1:]
    u, v = (centred @ one for one in first)
    # Circle through the projected points: u^2 + v^2 = 2 a u + 2 b v + c.
    solution = np.linalg.lstsq(np.column_stack([2 * u, 2 * v, np.ones(len(u))]), u * u + v * v, rcond=None)[0]
    radius = float(np.sqrt(max(solution[2] + solution[0] ** 2 + solution[1] ** 2, 0.0)))
    off = np.hypot(u - solution[0], v - solution[1]) - radius
    scatter = float(np.sqrt((off**2).mean()))
    section = np.column_stack([u, v])
    chord = section @ np.linalg.eigh(np.cov(u, v))[1][:, 1]
    extent = float(np.subtract(*np.percentile(chord, (95, 5))))
    if (
        extent < PLANE_TURN_RAD * radius
        or len(points) / ALIKE * np.log(max(flat, 1e-9) / max(scatter, 1e-9)) < MIN_LOG_RATIO
    ):
        return FaceShape(PLANE, may_bulge=_may_bulge(section, extent, first @ normals.mean(axis=0)))
    centre = solution[:2] @ first
    bulges = bool(centre @ normals.mean(axis=0) < 0 and scatter < BULGE_FRACTION * flat)
    if scatter < max(CYLINDER_FRACTION * flat, noise):
        direction = float(axis[0]), float(axis[1]), float(axis[2])
        return FaceShape(CYLINDER, radius, direction, bulges, turn_rad=extent / radius)
    return FaceShape(FREE_FORM, bulges=bulges)


def _may_bulge(section: Floats, extent: float, outward: Floats) -> bool:
    """Whether surfels in cross-section (K, 2) may lie on an arc that turns away from ``outward`` (2,) like a tube."""
    away = section - section.mean(axis=0)
    axes = np.linalg.eigh(away.T @ away)[1]
    height = away @ axes[:, 0] * np.sign(axes[:, 0] @ outward)
    columns = np.column_stack([np.ones(len(away)), away @ axes[:, 1], (away @ axes[:, 1]) ** 2])
    solution = np.linalg.lstsq(columns, height, rcond=None)[0]
    scatter = np.mean((height - columns @ solution) ** 2) * ALIKE
    sigma = float(np.sqrt(scatter * np.linalg.pinv(columns.T @ columns)[2, 2]))
    return bool(2 * (SURE_DEVIATIONS * sigma - solution[2]) * extent > PLANE_TURN_RAD)
