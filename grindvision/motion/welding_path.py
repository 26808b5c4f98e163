"""From a seam to the places a torch drives: stretches that are welded, with run-on and weave, and the ways between."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import InputError
from grindvision.geometry import check_points
from grindvision.motion.trajectory import Trajectory
from grindvision.motion.weave import Weave
from grindvision.records import by_content
from grindvision.words import counted

if TYPE_CHECKING:
    from grindvision.motion.plan import Motion, PlanMotionOptions
    from grindvision.motion.programme_steps import RobotProgramme, RobotProgrammeOptions

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

#: Places of a path are at most so far apart along the seam, mm, and the torch turns at most so far between them, rad.
STEP_MM, STEP_RAD = 10.0, 0.1

#: Speed along the ways through the air, mm/s.
AIR_MM_S = 50.0

#: Most places that a path may have; controllers hold few thousand positions.
MAX_PLACES = 4000

#: The tip's acceleration along a weave, mm/s2; the joints' own limits still hold.
WEAVE_MM_S2 = 5000.0

#: A weave counts as held where nine moves of ten reach this fraction of their speed.
MIN_SPEED_FRACTION, MIN_MOVES_FRACTION = 0.9, 0.9


@by_content
@dataclass(frozen=True)
class WeldPathOptions:
    """Settings of ``weld_path``, lengths in mm along the seam.

    ``speed_mm_s`` along the seam. ``run_on_mm`` and ``run_off_mm``: the weld begins so far before the seam and ends so
    far behind it, straight on, for run-on and run-off plates; of a closed seam, ``run_off_mm`` is the overlap.
    ``weave`` left out: the tip stays on the seam. ``stretches`` (start, end) are welded; left out, all of the seam. In
    the air between them the torch is pulled back by ``lift_mm``.
    """

    speed_mm_s: float = 8.0
    run_on_mm: float = 0.0
    run_off_mm: float = 0.0
    weave: Weave | None = None
    stretches: Sequence[tuple[float, float]] | None = None
    lift_mm: float = 30.0

    def __post_init__(self) -> None:
        if not 0 < self.speed_mm_s < np.inf:
            raise InputError(f"the speed along the seam is {self.speed_mm_s:g} mm/s; give a number above 0")
        for name, length in (("run-on", self.run_on_mm), ("run-off", self.run_off_mm)):
            if not 0 <= length <= 200:
                raise InputError(f"a {name} of {length:g} mm; give 0 to 200 mm")
        if not 0 < self.lift_mm <= 500:
            raise InputError(f"a lift of {self.lift_mm:g} mm between two welds; give a length above 0, 500 mm at most")
        if self.weave is not None:
            self.weave.check_speed(self.speed_mm_s)


@by_content
@dataclass(frozen=True)
class WeldPath:
    """Places of a torch in the order they are driven, N of them, as an open ``trajectory``.

    ``welds`` (N,) number the weld that a place belongs to from 1, 0 in the air. ``speeds_mm_s`` (N,) is the tip's speed
    on the way to the place. ``seam_mm`` (N,) is the length along the seam, NaN in the air. ``lengths_mm`` of the welds
    are counted along the seam, at ``speed_mm_s`` along it.
    """

    trajectory: Trajectory
    welds: Integers
    speeds_mm_s: Floats
    seam_mm: Floats
    lengths_mm: tuple[float, ...]
    speed_mm_s: float
    weave: Weave | None = None

    def __len__(self) -> int:
        return len(self.welds)

    @property
    def count(self) -> int:
        """How many welds there are."""
        return int(self.welds.max())

    def moved(self, T_new_base: ArrayLike) -> WeldPath:
        """Return the same path in another frame."""
        return replace(self, trajectory=self.trajectory.moved(T_new_base))

    def plan_options(self, options: PlanMotionOptions) -> PlanMotionOptions:
        """Settings for ``plan_motion`` along this path: its highest speed, and a weave's acceleration."""
        fastest = float(self.speeds_mm_s.max())
        if self.weave is None:
            return replace(options, tool_speed_mm_s=fastest)
        return replace(options, tool_speed_mm_s=fastest, tool_acceleration_mm_s2=WEAVE_MM_S2)

    def __str__(self) -> str:
        weave = "" if self.weave is None else f", {self.weave}"
        return f"{counted(self.count, 'weld')}, {sum(self.lengths_mm):.1f} mm along the seam{weave}, {len(self)} places"


def weld_path(seam: Trajectory, options: WeldPathOptions | None = None) -> WeldPath:
    """Places along a seam: every stretch welded, with its weave, and the ways through the air between them.

    A weave swings along the tool's y axis, square to the torch, and is counted along the seam, so that it runs on
    through corners. Its tip keeps ``speed_mm_s`` along the seam, not along the swing.

    Args:
        seam: tool frames along the seam, see ``tool_trajectory``; mm.
        options: speed, run-on, weave, stretches.

    Raises:
        InputError: a stretch outside the seam, shorter than 1 mm, or over the one before.
    """
    options = WeldPathOptions() if options is None else options
    spans = _spans(seam, options)
    poses: list[Floats] = []
    welds: list[NDArray[np.int64]] = []
    along: list[Floats] = []
    speeds: list[Floats] = []
    for number, (start, end) in enumerate(spans, start=1):
        weave = None if options.weave is None else options.weave.fitted(end - start, _whole_ring(seam, start, end))
        at = _places(seam, start, end, weave)
        there = seam.poses_at(at)
        if weave is not None:
            there[:, :3, 3] += weave.offsets_mm(at - start)[:, None] * there[:, :3, 1]
        if poses:
            air = _through_the_air(seam, poses[-1][-1], along[-1][-1], there[0], start, options.lift_mm)
            poses.append(air)
            welds.append(np.zeros(len(air), dtype=np.int64))
            along.append(np.full(len(air), np.nan))
            speeds.append(np.full(len(air), AIR_MM_S))
        steps = np.linalg.norm(np.diff(there[:, :3, 3], axis=0), axis=1)
        poses.append(there)
        welds.append(np.full(len(at), number, dtype=np.int64))
        along.append(at)
        speeds.append(np.concatenate([[AIR_MM_S if number > 1 else options.speed_mm_s],
                                      options.speed_mm_s * steps / np.diff(at)]))  # fmt: skip
    count = sum(map(len, poses))
    if count > MAX_PLACES:
        raise InputError(f"the path needs {count} positions, {MAX_PLACES} are the most: weave with a longer swing")
    return WeldPath(
        Trajectory(np.concatenate(poses)),
        np.concatenate(welds),
        np.concatenate(speeds),
        np.concatenate(along),
        tuple(end - start for start, end in spans),
        options.speed_mm_s,
        weave,
    )


def equal_tacks(seam: Trajectory, count: int, length_mm: float) -> tuple[tuple[float, float], ...]:
    """Stretches (start, end), mm along the seam, of equally spaced tacks, the outer ones half a space from the ends.

    Raises:
        InputError: they do not fit.
    """
    whole = float(seam.arc_mm[-1])
    if not (count >= 1 and length_mm >= 1.0 and count * length_mm <= whole / 2):
        raise InputError(
            f"{count} tacks of {length_mm:g} mm on a seam of {whole:.0f} mm; tacks are 1 mm long at least and take half"
            " of the seam at most: fewer or shorter ones"
        )
    middles = whole * (np.arange(count) + 0.5) / count
    return tuple((float(middle - length_mm / 2), float(middle + length_mm / 2)) for middle in middles)


def tacks_at(seam: Trajectory, points_mm: ArrayLike, length_mm: ArrayLike) -> tuple[tuple[float, float], ...]:
    """Stretches (start, end), mm along the seam, of tacks with their middles at points (N, 3), in the seam's frame.

    Raises:
        InputError: a point is farther than 10 mm from the seam, a tack hangs over an end, or two overlap.
    """
    points = check_points(points_mm, "tacks", min_points=1)
    lengths = np.broadcast_to(np.asarray(length_mm, dtype=float), len(points))
    whole = float(seam.arc_mm[-1])
    fine = np.linspace(0.0, whole, int(np.ceil(whole / 0.1)) + 1)
    away = [np.linalg.norm(seam.poses_at(fine)[:, :3, 3] - point, axis=1) for point in points]
    for number, distances in enumerate(away, start=1):
        if distances.min() > 10.0:
            raise InputError(
                f"tack {number} is {distances.min():.1f} mm from the seam; give points on the seam, in the cloud's"
                " frame, mm"
            )
    at = np.array([fine[int(distances.argmin())] for distances in away])
    order = np.argsort(at, kind="stable")
    starts, ends = at[order] - lengths[order] / 2, at[order] + lengths[order] / 2
    if not seam.closed:
        starts, ends = np.clip(starts, 0.0, whole), np.clip(ends, 0.0, whole)
    if (starts[1:] <= ends[:-1]).any():
        first = int((starts[1:] <= ends[:-1]).argmax())
        raise InputError(
            f"two tacks overlap at {ends[first]:.0f} mm along the seam; give each tack once, or shorter ones"
        )
    return tuple(zip(starts.tolist(), ends.tolist(), strict=True))


def stretches_between(seam: Trajectory, tacks: Sequence[tuple[float, float]]) -> tuple[tuple[float, float], ...]:
    """What is left of the seam between tacks, of stretches of 1 mm or more.

    Raises:
        InputError: nothing is left.
    """
    whole = float(seam.arc_mm[-1])
    if seam.closed:
        starts = [end for _, end in tacks]
        ends = [*(start for start, _ in tacks[1:]), tacks[0][0] + whole]
    else:
        starts, ends = [0.0, *(end for _, end in tacks)], [*(start for start, _ in tacks), whole]
    left = tuple((start, end) for start, end in zip(starts, ends, strict=True) if end - start >= 1.0)
    if not left:
        raise InputError("the tacks take all of the seam; nothing is left to weld")
    return left


def welding_programme(motion: Motion, path: WeldPath, options: RobotProgrammeOptions | None = None) -> RobotProgramme:
    """A motion along a welding path as the steps of a programme: the arc burns along each weld, and nowhere else.

    Raises:
        InputError: the motion is not the path's; the arm cannot hold the weave; see ``robot_programme``.
    """
    from grindvision.motion.programme_steps import (
        Comment,
        LinearMove,
        RobotProgrammeOptions,
        Step,
        arc_steps,
        robot_programme,
    )

    options = RobotProgrammeOptions() if options is None else options
    if len(motion.path.q_rad) != len(path):
        raise InputError(f"a motion through {len(motion.path.q_rad)} poses and a path of {len(path)}: two jobs")
    plain = robot_programme(motion, options)
    before, after = arc_steps(options.arc)
    moves = plain.moves
    _check_held(path, motion, np.array([move.speed_mm_s for move in moves[: len(path)]]))
    head = [step for step in plain.steps[:3] if not isinstance(step, LinearMove)]  # two comments, the joint move
    steps: list[Step] = [
        Comment(f"{counted(path.count, 'weld')}, {sum(path.lengths_mm):.1f} mm at {path.speed_mm_s:g} mm/s")
    ]
    steps += head[1:]
    for at, move in enumerate(moves[: len(path)]):
        weld = int(path.welds[at])
        first = weld > 0 and (at == 0 or path.welds[at - 1] != weld)
        last = weld > 0 and (at == len(path) - 1 or path.welds[at + 1] != weld)
        speed = move.speed_mm_s if at == 0 else min(move.speed_mm_s, float(path.speeds_mm_s[at]))
        zone = 0.0 if first or last or weld == 0 else move.zone_mm
        steps += [Comment(f"weld {weld} of {path.count}")] if first and path.count > 1 else []
        steps.append(replace(move, speed_mm_s=speed, zone_mm=zone, on_seam=weld > 0 and not first))
        steps += [*(before if first else []), *(after if last else [])]
    return replace(plain, steps=(*steps, moves[-1]))


def _spans(seam: Trajectory, options: WeldPathOptions) -> list[tuple[float, float]]:
    """Stretches to weld, run-on and run-off added where the first and the last one reach the seam's ends."""
    whole = float(seam.arc_mm[-1])
    spans = [(0.0, whole)] if options.stretches is None else [(float(a), float(b)) for a, b in options.stretches]
    last = -np.inf
    for start, end in spans:
        inside = seam.closed or (start >= -1e-6 and end <= whole + 1e-6)
        if not (inside and end - start >= 1.0 and start >= last and end - start <= whole + 1e-6):
            raise InputError(
                f"a stretch from {start:.1f} to {end:.1f} mm along a seam of {whole:.1f} mm; stretches lie on the seam,"
                " 1 mm long at least, one behind the other"
            )
        last = end
    (start, _), (_, end) = spans[0], spans[-1]
    if not seam.closed and abs(start) < 1e-6:
        spans[0] = (start - options.run_on_mm, spans[0][1])
    if _whole_ring(seam, start, end) or (not seam.closed and abs(end - whole) < 1e-6):
        spans[-1] = (spans[-1][0], end + options.run_off_mm)
    return spans


def _whole_ring(seam: Trajectory, start: float, end: float) -> bool:
    return seam.closed and abs(end - start - float(seam.arc_mm[-1])) < 1e-6


def _places(seam: Trajectory, start: float, end: float, weave: Weave | None) -> Floats:
    """Lengths along the seam at which the path has a place: its ends, the seam's own way points, the weave's turns."""
    if weave is not None:
        at = start + weave.positions_mm(end - start)
    else:
        own = seam.arc_mm
        if seam.closed:
            own = np.concatenate([own[:-1] + turn * own[-1] for turn in (-1, 0, 1, 2)])
        at = np.concatenate([[start], own[(own > start + 0.5) & (own < end - 0.5)], [end]])
    axes = seam.poses_at(at)[:, :3, :3]
    turns = np.arccos(np.clip((np.einsum("kji,kji->k", axes[1:], axes[:-1]) - 1) / 2, -1, 1))
    pieces = np.ceil(np.maximum(np.diff(at) / STEP_MM, turns / STEP_RAD) - 1e-9).astype(int)
    inner = [np.linspace(at[k], at[k + 1], max(count, 1), endpoint=False) for k, count in enumerate(pieces)]
    return np.concatenate([*inner, at[-1:]])


def _through_the_air(
    seam: Trajectory, leaving: Floats, left_at: float, coming: Floats, start: float, lift_mm: float
) -> Floats:
    """Poses from the end of a weld, back along the torch, over the seam, to above the next weld's start."""
    between = np.linspace(left_at, start, max(int(np.ceil((start - left_at) / STEP_MM)), 1) + 1)[1:-1]
    above = np.concatenate([leaving[None], seam.poses_at(between), coming[None]])
    ups = np.linspace(0.0, lift_mm, int(np.ceil(lift_mm / STEP_MM)) + 1)[1:]
    ways = [_raised(leaving[None], up) for up in ups[:-1]]
    ways.append(_raised(above, lift_mm))
    ways += [_raised(coming[None], up) for up in ups[:-1][::-1]]
    return np.concatenate(ways)


def _raised(poses: Floats, up_mm: float) -> Floats:
    raised = poses.copy()
    raised[:, :3, 3] -= up_mm * poses[:, :3, 2]
    return raised


def _check_held(path: WeldPath, motion: Motion, reached_mm_s: Floats) -> None:
    """Refuse a weave that the arm's joints cannot follow at its speed."""
    if path.weave is None:
        return
    inside = np.flatnonzero((path.welds[1:] > 0) & (path.welds[1:] == path.welds[:-1])) + 1
    wanted = path.speeds_mm_s[inside]
    held = np.quantile(reached_mm_s[inside] / wanted, 1 - MIN_MOVES_FRACTION)
    if held < MIN_SPEED_FRACTION:
        hz = path.speed_mm_s / path.weave.length_mm
        steps = np.linalg.norm(np.diff(path.trajectory.positions_mm, axis=0), axis=1)
        slower = min(float((steps / path.speeds_mm_s[1:]).sum() / motion.timing.time_s[-1]), 1.0)
        raise InputError(
            f"the arm's joints hold {100 * held:.0f} % of the tip's speed of up to {wanted.max():.0f} mm/s in a weave"
            f" {path.weave.width_mm:g} mm wide at {hz:.2g} Hz; weave at about {0.8 * slower * hz:.2g} Hz, or narrower"
        )
