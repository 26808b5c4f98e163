"""Views of a part that rests: the camera's place from the part itself, and the views before and after it is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from grindvision.calibration.hand_eye import HandEye, hand_eye
from grindvision.geometry import inverse, rigid
from grindvision.vision.registration.meeting import Meeting, merge
from grindvision.vision.registration.views import ViewRegistration, register_views
from grindvision_book.chapter_14.simulated import T_FLANGE_CAMERA, Errors, looking_poses, shown_and_seen, view_of_part

Floats = NDArray[np.float64]

#: What a drawing says of the camera's place, off the truth by so much along and about every axis.
DRAWN_OFF_MM, DRAWN_OFF_DEG = 4.0, 1.5


@dataclass(frozen=True)
class Joined:
    """Views (each (N, 3), camera frame) with the camera that they gave, and how they meet by a drawing and by it."""

    views: tuple[Floats, ...]
    registered: ViewRegistration
    camera: HandEye
    before: Meeting
    after: Meeting


def joined_views(rng: np.random.Generator, count: int, turn_deg: float, seed: int) -> Joined:
    """Simulate ``count`` views of a part, register them without any pose, and join them with the camera found."""
    poses = looking_poses(rng, count, turn_deg)
    views = tuple(view_of_part(rng, pose @ T_FLANGE_CAMERA) for pose in poses)
    shown, _ = shown_and_seen(rng, poses, Errors(arm_deg=0.02))
    registered = register_views(views, seed=seed)
    rows = registered.found
    camera = hand_eye(shown[rows], inverse(registered.T_part_view[rows]))
    off = rigid(Rotation.from_rotvec(np.radians([DRAWN_OFF_DEG] * 3)).as_matrix(), [DRAWN_OFF_MM] * 3)
    before, after = (merge(views, shown @ place) for place in (off @ T_FLANGE_CAMERA, camera.T_parent_camera))
    return Joined(views, registered, camera, before, after)


def section(meeting: Meeting, views: tuple[Floats, ...], half_mm: float = 1.0) -> list[Floats]:
    """Of every view the points (M, 2) in a slab through the middle of all: x and z of the base frame, mm."""
    parts = np.split(meeting.points, np.cumsum([len(view) for view in views])[:-1])
    middle = float(np.median(meeting.points[:, 1]))
    return [part[np.abs(part[:, 1] - middle) <= half_mm][:, [0, 2]] for part in parts]
