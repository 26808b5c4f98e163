"""What the joints of a true arm do beyond its geometry: gear waves, and sag under the arm's own weight."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.arm import MdhArm, joint_transforms
from grindvision.errors import InputError
from grindvision.records import by_content

Floats = NDArray[np.float64]

#: Standard gravity, m/s2.
GRAVITY = 9.80665


@by_content
@dataclass(frozen=True)
class JointErrors:
    """By how much every one of n joints leaves its commanded angle, as a function of all commanded angles.

    ``waves_rad`` (n, 2, 2): amplitudes of cos and sin (last axis) of one and of two waves a turn. ``compliance_rad_nm``
    (n,): turn of a joint by 1 Nm. ``masses_kg`` (n,) stand at ``centres_mm`` (n, 3) of the links' frames of ``arm``;
    gravity points along ``down`` (3,), base frame.
    """

    arm: MdhArm
    waves_rad: Floats
    compliance_rad_nm: Floats
    masses_kg: Floats
    centres_mm: Floats
    down: Floats = field(default_factory=lambda: np.array([0.0, 0.0, -1.0]))

    def __post_init__(self) -> None:
        n = self.arm.n
        for name, shape in (
            ("waves_rad", (n, 2, 2)),
            ("compliance_rad_nm", (n,)),
            ("masses_kg", (n,)),
            ("centres_mm", (n, 3)),
            ("down", (3,)),
        ):
            array = np.array(getattr(self, name), dtype=float)
            if array.shape != shape or not np.isfinite(array).all():
                raise InputError(f"{name} has shape {array.shape}; {shape} of finite numbers needed")
            object.__setattr__(self, name, array)

    def torques_nm(self, q_rad: ArrayLike) -> Floats:
        """Torque of gravity (..., n) about every joint at joint angles (..., n), Nm."""
        frames = joint_transforms(self.arm, np.asarray(q_rad, dtype=float))[..., 1:, :, :]
        centres = np.einsum("...kij,kj->...ki", frames[..., :3, :3], self.centres_mm) + frames[..., :3, 3]
        weights = GRAVITY * self.masses_kg[:, None] * self.down
        torques = np.empty(frames.shape[:-2])
        for joint in range(self.arm.n):
            levers = (centres[..., joint:, :] - frames[..., joint, None, :3, 3]) / 1000
            moment = np.cross(levers, weights[joint:]).sum(axis=-2)
            torques[..., joint] = (moment * frames[..., joint, :3, 2]).sum(axis=-1)
        return torques

    def applied(self, q_rad: ArrayLike) -> Floats:
        """Angles (..., n) at which the joints stand when (..., n) are commanded, rad."""
        q = np.asarray(q_rad, dtype=float)
        waves = np.zeros(q.shape)
        for order in (1, 2):
            cosine, sine = self.waves_rad[:, order - 1].T
            waves += cosine * np.cos(order * q) + sine * np.sin(order * q)
        return q + waves + self.compliance_rad_nm * self.torques_nm(q)

    def __str__(self) -> str:
        largest = np.degrees(np.hypot(self.waves_rad[..., 0], self.waves_rad[..., 1]).max())
        return f"gear waves up to {largest:.3f} deg, compliance up to {1e6 * self.compliance_rad_nm.max():.1f} urad/Nm"


def drawn_joint_errors(
    arm: MdhArm, rng: np.random.Generator, wave_deg: float = 0.012, sag_deg: float = 0.03, mass_kg: float = 45.0
) -> JointErrors:
    """Joint errors at random: waves of ``wave_deg`` and, stretched out, sag of ``sag_deg`` (standard deviations).

    The links share ``mass_kg`` in random parts, each with its mass between the joint and the next one.
    """
    n = arm.n
    masses = mass_kg * rng.dirichlet(np.full(n, 4.0))
    frames = joint_transforms(arm, np.zeros(n))[1:]
    following = np.vstack([frames[1:, :3, 3], frames[-1:, :3, 3] + 100.0 * frames[-1:, :3, 2]])
    along = rng.uniform(0.2, 0.8, (n, 1)) * (following - frames[:, :3, 3])
    centres = np.einsum("kji,kj->ki", frames[:, :3, :3], along) + rng.normal(0, 20.0, (n, 3))
    waves = rng.normal(0, np.radians(wave_deg), (n, 2, 2))
    still = JointErrors(arm, waves, np.zeros(n), masses, centres)
    largest = np.abs(still.torques_nm(rng.uniform(-np.pi, np.pi, (200, n)))).max(axis=0)
    sag = np.abs(rng.normal(0, np.radians(sag_deg), n)) / np.maximum(largest, 1.0)
    return JointErrors(arm, waves, sag, masses, centres)
