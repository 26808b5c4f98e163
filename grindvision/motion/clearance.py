"""How far the moving arm and tool stay from the table, the work and themselves (coal, through Pinocchio)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import InputError
from grindvision.extras import extra
from grindvision.geometry import check_points, check_rigid
from grindvision.lazy import renamed_property
from grindvision.motion.robot import Robot
from grindvision.records import by_content

with extra("robot"):
    import coal
    import pinocchio as pin

Floats = NDArray[np.float64]


@by_content
@dataclass(frozen=True)
class Obstacle:
    """Something that stands still: a coal ``shape`` in mm whose frame lies at ``T_base_shape``."""

    name: str
    shape: coal.CollisionGeometry
    T_base_shape: Floats

    def __str__(self) -> str:
        return f"obstacle {self.name}"


@by_content
@dataclass(frozen=True)
class Clearance:
    """Least distance in mm at each of N joint positions, below zero where bodies overlap.

    ``distance_mm`` (N, K) holds it for each of ``against`` (K): the robot's own bodies ("itself"), then every obstacle.
    ``nearest`` names the nearest pair of bodies at each position.
    """

    distance_mm: Floats
    against: tuple[str, ...]
    nearest: tuple[tuple[str, str], ...]

    @property
    def min_mm(self) -> float:
        """The least distance of all, mm."""
        return float(self.distance_mm.min())

    least_mm = renamed_property("least_mm", "min_mm")

    @property
    def tightest(self) -> int:
        """Number of the position with the least distance."""
        return int(self.distance_mm.min(axis=1).argmin())

    def __str__(self) -> str:
        first, second = self.nearest[self.tightest]
        return f"at least {self.min_mm:.1f} mm clear, at way point {self.tightest} between {first} and {second}"


def box(name: str, size_mm: ArrayLike, T_base_box: ArrayLike) -> Obstacle:
    """A box with edges ``size_mm`` (3,) about the origin of its frame."""
    size = np.asarray(size_mm, dtype=float)
    if size.shape != (3,) or not (size > 0).all():
        raise InputError(f"the box {name} needs three edges above 0 mm, got {size.tolist()}")
    return Obstacle(name, coal.Box(*size), check_rigid(T_base_box, "T_base_box"))


def table(top_mm: float = 0.0, edge_mm: float = 3000.0) -> Obstacle:
    """A square table top about the base's axis, its surface at ``z = top_mm`` in the base frame."""
    thickness_mm = 200.0
    place = np.eye(4)
    place[2, 3] = top_mm - thickness_mm / 2
    return box("table", [edge_mm, edge_mm, thickness_mm], place)


def mesh(name: str, vertices_mm: ArrayLike, triangles: ArrayLike, T_base_mesh: ArrayLike) -> Obstacle:
    """A triangle mesh: vertices (V, 3) in mm in its own frame, triangles (F, 3) of vertex numbers."""
    vertices = check_points(vertices_mm, f"vertices of {name}", min_points=3)
    faces = np.asarray(triangles, dtype=int)
    if faces.ndim != 2 or faces.shape[1] != 3 or len(faces) == 0 or faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(f"triangles of {name} have shape {faces.shape}; expected (F, 3) numbers of its vertices")
    corners, corner_numbers = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
    for vertex in vertices:
        corners.append(vertex)
    for a, b, c in faces.tolist():
        corner_numbers.append(coal.Triangle(a, b, c))
    shape = coal.BVHModelOBBRSS()
    shape.beginModel(len(faces), len(vertices))
    shape.addSubModel(corners, corner_numbers)
    shape.endModel()
    return Obstacle(name, shape, check_rigid(T_base_mesh, "T_base_mesh"))


def scanned(name: str, points_base_mm: ArrayLike, cell_mm: float = 3.0) -> Obstacle:
    """What a scan saw: every cube of edge ``cell_mm`` of an octree that holds one of the points (N, 3) is solid."""
    if not cell_mm > 0:
        raise InputError(f"the octree's cell is {cell_mm:.4g} mm; it must be above 0")
    return Obstacle(name, coal.makeOctree(check_points(points_base_mm, f"points of {name}"), float(cell_mm)), np.eye(4))


def measure_clearance(robot: Robot, q_rad: ArrayLike, obstacles: Sequence[Obstacle] = ()) -> Clearance:
    """Least distance between the arm's own bodies, and between what moves and each obstacle, at joint angles (N, n)."""
    q = np.asarray(q_rad, dtype=float)
    if q.ndim != 2 or q.shape[1] != robot.model.nq or len(q) == 0:
        raise InputError(f"joint positions have shape {q.shape}; expected (N, {robot.model.nq})")
    world = robot.bodies.copy()
    kinds = [0] * len(world.collisionPairs)
    movers = [number for number, body in enumerate(world.geometryObjects) if body.parentJoint > 0]
    for kind, obstacle in enumerate(obstacles, 1):
        still = world.addGeometryObject(
            pin.GeometryObject(obstacle.name, 0, pin.SE3(obstacle.T_base_shape), obstacle.shape)
        )
        for mover in movers:
            world.addCollisionPair(pin.CollisionPair(mover, still))
            kinds.append(kind)
    data, world_data = robot.model.createData(), world.createData()
    of_pairs = np.full((len(q), len(kinds)), np.inf)
    for row, angles in enumerate(q):
        pin.computeDistances(robot.model, data, world, world_data, angles)
        of_pairs[row] = [result.min_distance for result in world_data.distanceResults]
    names = [body.name for body in world.geometryObjects]
    pairs = [(names[pair.first], names[pair.second]) for pair in world.collisionPairs]
    kind_of = np.array(kinds)
    by_kind = [of_pairs[:, kind_of == kind].min(axis=1, initial=np.inf) for kind in range(len(obstacles) + 1)]
    return Clearance(
        np.stack(by_kind, axis=1),
        ("itself", *(obstacle.name for obstacle in obstacles)),
        tuple(pairs[nearest] for nearest in of_pairs.argmin(axis=1)),
    )
