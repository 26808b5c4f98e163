"""The book's virtual cell beside measured data: noise and waviness of cameras, what the joints of arms leave."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from grindvision import cell
from grindvision.calibration import Options, calibrate, on_test_rows
from grindvision.geometry import PlaneFit, fit_plane
from grindvision.geometry.ransac import ransac_plane
from grindvision_book.chapter_03 import first_robot, measurements_of
from grindvision_book.chapter_13.arms import ArmErrors
from grindvision_book.chapter_13.views import PLATE_MM

Floats = NDArray[np.float64]

#: Residues are smooth over this radius (waviness); what is left about them is noise. mm.
PATCH_MM = 5.0


def noise_and_waviness(points: Floats, residues: Floats) -> dict[str, float]:
    """Of residues (N,) at points (N, 3), mm: rms, noise about the mean within ``PATCH_MM``, rms of that mean."""
    tree = cKDTree(points)
    few = np.arange(0, len(points), max(1, len(points) // 800))
    smooth = np.array([residues[near].mean() for near in tree.query_ball_point(points[few], PATCH_MM)])
    return {
        "rms_mm": float(residues.std()),
        "noise_mm": float((residues[few] - smooth).std()),
        "waviness_mm": float(smooth.std()),
    }


def camera_rows(spheres: Sequence[tuple[Floats, Floats]], seed: int) -> pd.DataFrame:
    """Noise and waviness of the measured views of a sphere (mean over them), and of the twin's two cameras on a plate.

    Args:
        spheres: points (N, 3) of each cap with their distances (N,) from its fit.
        seed: of the twin.
    """
    rng = np.random.default_rng(seed)
    rows: list[dict[str, object]] = []
    if spheres:
        parts = pd.DataFrame([noise_and_waviness(points, residues) for points, residues in spheres]).mean()
        rows.append({"what": "camera of RegHEC, sphere", "origin": "measured", **parts.to_dict()})
    plate = cell.Target(cell.flat_plate())
    twins: list[tuple[str, cell.Scanner, float, int]] = [
        ("structured light, plate at 400 mm", cell.StructuredLightScanner(), 400.0, 3),
        ("depth camera, plate at 450 mm", cell.DepthCamera(), 450.0, 2),
    ]
    for name, camera, distance, every in twins:
        scan = camera.scan(plate, cell.view_from([0.0, 0.0, 0.0], distance), rng, every)
        rows.append({"what": f"twin: {name}", "origin": f"synthetic (seed {seed})", **_about_plane(scan.points)})
    return pd.DataFrame(rows)


def joint_rows(arms: dict[str, ArmErrors], seed: int) -> pd.DataFrame:
    """What calibrations leave on unseen poses: measured arms, and the twin's without and with gear waves and sag."""
    rows = [
        {
            "arm": name,
            "origin": "measured",
            "geometry_mm": found.geometry.mean(),
            "beyond_mm": found.beyond.mean(),
            "beyond": found.beyond_kind,
        }
        for name, found in arms.items()
    ]
    for name, wavy in (("twin", False), ("twin, gear waves and sag", True)):
        rng = np.random.default_rng(seed)
        errors = cell.drawn_joint_errors(first_robot().true, rng) if wavy else None
        made = cell.calibration_experiment(rng, robot=replace(first_robot(), joint_errors=errors), every=None)
        fit = calibrate(measurements_of(made), first_robot().nominal, Options(beyond_geometry=True))
        unseen = on_test_rows(fit)
        rows.append(
            {
                "arm": name,
                "origin": f"synthetic (seed {seed})",
                "geometry_mm": unseen.after.mean,
                "beyond_mm": (unseen.beyond or unseen.after).mean,
                "beyond": "geometry alone" if fit.beyond is None else fit.beyond.kind,
            }
        )
    return pd.DataFrame(rows)


def _about_plane(points: Floats) -> dict[str, float]:
    """Noise and waviness of the points (N, 3) of the plate in a cloud about its plane."""
    fit: PlaneFit = ransac_plane(points, 3 * PLATE_MM, np.random.default_rng(0))
    on_it = points[fit.inliers]
    return noise_and_waviness(on_it, fit_plane(on_it).distance(on_it))
