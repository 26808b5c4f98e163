"""Joints of known seams under a camera, and how far the detector's seams lie from them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from grindvision import cell
from grindvision.cell.joint_scene import JointScene
from grindvision.cell.scanners import Scanner
from grindvision.errors import NoGrooveError
from grindvision.geometry import rotation_about
from grindvision.vision.seam.joints import Seam
from grindvision.vision.seam.seams import FindSeamsOptions, find_seams

Floats = NDArray[np.float64]

#: Cameras by the names that the table gives them, and how far they stand away, mm.
CAMERAS: dict[str, tuple[type[cell.DepthCamera] | type[cell.StructuredLightScanner], float]] = {
    "D415": (cell.DepthCamera, 450.0),
    "structured light": (cell.StructuredLightScanner, 400.0),
}
#: Angle of air between the faces of the pieces whose faces are planes, or a plane and a tube on it, deg.
_OPENINGS_DEG = {
    "t-joint": 90.0,
    "inside-corner": 90.0,
    "outside-corner": 270.0,
    "lap-joint": 90.0,
    "tube-on-plate": 90.0,
}
#: Stations within this of a seam's end are not judged: how far a seam is seen is another question, mm.
END_MM = 3.0


@dataclass(frozen=True)
class Looked:
    """One view of a joint: the scene with its truth, the first seam found, or None and what was said."""

    kind: str
    scene: JointScene
    seam: Seam | None
    said: str = ""

    @property
    def right(self) -> bool:
        """Whether the first seam is of the piece's kind and within 3 mm of the true one."""
        return self.seam is not None and self.seam.kind == self.kind and bool(self.lateral_mm.mean() < 3.0)

    @property
    def lateral_mm(self) -> Floats:
        """Distance (S,) of the seam's stations from the true line as the camera shows it, mm; its ends left out."""
        if self.seam is None:
            return np.empty(0)
        away = self.off_mm(self.scene.root_mm + self.scene.root_errors_mm)
        ends = cKDTree(self.seam.root[[0, -1]]).query(self.seam.root)[0]
        return away if self.seam.closed else away[ends > END_MM]

    def off_mm(self, line: Floats) -> Floats:
        """Distance (S,) of the seam's stations from a line (K, 3) beside the true seam, across the true seam, mm."""
        assert self.seam is not None
        nearest = cKDTree(line).query(self.seam.root)[1]
        off, along = self.seam.root - line[nearest], self.scene.tangents[nearest]
        return np.linalg.norm(off - (off * along).sum(axis=1)[:, None] * along, axis=1)


def look(
    kind: str, seed: int, camera: Scanner | str = "D415", every: int = 1, size: cell.JointSize | None = None
) -> Looked:
    """Scan a piece of a kind and a size, and look for its seam; the seed draws the view and the noise."""
    rng = np.random.default_rng(seed)
    if isinstance(camera, str):
        instrument, distance = CAMERAS[camera]
        chosen: Scanner = instrument(serial=seed + 1)
    else:
        chosen, distance = camera, 450.0
    scene = cell.joint_scene(kind, rng, size, chosen, distance, every)
    try:
        return Looked(kind, scene, find_seams(scene.points).seams[0])
    except NoGrooveError as error:
        return Looked(kind, scene, None, str(error))


def true_opening_deg(kind: str) -> float:
    """Angle of air of a piece's joint, deg; NaN where it changes along the seam or the joint is a groove."""
    return _OPENINGS_DEG.get(kind, np.nan)


def judged(looked: Looked, camera: str) -> dict[str, object]:
    """A row of the chapter's table: what was found, how far off, and how far the detector thought it was."""
    row: dict[str, object] = {"joint": looked.kind, "camera": camera, "found as": "nothing"}
    if looked.seam is None:
        return row
    seam, off = looked.seam, looked.lateral_mm
    opening = float(np.median(seam.opening_deg)) - true_opening_deg(looked.kind)
    # A lap whose wall is hardly seen is fitted as a step: its angle is taken for granted, not measured.
    measured = seam.opening_sigma_deg > 0
    return row | {
        "found as": seam.kind,
        "lateral_mean_mm": off.mean(),
        "lateral_max_mm": off.max(),
        "sigma_mm": float(np.median(seam.sigma_mm)),
        "angle_off_deg": opening if measured else np.nan,
        "angle_sigma_deg": seam.opening_sigma_deg if measured else np.nan,
    }


def noisier(factor: float, serial: int) -> Scanner:
    """A D415 whose random noise and waviness are scaled."""
    camera = cell.DepthCamera(serial=serial)
    names = ("triangulation_px", "correlated_px", "distortion_mm")
    return camera.with_errors(replace(camera.errors, **{name: factor * getattr(camera.errors, name) for name in names}))


def refused_gap(gap_mm: float, seed: int, every: int) -> Looked:
    """A butt joint of a gap asked for by its kind, so that a refusal says what it would take."""
    scene = cell.joint_scene("butt-gap", np.random.default_rng(seed), cell.JointSize(gap_mm=gap_mm), every=every)
    try:
        return Looked("butt-gap", scene, find_seams(scene.points, FindSeamsOptions(joint="butt")).seams[0])
    except NoGrooveError as error:
        return Looked("butt-gap", scene, None, str(error))


def look_at_bend(radius_mm: float, noise_mm: float, spacing_mm: float, seed: int) -> Seam | None:
    """The seam found, if any, in one sheet bent through a right angle with a radius: there is none to find."""
    rng = np.random.default_rng(seed)
    at = np.arange(-50.0, radius_mm * np.pi / 2 + 50.0, spacing_mm)
    turn = np.clip(at / radius_mm, 0, np.pi / 2)
    across = np.where(at < 0, at, radius_mm * np.sin(turn))
    rise = radius_mm * (1 - np.cos(turn)) + np.maximum(at - radius_mm * np.pi / 2, 0)
    along, place = np.meshgrid(np.arange(-60.0, 60.0, spacing_mm), np.arange(len(at)), indexing="ij")
    sheet = np.stack([along, across[place], rise[place]], axis=-1).reshape(-1, 3)
    sheet = sheet @ rotation_about([1.0, 0.0, 0.0], -np.pi / 4).T + noise_mm * rng.standard_normal(sheet.shape)
    try:
        return find_seams(sheet, FindSeamsOptions([0.0, 0.0, 500.0])).seams[0]
    except NoGrooveError:
        return None
