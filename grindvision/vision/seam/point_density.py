"""Where a camera stood, told by how densely its points lie on the surfaces that it saw.

The pixels of a pinhole camera divide a plane across its axis evenly. On a surface of normal n, seen from e, there are
``n.(e - p) / (b.(e - p))^3`` points a square millimetre at p, where b is the direction of the axis times a length that
stands for the pixels' size: fewer the flatter it is seen, and fewer farther away. A scan filtered to even spacing
follows that law for no place within reach, one merged from several views for none at all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from grindvision.geometry import unit_vectors, vector_angle
from grindvision.geometry.bounds import diagonal_mm
from grindvision.records import by_content
from grindvision.vision.seam.seam_smoothing import MAD_TO_STD
from grindvision.vision.surface.surfels import build_surfels

Floats = NDArray[np.float64]

#: Edge of the surfels about which points are counted, as a fraction of the diagonal; so many points each, which lie
#: evenly about the place (within this fraction of their radius) and flat (within so many times the usual scatter).
SURFEL_FRACTION, NEIGHBOURS, MAX_OFF, MAX_ROUGH = 1 / 60, 36, 0.12, 2.0
#: Fewer places than this tell nothing.
MIN_PLACES = 150
#: Rounds of the first, linear fit and of the other one, and when a residual (of the logarithm) no longer counts.
LINEAR_ROUNDS, ROUNDS, TUKEY = 12, 40, 4.7
#: So many of the directions tried are followed; the place is first put so many diagonals away.
FOLLOWED, START_DIAGONALS = 5, 1.5
#: A camera looks at what it measures: its axis passes the middle of the cloud within this standard deviation.
AXIS_SIGMA_RAD = np.radians(12.0)
#: A place is believed whose direction is known to this and whose distance to this fraction of itself, if the law holds
#: to this (a logarithm) and no place in another direction explains the points nearly as well, by this logarithm of the
#: ratio of likelihoods.
MAX_ANGLE_SIGMA_RAD, MAX_DISTANCE_SIGMA, MAX_SCATTER, MIN_LOG_RATIO = np.radians(8.0), 0.25, 0.13, 10.0
#: Other directions differ by more than this.
OTHER_RAD = np.radians(25.0)
#: Pixels fall as the same on all of a plane only for cameras within so many diagonals.
MAX_DIAGONALS = 6.0


@by_content
@dataclass(frozen=True)
class _Place:
    """A camera's place (3,), its covariance, the scatter of the logarithms of the densities about its law, and the
    negative logarithm of its likelihood up to a constant."""

    eye: Floats
    covariance: Floats
    scatter: float
    unlikely: float


def camera_place(points: Floats) -> Floats | None:
    """Where the camera stood that took a cloud (N, 3), (3,) in its frame; None where the density does not tell."""
    counted = _densities(points)
    if counted is None:
        return None
    places, normals, density = counted
    middle, size = places.mean(axis=0), diagonal_mm(places)
    found = []
    for start in _directions(normals, density):
        for way in (start, -start):
            one = _followed((places - middle) / size, normals, np.log(density * size**2), START_DIAGONALS * way)
            if one is not None:
                found.append(one)
    if not found:
        return None
    again = min(found, key=lambda one: one.unlikely).eye
    polished = _followed((places - middle) / size, normals, np.log(density * size**2), again)
    found = sorted([*found, *([] if polished is None else [polished])], key=lambda one: one.unlikely)
    best = found[0]
    distance = float(np.linalg.norm(best.eye))
    direction = best.eye / max(distance, 1e-9)
    along = float(np.sqrt(direction @ best.covariance @ direction))
    across = float(np.sqrt(max(np.trace(best.covariance) - along**2, 0.0) / 2))
    others = [one.unlikely for one in found if vector_angle(one.eye, best.eye) > OTHER_RAD]
    if (
        best.scatter > MAX_SCATTER
        or across > MAX_ANGLE_SIGMA_RAD * distance
        or along > MAX_DISTANCE_SIGMA * distance
        or distance > MAX_DIAGONALS
        or (others and min(others) < best.unlikely + MIN_LOG_RATIO)
    ):
        return None
    return np.asarray(middle + size * best.eye)


def _densities(points: Floats) -> tuple[Floats, Floats, Floats] | None:
    """Places (M, 3) within smooth surfaces, normals of any sign (M, 3), and points a square millimetre there (M,)."""
    surfels = build_surfels(points, SURFEL_FRACTION * diagonal_mm(points))
    if len(surfels) < MIN_PLACES or len(points) < 10 * NEIGHBOURS:
        return None
    away, near = cKDTree(points).query(surfels.points, NEIGHBOURS)
    around = points[near]
    middle = around.mean(axis=1)
    offset = around - middle[:, None]
    values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", offset, offset) / NEIGHBOURS)
    radius = np.maximum(away[:, -1], 1e-9)
    rough = np.sqrt(np.maximum(values[:, 0], 0.0)) / radius
    good = np.linalg.norm(middle - surfels.points, axis=1) < MAX_OFF * radius
    good &= rough <= MAX_ROUGH * np.median(rough)
    if good.sum() < MIN_PLACES:
        return None
    return middle[good], vectors[good, :, 0], (NEIGHBOURS / (np.pi * radius**2))[good]


def _directions(normals: Floats, density: Floats) -> list[Floats]:
    """Likely directions (3,) to a far camera: for it the density is n.g; its sign stays open."""
    steps = np.array([-1.0, 0.0, 1.0])
    grid = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    axes = np.linalg.eigh(normals.T @ normals)[1]
    found: list[tuple[float, Floats]] = []
    for start in unit_vectors(grid[14:]) @ axes.T:
        way, weight = start, 1 / density
        for _ in range(LINEAR_ROUNDS):
            turned = normals * np.where(normals @ way < 0, -1.0, 1.0)[:, None]
            left = turned * weight[:, None]
            way = np.linalg.solve(left.T @ left + 1e-9 * np.eye(3), left.T @ (density * weight))
            off = 1 - turned @ way / density
            scatter = max(float(MAD_TO_STD * np.median(np.abs(off))), 1e-6)
            weight = np.maximum(1 - (off / (TUKEY * scatter)) ** 2, 0) / density
        way = way / max(float(np.linalg.norm(way)), 1e-12)
        if all(abs(way @ other) < np.cos(OTHER_RAD / 2) for _, other in found):
            found.append((scatter, way))
    found.sort(key=lambda one: one[0])
    return [way for _, way in found[:FOLLOWED]]


def _followed(places: Floats, normals: Floats, level: Floats, eye: Floats) -> _Place | None:
    """The place that explains the logarithms (M,) of the densities best, from a first one; lengths in diagonals.

    Gauss and Newton's steps on the six unknowns e and b, damped after Levenberg and Marquardt.
    """
    distance = float(np.linalg.norm(eye))
    height = np.median(np.log(np.maximum(np.abs(normals @ eye), 1e-3)) - level) / 3
    state = np.concatenate([eye, eye * np.exp(height) / distance**2])
    independent = min(len(places) / MIN_PLACES, 1.0) * MIN_PLACES
    damping = 1e-3
    off, rows, scatter = _misses(places, normals, level, state)
    aside, turned = _axis(state)
    unlikely = independent * np.log(scatter) + aside @ aside / 2
    for _ in range(ROUNDS):
        weight = np.maximum(1 - (off / (TUKEY * scatter)) ** 2, 0) ** 2 * independent / len(off) / scatter**2
        normal = rows.T @ (rows * weight[:, None]) + turned.T @ turned
        right = rows.T @ (weight * off) + turned.T @ aside
        step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)) + 1e-12 * np.eye(6), right)
        off_there, rows_there, scatter_there = _misses(places, normals, level, state - step)
        aside_there, turned_there = _axis(state - step)
        there = independent * np.log(scatter_there) + aside_there @ aside_there / 2
        if there < unlikely:
            gained = unlikely - there
            state, unlikely, damping = state - step, there, max(damping / 5, 1e-9)
            off, rows, scatter, aside, turned = off_there, rows_there, scatter_there, aside_there, turned_there
            if gained < 1e-3:
                break
        elif damping > 1e3:
            break
        else:
            damping *= 10
    if not np.isfinite(state).all():
        return None
    return _Place(state[:3], np.asarray(np.linalg.pinv(normal)[:3, :3], dtype=float), scatter, float(unlikely))


def _axis(state: Floats) -> tuple[Floats, Floats]:
    """The angle (3,) by which the axis passes the middle, in standard deviations, and its derivatives (3, 6)."""
    distance, length = float(np.linalg.norm(state[:3])), float(np.linalg.norm(state[3:]))
    across = np.eye(3) - np.outer(state[:3], state[:3]) / distance**2
    rows = np.hstack([np.zeros((3, 3)) - across * (state[3:] @ state[:3]) / (distance**2 * length), across / length])
    return across @ state[3:] / length / AXIS_SIGMA_RAD, rows / AXIS_SIGMA_RAD


def _misses(places: Floats, normals: Floats, level: Floats, state: Floats) -> tuple[Floats, Floats, float]:
    """By how much the law misses (M,), its derivatives (M, 6), and the scatter."""
    rays = state[:3] - places
    height = (normals * rays).sum(axis=1)
    normals = normals * np.where(height < 0, -1.0, 1.0)[:, None]
    height = np.maximum(np.abs(height), 1e-3)
    depth = np.maximum(rays @ state[3:], 1e-6)
    off = np.log(height) - 3 * np.log(depth) - level
    rows = np.hstack([normals / height[:, None] - 3 * state[3:] / depth[:, None], -3 * rays / depth[:, None]])
    return off, rows, max(float(MAD_TO_STD * np.median(np.abs(off))), 1e-6)
