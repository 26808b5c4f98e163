"""``grindvision merge``: views and the controller's poses in, one cloud in the base frame out, and how they meet."""

from __future__ import annotations

import argparse
import warnings
from pathlib import Path

from grindvision.cli.camera_pose import add_convention_arguments, flange_poses, read_camera, stated_convention
from grindvision.cli.facing import FACES_CAMERA
from grindvision.cli.report import Run, add_output_arguments
from grindvision.cli.scans import CLOUD_FORMATS, add_unit_argument, read_scans, size_question
from grindvision.errors import GrindvisionWarning, InputError

EPILOG = """\
POSES and CLOUDs as for `grindvision hand-eye`: a row for every cloud, in their order. Views of a camera on the arm are
joined in the robot's base frame, those of a fixed camera in the frame of the flange that holds the part. How they meet
there says how good arm and hand-eye are. Then the views are fitted to each other, where their surfaces overlap, and all
together stay where the arm puts them in the mean: say --as-posed to leave them where the poses put them.

results in DIR:
  merged.ply       all points in one frame, for detect and groove: they take --scanner-pose with the identity, and
                   groove --base controller where it has a --robot; with normals turned to the camera of each view, by
                   which detect and grind tell the side, and groove where nothing else does
  report.png       did it work? the views, a colour each, and how far each pair is apart where it overlaps
  report.json      meeting_mm: by the poses, the median, every pair, the worst one; fitted_mm: after the views were
                   fitted to each other; timings, versions, parameters; written last

exit code: 0 done, 2 the input cannot be used (one line says why), 1 anything else

example:
  grindvision merge poses.txt view*.ply --hand-eye camera/hand_eye.json -o part
"""

#: A pair that meets so many times worse than all do, and worse than so much (mm), is worth a word.
MUCH_WORSE, WORTH_MM = 3.0, 0.5


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.formatter_class, parser.epilog = argparse.RawDescriptionHelpFormatter, EPILOG
    data = parser.add_argument_group("poses and clouds")
    data.add_argument("poses", metavar="POSES", help="table of controller poses, a row for every cloud")
    data.add_argument("clouds", nargs="+", metavar="CLOUD", help=f"clouds in the camera's frame ({CLOUD_FORMATS})")
    data.add_argument("--hand-eye", required=True, metavar="FILE.json", help="hand_eye.json of `grindvision hand-eye`")
    add_unit_argument(data)
    how = parser.add_argument_group("how the poses are written")
    add_convention_arguments(how, " of `grindvision hand-eye --help` (default: as in the calibration)")
    parser.add_argument(
        "--as-posed",
        action="store_true",
        help="leave the views where poses and hand-eye put them; else they are fitted to each other",
    )
    add_output_arguments(parser)


def run(options: argparse.Namespace) -> int:
    """Run it."""
    import numpy as np

    from grindvision.calibration.hand_eye_checks import check_pose_rows, check_repeated
    from grindvision.calibration.pose_conventions import read_pose_rows
    from grindvision.cli.pictures import drawing
    from grindvision.clouds import finite_points, write_ply
    from grindvision.geometry import rotate_vectors
    from grindvision.vision.registration.meeting import merge
    from grindvision.vision.registration.view_fit import fit_views, view_normals

    camera = read_camera(options.hand_eye)
    stated = stated_convention(options, camera.convention)
    if stated is None:
        raise InputError(
            "--rotation is missing: say how the poses are written; `grindvision hand-eye --help` lists names"
        )
    flange = flange_poses(read_pose_rows(options.poses), stated, options.poses)
    if len(flange) != len(options.clouds) or len(flange) < 2:
        raise InputError(
            f"{len(flange)} poses and {len(options.clouds)} clouds; give two clouds at least, and a pose for each"
        )
    draw = drawing("merge_picture")
    frame = "base" if camera.mounted == "on-arm" else "flange"
    with Run(options, ("poses", "clouds"), ("numpy", "scipy", "numba", "matplotlib"), 5) as work:
        with work.stage("read"):
            clouds = read_scans(options.clouds, options.unit)
            views = [finite_points(cloud, path) for cloud, path in zip(clouds, options.clouds, strict=True)]
            check_repeated(views, options.clouds)
        poses = camera.poses(flange)
        with work.stage("meet"):
            meeting = merge(views, poses)
        with work.stage("fit"):
            fitted = None if options.as_posed else fit_views(views, poses, meeting)
        placed = poses if fitted is None else fitted.T_common_view
        points = meeting.points if fitted is None else fitted.meeting.points
        first, second = meeting.worst
        worst_mm = float(meeting.pair_mm[first, second])
        names = [Path(name).name for name in options.clouds]
        worst = f"the worst pair, {names[first]} and {names[second]}, within {worst_mm:.2f} mm"
        findings = [f"{options.clouds[row]} overlaps no other view" for row in meeting.alone]
        if worst_mm > max(MUCH_WORSE * meeting.overall_mm, WORTH_MM):
            findings.append(f"{worst}, far more than the others: wrong pose, or did the part move?")
        for text in [*check_pose_rows(flange), *findings]:
            warnings.warn(text, GrindvisionWarning, stacklevel=1)
        with work.stage("write"):
            normals = [rotate_vectors(pose, view_normals(view)) for pose, view in zip(placed, views, strict=True)]
            write_ply(work.place / "merged.ply", points, np.vstack(normals), FACES_CAMERA)
        with work.stage("picture"):
            joined = np.split(points, np.cumsum([len(view) for view in views])[:-1])
            draw(meeting, joined, frame, worst, work.warnings, work.place / "report.png")
        results = {
            "frame": frame,
            "points": sum(len(view) for view in views),
            "meeting_mm": {
                "median": meeting.overall_mm,
                "pairs": meeting.median_mm,
                "worst": {"clouds": [options.clouds[first], options.clouds[second]], "median": worst_mm},
            },
            "fitted_mm": None if fitted is None else {"median": fitted.meeting.overall_mm, "moved": fitted.moved_mm},
            f"T_{frame}_camera": placed,
        }
        message = f"{meeting}; {worst}" + ("" if fitted is None else f"; {fitted}")
        question = size_question([f"CLOUD 1 of {len(views)}"], clouds[:1])
        work.report(message, results, {"convention": str(stated), "frame": frame}, questions=[question])
    return 0
