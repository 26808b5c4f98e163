"""Sums over the points around stations along a bead, from which the cross-sections of its ridge are fitted."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from grindvision.kernels import njit

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

REACH_WIDTHS = 1.2
"""A station's cross-section is fitted to what lies within so many widths of it along the bead."""

FLANK = 0.2
"""A flank begins so many widths to the side of the ridge."""


class Sections(NamedTuple):
    """Sums over the points around each of M stations, weighted by their nearness along the bead (``ridge_path``).

    ``counts`` (M,) of points; ``normal`` (M, 8, 8) and ``right`` (M, 8): equations of the section's terms 1, s, s^2,
    s b, b, b^2, b^3, b^4, in widths; ``flanks`` (M, 2): shares of the weight that lie to either side of the ridge;
    ``up`` and ``offset`` (M, 3): means of the surface's normals and of the feet's offsets from the station's curve.
    """

    counts: Integers
    normal: Floats
    right: Floats
    flanks: Floats
    up: Floats
    offset: Floats

    def at(self, stations: NDArray[np.bool_]) -> Sections:
        """The sums of those stations (M,) that are marked."""
        return Sections(
            self.counts[stations],
            self.normal[stations],
            self.right[stations],
            self.flanks[stations],
            self.up[stations],
            self.offset[stations],
        )


@njit(cache=True, nogil=True)
def sums_of_sections(
    s: Floats, b: Floats, h: Floats, up: Floats, offsets: Floats, arcs: Floats, width: float, around_mm: float
) -> Sections:
    """``Sections`` at stations with arc lengths ``arcs`` (M,), of points with s, b, h (N,), normals and offsets
    (N, 3).

    ``around_mm`` is the length of a closed curve, infinite for an open one.
    """
    stations = len(arcs)
    found = Sections(
        np.zeros(stations, dtype=np.int64),
        np.zeros((stations, 8, 8)),
        np.zeros((stations, 8)),
        np.zeros((stations, 2)),
        np.zeros((stations, 3)),
        np.zeros((stations, 3)),
    )
    term = np.empty(8)
    for m in range(stations):
        normal, right = found.normal[m], found.right[m]
        total = 0.0
        for p in range(len(s)):
            along, across = s[p] - arcs[m], b[p] / width
            if along > around_mm / 2:
                along -= around_mm
            elif along < -around_mm / 2:
                along += around_mm
            near = abs(along) / (REACH_WIDTHS * width)
            if near >= 1 or abs(across) >= 0.5:
                continue
            weight = (1 - near**3) ** 3
            along /= width
            term[0], term[1], term[2], term[3] = 1.0, along, along * along, along * across
            term[4] = across
            for k in range(5, 8):
                term[k] = term[k - 1] * across
            for i in range(8):
                for j in range(i, 8):
                    normal[i, j] += weight * term[i] * term[j]
                right[i] += weight * term[i] * h[p]
            for k in range(3):
                found.up[m, k] += weight * up[p, k]
                found.offset[m, k] += weight * offsets[p, k]
            found.flanks[m, 0] += weight * (-across > FLANK)
            found.flanks[m, 1] += weight * (across > FLANK)
            found.counts[m] += 1
            total += weight
        for i in range(8):
            for j in range(i):
                normal[i, j] = normal[j, i]
        if total > 0:
            found.flanks[m] /= total
            found.up[m] /= total
            found.offset[m] /= total
    return found
