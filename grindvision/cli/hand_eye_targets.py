"""What ``grindvision hand-eye`` looks at: the target found in every cloud, as points or poses in the camera's frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import TYPE_CHECKING, Any

from grindvision.errors import InputError
from grindvision.records import by_content

if TYPE_CHECKING:
    import numpy as np

#: Views up to which every pair is registered; of more, each with so many others that are turned least against it.
ALL_PAIRS, NEAREST = 12, 6


@by_content
@dataclass(frozen=True)
class TargetSeen:
    """The target in the camera's frame, points (M, 3) or poses (M, 4, 4), at the poses ``rows`` (M,) that show it."""

    target: np.ndarray
    rows: np.ndarray
    results: dict[str, Any] = field(default_factory=dict)
    told: str = ""


def read_target(text: str) -> tuple[str, float]:
    """Kind and size of ``--target``.

    Raises:
        InputError: neither a sphere with its diameter, nor the part, nor poses.
    """
    kind, _, size = text.partition(":")
    if text in ("part", "poses"):
        return kind, 0.0
    try:
        diameter = float(size)
    except ValueError:
        diameter = 0.0
    if kind != "sphere" or not 0 < diameter < 1000:
        raise InputError(f"--target {text}: say sphere:DIAMETER_MM, as in sphere:38.1, or part, or poses")
    return kind, diameter


def see_target(
    kind: str, size: float, clouds: Sequence[np.ndarray], names: Sequence[str], poses: np.ndarray | None, seed: int
) -> TargetSeen:
    """Find the target in clouds (M_i, 3), mm; ``poses`` (N, 4, 4) of the arm, where known, say which views are alike.

    Raises:
        DegenerateError: it is not there, or leaves its pose open.
    """
    if kind == "sphere":
        return _sphere(size, clouds, names, seed)
    return _part(clouds, names, poses, seed)


def given_poses(path: str, rotation: str | None, angles: str | None, unit: str | None, count: int) -> TargetSeen:
    """Poses T_camera_target (N, 4, 4) that another tool measured, from a table like that of the controller's poses.

    Raises:
        InputError: no file or no ``rotation``; other than ``count`` rows. FileError: see ``read_pose_rows``.
    """
    import numpy as np

    from grindvision.calibration.pose_conventions import convention, poses_from, read_pose_rows

    if rotation is None:
        raise InputError("--target poses: say --target-rotation, how the rotation in the second table is written")
    rows = read_pose_rows(path)
    if len(rows) != count:
        raise InputError(f"{count} poses of the controller and {len(rows)} of the target; a row each, in their order")
    return TargetSeen(poses_from(rows, convention(rotation, angles, unit or "mm"), path), np.arange(count))


def _sphere(diameter: float, clouds: Sequence[np.ndarray], names: Sequence[str], seed: int) -> TargetSeen:
    import numpy as np

    from grindvision.calibration.sphere_search import cut_out_sphere

    streams = np.random.default_rng(seed).spawn(len(clouds))
    fits = [
        cut_out_sphere(points, diameter, rng, name) for points, rng, name in zip(clouds, streams, names, strict=True)
    ]
    sigmas = np.array([np.sqrt(np.linalg.eigvalsh(fit.centre_covariance)[-1]) for fit in fits])
    centres = np.array([fit.centre_mm for fit in fits])
    return TargetSeen(centres, np.arange(len(clouds)), {"camera_sigma_of_centre_mm": sigmas})


def _part(clouds: Sequence[np.ndarray], names: Sequence[str], poses: np.ndarray | None, seed: int) -> TargetSeen:
    import numpy as np

    from grindvision.geometry import inverse
    from grindvision.vision.registration.views import register_views

    found = register_views(clouds, names, pairs_of_views(len(clouds), poses), seed)
    results = {
        "pairs_registered": len(found.pairs),
        "pairs_refused": {f"{a + 1} {b + 1}": reason for (a, b), reason in found.refused.items()},
        "pairs_disagreement_mm": float(np.median(found.disagreement_mm)),
    }
    return TargetSeen(inverse(found.T_part_view[found.found]), found.found, results, str(found))


def pairs_of_views(count: int, poses: np.ndarray | None) -> list[tuple[int, int]]:
    """Pairs of views to register, most alike first: all of few, of many those turned least against each other."""
    import numpy as np

    pairs = list(combinations(range(count), 2))
    if poses is None:
        apart = np.array([float(b - a) for a, b in pairs])
    else:
        from grindvision.calibration.hand_eye_checks import turns_between

        apart = turns_between(poses)
    order = np.argsort(np.round(apart, 9), kind="stable")
    pairs = [pairs[at] for at in order]
    if count <= ALL_PAIRS:
        return pairs
    taken = [0] * count
    chosen = []
    for a, b in pairs:
        if min(taken[a], taken[b]) < NEAREST or b == a + 1:
            chosen.append((a, b))
            taken[a] += 1
            taken[b] += 1
    return chosen
