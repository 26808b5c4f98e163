"""ICP across motions that hardly anything resists: along them it would slide to wherever small errors lead it."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from grindvision.geometry import move_points, rigid, small_motion, twist_between
from grindvision.vision.registration.free_motions import rms_extent
from grindvision.vision.registration.icp import FineRegistration
from grindvision.vision.registration.plane_icp import icp_planes
from grindvision.vision.surface.scan import Scan
from grindvision.vision.surface.surfels import Surfels, same_within

Floats = NDArray[np.float64]

SLID = 0.03
"""Fraction of the extent that the last ICP moves no point from a verified pose, which is told apart from others by 2 %;
farther it has slid."""

SLIDING = 0.002
"""Along a motion that so small a part of the surface resists, ICP finds no place of its own: poses all along it are
judged as they are."""

ROUNDS, STEPS = 3, 6
"""So often is the slide taken back, each time after so many steps of ICP."""


class Held(NamedTuple):
    """Motions that are held: ``twists`` (6, K), mm and rad, about ``centre_mm`` (3,) in the target's frame, orthonormal
    where rotations count at ``extent_mm`` from it."""

    twists: Floats
    centre_mm: Floats
    extent_mm: float


def weak_motions_of(found: FineRegistration, extent_mm: float, below: float) -> Held:
    """The motions about the centre of a registration that less than this part of the surface resists."""
    scale = np.array([1, 1, 1, 1 / extent_mm, 1 / extent_mm, 1 / extent_mm])
    information = found.information * np.outer(scale, scale)
    values, directions = np.linalg.eigh(information)
    weak = values < below * np.trace(information[:3, :3])
    return Held(np.asarray(directions[:, weak][:, :3] * scale[:, None]), found.centre_mm, extent_mm)


def icp_across(
    points: Floats,
    normals: Floats,
    target: Surfels,
    T_start: Floats,
    held: Held,
    limits_mm: tuple[float, float],
    rounds: int = ROUNDS,
) -> FineRegistration:
    """Point-to-plane ICP of points (N, 3) with normals (N, 3) that moves them along no motion that is ``held``.

    Args:
        T_start: the pose (4, 4) along these motions.
        limits_mm: pairs farther apart are not used, and the floor of the residuals' spread.

    Raises:
        DegenerateError: the scans do not meet.
    """
    scale = np.array([1, 1, 1, held.extent_mm, held.extent_mm, held.extent_mm])
    along = held.twists * scale[:, None]
    to_centre, back = rigid(None, -held.centre_mm), rigid(None, held.centre_mm)
    pose = T_start
    for _ in range(rounds):
        found = icp_planes(points, normals, target, pose, *limits_mm, iterations=STEPS)
        motion = twist_between(T_start, found.T_target_source, held.centre_mm) * scale
        across = (motion - along @ (along.T @ motion)) / scale
        pose = back @ small_motion(across) @ to_centre @ T_start
    return replace(found, T_target_source=pose)


def hold_where_verified(
    source: Scan, target: Scan, found: FineRegistration, verified: Floats, samples: int = 6_000
) -> FineRegistration:
    """A registration that has slid far from the ``verified`` pose (4, 4), along motions that next to nothing resists,
    brought back along them; its hidden covariance holds how far it had slid. Another one as it is."""
    every = max(1, len(source.surfels) // samples)
    points, normals = source.surfels.points[::every], source.surfels.normals[::every]
    away = move_points(found.T_target_source, points) - move_points(verified, points)
    extent = rms_extent(points)
    if np.linalg.norm(away, axis=1).max() < SLID * extent:
        return found
    held = weak_motions_of(found, extent, SLIDING)
    if not held.twists.size:
        return found
    limits = 2 * target.surfels.grid.size_mm, same_within(source.surfels, target.surfels) / 3
    across = icp_across(points, normals, target.surfels, verified, held, limits)
    slide = twist_between(across.T_target_source, found.T_target_source, found.centre_mm)
    return replace(
        found, T_target_source=across.T_target_source, rms_mm=across.rms_mm, overlap=across.overlap,
        hidden_covariance=found.hidden_covariance + np.outer(slide, slide),
    )  # fmt: skip
