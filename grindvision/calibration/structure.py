"""What is left after a fit must look like noise: tests for what follows the session, the joints, the scanner, a sphere.

Each test adds a few columns to the error model, takes from them what the fit's own unknowns can do, and asks how much
of the residuals they explain (an F test on rows scaled to unit noise). The one that explains most is taken into the
model before the others are asked again, so that one cause is named once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as fisher

from grindvision.calibration.estimate import Sigmas, deviations, unit_sizes
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
from grindvision.calibration.model import CarriedPoints, ScannerOnArm
from grindvision.calibration.unknowns import Unknowns
from grindvision.calibration.wave_search import ORDERS, LinearFit, Wave, linear_fit, strongest_wave
from grindvision.geometry import skew
from grindvision.records import by_content

Floats = NDArray[np.float64]
Describe = Callable[[Floats], tuple[float, str]]

#: Chance that any of the tests speaks without a cause; and the least fraction of squares it must explain.
FALSE_ALARM, MIN_EXPLAINED = 1e-3, 0.08

#: Causes named at most, and rows looked at: more than these tell no more.
MAX_FINDINGS, MAX_ROWS = 4, 2000

#: Places in the session at which a jump is looked for.
JUMPS = 150


@by_content
@dataclass(frozen=True)
class Finding:
    """A structure in the residuals: its ``kind``, how far it moves points (rms, mm), and a sentence for a person.

    ``explained`` is the fraction of the residuals' squares that it explains, ``p_value`` the chance of as much from
    noise. ``bias`` (K,) is how far the unknowns lie from where they are without it, ``values`` are the coefficients of
    its columns, and ``terms`` what these are where ``model_error`` has no unknowns for them.
    """

    kind: str
    size_mm: float
    explained: float
    p_value: float
    sentence: str
    bias: Floats
    values: tuple[float, ...] = ()
    terms: tuple[JointTerm, ...] = ()


@by_content
@dataclass(frozen=True)
class _Effect:
    kind: str
    columns: Floats
    describe: Describe
    terms: tuple[JointTerm, ...] = ()


def structure_in(
    cell: ScannerOnArm,
    unknowns: Unknowns,
    measurements: Measurements,
    sigmas: Sigmas,
    load: GravityLoad,
) -> tuple[Finding, ...]:
    """Find structure in the residuals of a fit, the largest first; rows must stand in the order of measuring.

    Args:
        cell: the calibrated cell.
        unknowns: what the fit was free to move.
        measurements: the rows to look at, without those that were dropped.
        sigmas: noise and priors of the fit.
        load: masses that the joints may sag under.
    """
    if len(measurements) > MAX_ROWS:
        measurements = measurements.rows(np.linspace(0, len(measurements) - 1, MAX_ROWS).astype(int))
    fit = linear_fit(cell, deviations(cell, cell.arm, unknowns), unknowns, measurements, sigmas)
    effects = _effects(fit.points, measurements, load)
    if not effects:
        return ()
    units = unit_sizes(measurements, unknowns)
    blocks = [fit.block(effect.columns) for effect in effects]
    basis, left = fit.basis, fit.left
    freedom = len(left) - len(unknowns)
    orders = ORDERS[ORDERS > 2]
    tested = len(effects) + len(orders) * cell.arm.n
    found: list[Finding] = []
    for _ in range(MAX_FINDINGS):
        total = float(left @ left)
        best = _strongest(effects, blocks, basis, left, freedom)
        spare = measurements.equations - basis.shape[1]
        wave = strongest_wave(fit, basis, left, spare, orders)
        if wave is not None and (best is None or (wave.p_value, -wave.gain) < best[:2]):
            effect = _wave_effect(fit, wave)
            best = (wave.p_value, -wave.gain, effect, fit.block(effect.columns), wave.columns)
        if best is None:
            break
        chance, loss, effect, block, sides = best
        if chance * tested > FALSE_ALARM or -loss < MIN_EXPLAINED * total:
            break
        values = np.linalg.lstsq(block - basis @ (basis.T @ block), left, rcond=0.05)[0]
        scale = np.maximum(np.linalg.norm(fit.whiten(effect.columns), axis=0), 1e-12)
        size, sentence = effect.describe(values / scale)
        bias = -np.linalg.lstsq(fit.design, block @ values, rcond=1e-10)[0] * units
        coefficients = tuple((values / scale).tolist())
        found.append(
            Finding(effect.kind, size, -loss / total, chance * tested, sentence, bias, coefficients, effect.terms)
        )
        basis = np.hstack([basis, sides])
        left = left - sides @ (sides.T @ left)
        freedom -= sides.shape[1]
    return tuple(found)


def _strongest(
    effects: Sequence[_Effect], blocks: Sequence[Floats], basis: Floats, left: Floats, freedom: int
) -> tuple[float, float, _Effect, Floats, Floats] | None:
    """The effect that noise explains least: the chance of that, minus the squares it explains, and its columns."""
    best = None
    total = float(left @ left)
    for effect, block in zip(effects, blocks, strict=True):
        free = block - basis @ (basis.T @ block)
        sides, lengths, _ = np.linalg.svd(free, full_matrices=False)
        sides = sides[:, lengths > 1e-3]
        count = sides.shape[1]
        if count == 0 or freedom - count < 6:
            continue
        gain = float(((sides.T @ left) ** 2).sum())
        ratio = (gain / count) / max((total - gain) / (freedom - count), 1e-300)
        chance = float(fisher.sf(ratio, count, freedom - count))
        if best is None or (chance, -gain) < best[:2]:
            best = (chance, -gain, effect, block, sides)
    return best


def _wave_effect(fit: LinearFit, wave: Wave) -> _Effect:
    columns = fit.wave(wave.joint, np.array([wave.order]))

    def told(values: Floats) -> tuple[float, str]:
        size = float(np.sqrt(((columns @ values) ** 2).sum(axis=1).mean()))
        return size, (
            f"what is left repeats {wave.order:g} times a turn of joint {wave.joint + 1} (waves of"
            f" {np.degrees(np.hypot(*values)):.2g} deg, {size:.2g} mm of the points): gears, motor or encoder; keep to"
            " the poses measured, or use the joint terms where the report has them"
        )

    return _Effect("wave", columns, told, wave_pair(wave.joint, wave.order))


def _effects(points: CarriedPoints, measurements: Measurements, load: GravityLoad) -> list[_Effect]:
    effects = _session_effects(points, measurements) if measurements.tracked.all() else []
    effects += _joint_effects(points, load)
    effects += _scale_effects(points, measurements)
    return effects + _sphere_effects(measurements)


def _session_effects(points: CarriedPoints, measurements: Measurements) -> list[_Effect]:
    """The tracker's frame drifts with the row, or jumps once."""
    rows = len(measurements)
    centre = measurements.tracker_mm.mean(axis=0)
    motion = np.concatenate(
        [np.broadcast_to(np.eye(3), (rows, 3, 3)), _turning(measurements.tracker_mm - centre)], axis=2
    )
    time = np.linspace(-0.5, 0.5, rows)

    def size_of(values: Floats, course: Floats) -> tuple[float, str]:
        moved = (motion * course[:, None, None]) @ values
        translation, rotation = np.linalg.norm(values[:3]), np.degrees(np.linalg.norm(values[3:]))
        return float(np.sqrt((moved**2).sum(axis=1).mean())), f"{translation:.2g} mm and {rotation:.2g} deg"

    def drift(values: Floats) -> tuple[float, str]:
        size, amount = size_of(values, time)
        return size, (
            f"what is left drifts by {amount} from the first row to the last: the tracker, the base or the temperature"
            " moved; measure some points again at the end of a session, and calibrate each part by itself"
        )

    effects = [_Effect("drift", motion * time[:, None, None], drift)]
    starts = np.flatnonzero(measurements.pose[1:] != measurements.pose[:-1]) + 1
    starts = starts[(starts >= 4) & (starts <= rows - 4)]
    if len(starts) > JUMPS:
        starts = starts[np.linspace(0, len(starts) - 1, JUMPS).astype(int)]
    steps = [(np.arange(rows) >= row, f"at row {row + 1} or near it") for row in starts]
    if 4 <= measurements.train.sum() <= rows - 4:
        steps.append((~measurements.train, "between the training and the test rows"))
    for after, where in steps:
        course = after.astype(float)

        def jump(values: Floats, course: Floats = course, where: str = where) -> tuple[float, str]:
            size, amount = size_of(values, course)
            return size, (
                f"what is left jumps by {amount} {where}: the tracker or the arm's base was moved, or a reflector"
                " slipped; calibrate the rows before and after it by themselves"
            )

        effects.append(_Effect("jump", motion * course[:, None, None], jump))
    return effects


def _joint_effects(points: CarriedPoints, load: GravityLoad) -> list[_Effect]:
    """Gear waves joint by joint, sag of all joints, couplings pair by pair."""
    arm, jacobian = points.cell.arm, points.jacobian()
    already = {term.name for term in points.cell.corrections.terms}
    effects = []
    waves, sags = wave_terms(arm), sag_terms(load, points.q_rad)
    groups = [("wave", tuple(term for term in waves if term.joint == joint)) for joint in range(arm.n)]
    groups += [("sag", sags), *(("coupling", (term,)) for term in coupling_terms(arm))]
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
            return size, (
                f"what is left follows the angle of joint {source + 1} as if joint {joint + 1} were driven along, by"
                f" {values[0]:.3g} of it ({size:.2g} mm rms): a coupling of the gears that the columns leave out"
            )

        effects.append(_Effect(kind, columns, told, terms if kind == "coupling" else ()))
    return effects


def _scale_effects(points: CarriedPoints, measurements: Measurements) -> list[_Effect]:
    """The scanner's or the tracker's lengths come out too long or too short."""
    effects = []
    seen = measurements.scanner_mm
    columns = [("tracker", "b", measurements.tracker_mm - measurements.tracker_mm.mean(axis=0))]
    if not measurements.on_tool and np.ptp(seen, axis=0).max() > 1.0 and len(np.unique(seen, axis=0)) > 8:
        rotation = (points.cell.T_tracker_base @ points.frames[:, -1] @ points.cell.T_joint_scanner)[:, :3, :3]
        columns.append(("scanner", "s", -np.einsum("mij,mj->mi", rotation, seen)))
    for instrument, letter, column in columns:

        def scale(
            values: Floats, instrument: str = instrument, letter: str = letter, column: Floats = column
        ) -> tuple[float, str]:
            centred = column - column.mean(axis=0)
            size = abs(float(values[0])) * float(np.sqrt((centred**2).sum(axis=1).mean()))
            factor = "long" if values[0] > 0 else "short"
            return size, (
                f"the {instrument}'s lengths ({letter}x to {letter}z) come out {abs(values[0]):.2%} too {factor} for"
                f" this arm: check the {instrument}'s scale, its temperature and unit"
            )

        effects.append(_Effect(f"{instrument} scale", column[:, :, None], scale))
    return effects


def _sphere_effects(measurements: Measurements) -> list[_Effect]:
    """One sphere stands elsewhere than the tracker said."""
    labels, number, counts = np.unique(measurements.sphere, return_inverse=True, return_counts=True)
    poses = np.array([len(np.unique(measurements.pose[number == i])) for i in range(min(len(labels), 200))])
    effects = []
    for sphere in np.flatnonzero((poses >= 3) & (counts[: len(poses)] < len(measurements) / 2)):
        own = (number == sphere).astype(float)

        def off(values: Floats, label: str = str(labels[sphere]), own: Floats = own) -> tuple[float, str]:
            length = float(np.linalg.norm(values))
            return length * float(np.sqrt(own.mean())), (
                f"sphere {label} stands {length:.2g} mm from where the tracker has it, by all other rows: measure it"
                " again or leave its rows out"
            )

        effects.append(_Effect("sphere", own[:, None, None] * np.eye(3)[None], off))
    return effects


def _turning(points: Floats) -> Floats:
    """Columns (M, 3, 3): how a small rotation about x, y, z moves points (M, 3)."""
    return -skew(points)


def sentences_of(findings: Sequence[Finding]) -> list[str]:
    """What a person should know of the findings, a sentence each."""
    return [finding.sentence for finding in findings]
