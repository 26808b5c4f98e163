"""Where a coarse fit begins: closed-form solutions of random subsets, the one that most measurements agree with."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from grindvision.arm import MdhArm, forward
from grindvision.calibration.estimate import residuals_of
from grindvision.calibration.measurements import Measurements
from grindvision.calibration.model import ScannerOnArm, carried
from grindvision.errors import DegenerateError
from grindvision.geometry import fit_rigid, inverse, move_points, nearest_rotation, random_rotation, rigid

Floats = NDArray[np.float64]

#: Random subsets tried: with a third of the rows wrong, one of 30 triples is right with probability 1 - 3e-5.
SUBSETS = 30


def median_error(cell: ScannerOnArm, measurements: Measurements) -> float:
    """Median distance in mm between measured and predicted points."""
    return float(np.median(np.linalg.norm(residuals_of(cell, measurements), axis=1)))


def closed_form_errors(
    measurements: Measurements, arm: MdhArm, base_fixed: bool, seed: int = 0, subsets: int = 16
) -> Floats:
    """Errors (M,) in mm that the best closed-form start leaves: a quick look at whether measurements make sense."""
    rng = np.random.default_rng(seed)
    cells = [fixed_base_start(measurements, arm, rng)]
    if not base_fixed:
        cells.append(free_base_starts(measurements, arm, rng, subsets, blind=0)[0])
    lengths = [np.linalg.norm(residuals_of(cell, measurements), axis=1) for cell in cells]
    return min(lengths, key=lambda found: float(np.median(found)))


def unit_factors(measurements: Measurements, arm: MdhArm, seed: int = 0) -> tuple[float, float]:
    """By what the tracker's and the scanner's lengths must be multiplied to fit the arm's, from a linear solution.

    NaN for a reflector on the tool, which has no lengths of its own.
    """
    rng = np.random.default_rng(seed)
    rows = np.arange(len(measurements))
    subsets = [rows] + [rng.choice(rows, 14, replace=False) for _ in range(10) if len(rows) > 14]
    frames = forward(arm, measurements.q_rad)
    found = np.array([_linear_solution(measurements, frames, chosen)[1] for chosen in subsets])
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
    rows, frames = np.arange(len(measurements)), forward(arm, measurements.q_rad)
    parts = [rows] + [rng.choice(rows, 12, replace=False) for _ in range(subsets) if len(rows) > 12]
    rotations = [_linear_solution(measurements, frames, chosen)[0] for chosen in parts]
    cells = [
        _with_rotations(measurements, arm, frames, chosen, *pair) for chosen, pair in zip(parts, rotations, strict=True)
    ]
    cells.sort(key=lambda cell: _median_placed(cell, measurements, frames))
    return [
        *cells[:2],
        *(
            _with_rotations(measurements, arm, frames, rows, random_rotation(rng), random_rotation(rng))
            for _ in range(blind)
        ),
    ]


def _median_placed(cell: ScannerOnArm, measurements: Measurements, frames: Floats) -> float:
    """Median error of a cell whose joint frames (M, 4, 4) are known already."""
    joint = move_points(cell.T_joint_scanner, measurements.scanner_mm)
    base = np.einsum("mij,mj->mi", frames[:, :3, :3], joint) + frames[:, :3, 3]
    off = measurements.tracker_mm - move_points(cell.T_tracker_base, base)
    return float(np.median(np.linalg.norm(off, axis=1)))


def _linear_solution(
    measurements: Measurements, frames: Floats, chosen: NDArray[np.int64]
) -> tuple[tuple[Floats, Floats], tuple[float, float]]:
    """Solve R_bt p_t + t_bt - R_i (R_js s + t_js) = t_i with the entries of both rotations free, then make them so.

    The second pair says how long the solution's rotation matrices are: 1 where tracker and scanner count as the arm.
    """
    T_base_joint, tracker, seen_mm = frames[chosen], measurements.tracker_mm[chosen], measurements.scanner_mm[chosen]
    size = max(float(np.abs(tracker).max()), 1.0)
    columns = _linear_columns(T_base_joint, tracker, seen_mm, size)
    solution = np.linalg.lstsq(columns.reshape(-1, 24), T_base_joint[:, :3, 3].ravel(), rcond=1e-9)[0]
    parts = [part.reshape(3, 3) for part in (solution[:9], solution[12:21])]
    R_base_tracker, R_joint_scanner = (nearest_rotation(part) for part in parts)
    lengths = [float(np.cbrt(abs(np.linalg.det(part)))) / size for part in parts]
    return (R_base_tracker, R_joint_scanner), (lengths[0], lengths[1])


def _linear_columns(T_base_joint: Floats, tracker_mm: Floats, seen_mm: Floats, size: float) -> Floats:
    """Columns (M, 3, 24) of the linear system of ``_linear_solution``; ``size`` scales the readings to about 1."""
    columns = np.zeros((len(tracker_mm), 3, 24))
    for axis in range(3):
        columns[:, axis, 3 * axis : 3 * axis + 3] = tracker_mm / size
        columns[:, axis, 9 + axis] = 1.0
        seen = -T_base_joint[:, :3, axis, None] * seen_mm[:, None, :] / size
        columns[:, :, 12 + 3 * axis : 15 + 3 * axis] = seen
    columns[:, :, 21:] = -T_base_joint[:, :3, :3]
    return columns


def _with_rotations(
    measurements: Measurements,
    arm: MdhArm,
    frames: Floats,
    chosen: NDArray[np.int64],
    R_base_tracker: Floats,
    R_joint_scanner: Floats,
) -> ScannerOnArm:
    """Cell with given rotations and the translations that fit best; a reflector on the tool needs none of its own."""
    if measurements.on_tool:
        R_joint_scanner = np.eye(3)
    T_base_joint, tracker = frames[chosen], measurements.tracker_mm[chosen]
    rotations = T_base_joint[:, :3, :3]
    rotated = np.einsum("mij,mj->mi", rotations, measurements.scanner_mm[chosen] @ R_joint_scanner.T)
    columns = np.concatenate([np.broadcast_to(np.eye(3), rotations.shape), -rotations], axis=2)
    goal = T_base_joint[:, :3, 3] + rotated - tracker @ R_base_tracker.T
    translations = np.linalg.lstsq(columns.reshape(-1, 6), goal.ravel(), rcond=1e-9)[0]
    return ScannerOnArm(arm, rigid(R_joint_scanner, translations[3:]), inverse(rigid(R_base_tracker, translations[:3])))


def track_direction(measurements: Measurements, arm: MdhArm, travel: Floats) -> tuple[Floats, float, float]:
    """Whether the arm rode on a slide by ``travel`` (M,) of some unit while it was measured.

    The linear solution of the starts, with the slide's direction times the length of its unit as three more unknowns.

    Returns:
        That direction (3,) in the base frame, mm a unit, and the median errors in mm without it and with it.
    """
    frames, tracker = forward(arm, measurements.q_rad), measurements.tracker_mm
    columns = _linear_columns(frames, tracker, measurements.scanner_mm, max(float(np.abs(tracker).max()), 1.0))
    travelled = np.multiply.outer((travel - travel.mean()) / np.std(travel), -np.eye(3))
    goal = frames[:, :3, 3]
    medians = []
    for matrix in (columns, np.concatenate([columns, travelled], axis=2)):
        flat = matrix.reshape(-1, matrix.shape[2])
        solution = np.linalg.lstsq(flat, goal.ravel(), rcond=1e-9)[0]
        medians.append(float(np.median(np.linalg.norm(goal - (flat @ solution).reshape(-1, 3), axis=1))))
    return solution[-3:] / np.std(travel), medians[0], medians[1]


def touching_start(measurements: Measurements, arm: MdhArm, base_fixed: bool, seed: int = 0) -> ScannerOnArm:
    """Cell to start from where rows touch sockets or planes, or several reflectors sit on the tool: linear solutions.

    Tracked rows place the base and the tool first, all reflectors taken for one. Sockets without a bar are solved for
    with the tool's point; ``seed`` above 0 begins bars and planes elsewhere, where the first start may fail.

    Raises:
        DegenerateError: neither tracked rows nor sockets to begin with.
    """
    rng = np.random.default_rng(seed)
    reflectors = np.zeros((len(measurements.reflectors), 3))
    if measurements.tracked.any():
        tracked = replace(measurements.rows(measurements.tracked), fixtures=(), reflectors=(), distances_mm=())
        single = tracked
        if measurements.reflectors and measurements.on_tool:
            single = tracked.rows(tracked.reflector == int(np.argmax(np.bincount(tracked.reflector))))
        start = fixed_base_start(single, arm, rng) if base_fixed else free_base_starts(single, arm, rng)[min(seed, 2)]
        if measurements.reflectors and measurements.on_tool:
            reflectors = np.tile(start.T_joint_scanner[:3, 3], (len(reflectors), 1))
            start = replace(start, T_joint_scanner=np.eye(4))
    else:
        start = ScannerOnArm(arm, _tool_in_sockets(measurements, arm), np.eye(4))
    start = replace(start, reflectors_mm=reflectors)
    everywhere = np.arange(len(measurements.fixtures))
    return replace(start, fixtures_mm=_fixture_places(start, measurements, everywhere))


def place_unseen_fixtures(cell: ScannerOnArm, measurements: Measurements, training: Measurements) -> ScannerOnArm:
    """The cell with the fixtures that no training row touches where the rows that do touch them say.

    What such rows leave then is how well the cell makes them meet in one point, plane or sphere.
    """
    unseen = np.setdiff1d(np.arange(len(measurements.fixtures)), np.unique(training.fixture))
    places = cell.fixtures_mm.copy()
    places[unseen] = _fixture_places(cell, measurements, unseen)[unseen]
    return replace(cell, fixtures_mm=places)


def _fixture_places(cell: ScannerOnArm, measurements: Measurements, numbers: NDArray[np.int64]) -> Floats:
    """Places (F, 4) of the fixtures ``numbers`` by the points that touch them; zero for all others."""
    points = carried(cell, measurements).tracker_mm
    places = np.zeros((len(measurements.fixtures), 4))
    for number in numbers:
        own = points[measurements.fixture == number]
        if not len(own):
            continue
        if measurements.fixtures[number][0] == "plane":
            middle = own.mean(axis=0)
            normal = np.linalg.svd(own - middle)[2][2]
            places[number] = np.append(normal, normal @ middle)
            continue
        places[number, :3] = np.median(own, axis=0)
        bars = measurements.bar_mm[measurements.fixture == number]
        if np.isfinite(bars).all():  # all points lie on spheres round the socket
            rows = np.column_stack([2 * own, np.ones(len(own))])
            places[number, :3] = np.linalg.lstsq(rows, (own**2).sum(axis=1) - bars**2, rcond=None)[0][:3]
    return places


def _tool_in_sockets(measurements: Measurements, arm: MdhArm) -> Floats:
    """Where the tool's point sits, T_joint_scanner, if it lay still in every socket: R_i s + t_i = c_k, linear.

    Where only bars and planes are touched, the last joint's origin.
    """
    T_base_joint = forward(arm, measurements.q_rad)
    kinds = np.array([kind == "socket" for kind, _ in measurements.fixtures])
    fixed = kinds[measurements.fixture] & ~np.isfinite(measurements.bar_mm)
    if fixed.sum() < 4:
        return np.eye(4)
    rows = np.flatnonzero(fixed)
    columns = np.zeros((len(rows), 3, 12 + 3 * len(kinds)))
    rotations = T_base_joint[rows, :3, :3]
    columns[:, :, 9:12] = rotations
    seen = measurements.scanner_mm[rows]
    on_tool = measurements.on_tool
    if not on_tool:
        columns[:, :, :9] = np.einsum("mij,mk->mijk", rotations, seen).reshape(len(rows), 3, 9)
    for place, row in enumerate(rows):
        first = 12 + 3 * int(measurements.fixture[row])
        columns[place, :, first : first + 3] = -np.eye(3)
    solution = np.linalg.lstsq(columns.reshape(-1, columns.shape[2]), -T_base_joint[rows, :3, 3].ravel(), rcond=1e-9)[0]
    rotation = np.eye(3) if on_tool else nearest_rotation(solution[:9].reshape(3, 3))
    return rigid(rotation, solution[9:12])
