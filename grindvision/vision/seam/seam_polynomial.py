"""Polynomials along a seam, of the lowest degree that is not worse than a higher one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtri

from grindvision.records import by_content
from grindvision.vision.seam.seam_smoothing import MAD_TO_STD, TUKEY

Floats = NDArray[np.float64]

#: Noise alone makes a higher degree look as much better in one of a hundred lines.
CHANCE = 0.01
#: Rounds of the robust fits.
ROUNDS = 3
#: With fewer independent stations than this beyond its coefficients nothing tells a polynomial from noise.
MIN_FREE = 2.0


@by_content
@dataclass(frozen=True)
class Polynomial:
    """``line`` (S, K), the polynomials at S stations, ``projection`` (S, S), which takes values to it, and ``degree``.

    ``told`` says that the degree was told from the noise: there were stations enough.
    """

    line: Floats
    projection: Floats
    degree: int
    told: bool


def fit_polynomial(values: Floats, weight: Floats, alike: float, degrees: tuple[int, int, int]) -> Polynomial:
    """Robust polynomials through values (S, K) with weights (S,), one degree for all K.

    Args:
        values: one row per station, at even distances.
        weight: (S,) inverse variances up to a factor, 0 where nothing is known.
        alike: so many neighbouring stations are as good as a single one.
        degrees: the lowest, the highest, and the one that is taken where there are too few stations to tell.
    """
    lowest, highest, untold = degrees
    highest = min(highest, max(len(values) // 4, lowest))
    basis = np.asarray(np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, len(values)), highest), dtype=float)
    count = values.shape[1]
    free = float((weight > 0).sum()) / alike - highest - 1
    if free <= MIN_FREE:
        degree = min(untold, highest)
        return _robust(basis[:, : degree + 1], values, weight, False)[0]
    best, share = _robust(basis, values, weight, True)
    squares = [_squares(basis[:, : q + 1], values, share) for q in range(highest + 1)]
    noise = squares[highest] / (count * free)
    chosen = highest
    for degree in range(highest - 1, lowest - 1, -1):
        more = np.arange(degree + 1, highest + 1) - degree
        gains = (squares[degree] - np.array(squares[degree + 1 :])) / (count * more)
        if (gains > fdtri(count * more, count * free, 1 - CHANCE) * noise).any():
            break
        chosen = degree
    return best if chosen == highest else _robust(basis[:, : chosen + 1], values, weight, True)[0]


def _squares(basis: Floats, values: Floats, share: Floats) -> float:
    """Weighted sum of squares that a basis (S, D) leaves of values (S, K)."""
    normal = basis.T @ (share[:, None] * basis)
    left = values - basis @ np.linalg.lstsq(normal, basis.T @ (share[:, None] * values), rcond=None)[0]
    return float((share[:, None] * left**2).sum())


def _robust(basis: Floats, values: Floats, weight: Floats, told: bool) -> tuple[Polynomial, Floats]:
    """Robust fit of values (S, K) by a basis (S, D), and the final weights (S,)."""
    even = weight / weight.max()
    share, shown = even, weight > 0
    line = projection = np.empty(0)
    for _ in range(ROUNDS):
        normal = basis.T @ (share[:, None] * basis)
        projection = basis @ np.linalg.lstsq(normal, basis.T * share, rcond=None)[0]
        line = projection @ values
        off = np.linalg.norm(values - line, axis=1)
        scale = max(TUKEY * MAD_TO_STD * float(np.median(off[shown])), 1e-9)
        last, share = share, even * np.maximum(1 - (off / scale) ** 2, 0) ** 2
    return Polynomial(line, projection, basis.shape[1] - 1, told), last
