"""A depth camera looks at a weld piece: a labelled cloud with the groove's true root line, all in the camera frame."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from grindvision.cell.rays import Target, target_of
from grindvision.cell.scan import Scan
from grindvision.cell.scanners import DepthCamera, Scanner
from grindvision.cell.views import view_from
from grindvision.cell.weld_pieces import GROOVE, Groove, WeldPiece, weld_piece
from grindvision.errors import SightError
from grindvision.geometry import inverse, move_points, rotate_vectors, vector_angle
from grindvision.records import by_content

Floats = NDArray[np.float64]

#: Tilt of the camera against the piece's z axis, towards its side, that shows the box's flank.
TILT_DEG = {"line": 5.0, "curve": 5.0, "box": 20.0, "cylinder": 5.0}

#: Root points seen at flatter angles than this do not count as visible.
VISIBLE_DEG = 70.0

#: Measured points so near a root point show it: about the groove's half width.
NEAR_MM = 8.0


@by_content
@dataclass(frozen=True)
class WeldScene:
    """What the camera measured, and the truth in the camera frame (mm).

    ``points`` (N, 3); ``labels`` (N,) true on the groove's walls and root; ``root_mm``, ``tangents``, ``normals`` (K,
    3) of the part of the root line that the camera sees, normals out of the groove. ``scan`` holds the pixels and true
    points, its world frame is the piece's frame; ``camera`` is the instrument that took it.
    """

    piece: WeldPiece
    camera: Scanner
    scan: Scan
    labels: NDArray[np.bool_]
    root_mm: Floats
    tangents: Floats
    normals: Floats

    @property
    def points(self) -> Floats:
        """Measured points (N, 3), camera frame, mm."""
        return self.scan.points

    @cached_property
    def root_errors_mm(self) -> Floats:
        """Mean error (K, 3) in mm of the points measured within ``NEAR_MM`` of each root point."""
        errors = self.scan.points - self.scan.true_points
        around = cKDTree(self.scan.true_points).query_ball_point(self.root_mm, NEAR_MM)
        return np.stack([errors[near].mean(axis=0) if near else np.zeros(3) for near in around])

    def __str__(self) -> str:
        return f"{self.piece}: {len(self.labels):,} points, {int(self.labels.sum()):,} of them in the groove"


def weld_scene(
    kind: str,
    rng: np.random.Generator,
    groove: Groove | None = None,
    camera: Scanner | None = None,
    distance_mm: float = 450.0,
    every: int = 1,
) -> WeldScene:
    """Put a weld piece under the camera and take one frame.

    Args:
        kind: line, curve, box or cylinder.
        rng: draws the camera's waviness (its serial), the view (up to 8 deg about the standard one) and all noise.
        groove: cross-section; 12 mm wide and 7 mm deep when left out.
        camera: a D415 when left out. A camera that is given keeps its serial.
        distance_mm: from the camera to the piece's upper side.
        every: pixel step; 1 gives the camera's full resolution.

    Raises:
        InputError: unknown kind or impossible groove. SightError: the distance is outside the camera's range.
    """
    piece = weld_piece(kind, groove)
    serial = int(rng.integers(2**31))
    camera = camera or DepthCamera(serial=serial)
    tilt, roll = np.radians(TILT_DEG[kind] + rng.uniform(-4, 4)), np.radians(rng.uniform(-8, 8))
    sideways = np.radians(90 + rng.uniform(-20, 20))
    pose = view_from(np.zeros(3), distance_mm, tilt, sideways, roll)
    target = target_of(piece.solid)
    scan = camera.scan(target, pose, rng, every)
    seen = _visible(piece, camera, target, pose)
    T_camera_piece = inverse(pose)
    return WeldScene(
        piece,
        camera,
        scan,
        scan.on(GROOVE),
        move_points(T_camera_piece, piece.root_mm[seen]),
        rotate_vectors(T_camera_piece, piece.tangents[seen]),
        rotate_vectors(T_camera_piece, piece.normals[seen]),
    )


def _visible(piece: WeldPiece, camera: Scanner, target: Target, pose: Floats) -> NDArray[np.bool_]:
    """Mark the root points (K,) in the image, not hidden, and not at too flat an angle."""
    eye = pose[:3, 3]
    points = move_points(inverse(pose), piece.root_mm)
    columns, rows = (points[:, :2] / points[:, 2:] * camera.focal_px).T
    seen = (np.abs(columns) < camera.columns / 2) & (np.abs(rows) < camera.rows / 2)
    seen &= vector_angle(eye - piece.root_mm, piece.normals) < np.radians(VISIBLE_DEG)
    # Just above the root, so that the walls' own triangles do not hide it.
    seen &= target.sees(piece.root_mm + 0.05 * piece.normals, piece.normals, eye)
    if not seen.any():
        raise SightError("the camera does not see the groove's root; turn it or choose a wider groove")
    return seen
