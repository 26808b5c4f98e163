"""Measured views of a camera on an arm: the sphere's hand-eye, and how views of other things meet through it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from grindvision.calibration.hand_eye import HandEye, hand_eye
from grindvision.calibration.hand_eye_advice import knowledge, poorly_known
from grindvision.calibration.sphere_search import cut_out_sphere
from grindvision.errors import DataNotHereError
from grindvision.measured import find_measured
from grindvision.records import by_content
from grindvision.vision.registration.meeting import merge
from grindvision_book.chapter_13.sphere import controller_poses, views

Floats = NDArray[np.float64]

#: Diameter that the data's authors and every view's own fit agree on, mm.
DIAMETER_MM = 96.752

SETS = {"David": "reghec-david", "Duck": "reghec-duck"}


@by_content
@dataclass(frozen=True)
class SphereSeen:
    """The measured sphere: the controller's poses (N, 4, 4), its centres (N, 3) in the camera's frame, the camera."""

    T_base_flange: Floats
    centres_mm: Floats
    camera: HandEye


def sphere_camera(seed: int) -> SphereSeen | None:
    """The camera on the flange from the measured sphere; None where the data are not here."""
    try:
        folder = find_measured("reghec-sphere")
    except DataNotHereError:
        return None
    streams = np.random.default_rng(seed).spawn(9)
    clouds = views(folder, "Sphere")
    fits = [cut_out_sphere(cloud, DIAMETER_MM, rng, "view") for cloud, rng in zip(clouds, streams, strict=True)]
    poses, centres = controller_poses(folder, "Sphere"), np.array([fit.centre_mm for fit in fits])
    return SphereSeen(poses, centres, hand_eye(poses, centres))


def measured_rows(seen: SphereSeen | None) -> pd.DataFrame:
    """What the measured sphere says of the camera, and how views of other things meet through it."""
    if seen is None:
        return pd.DataFrame({"measured": ["reghec"], "what": ["not here: `grindvision data reghec-sphere` fetches it"]})
    known = knowledge(seen.camera, seen.centres_mm)
    rows = [
        {"measured": "Sphere", "what": what, "value": value, "unit": unit}
        for what, value, unit in (
            ("nine centres meet, rms", seen.camera.rms_mm, "mm"),
            ("camera's place, sigma of the worst direction", known.place_mm, "mm"),
            ("camera's rotation, the same", known.rotation_deg, "deg"),
            ("a point where the sphere was, the same", known.target_mm, "mm"),
            (poorly_known(seen.camera, seen.T_base_flange, seen.centres_mm), np.nan, ""),
        )
    ]
    for name, key in SETS.items():
        try:
            folder = find_measured(key)
        except DataNotHereError:
            continue
        meeting = merge(views(folder, name), controller_poses(folder, name) @ seen.camera.T_parent_camera)
        rows.append({"measured": name, "what": "views meet, median", "value": meeting.overall_mm, "unit": "mm"})
    return pd.DataFrame(rows)
