"""Sphere measurements: joint angles, the sphere in the scanner's frame, the same sphere in the tracker's frame."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import InputError
from grindvision.records import by_content

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

#: Optional columns of a measurement file: the covariance of the sphere's centre in the scanner's frame.
COVARIANCE_COLUMNS = ("sxx_mm2", "sxy_mm2", "sxz_mm2", "syy_mm2", "syz_mm2", "szz_mm2")

KINDS: dict[str, type] = {"pose": str, "sphere": str, "train": bool, "reflector": int, "fixture": int}

_TOUCHED = ("reflector", "fixture", "bar_mm")


@by_content
@dataclass(frozen=True)
class Measurements:
    """M sphere centres, each seen by the scanner on an arm of n joints and measured by a tracker.

    ``q_rad`` (M, n); ``scanner_mm`` (M, 3) in the scanner's frame, or in the tool's when the tracker's reflector sits
    on the tool; ``tracker_mm`` (M, 3) in the tracker's frame. ``pose`` and ``sphere`` (M,) are labels, ``train`` (M,)
    marks the rows to fit. ``scanner_covariance_mm2`` (M, 3, 3), in the scanner's frame, and ``tracker_std_mm`` may be
    left out.

    Where several reflectors sit on the tool at places known only nearly, ``reflectors`` names them and ``reflector``
    (M,) numbers each row's (-1: exactly where ``scanner_mm`` says). Where rows touch a fixed thing at an unknown place
    instead of being tracked, ``fixtures`` holds its kind (``socket`` or ``plane``) and name, and ``fixture`` (M,) its
    number (-1: tracked; ``tracker_mm`` is not used elsewhere); ``bar_mm`` (M,) is the length of the ball bar from the
    socket, NaN without one. ``distances_mm`` holds pairs of sockets whose distance is known: (one, other, mm).
    """

    q_rad: Floats
    scanner_mm: Floats
    tracker_mm: Floats
    pose: NDArray[np.str_] = field(default=None)  # type: ignore[arg-type]
    sphere: NDArray[np.str_] = field(default=None)  # type: ignore[arg-type]
    train: Flags = field(default=None)  # type: ignore[arg-type]
    scanner_covariance_mm2: Floats | None = None
    tracker_std_mm: float = 0.0
    reflector: NDArray[np.int64] = field(default=None)  # type: ignore[arg-type]
    reflectors: tuple[str, ...] = ()
    fixture: NDArray[np.int64] = field(default=None)  # type: ignore[arg-type]
    fixtures: tuple[tuple[str, str], ...] = ()
    bar_mm: Floats = field(default=None)  # type: ignore[arg-type]
    distances_mm: tuple[tuple[int, int, float], ...] = ()

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
            ("reflector", (rows,), np.full(rows, -1)),
            ("fixture", (rows,), np.full(rows, -1)),
            ("bar_mm", (rows,), np.full(rows, np.nan)),
        ):
            value = getattr(self, name)
            if value is None and default is None:
                continue
            kind = KINDS.get(name, float)
            array: NDArray[Any] = np.array(default if value is None else value, dtype=kind)
            if array.ndim != len(shape) or any(
                want not in (-1, got) for want, got in zip(shape, array.shape, strict=True)
            ):
                raise InputError(f"{name} has shape {array.shape}; {rows} measurements need {shape} (-1: any)")
            if kind is float and name != "bar_mm" and not np.isfinite(array).all():
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

    @property
    def tracked(self) -> Flags:
        """Flags (M,) of the rows that the tracker measured, and no fixture held."""
        return self.fixture < 0

    @property
    def directions(self) -> NDArray[np.int64]:
        """Directions (M,) in which each row says something: three, but one for a bar's length or a touched plane."""
        planes = np.array([kind == "plane" for kind, _ in self.fixtures] + [False])[self.fixture]
        return np.where(~self.tracked & (planes | np.isfinite(self.bar_mm)), 1, 3)

    @property
    def equations(self) -> int:
        """Equations that the rows give, one for each direction and for each known distance."""
        return int(self.directions.sum()) + len(self.distances_mm)

    def rows(self, chosen: ArrayLike) -> Measurements:
        """Return the rows marked or numbered by ``chosen``."""
        chosen, covariance = np.asarray(chosen), self.scanner_covariance_mm2
        return replace(
            self,
            **{name: getattr(self, name)[chosen] for name in ("q_rad", "scanner_mm", "tracker_mm")},
            **{name: getattr(self, name)[chosen] for name in ("pose", "sphere", "train", *_TOUCHED)},
            scanner_covariance_mm2=None if covariance is None else covariance[chosen],
        )

    def with_known_distances(self) -> Measurements:
        """The same rows without the distances of sockets in which none of them lies."""
        seen = set(np.unique(self.fixture).tolist())
        return replace(self, distances_mm=tuple(one for one in self.distances_mm if {one[0], one[1]} <= seen))

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
