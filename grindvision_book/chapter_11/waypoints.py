"""Way points against the true root of a weld groove, as the camera shows it and with the camera's field calibrated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from grindvision.cell import Scanner, Target, WeldScene, flat_plate, view_from
from grindvision.geometry import vector_angle
from grindvision.vision.depth_calibration.field_correction import FieldCorrection
from grindvision.vision.seam.seam_path import SeamPath

Floats = NDArray[np.float64]

#: Where the plate stands that teaches a camera its field, mm: about the grooves, half the waviness' length apart.
PLATES_MM = np.arange(420.0, 511.0, 15.0)

#: Standard deviation of a linear stage's position, and of the first plate's distance, mm. The latter is what marks on
#: the plate give: their distances, known to 0.05 mm in half a metre, are seen longer as the plate is nearer.
STEP_ERROR_MM = 0.02
DISTANCE_ERROR_MM = 0.05


@dataclass(frozen=True)
class WaypointErrors:
    """How W way points lie to the true root line, mm: ``across`` the seam and ``up`` out of the groove.

    ``off_mm`` (W,) is the distance in 3D from the root line, ``beyond_mm`` (W,) how far a way point lies past the
    line's end (part of ``off_mm``), ``axis_deg`` (W,) the angle between its normal and the true one.
    """

    across_mm: Floats
    up_mm: Floats
    beyond_mm: Floats
    axis_deg: Floats

    @property
    def off_mm(self) -> Floats:
        """Distance (W,) from the root line in 3D."""
        return np.sqrt(self.across_mm**2 + self.up_mm**2 + self.beyond_mm**2)

    def __str__(self) -> str:
        return (
            f"{len(self.up_mm)} way points off by {self.off_mm.mean():.2f} mm on average, {self.off_mm.max():.2f} mm at"
            f" most; axis by {self.axis_deg.mean():.1f} deg"
        )


def waypoint_errors(path: SeamPath, scene: WeldScene, as_shown: bool = False) -> WaypointErrors:
    """Compare a path in the camera frame with the root the camera could see.

    ``as_shown`` first moves each root point by the mean error of the measured points around it: what is left is the
    method's own, without the camera's waviness and scale, which no method can take out of a single cloud.
    """
    root = scene.root_mm + scene.root_errors_mm if as_shown else scene.root_mm
    _, nearest = cKDTree(root).query(path.points)
    error, tangents, normals = path.points - root[nearest], scene.tangents[nearest], scene.normals[nearest]
    along = np.einsum("ij,ij->i", error, tangents)
    at_end = (nearest == 0) | (nearest == len(root) - 1)
    return WaypointErrors(
        across_mm=np.einsum("ij,ij->i", error, np.cross(normals, tangents)),
        up_mm=np.einsum("ij,ij->i", error, normals),
        beyond_mm=np.where(at_end, along, 0.0),
        axis_deg=np.degrees(vector_angle(path.normals, normals)),
    )


def plate_scans(
    camera: Scanner, rng: np.random.Generator, distances_mm: ArrayLike = PLATES_MM, step_error_mm: float = STEP_ERROR_MM
) -> list[Floats]:
    """Scans of a flat plate square to the camera, one at each distance but for the stage's random error there.

    Every fourth pixel is read: the camera's noise is alike over several pixels, so the others would tell little more.
    """
    plate = Target(flat_plate(1000.0, 600.0))
    stands = np.asarray(distances_mm) + step_error_mm * rng.standard_normal(np.shape(distances_mm))
    return [camera.scan(plate, view_from(np.zeros(3), distance), rng, every=4).points for distance in stands]


def depth_left(camera: Scanner, correction: FieldCorrection) -> pd.DataFrame:
    """A camera's own depth error and what a correction says of it, all over the volume, without noise.

    Returns:
        x_mm, y_mm, z_mm of true points; true_mm, learned_mm, and left_mm, the difference.
    """
    low, high = correction.low, correction.high
    slopes = [np.linspace(low[k], high[k], count) for k, count in ((0, 64), (1, 36))]
    u, v, z = (part.ravel() for part in np.meshgrid(*slopes, np.linspace(low[2], high[2], 7)))
    points = np.column_stack([u * z, v * z, z])
    true = camera.systematic_mm(points)
    learned = correction.error_mm(points * (1 + true / z)[:, None])
    columns = {"true_mm": true, "learned_mm": learned, "left_mm": true - learned}
    return pd.DataFrame(points, columns=["x_mm", "y_mm", "z_mm"]).assign(**columns)


def summary(path: SeamPath, scene: WeldScene) -> dict[str, float]:
    """A path's mean and largest distance from the true root and from the root as shown, mm; its axis' mean angle."""
    errors, shown = waypoint_errors(path, scene), waypoint_errors(path, scene, as_shown=True)
    return {
        "off_mean_mm": errors.off_mm.mean(),
        "off_max_mm": errors.off_mm.max(),
        "shown_mean_mm": shown.off_mm.mean(),
        "shown_max_mm": shown.off_mm.max(),
        "axis_mean_deg": errors.axis_deg.mean(),
    }


def over_views(views: pd.DataFrame, by: str) -> pd.DataFrame:
    """Summaries of each piece and variant (column ``by``) over all views: means of means, largest of the largest."""
    numbers = [name for name in views.columns if name.endswith(("_mm", "_deg"))]
    how = {name: "max" if "_max_" in name else "mean" for name in numbers}
    return views.groupby(["piece", by], sort=False).agg(how).reset_index()
