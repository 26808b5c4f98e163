"""Finding weld grooves in a cloud: valleys of the height field, then their edges and root fitted along the seam.

What all V-grooves share is used and nothing else: two walls that fall towards each other along a line, below a surface
that is flat or gently bent. An outline, a rounded outer edge or a bead is no valley and is never looked at.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from grindvision.clouds import LARGEST_MM, SMALLEST_MM, filler_point
from grindvision.errors import InputError, NoGrooveError, UnitError
from grindvision.geometry import inverse, move_points
from grindvision.geometry.bounds import diagonal_mm
from grindvision.loose_settings import settings_in
from grindvision.parallel import one_blas_thread
from grindvision.records import by_content
from grindvision.vision.seam.groove_diagnostics import MIN_WALL_FRACTION, wall_fraction
from grindvision.vision.seam.groove_fit import MIN_POINTS_ACROSS, fit_groove
from grindvision.vision.seam.groove_lines import DetectedGroove
from grindvision.vision.seam.height_field import spacing_of
from grindvision.vision.seam.valley import find_valleys
from grindvision.vision.seam.viewing_frames import field_frames
from grindvision.words import counted

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

#: A groove holds at least this fraction of the volume of the first one.
MIN_VOLUME_FRACTION = 0.05
#: Where the largest valley is no groove or may be a gap, so many of the valleys under each smaller disc are fitted,
#: largest first.
MAX_LOOKED_AT = 4
#: A path that runs along a known groove for this fraction is that groove again.
KNOWN_FRACTION = 0.5


@by_content
@dataclass(frozen=True)
class FindGroovesOptions:
    """Settings of ``find_grooves``, in mm and in the cloud's frame.

    ``viewpoint_mm``: the camera (3,). Left out, the origin is taken where a camera could stand there; otherwise both
    sides of the surface are tried and the one with the larger groove counts. ``width_mm``: rough width of the grooves;
    ``spacing_mm``: typical distance of neighbouring points; both estimated when left out. ``bevel``: whether one wall
    may be upright, with the root below its edge.
    """

    viewpoint_mm: ArrayLike | None = None
    width_mm: float | None = None
    spacing_mm: float | None = None
    bevel: bool = False


@by_content
@dataclass(frozen=True)
class GrooveDetection:
    """All grooves of a cloud, largest volume first, but what may be a gap between two things last.

    ``labels`` in the cloud's shape marks the points of any groove. ``groove_id`` has the same shape: rank of the
    point's groove, -1 outside. ``spacing_mm`` is the cloud's point distance, ``T_field_cloud`` (4, 4) the frame whose z
    axis is the viewing direction that was used. ``left_out`` are grooves too small against the first one to count.
    ``cluttered`` says that there are larger valleys than the grooves, and that they are none: gaps between the things
    in the scene.
    """

    grooves: tuple[DetectedGroove, ...]
    groove_id: Integers
    spacing_mm: float
    T_field_cloud: Floats
    left_out: tuple[DetectedGroove, ...] = ()
    cluttered: bool = False

    @property
    def labels(self) -> Flags:
        """True on the points of any groove."""
        return self.groove_id >= 0

    def __str__(self) -> str:
        return f"{counted(len(self.grooves), 'groove')}: " + "; ".join(str(groove) for groove in self.grooves)


@settings_in(FindGroovesOptions, 1, ("viewpoint_mm", "width_mm", "spacing_mm", "bevel"))
@one_blas_thread()
def find_grooves(points: ArrayLike, options: FindGroovesOptions | None = None) -> GrooveDetection:
    """Find the V-grooves of a single-view cloud.

    Args:
        points: (N, 3) or organised (R, C, 3), mm; rows with NaN (pixels without depth) belong to no groove.
        options: viewpoint, width, spacing; see ``FindGroovesOptions``.

    Returns:
        The grooves, largest first, each with root and edges (K, 3) in mm in the frame of the points; ``labels`` and
        ``groove_id`` in the shape of the cloud.

    Raises:
        InputError: wrong shape, too few points, a width that the spacing cannot resolve. UnitError: the size of the
            cloud fits no part in mm. NoGrooveError: the cloud shows no groove.

    Example:
        >>> import numpy as np
        >>> from grindvision import FindGroovesOptions, find_grooves
        >>> x, y = np.meshgrid(np.arange(-60.0, 60.0), np.arange(-30.0, 30.0, 0.5))
        >>> plate = np.stack([x, y, 400 + np.maximum(0, 6 - 1.2 * abs(y))], axis=-1).reshape(-1, 3)
        >>> found = find_grooves(plate, FindGroovesOptions(viewpoint_mm=(0, 0, 0)))
        >>> groove = found.grooves[0]
        >>> bool(abs(np.median(groove.depth_mm) - 6) < 0.1), bool(abs(groove.root[:, 1]).max() < 0.1)
        (True, True)
    """
    options = FindGroovesOptions() if options is None else options
    view = seen_cloud(points, options.viewpoint_mm, options.spacing_mm)
    return grooves_of(view, options.width_mm, options.bevel)


@by_content
@dataclass(frozen=True)
class SeenCloud:
    """Finite points (N, 3) of a cloud, ``valid`` which rows of the flat cloud they are, its ``shape`` without the last
    axis, ``sides`` the frames from which its surfaces are seen straight on (``field_frames``), and its spacing."""

    points: Floats
    valid: Flags
    shape: tuple[int, ...]
    sides: list[list[Floats]]
    spacing_mm: float


def seen_cloud(points: ArrayLike, viewpoint_mm: ArrayLike | None, spacing_mm: float | None = None) -> SeenCloud:
    """A cloud made ready for the detectors.

    Raises:
        InputError: wrong shape or too few points. UnitError: no part in mm is of this size.
    """
    cloud, valid = finite_points(points)
    sides = field_frames(cloud, viewpoint_mm)
    spacing = spacing_of(cloud, sides[0][0]) if spacing_mm is None else float(spacing_mm)
    return SeenCloud(cloud, valid, np.shape(points)[:-1], sides, spacing)


def grooves_of(view: SeenCloud, width_mm: float | None = None, bevel: bool = False) -> GrooveDetection:
    """``find_grooves`` in a cloud that was made ready."""
    cloud, valid, sides, spacing = view.points, view.valid, view.sides, view.spacing_mm
    if width_mm is not None and not width_mm >= MIN_POINTS_ACROSS * spacing:
        raise InputError(
            f"the points are {spacing:.2g} mm apart, too sparse for a groove {width_mm:.3g} mm wide; at least"
            f" {MIN_POINTS_ACROSS:.0f} points must fit across it: scan more densely or from nearer"
        )
    best: tuple[list[DetectedGroove], Floats, bool] = [], sides[0][0], False
    for frames in sides:
        grooves, cluttered = _grooves_seen(cloud, frames, spacing, width_mm, bevel)
        if _total_volume(grooves) > _total_volume(best[0]):
            best = grooves, frames[0], cluttered
    if not best[0]:
        raise NoGrooveError(
            f"no groove in the cloud ({len(cloud):,} points, {spacing:.2g} mm apart): no place where two walls fall"
            f" towards each other along a line, at least {MIN_POINTS_ACROSS * spacing:.2g} mm apart at this spacing;"
            " check the view, and give the viewpoint if the camera does not stand at the origin"
        )
    rank = np.full(len(valid), -1)
    at = np.flatnonzero(valid)
    found = [_with_members(groove, at[groove.members]) for groove in best[0]]
    least = MIN_VOLUME_FRACTION * found[0].volume_mm3
    grooves = [groove for groove in found if groove.volume_mm3 >= least]
    for number, groove in reversed(list(enumerate(grooves))):
        rank[groove.members] = number
    ranks = rank.reshape(view.shape)
    left_out = tuple(groove for groove in found if groove.volume_mm3 < least)
    return GrooveDetection(tuple(grooves), ranks, spacing, best[1], left_out, best[2])


def finite_points(points: ArrayLike) -> tuple[Floats, Flags]:
    """The finite points (N, 3) of a cloud (N, 3) or (R, C, 3), and which rows of the flat cloud they are.

    Raises:
        InputError: not such a cloud, or fewer than 100 finite points. UnitError: no part in mm is of this size.
    """
    try:
        cloud = np.asarray(points, dtype=float)
    except (TypeError, ValueError):
        raise InputError("the cloud is not an array of numbers; expected shape (N, 3)") from None
    if cloud.ndim not in (2, 3) or cloud.shape[-1] != 3:
        raise InputError(f"the cloud has shape {cloud.shape}; expected (N, 3), or (rows, columns, 3) if organised")
    cloud = cloud.reshape(-1, 3)
    valid = np.isfinite(cloud[:, 0] + cloud[:, 1] + cloud[:, 2])
    filler = filler_point(cloud)
    if filler is not None:
        valid &= (cloud != filler).any(axis=1)
    kept = cloud if valid.all() else cloud[valid]
    if len(kept) < 100:
        raise InputError(f"{len(kept)} of {len(cloud)} points are finite; a groove needs at least 100")
    diagonal = diagonal_mm(kept)
    if not SMALLEST_MM <= diagonal <= LARGEST_MM:
        guess = "; if its numbers are metres, read it with unit m" if diagonal < SMALLEST_MM else ""
        raise UnitError(f"the cloud spans {diagonal:.3g} mm, which is no weld part in mm{guess}")
    return kept, valid


def _total_volume(grooves: list[DetectedGroove]) -> float:
    return sum(groove.volume_mm3 for groove in grooves)


def _with_members(groove: DetectedGroove, members: Integers) -> DetectedGroove:
    return replace(groove, members=members)


def _grooves_seen(
    cloud: Floats, frames: list[Floats], spacing: float, width_mm: float | None, bevel: bool
) -> tuple[list[DetectedGroove], bool]:
    """Grooves of one side of the surface, largest first, what may be gaps last; one seen from several directions counts
    once.

    Also, whether some were found only under a smaller disc than the one that fills the largest valley.
    """
    radius = None if width_mm is None else max(1.2 * width_mm, 8 * spacing)
    found: list[DetectedGroove] = []
    may_be_gap: list[bool] = []
    cluttered = False
    for frame in frames:
        for look, (valleys, field) in enumerate(find_valleys(cloud, frame, spacing, radius)):
            before = len(found)
            for valley in valleys[:MAX_LOOKED_AT] if look else valleys:
                path = move_points(inverse(field.T_field_cloud), valley.path)
                if not _known(path, found):
                    groove = fit_groove(cloud, field.T_field_cloud, valley, spacing, found, bevel)
                    found += [groove] if groove is not None and not _known(groove.root, found) else []
            cluttered = cluttered or (look > 0 and len(found) > before)
            may_be_gap += [wall_fraction(groove, cloud) < MIN_WALL_FRACTION for groove in found[before:]]
            if not all(may_be_gap):
                break
    order = sorted(range(len(found)), key=lambda at: (may_be_gap[at], -found[at].volume_mm3))
    return [found[at] for at in order], cluttered


def _known(path: Floats, grooves: list[DetectedGroove]) -> bool:
    """Whether most of a path (M, 3) runs along one of the grooves."""
    return any(
        (cKDTree(groove.root).query(path)[0] < np.median(groove.width_mm)).mean() > KNOWN_FRACTION for groove in grooves
    )
