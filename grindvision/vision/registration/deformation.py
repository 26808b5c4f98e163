"""A smooth field of displacements over a part: a polynomial of low order in each of its components."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import DegenerateError
from grindvision.geometry import fit_rigid, inverse, rigid, rotate_vectors, small_motion
from grindvision.records import by_content

Floats = NDArray[np.float64]

INVERSE_STEPS, INVERSE_MM = 50, 1e-7
"""Steps of the fixed point that inverts a field, and the change at which it rests."""

MOTION_STEPS = 6
"""Steps to the motion nearest to a field along normals: the motion is not linear in its twist."""

FIRST = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
"""Exponents of the linear monomials, x first."""


@cache
def powers_of(order: int) -> tuple[tuple[int, int, int], ...]:
    """Exponents of x, y, z of all monomials up to an order, lowest first."""
    every = [(a, b, c) for a, b, c in product(range(order + 1), repeat=3) if a + b + c <= order]
    return tuple(sorted(every, key=lambda powers: (sum(powers), powers)))


@by_content
@dataclass(frozen=True)
class Deformation:
    """A polynomial field of displacements in the frame of a test scan, mm: p + v(p) is the point p of the bent part as
    it lay on the unbent one.

    ``coefficients`` (K, 3) of the monomials in (p - ``centre_mm``) / ``scale_mm`` up to ``order``; ``covariance``
    (3K, 3K) of them, row by row. Beyond the box of what was fitted, ``half_mm`` (3,) about the centre, the displacement
    is that of the nearest place in it.
    """

    order: int
    centre_mm: Floats
    scale_mm: float
    half_mm: Floats
    coefficients: Floats
    covariance: Floats

    def terms(self, points: Floats) -> Floats:
        """Monomials (N, K) at points (N, 3)."""
        powers = powers_of(self.order)
        at = np.clip(points - self.centre_mm, -self.half_mm, self.half_mm) / self.scale_mm
        one_by_one = [np.stack([at[:, axis] ** power for power in range(self.order + 1)]) for axis in range(3)]
        return np.stack([one_by_one[0][a] * one_by_one[1][b] * one_by_one[2][c] for a, b, c in powers], axis=1)

    def displacements(self, points: ArrayLike) -> Floats:
        """v (N, 3) in mm at points (N, 3) of the test part."""
        return np.asarray(self.terms(np.asarray(points, dtype=float)) @ self.coefficients)

    def gradients(self, points: Floats) -> Floats:
        """Derivatives (N, 3, 3) of the displacements: row by component, column by axis."""
        at = np.clip(points - self.centre_mm, -self.half_mm, self.half_mm) / self.scale_mm
        found = np.zeros((len(points), 3, 3))
        for power, coefficient in zip(powers_of(self.order), self.coefficients, strict=True):
            for axis in range(3):
                lower = np.array(power)
                lower[axis] -= 1
                if lower[axis] >= 0:
                    slope = power[axis] / self.scale_mm * np.prod(at**lower, axis=1)
                    found[:, :, axis] += slope[:, None] * coefficient
        return found

    def bent(self, straight: Floats) -> Floats:
        """Points (N, 3) of the unbent part where the bent one has them: the inverse of p + v(p).

        Raises:
            DegenerateError: the field folds the surface there.
        """
        points = straight - self.displacements(straight)
        for _ in range(INVERSE_STEPS):
            moved = straight - self.displacements(points)
            step = float(np.abs(moved - points).max(initial=0.0))
            points = moved
            if step < INVERSE_MM:
                return points
        raise DegenerateError(f"the deformation folds the surface: its inverse is still {step:.2g} mm off")

    def variances(self, points: Floats, normals: Floats) -> Floats:
        """Variances (N,) in mm2 of the displacements along unit normals (N, 3)."""
        design = along_normals(self.terms(points), normals)
        return np.einsum("ij,ij->i", design @ self.covariance, design)

    def stretches(self, points: Floats) -> Floats:
        """Volume elements (N,) of p + v(p): 1 where nothing is stretched."""
        return np.asarray(np.linalg.det(np.eye(3) + self.gradients(points)))

    def less_motion(self, motion: Floats) -> Deformation:
        """The field w that is left of this one, v, beside a rigid motion (4, 4): M (p + w(p)) = p + v(p)."""
        rotation, translation = motion[:3, :3], motion[:3, 3]
        left = self.coefficients @ rotation  # rows of R^T (v - t) + R^T p - p
        powers = powers_of(self.order)
        left[powers.index((0, 0, 0))] += (self.centre_mm - translation) @ rotation - self.centre_mm
        for axis, one in enumerate(FIRST):
            left[powers.index(one)] += self.scale_mm * (rotation[axis] - np.eye(3)[axis])
        return replace(self, coefficients=left)

    def nearest_motion(self, points: Floats, normals: Floats | None = None) -> Floats:
        """The rigid motion (4, 4) nearest to p + v(p) over points (N, 3); along their normals (N, 3), where given: what
        a best fit of the surfaces finds."""
        moved = points + self.displacements(points)
        if normals is None:
            return fit_rigid(points, moved).T_target_source
        motion, centre = np.eye(4), points.mean(axis=0)
        arms = points - centre
        design = np.column_stack([normals, np.cross(arms, normals)])
        for _ in range(MOTION_STEPS):
            left = rotate_vectors(inverse(motion), moved - motion[:3, 3]) - points
            twist = np.linalg.lstsq(design, (normals * left).sum(axis=1), rcond=1e-9)[0]
            motion = motion @ rigid(None, centre) @ small_motion(twist) @ rigid(None, -centre)
        return motion


def along_normals(terms: Floats, normals: Floats) -> Floats:
    """Derivatives (N, 3K) of displacements along normals (N, 3) by the coefficients (K, 3), from terms (N, K)."""
    return (terms[:, :, None] * normals[:, None, :]).reshape(len(terms), -1)


def zero_field(order: int, points: Floats) -> Deformation:
    """No displacement, as a field of an order about the box of points (N, 3)."""
    low, high = points.min(axis=0), points.max(axis=0)
    count = len(powers_of(order))
    half = (high - low) / 2
    scale = float(np.linalg.norm(half))
    return Deformation(order, (low + high) / 2, scale, half, np.zeros((count, 3)), np.zeros((3 * count, 3 * count)))


def raised(field: Deformation, order: int) -> Deformation:
    """The same field written as one of a higher order, without its covariance."""
    count = len(powers_of(order))
    coefficients = np.zeros((count, 3))
    coefficients[: len(field.coefficients)] = field.coefficients
    return replace(field, order=order, coefficients=coefficients, covariance=np.zeros((3 * count, 3 * count)))
