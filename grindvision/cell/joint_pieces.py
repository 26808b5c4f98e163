"""Weld pieces of the joints that peng2020 does not have: fillets, laps, corners, gaps, tubes, other grooves."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import manifold3d as m3
import numpy as np
from numpy.typing import NDArray

from grindvision.cell.solids import Shape, Solid, box, check_size, swept
from grindvision.errors import InputError
from grindvision.geometry import rotation_about, unit_vectors, vector_angle
from grindvision.records import by_content

Floats = NDArray[np.float64]

#: The kinds, by the names that the detector gives them.
JOINTS = (
    "u-groove",
    "bevel-groove",
    "butt-gap",
    "t-joint",
    "lap-joint",
    "inside-corner",
    "outside-corner",
    "tube-on-plate",
    "saddle",
)

#: Spacing of the stations of a root line, mm; segments of a full circle.
STATION_MM, SEGMENTS = 0.5, 720
CLEARANCE_MM = 2.0
#: Tubes meet in a corner where their surfaces turn by at least this.
MIN_CORNER_RAD = np.radians(20.0)


@dataclass(frozen=True)
class JointSize:
    """Sizes of a joint, mm: plates ``length_mm`` along the seam, ``width_mm`` across it, ``thickness_mm`` thick.

    ``height_mm`` is how far an upright or a branch stands up, ``angle_deg`` the angle of air in a T-joint or a corner,
    ``gap_mm`` that of a butt joint; ``radius_mm`` of a tube, ``branch_mm`` the radius of a saddle's branch, which leans
    ``lean_deg`` from upright along the tube. ``tacks`` spheres of ``tack_mm`` radius lie in the seam, ``clamp`` lays a
    bar across its middle.
    """

    length_mm: float = 180.0
    width_mm: float = 70.0
    thickness_mm: float = 8.0
    height_mm: float = 70.0
    angle_deg: float = 90.0
    gap_mm: float = 2.0
    radius_mm: float = 30.0
    branch_mm: float = 20.0
    lean_deg: float = 0.0
    tacks: int = 0
    tack_mm: float = 3.0
    clamp: bool = False

    def __post_init__(self) -> None:
        lengths = ("length_mm", "width_mm", "thickness_mm", "height_mm", "gap_mm", "radius_mm", "branch_mm", "tack_mm")
        for name in lengths:
            check_size(name, getattr(self, name))
        if not 30 <= self.angle_deg <= 150:
            raise InputError(f"angle_deg is {self.angle_deg}; a joint's faces stand 30 to 150 deg apart")
        if self.branch_mm > self.radius_mm:
            raise InputError(f"the branch's radius {self.branch_mm} mm is above the tube's, {self.radius_mm} mm")
        if not 0 <= self.lean_deg <= 65:
            raise InputError(f"lean_deg is {self.lean_deg}; a branch leans 0 to 65 deg from upright")


@by_content
@dataclass(frozen=True)
class JointPiece:
    """A piece in its own frame (mm, z up) and the truth of its seam.

    ``root_mm`` (K, 3) with unit ``tangents`` and ``normals`` (K, 3), the latter half-way between the faces and out of
    the joint. ``tilt_deg`` and ``azimuth_deg`` are from where it is best seen: off z, and towards which side.
    """

    kind: str
    size: JointSize
    solid: Solid
    root_mm: Floats
    tangents: Floats
    normals: Floats
    tilt_deg: float
    azimuth_deg: float

    def __str__(self) -> str:
        length = np.linalg.norm(np.diff(self.root_mm, axis=0), axis=1).sum()
        return f"weld piece {self.kind}, seam {length:.0f} mm long"


@lru_cache(maxsize=16)
def joint_piece(kind: str, size: JointSize | None = None) -> JointPiece:
    """Make a piece of one of ``JOINTS``.

    Raises:
        InputError: unknown kind, or sizes that do not fit together.
    """
    makers = {
        "t-joint": _t_joint,
        "lap-joint": _lap,
        "butt-gap": _butt,
        "inside-corner": _inside,
        "outside-corner": _outside,
        "tube-on-plate": _tube_on_plate,
        "saddle": _saddle,
        "bevel-groove": _bevel,
        "u-groove": _u_groove,
    }
    if kind not in makers:
        raise InputError(f"no joint {kind!r}; choose one of {', '.join(JOINTS)}")
    return makers[kind](kind, size or JointSize())


def _t_joint(kind: str, size: JointSize) -> JointPiece:
    half = size.length_mm / 2
    base = box("base", [-half, -size.width_mm, -size.thickness_mm], [half, size.width_mm, 0])
    return _straight(kind, size, base + _upright(size), [0.0, 0.0], _halving(size.angle_deg), 38.0, -90.0)


def _inside(kind: str, size: JointSize) -> JointPiece:
    size = replace(size, height_mm=0.3 * size.height_mm)  # low enough that it shows that nothing is behind
    reach = size.thickness_mm * 0.9
    base = box("base", [-size.length_mm / 2, -size.width_mm, -size.thickness_mm], [size.length_mm / 2, reach, 0])
    return _straight(kind, size, base + _upright(size), [0.0, 0.0], _halving(size.angle_deg), 38.0, -90.0)


def _outside(kind: str, size: JointSize) -> JointPiece:
    half = size.length_mm / 2
    top = box("top", [-half, -size.width_mm, -size.thickness_mm], [half, 0, 0])
    side = box("side", [-half, -size.thickness_mm, -size.width_mm], [half, 0, -size.thickness_mm])
    return _straight(kind, size, top + side, [0.0, 0.0], np.array([1.0, 1.0]) / np.sqrt(2), 40.0, 90.0)


def _lap(kind: str, size: JointSize) -> JointPiece:
    half = size.length_mm / 2
    lower = box("lower", [-half, -size.width_mm, -size.thickness_mm], [half, size.width_mm, 0])
    upper = box("upper", [-half, 0, 0], [half, 1.5 * size.width_mm, size.thickness_mm])
    return _straight(kind, size, lower + upper, [0.0, 0.0], np.array([-1.0, 1.0]) / np.sqrt(2), 22.0, -90.0)


def _butt(kind: str, size: JointSize) -> JointPiece:
    half, gap = size.length_mm / 2, size.gap_mm / 2
    left = box("left", [-half, -size.width_mm, -size.thickness_mm], [half, -gap, 0])
    right = box("right", [-half, gap, -size.thickness_mm], [half, size.width_mm, 0])
    return _straight(kind, size, left + right, [0.0, 0.0], np.array([0.0, 1.0]), 6.0, -90.0)


def _bevel(kind: str, size: JointSize) -> JointPiece:
    """One upright wall, the other at 45 degrees; as deep as 0.8 of the plate."""
    depth = 0.8 * size.thickness_mm
    outline = np.array([[0.0, -depth], [depth + CLEARANCE_MM, CLEARANCE_MM], [0.0, CLEARANCE_MM]])
    return _cut(kind, size, outline, np.array([0.0, -depth]), np.array([0.38, 0.92]), 10.0, 90.0)


def _u_groove(kind: str, size: JointSize) -> JointPiece:
    """Walls 12 degrees from upright and a round floor of 40 % of the thickness, as deep as 0.8 of the plate."""
    depth, floor = 0.8 * size.thickness_mm, 0.4 * size.thickness_mm
    lean = np.radians(12)
    around = np.linspace(np.pi + lean, 2 * np.pi - lean, 17)
    centre = floor - depth
    arc = np.column_stack([floor * np.cos(around), centre + floor * np.sin(around)])
    top = arc[-1, 0] + (CLEARANCE_MM - arc[-1, 1]) * np.tan(lean)
    outline = np.concatenate([arc, [[top, CLEARANCE_MM], [-top, CLEARANCE_MM]]])
    return _cut(kind, size, outline, np.array([0.0, -depth]), np.array([0.0, 1.0]), 6.0, -90.0)


def _cut(
    kind: str, size: JointSize, outline: Floats, root: Floats, normal: Floats, tilt_deg: float, azimuth_deg: float
) -> JointPiece:
    half = size.length_mm / 2
    plate = box("plate", [-half, -size.width_mm, -size.thickness_mm], [half, size.width_mm, 0])
    x = np.array([-half - CLEARANCE_MM, half + CLEARANCE_MM])
    # Seen along x, y points to the left: the outline is counter-clockwise in y, z.
    rings = np.stack([np.column_stack([np.full(len(outline), at), outline[:, 0], outline[:, 1]]) for at in x])
    return _straight(kind, size, plate - swept("groove", rings), root.tolist(), normal, tilt_deg, azimuth_deg)


def _upright(size: JointSize) -> Shape:
    """A plate that stands on y = 0, z = 0 and leans so that ``angle_deg`` of air is in front of it."""
    half = size.length_mm / 2
    turn = rotation_about([1.0, 0.0, 0.0], np.radians(size.angle_deg - 90.0))
    plate = m3.Manifold.cube([2 * half, size.thickness_mm, size.height_mm + 2 * size.thickness_mm])
    plate = plate.translate([-half, 0.0, -2 * size.thickness_mm]).transform(np.column_stack([turn.T, np.zeros(3)]))
    above = m3.Manifold.cube([4 * half, 8 * size.height_mm, 4 * size.height_mm]).translate(
        [-2 * half, -4 * size.height_mm, -0.5 * size.thickness_mm]
    )
    return Shape.named(plate ^ above, "upright")


def _halving(angle_deg: float) -> Floats:
    """Unit (y, z) half-way between the base's normal (0, 1) and the upright's, with ``angle_deg`` of air between."""
    half = np.radians(angle_deg) / 2
    return np.array([-np.cos(half), np.sin(half)])


def _tube_on_plate(kind: str, size: JointSize) -> JointPiece:
    reach = size.radius_mm + size.width_mm
    base = box("base", [-reach, -reach, -size.thickness_mm], [reach, reach, 0])
    tube = m3.Manifold.cylinder(size.height_mm + 1.0, size.radius_mm, circular_segments=SEGMENTS)
    tube = tube.translate([0, 0, -1.0])
    angle = np.arange(0, 2 * np.pi, STATION_MM / size.radius_mm)
    outward = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    tangents = np.column_stack([-np.sin(angle), np.cos(angle), 0 * angle])
    normals = (outward + [0, 0, 1]) / np.sqrt(2)
    shape = _spoiled(base + Shape.named(tube, "tube"), size, size.radius_mm * outward)
    return JointPiece(kind, size, shape.solid(), size.radius_mm * outward, tangents, normals, 38.0, -90.0)


def _saddle(kind: str, size: JointSize) -> JointPiece:
    """A tube along x with its axis at z = 0, and a branch that leans from z towards x; their axes cross."""
    lay = np.array([[0.0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0]])
    lean = np.radians(size.lean_deg)
    reach = (size.radius_mm + size.branch_mm * np.sin(lean)) / np.cos(lean)
    length = size.length_mm + 2 * reach * np.tan(lean)
    main = m3.Manifold.cylinder(length, size.radius_mm, circular_segments=SEGMENTS)
    main = main.translate([0, 0, -length / 2]).transform(lay)
    turn = rotation_about([0.0, 1.0, 0.0], lean)
    branch = m3.Manifold.cylinder(reach + size.height_mm, size.branch_mm, circular_segments=SEGMENTS)
    branch = branch.transform(np.column_stack([turn, np.zeros(3)]))
    angle = np.arange(0, 2 * np.pi, STATION_MM / size.branch_mm)
    of_branch = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle]) @ turn.T
    around = size.branch_mm * of_branch
    level = np.sqrt(np.maximum(size.radius_mm**2 - around[:, 1] ** 2, 0.0))
    root = around + ((level - around[:, 2]) / np.cos(lean))[:, None] * turn[:, 2]
    tangents = unit_vectors(np.gradient(np.concatenate([root[-1:], root, root[:1]]), axis=0)[1:-1])
    of_main = np.column_stack([0 * angle, root[:, 1], level]) / size.radius_mm
    # Tubes of one radius touch at their sides: there is no corner to weld.
    corner = vector_angle(of_branch, of_main) > MIN_CORNER_RAD
    shape = _spoiled(Shape.named(main, "tube") + Shape.named(branch, "branch"), size, root[corner])
    normals = unit_vectors(of_branch + of_main)[corner]
    return JointPiece(kind, size, shape.solid(), root[corner], tangents[corner], normals, 40.0, -60.0)


def _straight(
    kind: str, size: JointSize, shape: Shape, root: list[float], normal: Floats, tilt_deg: float, azimuth_deg: float
) -> JointPiece:
    """A piece whose seam runs along x through (y, z) = ``root``."""
    x = np.linspace(-size.length_mm / 2, size.length_mm / 2, int(size.length_mm / STATION_MM) + 1)
    line = np.column_stack([x, np.full_like(x, root[0]), np.full_like(x, root[1])])
    tangents = np.tile([1.0, 0.0, 0.0], (len(x), 1))
    unit = normal / np.linalg.norm(normal)
    normals = np.tile([0.0, *unit], (len(x), 1))
    shape = _spoiled(shape, size, line)
    return JointPiece(kind, size, shape.solid(), line, tangents, normals, tilt_deg, azimuth_deg)


def _spoiled(shape: Shape, size: JointSize, line: Floats) -> Shape:
    """The piece with its tack welds and a clamp over the seam."""
    for number in range(size.tacks):
        place = line[int((number + 0.5) / size.tacks * len(line))]
        ball = m3.Manifold.sphere(size.tack_mm, circular_segments=48).translate(place.tolist())
        shape = shape + Shape.named(ball, "tack")
    if size.clamp:
        middle = line[len(line) // 2]
        bar = m3.Manifold.cube([12.0, 60.0, 60.0]).translate((middle - [6.0, 30.0, 30.0]).tolist())
        shape = shape + Shape.named(bar, "clamp")
    return shape
