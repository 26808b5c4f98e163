"""A rectangular plate of known size in a cloud that shows other things too: its plane and edges give its whole pose.

The plate's frame stands in its middle: x along the longer side, y along the shorter, z out of the face that is seen.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import label
from scipy.spatial import ConvexHull, QhullError, cKDTree

from grindvision.errors import DegenerateError
from grindvision.geometry import check_points, fit_plane, rigid, rotation_about

Floats = NDArray[np.float64]

#: Places that are tried, and points of the cloud that take part in the search.
TRIALS, SEARCHED = 250, 30_000

#: How far points may stand off the plane: so many times their scatter over a small patch, within these limits (mm).
SCATTERS, THRESHOLDS_MM = 4.0, (0.25, 2.0)

#: Fewest points on the plate, and cells of the grid on its plane over the points' spacing.
FEWEST_POINTS, CELL_SPACINGS = 200, 2.5

#: The sides may differ from those stated by this share, and by so many spacings; so much of the rectangle is filled.
SIDE_TOLERANCE, SIDE_SPACINGS, MIN_FILLED = 0.04, 3.0, 0.8

#: A rectangle round points whose sides are off by less (share) is looked at closely.
LIKELY = 0.25

#: Strips across an edge, each of which says where the edge lies; ends of an edge (share) that say nothing.
STRIPS, ENDS = 40, 0.12


def find_plate(points_camera: ArrayLike, sides_mm: tuple[float, float], rng: np.random.Generator, name: str) -> Floats:
    """T_camera_plate (4, 4) of the rectangular plate of these sides in a cloud (N, 3), mm, of a camera at the origin.

    Raises:
        DegenerateError: no such plate in it, with the sides of the most similar one.
    """
    points = check_points(points_camera, name, min_points=FEWEST_POINTS)
    long, short = max(sides_mm), min(sides_mm)
    few = points if len(points) <= SEARCHED else points[rng.choice(len(points), SEARCHED, replace=False)]
    tree = cKDTree(few)
    spacing = float(np.median(tree.query(few[:: max(len(few) // 2000, 1)], k=2)[0][:, 1]))
    least, seen = np.inf, (np.nan, np.nan)
    for seed in rng.integers(len(few), size=TRIALS):
        found = _plate_at(few, tree, int(seed), (long, short), spacing)
        if found is None:
            continue
        frame, sides, threshold = found
        off = max(abs(sides[0] - long) / long, abs(sides[1] - short) / short)
        if off < LIKELY:
            filled = 0.0
            for _ in range(3):
                frame, sides, filled = _refined(points, frame, (long, short), threshold)
            allowed = [SIDE_TOLERANCE * side + SIDE_SPACINGS * spacing for side in (long, short)]
            fits = abs(sides[0] - long) <= allowed[0] and abs(sides[1] - short) <= allowed[1]
            if fits and filled >= MIN_FILLED:
                return frame
        if off < least and np.isfinite(sides[0]):
            least, seen = off, sides
    said = f"; the most similar flat thing measures {seen[0]:.0f} x {seen[1]:.0f} mm" if np.isfinite(seen[0]) else ""
    raise DegenerateError(
        f"{name}: no rectangular plate of {long:g} x {short:g} mm in it{said}; are those its sides in mm, does it"
        " lie in view with all four edges, free of what it touches?"
    )


def _plate_at(
    points: Floats, tree: cKDTree, seed: int, sides: tuple[float, float], spacing: float
) -> tuple[Floats, tuple[float, float], float] | None:
    """A rectangle round one point of the cloud: its frame (4, 4), sides, and the threshold of its plane."""
    patch = points[tree.query_ball_point(points[seed], max(0.15 * sides[1], 3 * spacing))]
    if len(patch) < 8:
        return None
    plane = fit_plane(patch)
    threshold = float(np.clip(SCATTERS * plane.distance(patch).std(), *THRESHOLDS_MM))
    near = points[tree.query_ball_point(points[seed], 1.1 * float(np.hypot(*sides)))]
    for _ in range(2):
        on = np.abs(plane.distance(near)) <= threshold
        if on.sum() < FEWEST_POINTS // 4:
            return None
        plane = fit_plane(near[on])
    frame = _facing(plane.normal, near[on].mean(axis=0))
    flat = (near[on] - frame[:3, 3]) @ frame[:3, :2]
    start = (points[seed] - frame[:3, 3]) @ frame[:3, :2]
    piece = _connected(flat, start, max(CELL_SPACINGS * spacing, 1e-3))
    if piece.sum() < FEWEST_POINTS // 4:
        return None
    turn, middle, found = _smallest_rectangle(flat[piece])
    if found[1] < 0.7 * sides[1] or found[0] > 1.3 * sides[0]:
        return None
    centre = frame[:3, 3] + frame[:3, :2] @ middle
    return rigid(frame[:3, :3] @ rotation_about([0, 0, 1], turn), centre), found, threshold


def _refined(
    points: Floats, frame: Floats, sides: tuple[float, float], threshold: float
) -> tuple[Floats, tuple[float, float], float]:
    """The frame (4, 4) by all points of the plate, the sides that its edges show, and how much of it is filled.

    A strip across an edge ends about half a spacing inside it: on both sides, so that the middle does not move.
    """
    local = (points - frame[:3, 3]) @ frame[:3, :3]
    half = np.array(sides) / 2
    on = (np.abs(local[:, :2]) <= 1.15 * half).all(axis=1) & (np.abs(local[:, 2]) <= threshold)
    if on.sum() < FEWEST_POINTS:
        return frame, (np.nan, np.nan), 0.0
    inner = on & (np.abs(local[:, :2]) <= 0.9 * half).all(axis=1)
    plane = fit_plane(points[inner] if inner.sum() >= FEWEST_POINTS else points[on])
    normal = plane.normal if plane.normal @ frame[:3, 2] > 0 else -plane.normal
    x = frame[:3, 0] - normal * (normal @ frame[:3, 0])
    x /= np.linalg.norm(x)
    rotation = np.column_stack([x, np.cross(normal, x), normal])
    centre = frame[:3, 3] - plane.normal * plane.distance(frame[:3, 3])
    local = (points - centre) @ rotation
    wide = (np.abs(local[:, :2]) <= 1.15 * half).all(axis=1)
    flat = local[wide & (np.abs(local[:, 2]) <= threshold), :2]
    edges = [_edge(flat, axis, sign, half) for axis in (0, 1) for sign in (1, -1)]
    (right, right_turn), (left, left_turn), (top, top_turn), (bottom, bottom_turn) = edges
    measured = (right + left, top + bottom)
    shift = np.array([(right - left) / 2, (top - bottom) / 2])
    weights = np.array([half[1], half[1], half[0], half[0]])
    turn = float(np.average([right_turn, left_turn, top_turn, bottom_turn], weights=weights))
    turned = rotation @ rotation_about([0, 0, 1], turn)
    cells = 20
    where = np.floor((flat / half * 0.5 + 0.5) * cells).astype(int)
    inside = ((where >= 0) & (where < cells)).all(axis=1)
    filled = len(np.unique(where[inside] @ [1, cells])) / cells**2
    return rigid(turned, centre + rotation[:, :2] @ shift), measured, filled


def _edge(flat: Floats, axis: int, sign: int, half: Floats) -> tuple[float, float]:
    """How far out an edge lies in its middle (mm), and by how much it is turned (rad), from strips across it."""
    along, out = flat[:, 1 - axis], sign * flat[:, axis]
    reach = (1 - ENDS) * half[1 - axis]
    strip = np.floor((along / reach * 0.5 + 0.5) * STRIPS).astype(int)
    shown = (strip >= 0) & (strip < STRIPS) & (out > 0)
    ends = np.full(STRIPS, -np.inf)
    np.maximum.at(ends, strip[shown], out[shown])
    used = np.isfinite(ends)
    places = ((np.arange(STRIPS) + 0.5) / STRIPS * 2 - 1) * reach
    for _ in range(4):
        if used.sum() < STRIPS // 3:
            return float("nan"), 0.0
        slope, middle = np.polyfit(places[used], ends[used], 1)
        left = ends - (slope * places + middle)
        scatter = 1.4826 * float(np.median(np.abs(left[used])))
        used = np.isfinite(ends) & (np.abs(left) <= max(3 * scatter, 1e-6))
    # seen from the middle, a turn by +a leans the edges across x by -a and those across y by +a, times their side
    return float(middle), float(np.arctan(slope)) * (-sign if axis == 0 else sign)


def _facing(normal: Floats, centre: Floats) -> Floats:
    """A frame (4, 4) on a plane whose z axis points to the camera."""
    z = -normal if normal @ centre > 0 else normal
    x = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
    x /= np.linalg.norm(x)
    return rigid(np.column_stack([x, np.cross(z, x), z]), centre)


def _connected(flat: Floats, start: Floats, cell: float) -> NDArray[np.bool_]:
    """Points (N,) of a plane (N, 2) that hang together with ``start`` over cells of a grid."""
    where = np.floor((flat - flat.min(axis=0)) / cell).astype(int)
    grid = np.zeros(where.max(axis=0) + 1, dtype=bool)
    grid[where[:, 0], where[:, 1]] = True
    pieces, _ = label(grid, structure=np.ones((3, 3)))
    numbers = pieces[where[:, 0], where[:, 1]]
    return np.asarray(numbers == numbers[np.argmin(((flat - start) ** 2).sum(axis=1))])


def _smallest_rectangle(flat: Floats) -> tuple[float, Floats, tuple[float, float]]:
    """Turn (rad) of the longer side, middle (2,) and sides of the smallest rectangle round points (N, 2)."""
    try:
        hull = flat[ConvexHull(flat).vertices]
    except QhullError:  # points on a line
        return 0.0, flat.mean(axis=0), (0.0, 0.0)
    edges = np.roll(hull, -1, axis=0) - hull
    best = (np.inf, 0.0, flat[0], (0.0, 0.0))
    for angle in np.unique(np.round(np.arctan2(edges[:, 1], edges[:, 0]) % (np.pi / 2), 6)):
        axes = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        turned = hull @ axes.T
        low, high = turned.min(axis=0), turned.max(axis=0)
        sides = high - low
        if sides.prod() < best[0]:
            middle = axes.T @ ((low + high) / 2)
            longer = float(angle) if sides[0] >= sides[1] else float(angle) + np.pi / 2
            best = (float(sides.prod()), longer, middle, (float(sides.max()), float(sides.min())))
    return best[1], best[2], best[3]
