"""Smoothing splines on a grid of two or three axes: values with noise and holes in, a smooth field out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.optimize import minimize
from scipy.sparse.linalg import LinearOperator, cg

Floats = NDArray[np.float64]

#: Decades of stiffness that are searched, in units of the cubed spacing of an axis.
SEARCHED = (-4.0, 5.0)


def smooth_grid(values: Floats, weights: Floats, nodes: Sequence[Floats], stiffness: Floats) -> Floats:
    """Field on a grid that is near the values and bends little: a tensor-product smoothing spline at its nodes.

    It has the least sum of weighted squared differences plus, for each axis, ``stiffness`` times the integral of the
    squared second derivative along it. Straight fields cost nothing and pass unchanged.

    Args:
        values: of the grid; where the weight is 0 they do not count.
        weights: of the values, 0 to 1; 0 marks a hole.
        nodes: increasing coordinates along each axis.
        stiffness: of each axis (axes,), the cube of its unit; 0 does not smooth.
    """
    vectors, bends = _bends(nodes)
    penalty = sum(size * bend for size, bend in zip(stiffness, bends, strict=True))
    return _solved(weights, weights * values, vectors, penalty)


def draw_deviations(
    weights: Floats, nodes: Sequence[Floats], stiffness: Floats, count: int, rng: np.random.Generator
) -> Floats:
    """Fields (count, grid) by which ``smooth_grid`` may be off, drawn at random, for values whose noise is 1.

    The spline is the mean of a Gaussian field whose second derivatives are white noise of variance 1 / ``stiffness``,
    seen with noise of variance 1 / weight; these are draws of that field round its mean, so that holes and the space
    between nodes far apart come out as uncertain as they are.
    """
    vectors, bends = _bends(nodes)
    penalty = sum(size * bend for size, bend in zip(stiffness, bends, strict=True))
    draws = np.empty((count, *weights.shape))
    for draw in draws:
        seen = np.sqrt(weights) * rng.standard_normal(weights.shape)
        bend = on_axes(vectors, np.sqrt(penalty) * rng.standard_normal(weights.shape))
        draw[:] = _solved(weights, seen + bend, vectors, penalty)
    return draws


def freedom_left(weights: Floats, nodes: Sequence[Floats], stiffness: Floats) -> float:
    """Degrees of freedom that are left for the noise of the values beside the field, holes filled."""
    _, bends = _bends(nodes)
    penalty = sum(size * bend for size, bend in zip(stiffness, bends, strict=True))
    return float((penalty / (1 + penalty)).sum()) * float((weights > 0).mean())


def _solved(weights: Floats, right: Floats, vectors: list[Floats], penalty: Floats) -> Floats:
    """Field whose weights and bends, applied to it, give ``right``, by conjugate gradients."""

    def bent(flat: Floats) -> Floats:
        field = flat.reshape(weights.shape)
        return (weights * field + on_axes(vectors, penalty * on_axes(_turned(vectors), field))).ravel()

    def as_without_holes(flat: Floats) -> Floats:
        return on_axes(vectors, on_axes(_turned(vectors), flat.reshape(weights.shape)) / (1 + penalty)).ravel()

    size = (weights.size, weights.size)
    solution, _ = cg(
        LinearOperator(size, bent, dtype=float),
        right.ravel(),
        M=LinearOperator(size, as_without_holes, dtype=float),
        rtol=1e-6,
        maxiter=300,
    )
    return np.asarray(solution.reshape(weights.shape))


def fitting_stiffness(values: Floats, weights: Floats, nodes: Sequence[Floats]) -> Floats:
    """Stiffness (axes,) that the values themselves ask for, one for the last axis and one for all before it.

    It minimises the generalised cross-validation score, how badly each value is predicted by the others. Holes are
    first filled by a stiff field, then by the field found.
    """
    vectors, bends = _bends(nodes)
    across, along = sum(bends[:-1]), bends[-1]
    scale = np.array([np.diff(axis).mean() ** 3 if len(axis) > 1 else 0.0 for axis in nodes])
    stiffness = 10.0 ** SEARCHED[1] * scale
    for _ in range(2):
        filled = weights * values + (1 - weights) * smooth_grid(values, weights, nodes, stiffness)
        power = on_axes(_turned(vectors), filled) ** 2

        def score(decades: Floats, power: Floats = power) -> float:
            first, last = 10.0**decades * scale[[0, -1]]
            penalty = first * across + last * along
            lost = penalty / (1 + penalty)
            return np.log((lost**2 * power).sum()) - 2 * np.log(lost.mean())

        search = {"xatol": 0.05, "fatol": 1e-6, "initial_simplex": [[1.0, 1.0], [-1.0, 1.0], [1.0, -1.0]]}
        decades = minimize(score, [1.0, 1.0], method="Nelder-Mead", bounds=[SEARCHED] * 2, options=search).x
        first, last = 10.0**decades * scale[[0, -1]]
        stiffness = np.array([*[first] * (len(nodes) - 1), last])
    return stiffness


def on_axes(matrices: Sequence[Floats], values: Floats) -> Floats:
    """Values of a grid with one matrix applied along each axis."""
    for axis, matrix in enumerate(matrices):
        values = np.moveaxis(np.tensordot(matrix, values, (1, axis)), 0, axis)
    return values


def spline_matrix(nodes: Floats, at: Floats) -> Floats:
    """Matrix (M, N) that takes values at N nodes to those of the natural cubic spline through them at M places."""
    if len(nodes) == 1:
        return np.ones((len(at), 1))
    return CubicSpline(nodes, np.eye(len(nodes)), bc_type="natural")(at)


def roughness(nodes: Floats) -> Floats:
    """Matrix (N, N) whose quadratic form is the natural spline's integral of the squared second derivative."""
    gaps, n = np.diff(nodes), len(nodes)
    if n < 3:
        return np.zeros((n, n))
    rows = np.arange(n - 2)
    steps = np.zeros((n - 2, n))
    steps[rows, rows], steps[rows, rows + 2] = 1 / gaps[:-1], 1 / gaps[1:]
    steps[rows, rows + 1] = -1 / gaps[:-1] - 1 / gaps[1:]
    gram = np.diag(gaps[:-1] + gaps[1:]) / 3 + (np.diag(gaps[1:-1], 1) + np.diag(gaps[1:-1], -1)) / 6
    return steps.T @ np.linalg.solve(gram, steps)


def _bends(nodes: Sequence[Floats]) -> tuple[list[Floats], list[Floats]]:
    """Shapes of each axis (columns), and the roughness of each shape, laid along its axis of the grid."""
    vectors, bends = [], []
    for axis, places in enumerate(nodes):
        values, columns = np.linalg.eigh(roughness(places))
        values[: min(2, len(values))] = 0.0
        vectors.append(columns)
        bends.append(values.reshape([-1 if other == axis else 1 for other in range(len(nodes))]))
    return vectors, bends


def _turned(matrices: Sequence[Floats]) -> list[Floats]:
    return [matrix.T for matrix in matrices]
