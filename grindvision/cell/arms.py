"""The grinding robot of diao2018 with its truth, and the laser tracker that watches it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision import paper
from grindvision.arm import MdhArm, forward, read_arm
from grindvision.cell.joint_errors import JointErrors
from grindvision.cell.scanners import Scanner, StructuredLightScanner
from grindvision.data_files import data_folder
from grindvision.errors import InputError
from grindvision.records import by_content

Floats = NDArray[np.float64]

#: The scanner sits on this joint, so only the joints up to it are calibrated.
SCANNER_JOINT = 4

#: Joint limits in rad, low and high, of joints 1 to 4. The ER3A-C60's are not published; these are its successor's.
JOINT_LIMITS_RAD = np.radians([[-170, 170], [-135, 85], [-65, 185], [-190, 190]])


def nominal_arm() -> MdhArm:
    """First four joints of the ER3A-C60 as its data sheet has them: what the controller believes.

    Raises:
        FileError: ``data/robots/er3a_c60.csv`` is missing or damaged.
    """
    return read_arm(data_folder() / "robots" / "er3a_c60.csv").first(SCANNER_JOINT)


def true_arm() -> MdhArm:
    """The nominal arm with the printed corrections of diao2018 Table 2 taken for the truth."""
    return nominal_arm().changed_by(paper.mdh_corrections())


@by_content
@dataclass(frozen=True)
class LaserTracker:
    """A tracker like the AT960: noise ``fixed_um`` plus ``per_metre_um`` times the distance, one sigma per axis.

    The defaults are a third of the maximum permissible error of 15 um + 6 um/m. ``T_tracker_base`` is the pose of its
    frame against the arm's base, which nobody knows exactly; ``station_mm`` (3,) is where it stands, in the base frame.
    """

    T_tracker_base: Floats
    station_mm: Floats = field(default_factory=lambda: np.array([2500.0, -1500.0, 500.0]))
    fixed_um: float = 5.0
    per_metre_um: float = 2.0

    def measure(self, points_base: ArrayLike, rng: np.random.Generator) -> Floats:
        """Measured positions (N, 3) in the tracker frame of points (N, 3) given in the base frame, mm."""
        points = np.asarray(points_base, dtype=float)
        metres = np.linalg.norm(points - self.station_mm, axis=1) / 1000
        noise = (self.fixed_um + self.per_metre_um * metres) / 1000
        seen = points @ self.T_tracker_base[:3, :3].T + self.T_tracker_base[:3, 3]
        return seen + noise[:, None] * rng.standard_normal(points.shape)


@by_content
@dataclass(frozen=True)
class GrindingRobot:
    """The arm with the scanner on joint 4: what the controller believes, and what is true.

    ``joint_noise_deg`` is the standard deviation of every joint about its commanded angle, new at each move: 0.003 deg
    move the scanner by about the arm's stated repeatability of 0.02 mm. ``joint_errors`` are gear waves and sag that
    repeat with the angles; the twin of the paper has none.
    """

    nominal: MdhArm = field(default_factory=nominal_arm)
    true: MdhArm = field(default_factory=true_arm)
    T_joint4_scanner_nominal: Floats = field(default_factory=lambda: paper.hand_eye("coarse"))
    T_joint4_scanner: Floats = field(default_factory=lambda: paper.hand_eye("accurate"))
    scanner: Scanner = field(default_factory=StructuredLightScanner)
    joint_noise_deg: float = 0.003
    joint_errors: JointErrors | None = None

    def __post_init__(self) -> None:
        if not self.joint_noise_deg >= 0:
            raise InputError(f"joint_noise_deg is {self.joint_noise_deg}; it must be zero or above")

    def believed_poses(self, q_rad: ArrayLike) -> Floats:
        """T_base_scanner (..., 4, 4) as the controller computes it for joint angles (..., 4) before any calibration."""
        return forward(self.nominal, q_rad) @ self.T_joint4_scanner_nominal

    def exact_poses(self, q_rad: ArrayLike) -> Floats:
        """True T_base_scanner (..., 4, 4) at commanded joint angles (..., 4), without the noise of a move."""
        stands = q_rad if self.joint_errors is None else self.joint_errors.applied(q_rad)
        return forward(self.true, stands) @ self.T_joint4_scanner

    def move(self, q_rad: ArrayLike, rng: np.random.Generator) -> Floats:
        """True T_base_scanner (..., 4, 4) after a move to commanded joint angles (..., 4): they are met only nearly."""
        q = np.asarray(q_rad, dtype=float)
        return self.exact_poses(q + np.radians(self.joint_noise_deg) * rng.standard_normal(q.shape))
