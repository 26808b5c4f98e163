"""How far a calibration may be trusted: covariances with the model's own error, and errors predicted anywhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr

from grindvision.arm import MdhArm
from grindvision.calibration.estimate import (
    Sigmas,
    deviations,
    estimate_sigmas,
    joint_noise_jacobian,
    posterior_covariance,
    prior_widths,
    residuals_of,
    row_covariances,
)
from grindvision.calibration.joint_terms import (
    GravityLoad,
    JointCorrections,
    JointTerm,
    bases_of,
    sag_terms,
    wave_terms,
)
from grindvision.calibration.measurements import Measurements
from grindvision.calibration.model import ScannerOnArm, carried, carry
from grindvision.calibration.structure import Finding
from grindvision.calibration.unknowns import Unknowns
from grindvision.records import by_content

Floats = NDArray[np.float64]

#: Mean length of a vector of normal errors over its root mean square, three axes alike.
MEAN_OF_RMS = 0.9213

#: Probability of one standard deviation.
ONE_SIGMA = 0.6827

#: Structures that no joint term stands for: they pull the unknowns by what the test found.
PULLING = (
    "drift", "jump", "slip", "bar", "scanner scale", "scanner depth", "tracker scale", "sphere", "coupling",
    "joint scale",
)  # fmt: skip


@by_content
@dataclass(frozen=True)
class ModelError:
    """What joints do beyond their geometry, where the fit has no unknowns for it: gear waves and sag, ``terms``.

    The same rows were fitted once more with the terms free. ``bias`` (K,) is how far the fit's unknowns then lie from
    where they were, ``values`` (T,) are the terms' coefficients, ``covariance`` (K + T, K + T) that of both.
    """

    terms: tuple[JointTerm, ...]
    values: Floats
    bias: Floats
    covariance: Floats


def model_error(
    cell: ScannerOnArm,
    nominal: MdhArm,
    unknowns: Unknowns,
    used: Measurements,
    sigmas: Sigmas,
    load: GravityLoad,
    terms_too: bool = True,
) -> ModelError:
    """Learn from the rows of a fit what gear waves and sag it leaves out, and how far they pull its unknowns.

    Rows of one pose are weighted by the fit as if each had its own joint error; the covariance knows that they share
    it. Without ``terms_too``, or where the table is not free, only that is looked at.
    """
    known = {term.name for term in unknowns.terms}
    every = wave_terms(cell.arm) + sag_terms(load, used.q_rad)
    terms = tuple(term for term in every if term.name not in known)
    if not terms_too or not unknowns.table:
        terms = ()
    size = len(unknowns)
    wider = replace(unknowns, terms=unknowns.terms + terms)
    values = (*cell.corrections.values, *(0.0,) * len(terms))
    start = replace(cell, corrections=JointCorrections(wider.terms, values))
    if terms:
        begin = replace(sigmas, term_rad=2e-4, sag_rad=5e-4)
        sigmas = estimate_sigmas(start, nominal, wider, used, begin, iterations=40)
    inner: Floats = posterior_covariance(start, wider, used, sigmas)
    points = carried(start, used)
    design = points.design(wider)
    jacobian = sigmas.joint_rad * joint_noise_jacobian(points)
    noise = row_covariances(points, used, sigmas) + jacobian @ np.swapaxes(jacobian, 1, 2)
    weighted: Floats = np.asarray(np.linalg.solve(noise, design))
    right = np.einsum("mik,mi->k", weighted, residuals_of(cell, used))
    right -= deviations(start, nominal, wider) / prior_widths(wider, sigmas) ** 2
    step = inner @ right
    total: Floats = inner + inner @ _shared_in_poses(weighted, jacobian, used.pose) @ inner
    added = np.zeros(len(wider), dtype=bool)
    added[wider.in_terms] = np.arange(len(wider.terms)) >= len(unknowns.terms)
    order = np.concatenate([np.flatnonzero(~added), np.flatnonzero(added)])
    bias = step[order[:size]] if terms else np.zeros(size)
    return ModelError(terms, step[order[size:]], bias, total[np.ix_(order, order)])


def _shared_in_poses(weighted: Floats, jacobian: Floats, pose: NDArray[np.str_]) -> Floats:
    """What the joint errors that rows of one pose share add to the covariance of the weighted residuals (K, K)."""
    _, number = np.unique(pose, return_inverse=True)
    size = weighted.shape[2]
    if number.max(initial=0) + 1 == len(pose):
        return np.zeros((size, size))
    single = np.swapaxes(weighted, 1, 2) @ jacobian
    shared = np.zeros((int(number.max()) + 1, *single.shape[1:]))
    np.add.at(shared, number, single)
    return np.einsum("gkn,gln->kl", shared, shared) - np.einsum("mkn,mln->kl", single, single)


def honest_covariance(error: ModelError, findings: Sequence[Finding] = ()) -> Floats:
    """Second moments (K, K) of the unknowns' errors: noise, priors, model error, the pull of what was found."""
    size = len(error.bias)
    total = error.covariance[:size, :size] + np.outer(error.bias, error.bias)
    for finding in findings:
        if finding.kind in PULLING:
            total = total + np.outer(finding.bias, finding.bias)
    return (total + total.T) / 2


def one_sigma(error: ModelError, findings: Sequence[Finding] = ()) -> Floats:
    """Half-widths (K,) round the unknowns that hold the truth with 68.3 %.

    With a known pull b beside a random error of standard deviation s that is between s and b + s / 2.
    """
    size = len(error.bias)
    random = np.sqrt(np.maximum(np.diag(error.covariance)[:size], 1e-300))
    pulls = [error.bias, *(finding.bias for finding in findings if finding.kind in PULLING)]
    pull = np.sqrt(np.sum(np.square(pulls), axis=0)) / random
    low, high = np.zeros(size), pull + 1.0
    for _ in range(50):
        middle = (low + high) / 2
        inside = ndtr(middle - pull) - ndtr(-middle - pull) < ONE_SIGMA
        low, high = np.where(inside, middle, low), np.where(inside, high, middle)
    return random * high


def predicted_rms_mm(
    cell: ScannerOnArm,
    unknowns: Unknowns,
    error: ModelError,
    findings: Sequence[Finding],
    q_rad: ArrayLike,
    points_scanner: ArrayLike,
) -> Floats:
    """Root mean square error (P,) in mm predicted at joint angles (P, n) for points (P, 3) of the scanner's frame.

    Of several reflectors on the tool, the first is taken.
    The systematic part: what calibration leaves of the arm's and the scanner's errors, with the waves that were found
    and what drifts, jumps and wrong scales pull the unknowns by; without the noise of measuring.
    """
    first = np.zeros(len(np.asarray(q_rad)), dtype=np.int64) if unknowns.reflectors else None
    points = carry(cell, q_rad, points_scanner, None, first)
    keep = ~unknowns.in_fixtures
    design = points.design(replace(unknowns, fixtures=()))
    jacobian = points.jacobian()

    def columns(terms: tuple[JointTerm, ...]) -> Floats:
        return jacobian[:, :, [term.joint for term in terms]] * bases_of(terms, points.q_rad)[:, None, :]

    every = np.concatenate([design, columns(error.terms)], axis=2)
    chosen = np.concatenate([keep, np.ones(len(error.terms), dtype=bool)])
    variance = np.einsum("mik,kl,mil->m", every, error.covariance[np.ix_(chosen, chosen)], every)
    square = ((every @ np.concatenate([error.bias[keep], error.values])) ** 2).sum(axis=1)
    for finding in findings:
        if finding.kind not in PULLING and not finding.terms:
            continue
        off = design @ finding.bias[keep]
        if finding.terms:
            off = off + columns(finding.terms) @ np.array(finding.values)
        elif finding.kind in ("scanner scale", "scanner depth"):
            rotation = (cell.T_tracker_base @ points.frames[:, -1] @ cell.T_joint_scanner)[:, :3, :3]
            axes = np.array([1.0, 1.0, 1.0] if finding.kind == "scanner scale" else [0.0, 0.0, 1.0])
            off = off - finding.values[0] * np.einsum("mij,mj->mi", rotation, axes * points.scanner_mm)
        square = square + (off**2).sum(axis=1)
    return np.sqrt(np.maximum(variance, 0.0) + square)
