"""What a scanner sees and what it measures: an errorless sighting, and a scan with its truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import InputError
from grindvision.geometry import move_points
from grindvision.records import by_content

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

#: Surface id of a mixed pixel: its point lies on no surface at all.
NO_SURFACE = -1


@by_content
@dataclass(frozen=True)
class Sighting:
    """What an instrument without errors would see: the rays that hit something in range, before any noise.

    ``pixels`` (N, 2) column and row within ``grid_shape`` (rows, columns); ``points`` (N, 3) mm and ``normals`` (N,
    3) in the scanner frame; ``surface_id`` (N,) into ``surfaces``; ``in_light`` (N,) the projector sees the point too;
    ``incidence_rad`` (N,) the larger angle of both rays against the normal. ``every`` is the pixel step.
    """

    pixels: Integers
    grid_shape: tuple[int, int]
    every: int
    points: Floats
    normals: Floats
    surface_id: Integers
    surfaces: tuple[str, ...]
    in_light: Flags
    incidence_rad: Floats
    T_world_scanner: Floats


@by_content
@dataclass(frozen=True)
class Scan:
    """One measurement with its truth.

    ``points`` (N, 3) mm in the scanner frame are all that an algorithm may see. Truth: ``true_points`` and
    ``true_normals`` (N, 3) of the surface met by each ray, ``surface_id`` (N,) into ``surfaces`` (-1: a mixed pixel),
    ``T_world_scanner`` the true pose. ``pixels`` (N, 2) are column and row within ``grid_shape`` (rows, columns).
    """

    points: Floats
    pixels: Integers
    grid_shape: tuple[int, int]
    true_points: Floats
    true_normals: Floats
    surface_id: Integers
    surfaces: tuple[str, ...]
    T_world_scanner: Floats

    def world_points(self) -> Floats:
        """Measured points (N, 3) in the world frame."""
        return move_points(self.T_world_scanner, self.points)

    def on(self, surface: str) -> Flags:
        """Mark the points (N,) that truly lie on a surface.

        Raises:
            InputError: no such surface.
        """
        if surface not in self.surfaces:
            raise InputError(f"no surface {surface!r}; there are {', '.join(self.surfaces)}")
        return self.surface_id == self.surfaces.index(surface)

    def image(self, values: ArrayLike) -> Floats:
        """Lay values (N, ...) of the points out on the pixel grid (rows, columns, ...); NaN where there is no point."""
        values = np.asarray(values, dtype=float)
        grid = np.full((*self.grid_shape, *values.shape[1:]), np.nan)
        grid[self.pixels[:, 1], self.pixels[:, 0]] = values
        return grid

    def __len__(self) -> int:
        return len(self.points)

    def __str__(self) -> str:
        rows, columns = self.grid_shape
        off = np.einsum("ij,ij->i", self.points - self.true_points, self.true_normals)
        rms = np.sqrt(np.mean(off**2))
        return f"scan of {len(self):,} points on {columns} x {rows} pixels, rms {rms:.3g} mm off the surface"
