"""Sphere measurements: joint angles, the sphere in the scanner's frame, the same sphere in the tracker's frame."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import FileError, InputError
from grindvision.files import read_table

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

#: Optional columns of a measurement file: the covariance of the sphere's centre in the scanner's frame.
COVARIANCE_COLUMNS = ("sxx_mm2", "sxy_mm2", "sxz_mm2", "syy_mm2", "syz_mm2", "szz_mm2")


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
    pose: NDArray[np.str_] = field(default=None)  # type: ignore[assignment]
    sphere: NDArray[np.str_] = field(default=None)  # type: ignore[assignment]
    train: Flags = field(default=None)  # type: ignore[assignment]
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
            array = np.array(default if value is None else value, dtype=kind)
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
        covariance = self.scanner_covariance_mm2
        return replace(
            self,
            **{name: getattr(self, name)[chosen] for name in ("q_rad", "scanner_mm", "tracker_mm")},
            **{name: getattr(self, name)[chosen] for name in ("pose", "sphere", "train")},
            scanner_covariance_mm2=None if covariance is None else covariance[chosen],
        )

    def label(self, row: int) -> str:
        """Name a row as a person would look it up."""
        return f"row {row + 1} (pose {self.pose[row]}, sphere {self.sphere[row]})"

    def __str__(self) -> str:
        return (
            f"{len(self)} measurements, {len(set(self.sphere))} spheres, {len(set(self.pose))} poses,"
            f" {int(self.train.sum())} to train"
        )


def read_measurements(path: str | Path, joints: int) -> Measurements:
    """Read ``pose,sphere,q1_rad..qN_rad,sx_mm..sz_mm,bx_mm..bz_mm[,split]`` for an arm of ``joints`` joints.

    Six further columns ``COVARIANCE_COLUMNS`` are used where present. Without ``split`` every row is a training row.

    Raises:
        FileError: missing or damaged file, a column missing, text or NaN where a number belongs, a split that is
            neither train nor test; the message names row and column.
    """
    angles = [f"q{i + 1}_rad" for i in range(joints)]
    seen, measured = ["sx_mm", "sy_mm", "sz_mm"], ["bx_mm", "by_mm", "bz_mm"]
    table = read_table(path, (*seen, *measured), texts=("pose", "sphere"))
    columns = sum(re.fullmatch(r"q\d+_rad", column) is not None for column in table.columns)
    if columns != joints:
        raise FileError(
            f"{path}: {columns} columns of joint angles (q1_rad ...), but the robot table has {joints} joints;"
            " give the table up to the joint that carries the scanner"
        )
    table = read_table(path, (*angles, *seen, *measured))
    train = None
    if "split" in table.columns:
        split = table["split"].astype(str).str.strip()
        wrong = ~split.isin(["train", "test"])
        if wrong.any():
            row = int(wrong.to_numpy().argmax())
            raise FileError(f"{path}: row {row + 1}, column split: {split.iloc[row]!r}; write train or test")
        train = (split == "train").to_numpy()
    covariance = None
    if all(column in table.columns for column in COVARIANCE_COLUMNS):
        numbers = read_table(path, COVARIANCE_COLUMNS)[list(COVARIANCE_COLUMNS)].to_numpy(dtype=float)
        covariance = numbers[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    return Measurements(
        table[angles].to_numpy(dtype=float),
        table[seen].to_numpy(dtype=float),
        table[measured].to_numpy(dtype=float),
        pose=table["pose"].astype(str).to_numpy(dtype=str),
        sphere=table["sphere"].astype(str).to_numpy(dtype=str),
        train=train,
        scanner_covariance_mm2=covariance,
    )
