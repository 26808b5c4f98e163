"""Sphere measurements: joint angles, the sphere in the scanner's frame, the same sphere in the tracker's frame."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from grindvision.errors import FileError, InputError
from grindvision.files import column_names, read_table

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

#: Optional columns of a measurement file: the covariance of the sphere's centre in the scanner's frame.
COVARIANCE_COLUMNS = ("sxx_mm2", "sxy_mm2", "sxz_mm2", "syy_mm2", "syz_mm2", "szz_mm2")

#: Joint angles that differ by less (rad) are one pose, visited again: 0.01 deg, what a controller repeats to.
SAME_POSE_RAD = 2e-4

JOINT = re.compile(r"q(\d+)_(?:rad|deg)")
KNOWN = re.compile(rf"{JOINT.pattern}|[sb][xyz]_m?m|pose|sphere|split|" + "|".join(COVARIANCE_COLUMNS))
KNOWN_WORDS = "q1_rad or q1_deg ..., sx_mm .. sz_mm, bx_mm .. bz_mm (or _m), pose, sphere, split"


@dataclass(frozen=True)
class Measurements:
    """M sphere centres, each seen by the scanner on an arm of n joints and measured by a tracker.

    ``q_rad`` (M, n); ``scanner_mm`` (M, 3) in the scanner's frame, or in the tool's when the tracker's reflector sits
    on the tool; ``tracker_mm`` (M, 3) in the tracker's frame. ``pose`` and ``sphere`` (M,) are labels, ``train`` (M,)
    marks the rows to fit. ``scanner_covariance_mm2`` (M, 3, 3), in the scanner's frame, and ``tracker_std_mm`` may be
    left out.
    """

    q_rad: Floats
    scanner_mm: Floats
    tracker_mm: Floats
    pose: NDArray[np.str_] = field(default=None)  # type: ignore[arg-type]  # filled below
    sphere: NDArray[np.str_] = field(default=None)  # type: ignore[arg-type]
    train: Flags = field(default=None)  # type: ignore[arg-type]
    scanner_covariance_mm2: Floats | None = None
    tracker_std_mm: float = 0.0

    def __post_init__(self) -> None:
        rows = len(np.atleast_2d(np.asarray(self.q_rad, dtype=float)))
        numbers = [str(i) for i in range(rows)]
        for name, shape, default in (
            ("q_rad", (rows, -1), None),
            ("scanner_mm", (rows, 3), None),
            ("tracker_mm", (rows, 3), None),
            ("scanner_covariance_mm2", (rows, 3, 3), None),
            ("pose", (rows,), numbers),
            ("sphere", (rows,), numbers),
            ("train", (rows,), np.ones(rows, dtype=bool)),
        ):
            value = getattr(self, name)
            if value is None and default is None:
                continue
            kind = {"pose": str, "sphere": str, "train": bool}.get(name, float)
            array: NDArray[Any] = np.array(default if value is None else value, dtype=kind)
            if array.ndim != len(shape) or any(
                want not in (-1, got) for want, got in zip(shape, array.shape, strict=True)
            ):
                raise InputError(f"{name} has shape {array.shape}; {rows} measurements need {shape} (-1: any)")
            if kind is float and not np.isfinite(array).all():
                row = int(np.argwhere(~np.isfinite(array))[0, 0])
                raise InputError(f"{name}: row {row + 1} holds NaN or infinity; drop the row or measure it again")
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        if self.scanner_covariance_mm2 is not None and np.linalg.eigvalsh(self.scanner_covariance_mm2).min() < -1e-12:
            raise InputError(
                "a sphere centre's covariance has a negative eigenvalue; it must be symmetric and positive"
            )
        if not self.tracker_std_mm >= 0:
            raise InputError(f"tracker_std_mm is {self.tracker_std_mm}; it must not be negative")

    def __len__(self) -> int:
        return len(self.q_rad)

    @property
    def on_tool(self) -> bool:
        """Whether the measured point never moves in the last joint's frame: a reflector on the tool, not a scan."""
        return bool(np.ptp(self.scanner_mm, axis=0).max() < 1e-9)

    def rows(self, chosen: ArrayLike) -> Measurements:
        """Return the rows marked or numbered by ``chosen``."""
        chosen, covariance = np.asarray(chosen), self.scanner_covariance_mm2
        return replace(
            self,
            **{name: getattr(self, name)[chosen] for name in ("q_rad", "scanner_mm", "tracker_mm")},
            **{name: getattr(self, name)[chosen] for name in ("pose", "sphere", "train")},
            scanner_covariance_mm2=None if covariance is None else covariance[chosen],
        )

    def drawn(self, count: int, rng: np.random.Generator) -> Measurements:
        """Return the same rows with ``count`` of them, drawn at random, to train and the others to test.

        Rows of one pose stay together, so it may be a few more.

        Raises:
            InputError: fewer than one row, or none left to test.
        """
        if not 0 < count < len(self):
            raise InputError(f"{count} of {len(self)} measurements to train; choose 1 to {len(self) - 1}")
        poses, which = np.unique(self.pose, return_inverse=True)
        order = rng.permutation(len(poses))
        rank = np.empty(len(poses), dtype=int)
        rank[order] = np.arange(len(poses))
        needed = int(np.searchsorted(np.cumsum(np.bincount(which)[order]), count)) + 1
        if needed == len(poses):
            raise InputError(
                f"{count} training rows take all {len(poses)} poses; ask for fewer, or name the poses apart"
            )
        return replace(self, train=rank[which] < needed)

    def label(self, row: int) -> str:
        """Name a row as a person would look it up."""
        return f"row {row + 1} (pose {self.pose[row]}, sphere {self.sphere[row]})"

    def __str__(self) -> str:
        return (
            f"{len(self)} measurements, {len(set(self.sphere))} spheres, {len(set(self.pose))} poses,"
            f" {int(self.train.sum())} to train"
        )


def read_measurements(
    path: str | Path, joints: int | None = None, columns: Mapping[str, str] | None = None
) -> Measurements:
    """Read ``pose,sphere,q1_rad..qN_rad,sx_mm..sz_mm,bx_mm..bz_mm[,split]`` for an arm of ``joints`` joints.

    Angles may be given in degrees (``q1_deg``), lengths in metres (``bx_m``). Where no ``s`` column stands, the
    tracker's reflector sits on the tool. Left out, ``pose`` is the number of the first row with the same joint angles
    and ``sphere`` is ``pose``, so that a pose visited again is held out as one. Six further columns
    ``COVARIANCE_COLUMNS`` are used where present. Without ``split`` every row is a training row.

    Args:
        path: file.
        joints: of the arm; left out: as many as the file has.
        columns: our name of columns that the file calls otherwise, see ``read_table``.

    Raises:
        FileError: missing or damaged file, a column missing, text or NaN where a number belongs, a split that is
            neither train nor test; the message names row and column.
    """
    columns = columns or {}
    names = {*column_names(path), *columns}
    for name in columns:
        if not KNOWN.fullmatch(name):
            raise InputError(f"{name!r} is no column of a measurement table; use {KNOWN_WORDS}")
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
    angles = [f"q{i + 1}_rad" for i in range(numbered)]
    seen, measured = ["sx_mm", "sy_mm", "sz_mm"], ["bx_mm", "by_mm", "bz_mm"]
    on_tool = not any(re.fullmatch("s[xyz]_m?m", name) for name in names)
    covariances = list(COVARIANCE_COLUMNS) if set(COVARIANCE_COLUMNS) <= names else []
    texts = [name for name in ("pose", "sphere", "split") if name in names]
    table = read_table(path, (*angles, *(() if on_tool else seen), *measured, *covariances), texts, columns)
    labels = {name: table[name].astype(str).to_numpy(dtype=str) for name in texts}
    covariance = table[covariances].to_numpy(dtype=float) if covariances else None
    q_rad = table[angles].to_numpy(dtype=float)
    pose = labels.get("pose", first_visits(q_rad).astype(str))
    return Measurements(
        q_rad,
        np.zeros((len(table), 3)) if on_tool else table[seen].to_numpy(dtype=float),
        table[measured].to_numpy(dtype=float),
        pose=pose,
        sphere=labels.get("sphere", pose),
        train=_train_rows(path, labels["split"]) if "split" in labels else np.ones(len(table), dtype=bool),
        scanner_covariance_mm2=(
            None if covariance is None else covariance[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
        ),
    )


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
