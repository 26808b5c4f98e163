"""Which cases a study measures, and which parameter mattered: one at a time, space-filling, ranked by regression."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from grindvision.errors import InputError

if TYPE_CHECKING:
    import pandas as pd


def one_at_a_time(base: Mapping[str, Any], levels: Mapping[str, Sequence[Any]], repeats: int) -> pd.DataFrame:
    """Cases that move one parameter through its levels while the others keep their ``base`` value.

    Returns one row per level and repeat: ``varied`` (the parameter's name), ``repeat`` (0 to ``repeats`` - 1) and the
    parameters.

    Raises:
        InputError: a varied parameter that ``base`` does not name.
    """
    import pandas as pd

    unknown = [name for name in levels if name not in base]
    if unknown:
        raise InputError(f"{unknown[0]!r} is varied but has no base value; base names {', '.join(base)}")
    rows = [
        {"varied": name, "repeat": repeat, **base, name: level}
        for name, values in levels.items()
        for level in values
        for repeat in range(repeats)
    ]
    return pd.DataFrame(rows)


def space_filling(ranges: Mapping[str, tuple[float, float]], cases: int, seed: int) -> pd.DataFrame:
    """Scrambled Sobol points in a box: ``cases`` rows, one column per parameter, each range covered evenly.

    A range whose ends are both whole numbers of type ``int`` gives whole numbers, both ends included.

    Raises:
        InputError: ``cases`` is no power of two (Sobol points are balanced only then), or a range is empty.
    """
    import pandas as pd
    from scipy.stats import qmc

    if cases < 2 or cases & (cases - 1):
        raise InputError(
            f"{cases} cases asked for; a Sobol design needs a power of two, such as {2 ** max(cases, 2).bit_length()}"
        )
    for name, (low, high) in ranges.items():
        if not low < high:
            raise InputError(f"the range of {name} is empty: {low} to {high}")
    unit = qmc.Sobol(len(ranges), scramble=True, rng=np.random.default_rng(seed)).random(cases)
    columns = {}
    for (name, (low, high)), column in zip(ranges.items(), unit.T, strict=True):
        whole = isinstance(low, int) and isinstance(high, int)
        columns[name] = low + np.floor(column * (high - low + 1)).astype(int) if whole else low + column * (high - low)
    return pd.DataFrame(columns)


def rank_sensitivity(
    parameters: pd.DataFrame, response: ArrayLike, rng: np.random.Generator, resamples: int = 100
) -> pd.DataFrame:
    """Share of the response's variance that each parameter explains by itself, most important first.

    The response is regressed on two orthogonal polynomials of each parameter, linear and quadratic. A share is what
    the model loses without one parameter's two terms; ``unexplained`` is the rest: noise, interactions and anything
    rougher. Shares are corrected for the number of terms, as an adjusted R^2 is: idle parameters scatter around zero.

    Returns:
        ``parameter, share, share_std, effect``: ``share_std`` comes from random halves of the cases; ``effect`` is the
        change of the response from the low to the high end of the range by the linear term, NaN in the last row.

    Raises:
        InputError: fewer than two cases per term, or lengths that differ.
    """
    import pandas as pd

    values = np.asarray(response, dtype=float)
    names = list(parameters.columns)
    if len(values) != len(parameters):
        raise InputError(f"{len(values)} responses for {len(parameters)} cases")
    scaled = parameters.to_numpy(dtype=float)
    low, high = scaled.min(axis=0), scaled.max(axis=0)
    scaled = 2 * (scaled - low) / (high - low) - 1
    terms = np.column_stack([np.ones(len(values)), scaled, 1.5 * scaled**2 - 0.5])
    if len(values) < 2 * terms.shape[1]:
        raise InputError(f"{len(values)} cases for {terms.shape[1]} terms; give at least {2 * terms.shape[1]}")
    count = len(names)
    groups = [[1 + i, 1 + count + i] for i in range(count)]
    shares = _shares(terms, values, groups)
    halves = [rng.permutation(len(values))[: len(values) // 2] for _ in range(resamples)]
    spread = np.array([_shares(terms[half], values[half], groups) for half in halves])
    effect = 2 * np.linalg.lstsq(terms, values, rcond=None)[0][1 : 1 + count]
    table = pd.DataFrame(
        {
            "parameter": [*names, "unexplained"],
            "share": shares,
            "share_std": spread.std(axis=0),
            "effect": [*effect, np.nan],
        }
    )
    own = table.iloc[:count].sort_values("share", ascending=False, kind="stable")
    return pd.concat([own, table.iloc[count:]], ignore_index=True)


def _shares(terms: np.ndarray, values: np.ndarray, groups: list[list[int]]) -> np.ndarray:
    """Variance shares of groups of terms by what leaving each out costs, adjusted for their number; the rest last."""
    total = np.var(values) * len(values)

    def left(columns: np.ndarray) -> float:
        return float(((values - columns @ np.linalg.lstsq(columns, values, rcond=None)[0]) ** 2).sum())

    full = left(terms)
    noise = full / (len(values) - terms.shape[1])
    lost = [left(np.delete(terms, group, axis=1)) - full - noise * len(group) for group in groups]
    return np.array([*lost, noise * len(values)]) / total
