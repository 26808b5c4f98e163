"""A deformation field fitted beside the pose, for a part that agrees with its good one nowhere by a rigid motion.

A part that is bent or twisted may, beside its motion, move by a polynomial of place: x = T (p + v(p)). The prior holds
what no residual tells, so the field does not let a surface slide along itself; robust weights leave beads out of it;
and its order is the lowest that predicts blocks of the surface that were not fitted as well as the best one does. The
pose is the best rigid fit of the surfaces, where plain ICP rests, and the field what is left of the whole.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from grindvision.errors import DegenerateError
from grindvision.geometry import (
    inverse,
    move_points,
    orthonormalised,
    rigid,
    rotate_vectors,
    skew,
    small_motion,
)
from grindvision.geometry.hash_grid import build_cells
from grindvision.records import by_content
from grindvision.vision.registration.deformable import TUKEY, block_covariance
from grindvision.vision.registration.deformation import FIRST, Deformation, along_normals, powers_of, raised, zero_field
from grindvision.vision.registration.icp import FineRegistration
from grindvision.vision.registration.plane_icp import icp_planes
from grindvision.vision.surface.signed_distance import signed_distances
from grindvision.vision.surface.surfels import Surfels

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

ORDERS = (2, 3, 4)
"""Orders of the polynomial that are tried: a bend or a twist of a plate is of the second."""

STRAIN, BENDING = 0.002, 0.02
"""Standard deviations of the field's coefficients before any scan, as fractions of the part's half-length: metal is
stretched less than it is bent. Halved from the second order to the third, and so on."""

MIN_SURFELS = 1000
"""Fewer surfels of the test scan do not tell a field from stock."""

ALIKE = 12.0
"""So many neighbouring surfels err alike and count as one."""

BLOCKS, FOLDS = 8, 4
"""Blocks along the part's length that are left out together, and the groups of them that are left out in turn."""

FACING = 0.7
"""Smallest cosine of the angle between the normals of two surfaces that may be the same."""

REACH = 0.1
"""Surfaces farther apart than this part of the part's half-length do not meet."""

MAX_LOSS = 9.0
"""Squared residuals, in standard deviations, count for no more."""

FITTING = 0.75
"""Fraction of the surface that the field must fit: the spread of the residuals is that of so many of the smallest."""

NORMAL_QUANTILE = 1.1503
"""Standard deviations within which so much of a normal distribution lies."""

MIN_GAIN = 0.05
"""Part of the loss over blocks that were not fitted by which a higher order must predict them better."""

RIGID_STEPS, RIGID_REST_MM = 100, 1e-3
"""Most steps of the best rigid fit, and the motion of the part's rim at which it rests."""

STEPS, AT_REST = 25, 0.01
"""Most steps of a fit, and the change of the surface, in parts of the residuals' spread, at which it rests."""


@by_content
@dataclass(frozen=True)
class DeformationFit:
    """A field fitted beside a pose.

    ``registration`` is the pose T_target_source with its covariance, ``field`` the deformation in the source's frame;
    of the source's samples ``points`` (N, 3), ``before_mm`` and ``after_mm`` (N,) are the residuals of the rigid pose
    and with the field, NaN where the target shows nothing. ``held_out_mm``: spread of the residuals over blocks that
    were not fitted, by order, 0 for the rigid pose; ``order`` the one that was chosen by them.
    """

    registration: FineRegistration
    field: Deformation
    points: Floats
    before_mm: Floats
    after_mm: Floats
    held_out_mm: dict[int, float]
    order: int

    @property
    def spread_mm(self) -> float:
        """Standard deviation of what the field leaves."""
        return spread_of(self.after_mm)

    @property
    def explained(self) -> float:
        """Fraction of the squared difference after the rigid pose that the field takes up."""
        return float(1 - (spread_of(self.after_mm) / max(spread_of(self.before_mm), 1e-12)) ** 2)


def spread_of(residuals: Floats) -> float:
    """Standard deviation in mm of the smaller ``FITTING`` of residuals; those that are NaN count as large."""
    sizes = np.where(np.isfinite(residuals), np.abs(residuals), np.inf)
    found = float(np.quantile(sizes, FITTING, method="lower"))
    return found / NORMAL_QUANTILE if np.isfinite(found) else np.inf


def fit_deformation(points: Floats, normals: Floats, target: Surfels, start: FineRegistration) -> DeformationFit:
    """Fit pose and field to points (N, 3) with normals (N, 3) of a source on a target's surfels, from a rigid pose.

    Raises:
        DegenerateError: too few points, or they do not meet the target; the field folds the surface.
    """
    if len(points) < MIN_SURFELS:
        raise DegenerateError(
            f"the test scan shows {len(points)} surfels; {MIN_SURFELS} are needed to tell a deformed part from stock"
        )
    nothing = zero_field(ORDERS[0], points)
    reach = REACH * nothing.scale_mm
    wide = icp_planes(points, normals, target, start.T_target_source, reach, reach / 8, iterations=100)
    samples = _Samples(points, normals, target, reach)
    sharp = icp_planes(points, normals, target, wide.T_target_source, reach, iterations=100)
    tries = [_Step.of(samples, one.T_target_source, nothing) for one in (wide, sharp)]
    first = min(tries, key=lambda step: spread_of(step.residuals))
    floor = spread_of(first.residuals)
    if not np.isfinite(floor):
        raise DegenerateError(f"at no rigid pose does {FITTING:.0%} of the test scan come near the sample")
    left_out = {0: _held_out_rigid(samples, first)}
    steps, field, pose = {}, nothing, wide.T_target_source
    for order in ORDERS:
        steps[order] = samples.settled(pose, raised(field, order), floor)
        left_out[order] = samples.held_out(steps[order])
        pose, field = steps[order].pose, steps[order].field
    order = _lowest_of_the_best(samples, left_out)
    chosen = steps[max(order, ORDERS[0])]
    registration, field = samples.known(chosen, wide)
    held_out = {one: spread_of(residuals) for one, residuals in left_out.items()}
    return DeformationFit(registration, field, points, first.residuals, chosen.residuals, held_out, order)


@dataclass(frozen=True, eq=False)
class _Step:
    """Residuals (N,) of the samples at a pose and a field, NaN where the target shows nothing, and the target's normals
    (N, 3) in the source's frame."""

    pose: Floats
    field: Deformation
    residuals: Floats
    up: Floats

    @classmethod
    def of(cls, samples: _Samples, pose: Floats, field: Deformation) -> _Step:
        """The samples where a pose and a field bring them."""
        places = move_points(pose, samples.points + field.displacements(samples.points))
        residuals, up, _ = signed_distances(samples.target, places, samples.reach)
        facing = (rotate_vectors(pose, samples.normals) * up).sum(axis=1) > FACING
        up = rotate_vectors(inverse(pose), np.nan_to_num(up))
        return cls(pose, field, np.where(facing, residuals, np.nan), up)


class _Samples:
    """Samples of the source on the target, and the blocks of space in which they lie."""

    def __init__(self, points: Floats, normals: Floats, target: Surfels, reach: float) -> None:
        self.points, self.normals, self.target, self.reach = points, normals, target, reach
        grid = build_cells(points, float(np.linalg.norm(np.ptp(points, axis=0))) / BLOCKS)
        self.blocks = np.empty(len(points), dtype=np.int64)
        for block, members in enumerate(np.split(grid.order, grid.starts[1:-1])):
            self.blocks[members] = block

    def settled(self, pose: Floats, field: Deformation, floor: float) -> _Step:
        """Pose and field brought to rest; residuals up to ``floor`` count fully at first, then less and less."""
        step = _Step.of(self, pose, field)
        least = 1e-4 * self.target.grid.size_mm
        for turn in range(STEPS):
            spread = max(spread_of(step.residuals), floor * 0.6**turn, least)
            if not np.isfinite(spread):
                raise DegenerateError("with the deformation that was tried the scans do not meet")
            terms = step.field.terms(self.points)
            change = _solved(along_normals(terms, step.up), step, spread)[0].reshape(-1, 3)
            moved = replace(step.field, coefficients=step.field.coefficients + change)
            motion = moved.nearest_motion(self.points)
            step = _Step.of(self, step.pose @ motion, moved.less_motion(motion))
            if floor * 0.6**turn < spread and np.abs(terms @ change).max() < AT_REST * spread:
                break
        return step

    def held_out(self, step: _Step) -> Floats:
        """Residuals (N,) of blocks that were left out of the fit, near a step at rest."""
        design = along_normals(step.field.terms(self.points), step.up)
        spread = spread_of(step.residuals)
        found = np.full(len(self.points), np.nan)
        for fold in range(FOLDS):
            out = self.blocks % FOLDS == fold
            change = _solved(design, step, spread, ~out)[0]
            found[out] = step.residuals[out] + design[out] @ change
        return found

    def best_rigid(self, pose: Floats) -> Floats:
        """The pose (4, 4) of least squared distances between the surfaces, from one near it: steps along tangents of
        the surface, since over millimetres of bending the motion nearest to the field is not yet it."""
        nothing = zero_field(1, self.points)
        centre = nothing.centre_mm
        for _ in range(RIGID_STEPS):
            step = _Step.of(self, pose, nothing)
            shown = np.isfinite(step.residuals)
            design = np.column_stack([step.up, np.cross(self.points - centre, step.up)])[shown]
            twist = -np.linalg.lstsq(design, step.residuals[shown], rcond=1e-6)[0]
            pose = orthonormalised(pose @ rigid(None, centre) @ small_motion(twist) @ rigid(None, -centre))
            if np.linalg.norm(twist[:3]) + nothing.scale_mm * np.linalg.norm(twist[3:]) < RIGID_REST_MM:
                break
        return pose

    def known(self, step: _Step, start: FineRegistration) -> tuple[FineRegistration, Deformation]:
        """Registration and field with what is known of them: errors alike within blocks, and the prior where no
        residual tells."""
        design = along_normals(step.field.terms(self.points), step.up)
        spread = spread_of(step.residuals)
        change, information, weights = _solved(design, step, spread)
        used = weights > 0
        left = np.nan_to_num(step.residuals) + design @ change
        covariance = np.linalg.inv(information) + block_covariance(
            self.points[used], design[used], left[used], weights[used] / spread**2, information
        )
        up = np.where(used[:, None], step.up, self.normals)
        motions, back = _motions(step.field, self.points, up)
        rest = np.eye(len(covariance)) - back @ motions
        motion = inverse(step.pose) @ self.best_rigid(step.pose @ step.field.nearest_motion(self.points, up))
        field = replace(step.field.less_motion(motion), covariance=rest @ covariance @ rest.T)
        pose = step.pose @ motion
        rotation = np.kron(np.eye(2), pose[:3, :3])
        centre = move_points(pose, step.field.centre_mm)
        shown = np.isfinite(step.residuals)
        along = rotate_vectors(pose, step.up[shown])
        jacobian = np.column_stack([along, np.cross(move_points(pose, self.points[shown]) - centre, along)])
        pose_errors = rotation @ motions @ covariance @ motions.T @ rotation.T
        found = FineRegistration(
            pose, spread, float(shown.mean()), start.iterations, True, centre, jacobian.T @ jacobian, pose_errors,
            np.array([spread**2]),
        )  # fmt: skip
        return found, field


def _prior(field: Deformation) -> Floats:
    """Inverse covariance (3K, 3K) of a field's coefficients before any scan; rotations and translations are free."""
    powers = powers_of(field.order)
    found = np.zeros((3 * len(powers), 3 * len(powers)))
    first = [powers.index(one) for one in FIRST]
    for axis in range(3):
        for component in range(3):
            both = [3 * first[axis] + component, 3 * first[component] + axis]
            found[np.ix_(both, both)] += 0.25 / (STRAIN * field.scale_mm) ** 2
    for at, one in enumerate(powers):
        if sum(one) > 1:
            sigma = BENDING * field.scale_mm * 0.5 ** (sum(one) - 2)
            found[range(3 * at, 3 * at + 3), range(3 * at, 3 * at + 3)] = sigma**-2
    return found + 1e-9 / field.scale_mm**2 * np.eye(len(found))


def _solved(design: Floats, step: _Step, spread: float, part: Flags | None = None) -> tuple[Floats, Floats, Floats]:
    """Change (3K,) of a field's coefficients that takes the residuals up, the information (3K, 3K) and the weights
    (N,) of the samples; of a ``part`` of them only."""
    shown = np.isfinite(step.residuals) if part is None else np.isfinite(step.residuals) & part
    residuals = np.nan_to_num(step.residuals)
    prior = _prior(step.field)
    change: Floats = np.zeros(design.shape[1])
    for _ in range(3):
        left = residuals + design @ change
        weights = shown * np.clip(1 - (left / (TUKEY * spread)) ** 2, 0, None) ** 2 / ALIKE
        weighted = design * weights[:, None] / spread**2
        information = design.T @ weighted + prior
        pull = weighted.T @ residuals + prior @ step.field.coefficients.ravel()
        change = np.asarray(-np.linalg.solve(information, pull), dtype=float)
    return change, information, weights


def _held_out_rigid(samples: _Samples, step: _Step) -> Floats:
    """Residuals (N,) of blocks that were left out of a rigid fit."""
    arms = samples.points - step.field.centre_mm
    design = np.column_stack([step.up, np.cross(arms, step.up) / step.field.scale_mm])
    spread, found = spread_of(step.residuals), np.full(len(samples.points), np.nan)
    shown, residuals = np.isfinite(step.residuals), np.nan_to_num(step.residuals)
    for fold in range(FOLDS):
        out = samples.blocks % FOLDS == fold
        change = np.zeros(6)
        for _ in range(3):
            left = residuals + design @ change
            weights = (shown & ~out) * np.clip(1 - (left / (TUKEY * spread)) ** 2, 0, None) ** 2
            weighted = design * weights[:, None]
            change = -np.linalg.lstsq(design.T @ weighted, weighted.T @ residuals, rcond=1e-9)[0]
        found[out] = step.residuals[out] + design[out] @ change
    return found


def _lowest_of_the_best(samples: _Samples, left_out: dict[int, Floats]) -> int:
    """The lowest order whose loss over blocks that were not fitted is the least one's, within two standard errors."""
    scale = max(min(spread_of(residuals) for residuals in left_out.values()), 1e-9)
    count = int(samples.blocks.max()) + 1
    sizes = np.bincount(samples.blocks, minlength=count)
    losses = {}
    for order, residuals in left_out.items():
        loss = np.minimum(np.where(np.isfinite(residuals), (np.nan_to_num(residuals) / scale) ** 2, np.inf), MAX_LOSS)
        losses[order] = np.bincount(samples.blocks, loss, count)
    best = min(losses, key=lambda order: float(losses[order].sum()))
    for order in sorted(losses):
        more = losses[order] - losses[best]
        error = np.sqrt(((more - sizes * more.sum() / sizes.sum()) ** 2).sum())
        if more.sum() <= max(2 * error, MIN_GAIN * float(losses[best].sum())):
            return order
    return best


def _motions(field: Deformation, points: Floats, normals: Floats) -> tuple[Floats, Floats]:
    """The twist (6, 3K) about the field's centre, translation first, nearest along normals (N, 3) at points (N, 3) to a
    change of the coefficients, and the change (3K, 6) that makes a twist."""
    powers = powers_of(field.order)
    back = np.zeros((3 * len(powers), 6))
    back[3 * powers.index((0, 0, 0)) + np.arange(3), np.arange(3)] = 1.0
    for axis, one in enumerate(FIRST):
        # a rotation vector w moves the end of the unit axis e by w x e
        back[3 * powers.index(one) + np.arange(3), 3:] = -field.scale_mm * skew(np.eye(3)[axis])
    along = along_normals(field.terms(points), normals)
    jacobian = along @ back
    return np.linalg.pinv(jacobian, rcond=1e-9) @ along, back
