"""Heights over a curved surface on a regular grid, in the surface's own frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import InputError
from grindvision.geometry.transforms import check_rigid, move_points, rotate_vectors
from grindvision.records import by_content

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]


@by_content
@dataclass(frozen=True)
class HeightMap:
    """Heights along the normals of a ground surface, over a grid of R x C nodes ``spacing_mm`` apart.

    Node (i, j) stands at x = i spacing, y = j spacing of the map's frame, whose z is the mean normal of the ground and
    whose x runs along the longer side. ``T_scan_map`` (4, 4) leads into the frame of the scan. ``ground_mm`` (R, C)
    elevation of the ground, ``normals`` (R, C, 3) unit, both in the map's frame; ``heights_mm`` (R, C) above the
    ground, along its normals. NaN where the ground, or what stands on it, is not shown.
    """

    T_scan_map: Floats
    spacing_mm: float
    ground_mm: Floats
    normals: Floats
    heights_mm: Floats

    def __post_init__(self) -> None:
        check_rigid(self.T_scan_map, "T_scan_map")
        shape = np.shape(self.ground_mm)
        if len(shape) != 2 or min(shape) < 3:
            raise InputError(f"a height map needs a grid of at least 3 x 3 nodes, got {shape}")
        if np.shape(self.heights_mm) != shape or np.shape(self.normals) != (*shape, 3):
            raise InputError(
                f"ground {shape}, heights {np.shape(self.heights_mm)} and normals {np.shape(self.normals)} are no grid"
                " of one size"
            )
        if not 0 < self.spacing_mm < np.inf:
            raise InputError(f"the nodes are {self.spacing_mm} mm apart; give a length above zero")

    @property
    def shape(self) -> tuple[int, int]:
        """Number of nodes along x and y."""
        return self.ground_mm.shape[0], self.ground_mm.shape[1]

    @property
    def x_mm(self) -> Floats:
        """Places (R,) of the nodes along x."""
        return np.asarray(np.arange(self.shape[0]) * self.spacing_mm, dtype=float)

    @property
    def y_mm(self) -> Floats:
        """Places (C,) of the nodes along y."""
        return np.asarray(np.arange(self.shape[1]) * self.spacing_mm, dtype=float)

    @property
    def shown(self) -> Flags:
        """Nodes (R, C) at which the ground is known."""
        return np.isfinite(self.ground_mm)

    @property
    def areas_mm2(self) -> Floats:
        """Area (R, C) of the ground that belongs to each node; 0 where it is not shown."""
        cosines = np.where(self.shown, self.normals[..., 2], np.inf)
        return self.spacing_mm**2 / np.maximum(cosines, 0.1)

    @property
    def feet_mm(self) -> Floats:
        """Ground points (R, C, 3) in the map's frame."""
        x, y = np.meshgrid(self.x_mm, self.y_mm, indexing="ij")
        return np.stack([x, y, self.ground_mm], axis=-1)

    def at(self, values: ArrayLike, places_mm: ArrayLike) -> Floats:
        """Values (R, C, ...) of the nodes, taken at places (K, 2) x, y in between; NaN beside the map."""
        from scipy.ndimage import map_coordinates

        grid, places = np.asarray(values, dtype=float), np.asarray(places_mm, dtype=float) / self.spacing_mm
        flat = grid.reshape(*self.shape, -1)
        found = [
            map_coordinates(flat[..., k], places.T, order=1, mode="constant", cval=np.nan)
            for k in range(flat.shape[-1])
        ]
        return np.stack(found, axis=-1).reshape(len(places), *grid.shape[2:])

    def refined(self, times: int) -> HeightMap:
        """The same map with so many times as many nodes along each side, values in between by straight lines."""
        if times == 1:
            return self
        x, y = (np.arange((count - 1) * times + 1) * self.spacing_mm / times for count in self.shape)
        places = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
        shape = (len(x), len(y))
        ground, heights = (self.at(values, places).reshape(shape) for values in (self.ground_mm, self.heights_mm))
        normals = self.at(self.normals, places)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return HeightMap(self.T_scan_map, self.spacing_mm / times, ground, normals.reshape(*shape, 3), heights)

    def in_scan(self, places_mm: ArrayLike, heights_mm: ArrayLike = 0.0) -> tuple[Floats, Floats]:
        """Points (K, 3) at heights over places (K, 2) x, y of the map, and unit normals (K, 3), in the scan's frame."""
        places = np.asarray(places_mm, dtype=float)
        normals = self.at(self.normals, places)
        normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
        feet = np.column_stack([places, self.at(self.ground_mm, places)])
        points = feet + np.broadcast_to(heights_mm, len(places))[:, None] * normals
        return move_points(self.T_scan_map, points), rotate_vectors(self.T_scan_map, normals)

    def __str__(self) -> str:
        across = "{:.1f} x {:.1f} mm".format(*(self.spacing_mm * (count - 1) for count in self.shape))
        return f"height map of {across}, nodes {self.spacing_mm:.3g} mm apart"
