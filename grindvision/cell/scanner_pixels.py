"""Compiled passes over the pixels of a scanner: their rays, what these meet, and what the errors make of it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from grindvision.kernels import njit

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


@njit(cache=True)
def directions(x: Floats, y: Floats, rotation: Floats) -> Floats:
    """Rays (x, y, 1) of all columns ``x`` (C,) and rows ``y`` (R,), row by row and turned by ``rotation``: (R C, 3)."""
    directions = np.empty((len(y) * len(x), 3))
    for i in range(len(y)):
        for j in range(len(x)):
            for k in range(3):
                directions[i * len(x) + j, k] = x[j] * rotation[k, 0] + y[i] * rotation[k, 1] + rotation[k, 2]
    return directions


@njit(cache=True)
def seen(
    ray: Integers, z: Floats, facing: Floats, x: Floats, y: Floats, rotation: Floats, baseline_mm: float
) -> tuple[Integers, Floats, Floats, Floats]:
    """Pixels (N, 2), points and normals (N, 3) in the scanner frame and incidence (N,) of the hits of ``directions``.

    The hits lie at depths ``z`` (N,) and have the normals ``facing`` (N, 3) in the target's frame. Incidence is the
    larger angle in radians between the normal and the ways to the camera and to the projector.
    """
    pixels = np.empty((len(ray), 2), dtype=np.int64)
    points, normals, incidence = np.empty((len(ray), 3)), np.empty((len(ray), 3)), np.empty(len(ray))
    for i in range(len(ray)):
        row = ray[i] // len(x)
        column = ray[i] - row * len(x)
        pixels[i, 0], pixels[i, 1] = column, row
        points[i, 0], points[i, 1], points[i, 2] = x[column] * z[i], y[row] * z[i], z[i]
        for k in range(3):
            normals[i, k] = (
                facing[i, 0] * rotation[0, k] + facing[i, 1] * rotation[1, k] + facing[i, 2] * rotation[2, k]
            )
        to_camera = -(points[i, 0] * normals[i, 0] + points[i, 1] * normals[i, 1] + z[i] * normals[i, 2])
        to_projector = to_camera + baseline_mm * normals[i, 0]
        aside = points[i, 1] ** 2 + z[i] ** 2
        cosine = min(
            to_camera / np.sqrt(points[i, 0] ** 2 + aside),
            to_projector / np.sqrt((points[i, 0] - baseline_mm) ** 2 + aside),
        )
        incidence[i] = np.arccos(min(max(cosine, -1.0), 1.0))
    return pixels, points, normals, incidence


@njit(cache=True)
def depth_steps(z: Floats, pixels: Integers, shape: tuple[int, int]) -> Floats:
    """The larger of the steps (N,) in depth from pixels (N, 2) to their neighbours to the right and below."""
    grid = np.full((shape[0] + 1, shape[1] + 1), np.nan)
    for i in range(len(z)):
        grid[pixels[i, 1], pixels[i, 0]] = z[i]
    steps = np.zeros(len(z))
    for i in range(len(z)):
        column, row = pixels[i, 0], pixels[i, 1]
        aside, below = grid[row, column + 1] - z[i], grid[row + 1, column] - z[i]
        for step in (below, aside):
            if abs(step) >= abs(steps[i]):
                steps[i] = step
    return steps


@njit(cache=True)
def moved(true_points: Floats, z: Floats, off: Floats, white: Floats, product: float, step_px: float) -> Floats:
    """Points (N, 3) on the rays of the true ones: at depth ``z`` plus ``off``, and moved by ``white`` along the ray.

    Where ``step_px`` is not zero, the disparity, ``product`` (focal length times baseline, px mm) by depth, is read out
    in such steps.
    """
    points = np.empty_like(true_points)
    for i in range(len(z)):
        x, y = true_points[i, 0] / true_points[i, 2], true_points[i, 1] / true_points[i, 2]
        depth = z[i] + off[i] + white[i] / np.sqrt(x * x + y * y + 1)
        if step_px > 0:
            depth = product / (step_px * np.round(product / depth / step_px))
        points[i, 0], points[i, 1], points[i, 2] = x * depth, y * depth, depth
    return points


def correlated(shape: tuple[int, int], length: float, rng: np.random.Generator) -> Floats:
    """Unit-variance noise (rows, columns): white noise smoothed by a Gaussian of sigma ``length`` pixels."""
    noise = gaussian_filter(rng.standard_normal(shape), length, mode="wrap", truncate=3.0)
    return noise * np.sqrt(max(4 * np.pi * length**2, 1.0))
