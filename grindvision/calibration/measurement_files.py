"""Measurement tables as files: which columns say joint angles, tracker readings, orientations, sockets, planes."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from grindvision.calibration.measurements import COVARIANCE_COLUMNS, Measurements
from grindvision.errors import FileError, InputError
from grindvision.files import column_names, read_table

if TYPE_CHECKING:
    import pandas as pd

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

#: Joint angles that differ by less (rad) are one pose, visited again: 0.01 deg, what a controller repeats to.
SAME_POSE_RAD = 2e-4

#: A measured pose becomes its point and three points so far (mm) along its axes: what a tool is long.
LEVER_MM = 150.0

JOINT = re.compile(r"q(\d+)_(?:rad|deg|mm|m)")
LABELS = ("pose", "sphere", "split", "reflector", "socket", "to_socket", "plane")
ROTATION_VECTOR, QUATERNION = ("brx_rad", "bry_rad", "brz_rad"), ("bqw", "bqx", "bqy", "bqz")
KNOWN = re.compile(
    rf"{JOINT.pattern}|[sb][xyz]_m?m|br[xyz]_(?:rad|deg)|(?:bar|distance)_m?m|"
    + "|".join([*LABELS, *QUATERNION, *COVARIANCE_COLUMNS])
)
KNOWN_WORDS = (
    "q1_rad or q1_deg ... (prismatic: _mm or _m), sx_mm .. sz_mm, bx_mm .. bz_mm (or _m), brx_rad .. brz_rad,"
    " bqw .. bqz, pose, sphere, split, reflector, socket, bar_mm, to_socket, distance_mm, plane"
)


def read_measurements(
    path: str | Path,
    joints: int | None = None,
    columns: Mapping[str, str] | None = None,
    prismatic: Collection[int] = (),
) -> Measurements:
    """Read ``pose,sphere,q1_rad..qN_rad,sx_mm..sz_mm,bx_mm..bz_mm[,split]`` for an arm of ``joints`` joints.

    Angles may be given in degrees (``q1_deg``), lengths in metres (``bx_m``). Where no ``s`` column stands, the
    tracker's reflector sits on the tool. Left out, ``pose`` is the number of the first row with the same joint angles
    and ``sphere`` is ``pose``, so that a pose visited again is held out as one. Six further columns
    ``COVARIANCE_COLUMNS`` are used where present. Without ``split`` every row is a training row.

    ``brx_rad..brz_rad`` (rotation vector) or ``bqw..bqz`` (quaternion) give the tool's orientation in the tracker's
    frame: the row becomes four points of one pose. ``reflector`` names several reflectors on the tool. Instead of
    ``b`` columns, ``socket`` names a fixed unknown point in which the ball lies, with ``bar_mm`` the length of a ball
    bar from it, or ``plane`` a fixed unknown plane that the tip touches; an empty cell means none, then ``b`` is
    needed. ``to_socket`` and ``distance_mm`` give a known distance between two sockets.

    Args:
        path: file.
        joints: of the arm; left out: as many as the file has.
        columns: our name of columns that the file calls otherwise, see ``read_table``.
        prismatic: numbers (from 0) of joints that count in mm, as ``q1_mm``.

    Returns:
        M rows: joint angles (M, n) in rad, the sphere's centre (M, 3) in mm in the frames of scanner and tracker.

    Raises:
        FileError: missing or damaged file, a column missing, text or NaN where a number belongs, a split that is
            neither train nor test; the message names row and column.

    Example:
        >>> from grindvision import SimulateOptions, read_measurements, simulate
        >>> made = simulate("calibration", SimulateOptions(seed=1, every=16))
        >>> made.table.to_csv("measurements.csv", index=False)
        >>> measurements = read_measurements("measurements.csv", joints=4)
        >>> measurements.q_rad.shape, measurements.scanner_mm.shape
        ((114, 4), (114, 3))
    """
    columns = _checked_names(columns or {})
    names = {*column_names(path), *columns}
    count = _joint_count(path, names, joints, columns)
    angles = [f"q{i + 1}_{'mm' if i in prismatic else 'rad'}" for i in range(count)]
    texts = [name for name in LABELS if name in names]
    touching = "socket" in names or "plane" in names
    tracked = all({f"b{axis}_mm", f"b{axis}_m"} & names for axis in "xyz")
    seen = [] if not any(re.fullmatch("s[xyz]_m?m", name) for name in names) else ["sx_mm", "sy_mm", "sz_mm"]
    measured = [] if touching and not tracked else ["bx_mm", "by_mm", "bz_mm"]
    covariances = list(COVARIANCE_COLUMNS) if set(COVARIANCE_COLUMNS) <= names else []
    orientation = _orientation_columns(names)
    table = read_table(path, (*angles, *seen, *measured, *covariances, *orientation), texts, columns)
    labels = {name: _label_column(table, name) for name in texts}
    q_rad = table[angles].to_numpy(dtype=float)
    pose = labels.get("pose", first_visits(q_rad).astype(str))
    values: dict[str, Any] = {
        "pose": pose,
        "sphere": labels.get("sphere", pose),
        "train": _train_rows(path, labels["split"]) if "split" in labels else None,
        "scanner_covariance_mm2": _symmetric(table[covariances].to_numpy(dtype=float)) if covariances else None,
    }
    if "reflector" in labels:
        found, number = np.unique(labels["reflector"], return_inverse=True)
        values |= {"reflectors": tuple(map(str, found)), "reflector": number}
    if touching:
        values |= _fixtures(path, table, labels, tracked)
    scanner = table[seen].to_numpy(dtype=float) if seen else np.zeros((len(table), 3))
    tracker = table[measured].to_numpy(dtype=float) if measured else np.zeros((len(table), 3))
    result = Measurements(q_rad, scanner, tracker, **values)
    return _with_orientations(result, table, orientation) if orientation else result


def unused_columns(path: str | Path, columns: Mapping[str, str] | None = None) -> dict[str, Floats]:
    """Columns of numbers (M,) in a measurement file that ``read_measurements`` does not read, by their names."""
    used = re.split(r"[+-]", "+".join((columns or {}).values()))
    found = {}
    for name in column_names(path):
        if not KNOWN.fullmatch(name) and name not in used:
            try:
                found[name] = read_table(path, (name,))[name].to_numpy(dtype=float)
            except FileError:
                continue
    return found


def _joint_count(path: str | Path, names: Collection[str], joints: int | None, columns: Mapping[str, str]) -> int:
    numbered = len({match[1] for name in names if (match := JOINT.fullmatch(name))})
    if numbered == 0:
        known = ", ".join(column_names(path)[:16])
        raise FileError(
            f"{path}: no columns of joint angles (q1_rad or q1_deg ...); found {known}; say which they are, as in"
            " --columns q1_deg=joint_1"
        )
    if joints is not None and numbered != joints:
        raise FileError(
            f"{path}: {numbered} columns of joint angles (q1_rad or q1_deg ...), but the robot table has {joints}"
            " joints; give the table up to the joint that carries the scanner"
        )
    return numbered


def _checked_names(columns: Mapping[str, str]) -> Mapping[str, str]:
    for name in columns:
        if not KNOWN.fullmatch(name):
            raise InputError(f"{name!r} is no column of a measurement table; use {KNOWN_WORDS}")
    return columns


def _symmetric(columns: Floats) -> Floats:
    """Matrices (M, 3, 3) from columns (M, 6) that hold xx, xy, xz, yy, yz, zz."""
    return columns[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)


def _label_column(table: pd.DataFrame, name: str) -> NDArray[np.str_]:
    return table[name].where(table[name].notna(), "").astype(str).str.strip().to_numpy(dtype=str)


def _orientation_columns(names: Collection[str]) -> Sequence[str]:
    if set(QUATERNION) <= set(names):
        return QUATERNION
    if all({name, name.replace("_rad", "_deg")} & set(names) for name in ROTATION_VECTOR):
        return ROTATION_VECTOR
    return ()


def _with_orientations(measurements: Measurements, table: pd.DataFrame, columns: Sequence[str]) -> Measurements:
    """Every measured pose as its point and three points along its axes, in rows of one pose label.

    Raises:
        InputError: a quaternion of no length.
    """
    numbers = table[list(columns)].to_numpy(dtype=float)
    if len(columns) == 4:
        lengths = np.linalg.norm(numbers, axis=1)
        if lengths.min() < 0.5:
            row = int(np.argmin(lengths))
            raise InputError(
                f"row {row + 1}: the quaternion bqw .. bqz has length {lengths[row]:.3g}, which is no turn"
            )
        rotations = Rotation.from_quat(numbers[:, [1, 2, 3, 0]]).as_matrix()
    else:
        rotations = Rotation.from_rotvec(numbers).as_matrix()
    levers = np.vstack([np.zeros(3), LEVER_MM * np.eye(3)])
    rows = np.repeat(np.arange(len(measurements)), 4)
    every = measurements.rows(rows)
    scanner = measurements.scanner_mm[:, None, :] + levers
    tracker = measurements.tracker_mm[:, None, :] + np.einsum("mij,kj->mki", rotations, levers)
    from dataclasses import replace

    return replace(every, scanner_mm=scanner.reshape(-1, 3), tracker_mm=tracker.reshape(-1, 3))


def _fixtures(
    path: str | Path, table: pd.DataFrame, labels: Mapping[str, NDArray[np.str_]], tracked: bool
) -> dict[str, Any]:
    """Sockets and planes that rows touch, bars between, and known distances."""
    rows = len(table)
    empty = np.full(rows, "", dtype=str)
    socket, plane, other = (labels.get(name, empty) for name in ("socket", "plane", "to_socket"))
    both = (socket != "") & (plane != "")
    if both.any():
        raise FileError(f"{path}: row {int(both.argmax()) + 1} names a socket and a plane; a row touches one thing")
    free = (socket == "") & (plane == "")
    if free.any() and not tracked:
        raise FileError(
            f"{path}: row {int(free.argmax()) + 1} names neither socket nor plane, and there are no columns bx_mm to"
            " bz_mm; say where the point was measured"
        )
    names = [("socket", str(name)) for name in np.unique(socket) if name]
    names += [("plane", str(name)) for name in np.unique(plane) if name]
    fixture = np.full(rows, -1)
    for number, (kind, name) in enumerate(names):
        fixture[(socket if kind == "socket" else plane) == name] = number
    bar = np.full(rows, np.nan)
    if "bar_mm" in table.columns or "bar_m" in table.columns:
        column, factor = ("bar_mm", 1.0) if "bar_mm" in table.columns else ("bar_m", 1000.0)
        bar = factor * table[column].astype(float).to_numpy()
    distances: dict[tuple[int, int], float] = {}
    if "distance_mm" in table.columns and "to_socket" in labels:
        given = table["distance_mm"].astype(float).to_numpy()
        index = {name: number for number, (kind, name) in enumerate(names) if kind == "socket"}
        for row in np.flatnonzero((other != "") & np.isfinite(given) & (socket != "")):
            if str(other[row]) not in index:
                raise FileError(f"{path}: row {row + 1}, column to_socket: no row lies in socket {str(other[row])!r}")
            pair = sorted((index[str(socket[row])], index[str(other[row])]))
            if not given[row] > 0 or pair[0] == pair[1]:
                raise FileError(
                    f"{path}: row {row + 1}: distance_mm is {given[row]:g} between {socket[row]} and"
                    f" {other[row]}; a positive distance of two sockets is needed"
                )
            key = (pair[0], pair[1])
            if abs(distances.setdefault(key, float(given[row])) - given[row]) > 1e-6:
                raise FileError(f"{path}: row {row + 1}: distance_mm is {given[row]:g}, but {distances[key]:g} before")
    return {
        "fixtures": tuple(names),
        "fixture": fixture,
        "bar_mm": bar,
        "distances_mm": tuple((a, b, mm) for (a, b), mm in distances.items()),
    }


def first_visits(q_rad: ArrayLike) -> NDArray[np.int64]:
    """For every row of joint angles (M, n) the first row that has them too, within ``SAME_POSE_RAD``."""
    q = np.asarray(q_rad, dtype=float)
    tree, first = cKDTree(q), np.full(len(q), -1)
    for row in range(len(q)):
        if first[row] < 0:
            near = np.array(tree.query_ball_point(q[row], SAME_POSE_RAD, p=np.inf))
            first[near[first[near] < 0]] = row
    return first


def _train_rows(path: str | Path, split: NDArray[np.str_]) -> Flags:
    split = np.char.strip(split)
    wrong = ~np.isin(split, ["train", "test"])
    if wrong.any():
        row = int(wrong.argmax())
        raise FileError(f"{path}: row {row + 1}, column split: {str(split[row])!r}; write train or test")
    return split == "train"
