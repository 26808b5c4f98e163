"""grindvision's own racers of calibration: the public functions at their defaults."""

from __future__ import annotations

import pandas as pd

from benchmarks.peers.hand_eye_peers import each
from benchmarks.peers.laps import Answer, Laps
from grindvision.arm import read_arm
from grindvision.calibration import calibrate as fit_cell
from grindvision.calibration import read_measurements
from grindvision.calibration.hand_eye import hand_eye as fit_camera


def calibrate(train: str, test: str, robot: str) -> Answer:
    """Scanner, arm and base from measurements; then the held-out spheres in the tracker's frame."""
    lap = Laps()
    arm = read_arm(robot).first(4)
    measurements, held_out = read_measurements(train, arm.n), pd.read_csv(test)
    lap("read")
    found = fit_cell(measurements, arm)
    lap("calibrate")
    q_rad, seen_mm = held_out.filter(regex="q._rad").to_numpy(), held_out.filter(regex="s._mm").to_numpy()
    return {"held_out": found.cell.points_tracker(q_rad, seen_mm), "laps_s": lap.laps_s}


def hand_eye(sequences: str) -> Answer:
    """The camera's place of every sequence of poses."""
    return each(sequences, lambda flange, board: fit_camera(flange, board).T_parent_camera)
