"""Waves of the joints whose number a turn is not known: the one that explains most of what a fit leaves."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc

from grindvision.arm import MdhArm
from grindvision.calibration.estimate import Sigmas, deviations, prior_widths, residuals_of, unit_sizes
from grindvision.calibration.joint_terms import JointTerm, wave_pair
from grindvision.calibration.measurements import Measurements
from grindvision.calibration.model import CarriedPoints, ScannerOnArm, carried
from grindvision.calibration.pose_whitening import PoseWhitening, pose_whitening
from grindvision.calibration.unknowns import Unknowns
from grindvision.records import by_content

Floats = NDArray[np.float64]

#: Waves a turn that are looked for: magnets and poles of encoders and motors come to tens.
ORDERS = np.arange(1.0, 41.0)

#: So many of them are tried in one product of matrices: with 10,000 poses, each takes half a megabyte a column.
ORDERS_AT_ONCE = 5

#: Chance that a wave is taken which is none, and waves at most. Held-out poses judge all of them together, so the first
#: is not strict: at 0.01, 60 poses of a UR10 show no wave and leave 0.469 mm on 1,000 others; from 0.05 to 0.2 they
#: show six and leave 0.266, at 0.5 nine and 0.230.
FALSE_WAVE, MAX_WAVES = 0.2, 12

#: Equations beyond the unknowns from which waves are looked for: among hundreds of candidates, one fits a few.
MIN_FREEDOM = 20

#: Of a wave's columns, this much must be left beside what the fit's own unknowns can do.
OWN_FRACTION = 0.05


@by_content
@dataclass(frozen=True)
class LinearFit:
    """The fit near its solution, scaled to unit noise: R residuals and priors, K unknowns.

    ``jacobian`` (M, 3, n) says how each joint moves each of the ``points``. ``design`` (R, K) has a row for each prior
    behind the rows (3 M) of the measurements; ``basis`` (R, K) spans it, ``left`` (R,) is what it leaves of the goal.
    """

    points: CarriedPoints
    jacobian: Floats
    whiten: PoseWhitening
    design: Floats
    basis: Floats
    left: Floats

    def block(self, columns: Floats) -> Floats:
        """Columns (M, 3, c) of an effect, scaled to unit noise and unit length, (R, c)."""
        block = np.vstack([self.whiten(columns), np.zeros((self.design.shape[1], columns.shape[2]))])
        return block / np.maximum(np.linalg.norm(block, axis=0), 1e-12)

    def beside(self, block: Floats) -> Floats:
        """What of columns (R, c) the fit's own unknowns cannot do."""
        return block - self.basis @ (self.basis.T @ block)

    def wave(self, joint: int, orders: Floats) -> Floats:
        """Columns (M, 3, 2 W) of the waves of a joint, cos and sin in turn."""
        angles = orders * self.points.q_rad[:, [joint]]
        bases = np.stack([np.cos(angles), np.sin(angles)], axis=-1).reshape(len(angles), -1)
        return self.jacobian[:, :, [joint]] * bases[:, None, :]


def linear_fit(
    cell: ScannerOnArm, deviations_of: Floats, unknowns: Unknowns, measurements: Measurements, sigmas: Sigmas
) -> LinearFit:
    """Linearise a fit; ``deviations_of`` (K,) its unknowns are what its priors pull back."""
    points = carried(cell, measurements)
    whiten = pose_whitening(points, measurements, sigmas)
    units, widths = unit_sizes(measurements, unknowns), prior_widths(unknowns, sigmas)
    design = np.vstack([whiten(points.design(unknowns) * units), np.diag(units / widths)])
    pull = np.nan_to_num(-deviations_of / widths)
    goal = np.concatenate([whiten(residuals_of(cell, measurements)[:, :, None])[:, 0], pull])
    basis = np.linalg.svd(design, full_matrices=False)[0]
    return LinearFit(points, points.jacobian(), whiten, design, basis, goal - basis @ (basis.T @ goal))


@by_content
@dataclass(frozen=True)
class Wave:
    """A wave of ``order`` a turn of joint number ``joint`` (from 0): the squares that it explains, ``gain``.

    ``p_value`` is the chance that one such wave explains as much from noise, ``columns`` (R, 2) what of it the basis
    has not, orthonormal.
    """

    joint: int
    order: float
    gain: float
    p_value: float
    columns: Floats


def strongest_wave(fit: LinearFit, basis: Floats, left: Floats, freedom: int, orders: Floats) -> Wave | None:
    """Find the wave that explains most of ``left`` (R,) beside ``basis`` (R, B); None: no joint turns."""
    best, gain = None, 0.0
    if freedom < MIN_FREEDOM:
        return None
    arm, q_rad = fit.points.cell.arm, fit.points.q_rad
    moved = np.flatnonzero(~np.array(arm.prismatic) & (np.ptp(q_rad, axis=0) > 1e-3))
    for joint, some in product(moved, np.array_split(orders, -(-len(orders) // ORDERS_AT_ONCE))):
        block = fit.block(fit.wave(int(joint), some))
        free = block - basis @ (basis.T @ block)
        cos, sin = free[:, 0::2], free[:, 1::2]
        cc, ss, cs = (cos**2).sum(axis=0), (sin**2).sum(axis=0), (cos * sin).sum(axis=0)
        known = np.minimum(cc, ss) - np.abs(cs) > OWN_FRACTION**2
        determinant = np.where(known, cc * ss - cs**2, 1.0)
        right = left @ cos, left @ sin
        gains = (ss * right[0] ** 2 - 2 * cs * right[0] * right[1] + cc * right[1] ** 2) / determinant
        gains = np.round(np.where(known, gains, 0.0), 9)
        number = int(np.argmax(gains))
        if gains[number] > gain:
            best, gain = (int(joint), float(some[number]), free[:, 2 * number : 2 * number + 2].copy()), gains[number]
    if best is None:
        return None
    total = float(left @ left)
    ratio = (gain / 2) / max((total - gain) / (freedom - 2), 1e-300)
    columns = np.linalg.qr(best[2])[0]
    return Wave(best[0], best[1], float(gain), float(fdtrc(2, freedom - 2, ratio)), columns)


def find_waves(
    cell: ScannerOnArm, nominal: MdhArm, unknowns: Unknowns, rows: Measurements, sigmas: Sigmas
) -> tuple[JointTerm, ...]:
    """Waves that the residuals of a fit hold, one after the other until what is left looks like noise.

    Args:
        cell: fitted to ``rows``.
        nominal: the arm that the priors pull to.
        unknowns, rows, sigmas: of that fit.

    Returns:
        Two terms for each wave, cos and sin.
    """
    fit = linear_fit(cell, deviations(cell, nominal, unknowns), unknowns, rows, sigmas)
    tested = len(ORDERS) * rows.q_rad.shape[1]
    basis, left = fit.basis, fit.left
    freedom = rows.equations - len(unknowns)
    terms: tuple[JointTerm, ...] = ()
    for _ in range(MAX_WAVES):
        wave = strongest_wave(fit, basis, left, freedom, ORDERS)
        if wave is None or wave.p_value * tested > FALSE_WAVE:
            break
        terms += wave_pair(wave.joint, wave.order)
        basis = np.hstack([basis, wave.columns])
        left = left - wave.columns @ (wave.columns.T @ left)
        freedom -= 2
    return terms
