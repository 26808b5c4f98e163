"""What a hand-eye calibration leaves poorly known, and which further poses would mend it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from grindvision.calibration.hand_eye import HandEye, carriers
from grindvision.calibration.hand_eye_fit import FitOptions, weighted_jacobian
from grindvision.calibration.hand_eye_starts import rotation_rms
from grindvision.geometry import inverse, motion_columns, move_points, nearest_rotation, rigid, rotation_about
from grindvision.records import by_content

Floats = NDArray[np.float64]

#: A camera whose place (mm) or rotation (deg) has a larger standard deviation is of little use, and that is said.
USEFUL_MM, USEFUL_DEG = 1.5, 0.5

#: Further poses that are tried: so many at a time, turned so far (deg), with the target so far (fraction of its
#: distance) from where it was seen in the mean.
ADDED, TURNED_DEG, ASIDE = 4, 30.0, 0.25

#: Kinds of further poses that one advice names at most.
MAX_KINDS = 2


@by_content
@dataclass(frozen=True)
class Knowledge:
    """Standard deviations in the worst direction: of the camera's place, of its rotation, and of a place as far from
    the camera as the target was."""

    place_mm: float
    rotation_deg: float
    target_mm: float

    @property
    def useful(self) -> bool:
        """Whether all stay below ``USEFUL_MM`` and ``USEFUL_DEG``."""
        return self.excess <= 1

    @property
    def excess(self) -> float:
        """The largest one over what is useful."""
        return max(self.place_mm / USEFUL_MM, self.rotation_deg / USEFUL_DEG, self.target_mm / USEFUL_MM)

    def __str__(self) -> str:
        return (
            f"its place to {self.place_mm:.2g} mm, its rotation to {self.rotation_deg:.2g} deg, a point where the"
            f" target was to {self.target_mm:.2g} mm"
        )


def knowledge(found: HandEye, target_camera: Floats) -> Knowledge:
    """How well a calibration knows the camera; ``target_camera`` as ``hand_eye`` took it."""
    return _knowledge(found.covariance, found.T_parent_camera, _points(target_camera).mean(axis=0))


def poorly_known(found: HandEye, T_base_flange: Floats, target_camera: Floats) -> str:
    """In words, what is known too poorly to be of use, in which directions, and which poses would mend it; or nothing.

    Args:
        found: the calibration.
        T_base_flange: the controller's poses (N, 4, 4) that it came from, mm.
        target_camera: what the camera saw, points (N, 3) or poses (N, 4, 4).
    """
    now = knowledge(found, target_camera)
    if now.useful:
        return ""
    told = f"the camera is known poorly (one sigma): {_known_directions(found, now, target_camera)}"
    names, then = further_poses(found, T_base_flange, target_camera)
    if not names:
        return f"{told}; a few more such poses would not mend it: take many more, or a larger target"
    return f"{told}; {', and '.join(names)} would leave {then}"


def _known_directions(found: HandEye, now: Knowledge, target_camera: Floats) -> str:
    """In words, which directions are known how well, why, and how views of a thing where the target was still meet."""
    frame = "flange" if found.mounted == "on-arm" else "base"
    place, rotation = (found.covariance[part, part] for part in (slice(0, 3), slice(3, 6)))
    least_mm = float(np.sqrt(max(np.linalg.eigvalsh(place)[0], 0.0)))
    told = (
        f"its place to {now.place_mm:.2g} mm along {_axis(place)}, to {least_mm:.2g} mm along {_axis(place, 0)}, its"
        f" rotation to {now.rotation_deg:.2g} deg about {_axis(rotation)} of the {frame}, a point where the target was"
        f" to {now.target_mm:.2g} mm"
    )
    if np.ndim(target_camera) == 2:
        seen = np.asarray(target_camera, dtype=float)
        rms_mm = float(np.sqrt(((seen - seen.mean(axis=0)) ** 2).sum(axis=1).mean()))
        told += f"; the target was seen within {rms_mm:.0f} mm (rms) of one place before the camera"
    meet_mm = float(np.sqrt(np.mean(found.left_out_mm[found.fitting] ** 2)))
    return f"{told}; views of a thing there still meet within about {meet_mm:.2g} mm"


def further_poses(found: HandEye, T_base_flange: Floats, target_camera: Floats) -> tuple[list[str], Knowledge]:
    """Poses to add, in words, those that help most first, and what the camera would be known to with them."""
    carrier, target = carriers(T_base_flange, found.mounted), np.asarray(target_camera, dtype=float)
    middle = _points(target).mean(axis=0)
    sizes = None if found.errors is None else np.array(list(vars(found.errors).values())) ** 2
    options = FitOptions(found.mounted == "on-arm", sizes=sizes)

    def information(poses: Floats, seen: Floats, weights: Floats) -> Floats:
        rows = weighted_jacobian(poses, seen, found.T_parent_camera, found.target, weights, options)
        return np.asarray(rows.T @ rows)

    total = information(carrier, target, found.weights)
    scale = np.trace(found.covariance) / np.trace(_inverted(total))
    names: list[str] = []
    now = knowledge(found, target)
    tried = {
        name: information(poses, seen, np.ones(ADDED)) for name, poses, seen in _candidates(found, carrier, target)
    }
    while tried and len(names) < MAX_KINDS and not now.useful:
        outcomes = {
            name: _knowledge(scale * _inverted(total + more), found.T_parent_camera, middle)
            for name, more in tried.items()
        }
        name = min(outcomes, key=lambda one: round(outcomes[one].excess, 6))
        if outcomes[name].excess > 0.9 * now.excess:
            break
        now = outcomes[name]
        total = total + tried.pop(name)
        names.append(name)
    return names, now


def _candidates(found: HandEye, carrier: Floats, target: Floats) -> Iterator[tuple[str, Floats, Floats]]:
    """Name, carrier's poses (K, 4, 4) and what the camera would see there, of further poses."""
    frame = "flange" if found.mounted == "on-arm" else "base"
    seen = _points(target).mean(axis=0)
    mean = nearest_rotation(carrier[:, :3, :3].mean(axis=0))
    _, axes = rotation_rms(carrier)
    angle = np.radians(TURNED_DEG)
    for axis in axes:
        turned = [mean @ rotation_about(axis, sign * angle) for sign in (1, 1, -1, -1)]
        words = ", ".join(f"{value:.2f}" for value in axis)
        yield (
            f"{ADDED} more poses turned by {TURNED_DEG:.0f} deg both ways about ({words}) of the {frame}",
            *_looking(found, target, turned, np.tile(seen, (ADDED, 1))),
        )
    aside = ASIDE * np.linalg.norm(seen)
    corners = seen + aside * np.array([[1, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0]])
    depths = seen * np.array([[1 + ASIDE], [1 + ASIDE], [1 - ASIDE], [1 - ASIDE]])
    for words, places in (
        (f"{ADDED} more poses with the target {aside:.0f} mm from the middle of the view, in its corners", corners),
        (f"{ADDED} more poses with the target {aside:.0f} mm nearer and farther", depths),
    ):
        yield (words, *_looking(found, target, [mean] * ADDED, places))


def _looking(found: HandEye, target: Floats, rotations: list[Floats], places: Floats) -> tuple[Floats, Floats]:
    """Carrier's poses with these rotations that have the target at ``places`` (K, 3) of the view, and what is seen."""
    offsets = places @ found.T_parent_camera[:3, :3].T + found.T_parent_camera[:3, 3]
    poses = np.array(
        [rigid(turn, found.target[:3, 3] - turn @ offset) for turn, offset in zip(rotations, offsets, strict=True)]
    )
    return poses, places if target.ndim == 2 else inverse(poses @ found.T_parent_camera) @ found.target


def _axis(covariance: Floats, which: int = -1) -> str:
    """In words, the direction in which a covariance (3, 3) is largest, or with ``which`` 0 least."""
    direction = np.linalg.eigh(covariance)[1][:, which]
    direction = direction * np.sign(direction[np.argmax(np.abs(direction))])
    return f"({', '.join(f'{value:.2f}' for value in direction + 0.0)})"


def _points(target: Floats) -> Floats:
    return target if np.ndim(target) == 2 else np.asarray(target)[:, :3, 3]


def _inverted(information: Floats) -> Floats:
    return np.asarray(np.linalg.pinv(information, hermitian=True)[:6, :6])


def _knowledge(covariance: Floats, T_parent_camera: Floats, place: Floats) -> Knowledge:
    lever = move_points(T_parent_camera, place) - T_parent_camera[:3, 3]
    at_target = motion_columns(lever)
    parts = (covariance[:3, :3], covariance[3:, 3:], at_target @ covariance @ at_target.T)
    place_mm, rotation_rad, target_mm = (float(np.sqrt(max(np.linalg.eigvalsh(part)[-1], 0.0))) for part in parts)
    return Knowledge(place_mm, float(np.degrees(rotation_rad)), target_mm)
