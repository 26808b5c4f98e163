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
from scipy.linalg import eigh

from grindvision.geometry import motion_columns, move_points, rigid, rotate_vectors, small_motion, twist_between
from grindvision.geometry.hash_grid import build_cells
from grindvision.vision.registration.icp import FineRegistration
from grindvision.vision.registration.rivals import MOTION_STEPS
from grindvision.vision.surface.signed_distance import CellBlocks, signed_distances
from grindvision.vision.surface.surfels import Surfels

Floats = NDArray[np.float64]

POWERS = tuple((a, b) for a in range(4) for b in range(4) if 2 <= a + b <= 3)
"""Exponents of the field's terms; the constant and linear ones are the pose's, and are taken out of the others."""

TUKEY = 4.685
BLOCKS_ACROSS = 12
CLEARLY_HELD = 0.9
"""Along a motion that the normals of both scans resist alike by this fraction, the covariance stays as it is."""

KNOWN_FROM_RIVALS = 1 / MOTION_STEPS
"""Poses all along a motion that hardly anything resists are judged by what they hide and show, in steps of twice this
fraction of the extent: the standard deviation along it is no larger."""

AT_REST = 1e-3
"""A step that moves the points by a smaller part of the residuals' spread is the last: the next one would move them by
a thirtieth of it, less than where single points come and go beside the target's edge."""


def refine_bent(
    source: ArrayLike,
    source_normals: ArrayLike,
    target: Surfels,
    start: FineRegistration,
    iterations: int = 60,
    min_spread_mm: float = 1e-9,
) -> FineRegistration:
    """Refine a registration of points (N, 3) with normals (N, 3) onto surfels, allowing for a smooth bending.

    It ends when the pose rests, by ``AT_REST`` of the residuals' spread, and so does not depend on where it began.

    The covariance of the result holds for correlated errors: blocks of a twelfth of the extent count as independent,
    not single residuals. The hidden covariance guesses, from the bends that show, at the part of the field that looks
    like a motion: a constant and two slopes; and it holds how far the bending moved the pose from ``start``, where ICP
    without it came to rest: along motions that the surface hardly resists, either may be right. What moves both scans
    alike (a scale error, an offset of the depth) leaves no trace in either and is in none of them. Residuals within a
    few times ``min_spread_mm`` count, however little most of them spread.
    """
    source, normals = np.asarray(source, dtype=float), np.asarray(source_normals, dtype=float)
    size = target.grid.size_mm
    transform = start.T_target_source
    prior = start.rms_mm
    done, rests = 0, False
    blocks = CellBlocks.unknown(len(source))
    while done < iterations and not rests:
        moved = move_points(transform, source)
        residual, up, variance = signed_distances(target, moved, 2 * size, blocks)
        used = ~np.isnan(residual) & ((rotate_vectors(transform, normals) * up).sum(axis=1) > 0.7)
        moved, up, residual, variance = moved[used], up[used], residual[used], variance[used]
        centre = moved.mean(axis=0)
        hidden, bends = _fields(moved - centre)
        design = np.column_stack([up, np.cross(moved - centre, up), bends])
        solution, information, weights, spread = _robust(design, residual, variance, prior, min_spread_mm)
        transform = rigid(None, centre) @ small_motion(solution[:6]) @ rigid(None, -centre) @ transform
        done += 1
        shift = np.abs(solution[:3]).max() + np.abs(solution[3:6]).max() * np.abs(moved - centre).max()
        rests = shift < AT_REST * spread
    mistaken = _solved(information, design.T @ (weights[:, None] * hidden))[:6] * _hidden_sizes(solution[6:])
    mistaken = np.column_stack([mistaken, twist_between(start.T_target_source, transform, centre)])
    covariance = block_covariance(moved, design, residual + design @ solution, weights, information)[:6, :6]
    turned = rotate_vectors(transform, normals[used])
    of_source = np.column_stack([turned, np.cross(moved - centre, turned)])
    covariance = _held_by_both(covariance, moved - centre, of_source, design[:, :6], weights)
    return replace(
        start, T_target_source=transform, rms_mm=spread, overlap=float(used.mean()), centre_mm=centre,
        iterations=start.iterations + done, covariance=covariance,
        hidden_covariance=mistaken @ mistaken.T,
        mean_squares_mm2=np.append(start.mean_squares_mm2, spread**2),
    )  # fmt: skip


def _fields(places: Floats) -> tuple[Floats, Floats]:
    """Fields (N, 3) that look like a motion and bends (N, 7), at places (N, 3) about the middle; each of unit rms, and
    none holds a part of another."""
    extent = np.sqrt((places**2).sum(axis=1).mean())
    _, axes = np.linalg.eigh(places.T @ places)
    u, v = places @ axes[:, 2] / extent, places @ axes[:, 1] / extent
    terms = np.column_stack([np.ones_like(u), u, v, *(u**a * v**b for a, b in POWERS)])
    # by the root of their products: a tenth of the time of a QR decomposition; the last term: points in one line
    terms /= np.sqrt((terms**2).mean(axis=0)) + 1e-300
    products = terms.T @ terms / len(places) + 1e-12 * np.eye(terms.shape[1])
    terms = terms @ np.linalg.inv(np.linalg.cholesky(products)).T
    return terms[:, :3], terms[:, 3:]


def _hidden_sizes(bends: Floats) -> Floats:
    """Sizes (3,) in mm of the constant and the two slopes, from the bends (7,): a smooth field grows from degree to
    degree towards the low ones as it does from degree three to two; by once to twice, as seven terms do not tell it
    better."""
    degrees = np.array([a + b for a, b in POWERS])
    second, third = ((bends[degrees == degree] ** 2).mean() for degree in (2, 3))
    growth = np.clip(second / max(third, 1e-12), 1.0, 4.0)
    return np.sqrt(second * growth ** np.array([2.0, 1.0, 1.0]))


def _robust(
    design: Floats, residual: Floats, variance: Floats, prior: float, min_spread: float
) -> tuple[Floats, Floats, Floats, float]:
    """Least squares with Tukey's weights; all but the first six unknowns are held to zero within ``prior``.

    ``variance`` (N,) of the target's surface adds to the residuals' own: edges, where it is ill known, weigh less.
    """
    common = (1.4826 * float(np.median(np.abs(residual)))) ** 2 + 1e-18
    trust = common / (common + variance)
    solution = np.zeros(design.shape[1])
    for _ in range(3):
        left = residual + design @ solution
        spread = max(1.4826 * float(np.median(np.abs(left))), min_spread)
        weights = trust * np.clip(1 - trust * (left / (TUKEY * spread)) ** 2, 0, None) ** 2
        information = design.T @ (design * weights[:, None])
        information[range(6, len(solution)), range(6, len(solution))] += (spread / max(prior, 1e-9)) ** 2
        solution = -_solved(information, design.T @ (weights * residual)[:, None])[:, 0]
    return solution, information, weights, spread


def _held_by_both(covariance: Floats, arms: Floats, source: Floats, target: Floats, weights: Floats) -> Floats:
    """The covariance (6, 6) of a pose, larger along the motions that the errors of the normals alone seem to hold.

    Rows (N, 6) are derivatives of the residuals by the motion, taken with the ``source``'s normals and the
    ``target``'s, at ``arms`` (N, 3) from the centre. The target's information is a sum of squares, and each error of a
    normal adds to it: a plane slid along itself seems held. The errors of the two scans are independent, so products of
    one scan's row with the other's hold the part that the surface itself has. Along a motion of which this is a
    fraction of the whole, a standard deviation is larger by its inverse, up to ``KNOWN_FROM_RIVALS``.
    """
    if not np.isfinite(covariance).all():
        return covariance
    extent = np.sqrt((arms**2).sum(axis=1).mean())
    scale = np.array([1, 1, 1, 1 / extent, 1 / extent, 1 / extent])
    source, target = source * scale, target * scale
    information, shared = target.T @ (target * weights[:, None]), source.T @ (target * weights[:, None])
    information += 1e-9 * np.trace(information) * np.eye(6)
    fractions, motions = eigh(0.5 * (shared + shared.T), information)
    back = motions.T @ information / scale
    moves = np.sqrt(((motion_columns(arms) @ (scale[:, None] * motions)) ** 2).sum(axis=1).mean(axis=0))
    sigmas = np.sqrt(np.maximum(np.diag(back @ covariance @ back.T), 1e-300)) * moves
    most = np.maximum(KNOWN_FROM_RIVALS * extent / sigmas, 1)
    larger = np.where(fractions < CLEARLY_HELD, np.minimum(1 / np.maximum(fractions, 1e-9), most), 1.0)
    change = scale[:, None] * (motions * larger) @ back
    return change @ covariance @ change.T


def block_covariance(
    places: Floats, design: Floats, residual: Floats, weights: Floats, information: Floats, across: int = BLOCKS_ACROSS
) -> Floats:
    """Covariance of the unknowns when errors are alike within blocks of space and independent between them.

    ``design`` (N, k), ``residual`` (N,) and ``weights`` (N,) belong to a fit with ``information`` (k, k) to points at
    ``places`` (N, 3), along whose diagonal ``across`` blocks lie.

    The jackknife: how far the unknowns move when a block is left out, squared, summed over the blocks. Few blocks, the
    steep ones, decide about motions across the surface; the sandwich estimator takes their fit for their truth.
    """
    block = float(np.linalg.norm(np.ptp(places, axis=0))) / across
    grid = build_cells(places, block)
    left, pulls = [], []
    for members in np.split(grid.order, grid.starts[1:-1]):
        rows, weighted = design[members], design[members] * weights[members, None]
        left.append(information - rows.T @ weighted)
        pulls.append(weighted.T @ residual[members, None])
    moves = _solved(np.array(left), np.array(pulls))[..., 0]
    return moves.T @ moves


def _solved(information: Floats, right: Floats) -> Floats:
    """Least solutions (..., k, m) of normal equations (..., k, k), mm and radians made comparable first."""
    scale = np.sqrt(np.maximum(np.diagonal(information, axis1=-2, axis2=-1), 1e-300))
    sizes = scale[..., :, None] * scale[..., None, :]
    return np.linalg.pinv(information / sizes, rcond=1e-12, hermitian=True) / sizes @ right
