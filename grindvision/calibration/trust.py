"""Where a calibration holds: errors predicted over the arm's joint range or a work space, and poses that would help."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.arm import MdhArm
from grindvision.calibration.accurate import Calibration
from grindvision.calibration.estimate import noise_covariances
from grindvision.calibration.measurements import Measurements
from grindvision.calibration.model import carry
from grindvision.calibration.uncertainty import MEAN_OF_RMS
from grindvision.errors import InputError
from grindvision.records import by_content

Floats = NDArray[np.float64]

#: Error over the range by that of the held-out rows from which a calibration is said to hold only near them.
FAR_WORSE = 1.5

#: Poses tried for a work space, and those inside it that are enough to judge it.
TRIED, ENOUGH = 40_000, 40


@by_content
@dataclass(frozen=True)
class PredictedErrors:
    """Errors predicted at P poses ``q_rad`` (P, n), mm: ``rms_mm`` (P,) at points ``base_mm`` (P, 3), base frame.

    ``where`` says in words which poses these are; ``measured_rms_mm`` (M,) is the same at the measured poses.
    """

    q_rad: Floats
    base_mm: Floats
    rms_mm: Floats
    measured_rms_mm: Floats
    where: str

    @property
    def mean_mm(self) -> float:
        """Mean error to expect over the poses."""
        return float(MEAN_OF_RMS * self.rms_mm.mean())

    @property
    def measured_mean_mm(self) -> float:
        """Mean error to expect at the measured poses, the noise of measuring aside."""
        return float(MEAN_OF_RMS * self.measured_rms_mm.mean())

    @property
    def p95_mm(self) -> float:
        """What 95 % of the poses stay below, mean error each."""
        return float(MEAN_OF_RMS * np.quantile(self.rms_mm, 0.95))

    def __str__(self) -> str:
        return (
            f"predicted without noise: {self.measured_mean_mm:.3f} mm at the measured poses, {self.mean_mm:.3f} mm"
            f" {self.where} (95 % below {self.p95_mm:.3f} mm)"
        )


def joint_ranges(arm: MdhArm, measurements: Measurements) -> tuple[Floats, str]:
    """Lower and upper end (n, 2) of every joint, and in words where they come from.

    The arm's limits where they are known; else -180 to 180 deg, and the measured range of a prismatic joint.
    """
    measured = np.column_stack([measurements.q_rad.min(axis=0), measurements.q_rad.max(axis=0)])
    if arm.limits is not None and np.isfinite(arm.limits[:, :2]).all() and (np.ptp(arm.limits[:, :2], 1) > 0).all():
        return arm.limits[:, :2].copy(), "over the joints' limits"
    ranges = np.tile([-np.pi, np.pi], (arm.n, 1))
    prismatic = np.array(arm.prismatic)
    ranges[prismatic] = measured[prismatic]
    still = np.ptp(measured, axis=1) < 1e-3
    ranges[still] = measured[still]
    return ranges, "over all joint angles (-180 to 180 deg; the robot table has no limits)"


def predict_errors(
    calibration: Calibration, rng: np.random.Generator, box_mm: ArrayLike | None = None, count: int = 1500
) -> PredictedErrors:
    """Errors predicted at random poses over the joints' range, or at those that bring the point into a box.

    Args:
        calibration: what was found.
        rng: draws the poses.
        box_mm: two opposite corners (2, 3) in the arm's base frame; left out: the whole range.
        count: poses at most.

    Raises:
        InputError: a box that no pose reaches.
    """
    measurements = calibration.measurements
    ranges, where = joint_ranges(calibration.arm, measurements)
    point = np.median(measurements.scanner_mm, axis=0)
    total = count if box_mm is None else TRIED
    q = rng.uniform(ranges[:, 0], ranges[:, 1], (total, len(ranges)))
    base = carry(calibration.cell, q, np.broadcast_to(point, (total, 3))).base_mm
    if box_mm is not None:
        low, high = np.sort(np.asarray(box_mm, dtype=float).reshape(2, 3), axis=0)
        inside = np.flatnonzero(((base >= low) & (base <= high)).all(axis=1))[:count]
        if len(inside) < ENOUGH:
            reached = ", ".join(f"{a:.0f}..{b:.0f}" for a, b in zip(base.min(axis=0), base.max(axis=0), strict=True))
            raise InputError(
                f"the box {low.round().tolist()} to {high.round().tolist()} mm is reached by {len(inside)} of {TRIED}"
                f" random poses; the arm reaches {reached} mm (base frame): name a box that it works in"
            )
        q, base, where = q[inside], base[inside], "in the box of the work"
    rms = calibration.predicted_rms_mm(q, np.broadcast_to(point, (len(q), 3)))
    train = measurements.rows(measurements.train)
    return PredictedErrors(q, base, rms, calibration.predicted_rms_mm(train.q_rad, train.scanner_mm), where)


def diagnose_trust(predicted: PredictedErrors, stated_mean_mm: float) -> list[str]:
    """A sentence where the error over these poses is far from the ``stated_mean_mm`` of the held-out rows."""
    if predicted.mean_mm < FAR_WORSE * stated_mean_mm:
        return []
    return [
        f"the stated {stated_mean_mm:.2g} mm hold near the measured poses; {predicted.where} expect"
        f" {predicted.mean_mm:.2g} mm on average and {predicted.p95_mm:.2g} mm at 95 %: measure there too (--suggest 12"
        " names poses)"
    ]


@by_content
@dataclass(frozen=True)
class Suggestion:
    """Poses ``q_rad`` (N, n) to measure next, best first, and the mean error in mm predicted after each."""

    q_rad: Floats
    mean_mm: Floats

    def __str__(self) -> str:
        return f"{len(self.q_rad)} more poses: {self.mean_mm[-1]:.3f} mm predicted after them"


def suggest_poses(
    calibration: Calibration, predicted: PredictedErrors, count: int, rng: np.random.Generator, candidates: int = 400
) -> Suggestion:
    """Choose the poses whose measurement lowers the predicted error most, one after the other (I-optimal, greedy).

    Candidates are drawn from the poses of ``predicted``; each is taken to be measured with the noise that was found.

    Raises:
        InputError: fewer than one pose, or more than there are candidates.
    """
    chosen_from = rng.permutation(len(predicted.q_rad))[:candidates]
    if not 1 <= count <= len(chosen_from):
        raise InputError(f"{count} poses asked for; 1 to {len(chosen_from)} can be suggested")
    measurements, unknowns = calibration.measurements, calibration.unknowns
    point = np.median(measurements.scanner_mm, axis=0)

    def designs(q: Floats) -> Floats:
        first = np.zeros(len(q), dtype=np.int64) if unknowns.reflectors else None
        return carry(calibration.cell, q, np.broadcast_to(point, (len(q), 3)), None, first).design(unknowns)

    targets = designs(predicted.q_rad)
    flat = targets.reshape(-1, len(unknowns))
    weight = flat.T @ flat / len(targets)
    q = predicted.q_rad[chosen_from]
    offered = designs(q)
    noise = noise_covariances(
        calibration.cell,
        Measurements(q, np.broadcast_to(point, (len(q), 3)), np.zeros((len(q), 3))),
        calibration.sigmas,
    )
    covariance = calibration.model_error.covariance[: len(unknowns), : len(unknowns)].copy()
    rest = float(np.mean(predicted.rms_mm**2)) - float(np.sum(weight * covariance))
    taken: list[int] = []
    means = []
    for _ in range(count):
        pulled = offered @ covariance
        inner = np.linalg.inv(pulled @ np.swapaxes(offered, 1, 2) + noise)
        gains = ((inner @ pulled) * (pulled @ weight)).sum(axis=(1, 2))
        gains[taken] = -np.inf
        best = int(np.argmax(np.round(gains, 12)))
        taken.append(best)
        covariance = covariance - pulled[best].T @ inner[best] @ pulled[best]
        means.append(MEAN_OF_RMS * np.sqrt(max(float(np.sum(weight * covariance)) + max(rest, 0.0), 0.0)))
    return Suggestion(q[taken], np.array(means))
