"""The whole chain of diao2018 on its twin: arm, scanner, calibration, registration and path, each error to switch.

One case is one robot cell: an instrument and a tracker are drawn, the cell is calibrated, the good part is scanned
once, and the part with the bead from four orientations of the arm. Every path is brought into the base frame by the
calibrated cell at the commanded joint angles; truth serves the comparison and the sources switched off, nothing else.
"""

from __future__ import annotations

import pickle
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache, lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from grindvision.calibration import Measurements, Options, ScannerOnArm, calibrate
from grindvision.cell import (
    CalibrationPlan,
    GrindingRobot,
    LaserTracker,
    Scan,
    Scanner,
    StructuredLightScanner,
    Target,
    calibration_plan,
    measured,
    misaligned_tracker,
)
from grindvision.errors import DegenerateError
from grindvision.geometry import inverse, move_points, rotate_vectors, rotation_about, vector_angle
from grindvision.vision.change.oriented_box import BoxPath
from grindvision.vision.change.ridge_path import BeadPath, trace_bead
from grindvision_book.chapter_08.registered import (
    RegisteredPair,
    pairs_from_fixture,
    pairs_from_nothing,
    pairs_in_place,
)
from grindvision_book.chapter_08.workplace import Workplace, workplace

if TYPE_CHECKING:
    import pandas as pd

Floats = NDArray[np.float64]

COORDINATES = ["x_mm", "y_mm", "z_mm"]

#: Commanded angles of joints 1 to 4. D1 comes nearest to the pose that Tables 3 and 4 imply; the paper does not state
#: D2 to D4: these see the same spot from the same side of the arm, turned by 30 to 65 deg.
ORIENTATIONS_DEG = {
    "D1": (-51.05, -75.12, 17.86, -5.29),
    "D2": (-57.0, -83.0, 37.0, -74.0),
    "D3": (-49.0, -83.0, 27.0, 36.0),
    "D4": (-55.0, -87.0, 39.0, -40.0),
}

#: What can be wrong, as the keywords of ``compound_case``.
SOURCES = ("scanner_noise", "field_distortion", "registration", "joint_repeatability", "calibration")

#: Scanner errors that are new in every point; the others are the same in every scan of one instrument.
RANDOM_ERRORS = ("white_mm", "triangulation_px", "correlated_px", "mixed_pixels")


def compound_paths(
    rng: np.random.Generator,
    scanner_noise: bool = True,
    field_distortion: bool = True,
    registration: bool = True,
    joint_repeatability: bool = True,
    calibration: bool = True,
    around_mm: float | None = 25.0,
    points: int = 6,
) -> pd.DataFrame:
    """Paths of one robot cell found from the four orientations, base frame.

    A source switched off is replaced by the truth, the rest of the chain stays as it is. The calibration experiment
    itself always has all its errors.

    Args:
        rng: draws instrument, tracker, calibration, the sample's place and all noise.
        around_mm: the test scans keep a square of this half side around the bead, the sample's a square as wide as
            its diagonal, and both parts are known to stand in one fixture (``pairs_from_fixture``); None keeps the
            whole field, and registers each orientation from nothing.
        points: path points.

    Returns:
        ``orientation, point, x_mm, y_mm, z_mm, nx, ny, nz``; ``off_x_mm, off_y_mm, off_z_mm`` from the true ridge to
        the point, square to the ridge; ``slip_mm`` along it; ``normal_off_deg`` from the true normal.

    Raises:
        DegenerateError: registration or path failed, as ``detect`` says.
    """
    place = workplace()
    pairs, believed = _registered(
        rng,
        place,
        registration,
        around_mm,
        scanner_noise=scanner_noise,
        field_distortion=field_distortion,
        joint_repeatability=joint_repeatability,
        calibration=calibration,
    )
    return _compared(place, believed, [trace_bead(pair.piece(), points) for pair in pairs])


def compound_case(rng: np.random.Generator, boxes: bool = False, **settings: Any) -> dict[str, float]:
    """``compound_paths`` in numbers: a case of a study.

    ``spread_x_mm`` (y, z): widest spread of corresponding points over the path; ``spread_rms_mm``: rms distance of
    points from the middle of those that correspond. ``off_x_mm`` (y, z): rms of the vectors from the ridge; ``off_mm``
    their mean length, ``largest_off_mm`` the largest; ``normal_off_deg`` median. With ``boxes`` the same for the
    paper's boxes on the same scans, each name with ``boxes_`` before it; NaN where they give no path.
    """
    place = workplace()
    pairs, believed = _registered(rng, place, **settings)
    pieces = [pair.piece() for pair in pairs]
    found = _in_numbers(_compared(place, believed, [trace_bead(piece, 6) for piece in pieces]))
    if not boxes:
        return found
    try:
        paths = [pair.boxes(piece, 6) for pair, piece in zip(pairs, pieces, strict=True)]
        others = _in_numbers(_compared(place, believed, paths))
    except DegenerateError:
        others = dict.fromkeys(found, np.nan)
    return found | {f"boxes_{name}": value for name, value in others.items()}


def whole_field_case(rng: np.random.Generator) -> dict[str, float]:
    """``compound_case`` on whole fields, each registered from nothing, and what that changes.

    ``apart_mm`` is the largest distance of its 24 path points from those that the same surfels give under the
    registrations from the fixture, as in a window.
    """
    place = workplace()
    sample, tests, believed = _scans(rng, place, around_mm=None)
    pairs, known = pairs_from_nothing(sample, tests), pairs_from_fixture(sample, tests, believed, rng)
    others = [pair.at(one.registration.T_target_source) for pair, one in zip(pairs, known, strict=True)]
    paths, again = (
        _compared(place, believed, [trace_bead(pair.piece(), 6) for pair in way]) for way in (pairs, others)
    )
    apart = (paths[COORDINATES] - again[COORDINATES]).pow(2).sum(axis=1).max() ** 0.5
    return {**_in_numbers(paths), "apart_mm": float(apart)}


def _registered(
    rng: np.random.Generator,
    place: Workplace,
    registration: bool = True,
    around_mm: float | None = 25.0,
    **sources: bool,
) -> tuple[list[RegisteredPair], list[Floats]]:
    """One robot cell's four registered pairs, and the poses T_base_scanner (4, 4) that it believes."""
    sample, tests, believed = _scans(rng, place, around_mm=around_mm, **sources)
    if not registration:
        return pairs_in_place(sample, tests), believed
    if around_mm is None:
        return pairs_from_nothing(sample, tests), believed
    return pairs_from_fixture(sample, tests, believed, rng), believed


def _scans(
    rng: np.random.Generator,
    place: Workplace,
    scanner_noise: bool = True,
    field_distortion: bool = True,
    joint_repeatability: bool = True,
    calibration: bool = True,
    around_mm: float | None = 25.0,
) -> tuple[Scan, list[Scan], list[Floats]]:
    """One robot cell's scans of the good part and from the four orientations, and the poses T_base_scanner (4, 4) that
    it believes."""
    robot, tracker, calibrated, rng.bit_generator.state = _drawn_cell(pickle.dumps(rng))
    instrument = robot.scanner
    left_out = [*(() if scanner_noise else RANDOM_ERRORS), *(() if field_distortion else ("distortion_mm", "scale"))]
    scanner = instrument.with_errors(instrument.errors.without(*left_out))
    repeatability = robot.joint_noise_deg if joint_repeatability else 0.0
    robot = replace(robot, scanner=scanner, joint_noise_deg=repeatability)

    tests, believed = [], []
    for angles in ORIENTATIONS_DEG.values():
        q_rad = np.radians(angles)
        T_part_scanner = inverse(place.T_base_part) @ robot.move(q_rad, rng)
        tests.append(_scan_of_spot(place, place.faulty, scanner, T_part_scanner, rng, around_mm))
        believed.append(_believed_pose(calibrated, tracker, q_rad) if calibration else robot.exact_poses(q_rad))
    wider_mm = None if around_mm is None else np.sqrt(2) * around_mm
    sample = _scan_of_spot(place, place.good, scanner, _view_of_good_part(place, scanner, rng), rng, wider_mm)
    return sample, tests, believed


def _compared(place: Workplace, believed: list[Floats], found_paths: Sequence[BeadPath | BoxPath]) -> pd.DataFrame:
    """Found paths in the base frame against the truth: the columns of ``compound_paths``."""
    import pandas as pd

    rows = []
    for name, T_base_scanner, path in zip(ORIENTATIONS_DEG, believed, found_paths, strict=True):
        found, normals = move_points(T_base_scanner, path.points), rotate_vectors(T_base_scanner, path.normals)
        if (found[-1] - found[0]) @ (place.bead.ridge_mm[-1] - place.bead.ridge_mm[0]) < 0:
            found, normals = found[::-1], normals[::-1]
        off, slip, true_normals = place.compared(found)
        tilt = np.degrees(vector_angle(normals, true_normals))
        rows += [(name, i + 1, *found[i], *normals[i], *off[i], slip[i], tilt[i]) for i in range(len(found))]
    columns = [*COORDINATES, "nx", "ny", "nz", "off_x_mm", "off_y_mm", "off_z_mm", "slip_mm"]
    return pd.DataFrame(rows, columns=["orientation", "point", *columns, "normal_off_deg"])


def _in_numbers(paths: pd.DataFrame) -> dict[str, float]:
    apart = spreads(paths)
    coordinates = paths[COORDINATES]
    from_middle = coordinates - coordinates.groupby(paths["point"]).transform("mean")
    off = off_ridge(paths)
    lengths = np.linalg.norm(off, axis=1)
    return {
        **{f"spread_{axis}_mm": float(apart[f"{axis}_mm"].max()) for axis in "xyz"},
        "spread_rms_mm": float(np.sqrt(from_middle.pow(2).sum(axis=1).mean())),
        **{f"off_{axis}_mm": float(np.sqrt((off[:, i] ** 2).mean())) for i, axis in enumerate("xyz")},
        "off_mm": float(lengths.mean()),
        "largest_off_mm": float(lengths.max()),
        "normal_off_deg": float(paths["normal_off_deg"].median()),
    }


def spreads(paths: pd.DataFrame) -> pd.DataFrame:
    """How far corresponding points lie apart, largest minus smallest coordinate: ``point, x_mm, y_mm, z_mm``."""
    by_point = paths.groupby("point")[COORDINATES]
    return (by_point.max() - by_point.min()).reset_index()


def off_ridge(paths: pd.DataFrame) -> Floats:
    """Vectors (N, 3) from the true ridge to the path points, base frame."""
    return paths[["off_x_mm", "off_y_mm", "off_z_mm"]].to_numpy()


def calibration_case(rng: np.random.Generator, scanned: bool) -> dict[str, float]:
    """How far a calibrated cell alone puts the bead's middle from its true place: ``off_mm``, rms over D1 to D4.

    With ``scanned`` every sphere is scanned, cut out and fitted; else its centre's error comes from the error model.
    """
    robot, tracker = (
        replace(_robot(), scanner=StructuredLightScanner(serial=int(rng.integers(2**31)))),
        misaligned_tracker(rng),
    )
    calibrated = calibrated_cell(robot, tracker, rng, every=3 if scanned else None)
    middle, squares = workplace().bead.ridge_mm.mean(axis=0), []
    for angles in ORIENTATIONS_DEG.values():
        q_rad = np.radians(angles)
        seen = move_points(inverse(robot.exact_poses(q_rad)), middle)
        squares.append(((move_points(_believed_pose(calibrated, tracker, q_rad), seen) - middle) ** 2).sum())
    return {"off_mm": float(np.sqrt(np.mean(squares)))}


def calibrated_cell(
    robot: GrindingRobot, tracker: LaserTracker, rng: np.random.Generator, every: int | None = None
) -> ScannerOnArm:
    """Calibrate the robot as experiment 2 does: nine spheres, six directions each, and a tracker.

    ``every``: see ``cell.measured``; by default the error of a sphere's centre comes from the error model.
    """
    table = measured(_plan(), robot, tracker, rng, every).table
    joints, seen, tracked = (
        [f"q{i}_rad" for i in range(1, 5)], ["sx_mm", "sy_mm", "sz_mm"], ["bx_mm", "by_mm", "bz_mm"],
    )  # fmt: skip
    q_rad, seen_mm, tracked_mm = (table[columns].to_numpy() for columns in (joints, seen, tracked))
    measurements = Measurements(
        q_rad,
        seen_mm,
        tracked_mm,
        sphere=table["sphere"].astype(str).to_numpy(),
    )
    return calibrate(measurements, robot.nominal, Options(diagnose=False)).cell


@lru_cache(maxsize=8)
def _drawn_cell(pickled_rng: bytes) -> tuple[GrindingRobot, LaserTracker, ScannerOnArm, Mapping[str, Any]]:
    """A robot with its scanner, its tracker, what calibration makes of them, and the generator's state afterwards.

    The last few are kept: an error budget asks for one cell once with every setting.
    """
    rng = pickle.loads(pickled_rng)
    robot = replace(_robot(), scanner=StructuredLightScanner(serial=int(rng.integers(2**31))))
    tracker = misaligned_tracker(rng)
    return robot, tracker, calibrated_cell(robot, tracker, rng), rng.bit_generator.state


@cache
def _robot() -> GrindingRobot:
    """The robot of every cell, but for its own scanner; its tables are read once."""
    return GrindingRobot()


@cache
def _plan() -> CalibrationPlan:
    """Where the spheres stand and from where they are seen: the same for every robot cell."""
    return calibration_plan(_robot(), np.random.default_rng(2), test_spheres=0)


def _believed_pose(calibrated: ScannerOnArm, tracker: LaserTracker, q_rad: Floats) -> Floats:
    """T_base_scanner (4, 4) by the calibrated cell, in the base frame as the tracker defines it.

    Base and arm cannot be told apart by calibration, only their product: it is compared through the tracker's frame.
    """
    in_tracker = calibrated.points_tracker(np.tile(q_rad, (4, 1)), np.vstack([np.zeros(3), np.eye(3)]))
    T_tracker_scanner = np.eye(4)
    T_tracker_scanner[:3, :3] = (in_tracker[1:] - in_tracker[0]).T
    T_tracker_scanner[:3, 3] = in_tracker[0]
    return inverse(tracker.T_tracker_base) @ T_tracker_scanner


def _scan_of_spot(
    place: Workplace,
    part: Target,
    scanner: Scanner,
    T_part_scanner: Floats,
    rng: np.random.Generator,
    around_mm: float | None,
) -> Scan:
    """Scan a part; of the field only a square of half side ``around_mm`` about the bead's middle, unless None."""
    window = None
    if around_mm is not None:
        x, y, z = move_points(inverse(place.T_base_part @ T_part_scanner), place.bead.ridge_mm.mean(axis=0))
        per_mm = scanner.focal_px / z
        column, row, reach = x * per_mm + scanner.columns / 2, y * per_mm + scanner.rows / 2, around_mm * per_mm
        window = (int(column - reach), int(column + reach), int(row - reach), int(row + reach))
    return scanner.measure(scanner.sight(part, T_part_scanner, 1, window), rng)


def _view_of_good_part(place: Workplace, scanner: Scanner, rng: np.random.Generator) -> Floats:
    """Pose T_part_scanner (4, 4) 400 mm away, turned about 25 deg from the printed view towards facing the plate."""
    T_part_test = inverse(place.T_base_part) @ place.T_base_scanner
    axis = np.cross(T_part_test[:3, 2], [0.0, 0.0, -1.0]) + 0.3 * rng.standard_normal(3)
    T_part_scanner = np.eye(4)
    T_part_scanner[:3, :3] = rotation_about(axis, np.radians(25.0)) @ T_part_test[:3, :3]
    middle = move_points(inverse(place.T_base_part), place.bead.ridge_mm.mean(axis=0))
    T_part_scanner[:3, 3] = [0.0, middle[1], 0.0] - scanner.reference_mm * T_part_scanner[:3, 2]
    return T_part_scanner
