"""Measured views of a camera on an arm: the sphere's hand-eye, and how views of other things meet through it."""

from __future__ import annotations

import numpy as np
import pandas as pd

from grindvision.calibration.hand_eye import HandEye, free_directions, hand_eye
from grindvision.calibration.sphere_search import cut_out_sphere
from grindvision.errors import DataNotHereError
from grindvision.measured import find_measured
from grindvision.vision.registration.meeting import merge
from grindvision_book.chapter_13.sphere import controller_poses, views

#: Diameter that the data's authors and every view's own fit agree on, mm.
DIAMETER_MM = 96.752

SETS = {"David": "reghec-david", "Duck": "reghec-duck"}


def sphere_camera(seed: int) -> HandEye | None:
    """The camera on the flange from the measured sphere; None where the data are not here."""
    try:
        folder = find_measured("reghec-sphere")
    except DataNotHereError:
        return None
    streams = np.random.default_rng(seed).spawn(9)
    clouds = views(folder, "Sphere")
    fits = [cut_out_sphere(cloud, DIAMETER_MM, rng, "view") for cloud, rng in zip(clouds, streams, strict=True)]
    return hand_eye(controller_poses(folder, "Sphere"), np.array([fit.centre_mm for fit in fits]))


def measured_rows(camera: HandEye | None) -> pd.DataFrame:
    """What the measured sphere says of the camera, and how views of other things meet through it."""
    if camera is None:
        return pd.DataFrame({"measured": ["reghec"], "what": ["not here: `grindvision data reghec-sphere` fetches it"]})
    rows = [
        {"measured": "Sphere", "what": "nine centres meet, rms", "value": camera.rms_mm, "unit": "mm"},
        {"measured": "Sphere", "what": "least known direction, sigma", "value": camera.sigma_mm.max(), "unit": "mm"},
    ]
    rows += [{"measured": "Sphere", "what": text, "value": np.nan, "unit": ""} for text in free_directions(camera)]
    for name, key in SETS.items():
        try:
            folder = find_measured(key)
        except DataNotHereError:
            continue
        meeting = merge(views(folder, name), controller_poses(folder, name) @ camera.T_parent_camera)
        rows.append({"measured": name, "what": "views meet, median", "value": meeting.overall_mm, "unit": "mm"})
    return pd.DataFrame(rows)
