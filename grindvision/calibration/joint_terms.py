"""What moves a joint away from its commanded angle: gear waves, sag under gravity, couplings between joints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.arm import MdhArm, joint_transforms

Floats = NDArray[np.float64]

#: Direction of gravity in the base frame of an arm that stands upright.
DOWN = (0.0, 0.0, -1.0)

#: A torque that varies by less than this fraction of the largest one of the arm tells nothing: a vertical axis.
MIN_TORQUE = 0.02


@dataclass(frozen=True)
class GravityLoad:
    """Point masses on the links of an arm: ``masses`` (n,) stand at ``centres_mm`` (n, 3) in the joints' frames.

    ``down`` (3,) is the direction of gravity in the base frame. Only ratios of masses matter.
    """

    arm: MdhArm
    masses: tuple[float, ...]
    centres_mm: tuple[tuple[float, float, float], ...]
    down: tuple[float, float, float] = DOWN

    def torques(self, q_rad: ArrayLike) -> Floats:
        """Torque of gravity (M, n) about each joint at joint angles (M, n), as a fraction of the largest possible."""
        q = np.asarray(q_rad, dtype=float)
        frames = joint_transforms(self.arm, q)[..., 1:, :, :]
        masses, down = np.array(self.masses), np.array(self.down)
        centres = np.einsum("...kij,kj->...ki", frames[..., :3, :3], np.array(self.centres_mm)) + frames[..., :3, 3]
        axes, origins = frames[..., :3, 2], frames[..., :3, 3]
        torques = np.empty(q.shape)
        for joint in range(self.arm.n):
            arms = np.cross(centres[..., joint:, :] - origins[..., joint, None, :], down)
            force = np.einsum("...kj,...j,k->...", arms, axes[..., joint, :], masses[joint:])
            along_axis = np.einsum("...j,j->...", axes[..., joint, :], down) * masses[joint:].sum()
            torques[..., joint] = along_axis if self.arm.prismatic[joint] else force
        reach = float(np.hypot(self.arm.table[:, 1], self.arm.table[:, 2]).sum()) or 1.0
        return torques / (reach * masses.sum())


def uniform_load(arm: MdhArm, down: tuple[float, float, float] = DOWN) -> GravityLoad:
    """Links of the same weight a length, each with its mass half-way to the next joint, and as much again as a load."""
    starts = joint_transforms(arm, np.zeros(arm.n))[1:]
    ends = np.vstack([starts[1:, :3, 3], starts[-1:, :3, 3]])
    centres = np.einsum("kji,kj->ki", starts[:, :3, :3], (ends - starts[:, :3, 3]) / 2)
    masses = 2 * np.linalg.norm(centres, axis=1)
    masses[-1] += max(float(masses.sum()) / 4, 1.0)
    return GravityLoad(
        arm, tuple(map(float, masses)), tuple((float(x), float(y), float(z)) for x, y, z in centres), down
    )


@dataclass(frozen=True)
class JointTerm:
    """One way in which joint number ``joint`` (from 0) leaves its commanded angle, as a function of all angles.

    ``kind`` is ``cos`` or ``sin`` of ``order`` times the angle of joint ``source``; ``sag``, the torque of gravity
    about the joint; or ``coupling``, the angle of joint ``source`` itself.
    """

    joint: int
    kind: str
    order: float = 1.0
    source: int = -1
    load: GravityLoad | None = None

    @property
    def name(self) -> str:
        """Name with unit, as the unknowns have: ``sin2_q3_rad``, ``sag2_rad``, ``coupling_q2_to_q3_rad``."""
        if self.kind == "sag":
            return f"sag{self.joint + 1}_rad"
        if self.kind == "coupling":
            return f"coupling_q{self.source + 1}_to_q{self.joint + 1}_rad"
        return f"{self.kind}{self.order:g}_q{self.joint + 1}_rad"

    def basis(self, q_rad: Floats, torques: Floats | None = None) -> Floats:
        """Values (M,) that the term's coefficient is multiplied with, at joint angles (M, n)."""
        if self.kind == "sag":
            assert self.load is not None
            return (self.load.torques(q_rad) if torques is None else torques)[..., self.joint]
        driver = q_rad[..., self.source if self.source >= 0 else self.joint]
        if self.kind == "coupling":
            return driver
        return np.cos(self.order * driver) if self.kind == "cos" else np.sin(self.order * driver)


def bases_of(terms: Sequence[JointTerm], q_rad: Floats) -> Floats:
    """Values (M, T) of all terms at joint angles (M, n)."""
    load = next((term.load for term in terms if term.load is not None), None)
    torques = None if load is None else load.torques(q_rad)
    columns = [term.basis(q_rad, torques) for term in terms]
    return np.stack(columns, axis=-1) if columns else np.zeros((*q_rad.shape[:-1], 0))


@dataclass(frozen=True)
class JointCorrections:
    """Terms and their coefficients (T,), rad per unit of their basis: what is added to the commanded angles."""

    terms: tuple[JointTerm, ...] = ()
    values: tuple[float, ...] = ()

    def applied(self, q_rad: ArrayLike) -> Floats:
        """Angles (M, n) at which the joints really stand when the controller shows ``q_rad`` (M, n)."""
        q = np.asarray(q_rad, dtype=float)
        if not self.terms:
            return q
        added = bases_of(self.terms, q) * np.array(self.values)
        moved = q.copy()
        for number, term in enumerate(self.terms):
            moved[..., term.joint] += added[..., number]
        return moved

    def changed_by(self, step: ArrayLike) -> JointCorrections:
        """Return the same terms with a step (T,) added to their coefficients."""
        return replace(self, values=tuple(float(a + b) for a, b in zip(self.values, np.asarray(step), strict=True)))


def wave_pair(joint: int, order: float) -> tuple[JointTerm, JointTerm]:
    """The two terms of a wave of ``order`` a turn of joint number ``joint`` (from 0)."""
    return JointTerm(joint, "cos", order), JointTerm(joint, "sin", order)


def wave_terms(arm: MdhArm, orders: Sequence[float] = (1.0, 2.0)) -> tuple[JointTerm, ...]:
    """Gear waves: cos and sin of ``orders`` times the angle of every revolute joint."""
    return tuple(
        term
        for joint in range(arm.n)
        if not arm.prismatic[joint]
        for order in orders
        for term in wave_pair(joint, float(order))
    )


def sag_terms(load: GravityLoad, q_rad: ArrayLike) -> tuple[JointTerm, ...]:
    """Compliance of every joint whose torque of gravity varies over the angles (M, n) that were measured."""
    torques = load.torques(q_rad)
    varies = np.ptp(torques, axis=0) > MIN_TORQUE
    return tuple(JointTerm(int(joint), "sag", load=load) for joint in np.flatnonzero(varies))


def coupling_terms(arm: MdhArm) -> tuple[JointTerm, ...]:
    """Every joint driven along by a joint before it."""
    return tuple(
        JointTerm(joint, "coupling", source=source)
        for joint in range(arm.n)
        for source in range(joint)
        if not arm.prismatic[joint]
    )
