"""Registration of scans whose instrument bends space a little: the pose together with a smooth cubic field.

A structured-light scanner errs by some hundredths of a millimetre, smoothly over its field, and differently on the part
in two poses. Least squares blames the pose for it: on a shallow part a few hundredths along the normal become tenths
across it. Here the distance along the normal may also differ by a cubic polynomial over the overlap, held small by a
prior of the size of what ICP leaves, so that only sharp relief decides about the motions across the surface.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.geometry import move_points, rigid, small_motion, turn_vectors
from grindvision.geometry.neighbours import build_cells, nearest
from grindvision.vision.icp import FineRegistration
from grindvision.vision.surfels import Surfels

Floats = NDArray[np.float64]

POWERS = tuple((a, b) for a in range(4) for b in range(4) if 2 <= a + b <= 3)
"""Exponents of the field's terms; the constant and linear ones are the pose's, and are taken out of the others."""

TUKEY = 4.685
BLOCKS_ACROSS = 12


def refine_bent(
    source: ArrayLike, source_normals: ArrayLike, target: Surfels, start: FineRegistration, iterations: int = 2
) -> FineRegistration:
    """Refine a registration of points (N, 3) with normals (N, 3) onto surfels, allowing for a smooth bending.

    The covariance of the result holds for correlated errors: blocks of a twelfth of the extent count as independent,
    not single residuals.
    """
    source, normals = np.asarray(source, dtype=float), np.asarray(source_normals, dtype=float)
    size = target.grid.size_mm
    transform = start.T_target_source
    prior = 1 * start.rms_mm
    for _ in range(iterations):
        moved = move_points(transform, source)
        match, distance = nearest(target.grid, moved, 2 * size)
        up = target.normals[match]
        residual = ((moved - target.points[match]) * up).sum(axis=1)
        used = (match >= 0) & ((turn_vectors(transform, normals) * up).sum(axis=1) > 0.7)
        used[used] &= distance[used] ** 2 - residual[used] ** 2 < (1.5 * size) ** 2
        moved, up, residual = moved[used], up[used], residual[used]
        centre = moved.mean(axis=0)
        design = np.column_stack([up, np.cross(moved - centre, up), _field(moved - centre)])
        solution, information, weights, spread = _robust(design, residual, prior)
        transform = rigid(None, centre) @ small_motion(solution[:6]) @ rigid(None, -centre) @ transform
    covariance = _block_covariance(moved, design, residual + design @ solution, weights, information)
    return replace(
        start, T_target_source=transform, rms_mm=spread, overlap=float(used.mean()), centre_mm=centre,
        iterations=start.iterations + iterations, covariance=covariance[:6, :6],
        mean_squares_mm2=np.append(start.mean_squares_mm2, spread**2),
    )  # fmt: skip


def _field(places: Floats) -> Floats:
    """Terms of the bending field (N, 7) at places (N, 3) about the middle, of order one over the cloud."""
    extent = np.sqrt((places**2).sum(axis=1).mean())
    _, axes = np.linalg.eigh(places.T @ places)
    u, v = places @ axes[:, 2] / extent, places @ axes[:, 1] / extent
    field = np.column_stack([u**a * v**b for a, b in POWERS])
    flat = np.linalg.qr(np.column_stack([np.ones_like(u), u, v]))[0]
    return field - flat @ (flat.T @ field)


def _robust(design: Floats, residual: Floats, prior: float) -> tuple[Floats, Floats, Floats, float]:
    """Least squares with Tukey's weights; all but the first six unknowns are held to zero within ``prior``."""
    solution = np.zeros(design.shape[1])
    for _ in range(3):
        left = residual + design @ solution
        spread = max(1.4826 * float(np.median(np.abs(left))), 1e-9)
        weights = np.clip(1 - (left / (TUKEY * spread)) ** 2, 0, None) ** 2
        information = design.T @ (design * weights[:, None])
        information[range(6, len(solution)), range(6, len(solution))] += (spread / max(prior, 1e-9)) ** 2
        scale = np.sqrt(np.diag(information)) + 1e-300
        solution = (
            -np.linalg.lstsq(
                information / np.outer(scale, scale), design.T @ (weights * residual) / scale, rcond=1e-10
            )[0]
            / scale
        )
    return solution, information, weights, spread


def _block_covariance(places: Floats, design: Floats, residual: Floats, weights: Floats, information: Floats) -> Floats:
    """Covariance of the unknowns when errors are alike within blocks of space and independent between them.

    The sandwich estimator: what each block pulls, squared, between two inverses of the information.
    """
    block = float(np.linalg.norm(np.ptp(places, axis=0))) / BLOCKS_ACROSS
    grid = build_cells(places, block)
    cells = np.repeat(np.arange(len(grid.starts) - 1), np.diff(grid.starts))
    pulls = (design * (weights * residual)[:, None])[grid.order]
    sums = np.column_stack([np.bincount(cells, pull) for pull in pulls.T])
    scale = np.sqrt(np.diag(information)) + 1e-300
    spread = np.linalg.pinv(information / np.outer(scale, scale), rcond=1e-12) @ (sums / scale).T
    return spread @ spread.T / np.outer(scale, scale)
