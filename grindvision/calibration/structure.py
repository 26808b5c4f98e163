"""What is left after a fit must look like noise: tests for what follows the session, the joints, the scanner, a sphere.

Each test adds a few columns to the error model, takes from them what the fit's own unknowns can do, and asks how much
of the residuals they explain (an F test on rows scaled to unit noise). The one that explains most is taken into the
model before the others are asked again, so that one cause is named once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc

from grindvision.calibration.causes import Cause, causes_of, wave_cause
from grindvision.calibration.estimate import Sigmas, deviations, unit_sizes
from grindvision.calibration.joint_terms import GravityLoad, JointTerm
from grindvision.calibration.measurements import Measurements
from grindvision.calibration.model import ScannerOnArm
from grindvision.calibration.unknowns import Unknowns
from grindvision.calibration.wave_search import ORDERS, LinearFit, linear_fit, strongest_wave
from grindvision.records import by_content

Floats = NDArray[np.float64]

#: Chance that any of the tests speaks without a cause; and the least fraction of squares it must explain.
FALSE_ALARM, MIN_EXPLAINED = 1e-3, 0.08

#: Causes named at most, and rows looked at: more than these tell no more.
MAX_FINDINGS, MAX_ROWS = 4, 2000

#: Of columns of length 1, so much must be left beside what the fit's own unknowns can do.
OWN_LENGTH = 1e-3

#: Causes whose columns are multiplied at once; chances that differ by a smaller share, or are smaller, are computed
#: exactly before one is preferred.
CAUSES_AT_ONCE, NEARLY, UNDERFLOW = 50, 1e-4, 1e-290


@by_content
@dataclass(frozen=True)
class Finding:
    """A structure in the residuals: its ``kind``, how far it moves points (rms, mm), and a sentence for a person.

    ``explained`` is the fraction of the residuals' squares that it explains, ``p_value`` the chance of as much from
    noise. ``bias`` (K,) is how far the unknowns lie from where they are without it, ``values`` are the coefficients of
    its columns, and ``terms`` what these are where ``model_error`` has no unknowns for them.
    """

    kind: str
    size_mm: float
    explained: float
    p_value: float
    sentence: str
    bias: Floats
    values: tuple[float, ...] = ()
    terms: tuple[JointTerm, ...] = ()


def structure_in(
    cell: ScannerOnArm,
    unknowns: Unknowns,
    measurements: Measurements,
    sigmas: Sigmas,
    load: GravityLoad,
) -> tuple[Finding, ...]:
    """Find structure in the residuals of a fit, the largest first; rows must stand in the order of measuring.

    Args:
        cell: the calibrated cell.
        unknowns: what the fit was free to move.
        measurements: the rows to look at, without those that were dropped.
        sigmas: noise and priors of the fit.
        load: masses that the joints may sag under.
    """
    if len(measurements) > MAX_ROWS:
        measurements = measurements.rows(np.linspace(0, len(measurements) - 1, MAX_ROWS).astype(int))
    fit = linear_fit(cell, deviations(cell, cell.arm, unknowns), unknowns, measurements, sigmas)
    causes = causes_of(fit.points, measurements, load)
    if not causes:
        return ()
    tested = len(causes) + len(ORDERS[ORDERS > 2]) * cell.arm.n
    chosen = _needed(fit, _chosen(fit, causes, measurements.equations, tested), tested)
    if not chosen:
        return ()
    blocks = [fit.block(one.cause.columns) for one in chosen]
    together = fit.beside(np.hstack(blocks))
    values = np.linalg.lstsq(together, fit.left, rcond=0.02)[0]
    parts = np.split(values, np.cumsum([block.shape[1] for block in blocks])[:-1])
    units = unit_sizes(measurements, unknowns)
    found = []
    for one, block, part in zip(chosen, blocks, parts, strict=True):
        coefficients = part / np.maximum(np.linalg.norm(fit.whiten(one.cause.columns), axis=0), 1e-12)
        size, sentence = one.cause.describe(coefficients)
        bias = -np.linalg.lstsq(fit.design, block @ part, rcond=1e-10)[0] * units
        kind, terms, numbers = one.cause.kind, one.cause.terms, tuple(coefficients.tolist())
        found.append(Finding(kind, size, one.explained, one.p_value, sentence, bias, numbers, terms))
    return tuple(found)


@by_content
@dataclass(frozen=True)
class _Chosen:
    cause: Cause
    explained: float
    p_value: float


def _chosen(fit: LinearFit, causes: Sequence[Cause], equations: int, tested: int) -> list[_Chosen]:
    """Causes that explain most of what the ones before them leave, one after the other."""
    basis, left = fit.basis, fit.left
    freedom = len(left) - fit.design.shape[1]
    orders = ORDERS[ORDERS > 2]
    chosen: list[_Chosen] = []
    while len(chosen) < MAX_FINDINGS:
        best = _strongest(fit, causes, basis, left, freedom)
        wave = strongest_wave(fit, basis, left, equations - basis.shape[1], orders)
        if wave is not None and (best is None or (wave.p_value, -wave.gain) < best[:2]):
            best = (wave.p_value, -wave.gain, wave_cause(fit, wave), wave.columns)
        if best is None:
            break
        chance, loss, cause, sides = best
        explained = -loss / float(left @ left)
        if chance * tested > FALSE_ALARM or explained < MIN_EXPLAINED:
            break
        chosen.append(_Chosen(cause, explained, chance * tested))
        basis = np.hstack([basis, sides])
        left = left - sides @ (sides.T @ left)
        freedom -= sides.shape[1]
    return chosen


def _needed(fit: LinearFit, chosen: list[_Chosen], tested: int) -> list[_Chosen]:
    """The causes without those that explain nothing beside the others: a first guess that a later one made void."""
    while len(chosen) > 1:
        chances = []
        for number in range(len(chosen)):
            rest = np.hstack([fit.block(one.cause.columns) for one in chosen if one is not chosen[number]])
            sides, lengths, _ = np.linalg.svd(fit.beside(rest), full_matrices=False)
            basis = np.hstack([fit.basis, sides[:, lengths > 1e-3]])
            left = fit.left - basis @ (basis.T @ fit.left)
            again = _strongest(fit, [chosen[number].cause], basis, left, len(left) - basis.shape[1])
            chances.append(1.0 if again is None else again[0])
        worst = int(np.argmax(chances))
        if chances[worst] * tested <= FALSE_ALARM:
            break
        chosen = [*chosen[:worst], *chosen[worst + 1 :]]
    return chosen


def _strongest(
    fit: LinearFit, causes: Sequence[Cause], basis: Floats, left: Floats, freedom: int
) -> tuple[float, float, Cause, Floats] | None:
    """The cause that noise explains least: the chance of that, minus the squares it explains, and its columns."""
    best = None
    total = float(left @ left)
    if len(causes) > 1:
        chances = _rough_chances(fit, causes, basis, left, freedom)
        near = chances <= chances.min() * (1 + NEARLY) + UNDERFLOW
        causes = [cause for cause, is_near in zip(causes, near, strict=True) if is_near]
    for cause in causes:
        block = fit.block(cause.columns)
        free = block - basis @ (basis.T @ block)
        sides, lengths, _ = np.linalg.svd(free, full_matrices=False)
        sides = sides[:, lengths > OWN_LENGTH]
        count = sides.shape[1]
        if count == 0 or freedom - count < 6:
            continue
        gain = float(((sides.T @ left) ** 2).sum())
        ratio = (gain / count) / max((total - gain) / (freedom - count), 1e-300)
        chance = float(fdtrc(count, freedom - count, ratio))
        if best is None or (chance, -gain) < best[:2]:
            best = (chance, -gain, cause, sides)
    return best


def _rough_chances(fit: LinearFit, causes: Sequence[Cause], basis: Floats, left: Floats, freedom: int) -> Floats:
    """The chances (C,) of ``_strongest``, good to some eight digits, from products of matrices for many causes at once:
    there are hundreds, and decompositions of their columns one by one would take most of a calibration's time."""
    widths = np.array([cause.motion.shape[2] for cause in causes])
    total, chances = float(left @ left), np.ones(len(causes))
    for width in np.unique(widths):
        alike = np.flatnonzero(widths == width)
        for some in np.array_split(alike, -(-len(alike) // CAUSES_AT_ONCE)):
            block = fit.block(np.concatenate([causes[at].columns for at in some], axis=2))
            free = block - basis @ (basis.T @ block)
            own = np.ascontiguousarray(free.T).reshape(len(some), int(width), -1)
            squares, axes = np.linalg.eigh(own @ np.swapaxes(own, 1, 2))
            kept = squares > OWN_LENGTH**2
            along = np.einsum("cji,cj->ci", axes, own @ left)
            gains = np.where(kept, along**2 / np.where(kept, squares, 1.0), 0.0).sum(axis=1)
            counts = np.maximum(kept.sum(axis=1), 1)
            ratios = (gains / counts) / np.maximum((total - gains) / np.maximum(freedom - counts, 1), 1e-300)
            judged = kept.any(axis=1) & (freedom - counts >= 6)
            chances[some] = np.where(judged, fdtrc(counts, np.maximum(freedom - counts, 1), ratios), np.inf)
    return chances


def sentences_of(findings: Sequence[Finding]) -> list[str]:
    """What a person should know of the findings, a sentence each."""
    return [finding.sentence for finding in findings]
