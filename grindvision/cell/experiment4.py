"""The twin of experiment 4 of diao2018: a part whose bead runs through the printed path points, in the printed pose."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from grindvision import paper
from grindvision.cell.grinding_part import BEAD_PLACE, STATION_MM, Bead, GrindingPart, Surface, free_form, good_part
from grindvision.cell.grinding_scene import GrindingScene, scanned_pair
from grindvision.cell.rays import Target, target_of
from grindvision.cell.scanners import Scanner, StructuredLightScanner
from grindvision.errors import InputError, SightError
from grindvision.geometry import (
    fit_rigid,
    inverse,
    move_points,
    nearest_rotation,
    rigid,
    rotate_vectors,
    rotation_about,
    vector_angle,
)
from grindvision.records import by_content

Floats = NDArray[np.float64]

#: The bead goes on past the first and the last printed point by half their mean distance, as if each were the middle of
#: its sixth of the bead.
OVERHANG_MM = 3.3

#: Where the bead's middle lies on the plate (x, y in mm): off its centre, so that the part of the plate that the
#: scanner has in range from the printed pose carries boss, rib and pocket.
BEAD_MIDDLE_MM = (-38.0, -14.0)

#: Within this distance of the bead the plate follows the printed normals; farther out it is the standard free form.
BLEND_MM = 18.0

#: A drawn pose of the sample is good when the scan shows so much of what the test scan shows, and the bead's place.
MIN_OVERLAP = 0.5

#: Poses drawn before it is given up. Of fifty seeds of the standard twin two draw twice.
MAX_DRAWS = 20

#: What a pose shows is looked at on every so many-th pixel, and counts as shown within this distance of a point.
LOOK_EVERY, LOOK_MM = 6, 2.5


@by_content
@dataclass(frozen=True)
class PrintedPath:
    """The path of Table 3 made usable, in the scanner frame (mm).

    ``points_mm`` (6, 3) as printed. ``normals`` (6, 3): as printed with x and y negated, so that they face the
    scanner and stand nearly perpendicular to the path, then turned by ``rotations_deg`` (6,) to stand exactly so.
    ``tangents`` (6, 3) of the smooth curve through the points. ``T_base_scanner`` (4, 4) is what Tables 3 and 4
    together imply.
    """

    points_mm: Floats
    normals: Floats
    tangents: Floats
    rotations_deg: Floats
    T_base_scanner: Floats

    def curve(self) -> tuple[Floats, Floats]:
        """Ridge (K, 3) through the printed points, ``OVERHANG_MM`` longer at both ends, and unit normals (K, 3)."""
        s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self.points_mm, axis=0), axis=1))])
        ends = s[[0, -1]] + np.array([-OVERHANG_MM, OVERHANG_MM])
        at = np.linspace(ends[0], ends[1], int(np.ceil(np.ptp(ends) / STATION_MM)) + 1)
        inside = np.clip(at, s[0], s[-1])
        spline = CubicSpline(s, self.points_mm, bc_type="natural")
        ridge = spline(inside) + (at - inside)[:, None] * spline(inside, 1)
        normals = CubicSpline(s, self.normals, bc_type="natural")(inside)
        return ridge, perpendicular(normals, spline(inside, 1))


@dataclass(frozen=True)
class Experiment4Twin:
    """A synthetic experiment 4: ``scene`` as the scanner would deliver it, and the truth in scanner and base frame."""

    scene: GrindingScene
    path: PrintedPath

    @property
    def T_base_scanner(self) -> Floats:
        """Pose of the scanner (4, 4) during the test scan, in the robot's base frame."""
        return self.path.T_base_scanner

    @property
    def ridge_base_mm(self) -> Floats:
        """True ridge (K, 3) in the base frame."""
        return move_points(self.T_base_scanner, self.scene.ridge_mm)

    @property
    def ridge_normals_base(self) -> Floats:
        """True surface normals (K, 3) along the ridge in the base frame."""
        return rotate_vectors(self.T_base_scanner, self.scene.ridge_normals)

    def __str__(self) -> str:
        return (
            f"twin of experiment 4: {self.scene}; printed normals turned by up to"
            f" {self.path.rotations_deg.max():.1f} deg"
        )


def printed_path() -> PrintedPath:
    """Table 3 of diao2018 with its normals mended, and the pose that Tables 3 and 4 imply.

    Raises:
        FileError: the printed tables are missing.
    """
    points, printed = paper.path_points(3)
    points_base, _ = paper.path_points(4)
    facing = printed * [-1.0, -1.0, 1.0]
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    tangents = CubicSpline(s, points, bc_type="natural")(s, 1)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    normals = perpendicular(facing, tangents)
    angles_deg = np.degrees(vector_angle(facing, normals))
    return PrintedPath(points, normals, tangents, angles_deg, fit_rigid(points, points_base).T_target_source)


def twin_part(path: PrintedPath, width_mm: float = 4.0, height_mm: float = 1.5) -> tuple[GrindingPart, Floats]:
    """Grinding part whose bead's ridge is the printed path, and its pose T_scanner_part (4, 4) in the printed scan."""
    ridge, normals = path.curve()
    z_axis = normals.mean(axis=0)
    x_axis = ridge[-1] - ridge[0]
    y_axis = np.cross(z_axis, x_axis)
    axes = np.column_stack([v / np.linalg.norm(v) for v in (np.cross(y_axis, z_axis), y_axis, z_axis)])
    moved = rotation_about([0.0, 0.0, 1.0], -np.radians(BEAD_PLACE[2]))
    rotation = nearest_rotation(axes) @ moved
    foot = ridge - height_mm * normals
    middle = np.array([*BEAD_MIDDLE_MM, free_form(*np.array(BEAD_MIDDLE_MM))])
    T_scanner_part = rigid(rotation, foot.mean(axis=0) - rotation @ middle)
    T_part_scanner = inverse(T_scanner_part)
    bead = Bead(move_points(T_part_scanner, ridge), rotate_vectors(T_part_scanner, normals), width_mm, height_mm)
    return good_part(_surface_under(bead)).with_bead(bead), T_scanner_part


def experiment4_twin(
    rng: np.random.Generator,
    scanner: Scanner | None = None,
    rotation_deg: float = 25.0,
    every: int = 1,
) -> Experiment4Twin:
    """Scan the twin: the test part from the printed pose, the sample from a pose about ``rotation_deg`` away.

    Who scans looks at what the scanner shows: a drawn pose of the sample that shows less than half of what the test
    scan shows, or not the whole place of the bead, is drawn again.

    Args:
        rng: draws the instrument (its serial), the sample's pose and all noise.
        scanner: a structured-light scanner when left out; one that is given keeps its serial.
        rotation_deg: rotation of the sample's pose, towards facing the plate.
        every: pixel step; 1 gives full resolution.

    Raises:
        InputError: a rotation outside 0 to 40 deg. SightError: the scanner given does not reach the part, or no drawn
            pose shows enough of it.
    """
    if not 0 <= rotation_deg <= 40:
        raise InputError(
            f"rotation_deg is {rotation_deg}; choose 0 to 40, so that the sample scan still sees the bead's place"
        )
    path, part, T_scanner_part = _twin()
    serial = int(rng.integers(2**31))
    scanner = scanner or StructuredLightScanner(serial=serial)
    T_part_test = inverse(T_scanner_part)
    target = target_of(part.sample)
    spots = _shown(scanner, target, T_part_test, rng.spawn(1)[0])
    place = part.bead.ridge_mm - part.bead.height_mm * part.bead.normals
    for _ in range(MAX_DRAWS):
        T_part_sample = _sample_pose(rng, scanner, T_part_test, rotation_deg)
        try:
            shown = cKDTree(_shown(scanner, target, T_part_sample, rng.spawn(1)[0]))
        except SightError:
            continue
        of_test, of_place = (np.isfinite(shown.query(at, distance_upper_bound=LOOK_MM)[0]) for at in (spots, place))
        if of_test.mean() >= MIN_OVERLAP and of_place.all():
            return Experiment4Twin(scanned_pair(part, scanner, T_part_sample, T_part_test, rng, every), path)
    raise SightError(
        f"none of {MAX_DRAWS} poses drawn {rotation_deg} deg from the printed one shows the bead's place and"
        f" {MIN_OVERLAP:.0%} of what the test scan shows; give another rotation_deg or a scanner with a wider view"
    )


def _sample_pose(rng: np.random.Generator, scanner: Scanner, T_part_test: Floats, rotation_deg: float) -> Floats:
    """Pose T_part_sample (4, 4), turned towards facing the plate about the middle of what the test scan sees of it."""
    axis = np.cross(T_part_test[:3, 2], [0.0, 0.0, -1.0]) + 0.3 * rng.standard_normal(3)
    pivot = np.array([0.0, BEAD_MIDDLE_MM[1], 0.0])
    moved = rotation_about(axis, np.radians(rotation_deg))
    pose = rigid(moved @ T_part_test[:3, :3], pivot + moved @ (T_part_test[:3, 3] - pivot))
    seen_mm = float((pivot - pose[:3, 3]) @ pose[:3, 2])
    pose[:3, 3] += (seen_mm - scanner.reference_mm) * pose[:3, 2]
    return pose


def _shown(scanner: Scanner, target: Target, T_part_scanner: Floats, rng: np.random.Generator) -> Floats:
    """Points (N, 3) of the part, in its frame, that a quick look from a pose shows."""
    view = scanner.measure(scanner.sight(target, T_part_scanner, LOOK_EVERY), rng)
    return move_points(T_part_scanner, view.true_points)


@cache
def _twin() -> tuple[PrintedPath, GrindingPart, Floats]:
    """The printed path, and the part that is built round it: the same for every seed."""
    path = printed_path()
    return path, *twin_part(path)


def perpendicular(vectors: Floats, axes: Floats) -> Floats:
    """Unit vectors (K, 3): ``vectors`` with their part along ``axes`` (K, 3) taken away."""
    axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    left = vectors - np.einsum("ij,ij->i", vectors, axes)[:, None] * axes
    return left / np.linalg.norm(left, axis=1, keepdims=True)


def _surface_under(bead: Bead) -> Surface:
    """Free-form surface z(x, y) that holds the bead's foot line with the bead's normals."""
    foot = bead.ridge_mm - bead.height_mm * bead.normals
    tree = cKDTree(foot[:, :2])
    slopes = -bead.normals[:, :2] / bead.normals[:, 2:]

    def surface(x: Floats, y: Floats) -> Floats:
        at = np.column_stack([np.ravel(x), np.ravel(y)])
        near, index = tree.query(at, k=1)
        away = at - foot[index, :2]
        plane = foot[index, 2] + np.einsum("ij,ij->i", away, slopes[index])
        weight = np.exp(-((near / BLEND_MM) ** 4))
        height = weight * plane + (1 - weight) * free_form(at[:, 0], at[:, 1])
        return height.reshape(np.shape(x))

    return surface
