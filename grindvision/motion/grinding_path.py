"""From planned passes to places a robot drives: lead-in, cut, lead-out, retract, in the frame of the scan."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import InputError
from grindvision.geometry import move_points, rotate_vectors
from grindvision.geometry.transforms import check_rigid, rotation_about
from grindvision.motion.grinding import GrindingPass, GrindingPlan, Stroke
from grindvision.motion.grinding_options import CHORD_MM
from grindvision.motion.trajectory import Trajectory
from grindvision.records import by_content
from grindvision.words import counted

if TYPE_CHECKING:
    from grindvision.motion.plan import Motion
    from grindvision.motion.programme_steps import RobotProgramme, RobotProgrammeOptions

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

KINDS = ("retract", "lead-in", "cut", "lead-out")
RETRACT, LEAD_IN, CUT, LEAD_OUT = range(4)

LONGEST_STEP_MM = 10.0
"""Ways through the air get places so far apart."""


@by_content
@dataclass(frozen=True)
class ToolPath:
    """The tip's way through all passes, N places in the order they are driven, in one frame, mm.

    ``passes``, ``lines`` (N,) number pass and line from 1; ``kinds`` (N,) index ``KINDS``; ``points``, outward
    ``normals`` and ``ahead`` (N, 3), the unit direction along the line; ``feeds_mm_s`` and ``forces_n`` (N,), the
    force 0 where nothing is touched.
    """

    passes: Integers
    lines: Integers
    kinds: Integers
    points: Floats
    normals: Floats
    ahead: Floats
    feeds_mm_s: Floats
    forces_n: Floats

    def __len__(self) -> int:
        return len(self.points)

    def moved(self, T_new_old: ArrayLike) -> ToolPath:
        """Return the same way in another frame."""
        transform = check_rigid(T_new_old, "T_new_old")
        return replace(
            self,
            points=move_points(transform, self.points),
            normals=rotate_vectors(transform, self.normals),
            ahead=rotate_vectors(transform, self.ahead),
        )

    def thinned(self, step_mm: float) -> ToolPath:
        """Return the way with the places of each cut at least ``step_mm`` apart where it is straight, closer where a
        place left out would lie more than ``CHORD_MM`` beside the straight line that is driven instead; ends and ways
        in and out stay."""
        if not step_mm > 0:
            raise InputError(f"a step of {step_mm} mm was asked for; give a length above zero")
        keep = np.ones(len(self), dtype=bool)
        last = 0
        for at in range(1, len(self) - 1):
            inner = self.kinds[at - 1] == self.kinds[at] == self.kinds[at + 1] == CUT
            far = bool(np.linalg.norm(self.points[at] - self.points[last]) >= step_mm - 1e-9)
            keep[at] = not inner or far or self._sagitta_mm(last, at + 1) > CHORD_MM
            last = at if keep[at] else last
        return ToolPath(*(getattr(self, name)[keep] for name in self.__dataclass_fields__))

    def _sagitta_mm(self, first: int, last: int) -> float:
        """Largest distance of the places between two from the straight line through these."""
        chord = self.points[last] - self.points[first]
        off = np.cross(self.points[first + 1 : last] - self.points[first], chord)
        return float(np.linalg.norm(off, axis=1).max() / max(np.linalg.norm(chord), 1e-12))

    def trajectory(self, lead_angle_rad: float = 0.0) -> Trajectory:
        """Poses of the tool: z opposite to the normal, x along the line, leaning forward by the lead angle.

        Lines that are driven backwards keep the tool's x axis, so that it does not turn round between them.
        """
        poses = np.zeros((len(self), 4, 4))
        x, side = self.ahead.copy(), 1.0
        for at in range(1, len(x)):
            if side * (x[at] @ x[at - 1]) < 0 and self.lines[at] != self.lines[at - 1]:
                side = -side
            x[at] *= side
        z = -self.normals
        y = np.cross(z, x)
        y /= np.linalg.norm(y, axis=1, keepdims=True)
        poses[:, :3, :3] = np.stack([np.cross(y, z), y, z], axis=-1) @ rotation_about([0, 1, 0], lead_angle_rad)
        poses[:, :3, 3], poses[:, 3, 3] = self.points, 1.0
        return Trajectory(poses)

    def __str__(self) -> str:
        length = np.linalg.norm(np.diff(self.points, axis=0), axis=1).sum()
        passes = counted(len(np.unique(self.passes)), "pass", "passes")
        return f"{len(self)} places in {passes}, {length:.0f} mm to drive"


def tool_path(plan: GrindingPlan) -> ToolPath:
    """The way of the tool through a plan's passes, in the frame of the scan, sent lower by the wheel's known offset.

    Raises:
        InputError: the plan has no passes.
    """
    if not plan.passes:
        raise InputError("the plan has no passes; there is no way to drive")
    parts = [_way(plan, one, line, stroke) for one in plan.passes for line, stroke in enumerate(one.strokes, start=1)]
    whole = ToolPath(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    return whole.moved(plan.work.heights.T_scan_map)


def _way(plan: GrindingPlan, one: GrindingPass, line: int, stroke: Stroke) -> tuple[NDArray[Any], ...]:
    """Columns of a ``ToolPath`` for one stroke, in the map's frame."""
    options = plan.options
    ahead, normals = stroke.poses[:, 3:6], stroke.poses[:, 9:12]
    tips = stroke.poses[:, :3] + (stroke.lifts_mm - plan.work.offset_mm)[:, None] * normals
    lengths = stroke.leads_mm or (options.lead_mm, options.lead_mm)
    leads = [
        tips[end] + sign * length * ahead[end] + options.lead_height_mm * normals[end]
        for end, sign, length in ((0, -1.0, lengths[0]), (-1, 1.0, lengths[1]))
    ]
    ups = [lead + options.retract_mm * normals[end] for lead, end in zip(leads, (0, -1), strict=True)]
    points = np.vstack([ups[0], leads[0], tips, leads[1], ups[1]])
    count = len(tips)
    kinds = np.array([RETRACT, LEAD_IN, *[CUT] * count, LEAD_OUT, RETRACT])
    ends = np.array([0, 0, *range(count), count - 1, count - 1])
    forces = np.where(kinds == CUT, one.force_n, 0.0)
    same = np.ones(count + 4, dtype=np.int64)
    return (
        one.number * same, line * same, kinds, points, normals[ends], ahead[ends], one.feed_mm_s * same.astype(float),
        forces,
    )  # fmt: skip


def driven(path: ToolPath) -> ToolPath:
    """The way with places in between where the tool goes far through the air, for an arm that is followed pose by
    pose."""
    away = np.linalg.norm(np.diff(path.points, axis=0), axis=1)
    pieces = np.maximum(np.ceil(away / LONGEST_STEP_MM).astype(int), 1)
    at = np.concatenate([start + np.arange(count) / count for start, count in enumerate(pieces)] + [[len(path) - 1.0]])
    low = np.minimum(at.astype(int), len(path) - 2) if len(path) > 1 else at.astype(int)
    fraction = (at - low)[:, None]

    def between(values: Floats) -> Floats:
        return (1 - fraction) * values[low] + fraction * values[np.minimum(low + 1, len(values) - 1)]

    nearest = np.rint(at).astype(int)
    kinds = np.where(at == nearest, path.kinds[nearest], RETRACT)
    normals, ahead = between(path.normals), between(path.ahead)
    flipped = np.linalg.norm(ahead, axis=1) < 0.1  # half-way between two lines that run against each other
    ahead[flipped] = path.ahead[low[flipped]]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    ahead -= (ahead * normals).sum(axis=1, keepdims=True) * normals
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    return ToolPath(
        path.passes[low], path.lines[low], kinds, between(path.points), normals, ahead, path.feeds_mm_s[low],
        np.where(kinds == CUT, path.forces_n[nearest], 0.0),
    )  # fmt: skip


def grinding_programme(motion: Motion, path: ToolPath, options: RobotProgrammeOptions | None = None) -> RobotProgramme:
    """A motion along ``driven`` places as the steps of a programme, each straight move at the feed of its pass.

    Raises:
        InputError: the path is not the one that is driven; see ``robot_programme``.
    """
    from grindvision.motion.programme_steps import Comment, LinearMove, Step, robot_programme

    if len(motion.path.q_rad) != len(path):
        raise InputError(f"a motion through {len(motion.path.q_rad)} poses and a path of {len(path)}: two jobs")
    plain = robot_programme(motion, options)
    steps: list[Step] = [Comment("grinding: touch off on the good surface beside the stock before the first pass")]
    at = 0
    for step in plain.steps:
        if isinstance(step, LinearMove) and at < len(path):
            if at == 0 or path.passes[at] != path.passes[at - 1]:
                force = path.forces_n[path.passes == path.passes[at]].max()
                steps.append(Comment(f"pass {path.passes[at]}: contact force {force:.1f} N"))
            zone = 0.0 if path.kinds[at] != CUT else step.zone_mm
            steps.append(replace(step, speed_mm_s=min(step.speed_mm_s, float(path.feeds_mm_s[at])), zone_mm=zone))
            at += 1
        elif not (isinstance(step, Comment) and "arc" in step.text):
            steps.append(step)
    return replace(plain, steps=tuple(steps))
