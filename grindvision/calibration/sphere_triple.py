"""Three spheres of one diameter that rest together: told apart by their distances, they give a whole pose."""

from __future__ import annotations

from itertools import permutations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.calibration.sphere_search import OwnDiameter, cut_out_sphere, own_diameter
from grindvision.errors import AmbiguousError, DegenerateError
from grindvision.geometry import fit_rigid

Floats = NDArray[np.float64]

#: Sides of the triangle must differ by so much (mm), and it must be so high over its longest side (share).
MIN_DIFFERENCE_MM, MIN_HEIGHT = 4.0, 0.1

#: A view whose sides differ from those of the others by more (mm) shows other spheres.
SAME_SIDES_MM = 2.0


def find_three_spheres(
    points_camera: ArrayLike, diameter_mm: float, rng: np.random.Generator, name: str
) -> tuple[Floats, list[OwnDiameter]]:
    """Centres (3, 3) of three spheres of a diameter in a cloud (N, 3), mm, whatever else it shows, and the diameter
    that each has by its own points.

    Raises:
        DegenerateError: fewer than three such spheres in it.
    """
    left = np.asarray(points_camera, dtype=float)
    centres: list[Floats] = []
    own: list[OwnDiameter] = []
    while len(centres) < 3:
        try:
            found = cut_out_sphere(left, diameter_mm, rng, name)
        except DegenerateError as none:
            if not centres:
                raise
            raise DegenerateError(
                f"{name}: {len(centres)} of three spheres of diameter {diameter_mm:g} mm found; all three must be"
                " in view"
            ) from none
        centres.append(found.centre_mm)
        own.append(own_diameter(left, found))
        left = left[np.linalg.norm(left - found.centre_mm, axis=1) > 0.6 * diameter_mm]
    return np.array(centres), own


def poses_of_triples(centres: Floats, names: list[str]) -> Floats:
    """T_camera_target (N, 4, 4) of three spheres seen N times, centres (N, 3, 3) of each view in any order.

    The target's frame stands in the middle of the three: x to the first, the one opposite to the shortest side.

    Raises:
        AmbiguousError: two sides of the triangle are equal, so that the spheres cannot be told apart.
        DegenerateError: the three stand in a line; a view shows other spheres.
    """
    sides = np.sort(_sides(centres), axis=1)
    usual = np.median(sides, axis=0)
    if np.diff(usual).min() < MIN_DIFFERENCE_MM:
        told = ", ".join(f"{side:.1f}" for side in usual)
        raise AmbiguousError(
            f"the three spheres stand {told} mm apart: two distances are equal, and a turn or a mirror image of the"
            f" three looks alike; place them so that the distances differ by more than {MIN_DIFFERENCE_MM:g} mm"
        )
    half = usual.sum() / 2
    height = 2 * np.sqrt(max(half * np.prod(half - usual), 0.0)) / usual[2]
    if height < MIN_HEIGHT * usual[2]:
        raise DegenerateError(
            f"the three spheres stand in a line within {height:.1f} mm: the rotation about it is free; move one aside"
        )
    off = np.abs(sides - usual).max(axis=1)
    if off.max() > SAME_SIDES_MM:
        row = int(np.argmax(off))
        raise DegenerateError(
            f"{names[row]}: the three spheres found in it stand otherwise than in the other views, by {off[row]:.1f}"
            " mm; did one move, is another round thing of this size in view?"
        )
    model = _triangle(usual)
    return np.array([_pose(model, one) for one in centres])


def _sides(centres: Floats) -> Floats:
    """Lengths (N, 3) of the sides opposite to each of three points (N, 3, 3)."""
    return np.asarray(np.linalg.norm(np.roll(centres, -1, axis=1) - np.roll(centres, 1, axis=1), axis=2))


def _triangle(sides: Floats) -> Floats:
    """Corners (3, 3) of the triangle with these sides (3,) opposite to them, about its middle in the plane z = 0."""
    a, b, c = sides
    x = (b**2 + c**2 - a**2) / (2 * c)
    corners = np.array([[0.0, 0, 0], [c, 0, 0], [x, np.sqrt(max(b**2 - x**2, 0.0)), 0]])
    corners -= corners.mean(axis=0)
    x_axis = corners[0] / np.linalg.norm(corners[0])
    turn = np.array([x_axis, np.cross([0, 0, 1], x_axis), [0, 0, 1]])
    return np.asarray(corners @ turn.T)


def _pose(model: Floats, centres: Floats) -> Floats:
    """T_camera_target of one view: the order of its centres that the model fits best."""
    sides = _sides(model[None])[0]
    best = min(permutations(range(3)), key=lambda order: float(np.abs(_sides(centres[None, order])[0] - sides).sum()))
    return np.asarray(fit_rigid(model, centres[list(best)]).T_target_source)
