"""Solids of the virtual cell: closed triangle meshes in mm whose every triangle knows the surface it belongs to."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import InputError
from grindvision.extras import extra
from grindvision.geometry import move_points

with extra("sim"):
    import manifold3d as m3

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Solid:
    """A closed mesh: ``vertices_mm`` (V, 3), ``triangles`` (M, 3) counter-clockwise from outside.

    ``surface_id`` (M,) indexes the names in ``surfaces``. A solid equals itself only.
    """

    vertices_mm: Floats
    triangles: Integers
    surface_id: Integers
    surfaces: tuple[str, ...]

    @property
    def watertight(self) -> bool:
        """Every edge is shared by exactly two triangles that run through it in opposite directions."""
        edges = np.concatenate([self.triangles[:, [0, 1]], self.triangles[:, [1, 2]], self.triangles[:, [2, 0]]])
        count = len(self.vertices_mm)
        there, back = edges[:, 0] * count + edges[:, 1], edges[:, 1] * count + edges[:, 0]
        there.sort()
        back.sort()
        return bool((np.diff(there) > 0).all() and np.array_equal(there, back))

    @property
    def volume_mm3(self) -> float:
        """Volume inside, positive when the triangles face outwards."""
        a, b, c = (self.vertices_mm[self.triangles[:, i]] for i in range(3))
        return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)

    def moved(self, T_to_solid: ArrayLike) -> Solid:
        """Return the solid with its vertices expressed in another frame."""
        return replace(self, vertices_mm=move_points(T_to_solid, self.vertices_mm))

    def surface(self, name: str) -> int:
        """Id of a surface by its name.

        Raises:
            InputError: there is no such surface; the message lists those there are.
        """
        if name not in self.surfaces:
            raise InputError(f"no surface {name!r}; there are {', '.join(self.surfaces)}")
        return self.surfaces.index(name)

    def __str__(self) -> str:
        size = f"{len(self.triangles):,} triangles, {self.volume_mm3:.0f} mm3"
        return f"solid of {size}, surfaces {', '.join(self.surfaces)}"


def assembled(solids: Sequence[Solid]) -> Solid:
    """Put solids of one frame side by side in one mesh; equal surface names share one id."""
    surfaces = tuple(dict.fromkeys(name for solid in solids for name in solid.surfaces))
    starts = np.cumsum([0] + [len(solid.vertices_mm) for solid in solids[:-1]])
    return Solid(
        np.concatenate([solid.vertices_mm for solid in solids]),
        np.concatenate([solid.triangles + start for solid, start in zip(solids, starts, strict=True)]),
        np.concatenate([np.array([surfaces.index(n) for n in s.surfaces])[s.surface_id] for s in solids]),
        surfaces,
    )


class Shape:
    """A solid under construction by Boolean operations, each primitive's faces named after it."""

    def __init__(self, body: m3.Manifold, names: dict[int, str]) -> None:
        self.body = body
        self.names = names

    @classmethod
    def named(cls, body: m3.Manifold, name: str) -> Shape:
        """Name all faces of a primitive; they keep the name through every later cut."""
        body = body.as_original()
        return cls(body, {body.original_id(): name})

    def __add__(self, other: Shape) -> Shape:
        return Shape(self.body + other.body, self.names | other.names)

    def __sub__(self, other: Shape) -> Shape:
        return Shape(self.body - other.body, self.names | other.names)

    def __and__(self, other: Shape) -> Shape:
        return Shape(self.body ^ other.body, self.names | other.names)

    def solid(self) -> Solid:
        """Return the finished mesh with the surface of every triangle."""
        mesh = self.body.to_mesh64()
        triangles = np.asarray(mesh.tri_verts, dtype=np.int64)
        ends = np.asarray(mesh.run_index, dtype=np.int64)
        runs = (ends[1:] - ends[:-1]) // 3
        names = [self.names[int(origin)] for origin in mesh.run_original_id]
        surfaces = tuple(dict.fromkeys(names))
        surface_id = np.repeat([surfaces.index(name) for name in names], runs)
        return Solid(np.asarray(mesh.vert_properties)[:, :3].astype(float), triangles, surface_id, surfaces)


def box(name: str, low_mm: ArrayLike, high_mm: ArrayLike) -> Shape:
    """Axis-parallel box between two corners (3,).

    Raises:
        InputError: an edge is not positive.
    """
    low, high = np.asarray(low_mm, dtype=float), np.asarray(high_mm, dtype=float)
    for axis, edge in zip("xyz", high - low, strict=True):
        check_size(f"{name}: edge along {axis}", edge)
    return Shape.named(m3.Manifold.cube((high - low).tolist()).translate(low.tolist()), name)


def height_field(
    name: str, x_mm: Floats, y_mm: Floats, top: Callable[[Floats, Floats], Floats], bottom_mm: float
) -> Shape:
    """Block over the grid ``x_mm`` x ``y_mm`` whose upper face is ``top(x, y)`` and whose floor is ``bottom_mm``."""
    x, y = np.meshgrid(x_mm, y_mm, indexing="ij")
    z = np.broadcast_to(top(x, y), x.shape)
    if not z.min() > bottom_mm:
        raise InputError(f"{name}: the surface comes down to {z.min():.3g} mm, below its floor at {bottom_mm} mm")
    grid = np.stack([x, y, z], axis=-1)
    lower = grid.copy()
    lower[..., 2] = bottom_mm
    return lofted(name, grid, lower)


def lofted(name: str, upper: Floats, lower: Floats) -> Shape:
    """Block between two grids (R, C, 3) of the same shape, closed by four walls; ``upper`` faces +(row x column)."""
    rows, columns = upper.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    under = index + rows * columns

    def quads(a: Integers, b: Integers, c: Integers, d: Integers) -> Integers:
        corners = [np.ravel(corner) for corner in (a, b, c, d)]
        return np.concatenate([np.stack(corners[:3], 1), np.stack([corners[0], corners[2], corners[3]], 1)])

    faces = [
        quads(index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]),
        quads(under[:-1, :-1], under[:-1, 1:], under[1:, 1:], under[1:, :-1]),
    ]
    rim = np.concatenate([index[:-1, 0], index[-1, :-1], index[:0:-1, -1], index[0, :0:-1]])
    after = np.roll(rim, -1)
    faces.append(quads(rim, rim + rows * columns, after + rows * columns, after))
    return _closed(name, np.concatenate([upper.reshape(-1, 3), lower.reshape(-1, 3)]), np.concatenate(faces))


def swept(name: str, rings: Floats) -> Shape:
    """Solid between rings (R, P, 3), each a convex outline counter-clockwise when seen against the way they follow."""
    count, corners = rings.shape[:2]
    index = np.arange(count * corners).reshape(count, corners)
    after = np.roll(index, -1, axis=1)
    side = [index[:-1].ravel(), after[:-1].ravel(), after[1:].ravel(), index[1:].ravel()]
    faces = [np.stack([side[0], side[1], side[2]], 1), np.stack([side[0], side[2], side[3]], 1)]
    fan = np.array([[0, i, i + 1] for i in range(1, corners - 1)])
    faces += [index[0][fan][:, ::-1], index[-1][fan]]
    return _closed(name, rings.reshape(-1, 3), np.concatenate(faces))


def check_size(name: str, size_mm: float) -> float:
    """Return a length.

    Raises:
        InputError: it is not a positive finite number.
    """
    if not (np.isfinite(size_mm) and size_mm > 0):
        raise InputError(f"{name} is {size_mm} mm; it must be above zero")
    return float(size_mm)


def _closed(name: str, vertices: Floats, triangles: Integers) -> Shape:
    body = m3.Manifold(m3.Mesh64(vertices, triangles.astype(np.uint64)))
    if body.status() != m3.Error.NoError or not body.volume() > 0:
        raise InputError(f"{name}: the sizes given make a shape that cuts itself; use gentler curves or smaller sizes")
    return Shape.named(body, name)
