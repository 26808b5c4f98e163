"""Seams between surfaces: corners, steps and gaps beside the grooves that are known already.

Pairs of surfaces show creases and steps; rough lines are traced through them, fitted along their whole length and then
named. Where these show nothing, narrow gaps are looked for.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from grindvision.geometry import inverse, rotate_vectors
from grindvision.geometry.bounds import diagonal_mm
from grindvision.vision.seam.face_fit import Scale
from grindvision.vision.seam.face_shapes import bar_width_mm, face_shapes
from grindvision.vision.seam.gap_lines import find_gaps
from grindvision.vision.seam.joint_fit import JointFit, fit_joint
from grindvision.vision.seam.joint_names import BUTT, LAP, OUTSIDE
from grindvision.vision.seam.joints import Seam
from grindvision.vision.seam.pair_kernels import CONCAVE, CONVEX, STEP
from grindvision.vision.seam.seam_course import beyond_ends_mm, left_out_mm
from grindvision.vision.seam.seam_curve import around
from grindvision.vision.seam.seam_kinds import corner_seam, cut_short, may_be_rib, named_edges, plausible
from grindvision.vision.seam.seam_sight import with_sight
from grindvision.vision.seam.seam_tracing import trace_curves
from grindvision.vision.seam.step_fit import fit_step
from grindvision.vision.seam.surface_pairs import SurfacePairs, find_pairs
from grindvision.vision.surface.normals import orient_by_neighbours, seen_along
from grindvision.vision.surface.surfels import Surfels, build_surfels

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

#: What it counts that a scanner stands on the origin's side (the arm's), against its standing above.
ORIGIN_SIDE = 0.6
#: Edge of the surfels: so many spacings, so many times the noise, and at least this fraction of the cloud's diagonal.
CELL_SPACINGS, CELL_NOISE, CELL_FRACTION = 4.0, 6.0, 1 / 150
#: Where the finest cells show no seam, coarser ones are tried.
COARSER = (1.0, 1.7)
#: Corners of this fraction of the diagonal, all together, are enough.
ENOUGH = 0.1
#: A rough line is at least so many cells long; interruptions up to this length are bridged.
TRACED_CELLS, JOIN_CELLS = 3.5, 10.0
#: So many of the longest rough lines are fitted.
MAX_FITTED = 12
#: The highest step that is taken for a plate's edge, mm.
MAX_STEP_MM = 25.0
#: A seam that runs along a known one for this fraction is that one again.
KNOWN_FRACTION = 0.5


def surface_seams(
    cloud: Floats,
    T_field_cloud: Floats,
    towards: Floats | None,
    spacing: float,
    known: list[Seam],
    wanted: tuple[str, ...],
) -> list[Seam]:
    """Corners, steps and gaps beside the known grooves."""
    diagonal = diagonal_mm(cloud)
    noise = float(np.median(build_surfels(cloud, CELL_SPACINGS * spacing).noise_mm)) if not known else 0.0
    base = max(CELL_SPACINGS * spacing, CELL_NOISE * noise, CELL_FRACTION * diagonal)
    found: list[Seam] = []
    for factor in COARSER:
        cell = factor * base
        if cell > diagonal / 12:
            break
        surfels = build_surfels(cloud, cell)
        normals = _turned(surfels, towards)
        scale = Scale(spacing, cell, float(np.median(surfels.noise_mm)))
        usable = ~_inside(surfels.points, known, 2 * cell)
        pairs = find_pairs(surfels, normals, usable)
        scene = surfels, normals, towards
        kinds = (CONCAVE, CONVEX) if OUTSIDE in wanted else (CONCAVE,)
        for kind in kinds:
            found += _corners(cloud, scene, pairs.of(kind), scale, [*known, *found], (kind == CONCAVE, factor > 1))
        steps = _steps(cloud, scene[:2], pairs.of(STEP), scale, [*known, *found])
        found += [with_sight(one, cloud, towards) for one in steps]
        if known or sum(seam.length_mm for seam in _sure(found)) > ENOUGH * diagonal:
            break
    if BUTT in wanted and not known and not _sure(found):
        found = [*_gaps(cloud, T_field_cloud, Scale(spacing, base, noise)), *found]
    return found


def _sure(found: list[Seam]) -> list[Seam]:
    """Corners of the scene that leave nothing to look for."""
    return [seam for seam in found if seam.kind not in (LAP, OUTSIDE) and not seam.glancing]


def runs_along(path: Floats, seams: list[Seam], reach: float | None = None) -> bool:
    """Whether most of a path (M, 3) runs along one of the seams."""
    for seam in seams:
        near = reach
        if seam.groove is not None:
            near = max(0.75 * float(np.median(seam.groove.width_mm)), reach or 0.0)
        if (cKDTree(seam.root).query(path)[0] < (near or 3.0)).mean() > KNOWN_FRACTION:
            return True
    return False


def _corners(
    cloud: Floats,
    scene: tuple[Surfels, Floats, Floats | None],
    pairs: SurfacePairs,
    scale: Scale,
    known: list[Seam],
    way: tuple[bool, bool],
) -> list[Seam]:
    """Corners along rough lines through pairs, fitted and named; ``way``: are they concave, are the cells coarse."""
    found: list[Seam] = []
    fits: list[JointFit] = []
    concave, coarse = way
    curves = trace_curves(pairs.places, pairs.along, scale.cell, JOIN_CELLS * scale.cell, TRACED_CELLS * scale.cell)
    tree = cKDTree(pairs.places) if curves else None
    for curve in curves[:MAX_FITTED]:
        if tree is None or runs_along(curve, [*known, *found], 1.5 * scale.cell):
            continue
        at = tree.query(curve)[1]
        sides = _consistent(pairs.first[at], pairs.second[at])
        fit = fit_joint(cloud, curve, sides, concave, scale, scene[2])
        if fit is None:
            continue
        if concave and fit.sharpness < 1 and all(shape.bulges for shape in face_shapes(fit, *scene[:2])):
            # Tubes bend away from their corner; one surface that is bent into a corner does not.
            fit = replace(fit, sharpness=1.0)
        if not plausible(fit, scale, concave, coarse):
            continue
        seam = corner_seam(fit, *scene[:2], concave, scene[2])
        if seam.kind == LAP:
            seam = with_sight(_as_step(cloud, fit, scale) or seam, cloud, scene[2])
        if not runs_along(seam.root, [*known, *found], 1.5 * scale.cell):
            found.append(seam)
            fits.append(fit)
    result = []
    for seam, fit in zip(found, fits, strict=True):
        others = [other.root for other in (*known, *found) if other is not seam]
        beyond = beyond_ends_mm(cloud, fit, (concave, scene[2]), scale, others)
        aside = left_out_mm(fit, face_shapes(fit, *scene[:2]), scene[:2], others) if concave else 0.0
        result.append(replace(seam, doubts=seam.doubts + cut_short(max(beyond, aside), fit)))
    return result


def _as_step(cloud: Floats, fit: JointFit, scale: Scale) -> Seam | None:
    """A lap's corner fitted as a step, which holds where its short wall is hardly seen; None where it shows less."""
    legs = np.median(fit.legs_mm[:, fit.shown], axis=1)
    base = int(np.argmax(legs))
    step = fit_step(cloud, fit.root, fit.faces.outward[base], fit.faces.normal[base], float(legs.min()), scale)
    seam = None if step is None else named_edges(step, scale, gap=False)
    return seam if seam is not None and seam.length_mm > 0.9 * fit.length_mm else None


def _consistent(first: Floats, second: Floats) -> tuple[Floats, Floats]:
    """The two normals (M, 3) along a curve, swapped where that keeps each face on its side."""
    first, second = first.copy(), second.copy()
    for k in range(1, len(first)):
        keep = first[k] @ first[k - 1] + second[k] @ second[k - 1]
        swap = first[k] @ second[k - 1] + second[k] @ first[k - 1]
        if swap > keep:
            first[k], second[k] = second[k].copy(), first[k].copy()
    return first, second


def _steps(
    cloud: Floats, scene: tuple[Surfels, Floats], pairs: SurfacePairs, scale: Scale, known: list[Seam]
) -> list[Seam]:
    """Steps from one surface down to another that lies side by side with it."""
    low = pairs.step_mm < MAX_STEP_MM
    places, along = pairs.places[low], pairs.along[low]
    found: list[Seam] = []
    curves = trace_curves(places, along, scale.cell, JOIN_CELLS * scale.cell, TRACED_CELLS * scale.cell)
    for curve in curves:
        at = cKDTree(places).query(curve)[1]
        if runs_along(curve, [*known, *found], 2 * scale.cell):
            continue
        height = float(np.median(pairs.step_mm[low][at]))
        fit = fit_step(cloud, curve, pairs.first[low][at], pairs.second[low][at], height, scale)
        seam = None if fit is None else named_edges(fit, scale, gap=False)
        if fit is not None and seam is not None and not runs_along(seam.root, [*known, *found], 2 * scale.cell):
            width = bar_width_mm(fit, *scene)
            found.append(seam if width is None else replace(seam, doubts=(*seam.doubts, may_be_rib(width))))
    return found


def _gaps(cloud: Floats, T_field_cloud: Floats, scale: Scale) -> list[Seam]:
    """Butt gaps: narrow strips without surface between two surfaces of one level."""
    found: list[Seam] = []
    up = rotate_vectors(inverse(T_field_cloud), [0.0, 0.0, 1.0])
    for gap in find_gaps(cloud, T_field_cloud, scale.spacing, scale.noise, 8 * scale.cell):
        along = np.gradient(gap.path, axis=0)
        way = np.cross(np.broadcast_to(up, along.shape), along)
        fit = fit_step(cloud, gap.path, way, np.broadcast_to(up, along.shape), None, scale)
        seam = None if fit is None else named_edges(fit, scale, gap=True)
        if seam is not None and not runs_along(seam.root, found, 2 * scale.cell):
            found.append(seam)
    return found


def _turned(surfels: Surfels, towards: Floats | None) -> Floats:
    """Normals (M, 3) of the surfels, facing the scanner."""
    normals = surfels.normals
    if towards is not None:
        sign = np.sign(((towards - surfels.points) * normals).sum(axis=1))
        return normals * np.where(sign == 0, 1.0, sign)[:, None]
    sample = slice(None, None, max(len(surfels) // 2000, 1))
    direction = seen_along(surfels.points[sample], normals[sample], 2.0 * surfels.grid.size_mm)
    if direction is None:
        # Scans merged from several views: no direction sees all of it.
        return orient_by_neighbours(surfels.points, normals, 2.0 * surfels.grid.size_mm)
    # The bulge of a corner tells the wrong side: without a viewpoint, scanners look down and away from the origin.
    middle = surfels.points.mean(axis=0)[:2]
    outward = middle / max(float(np.linalg.norm(middle)), diagonal_mm(surfels.points))
    up = direction[2] - ORIGIN_SIDE * float(direction[:2] @ outward)
    direction = direction if up >= 0 else -direction
    return np.asarray(normals * np.where(normals @ direction < 0, -1.0, 1.0)[:, None])


def _inside(places: Floats, grooves: list[Seam], margin: float) -> Flags:
    """Which places (M, 3) lie in or near the known grooves."""
    inside = np.zeros(len(places), dtype=bool)
    for seam in grooves:
        if seam.groove is not None:
            middle = (seam.groove.left + seam.groove.right) / 2
            width = float(np.median(seam.groove.width_mm))
            reach = 0.75 * width + margin
            near = around(places, middle, reach)
            inside[near[cKDTree(middle).query(places[near])[0] < reach]] = True
    return inside
