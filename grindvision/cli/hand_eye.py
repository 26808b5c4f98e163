"""``grindvision hand-eye``: clouds and the controller's poses in, where the camera sits out."""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from grindvision.cli.camera_pose import DOUBT, add_convention_arguments, camera_content, stated_convention
from grindvision.cli.hand_eye_targets import TargetSeen, given_poses, read_target, see_target
from grindvision.cli.parameters import number
from grindvision.cli.report import Run, add_output_arguments
from grindvision.cli.scans import CLOUD_FORMATS, add_unit_argument, read_scans
from grindvision.errors import GrindvisionWarning, InputError

if TYPE_CHECKING:
    import numpy as np

    from grindvision.calibration.hand_eye import HandEye
    from grindvision.calibration.pose_conventions import PoseConvention

#: From this probability on it is said that poses near each other share errors of the arm.
LIKELY = 0.9

EPILOG = """\
POSES holds a line for every cloud, in their order: the flange's (or one tool's) pose in the base frame as the
controller shows it, x y z and the rotation. Say how the rotation is written: by the maker (ur, ur-rpy, abb, kuka,
fanuc, yaskawa, staubli, doosan) or as rotation-vector, quaternion-wxyz, quaternion-xyzw, matrix, or Euler axes: ZYX
about axes that move along, zyx about fixed ones. Left out, the command says what fits and asks.

The target rests while the arm carries the camera (--mounted on-arm), or sits on the flange in front of a fixed camera
(--mounted fixed: crop away what does not move with the flange). Turn the arm by 20 deg and more about two axes, and let
a sphere appear all over the view. A part (--target part) needs no measure and no mark: its views are registered to each
other. Flat, round and symmetric parts are refused, with the motion that they leave free. Three spheres and a plate give
the whole pose in every view; which way round a plate lies, the arm's turns say. A camera that is known worse than
1.5 mm or 0.5 deg is written with a warning: what is not known, and which further poses would mend it.

results in DIR:
  hand_eye.json    T_flange_camera (T_base_camera when fixed), 4x4, mm, T_a_b @ p_b = p_a; covariance, convention
  poses.csv        for every pose: where it puts the target, its error, its error when it took no part
  report.png       did it work? errors of the poses
  report.json      the numbers, timings, versions, parameters; written last

the arm itself: one sphere at rest in many poses also calibrates it, without a tracker: `grindvision calibrate` with
the joint angles, the centres as sx_mm, sy_mm, sz_mm and the sphere's name in column socket; what such data cannot know
keeps its prior and is said.

exit code: 0 done, 3 done, but the camera is not known to --require-mm or --require-deg, 2 the input cannot be used (one
line says why), 1 anything else

example:
  grindvision hand-eye poses.txt view*.ply --rotation ur --pose-unit m --target sphere:38.1 -o camera
  grindvision hand-eye poses.txt view*.ply --rotation kuka --target part -o camera
  grindvision hand-eye poses.txt view*.ply --rotation fanuc --target board:200x150 --mounted fixed -o camera
  grindvision hand-eye poses.txt board.txt --rotation abb --target poses --target-rotation rotation-vector -o camera
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.formatter_class, parser.epilog = argparse.RawDescriptionHelpFormatter, EPILOG
    data = parser.add_argument_group("poses and clouds")
    data.add_argument("poses", metavar="POSES", help="table of controller poses, a row for every cloud")
    data.add_argument("clouds", nargs="+", metavar="CLOUD", help=f"clouds in the camera's frame ({CLOUD_FORMATS})")
    add_unit_argument(data)
    data.add_argument(
        "--target",
        required=True,
        metavar="sphere:DIAMETER_MM|spheres:DIAMETER_MM|board:LENGTHxWIDTH_MM|part|poses",
        help="what rests: a sphere, by its diameter; three spheres of one diameter at different distances; a"
        " rectangular plate, by its sides; the part itself, any shape that leaves no motion free; or poses: in the"
        " place of clouds one table of T_camera_target that another tool measured (A X = B Z)",
    )
    data.add_argument(
        "--mounted", choices=("on-arm", "fixed"), default="on-arm", help="where the camera is (default on-arm)"
    )
    how = parser.add_argument_group("how the poses are written")
    add_convention_arguments(how)
    how.add_argument("--target-rotation", metavar="NAME", help="the same of the target's poses, with --target poses")
    how.add_argument("--target-angles", choices=("deg", "rad"), help="unit of their Euler angles")
    how.add_argument("--target-unit", choices=("mm", "m"), help="unit of their positions (default mm)")
    parser.add_argument("--seed", type=int, default=0, help="of the random draws (default 0)")
    parser.add_argument(
        "--require-mm",
        type=number,
        metavar="MM",
        help="end with exit code 3 unless the camera's place, and a point where the target was, are known to this"
        " standard deviation in every direction",
    )
    parser.add_argument(
        "--require-deg", type=number, metavar="DEG", help="the same of the camera's rotation about every axis"
    )
    add_output_arguments(parser)


def run(options: argparse.Namespace) -> int:
    """Run it."""
    kind, sizes = read_target(options.target)
    for option, least in (("--require-mm", options.require_mm), ("--require-deg", options.require_deg)):
        if least is not None and not 0 < least < 1e6:
            raise InputError(f"{option} is {least}; give a standard deviation above zero")
    from grindvision.calibration.hand_eye import FEWEST_POINTS, FEWEST_POSES, HandEyeOptions, hand_eye
    from grindvision.calibration.hand_eye_advice import poorly_known
    from grindvision.calibration.hand_eye_checks import (
        check_pose_rows,
        outliers,
        refuse_better_reading,
        refuse_implausible,
    )
    from grindvision.calibration.pose_conventions import poses_from, read_pose_rows
    from grindvision.cli.pictures import drawing

    rows = read_pose_rows(options.poses)
    stated = stated_convention(options)
    given = _given(kind, options, len(rows))
    views = len(options.clouds) if given is None else len(rows)
    _check_counts(len(rows), views, FEWEST_POINTS if kind == "sphere" else FEWEST_POSES, kind)
    draw = drawing("hand_eye_picture")
    with Run(options, ("poses", "clouds"), ("numpy", "scipy", "numba", "matplotlib"), 4) as work:
        poses = None if stated is None else poses_from(rows, stated, options.poses)
        with work.stage("read"):
            clouds = _read(options) if given is None else []
        with work.stage("target"):
            seen = given or see_target(kind, sizes, clouds, options.clouds, poses, options.seed)
        labels = options.clouds if given is None else [f"row {row + 1}" for row in range(len(rows))]
        rows, names = rows[seen.rows], [labels[row] for row in seen.rows]
        if stated is None or poses is None:
            raise InputError(_suggestion(rows, seen.target, options))
        poses = poses[seen.rows]
        with work.stage("solve"):
            refuse_better_reading(
                rows, stated, seen.target, options.mounted, [Path(name).name for name in names], seen.readings
            )
            found = hand_eye(poses, seen.target, HandEyeOptions(options.mounted))
            repeated = check_pose_rows(poses)
            refuse_implausible(found, repeated)
            doubt = poorly_known(found, poses, seen.target)
            lacking = _lacking(found, seen.target, options)
        for text in [*repeated, *outliers(found, names), *filter(None, [doubt, lacking])]:
            warnings.warn(text, GrindvisionWarning, stacklevel=1)
        with work.stage("write"):
            _write(found, stated, names, doubt, work.place)
            draw(found, names, work.warnings, work.place / "report.png")
        told = "\n".join(filter(None, [seen.told, *_told_errors(found)]))
        work.report(
            str(found), _results(found, seen), {"convention": str(stated)}, shown=told, questions=[_where(found)]
        )
    return 3 if lacking else 0


def _lacking(found: HandEye, target: np.ndarray, options: argparse.Namespace) -> str:
    """In words, what is known less well than ``--require-mm`` and ``--require-deg`` ask for; empty where nothing is."""
    from grindvision.calibration.hand_eye_advice import knowledge

    known = knowledge(found, target)
    asked = (
        (known.place_mm, options.require_mm, "the camera's place", "mm"),
        (known.target_mm, options.require_mm, "a point where the target was", "mm"),
        (known.rotation_deg, options.require_deg, "the camera's rotation", "deg"),
    )
    told = [
        f"{what} is known to {sigma:.2g} {unit}, not to {least:g} (--require-{unit})"
        for sigma, least, what, unit in asked
        if least is not None and not sigma <= least
    ]
    return "; ".join(told)


def _told_errors(found: HandEye) -> list[str]:
    """In words, the errors of arm and camera, and whether poses near each other share them."""
    if found.errors is None:
        return []
    shared = (
        f"poses near each other share errors of the arm (probability {found.shared_errors:.2f}), as wrong lengths and"
        " zeros make them: more poses alike do not average them out"
    )
    return [str(found.errors), *([shared] if found.shared_errors > LIKELY else [])]


def _given(kind: str, options: argparse.Namespace, count: int) -> TargetSeen | None:
    """The target's poses from their table with ``--target poses``; None for clouds."""
    told = (options.target_rotation, options.target_angles, options.target_unit)
    if kind == "poses":
        if len(options.clouds) != 1:
            raise InputError(f"--target poses takes one table in the place of clouds, not {len(options.clouds)} files")
        return given_poses(options.clouds[0], *told, count)
    if any(word is not None for word in told):
        raise InputError("--target-rotation, --target-angles and --target-unit are for --target poses; leave them out")
    return None


def _check_counts(poses: int, clouds: int, fewest: int, kind: str) -> None:
    if poses != clouds:
        raise InputError(f"{poses} poses and {clouds} clouds; every cloud needs its pose, a row each, in their order")
    if poses < fewest:
        what = "pairs of poses" if kind == "poses" else f"a {kind}"
        raise InputError(
            f"{poses} poses; hand-eye from {what} needs at least {fewest} turned about two axes, 8 or more to find a"
            " wrong one"
        )


def _read(options: argparse.Namespace) -> list[np.ndarray]:
    from grindvision.calibration.hand_eye_checks import check_repeated
    from grindvision.clouds import finite_points

    clouds = read_scans(options.clouds, options.unit)
    points = [finite_points(cloud, path) for cloud, path in zip(clouds, options.clouds, strict=True)]
    check_repeated(points, options.clouds)
    return points


def _suggestion(rows: np.ndarray, target: np.ndarray, options: argparse.Namespace) -> str:
    """Asks for ``--rotation``, with the conventions that fit best."""
    from grindvision.calibration.hand_eye_checks import rank_conventions
    from grindvision.calibration.pose_conventions import COMMON, COUNTS, PoseConvention, makers_of, other_conventions

    first = PoseConvention(COMMON[COUNTS[rows.shape[1]]][0])
    tried = [first, *other_conventions(first, rows)]
    ranked = rank_conventions(rows, target, options.mounted, iter(tried))[:2]
    if not ranked:
        return "--rotation is missing: say how the poses are written; `grindvision hand-eye --help` lists the names"
    told = "; ".join(f"{other}{makers_of(other)} leaves {size:.3g} mm rms" for size, other in ranked)
    return f"--rotation is missing: say how the poses are written. Best by the data: {told}"


def _write(found: HandEye, stated: PoseConvention, names: Sequence[str], doubt: str, place: Path) -> None:
    import numpy as np

    from grindvision.files import write_json, write_text

    other = "base" if found.mounted == "on-arm" else "flange"
    turns = bool(np.isfinite(found.residuals_rad).all())
    content = {
        **camera_content(found.T_parent_camera, found.mounted, stated),
        f"target_{other}_mm": found.target[:3, 3],
        **({f"T_{other}_target": found.target} if turns else {}),
        "covariance": found.covariance,
        "rms_mm": found.rms_mm,
        **({DOUBT: doubt} if doubt else {}),
    }
    write_json(place / "hand_eye.json", content)
    lines = [f"pose,cloud,x_{other}_mm,y_{other}_mm,z_{other}_mm,error_mm,left_out_mm,weight"]
    sizes = np.linalg.norm(found.residuals_mm, axis=1)
    for row, name in enumerate(names):
        x, y, z = found.target[:3, 3] + found.residuals_mm[row]
        safe = Path(name).name.replace('"', '""')
        lines.append(
            f'{row + 1},"{safe}",{x:.4f},{y:.4f},{z:.4f},{sizes[row]:.4f},{found.left_out_mm[row]:.4f},'
            f"{found.weights[row]:.4f}"
        )
    write_text(place / "poses.csv", "\n".join(lines) + "\n")


def _results(found: HandEye, seen: TargetSeen) -> dict[str, Any]:
    from dataclasses import asdict

    import numpy as np

    from grindvision.calibration.hand_eye_advice import knowledge

    return {
        "rms_mm": found.rms_mm,
        "left_out_mm": found.left_out_mm,
        **seen.results,
        "motions_deg": found.rotation_rms_deg,
        "sigma_mm": found.sigma_mm,
        "sigma_deg": found.sigma_deg,
        "known_to": asdict(knowledge(found, seen.target)),
        "errors": None if found.errors is None else asdict(found.errors),
        "shared_errors": found.shared_errors if np.isfinite(found.shared_errors) else None,
    }


def _where(found: HandEye) -> str:
    x, y, z, a, b, c = *found.T_parent_camera[:3, 3], *found.T_parent_camera[:3, 2]
    frame = "flange" if found.mounted == "on-arm" else "base"
    return (
        f"camera at ({x:.1f}, {y:.1f}, {z:.1f}) mm in the {frame} frame, looking along ({a:.2f}, {b:.2f}, {c:.2f}): is"
        " that where it sits?"
    )
