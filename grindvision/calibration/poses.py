"""Which poses to measure: the subset that tells most, by greedy choice and exchange on the determinant (D-optimal)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import DegenerateError, InputError
from grindvision.parallel import one_blas_thread
from grindvision.records import by_content

Floats = NDArray[np.float64]


@by_content
@dataclass(frozen=True)
class PoseChoice:
    """``chosen`` (count,) numbers of candidates, ascending; ``log_determinant`` of their information, and at ``start``.

    Both in the combinations that the candidates together can tell; half the difference per combination is the
    logarithm by which the mean standard deviation shrinks against the random start.
    """

    chosen: NDArray[np.int64]
    log_determinant: float
    start_log_determinant: float
    exchanges: int

    def __str__(self) -> str:
        gain = self.log_determinant - self.start_log_determinant
        return f"{len(self.chosen)} poses chosen, {self.exchanges} exchanges, log determinant up by {gain:.2f}"


@one_blas_thread()
def choose_poses(
    designs: ArrayLike,
    count: int,
    rng: np.random.Generator,
    tolerance: float = 1e-4,
    rounds: int = 50,
) -> PoseChoice:
    """Choose ``count`` of C candidate poses so that the determinant of the information matrix is largest.

    Args:
        designs: (C, r, K) whitened rows that each candidate would add, columns scaled to comparable units.
        count: number of poses to choose.
        rng: draws the random start that the choice is compared with.
        tolerance: singular values below this fraction of the largest count as zero: such combinations are left out.
        rounds: exchange passes at most; one pass offers every chosen pose its best replacement.

    Raises:
        InputError: wrong shape or count. DegenerateError: ``count`` poses cannot tell what the candidates can.
    """
    blocks = np.asarray(designs, dtype=float)
    if blocks.ndim != 3 or not np.isfinite(blocks).all():
        raise InputError(
            f"candidate designs have shape {blocks.shape}; finite numbers (candidates, rows, unknowns) needed"
        )
    if not 1 <= count <= len(blocks):
        raise InputError(f"{count} poses asked for out of {len(blocks)} candidates")
    _, values, directions = np.linalg.svd(blocks.reshape(-1, blocks.shape[2]), full_matrices=False)
    rank = int((values > tolerance * values[0]).sum())
    if count * blocks.shape[1] < rank:
        raise DegenerateError(f"{count} poses give {count * blocks.shape[1]} rows for {rank} combinations; choose more")
    blocks = blocks @ (directions[:rank].T * (np.sqrt(len(blocks)) / values[:rank]))
    ridge = 1e-9 * np.eye(rank)
    squares = np.swapaxes(blocks, 1, 2) @ blocks
    start = rng.permutation(len(blocks))[:count]
    start_log = float(np.linalg.slogdet(squares[start].sum(axis=0) + ridge)[1])
    chosen: list[int] = []
    information = ridge.copy()
    for _ in range(count):
        best = _best_addition(blocks, information, chosen)
        chosen.append(best)
        information = information + squares[best]
    exchanges = 0
    for _ in range(rounds):
        changed = False
        for place, old in enumerate(chosen):
            without = ridge + squares[[c for c in chosen if c != old]].sum(axis=0)
            best = _best_addition(blocks, without, [c for c in chosen if c != old])
            gains = _gains(blocks[[old, best]], without)
            if best != old and gains[1] > gains[0] + 1e-9:
                chosen[place], changed = best, True
                exchanges += 1
        if not changed:
            break
    final = float(np.linalg.slogdet(squares[chosen].sum(axis=0) + ridge)[1])
    return PoseChoice(np.sort(np.array(chosen)), final, start_log, exchanges)


def _best_addition(blocks: Floats, information: Floats, taken: list[int]) -> int:
    gains = _gains(blocks, information)
    gains[taken] = -np.inf
    return int(np.argmax(gains))


def _gains(blocks: Floats, information: Floats) -> Floats:
    """Rise of the log determinant by each block: log det(I + B M^-1 B^T)."""
    solved = blocks @ np.linalg.inv(information)
    return np.linalg.slogdet(np.eye(blocks.shape[1]) + solved @ np.swapaxes(blocks, 1, 2))[1]
