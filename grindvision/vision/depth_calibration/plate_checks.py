"""Whether scans of a plate stand as their steps and distance say: what contradicts them is named with its size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import InputError
from grindvision.geometry import check_points, fit_plane, vector_angle

Floats = NDArray[np.float64]

#: Points farther from their plate than this many standard deviations are not of the plate.
STRAY = 6.0

#: Points that are plenty for a plane.
PLENTY = 20_000

#: Plates may differ from what is said of them by this much, mm and fraction: more is a mistake, not a scanner's error.
WARN_MM, WARN_FRACTION, WARN_TILT_DEG = 2.0, 0.05, 1.0

#: What scanners do not show by themselves: plates tilted against each other (deg), a scale of depth, an offset (mm).
NAMED_TILT_DEG, NAMED_SCALE, NAMED_OFFSET_MM = 0.25, 0.015, 2.0

#: Standard deviation of a scanner's scale of depth, where the steps do not tell it.
USUAL_SCALE = 0.004

#: Standard deviation (mm) of a plate's mean depth from the scanner's waves: so much, and this fraction of their rms.
MEAN_MM, MEAN_FRACTION = 0.02, 0.15

#: A step is doubted at so many standard deviations.
SURE = 5.0


@dataclass(frozen=True)
class Unseen:
    """How large a fault these scans could hide, each in its unit and in mm of a corrected point.

    ``tilt_deg``: of one plate against another, ``tilt_mm`` at the rim of the view; ``step_mm``: of one step, None where
    fewer than four plates cannot tell; ``scale``: of all steps; ``distance_mm``: of the first distance, None where it
    was not given.
    """

    tilt_deg: float
    tilt_mm: float
    step_mm: float | None
    scale: float
    distance_mm: float | None

    def __str__(self) -> str:
        parts = [f"plates tilted by up to {self.tilt_deg:.2g} deg ({self.tilt_mm:.2g} mm at the rim of the view)"]
        if self.step_mm is not None:
            parts.append(f"a step wrong by up to {self.step_mm:.2g} mm")
        if self.distance_mm is not None:
            parts.append(f"a first distance wrong by up to {self.distance_mm:.2g} mm")
        return f"these scans could not show {', '.join(parts)}: the correction would hold it"


@dataclass(frozen=True)
class PlateDiagnosis:
    """What contradicts the scans of a plate, a sentence each, and what they could not show."""

    warnings: tuple[str, ...]
    unseen: Unseen


def diagnose_plates(
    plates: Sequence[ArrayLike], steps_mm: Sequence[float], distance_mm: float | None = None
) -> PlateDiagnosis:
    """Say in words, with sizes, where scans of a plate contradict what ``calibrate_field`` is told of them.

    Looked for are plates tilted against each other, one step (or one plate) that the others contradict, steps of a
    wrong scale, and a first distance that neither the points nor the scale of the steps explain. A scanner's own error
    of such a size would look the same; what of it a correction should hold, the reader has to decide.

    Args:
        plates, steps_mm, distance_mm: as ``calibrate_field`` takes them.

    Returns:
        The sentences, and how large a tilt, a wrong step and a wrong distance could hide in these scans.
    """
    steps = np.asarray(steps_mm, dtype=float)
    clouds = [without_strays(check_points(cloud, f"points of plate {k + 1}"), k + 1) for k, cloud in enumerate(plates)]
    planes = [fit_plane(cloud[:: max(len(cloud) // PLENTY, 1)]) for cloud in clouds]
    normals = np.array([plane.normal * np.sign(plane.normal[2]) for plane in planes])
    normal = normals.mean(axis=0) / np.linalg.norm(normals.mean(axis=0))
    stands = np.array([float((cloud @ normal).mean()) for cloud in clouds])
    waves = float(np.median([plane.rms_mm for plane in planes]))
    half_mm = float(np.median([np.linalg.norm(np.ptp(cloud[:, :2], axis=0)) / 2 for cloud in clouds]))
    sigma = MEAN_MM + MEAN_FRACTION * waves
    tilt_limit = max(NAMED_TILT_DEG, float(np.degrees(SURE * np.sqrt(2) * sigma / (0.4 * half_mm))))
    told = _diagnose_tilts(normals, half_mm, tilt_limit)
    offset, scale, scale_sigma, step_findings = _line_of_steps(steps, stands, sigma)
    told += step_findings
    scale_limit = max(NAMED_SCALE, SURE * scale_sigma)
    if abs(scale - 1) > scale_limit:
        told.append(
            f"the points move by {scale:.3f} mm for each mm of the steps ({scale - 1:+.1%}), more than scanners err:"
            " check the steps' size and unit"
        )
    distance_limit = None
    if distance_mm is not None:
        if abs(scale - 1) > NAMED_SCALE:
            scale, scale_sigma = 1.0, USUAL_SCALE
        constant = offset - scale * float(distance_mm)
        distance_limit = max(NAMED_OFFSET_MM, SURE * scale_sigma * float(distance_mm))
        if abs(constant) > distance_limit:
            told.append(
                f"--distance-mm {distance_mm:g} lies {abs(constant):.1f} mm {'before' if constant > 0 else 'behind'}"
                f" the first plate's points ({offset:.1f} mm), and the steps show no such scale of depth: all corrected"
                " points would be shifted by that; check where the distance was measured from, or leave it out"
            )
    tilt_mm = float(np.radians(tilt_limit)) * half_mm
    unseen = Unseen(tilt_limit, tilt_mm, _step_limit(steps, sigma), scale_limit, distance_limit)
    return PlateDiagnosis(tuple(told), unseen)


def _step_limit(steps: Floats, sigma_mm: float) -> float | None:
    """How wrong the step of any one plate may be without being doubted; its neighbours' line hides the most."""
    if len(steps) < 4:
        return None
    line = np.column_stack([np.ones(len(steps)), steps])
    free = np.eye(len(steps)) - line @ np.linalg.pinv(line)
    return SURE * sigma_mm / float(np.sqrt(np.diag(free).min()))


def _diagnose_tilts(normals: Floats, half_mm: float, limit_deg: float) -> list[str]:
    """The largest tilt between two plates where it exceeds what waves of the scanner do; their lever is 0.4 of half."""
    angles = np.degrees([[vector_angle(one, other) for other in normals] for one in normals])
    first, last = sorted(int(i) for i in np.unravel_index(int(np.argmax(angles)), angles.shape))
    tilt = float(angles[first, last])
    if tilt <= limit_deg:
        return []
    return [
        f"plates {first + 1} and {last + 1} are tilted against each other by {tilt:.2f} deg"
        f" ({np.radians(tilt) * half_mm:.2g} mm at the rim of the view): the correction takes that for the scanner's"
        " error; only shift the plate, along its normal"
    ]


def _line_of_steps(steps: Floats, stands: Floats, sigma_mm: float) -> tuple[float, float, float, list[str]]:
    """Offset and scale of the places against the steps, the scale's sigma, and what one step contradicts.

    Beside the straight line, one plate elsewhere and all plates from one on elsewhere are tried, each where the others
    determine it.
    """
    order = np.argsort(steps)
    at, place, count = steps[order], stands[order], len(steps)
    if count < 3:
        return float(place[0] - at[0]), 1.0, USUAL_SCALE, []
    line = np.column_stack([np.ones(count), at])
    best = (0.0, 0.0, -1, "")
    if count >= 4:
        for kind, columns in (("plate", np.eye(count)), ("from", np.tri(count)[:, 1:])):
            for number, column in enumerate(columns.T):
                free = column - line @ np.linalg.lstsq(line, column, rcond=None)[0]
                if free @ free < 1e-6:
                    continue
                shift = float(free @ place / (free @ free))
                gain = abs(shift) * float(np.sqrt(free @ free)) / sigma_mm
                if gain > best[0] * (1 + 1e-9):
                    best = (gain, shift, number if kind == "plate" else number + 1, kind)
    findings = []
    gain, shift, number, kind = best
    columns = line
    if gain > SURE:
        extra = (np.arange(count) == number) if kind == "plate" else (np.arange(count) >= number)
        columns = np.column_stack([line, extra.astype(float)])
        side = "farther" if shift > 0 else "nearer"
        if kind == "plate":
            what = f"plate {order[number] + 1} stands {abs(shift):.2g} mm {side} than its step, {at[number]:g} mm,"
        else:
            what = (
                f"from plate {order[number] + 1} (step {at[number]:g} mm) on, the plates stand {abs(shift):.2g} mm"
                f" {side} than their steps,"
            )
        findings.append(f"{what} by the points and the other steps: mistyped, or the stage slipped; measure it again")
    elif count == 3:
        free = np.linalg.svd(line.T)[2][-1]
        bend = abs(float(free @ place))
        if bend > SURE * sigma_mm:
            findings.append(
                f"three plates stand {bend / np.abs(free).max():.2g} mm out of line with their steps: one step is"
                " wrong, or the scanner's depth bends so much; scan more plates to tell"
            )
    values = np.linalg.lstsq(columns, place, rcond=None)[0]
    covariance = np.linalg.inv(columns.T @ columns) * sigma_mm**2
    return float(values[0]), float(values[1]), float(np.sqrt(covariance[1, 1])), findings


def checked_distance(distance_mm: float | None, offset_mm: float) -> float:
    """The first plate's distance: as given, or as its points have it.

    Raises:
        InputError: the two are too far apart for a scanner's error.
    """
    first = offset_mm if distance_mm is None else float(distance_mm)
    if not abs(first - offset_mm) <= WARN_MM + WARN_FRACTION * offset_mm:
        raise InputError(
            f"distance_mm is {first:g}, but the first plate's points lie {offset_mm:.1f} mm away; check both"
        )
    return first


def without_strays(cloud: Floats, number: int) -> Floats:
    """A plate's points (N, 3) but those far off their plane and those at the origin, pixels without a depth."""
    cloud = cloud[cloud.any(axis=1)]
    if (cloud[:, 2] <= 0).any():
        raise InputError(f"plate {number} has points behind the scanner (z <= 0); give them in the scanner frame")
    for _ in range(2):
        distance = fit_plane(cloud[:: max(len(cloud) // PLENTY, 1)]).distance(cloud)
        distance -= np.median(distance)
        spread = 1.4826 * np.median(np.abs(distance))
        cloud = cloud[np.abs(distance) <= STRAY * spread + 1e-9]
    return cloud


def parallel_planes(
    means: Floats, seen: NDArray[np.bool_], steps: Floats, order: NDArray[np.int64]
) -> tuple[Floats, float]:
    """Common normal (3,), z above 0, and distance in mm at step 0 of plates with bin means (K, B, 3)."""
    normals = []
    for cloud, mask in zip(means, seen, strict=True):
        plane = fit_plane(cloud[mask])
        normals.append(plane.normal * np.sign(plane.normal[2]))
    normal = normals[0]
    for _ in range(3):
        plane = fit_plane(np.concatenate([m[s] - step * normal for m, s, step in zip(means, seen, steps, strict=True)]))
        normal = plane.normal * np.sign(plane.normal[2])
    offset = float(plane.offset_mm * np.sign(plane.normal[2]))
    for k, cloud, mask, step, own in zip(order, means, seen, steps, normals, strict=True):
        stands = float((cloud[mask] @ normal).mean())
        if abs(stands - offset - step) > WARN_MM + WARN_FRACTION * np.abs(steps).max():
            raise InputError(
                f"plate {k + 1} lies {stands:.1f} mm away by its points, {offset + step:.1f} mm by its step {step:g};"
                " check the order, sign and unit of the steps"
            )
        tilt = np.degrees(vector_angle(own, normal))
        if tilt > WARN_TILT_DEG:
            raise InputError(f"plate {k + 1} is tilted by {tilt:.1f} deg against the others; only shift it")
    return normal, offset
