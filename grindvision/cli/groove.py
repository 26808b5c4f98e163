"""``grindvision groove``: a scan in, the weld seams and the torch's trajectory out."""

from __future__ import annotations

import argparse
import warnings
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from grindvision.cli.camera_pose import where_it_stood
from grindvision.cli.parameters import check_count, number, whole
from grindvision.cli.report import Run, add_output_arguments
from grindvision.cli.robot_job import (
    PROGRAM_FILES,
    RobotJob,
    add_robot_arguments,
    motion_facts,
    robot_job,
    send_if_agreed,
)
from grindvision.cli.scans import (
    CLOUD_FORMATS,
    add_field_argument,
    add_mirrored_argument,
    add_unit_argument,
    add_viewpoint_argument,
    corrected,
    diagnose_pose,
    read_correction,
    read_scans,
    rows_text,
    size_question,
)
from grindvision.errors import GrindvisionWarning, InputError
from grindvision.vision.seam.joint_names import FAMILIES, KINDS

if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np

    from grindvision.cli.weld_job import WeldRuns
    from grindvision.motion.plan import Motion
    from grindvision.motion.trajectory import Trajectory
    from grindvision.vision.seam.joints import Seam
    from grindvision.vision.seam.seam_path import SeamPath
    from grindvision.vision.seam.weld import TraceWeldOptions, Weld

#: How ``trace_weld`` begins what it says where it had to assume a side.
SIDE_ASSUMED = "nothing tells from which side"

#: Length along the seam over which the torch's frame averages what single normals say, mm.
STEADY_MM = 8.0

COLUMNS = "waypoint,x_mm,y_mm,z_mm,nx,ny,nz,roll_rad,pitch_rad,yaw_rad"

EPILOG = """\
results in DIR:
  trajectory.csv   way points along the first seam's root, outward normals, and the torch's roll, pitch, yaw
                   (R = Rz(yaw) Ry(pitch) Rx(roll); tool z into the work, x along the seam), frame of CLOUD
  trajectory_2.csv, ...  further seams: grooves, smaller after larger, then corners, the longest first
  labels.npy       bool, one per point of CLOUD in its order: does it belong to a seam?
  program.*        with --robot: the motion for the controller, a dry run
  prog_arc.*       with --arc: the same motion as a hot run, which sets the named outputs
  pass1.*, ...     with --bead-area: a programme for each pass, in the place of program.*; hot: arc1.*, ...
  tacks.*          with --tacks: the tack welds; hot: tack_arc.*
  report.png       did it work? the groove and the path on the cloud, the path's course
  report.json      kinds of seams with the evidence, sizes, timings, versions, parameters; written last

exit code: 0 done, 2 the input cannot be used or shows no seam (one line says why), 1 anything else

examples:
  grindvision groove plate.pcd -o weld --unit m
  grindvision groove plate.ply -o weld --waypoints 80 --width 12
  grindvision groove bracket.ply -o weld --joint fillet
  grindvision groove plate.ply -o weld --field-correction camera/field.npz
  grindvision groove plate.ply -o weld --robot ur3 --program urscript --scanner-pose pose.json --base controller
  grindvision groove plate.ply -o weld --robot kr6_r900 --program krl --scanner-pose pose.json --tool torch.json \\
      --travel-angle -10 --arc --arc-output 5
  grindvision groove plate.ply -o weld --robot gp12 --program jbi --scanner-pose pose.json --base controller \\
      --weave 4 --weave-frequency 2 --bead-area 12 --tacks 5 --run-on 10 --run-off 10
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.formatter_class, parser.epilog = argparse.RawDescriptionHelpFormatter, EPILOG
    scan = parser.add_argument_group("scan")
    scan.add_argument("cloud", metavar="CLOUD", help=f"scan of the workpiece ({CLOUD_FORMATS})")
    add_unit_argument(scan)
    add_viewpoint_argument(scan, "--viewpoint", "CLOUD")
    add_mirrored_argument(scan, "CLOUD")
    add_field_argument(scan)
    groove = parser.add_argument_group("seam and path")
    groove.add_argument("--waypoints", type=whole, default=50, metavar="N", help="along each seam (default: 50)")
    groove.add_argument(
        "--width",
        type=number,
        metavar="MM",
        help="rough width of the groove, for faint or unusual ones (default from the data: what stands out most)",
    )
    groove.add_argument(
        "--joint",
        choices=(*FAMILIES, *KINDS),
        default="any",
        metavar="KIND",
        help=f"look for one kind of seam or a family of kinds: {', '.join((*FAMILIES, *KINDS))} (default: any, the"
        " surest that is there)",
    )
    groove.add_argument(
        "--variant",
        choices=("ours", "paper"),
        default="ours",
        help="ours, or the second paper's method, which follows one groove (default: ours)",
    )
    torch = parser.add_argument_group("torch")
    for name, text in (
        ("--work-angle", "lean to one side of the seam, about the seam's direction"),
        ("--travel-angle", "lean along the seam: above 0 the wire points forward (push), below 0 back (drag)"),
    ):
        torch.add_argument(name, type=number, metavar="DEG", help=f"{text} (default: 0)")
    torch.add_argument(
        "--max-turning",
        type=number,
        metavar="DEG_S",
        help="steady the torch along the seam until it turns no faster than this at --torch-speed (default: steadied"
        f" over {STEADY_MM:g} mm)",
    )
    add_robot_arguments(parser)
    add_output_arguments(parser)


def run(options: argparse.Namespace) -> int:
    """Run it."""
    check_count("--waypoints", options.waypoints, 2, 100_000)
    if options.width is not None and not (options.width > 0 and options.variant == "ours"):
        raise InputError(f"--width is {options.width:g} mm; give a width above 0, and leave --variant at ours")

    if options.joint != "any" and options.variant != "ours":
        raise InputError(f"--joint {options.joint} is for --variant ours; the paper's method knows grooves only")

    for name, angle in (("--work-angle", options.work_angle), ("--travel-angle", options.travel_angle)):
        if angle is not None and not abs(angle) <= 60:
            raise InputError(f"{name} is {angle:g} deg; give -60 to 60")
    if options.max_turning is not None and not options.max_turning > 0:
        raise InputError(f"--max-turning is {options.max_turning:g} deg/s; give a number above 0")

    import numpy as np

    from grindvision.cli.pictures import drawing
    from grindvision.clouds import usable_rows
    from grindvision.files import write_text, write_whole
    from grindvision.vision.seam.weld import TraceWeldOptions

    draw = drawing("groove_picture")
    job = robot_job(options)
    field = read_correction(options.field_correction, options.viewpoint)
    libraries = ("numpy", "scipy", "numba", "matplotlib")
    outdated = ("trajectory_[0-9]*.csv", *PROGRAM_FILES)
    with Run(options, ("cloud",), libraries, 6 if job else 5, outdated) as work:
        with work.stage("read"):
            (cloud,) = read_scans((options.cloud,), options.unit, (options.mirrored,))
            rows, (copies, originals) = usable_rows(cloud, options.cloud)
            points = cloud.points if rows.all() else cloud.points[rows]
            if field is not None:
                points = corrected(field, cloud, points, options.cloud)
        for finding in diagnose_pose(job.T_base_scanner, points) if job else []:
            warnings.warn(finding, GrindvisionWarning, stacklevel=1)
        settings = TraceWeldOptions(
            options.waypoints, options.variant, options.viewpoint, None, options.width, options.joint
        )
        weld = _traced(points, None if cloud.normals is None or cloud.mesh else cloud.normals[rows], settings)
        labels = np.zeros(len(cloud), dtype=bool)
        labels[rows] = weld.labels
        labels[copies] = labels[originals]
        work.finished("detect")
        with work.stage("torch"):
            trajectories = [_torch(path, options, job) for path in weld.paths]
        results, welding = _results(weld, labels), None
        if job is not None:
            with work.stage("motion"):
                script, welding = _write_programmes(job, weld, points, work.place, options, results)
        with work.stage("write"):
            for rank, (path, trajectory) in enumerate(zip(weld.paths, trajectories, strict=True), start=1):
                name = "trajectory.csv" if rank == 1 else f"trajectory_{rank}.csv"
                write_text(work.place / name, rows_text(COLUMNS, path.points, path.normals, trajectory.rpy_rad))
            with write_whole(work.place / "labels.npy") as temporary:
                np.save(temporary, labels)
        with work.stage("picture"):
            draw(weld, points, work.warnings, work.place / "report.png", welding)
        questions = [size_question(("CLOUD",), (cloud,)), *where_it_stood(None, job)]
        work.report(str(weld), results, _from_the_data(options, weld), weld.timings_s, questions=questions)
    if options.send is not None:
        send_if_agreed(script, options)
    return 0


def _write_programmes(
    job: RobotJob, weld: Weld, points: np.ndarray, place: Path, options: argparse.Namespace, results: dict[str, Any]
) -> tuple[str, WeldRuns | None]:
    """Plan and write every programme along the first seam; returns the URScript to send and the weld's runs."""
    from grindvision.cli.weld_job import weld_runs, within_reach

    if job.wishes is None:
        motion = within_reach(weld.path, lambda path: job.plan(_torch(path, options, job), points))
        name = job.write(motion, place)
        results["motion"] = motion_facts(motion)
        return (place / name).read_text(encoding="ascii"), None
    wishes, groove = job.wishes, weld.seams[0].groove if weld.seams else None

    def planned(path: SeamPath) -> tuple[WeldRuns, list[Motion]]:
        runs = weld_runs(wishes, job.torch_speed_mm_s, path, groove, lambda beside: _torch(beside, options, job))
        return runs, [job.plan_weld(run.path, points, path.closed) for run in runs.runs]

    welding, motions = within_reach(weld.path, planned)
    scripts = [job.write_weld(motion, run, place) for motion, run in zip(motions, welding.runs, strict=True)]
    results["motion"] = motion_facts(motions[0])
    results["welding"] = welding.facts()
    for told, motion in zip(results["welding"]["runs"], motions, strict=True):
        told["clearance_mm"], told["position_error_mm"] = motion.clearance.min_mm, motion.path.position_error_mm.max()
    return scripts[0], welding


def _traced(points: np.ndarray, normals: np.ndarray | None, settings: TraceWeldOptions) -> Weld:
    """The seams of points (N, 3), mm; where nothing else tells from which side they were scanned, the file's normals
    (N, 3) do, each turned to its camera."""
    from grindvision.vision.seam.weld import trace_weld
    from grindvision.vision.surface.facing_side import MIN_FACING, faces_with, viewpoint_by_normals

    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        weld = trace_weld(points, settings)
    assumed = [one for one in told if str(one.message).startswith(SIDE_ASSUMED)]
    if assumed and normals is not None:
        viewpoint = viewpoint_by_normals(points, normals)
        if viewpoint is not None:
            return trace_weld(points, replace(settings, viewpoint_mm=viewpoint))
        path = weld.paths[0]
        if faces_with(points, normals, path.points, path.normals) >= MIN_FACING:
            told = [one for one in told if one not in assumed]
    for one in told:
        warnings.warn(one.message, one.category, stacklevel=2)
    return weld


def _torch(path: SeamPath, options: argparse.Namespace, job: RobotJob | None) -> Trajectory:
    import numpy as np

    from grindvision.motion.trajectory import ToolTrajectoryOptions, limit_angular_speed, tool_trajectory

    settings = ToolTrajectoryOptions(
        path.closed,
        float(np.radians(options.work_angle or 0.0)),
        float(np.radians(options.travel_angle or 0.0)),
        STEADY_MM if options.variant == "ours" else 0.0,
    )
    if options.max_turning is None:
        return tool_trajectory(path.points, path.normals, settings)
    speed = 8.0 if job is None else job.torch_speed_mm_s
    return limit_angular_speed(path.points, path.normals, settings, speed, float(np.radians(options.max_turning)))


def _results(weld: Weld, labels: np.ndarray) -> dict[str, Any]:
    import numpy as np

    grooves = [
        {
            "points": len(groove.members),
            "width_mm": float(np.median(groove.width_mm)),
            "depth_mm": float(np.median(groove.depth_mm)),
            "length_mm": groove.length_mm,
            "closed": groove.closed,
            "edges_seen": groove.edges_seen,
            "root_deviation_mm": float(np.median(groove.root_deviation_mm)),
        }
        for groove in weld.grooves
    ]
    return {
        "variant": weld.variant,
        "groove_points": int(labels.sum()),
        "path_length_mm": weld.path.length_mm,
        "euler_order": "R = Rz(yaw) Ry(pitch) Rx(roll); tool z into the work, x along the seam",
        "grooves": grooves,
        "seams": [_seam_facts(seam) for seam in weld.seams],
        "less_certain": [_seam_facts(seam) for seam in weld.weaker],
    }


def _seam_facts(seam: Seam) -> dict[str, Any]:
    import numpy as np

    return {
        "kind": seam.kind,
        "evidence": seam.evidence,
        "length_mm": seam.length_mm,
        "closed": seam.closed,
        "root_sigma_mm": float(np.median(seam.sigma_mm)),
        "opening_deg": float(np.median(seam.opening_deg)),
        "opening_sigma_deg": seam.opening_sigma_deg,
        "legs_mm": [float(leg) for leg in np.median(seam.legs_mm, axis=1)],
        "gap_mm": float(np.median(seam.gap_mm)),
        "gap_sigma_mm": seam.gap_sigma_mm,
        "step_mm": float(np.median(seam.step_mm)),
        "step_sigma_mm": seam.step_sigma_mm,
        "interruptions_mm": [[one.start_mm, one.end_mm] for one in seam.interruptions],
    }


def _from_the_data(options: argparse.Namespace, weld: Weld) -> dict[str, Any]:
    import numpy as np

    values: dict[str, Any] = {}
    if options.unit is None:
        values["unit"] = "mm unless the file says m"
    if weld.spacing_mm is not None:
        values["spacing_mm"] = weld.spacing_mm
    if options.width is None and weld.grooves:
        values["width"] = float(np.median(weld.grooves[0].width_mm))
    return values
