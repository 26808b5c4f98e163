"""A camera looks at a joint: a cloud with the seam's true line as far as it is seen, all in the camera frame."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from grindvision.cell.joint_pieces import JointPiece, JointSize, joint_piece
from grindvision.cell.rays import Target, target_of
from grindvision.cell.scan import Scan
from grindvision.cell.scanners import DepthCamera, Scanner
from grindvision.cell.views import view_from
from grindvision.errors import InputError, SightError
from grindvision.geometry import inverse, move_points, rotate_vectors
from grindvision.records import by_content

Floats = NDArray[np.float64]

#: A place of the root counts as seen from this far out of the joint, mm.
LIFT_MM = 1.0
#: Measured points so near to a place of the root show it.
NEAR_MM = 12.0
#: Spatter lands at most this far from the seam, mm, and is at most so thick.
SPATTER_REACH_MM, SPATTER_MM = 25.0, 1.5


@by_content
@dataclass(frozen=True)
class JointScene:
    """What the camera measured, and the truth in the camera frame (mm).

    ``points`` (N, 3) are measured; ``root_mm``, ``tangents``, ``normals`` (K, 3) the part of the seam that is seen.
    """

    piece: JointPiece
    camera: Scanner
    scan: Scan
    points: Floats
    root_mm: Floats
    tangents: Floats
    normals: Floats

    @cached_property
    def root_errors_mm(self) -> Floats:
        """Mean error (K, 3) in mm of the points measured within ``NEAR_MM`` of each place of the root."""
        errors = self.scan.points - self.scan.true_points
        around = cKDTree(self.scan.true_points).query_ball_point(self.root_mm, NEAR_MM)
        return np.stack([errors[near].mean(axis=0) if near else np.zeros(3) for near in around])

    def __str__(self) -> str:
        return f"{self.piece}: {len(self.points):,} points"


def joint_scene(
    kind: str,
    rng: np.random.Generator,
    size: JointSize | None = None,
    camera: Scanner | None = None,
    distance_mm: float = 450.0,
    every: int = 1,
    spatter: int = 0,
) -> JointScene:
    """Put a piece with a joint under the camera and take one frame.

    Args:
        kind: one of ``joint_pieces.JOINTS``.
        rng: draws the camera's waviness (its serial), the view (up to 8 deg about the standard one) and all noise.
        size: sizes of the joint.
        camera: a D415 when left out. A camera that is given keeps its serial.
        distance_mm: from the camera to the seam's middle.
        every: pixel step.
        spatter: so many drops of up to 1.5 mm near the seam, each on the points within half a millimetre.

    Raises:
        InputError: unknown kind, impossible sizes, spatter below 0. SightError: the seam is not seen from there.
    """
    if spatter < 0:
        raise InputError(f"spatter is {spatter}; give a number of drops, 0 or more")
    piece = joint_piece(kind, size)
    serial = int(rng.integers(2**31))
    camera = camera or DepthCamera(serial=serial)
    tilt, roll = np.radians(piece.tilt_deg + rng.uniform(-4, 4)), np.radians(rng.uniform(-8, 8))
    azimuth = np.radians(piece.azimuth_deg + rng.uniform(-8, 8))
    pose = view_from(piece.root_mm.mean(axis=0), distance_mm, tilt, azimuth, roll)
    target = target_of(piece.solid)
    scan = camera.scan(target, pose, rng, every)
    seen = _visible(piece, camera, target, pose)
    T_camera_piece = inverse(pose)
    root = move_points(T_camera_piece, piece.root_mm[seen])
    points = scan.points.copy()
    for _ in range(spatter):
        near = root[rng.integers(len(root))] + rng.uniform(-SPATTER_REACH_MM, SPATTER_REACH_MM, 3)
        lands = scan.true_points[((scan.true_points - near) ** 2).sum(axis=1).argmin()]
        drop = np.linalg.norm(scan.true_points - lands, axis=1) < 0.5
        points[drop] += scan.true_normals[drop] * rng.uniform(0.5, SPATTER_MM)
    return JointScene(
        piece, camera, scan, points, root,
        rotate_vectors(T_camera_piece, piece.tangents[seen]), rotate_vectors(T_camera_piece, piece.normals[seen]),
    )  # fmt: skip


def _visible(piece: JointPiece, camera: Scanner, target: Target, pose: Floats) -> NDArray[np.bool_]:
    """Mark the root places (K,) in the image and not hidden."""
    eye = pose[:3, 3]
    lifted = piece.root_mm + LIFT_MM * piece.normals
    points = move_points(inverse(pose), lifted)
    columns, rows = (points[:, :2] / points[:, 2:] * camera.focal_px).T
    seen = (np.abs(columns) < camera.columns / 2) & (np.abs(rows) < camera.rows / 2)
    seen &= target.sees(lifted, piece.normals, eye)
    if not seen.any():
        raise SightError("the camera does not see the seam; turn it or choose other sizes")
    return np.asarray(seen)
