"""Where a coarse fit begins: closed-form solutions of random subsets, the one that most measurements agree with."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grindvision.arm import MdhArm, forward
from grindvision.calibration.estimate import residuals_of
from grindvision.calibration.measurements import Measurements
from grindvision.calibration.model import ScannerOnArm
from grindvision.errors import DegenerateError
from grindvision.geometry import fit_rigid, inverse, move_points, nearest_rotation, random_rotation, rigid

Floats = NDArray[np.float64]

#: Random subsets tried: with a third of the rows wrong, one of 30 triples is right with probability 1 - 3e-5.
SUBSETS = 30


def median_error(cell: ScannerOnArm, measurements: Measurements) -> float:
    """Median distance in mm between measured and predicted points."""
    return float(np.median(np.linalg.norm(residuals_of(cell, measurements), axis=1)))


def closed_form_errors(measurements: Measurements, arm: MdhArm, base_fixed: bool, subsets: int = SUBSETS) -> Floats:
    """Errors (M,) in mm that the best closed-form start leaves: a quick look at whether measurements make sense."""
    rng = np.random.default_rng(0)
    cells = [fixed_base_start(measurements, arm, rng)]
    if not base_fixed:
        cells.append(free_base_starts(measurements, arm, rng, subsets, blind=0)[0])
    lengths = [np.linalg.norm(residuals_of(cell, measurements), axis=1) for cell in cells]
    return min(lengths, key=lambda found: float(np.median(found)))


def unit_factors(measurements: Measurements, arm: MdhArm) -> tuple[float, float]:
    """By what the tracker's and the scanner's lengths must be multiplied to fit the arm's, from a linear solution.

    NaN for a reflector on the tool, which has no lengths of its own.
    """
    rng = np.random.default_rng(0)
    rows = np.arange(len(measurements))
    subsets = [rows] + [rng.choice(rows, 14, replace=False) for _ in range(10) if len(rows) > 14]
    found = np.array([_linear_solution(measurements.rows(chosen), arm)[1] for chosen in subsets])
    tracker, scanner = (float(value) for value in np.median(found, axis=0))
    return tracker, np.nan if measurements.on_tool else scanner


def fixed_base_start(measurements: Measurements, arm: MdhArm, rng: np.random.Generator) -> ScannerOnArm:
    """Scanner's place, base fixed, by a rigid fit of all rows or of three, whichever leaves the least median error."""
    T_base_joint = forward(arm, measurements.q_rad)
    points = np.einsum("mji,mj->mi", T_base_joint[:, :3, :3], measurements.tracker_mm - T_base_joint[:, :3, 3])
    if measurements.on_tool:
        place = rigid(translation_mm=np.median(points, axis=0) - measurements.scanner_mm[0])
        return ScannerOnArm(arm, place, np.eye(4))
    rows = np.arange(len(measurements))
    places = []
    for chosen in [rows, *(rng.choice(rows, 3, replace=False) for _ in range(SUBSETS))]:
        try:
            places.append(fit_rigid(measurements.scanner_mm[chosen], points[chosen]).T_target_source)
        except DegenerateError:
            continue
    if not places:
        raise DegenerateError("the spheres lie on one line in the scanner's or the joint's frame; spread them")
    best = min(
        places,
        key=lambda place: np.median(np.linalg.norm(points - move_points(place, measurements.scanner_mm), axis=1)),
    )
    return ScannerOnArm(arm, best, np.eye(4))


def free_base_starts(
    measurements: Measurements, arm: MdhArm, rng: np.random.Generator, subsets: int = SUBSETS, blind: int = 2
) -> list[ScannerOnArm]:
    """Cells to start from, most promising first: linear solutions of all rows and of subsets, then blind rotations."""
    rows = np.arange(len(measurements))
    parts = [rows] + [rng.choice(rows, 12, replace=False) for _ in range(subsets) if len(rows) > 12]
    cells = [_linear_start(measurements.rows(chosen), arm) for chosen in parts]
    cells.sort(key=lambda cell: median_error(cell, measurements))
    return [
        *cells[:2],
        *(_with_rotations(measurements, arm, random_rotation(rng), random_rotation(rng)) for _ in range(blind)),
    ]


def _linear_start(measurements: Measurements, arm: MdhArm) -> ScannerOnArm:
    (R_base_tracker, R_joint_scanner), _ = _linear_solution(measurements, arm)
    return _with_rotations(measurements, arm, R_base_tracker, R_joint_scanner)


def _linear_solution(measurements: Measurements, arm: MdhArm) -> tuple[tuple[Floats, Floats], tuple[float, float]]:
    """Solve R_bt p_t + t_bt - R_i (R_js s + t_js) = t_i with the entries of both rotations free, then make them so.

    The second pair says how long the solution's rotation matrices are: 1 where tracker and scanner count as the arm.
    """
    T_base_joint = forward(arm, measurements.q_rad)
    size = max(float(np.abs(measurements.tracker_mm).max()), 1.0)
    columns = np.zeros((len(measurements), 3, 24))
    for axis in range(3):
        columns[:, axis, 3 * axis : 3 * axis + 3] = measurements.tracker_mm / size
        columns[:, axis, 9 + axis] = 1.0
        seen = -T_base_joint[:, :3, axis, None] * measurements.scanner_mm[:, None, :] / size
        columns[:, :, 12 + 3 * axis : 15 + 3 * axis] = seen
    columns[:, :, 21:] = -T_base_joint[:, :3, :3]
    solution = np.linalg.lstsq(columns.reshape(-1, 24), T_base_joint[:, :3, 3].ravel(), rcond=1e-9)[0]
    parts = [part.reshape(3, 3) for part in (solution[:9], solution[12:21])]
    R_base_tracker, R_joint_scanner = (nearest_rotation(part) for part in parts)
    lengths = [float(np.cbrt(abs(np.linalg.det(part)))) / size for part in parts]
    return (R_base_tracker, R_joint_scanner), (lengths[0], lengths[1])


def _with_rotations(
    measurements: Measurements, arm: MdhArm, R_base_tracker: Floats, R_joint_scanner: Floats
) -> ScannerOnArm:
    """Cell with given rotations and the translations that fit best; a reflector on the tool needs none of its own."""
    if measurements.on_tool:
        R_joint_scanner = np.eye(3)
    T_base_joint = forward(arm, measurements.q_rad)
    turns = T_base_joint[:, :3, :3]
    turned = np.einsum("mij,mj->mi", turns, measurements.scanner_mm @ R_joint_scanner.T)
    columns = np.concatenate([np.broadcast_to(np.eye(3), turns.shape), -turns], axis=2)
    goal = T_base_joint[:, :3, 3] + turned - measurements.tracker_mm @ R_base_tracker.T
    shifts = np.linalg.lstsq(columns.reshape(-1, 6), goal.ravel(), rcond=1e-9)[0]
    return ScannerOnArm(arm, rigid(R_joint_scanner, shifts[3:]), inverse(rigid(R_base_tracker, shifts[:3])))
