"""``grindvision groove``: a scan in, the weld groove and the torch's trajectory out."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from grindvision.cli.detect import where_it_stood
from grindvision.cli.robot_job import add_robot_arguments, motion_facts, robot_job

if TYPE_CHECKING:
    from grindvision.motion import Trajectory
    from grindvision.vision.seam_path import SeamPath
    from grindvision.vision.weld import Weld

#: Length along the seam over which the torch's frame averages what single normals say, mm.
STEADY_MM = 8.0

COLUMNS = "waypoint,x_mm,y_mm,z_mm,nx,ny,nz,roll_rad,pitch_rad,yaw_rad"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.add_argument("cloud", metavar="CLOUD", help="scan of the workpiece (PLY, PCD, XYZ, CSV, NPY)")
    parser.add_argument("-o", "--output", required=True, metavar="DIR", help="folder for the results")
    parser.add_argument("--waypoints", type=int, default=50, help="way points along the groove (default 50)")
    parser.add_argument(
        "--unit", choices=("mm", "m"), default="mm", help="unit of the numbers in the file (default mm)"
    )
    parser.add_argument(
        "--variant", choices=("ours", "paper"), default="ours", help="ours, or the second paper's method (default ours)"
    )
    parser.add_argument(
        "--viewpoint",
        type=float,
        nargs=3,
        metavar=("X", "Y", "Z"),
        help="where the camera stood, mm in the cloud's frame; the origin where that is possible",
    )
    add_robot_arguments(parser)


def run(options: argparse.Namespace) -> int:
    """Run it."""
    import numpy as np

    from grindvision.cli.groove_picture import draw
    from grindvision.cli.report import Stopwatch, run_facts
    from grindvision.clouds import check_unit, finite_points, read_cloud
    from grindvision.files import write_json, write_text, write_whole
    from grindvision.motion.trajectory import tool_trajectory
    from grindvision.vision.weld import trace_weld

    job = robot_job(options)
    stopwatch = Stopwatch()
    with stopwatch.stage("read"):
        cloud = read_cloud(options.cloud, options.unit)
        points = finite_points(cloud, options.cloud)
        check_unit(points, options.cloud, options.unit)
    weld = trace_weld(cloud.points, options.waypoints, options.variant, options.viewpoint)
    steady_mm = STEADY_MM if options.variant == "ours" else 0.0
    trajectories = [
        tool_trajectory(path.points, path.normals, closed=path.closed, steady_mm=steady_mm) for path in weld.paths
    ]
    results = _results(weld)
    written = ["trajectory.csv", "labels.npy", "report.json", "report.png"]
    folder = Path(options.output)
    motion = None
    if job is not None:
        with stopwatch.stage("motion"):
            motion = job.plan(trajectories[0], points)
    with stopwatch.stage("write"):
        write_text(folder / "trajectory.csv", trajectory_table(weld.path, trajectories[0]))
        for number, (path, trajectory) in enumerate(zip(weld.paths[1:], trajectories[1:], strict=True), start=2):
            written.append(f"trajectory_{number}.csv")
            write_text(folder / written[-1], trajectory_table(path, trajectory))
        with write_whole(folder / "labels.npy") as temporary:
            np.save(temporary, weld.labels)
        if motion is not None:
            written.append(job.write(motion, folder))
            results["motion"] = motion_facts(motion)
    facts = run_facts(options, [options.cloud], ("numpy", "scipy", "numba", "matplotlib"), stopwatch)
    facts["timings_s"] = {**weld.timings_s, **facts["timings_s"]}
    draw(weld, cloud.points, folder / "report.png")
    write_json(folder / "report.json", results | facts)
    if job is not None:
        print(where_it_stood(job.T_base_scanner))
    print(f"{weld}\nwritten: {', '.join(written)} in {folder}")
    return 0


def trajectory_table(path: SeamPath, trajectory: Trajectory) -> str:
    """The CSV text of way points in mm, outward normals, and the torch's roll, pitch and yaw in rad."""
    rows = [
        f"{number}," + ",".join(f"{value:.4f}" for value in point) + "," + ",".join(f"{v:.6f}" for v in (*normal, *rpy))
        for number, (point, normal, rpy) in enumerate(
            zip(path.points, path.normals, trajectory.rpy_rad, strict=True), start=1
        )
    ]
    return "\n".join([COLUMNS, *rows]) + "\n"


def _results(weld: Weld) -> dict[str, object]:
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
        "groove_points": int(weld.labels.sum()),
        "path_length_mm": weld.path.length_mm,
        "euler_order": "R = Rz(yaw) Ry(pitch) Rx(roll); tool z into the work, x along the seam",
        "message": str(weld),
        "grooves": grooves,
    }
