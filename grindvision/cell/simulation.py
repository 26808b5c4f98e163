"""Inputs for ``detect``, ``trace_weld`` and ``calibrate``, with the truth beside them, from a seed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, overload

import numpy as np

from grindvision.cell.calibration_scene import CalibrationExperiment, calibration_experiment
from grindvision.cell.grinding_scene import GrindingScene, grinding_scene
from grindvision.cell.joint_pieces import JOINTS
from grindvision.cell.joint_scene import JointScene, joint_scene
from grindvision.cell.scanners import StructuredLightScanner
from grindvision.cell.weld_pieces import KINDS
from grindvision.cell.weld_scene import WeldScene, weld_scene
from grindvision.errors import InputError

#: What can be simulated.
SUBJECTS = ("grinding", "welding", "calibration")

#: Cameras for joints, and how far from the piece they stand, mm: a D415, or a structured-light scanner of 0.05 mm.
CAMERAS = {"d415": 450.0, "fine": 400.0}


@dataclass(frozen=True)
class SimulateOptions:
    """Settings of ``simulate``.

    ``seed`` of all draws. ``every``: the scanner's pixel step, for fewer points (left out: what the scene has). Of
    welding, ``joint``: one of ``JOINTS`` or ``all``, instead of the four pieces with a groove, and the ``camera`` that
    sees it, ``d415`` or ``fine``.
    """

    seed: int = 0
    every: int | None = None
    joint: str | None = None
    camera: str | None = None

    def __post_init__(self) -> None:
        if self.joint is not None and self.joint not in ("all", *JOINTS):
            raise InputError(f"joint {self.joint!r} cannot be simulated; choose one of {', '.join(('all', *JOINTS))}")
        if self.camera is not None and self.camera not in CAMERAS:
            raise InputError(f"camera {self.camera!r} is unknown; choose one of {', '.join(CAMERAS)}")
        if self.camera is not None and self.joint is None:
            raise InputError(f"--camera {self.camera} is for a joint; give --joint as well")


@overload
def simulate(subject: Literal["grinding"], options: SimulateOptions | None = None) -> GrindingScene: ...
@overload
def simulate(
    subject: Literal["welding"], options: SimulateOptions | None = None
) -> dict[str, WeldScene] | dict[str, JointScene]: ...
@overload
def simulate(subject: Literal["calibration"], options: SimulateOptions | None = None) -> CalibrationExperiment: ...
def simulate(
    subject: str, options: SimulateOptions | None = None
) -> GrindingScene | dict[str, WeldScene] | dict[str, JointScene] | CalibrationExperiment:
    """Make what ``grindvision simulate`` writes. The same seed makes the same, and all of it is synthetic.

    Args:
        subject: ``grinding``, ``welding`` or ``calibration``.
        options: seed; joint and camera of a welding scene.

    Returns:
        ``grinding``: two scans (N, 3) and (M, 3) in mm, each in its scanner's frame, and ``T_sample_test`` between
        them. ``welding``: scenes by the name of their piece, each with ``points`` (N, 3) in the camera's frame.
        ``calibration``: a table of measurements as ``calibrate`` reads it, and the robot behind it.

    Raises:
        InputError: another subject, or a joint for something that has none.

    Example:
        >>> from grindvision import SimulateOptions, simulate
        >>> scenes = simulate("welding", SimulateOptions(seed=1, joint="t-joint", every=4))
        >>> scenes["t-joint"].points.shape[1]
        3
    """
    options = SimulateOptions() if options is None else options
    rng = np.random.default_rng(options.seed)
    if subject not in SUBJECTS:
        raise InputError(f"{subject!r} cannot be simulated; choose one of {', '.join(SUBJECTS)}")
    if options.joint is not None and subject != "welding":
        raise InputError(f"--joint {options.joint} is for welding; {subject} has no joints")
    every: dict[str, Any] = {} if options.every is None else {"every": options.every}
    if subject == "grinding":
        return grinding_scene(rng, **every)
    if subject == "calibration":
        return calibration_experiment(rng, **every)
    if options.joint is None:
        return {kind: weld_scene(kind, own, **every) for kind, own in zip(KINDS, rng.spawn(len(KINDS)), strict=True)}
    kinds = JOINTS if options.joint == "all" else (options.joint,)
    camera, distance_mm = options.camera or "d415", CAMERAS[options.camera or "d415"]
    scanner = StructuredLightScanner() if camera == "fine" else None
    return {
        kind: joint_scene(kind, own, camera=scanner, distance_mm=distance_mm, **every)
        for kind, own in zip(kinds, rng.spawn(len(kinds)), strict=True)
    }
