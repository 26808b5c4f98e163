"""A small measuring rig of the calibration tests: any arm, a scanner, a tracker, white noise; no part of the cell."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from grindvision.arm import MdhArm, read_arm
from grindvision.calibration import Measurements, ScannerOnArm
from grindvision.geometry import random_rotation, rigid, rotation_about

ROBOT = Path(__file__).resolve().parent.parent / "data" / "robots" / "er3a_c60.csv"
UR5 = np.array(
    [
        [0, 0, 89.159, 0, 0],
        [np.pi / 2, 0, 0, 0, 0],
        [0, -425, 0, 0, 0],
        [0, -392.25, 109.15, 0, 0],
        [np.pi / 2, 0, 94.65, 0, 0],
        [-np.pi / 2, 0, 82.3, 0, 0],
    ]
)


@dataclass(frozen=True)
class Rig:
    """A true cell, the nominal arm, and what is measured with them."""

    nominal: MdhArm
    cell: ScannerOnArm
    measurements: Measurements

    def errors_mm(self, cell: ScannerOnArm, count: int = 1000, seed: int = 1) -> np.ndarray:
        """Distances between a cell and the true one at random poses and points of the scanner's field, no noise."""
        rng = np.random.default_rng(seed)
        q, points = rng.uniform(-1.2, 1.2, (count, self.nominal.n)), field_points(rng, count)
        if self.measurements.on_tool:
            points = np.broadcast_to(self.measurements.scanner_mm[0], points.shape)
        return np.linalg.norm(cell.points_tracker(q, points) - self.cell.points_tracker(q, points), axis=1)


def er3a() -> MdhArm:
    return read_arm(ROBOT).first(4)


def ur5() -> MdhArm:
    return MdhArm(UR5, tuple(f"J{i}" for i in range(1, 7)))


def field_points(rng: np.random.Generator, count: int) -> np.ndarray:
    return rng.uniform([-90, -60, 350], [90, 60, 450], (count, 3))


def rig(
    arm: MdhArm,
    rng: np.random.Generator,
    rows: int = 54,
    test: int = 0,
    noise_mm: float = 0.05,
    joint_rad: float = 5e-5,
    base: str = "near",
    on_tool: bool = False,
    off_mm: float = 1.0,
    off_rad: float = 1e-3,
) -> Rig:
    """Measure with an arm off its nominal table by ``off``; the tracker's frame is ``same``, ``near`` or ``far``."""
    deviation = rng.normal(0, [off_rad, off_mm, off_mm, off_rad, 0], (arm.n, 5))
    parallel = (np.abs(np.sin(arm.table[:, 0])) < 0.02) & (np.arange(arm.n) > 0)
    deviation[parallel, 4] = rng.normal(0, off_rad, int(parallel.sum()))
    T_tracker_base = {
        "same": np.eye(4),
        "near": rigid(rotation_about(rng.normal(size=3), 1e-3), rng.normal(0, 0.5, 3)),
        "far": rigid(random_rotation(rng), rng.normal(0, 2000, 3)),
    }[base]
    T_joint_scanner = rigid(random_rotation(rng), rng.normal(0, 100, 3))
    cell = ScannerOnArm(arm.changed_by(deviation), T_joint_scanner, T_tracker_base)
    q = rng.uniform(-1.2, 1.2, (rows + test, arm.n))
    moved = q + joint_rad * rng.normal(size=q.shape)
    points = np.tile([10.0, -20.0, 150.0], (len(q), 1)) if on_tool else field_points(rng, len(q))
    seen = points if on_tool else points + noise_mm * rng.normal(size=points.shape)
    tracker = cell.points_tracker(moved, points) + (noise_mm if on_tool else 0) * rng.normal(size=points.shape)
    train = np.arange(len(q)) < rows
    return Rig(arm, cell, Measurements(q, seen, tracker, train=train))


def as_table(measurements: Measurements, split: bool = True) -> pd.DataFrame:
    columns = [f"q{i + 1}_rad" for i in range(measurements.q_rad.shape[1])]
    columns += [f"{frame}{axis}_mm" for frame in "sb" for axis in "xyz"]
    numbers = np.hstack([measurements.q_rad, measurements.scanner_mm, measurements.tracker_mm])
    table = pd.DataFrame(numbers, columns=columns)
    table.insert(0, "pose", measurements.pose)
    table.insert(1, "sphere", measurements.sphere)
    if split:
        table["split"] = np.where(measurements.train, "train", "test")
    return table
