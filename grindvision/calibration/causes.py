"""What may stand behind the residuals of a fit: each cause as columns of the error model, and in words."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from grindvision.calibration.joint_terms import (
    GravityLoad,
    JointTerm,
    bases_of,
    coupling_terms,
    sag_terms,
    wave_pair,
    wave_terms,
)
from grindvision.calibration.measurements import Measurements
from grindvision.calibration.model import CarriedPoints
from grindvision.calibration.wave_search import LinearFit, Wave
from grindvision.geometry import motion_columns
from grindvision.records import by_content

Floats = NDArray[np.float64]
Describe = Callable[[Floats], tuple[float, str]]

#: How wrong scales of the tracker, of the scanner and of its depths alone are told.
SCALES = (
    ("the tracker's lengths (bx to bz)", "for this arm: check the tracker's scale, its temperature and unit"),
    (
        "the scanner's lengths (sx to sz)",
        "against the tracker's and the arm's: check the scanner's scale, its temperature and unit, then the tracker's",
    ),
    (
        "the scanner's depths (sz)",
        "against its own breadth, the tracker and the arm: calibrate the scanner's depth, or scan at one distance",
    ),
)

#: Depths (mm) over which the spheres must stand for a scale of depth to be told from the scanner's place.
MIN_DEPTHS_MM = 20.0

#: Places in the session at which a jump is looked for.
JUMPS = 150


@by_content
@dataclass(frozen=True)
class Cause:
    """What a cause moves the points by: ``motion`` (M, 3, c) for each of its numbers, times its ``course`` (M,)."""

    kind: str
    motion: Floats
    describe: Describe
    terms: tuple[JointTerm, ...] = ()
    course: Floats | None = None

    @property
    def columns(self) -> Floats:
        """Columns (M, 3, c) of the error model; made anew each time, as there are hundreds that share one motion."""
        return self.motion if self.course is None else self.motion * self.course[:, None, None]


def causes_of(points: CarriedPoints, measurements: Measurements, load: GravityLoad) -> list[Cause]:
    """Every cause that is looked for; measurements (M rows) in the order in which they were taken."""
    causes = _session_causes(points, measurements)
    causes += _joint_causes(points, load)
    causes += _scale_causes(points, measurements)
    return causes + _sphere_causes(measurements)


def wave_cause(fit: LinearFit, wave: Wave) -> Cause:
    """A wave that was found in the residuals, as a cause."""
    columns = fit.wave(wave.joint, np.array([wave.order]))

    def told(values: Floats) -> tuple[float, str]:
        size = float(np.sqrt(((columns @ values) ** 2).sum(axis=1).mean()))
        return size, (
            f"what is left repeats {wave.order:g} times a turn of joint {wave.joint + 1} (waves of"
            f" {np.degrees(np.hypot(*values)):.2g} deg, {size:.2g} mm of the points): gears, motor or encoder; keep to"
            " the poses measured, or use the joint terms where the report has them"
        )

    return Cause("wave", columns, told, wave_pair(wave.joint, wave.order))


def _session_causes(points: CarriedPoints, measurements: Measurements) -> list[Cause]:
    """The tracker's frame drifts with the row or jumps once; the tool slips once, or a ball bar's length is wrong."""
    rows = len(measurements)
    motions = _carried_motions(points, measurements)
    causes = []
    if measurements.tracked.all():
        motion = motion_columns(measurements.tracker_mm - measurements.tracker_mm.mean(axis=0))
        motions.insert(0, ("jump", "", "the tracker or the arm's base was moved", motion))
        causes += _drifts(motion, measurements.tracker_mm)
    bars = np.isfinite(measurements.bar_mm) & ~measurements.tracked
    if bars.any():
        sockets = points.cell.fixtures_mm[measurements.fixture, :3]
        rays = np.where(bars[:, None], points.tracker_mm - sockets, 0.0)
        rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-9)
        motions.append(("bar", " along the ball bar", "another bar, or its length is mistyped", rays[:, :, None]))
        causes.append(Cause("bar", rays[:, :, None], _bar_told))
    starts = np.flatnonzero(measurements.pose[1:] != measurements.pose[:-1]) + 1
    starts = starts[(starts >= 4) & (starts <= rows - 4)]
    if len(starts) > JUMPS:
        starts = starts[np.linspace(0, len(starts) - 1, JUMPS).astype(int)]
    steps = [(np.arange(rows) >= row, f"at row {row + 1} or near it") for row in starts]
    if 4 <= measurements.train.sum() <= rows - 4:
        steps.append((~measurements.train, "between the training and the test rows"))
    for after, where in steps:
        for kind, frame, what, motion in motions:
            course = after.astype(float)

            def told(
                values: Floats, course: Floats = course, words: tuple[str, str, str] = (where, frame, what),
                motion: Floats = motion,
            ) -> tuple[float, str]:  # fmt: skip
                where, frame, what = words
                return _moved_rms(motion, values, course), (
                    f"what is left jumps by {_amount(values)} {where}{frame}: {what}; calibrate the rows before and"
                    " after it by themselves"
                )

            causes.append(Cause(kind, motion, told, course=course))
    return causes


def _drifts(motion: Floats, tracker_mm: Floats) -> list[Cause]:
    """The tracker's frame moves steadily from the first row to the last, or its lengths (or the arm's) grow."""
    time = np.linspace(-0.5, 0.5, len(motion))
    away = (tracker_mm - tracker_mm.mean(axis=0))[:, :, None]

    def moved(values: Floats) -> tuple[float, str]:
        return _moved_rms(motion, values, time), (
            f"what is left drifts by {_amount(values)} from the first row to the last: the tracker, the base or the"
            " temperature moved; measure some points again at the end of a session, and calibrate each part by itself"
        )

    def grew(values: Floats) -> tuple[float, str]:
        return _moved_rms(away, values, time), (
            f"the tracker's lengths {'grow' if values[0] > 0 else 'shrink'} by {abs(values[0]):.2%} from the first row"
            " to the last: the arm warms up, or the tracker's scale drifts; let both come to rest, and measure again"
        )

    return [Cause("drift", motion, moved, course=time), Cause("drift", away, grew, course=time)]


def _bar_told(values: Floats) -> tuple[float, str]:
    return abs(float(values[0])), (
        f"the ball bar comes out {abs(values[0]):.2g} mm {'shorter' if values[0] > 0 else 'longer'} than bar_mm says:"
        " measure its length between the centres of its balls"
    )


def _carried_motions(points: CarriedPoints, measurements: Measurements) -> list[tuple[str, str, str, Floats]]:
    """What sits on the last joint and may slip there: kind, frame and cause in words, and the motion (M, 3, 3 or 6)."""
    rotation = (points.cell.T_tracker_base @ points.frames[:, -1])[:, :3, :3]
    frame = " in the frame of the last joint"
    if not measurements.on_tool:
        return [("slip", frame, "the scanner was moved on it", rotation @ motion_columns(points.joint_mm))]
    if not measurements.reflectors:
        return [("slip", frame, "the reflector or the tip slipped on the tool", rotation)]
    return [
        ("slip", frame, f"reflector {name} slipped on the tool", rotation * own[:, None, None])
        for name, own in zip(
            measurements.reflectors, np.equal.outer(np.arange(len(measurements.reflectors)), measurements.reflector),
            strict=True,
        )
    ]  # fmt: skip


def _moved_rms(motion: Floats, values: Floats, course: Floats) -> float:
    moved = (motion * course[:, None, None]) @ values
    return float(np.sqrt((moved**2).sum(axis=1).mean()))


def _amount(values: Floats) -> str:
    """A shift (3,), mm, or a motion (6,) of a shift and a turn, rad, in words."""
    shift = f"{np.linalg.norm(values[:3]):.2g} mm"
    return shift if len(values) < 6 else f"{shift} and {np.degrees(np.linalg.norm(values[3:])):.2g} deg"


def _joint_causes(points: CarriedPoints, load: GravityLoad) -> list[Cause]:
    """Gear waves joint by joint, sag of all joints, couplings pair by pair."""
    arm, jacobian = points.cell.arm, points.jacobian()
    already = {term.name for term in points.cell.corrections.terms}
    causes = []
    waves, sags = wave_terms(arm), sag_terms(load, points.q_rad)
    groups = [("wave", tuple(term for term in waves if term.joint == joint)) for joint in range(arm.n)]
    groups += [("sag", sags), *(("coupling", (term,)) for term in coupling_terms(arm))]
    groups += [("joint scale", (JointTerm(joint, "coupling", source=joint),)) for joint in range(arm.n)]
    for kind, terms in groups:
        terms = tuple(term for term in terms if term.name not in already)
        if not terms:
            continue
        bases = bases_of(terms, points.q_rad)
        columns = jacobian[:, :, [term.joint for term in terms]] * bases[:, None, :]

        def told(
            values: Floats,
            kind: str = kind,
            joint: int = terms[0].joint,
            source: int = terms[0].source,
            columns: Floats = columns,
            jacobian: Floats = jacobian,
        ) -> tuple[float, str]:
            size = float(np.sqrt(((columns @ values) ** 2).sum(axis=1).mean()))
            if kind == "wave":
                angle = np.degrees(np.hypot(values[0::2], values[1::2]).max())
                return size, (
                    f"what is left repeats with the angle of joint {joint + 1} (waves of {angle:.2g} deg, {size:.2g} mm"
                    " of the points): gears or encoder; keep to the poses measured, or use the joint"
                    " terms where the report has them"
                )
            if kind == "sag":
                return size, (
                    f"what is left follows the arm's own weight ({size:.2g} mm rms): joints or links sag;"
                    " measure with the load that the arm will carry, or use the joint terms where the report has them"
                )
            if kind == "joint scale":
                return size, (
                    f"what is left grows with the reading of joint {joint + 1}: it moves {1 + values[0]:.5g} of what"
                    f" its column says ({size:.2g} mm rms); check its unit, its gear ratio, the scale of its encoder"
                )
            return size, (
                f"what is left follows the angle of joint {source + 1} as if joint {joint + 1} were driven along, by"
                f" {values[0]:.3g} of it ({size:.2g} mm rms): a coupling of the gears that the columns leave out"
            )

        causes.append(Cause(kind, columns, told, terms if kind in ("coupling", "joint scale") else ()))
    return causes


def _scale_causes(points: CarriedPoints, measurements: Measurements) -> list[Cause]:
    """The scanner's or the tracker's lengths come out too long or too short."""
    causes = []
    seen = measurements.scanner_mm
    columns = [("tracker scale", measurements.tracker_mm - measurements.tracker_mm.mean(axis=0), SCALES[0])]
    if not measurements.on_tool and np.ptp(seen, axis=0).max() > 1.0 and len(np.unique(seen, axis=0)) > 8:
        rotation = (points.cell.T_tracker_base @ points.frames[:, -1] @ points.cell.T_joint_scanner)[:, :3, :3]
        columns.append(("scanner scale", -np.einsum("mij,mj->mi", rotation, seen), SCALES[1]))
        if np.ptp(seen[:, 2]) > MIN_DEPTHS_MM:
            columns.append(("scanner depth", -rotation[:, :, 2] * seen[:, [2]], SCALES[2]))
    for kind, column, words in columns:

        def scale(values: Floats, column: Floats = column, words: tuple[str, str] = words) -> tuple[float, str]:
            centred = column - column.mean(axis=0)
            size = abs(float(values[0])) * float(np.sqrt((centred**2).sum(axis=1).mean()))
            factor = "long" if values[0] > 0 else "short"
            return size, f"{words[0]} come out {abs(values[0]):.2%} too {factor} {words[1]}"

        causes.append(Cause(kind, column[:, :, None], scale))
    return causes


def _sphere_causes(measurements: Measurements) -> list[Cause]:
    """One sphere stands elsewhere than the tracker said."""
    labels, number, counts = np.unique(measurements.sphere, return_inverse=True, return_counts=True)
    poses = np.array([len(np.unique(measurements.pose[number == i])) for i in range(min(len(labels), 200))])
    causes = []
    eye = np.broadcast_to(np.eye(3), (len(measurements), 3, 3))
    for sphere in np.flatnonzero((poses >= 3) & (counts[: len(poses)] < len(measurements) / 2)):
        own = (number == sphere).astype(float)

        def off(values: Floats, label: str = str(labels[sphere]), own: Floats = own) -> tuple[float, str]:
            length = float(np.linalg.norm(values))
            return length * float(np.sqrt(own.mean())), (
                f"sphere {label} stands {length:.2g} mm from where the tracker has it, by all other rows: measure it"
                " again or leave its rows out"
            )

        causes.append(Cause("sphere", eye, off, course=own))
    return causes
