"""Lengths of the arm that all come out wrong by one factor: the tracker's scale, which the fit absorbs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtr

from grindvision.arm import MdhArm
from grindvision.calibration.structure import Finding
from grindvision.calibration.unknowns import Unknowns, entry_name

Floats = NDArray[np.float64]

#: Chance of a factor as far from 1 where lengths deviate at random, and the smallest that is told; beyond the largest,
#: it is another unit or another arm.
FALSE_ALARM, MIN_SCALE, MAX_SCALE = 1e-3, 5e-4, 0.05

#: Lengths that are needed, and how exact (mm) each must be known.
MIN_LENGTHS, KNOWN_MM = 4, 1.0


def length_scale(
    arm: MdhArm, nominal: MdhArm, unknowns: Unknowns, known: NDArray[np.bool_], std: Floats
) -> tuple[Finding, ...]:
    """Find one factor between the lengths that were found and those of the robot table; none where they just deviate.

    With a reflector on the tool, the factor is all that a wrong scale of the tracker leaves: the table takes the rest.

    Args:
        arm, nominal: the calibrated arm and the one of the table.
        unknowns: of the fit, K numbers.
        known: flags (K,) of unknowns that the data tell.
        std: their standard deviations (K,), mm and rad.
    """
    entries = np.array(unknowns.table, dtype=int)
    in_table = np.flatnonzero(unknowns.in_table)
    chosen = np.isin(entries % 5, (1, 2)) & known[in_table] & (std[in_table] < KNOWN_MM)
    lengths, changes = nominal.table.ravel()[entries], (arm.table - nominal.table).ravel()[entries]
    count = int(chosen.sum())
    long = chosen & (np.abs(lengths) > 1.0)
    if count < MIN_LENGTHS or long.sum() < 2:
        return ()
    square = float((lengths[chosen] ** 2).sum())
    scale = float((lengths * changes)[chosen].sum()) / square
    left = float(((changes - scale * lengths)[chosen] ** 2).sum())
    ratio = abs(scale) / max(np.sqrt(left / (count - 1) / square), 1e-12)
    chance = 2 * float(stdtr(count - 1, -ratio))
    if chance > FALSE_ALARM or not MIN_SCALE < abs(scale) < MAX_SCALE:
        return ()
    rows = np.flatnonzero(long)[np.argsort(-np.abs(lengths[long]))][:3]
    told = ", ".join(f"{entry_name(int(entries[row]))} {changes[row]:+.2f}" for row in rows)
    bias = np.zeros(len(unknowns))
    bias[in_table[np.isin(entries % 5, (1, 2))]] = -scale * lengths[np.isin(entries % 5, (1, 2))]
    size = float(np.sqrt(((scale * lengths[chosen]) ** 2).mean()))
    explained = 1 - left / max(float((changes[chosen] ** 2).sum()), 1e-300)
    sentence = (
        f"the arm's lengths all come out {abs(scale):.2%} too {'long' if scale > 0 else 'short'} for the robot table"
        f" ({told}): the scale of what measured them (tracker, ball bar, distance of sockets) is off by as much, or"
        " the table is another arm's; measure a known length with it"
    )
    return (Finding("tracker scale", size, explained, chance, sentence, bias),)
