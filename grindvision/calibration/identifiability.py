"""What the measurements can tell: rank, confounded parameters in words, observability indices, correlations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import qr

from grindvision.errors import InputError
from grindvision.records import by_content

Floats = NDArray[np.float64]


@by_content
@dataclass(frozen=True)
class Identifiability:
    """Rank and null space of a whitened design matrix whose K columns were scaled to comparable units.

    ``singular_values`` (K,) of the scaled matrix, largest first: 1 / value is the standard deviation, in those units,
    of the combination it belongs to. ``null_space`` (K, K - rank) in the unknowns' own units, one free combination a
    column, as sparse as elimination makes it. ``known`` (K,) marks unknowns that stand in no free combination.
    ``sentences`` say the same in words. ``rank_qr`` is the rank by QR with column pivoting, a second opinion.
    """

    names: tuple[str, ...]
    singular_values: Floats
    rank: int
    rank_qr: int
    null_space: Floats
    known: NDArray[np.bool_]
    sentences: tuple[str, ...]

    @property
    def observability(self) -> dict[str, float]:
        """Observability indices O1-O5 of the combinations that can be known (larger is better), in scaled units."""
        s = self.singular_values[: self.rank]
        return {
            "O1": float(np.exp(np.log(s).mean())),
            "O2": float(s[-1] / s[0]),
            "O3": float(s[-1]),
            "O4": float(s[-1] ** 2 / s[0]),
            "O5": float(1 / np.sum(1 / s)),
        }

    def __str__(self) -> str:
        return f"{self.rank} of {len(self.names)} unknowns can be told apart; " + "; ".join(self.sentences or ("all",))


def analyse(
    design: ArrayLike,
    names: tuple[str, ...],
    units: ArrayLike,
    worst_std: float = np.inf,
    tolerance: float = 1e-9,
) -> Identifiability:
    """Find what a whitened design matrix (rows, K) can tell, its columns counted in ``units`` (K,).

    A combination counts as known if its singular value is above ``tolerance`` times the largest **and** its standard
    deviation is at most ``worst_std`` units: what the data know ten times worse than a drawing is not known.

    Raises:
        InputError: shapes differ.
    """
    matrix = np.asarray(design, dtype=float)
    units = np.asarray(units, dtype=float)
    if matrix.ndim != 2 or matrix.shape[1] != len(names) or units.shape != (len(names),):
        raise InputError(f"design {matrix.shape} and units {units.shape} do not fit {len(names)} names")
    # The triangle of the QR decomposition has the same singular values, right singular vectors and column norms.
    triangle = np.linalg.qr(matrix * units, mode="r")
    values, rows = np.linalg.svd(triangle, full_matrices=True)[1:]
    values = np.concatenate([values, np.zeros(len(names) - len(values))])
    min_value = max(tolerance * values[0], 1 / worst_std)
    rank = int((values > min_value).sum())
    diagonal = np.abs(np.diag(qr(triangle, mode="r", pivoting=True)[0]))
    null_space = _sparse_basis(rows[rank:].T)
    known = np.abs(null_space).max(axis=1, initial=0) < 1e-3
    null_space = null_space * units[:, None]
    sentences = _sentences(null_space, names)
    return Identifiability(names, values, rank, int((diagonal > min_value).sum()), null_space, known, sentences)


def correlations(covariance: ArrayLike, known: ArrayLike) -> Floats:
    """Correlation matrix (K, K) of a covariance (K, K); NaN in rows and columns that are not ``known`` (K,)."""
    covariance = np.asarray(covariance, dtype=float)
    known = np.asarray(known, dtype=bool)
    std = np.sqrt(np.where(known, np.diag(covariance), np.nan))
    return covariance / np.outer(std, std)


def _sparse_basis(basis: Floats) -> Floats:
    """Reduced echelon form of a null space (K, m): a column has a 1 where the others have 0; small entries cleared.

    Columns stand in the order of the unknowns in them: the order of elimination is a matter of rounding.
    """
    echelon = basis.copy()
    pivots: list[int] = []
    for column in range(echelon.shape[1]):
        rest = np.abs(echelon[:, column:]).max(axis=1)
        rest[pivots] = 0
        pivot = int(np.argmax(rest > 0.5 * rest.max()))
        pivots.append(pivot)
        row = echelon[pivot, column:]
        swap = column + int(np.argmax(np.abs(row)))
        echelon[:, [column, swap]] = echelon[:, [swap, column]]
        echelon[:, column] /= echelon[pivot, column]
        others = [c for c in range(echelon.shape[1]) if c != column]
        echelon[:, others] -= np.outer(echelon[:, column], echelon[pivot, others])
    echelon[np.abs(echelon) < 1e-2 * np.abs(echelon).max(axis=0, initial=1e-300)] = 0
    return echelon[:, sorted(range(len(pivots)), key=lambda column: np.flatnonzero(echelon[:, column]).tolist())]


def _sentences(null_space: Floats, names: tuple[str, ...]) -> tuple[str, ...]:
    """One sentence per free combination; pairs that exchange within one sum, as d2, d3 and d4 do, share a sentence."""
    sums: dict[int, list[int]] = {}
    sentences = {}
    for number, column in enumerate(null_space.T):
        inside = np.flatnonzero(column)
        units = {names[i].rsplit("_", 1)[1] for i in inside}
        if len(inside) == 2 and len(units) == 1 and abs(column[inside].sum()) < 0.02 * np.abs(column).max():
            joined = next((key for key, members in sums.items() if set(inside) & set(members)), number)
            sums[joined] = sorted(set(sums.get(joined, [])) | set(inside.tolist()))
        else:
            sentences[number] = _in_words(column, names)
    for number, members in sums.items():
        sentences[number] = f"{_listed([_short(names[i]) for i in members])} only as a sum"
    return tuple(sentences[number] for number in sorted(sentences))


def _short(name: str) -> str:
    return name.rsplit("_", 1)[0].replace("_", " ")


def _listed(words: list[str]) -> str:
    return f"{', '.join(words[:-1])} and {words[-1]}"


def _in_words(column: Floats, names: tuple[str, ...]) -> str:
    scale = np.abs(column)
    inside = [i for i in np.argsort(-scale, kind="stable") if scale[i] > 0]
    short = [_short(names[i]) for i in sorted(inside)]
    if len(inside) == 1:
        return f"{short[0]} moves no measured point: it cannot be known"
    same_unit = len({names[i].rsplit("_", 1)[1] for i in inside}) == 1
    if len(inside) == 2:
        first, second = column[sorted(inside)]
        if same_unit and abs(first / second - 1) < 0.02:
            return f"{short[0]} and {short[1]} only as a difference"
        return f"{short[0]} and {short[1]} only together"
    return f"{_listed(short)} only in combination"
