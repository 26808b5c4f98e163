"""What limits the path's accuracy, and what the wheel then leaves: one pair of scans under given conditions.

To the registration that is found an error of given size is added, so that it is a parameter like any other. No arm
stands between scan and path: that part is in ``compound``.
"""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from grindvision.cell.grinding_part import Bead, GrindingPart, grinding_part
from grindvision.cell.grinding_scene import GrindingScene, grinding_scene
from grindvision.errors import DegenerateError
from grindvision.geometry import inverse, move_points, rigid, small_motion, vector_angle
from grindvision.vision.change.ridge_path import BeadPath, trace_bead
from grindvision.vision.surface.voxel_grid import voxel_grid
from grindvision_book.chapter_08.offsets import square_to
from grindvision_book.chapter_08.registered import FIXTURE_REACH_MM, RegisteredPair, fixture_pose
from grindvision_book.chapter_09.grinding import GroundBead, Wheel, grind, resampled

Floats = NDArray[np.float64]


#: An ordinary job, vision and process; chapter 09 varies one value at a time around it.
ORDINARY = {
    "registration_mm": 0.02,
    "voxel_mm": 0.5,
    "points": 6,
    "overlap": 0.9,
    "bead_height_mm": 1.5,
    "wheel_radius_mm": 20.0,
}

#: Ranges that a workshop may meet.
RANGES = {
    "registration_mm": (0.0, 0.3),
    "voxel_mm": (0.4, 1.2),
    "points": (3, 20),
    "overlap": (0.5, 1.0),
    "bead_height_mm": (0.5, 2.5),
    "wheel_radius_mm": (5.0, 40.0),
}

WHEEL_WIDTH_MM = 8.0


@dataclass(frozen=True)
class FoundPath:
    """A path and the truth about it, both in the frame of the test scan; ``registration_mm`` (rms) is what ICP left."""

    path: BeadPath
    bead: Bead
    registration_mm: float

    def ground(self, wheel_radius_mm: float, depth_of_cut_mm: float, passes: int) -> GroundBead:
        """Grind the bead along the path with a wheel ``WHEEL_WIDTH_MM`` wide."""
        path, wheel = self.path, Wheel(wheel_radius_mm, WHEEL_WIDTH_MM)
        heights = np.full(len(path.points), path.height_mm)
        return grind(self.bead, path.points, path.normals, heights, wheel, depth_of_cut_mm, passes)


def found_path(
    rng: np.random.Generator,
    registration_mm: float,
    voxel_mm: float,
    points: int,
    overlap: float,
    bead_height_mm: float,
) -> FoundPath:
    """Scan the good part and the one with the bead, filter, register, find the path.

    Args:
        rng: draws instrument, poses, noise and the direction of the registration error.
        registration_mm: error added to the registration that was found: rms displacement over the plate.
        voxel_mm: edge of the voxel filter that both clouds, 0.4 mm apart as scanned, pass first.
        points: path points.
        overlap: share of the part that both scans see.
        bead_height_mm: of the bead, 4 mm wide.

    Raises:
        DegenerateError: no bead, or none that can be followed.
    """
    scene, pair, rng.bit_generator.state = _registered(pickle.dumps(rng), voxel_mm, overlap, bead_height_mm)
    T_sample_test = pair.registration.T_target_source
    spots = scene.test.true_points[:: len(scene.test) // 1000]
    path = trace_bead(pair.at(T_sample_test @ displacement(rng, spots, registration_mm)).piece(), points)
    left = move_points(inverse(scene.T_sample_test) @ T_sample_test, spots) - spots
    bead = Bead(scene.ridge_mm, scene.ridge_normals, scene.part.bead.width_mm, bead_height_mm)
    return FoundPath(path, bead, float(np.sqrt((left**2).sum(axis=1).mean())))


def path_case(
    rng: np.random.Generator,
    wheel_radius_mm: float,
    depth_of_cut_mm: float = 0.25,
    passes: int = 12,
    **vision: Any,
) -> dict[str, float]:
    """``found_path`` and the grinding along it in numbers: a case of a study.

    ``icp_mm`` is the registration error that ICP itself leaves (rms over the plate); ``path_mm`` the mean and
    ``largest_path_mm`` the largest distance between the true ridge and the straight lines through the path points;
    ``height_mm`` the bead's found minus true height; ``normal_off_deg`` median; ``left_mm`` and ``gouge_mm`` after
    grinding.

    Raises:
        DegenerateError: no bead was found, or something else that is none.
    """
    found = found_path(rng, **vision)
    ridge, normals = resampled(found.bead.ridge_mm, found.bead.normals)
    lines, carried = resampled(found.path.points, found.path.normals)
    off = np.linalg.norm(square_to(ridge, lines), axis=1)
    beside, nearest = cKDTree(ridge).query(lines)
    if beside.max() > found.bead.width_mm:
        raise DegenerateError(
            f"the largest piece that stands out is no bead: the path strays {beside.max():.1f} mm from it"
        )
    tilt = vector_angle(carried, normals[nearest])
    ground = found.ground(wheel_radius_mm, depth_of_cut_mm, passes)
    return {
        "icp_mm": found.registration_mm,
        "path_mm": float(off.mean()),
        "largest_path_mm": float(off.max()),
        "height_mm": float(found.path.height_mm - found.bead.height_mm),
        "normal_off_deg": float(np.degrees(np.median(tilt))),
        "left_mm": ground.left_mm,
        "gouge_mm": ground.gouge_mm,
    }


def displacement(rng: np.random.Generator, points_mm: Floats, rms_mm: float) -> Floats:
    """A small rigid motion (4, 4) in a random direction that moves points (N, 3) by ``rms_mm`` (rms)."""
    middle = points_mm.mean(axis=0)
    reach = np.sqrt(((points_mm - middle) ** 2).sum(axis=1).mean())
    twist = rng.standard_normal(6) * np.repeat([1.0, 1.0 / reach], 3)
    shift = twist[:3] + np.cross(twist[3:], points_mm - middle)
    twist *= rms_mm / np.sqrt((shift**2).sum(axis=1).mean())
    return rigid(translation_mm=middle) @ small_motion(twist) @ rigid(translation_mm=-middle)


@lru_cache(maxsize=8)
def _registered(
    pickled_rng: bytes, voxel_mm: float, overlap: float, bead_height_mm: float
) -> tuple[GrindingScene, RegisteredPair, Mapping[str, Any]]:
    """Both scans, filtered and registered from where the fixture holds the parts, and the generator's state afterwards.

    The last few are kept: levels of what comes after the registration are tried on one pair of scans.
    """
    rng = pickle.loads(pickled_rng)
    scene = grinding_scene(rng, overlap=overlap, part=_part(bead_height_mm), every=2)
    sample, test = (voxel_grid(scan.points, voxel_mm).centroids for scan in (scene.sample, scene.test))
    roughly = fixture_pose(scene.sample, scene.test, rng.spawn(1)[0])
    return scene, RegisteredPair.near(sample, test, roughly, FIXTURE_REACH_MM), rng.bit_generator.state


@lru_cache(maxsize=4)
def _part(bead_height_mm: float) -> GrindingPart:
    return grinding_part(height_mm=bead_height_mm)
