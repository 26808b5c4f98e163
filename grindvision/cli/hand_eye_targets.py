"""What ``grindvision hand-eye`` looks at: the target found in every cloud, as points or poses in the camera's frame."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import TYPE_CHECKING, Any, TypeVar

from grindvision.errors import DegenerateError, GrindvisionWarning, InputError
from grindvision.records import by_content

if TYPE_CHECKING:
    import numpy as np

    from grindvision.calibration.pose_conventions import PoseConvention

Found = TypeVar("Found")

#: Kinds of ``--target`` that have sizes, and how many.
KINDS = {"sphere": 1, "spheres": 1, "board": 2}

#: Sizes of targets stay below (mm), and so many views must show one.
LARGEST_MM, FEWEST_FOUND = 2000.0, 3

#: Views up to which every pair is registered; of more, each with so many others that are turned least against it.
ALL_PAIRS, NEAREST = 12, 6


@by_content
@dataclass(frozen=True)
class TargetSeen:
    """The target in the camera's frame, points (M, 3) or poses (M, 4, 4), at the poses ``rows`` (M,) that show it;
    ``readings`` are other ways to read a table of its poses, in words and as poses."""

    target: np.ndarray
    rows: np.ndarray
    results: dict[str, Any] = field(default_factory=dict)
    told: str = ""
    readings: tuple[tuple[str, np.ndarray], ...] = ()


def read_target(text: str) -> tuple[str, tuple[float, ...]]:
    """Kind and sizes of ``--target``: a diameter, or two sides.

    Raises:
        InputError: none of ``KINDS``, or without its sizes.
    """
    kind, _, said = text.partition(":")
    if text in ("part", "poses"):
        return kind, ()
    try:
        sizes = tuple(float(word) for word in said.split("x"))
    except ValueError:
        sizes = ()
    if KINDS.get(kind) != len(sizes) or not all(0 < size < LARGEST_MM for size in sizes):
        raise InputError(
            f"--target {text}: say sphere:DIAMETER_MM, as in sphere:38.1, spheres:DIAMETER_MM for three of them,"
            " board:LENGTHxWIDTH_MM for a plate, as in board:200x150, or part, or poses"
        )
    return kind, sizes


def see_target(
    kind: str,
    sizes: tuple[float, ...],
    clouds: Sequence[np.ndarray],
    names: Sequence[str],
    poses: np.ndarray | None,
    seed: int,
) -> TargetSeen:
    """Find the target in clouds (M_i, 3), mm; ``poses`` (N, 4, 4) of the arm, where known, say which views are alike.

    Raises:
        DegenerateError: it is not there, or leaves its pose open.
    """
    if kind == "sphere":
        return _sphere(sizes[0], clouds, names, seed)
    if kind == "spheres":
        return _three_spheres(sizes[0], clouds, names, seed)
    if kind == "board":
        return _plate((sizes[0], sizes[1]), clouds, names, poses, seed)
    return _part(clouds, names, poses, seed)


def given_poses(path: str, rotation: str | None, angles: str | None, unit: str | None, count: int) -> TargetSeen:
    """Poses T_camera_target (N, 4, 4) that another tool measured, from a table like that of the controller's poses.

    Raises:
        InputError: no ``rotation``; other than ``count`` rows; a row twice. FileError: see ``read_pose_rows``.
    """
    import numpy as np

    from grindvision.calibration.hand_eye_checks import check_repeated
    from grindvision.calibration.pose_conventions import convention, other_conventions, poses_from, read_pose_rows

    if rotation is None:
        raise InputError("--target poses: say --target-rotation, how the rotation in the second table is written")
    rows = read_pose_rows(path)
    if len(rows) != count:
        raise InputError(f"{count} poses of the controller and {len(rows)} of the target; a row each, in their order")
    check_repeated(list(rows), [f"row {row + 1} of {path}" for row in range(count)])
    stated = convention(rotation, angles, unit or "mm")
    readings = tuple(
        (_target_words(other), poses_from(rows, other))
        for other in other_conventions(stated, rows)
        if not (other.rotation_first or other.inverted)
    )
    return TargetSeen(poses_from(rows, stated, path), np.arange(count), readings=readings)


def _target_words(reading: PoseConvention) -> str:
    words = str(reading)
    for option, of_target in (
        ("rotation", "target-rotation"),
        ("angles", "target-angles"),
        ("pose-unit", "target-unit"),
    ):
        words = words.replace(f"--{option} ", f"--{of_target} ")
    return words


def _sphere(diameter: float, clouds: Sequence[np.ndarray], names: Sequence[str], seed: int) -> TargetSeen:
    import numpy as np

    from grindvision.calibration.sphere_search import cut_out_sphere, doubt_diameter, own_diameter

    streams = np.random.default_rng(seed).spawn(len(clouds))
    fits = [
        cut_out_sphere(points, diameter, rng, name) for points, rng, name in zip(clouds, streams, names, strict=True)
    ]
    doubt = doubt_diameter([own_diameter(points, fit) for points, fit in zip(clouds, fits, strict=True)], diameter)
    if doubt:
        warnings.warn(doubt, GrindvisionWarning, stacklevel=2)
    sigmas = np.array([np.sqrt(np.linalg.eigvalsh(fit.centre_covariance)[-1]) for fit in fits])
    centres = np.array([fit.centre_mm for fit in fits])
    told = f"the camera knows a centre to +- {np.median(sigmas):.2g} mm in the median; what is left beyond is the arm's"
    return TargetSeen(centres, np.arange(len(clouds)), {"camera_sigma_of_centre_mm": sigmas}, told)


def _three_spheres(diameter: float, clouds: Sequence[np.ndarray], names: Sequence[str], seed: int) -> TargetSeen:
    import numpy as np

    from grindvision.calibration.sphere_search import doubt_diameter
    from grindvision.calibration.sphere_triple import find_three_spheres, poses_of_triples

    found, rows = _where_found(
        lambda row, rng: find_three_spheres(clouds[row], diameter, rng, names[row]), len(clouds), seed
    )
    doubt = doubt_diameter([one for _, own in found for one in own], diameter)
    if doubt:
        warnings.warn(doubt, GrindvisionWarning, stacklevel=2)
    centres = np.array([three for three, _ in found])
    return TargetSeen(poses_of_triples(centres, [names[row] for row in rows]), np.array(rows))


def _plate(
    sides: tuple[float, float], clouds: Sequence[np.ndarray], names: Sequence[str], poses: np.ndarray | None, seed: int
) -> TargetSeen:
    import numpy as np

    from grindvision.calibration.plate_search import find_plate
    from grindvision.calibration.plate_symmetry import fold_of, resolve, upright

    found, rows = _where_found(lambda row, rng: find_plate(clouds[row], sides, rng, names[row]), len(clouds), seed)
    plates, fold = np.array(found), fold_of(sides)
    if poses is None:
        return TargetSeen(upright(plates, fold), np.array(rows))
    seen = resolve(poses[rows], plates, fold, [names[row] for row in rows])
    told = f"the plate looks alike {fold} ways round; which way each view shows it follows from the arm's turns"
    return TargetSeen(seen, np.array(rows), {"ways_round": fold}, told)


def _where_found(
    find: Callable[[int, np.random.Generator], Found], count: int, seed: int
) -> tuple[list[Found], list[int]]:
    """What ``find`` finds in each view, and in which views; those that show nothing are left out with a warning.

    Raises:
        DegenerateError: of the first view that shows nothing, where more than half of all do.
    """
    import numpy as np

    found, rows, refused = [], [], []
    for row, rng in enumerate(np.random.default_rng(seed).spawn(count)):
        try:
            found.append(find(row, rng))
            rows.append(row)
        except DegenerateError as refusal:
            refused.append(refusal)
            most = count - len(refused)
            if 2 * most < count or most < FEWEST_FOUND:  # whatever the views show that are left
                raise refused[0] from None
    for reason in refused:
        warnings.warn(f"left out: {reason}", GrindvisionWarning, stacklevel=2)
    return found, rows


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
        from grindvision.calibration.hand_eye_checks import rotations_between

        apart = rotations_between(poses)
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
