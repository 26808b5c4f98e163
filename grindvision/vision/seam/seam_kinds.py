"""From fits to named seams: what each kind must show, and the evidence in words."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grindvision.geometry import unit_vectors, vector_angle
from grindvision.vision.seam.face_fit import Scale
from grindvision.vision.seam.face_shapes import CYLINDER, PLANE, FaceShape, face_shapes, surroundings, undecided
from grindvision.vision.seam.gap_lines import MAX_SPACINGS
from grindvision.vision.seam.groove_lines import DetectedGroove
from grindvision.vision.seam.joint_fit import JointFit
from grindvision.vision.seam.joint_names import (
    BEVEL,
    BUTT,
    INSIDE,
    LAP,
    OUTSIDE,
    SADDLE,
    T_JOINT,
    TUBE_ON_PLATE,
    U_GROOVE,
    V_GROOVE,
)
from grindvision.vision.seam.joints import Interruption, Seam
from grindvision.vision.seam.seam_sight import narrow_face
from grindvision.vision.seam.step_fit import MIN_WALL_POINTS, EdgeFit
from grindvision.vision.surface.surfels import Surfels

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

#: A corner turns by at least this angle, and by so many standard deviations of it; an outside corner by more.
MIN_DIHEDRAL_RAD, MIN_DIHEDRAL_SIGMAS, MIN_OUTSIDE_RAD = np.radians(15.0), 12.0, np.radians(40.0)
#: Stations so many cells apart are fitted to other points.
WINDOW_CELLS = 2.4
#: Where less than this fraction of the turn is there close to the root, a bend is ruled out by such a turn only.
MIN_SHARPNESS, MIN_ROUNDED_RAD = 0.85, np.radians(38.0)
#: With coarse cells, in which a bend looks sharper than it is, a corner turns by at least this.
MIN_COARSE_RAD = np.radians(28.0)
#: One surface bends where next to nothing of the turn is there close to the root, and a face bends the same way by so
#: much, rad, over a cell, or only coarse cells show a turn. A bead hides the corner too, but the faces beside it are
#: flat, which finer cells show, and those of tubes bend away. Where only coarse cells show a turn that is rounded and
#: both faces bend into it, they are one sheet.
MIN_COARSE_SHARPNESS = 0.2
MIN_ANY_SHARPNESS, ONE_BEND_RAD = 0.35, 0.06
#: The root is known within this fraction of a cell, a quarter in each direction across the seam, and the faces scatter
#: by at most this one more than the scan.
MAX_SIGMA_CELLS, MAX_SCATTER_CELLS = 0.35, 0.08
#: Faces that are fitted to less of themselves meet within this fraction of a cell of where they met; those of one sheet
#: that bends into the corner, through this angle at most, do not.
MAX_MISSED_CELLS, MOST_BENT_RAD = 0.2, np.radians(100.0)
#: Faces are seen for so many cells at least; an outside corner, which every edge of a body is, for so many.
MIN_LEG_CELLS, MIN_OUTSIDE_CELLS, MIN_OUTSIDE_MM = 1.8, 7.0, 15.0
#: A wall up to this height, and this near to upright, may be the edge of a plate that lies on another.
MAX_PLATE_MM, MAX_LEAN_RAD = 25.0, np.radians(35.0)
#: A step stands out by so many deviations; two levels closer than this fraction of the gap are the two sides of a butt.
MIN_STEP_DEVIATIONS = 8.0
#: Sides of a butt joint are at most so far apart in height, and so much turned against each other. Where the surfaces
#: of a gap or a step end they turn down by less than this together: two tubes that lie side by side turn by a right
#: angle and more, and a tube on a table ends where the camera sees no more of it.
MAX_HI_LO_MM, MAX_BUTT_DIHEDRAL_RAD, MAX_FALL_RAD = 4.0, np.radians(10.0), np.radians(25.0)
#: The place of an edge at which a surface ends is known within this fraction of a spacing; one that is not is no edge.
MAX_EDGE_SIGMA_SPACINGS = 0.5
#: Cameras put the edge of a nearer body some pixels off, alike all along it: standard deviations in spacings where the
#: wall below the edge is seen and where it is not.
EDGE_BIAS_SPACINGS = 0.2, 0.7
#: A gap of so many spacings, as wide as a groove must be, shows less than this fraction of its points on walls. Those
#: of a V hold 60 %.
GROOVE_SPACINGS, MAX_ON_WALLS = 4.0, 0.3
#: A gap shows something below it at this fraction of its stations, or is wider than so many spacings.
MIN_GAP_SEEN, WIDE_GAP_SPACINGS = 0.3, 2.2
#: A corner whose faces go on meeting for this fraction of its whole length is said to be followed in part.
MIN_MISSED = 0.15
#: A concave corner that shows less than this fraction of its turn close to the root is rounded; a sharp one that a
#: camera blurs shows 0.84. A face seen at more than 75 deg of incidence may be pixels mixed from two bodies.
MIN_SHARP, MIN_SURE_FACING = 0.75, 0.26
#: A groove is U-shaped where its root is this much of its width, bevelled where the root lies so near to one edge.
U_FLOOR, BEVEL_SKEW = 0.3, 0.25


def plausible(fit: JointFit, scale: Scale, concave: bool, coarse: bool) -> bool:
    """Whether a fitted corner is one: turned enough for its noise, long enough, with faces on both sides.

    A corner that is not sharp, or found with ``coarse`` cells, may be a bend of the surface: it has to turn by more.
    """
    shown = fit.shown
    strongest = np.percentile(fit.dihedral_rad[shown], 80)
    least = MIN_DIHEDRAL_RAD if concave else MIN_OUTSIDE_RAD
    if fit.sharpness < MIN_SHARPNESS:
        least = max(least, MIN_ROUNDED_RAD)
    elif coarse:
        least = max(least, MIN_COARSE_RAD)
    if strongest < least or turn_deviations(fit, scale.cell) < MIN_DIHEDRAL_SIGMAS:
        return False
    bend = float(fit.bend_per_mm.max() if concave else -fit.bend_per_mm.min()) * scale.cell
    if fit.sharpness < (MIN_ANY_SHARPNESS if bend > ONE_BEND_RAD else MIN_COARSE_SHARPNESS if coarse else 0.0):
        return False
    one_sheet = concave and coarse and fit.bend_per_mm.min() * scale.cell > ONE_BEND_RAD
    if one_sheet and fit.sharpness < MIN_SHARP:
        return False
    if fit.length_mm < 5 * scale.cell or np.median(fit.sigma_mm[shown]) > MAX_SIGMA_CELLS * scale.cell:
        return False
    moved = max(float(np.median(fit.missed_mm[shown])), float(np.median(fit.swayed_mm[shown])))
    if moved > MAX_MISSED_CELLS * scale.cell and bend > 0 and strongest < MOST_BENT_RAD:
        return False
    if fit.noise_mm.max() > 2.5 * scale.noise + MAX_SCATTER_CELLS * scale.cell:
        return False
    legs = np.median(fit.legs_mm[:, shown], axis=1)
    min_leg = MIN_LEG_CELLS * scale.cell
    if not concave:
        min_leg = max(MIN_OUTSIDE_CELLS * scale.cell, MIN_OUTSIDE_MM)
    return bool(legs.min() > min_leg)


def turn_deviations(fit: JointFit, cell_mm: float) -> float:
    """By how many standard deviations the faces turn: stations farther apart than their windows are independent."""
    windows = max(fit.length_mm / (WINDOW_CELLS * cell_mm), 1.0)
    sigma = max(float(np.median(fit.dihedral_sigma_rad[fit.shown])), 1e-9)
    return float(np.median(fit.dihedral_rad[fit.shown]) * np.sqrt(windows) / sigma)


def corner_seam(fit: JointFit, surfels: Surfels, normals: Floats, concave: bool, towards: Floats | None) -> Seam:
    """The corner as a named seam; the scanner stands at ``towards`` (3,), if that is known."""
    shapes = face_shapes(fit, surfels, normals)
    turn = np.degrees(fit.dihedral_rad)
    opening = 180 - turn if concave else 180 + turn
    sigma = float(np.degrees(np.median(fit.dihedral_sigma_rad[fit.shown])))
    angle = f"{np.median(opening):.1f} +- {max(sigma, 0.05):.1g} deg"
    step = np.zeros(len(fit.root))
    if not concave:
        kind, evidence = OUTSIDE, f"{_two(shapes)} part in a convex edge, {angle} of air; both reach farther than a rim"
    else:
        kind, evidence = _concave_kind(fit, shapes, (surfels, normals, towards), angle)
        if kind == LAP:
            step = fit.legs_mm.min(axis=0)
    band = narrow_face(
        fit.faces.normal[:, fit.shown], fit.legs_mm[:, fit.shown], fit.root[fit.shown], surfels.grid.size_mm, towards
    )
    return Seam(
        kind,
        evidence,
        fit.root,
        np.hypot(fit.sigma_mm, fit.unseen_mm),
        fit.normals,
        fit.faces.normal,
        opening,
        sigma,
        fit.legs_mm,
        np.stack([fit.root, fit.root]),
        np.zeros(len(fit.root)),
        0.0,
        step,
        float(fit.noise_mm.max()) if kind == LAP else 0.0,
        fit.members,
        _interruptions(fit.shown, fit.curve.step_mm),
        fit.closed,
        deviations=turn_deviations(fit, surfels.grid.size_mm),
        doubts=undecided(kind, shapes) + _unlike(fit, concave) + ((band,) if band else ()),
        glancing=_facing(fit) < MIN_SURE_FACING or bool(band),
    )


def _unlike(fit: JointFit, concave: bool) -> tuple[str, ...]:
    """What speaks against a corner of two bodies: that it is rounded, that a face is seen at a glancing angle."""
    doubts = []
    if concave and fit.sharpness < MIN_SHARP:
        doubts.append(
            f"is rounded: close to its root the faces turn by {fit.sharpness:.0%} of their angle only, as at a bend of"
            " one sheet, a fillet or a bead that is there already; the root is where they would meet if they went on"
        )
    if _facing(fit) < MIN_SURE_FACING:
        glance = np.degrees(np.arccos(max(_facing(fit), 0.0)))
        doubts.append(
            f"has a face that is seen at {glance:.0f} deg from straight on: pixels mixed at the edge of a nearer body"
            " look like that; scan from where both faces are seen"
        )
    return tuple(doubts)


def _facing(fit: JointFit) -> float:
    return float(np.median(fit.facing[fit.shown]))


def cut_short(missed_mm: float, fit: JointFit) -> tuple[str, ...]:
    """What to say of a corner that goes on for ``missed_mm`` beyond its root line."""
    if missed_mm < MIN_MISSED * (missed_mm + fit.length_mm):
        return ()
    share = fit.length_mm / (missed_mm + fit.length_mm)
    return (
        f"is followed over {fit.length_mm:.0f} mm only, about {share:.0%} of where its two surfaces meet in the scan:"
        " see in the picture where it goes on, and scan the rest more densely or from where both faces are seen",
    )


def may_be_rib(width_mm: float) -> str:
    """What to say of a step down from something narrow to a surface that goes on behind it."""
    return (
        f"is undecided between {LAP} and {T_JOINT}: what ends above it is {width_mm:.0f} mm wide only, and the lower"
        " surface goes on behind it, as behind a rib; the line to weld is the same"
    )


def _concave_kind(
    fit: JointFit, shapes: tuple[FaceShape, FaceShape], scene: tuple[Surfels, Floats, Floats | None], angle: str
) -> tuple[str, str]:
    words = f"{_two(shapes)} meet in a concave corner of {angle}"
    names = sorted(shape.name for shape in shapes)
    straight = _straight(fit)
    if names == [CYLINDER, CYLINDER]:
        return SADDLE, words
    if names == [CYLINDER, PLANE] and not straight:
        return TUBE_ON_PLATE, words
    if PLANE not in names and all(shape.bulges for shape in shapes):
        return SADDLE, f"{words}; both bend away from it, as tubes do"
    if fit.closed and CYLINDER in names:
        return TUBE_ON_PLATE, f"{words}, all round"
    around = surroundings(fit, *scene)
    legs = np.median(fit.legs_mm[:, fit.shown], axis=1)
    upright = abs(float(np.median(fit.dihedral_rad[fit.shown])) - np.pi / 2) < MAX_LEAN_RAD
    for side in range(2):
        if upright and around.parallel_above[side] and legs[1 - side] < MAX_PLATE_MM:
            return LAP, f"{words}; the wall of {legs[1 - side]:.1f} mm ends in a surface parallel to the other face"
    if any(around.goes_on):
        return T_JOINT, f"{words}; one of them goes on behind the other"
    if any(around.ends_there):
        return INSIDE, f"{words}; behind it nothing of either is seen"
    return T_JOINT, f"{words}; what is behind it is hidden, so that an inside corner is not ruled out"


def named_edges(fit: EdgeFit, scale: Scale, gap: bool) -> Seam | None:
    """The step or gap as a named seam; None where it does not stand out."""
    shown = fit.shown
    step, width = float(np.median(fit.step_mm[shown])), float(np.median(fit.gap_mm[shown]))
    turn = float(np.median(vector_angle(fit.normals[0], fit.normals[1])[shown]))
    if fit.length_mm < 5 * scale.cell or turn > MAX_BUTT_DIHEDRAL_RAD or fit.fall_rad > MAX_FALL_RAD:
        return None
    if fit.edge_sigma_mm > MAX_EDGE_SIGMA_SPACINGS * scale.spacing:
        return None
    if fit.noise_mm > 2.5 * scale.noise + 0.08 * scale.cell:
        return None
    level = fit.noise_mm / np.sqrt(max(len(fit.members) / max(len(fit.root), 1), 1.0))
    sigma = fit.sigma_mm
    if gap:
        seen = float((fit.between > 0)[shown].mean())
        wide = width > WIDE_GAP_SPACINGS * scale.spacing
        if (
            abs(step) > MAX_HI_LO_MM
            or not (seen > MIN_GAP_SEEN or wide)
            or (width > GROOVE_SPACINGS * scale.spacing and fit.on_walls > MAX_ON_WALLS)
            or not scale.spacing < width < MAX_SPACINGS * scale.spacing
        ):
            return None
        kind = BUTT
        evidence = (
            f"two surfaces of one level end along parallel lines, {width:.2f} +- {fit.gap_sigma_mm:.2g} mm apart; "
            + (f"something lies below at {seen:.0%} of it" if seen > MIN_GAP_SEEN else "nothing is seen between")
        )
        normals = unit_vectors(fit.normals.sum(axis=0))
    else:
        if step < MIN_STEP_DEVIATIONS * level or step < max(1.2 * scale.spacing, 4 * fit.noise_mm):
            return None
        kind = LAP
        wall_seen = fit.between[shown].mean() > MIN_WALL_POINTS
        sigma = np.hypot(sigma, EDGE_BIAS_SPACINGS[0 if wall_seen else 1] * scale.spacing)
        evidence = f"one surface ends {step:.2f} +- {level:.2g} mm above another that is parallel to it"
        normals = unit_vectors(fit.normals[1] + fit.way)
    return Seam(
        kind,
        evidence,
        fit.root,
        sigma,
        normals,
        fit.normals,
        np.full(len(fit.root), 180.0 if gap else 90.0),
        0.0,
        np.stack([np.abs(fit.step_mm), np.full(len(fit.root), scale.far)]),
        fit.edges,
        fit.gap_mm if gap else np.zeros(len(fit.root)),
        fit.gap_sigma_mm if gap else 0.0,
        np.abs(fit.step_mm),
        float(level),
        fit.members,
        _interruptions(shown, fit.curve.step_mm),
    )


def groove_seam(groove: DetectedGroove) -> Seam:
    """A groove as a seam: its edges are the toes, its walls the faces."""
    along = np.gradient(groove.root, axis=0)
    along = unit_vectors(along - (along * groove.normals).sum(axis=1)[:, None] * groove.normals)
    walls, halves = [], []
    for edge in (groove.left, groove.right):
        way = edge - groove.root
        way = way - (way * along).sum(axis=1)[:, None] * along
        out = unit_vectors(np.cross(way, along))
        walls.append(out * np.where((out * groove.normals).sum(axis=1) < 0, -1.0, 1.0)[:, None])
        halves.append(np.degrees(vector_angle(way, groove.normals)))
    opening = halves[0] + halves[1]
    skew, floor = skew_of(groove), groove.floor_fraction
    if skew < BEVEL_SKEW:
        kind, why = BEVEL, f"one wall is upright: the root lies {skew:.0%} of the width from its edge"
    elif floor > U_FLOOR:
        kind, why = U_GROOVE, f"its floor or rounding takes {floor:.0%} of the width"
    else:
        kind, why = V_GROOVE, f"two walls {np.median(opening):.0f} deg apart"
    evidence = f"a valley between two parts of one surface; {why}"
    legs = np.stack([np.linalg.norm(edge - groove.root, axis=1) for edge in (groove.left, groove.right)])
    zero = np.zeros(len(groove.root))
    return Seam(
        kind, evidence, groove.root, groove.root_deviation_mm, groove.normals, np.stack(walls), opening,
        float(np.degrees(np.median(groove.root_deviation_mm / np.maximum(legs.min(axis=0), 1e-9)))), legs,
        np.stack([groove.left, groove.right]), zero, 0.0, zero, 0.0, groove.members, (), groove.closed, groove,
    )  # fmt: skip


def skew_of(groove: DetectedGroove) -> float:
    """How far the root lies from the nearer edge across the seam, as a fraction of the width; 0.5 in the middle."""
    along = np.gradient(groove.root, axis=0)
    across = unit_vectors(np.cross(groove.normals, along))
    span = np.abs(((groove.right - groove.left) * across).sum(axis=1))
    place = float(np.median(np.abs(((groove.root - groove.left) * across).sum(axis=1)) / np.maximum(span, 1e-9)))
    return min(place, 1 - place)


def _straight(fit: JointFit) -> bool:
    """Whether the root line bends by less than a hundredth of its length."""
    chord = fit.root[-1] - fit.root[0]
    length = float(np.linalg.norm(chord))
    if fit.closed or length < 1e-6:
        return False
    away = fit.root - fit.root[0]
    off = np.linalg.norm(away - np.outer(away @ chord / length**2, chord), axis=1)
    return bool(np.percentile(off, 90) < 0.02 * length)


def _two(shapes: tuple[FaceShape, FaceShape]) -> str:
    first, second = (str(shape) for shape in shapes)
    return f"two {first}s" if first == second and first == PLANE else f"{first} and {second}"


def _interruptions(shown: Flags, step: float) -> tuple[Interruption, ...]:
    """Stretches (at least two stations) in which a seam is not seen."""
    hidden = np.flatnonzero(~shown)
    if len(hidden) == 0:
        return ()
    runs = np.split(hidden, np.flatnonzero(np.diff(hidden) > 1) + 1)
    return tuple(Interruption(float(run[0] * step), float((run[-1] + 1) * step)) for run in runs if len(run) > 1)
