"""Many views of one part that rests: every view registered onto others, and one pose for each that all pairs agree on.

Pairs of views are registered as ``scan_registration`` does it, nothing known of the poses: few of them, until every
view closes a loop of three with others. A wrong pair shows in that going round three views does not end where it began,
and is dropped. The loops tell about where each view lies, and from there all other pairs are refined by ICP alone, in a
fraction of the time. The poses of all views then follow from one least squares over the pairs, each with the
information its surfaces hold: the refinement over all overlapping views at once.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import AmbiguousError, DegenerateError, GrindvisionError, GrindvisionWarning, InputError
from grindvision.geometry import check_points, move_points, rigid
from grindvision.parallel import one_blas_thread
from grindvision.records import by_content
from grindvision.vision.registration.free_motions import motion_names, rms_extent
from grindvision.vision.registration.scan_registration import (
    MIN_POINTS,
    RegisterOptions,
    Registration,
    register,
    without_strays,
)
from grindvision.vision.registration.view_poses import (
    Pair,
    Tie,
    closed_ties,
    consistent_poses,
    largest_group,
    open_loops,
    poses_along_pairs,
    triangle_pairs,
)
from grindvision.vision.registration.view_ties import MORE_RELIEF, loop_limits, refined_pairs, tie_of
from grindvision.vision.surface.scan import choose_resolution
from grindvision.vision.surface.surfels import build_surfels

Floats = NDArray[np.float64]

#: A motion of a view (rms over its extent) is free where it moves the surfaces along their normals by less than this
#: fraction: a camera's own depth error, a few hundredths of a mm, would else pass for mm of motion.
MIN_STIFFNESS = 0.03

#: But not where this fraction of the surface resists a motion by ``RESISTS`` and more, as a small part on a large table
#: does. Of measured planes and spheres, 0.002 at most do, by the errors of their normals.
MIN_RESISTING, RESISTS = 0.01, 0.1

#: Pairs tried before views that leave all of them open are refused.
FEWEST_TRIED = 6

#: Further pairs that are registered for a view that is in no loop that closes.
ADDED = 2


@by_content
@dataclass(frozen=True)
class ViewRegistration:
    """Poses of views of one part that agree with each other.

    ``T_part_view`` (N, 4, 4), mm: the part's frame stands in the middle of its points, with the axes of view
    ``reference``; NaN for views that no pair ties to the others. ``pairs`` (target, source) that were used, and
    ``disagreement_mm`` (K,), by how much each differs from what all say (rms along the normals). ``refused``: why other
    pairs were not used.
    """

    T_part_view: Floats
    reference: int
    pairs: tuple[Pair, ...]
    disagreement_mm: Floats
    refused: dict[Pair, str]

    @property
    def found(self) -> NDArray[np.int64]:
        """Views (M,) that have a pose."""
        return np.flatnonzero(np.isfinite(self.T_part_view[:, 0, 0]))

    def __str__(self) -> str:
        return (
            f"{len(self.found)} of {len(self.T_part_view)} views tied by {len(self.pairs)} pairs, which differ by"
            f" {np.median(self.disagreement_mm):.2g} mm in the median"
        )


@one_blas_thread()
def register_views(
    clouds: Sequence[ArrayLike],
    names: Sequence[str] | None = None,
    pairs: Iterable[Pair] | None = None,
    seed: int = 0,
    finished: Callable[[int, int], None] | None = None,
) -> ViewRegistration:
    """Poses of views (M_i, 3) of one part, mm, each in the frame of a camera at its origin.

    Args:
        clouds: the views.
        names: of the views in messages.
        pairs: the pairs (target, source) to register, most alike first; all pairs when left out.
        seed: of the random draws.
        finished: is told how many pairs are done, and of how many.

    Returns:
        A pose for every view that pairs tie to the others, in the part's own frame.

    Raises:
        InputError: fewer than three views.
        AmbiguousError: the part leaves a motion free (flat, round, symmetric); the message names it.
        DegenerateError: too few points in a view; the views cannot be tied together.

    Warns:
        GrindvisionWarning: points that lie alone, and views that were left out.
    """
    names = [f"view {k + 1}" for k in range(len(clouds))] if names is None else list(names)
    if len(clouds) < 3:
        raise InputError(f"{len(clouds)} views; give three at least")
    views = [without_strays(check_points(one, name, MIN_POINTS), name) for one, name in zip(clouds, names, strict=True)]
    _refuse_free(views, names)
    by_distance = sorted(combinations(range(len(views)), 2), key=lambda pair: pair[1] - pair[0])
    wanted = list(by_distance if pairs is None else pairs)
    told = _Told(len(wanted), finished)
    ties, refused = _registered_pairs(views, names, wanted, seed, told)
    chosen = largest_group(ties, len(views))
    if len(chosen) < 3:
        reasons = "; ".join(dict.fromkeys(refused.values())) or "no more pairs were given"
        raise DegenerateError(
            f"the views cannot be tied to each other ({len(ties)} of {len(wanted)} pairs agree): {reasons[:300]}"
        )
    ties = {pair: tie for pair, tie in ties.items() if pair[0] in chosen}
    for row in sorted(set(range(len(views))) - set(chosen)):
        text = f"{names[row]} cannot be tied to the other views and is left out"
        warnings.warn(text, GrindvisionWarning, stacklevel=2)
    reference = max(chosen, key=lambda row: (sum(row in pair for pair in ties), -row))
    poses = poses_along_pairs(ties, reference, len(views))
    middle = np.mean([move_points(poses[row], views[row]).mean(axis=0) for row in chosen], axis=0)
    poses, left = consistent_poses(ties, rigid(None, -middle) @ poses, reference)
    others = [pair for pair in wanted if pair not in ties and pair not in refused and set(pair) <= set(chosen)]
    if others:
        more, unused = refined_pairs(views, others, poses, seed, finished=told.one_more)
        ties, refused = ties | more, refused | unused
        poses, left = consistent_poses(ties, poses, reference)
    return ViewRegistration(poses, reference, tuple(ties), left, refused)


class _Told:
    """Tells ``finished`` how many of all pairs are done."""

    def __init__(self, count: int, finished: Callable[[int, int], None] | None) -> None:
        self.done, self.count, self.finished = 0, count, finished

    def one_more(self) -> None:
        self.done += 1
        if self.finished is not None:
            self.finished(self.done, self.count)


def _open(ties: dict[Pair, Tie], views: Sequence[Floats]) -> list[Pair]:
    """Pairs most of whose loops of three do not close."""
    return open_loops(ties, *loop_limits(views))


def _closed(ties: dict[Pair, Tie], views: Sequence[Floats]) -> tuple[list[Pair], list[int]]:
    """Pairs in loops that close, of three or more, and the most views that these tie together."""
    opened = _open(ties, views)
    closed = closed_ties({pair: tie for pair, tie in ties.items() if pair not in opened}, *loop_limits(views))
    return closed, largest_group(closed, len(views)) if closed else []


def _registered_pairs(
    views: Sequence[Floats], names: Sequence[str], wanted: Sequence[Pair], seed: int, told: _Told
) -> tuple[dict[Pair, Tie], dict[Pair, str]]:
    """Pairs that were registered, nothing known of their poses, and why others could not be.

    Few pairs are tried first (``triangle_pairs``); while a view is in no loop that closes, those next in ``wanted`` for
    it, and so up to all.

    Raises:
        AmbiguousError: more pairs leave a motion free than do not.
    """
    ties: dict[Pair, Tie] = {}
    refused: dict[Pair, str] = {}
    free: list[str] = []
    trying = triangle_pairs(wanted, len(views)) if wanted else []
    while trying:
        for target, source in trying:
            try:
                ties[target, source] = tie_of(_registered(views[source], views[target], seed).fine, views[source])
            except GrindvisionError as refusal:
                refused[target, source] = str(refusal)
                if isinstance(refusal, AmbiguousError):
                    free.append(f"{names[source]} on {names[target]}: {refusal}")
            told.one_more()
            tried = len(ties) + len(refused)
            if tried >= FEWEST_TRIED and len(free) == tried:
                break
        if tried >= FEWEST_TRIED and len(free) == tried:
            break
        trying = _next_pairs(ties, refused, wanted, views)
    if len(free) > len(ties):
        tried = len(ties) + len(refused)
        raise AmbiguousError(f"the part leaves its pose open in {len(free)} of {tried} pairs tried; {free[0]}")
    closed, group = _closed(ties, views)
    opened = _open(ties, views) if len(group) < len(views) else [pair for pair in ties if pair not in closed]
    for pair in opened:
        refused[pair] = "does not agree with the other pairs"
        del ties[pair]
    return ties, refused


def _next_pairs(
    ties: dict[Pair, Tie], refused: dict[Pair, str], wanted: Sequence[Pair], views: Sequence[Floats]
) -> list[Pair]:
    """Pairs to register next: none where every view is in loops that close and hang together, else ``ADDED`` for each
    view that is not."""
    _, group = _closed(ties, views)
    untried = [pair for pair in wanted if pair not in ties and pair not in refused]
    chosen: list[Pair] = []
    for row in set(range(len(views))) - set(group):
        chosen += [pair for pair in untried if row in pair][:ADDED]
    return [pair for pair in untried if pair in chosen]


def _registered(source: Floats, target: Floats, seed: int) -> Registration:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GrindvisionWarning)  # strays are told once a view, not once a pair
        return register(source, target, RegisterOptions(seed, np.zeros(3), np.zeros(3)))


def _refuse_free(views: Sequence[Floats], names: Sequence[str]) -> None:
    """Refuse a part whose surface leaves a motion free in most of its views: planes, spheres, cylinders.

    Raises:
        AmbiguousError: names the motions in one view's frame.
    """
    told = [_free_motions(*_resistance(view)) for view in views]
    free = [row for row, text in enumerate(told) if text]
    if 2 * len(free) > len(views):
        raise AmbiguousError(
            f"the part leaves its pose open in {len(free)} of {len(views)} views; in {names[free[0]]}, {told[free[0]]}"
        )


def _resistance(points: Floats) -> tuple[Floats, float, Floats]:
    """How far (N, 6) a view's surfels move along their normals for a unit of translation, and of rotation about the
    view's middle; its extent, and that middle (3,)."""
    surfels = build_surfels(points, choose_resolution(points).voxel_mm)
    shown = np.linalg.norm(surfels.normals, axis=1) > 0.5
    places, normals = surfels.points[shown], surfels.normals[shown]
    middle = places.mean(axis=0)
    return np.hstack([normals, np.cross(places - middle, normals)]), rms_extent(points), middle


def _free_motions(rows: Floats, extent: float, centre: Floats) -> str:
    """In words, motions that a surface of this ``_resistance`` hardly resists (``MIN_STIFFNESS``); empty where there
    are none."""
    scale = np.array([1, 1, 1, 1 / extent, 1 / extent, 1 / extent])
    squares, directions = np.linalg.eigh((rows * scale).T @ (rows * scale) / max(len(rows), 1))
    resisting = np.mean(np.abs(rows * scale @ directions) > RESISTS, axis=0)
    weak = (squares < MIN_STIFFNESS**2) & (resisting < MIN_RESISTING)
    if not weak.any():
        return ""
    named = motion_names(directions[:, weak] * scale[:, None] * extent, extent, centre)
    return (
        f"free motion: {'; '.join(named)}; the surface moves along its normals by"
        f" {np.sqrt(max(squares[weak][0], 0)):.1%} of such a motion only, no more than a camera's own depth error"
        f" feigns; {MORE_RELIEF}"
    )
