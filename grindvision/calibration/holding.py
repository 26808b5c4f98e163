"""Whether an old calibration still holds: new shots judged by it, against a limit."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from grindvision.arm import read_arm
from grindvision.calibration.estimate import residuals_of
from grindvision.calibration.measurements import Measurements
from grindvision.calibration.model import ScannerOnArm
from grindvision.calibration.statistics import ErrorStatistics, error_statistics
from grindvision.errors import FileError, InputError
from grindvision.files import read_json
from grindvision.geometry import check_rigid, fit_rigid
from grindvision.records import by_content

Floats = NDArray[np.float64]

#: Of the shots, this fraction must lie below the limit.
JUDGED_FRACTION = 0.95
#: Shots of which the mean is more than this fraction of their mean length are off the same way.
SHARED_FRACTION = 0.7
#: So few shots may be off the same way by chance.
FEW_SHOTS = 4


@dataclass(frozen=True)
class VerifyOptions:
    """Settings of ``verify``: ``limit_mm`` that 95 % of the shots must stay below. ``tracker_moved``: the tracker
    stands elsewhere than before; its place, six numbers, is fitted to the same shots first."""

    limit_mm: float
    tracker_moved: bool = False

    def __post_init__(self) -> None:
        if not 0 < self.limit_mm < float("inf"):
            raise InputError(f"the limit is {self.limit_mm:g} mm; say what the shots must stay below, as in 0.3")


@by_content
@dataclass(frozen=True)
class Verification:
    """How new shots agree with a calibrated cell.

    ``residuals_mm`` (M, 3) in the tracker's frame, ``p95_mm`` the length below which 95 % of them lie, ``limit_mm``
    what they are held to; ``cell`` is the one that was judged, with the tracker's new place where that was fitted.
    """

    cell: ScannerOnArm
    shots: Measurements
    residuals_mm: Floats
    p95_mm: float
    limit_mm: float
    tracker_moved: bool

    @property
    def passed(self) -> bool:
        """Whether the limit holds."""
        return self.p95_mm <= self.limit_mm

    @property
    def errors(self) -> ErrorStatistics:
        """Statistics of the lengths of the residuals."""
        return error_statistics(self.residuals_mm)

    @property
    def mean_residual_mm(self) -> Floats:
        """Mean (3,) of the residuals."""
        return self.residuals_mm.mean(axis=0)

    @property
    def worst(self) -> str:
        """Which shot is farthest off."""
        return self.shots.label(int(np.argmax(np.linalg.norm(self.residuals_mm, axis=1))))

    @property
    def warning(self) -> str | None:
        """What speaks for a cause that a new calibration would not mend, or None."""
        shared = float(np.linalg.norm(self.mean_residual_mm))
        if shared <= SHARED_FRACTION * self.errors.mean or len(self.shots) < FEW_SHOTS or self.tracker_moved:
            return None
        told = ", ".join(f"{value:.2f}" for value in self.mean_residual_mm)
        return (
            f"the shots are all off the same way, by ({told}) mm in the tracker's frame: the tracker or the base may"
            " have moved; try --tracker-moved"
        )

    def __str__(self) -> str:
        return (
            f"{'pass' if self.passed else 'FAIL'}: 95 % of {len(self.shots)} shots are within {self.p95_mm:.3f} mm, the"
            f" limit is {self.limit_mm:g} mm"
        )


def verify(cell: ScannerOnArm, shots: Measurements, options: VerifyOptions) -> Verification:
    """Judge new shots by an earlier calibration. Nothing is fitted, except the tracker's place where it has moved.

    Args:
        cell: calibrated arm, scanner and tracker: ``Calibration.cell``, or what ``read_cell`` reads.
        shots: M new measurements; which of them are training rows does not matter.
        options: the limit, and whether the tracker has moved.

    Returns:
        Residuals (M, 3) in mm in the tracker's frame, and whether the limit holds.

    Raises:
        InputError: sockets, planes or several reflectors among the shots, which cannot be verified.

    Example:
        >>> import numpy as np
        >>> from grindvision import Measurements, VerifyOptions, read_arm, verify
        >>> from grindvision.calibration import ScannerOnArm
        >>> from grindvision.data_files import data_folder
        >>> arm = read_arm(data_folder() / "robots" / "er3a_c60.csv").first(4)
        >>> cell = ScannerOnArm(arm, np.eye(4), np.eye(4))
        >>> q_rad = np.random.default_rng(1).uniform(-1, 1, (6, 4))
        >>> seen_mm = np.tile([0.0, 0.0, 400.0], (6, 1))
        >>> shots = Measurements(q_rad, seen_mm, cell.points_base(q_rad, seen_mm))
        >>> print(verify(cell, shots, VerifyOptions(limit_mm=0.3)))
        pass: 95 % of 6 shots are within 0.000 mm, the limit is 0.3 mm
    """
    if shots.fixtures or shots.reflectors:
        raise InputError("sockets, planes and several reflectors cannot be verified; give tracked points")
    if options.tracker_moved:
        cell = _with_tracker_placed(cell, shots)
    residuals = residuals_of(cell, shots)
    p95 = float(np.quantile(np.linalg.norm(residuals, axis=1), JUDGED_FRACTION, method="higher"))
    return Verification(cell, shots, residuals, p95, options.limit_mm, options.tracker_moved)


def read_cell(folder: str | Path) -> ScannerOnArm:
    """The cell that an earlier ``grindvision calibrate -o FOLDER`` wrote: robot.csv and hand_eye.json.

    Raises:
        FileError: robot.csv or hand_eye.json is missing or damaged. NotRigidError: a matrix is no rigid transform.
    """
    folder = Path(folder)
    places = read_json(folder / "hand_eye.json")
    known = places if isinstance(places, dict) else {}
    missing = [name for name in ("T_joint_scanner", "T_tracker_base") if name not in known]
    if missing:
        raise FileError(f"{folder / 'hand_eye.json'}: {missing[0]} is missing; name a folder of `calibrate`")
    arm = read_arm(folder / "robot.csv")
    key = "T_tracker_table" if "T_tracker_table" in known else "T_tracker_base"
    return ScannerOnArm(arm, check_rigid(known["T_joint_scanner"], "T_joint_scanner"), check_rigid(known[key], key))


def _with_tracker_placed(cell: ScannerOnArm, shots: Measurements) -> ScannerOnArm:
    found = fit_rigid(cell.points_base(shots.q_rad, shots.scanner_mm), shots.tracker_mm)
    return replace(cell, T_tracker_base=found.T_target_source)
