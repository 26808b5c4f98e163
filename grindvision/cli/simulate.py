"""``grindvision simulate``: scans and measurements of the virtual cell, with the truth beside them."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from grindvision.cli.parameters import check_count, whole
from grindvision.cli.report import Run, add_output_arguments
from grindvision.vision.seam.joint_names import KINDS, V_GROOVE

if TYPE_CHECKING:
    from grindvision.cell import CalibrationExperiment, GrindingScene, JointScene, WeldScene

#: Joints that can be simulated: all that the detector knows but the V-groove, which the four pieces have.
JOINTS = tuple(kind for kind in KINDS if kind != V_GROOVE)

EPILOG = """\
results in DIR, all synthetic, mm:
  grinding     sample.ply, test.ply, pose.json, truth.json: two scans of a part, without and with the bead to be ground,
               and where the scanner stood for the second one in the robot's base frame
  welding      line/, curve/, box/, cylinder/, each with cloud.ply, labels.npy, pose.json, truth.json
               with --joint: one folder for that joint, or for every joint, each with cloud.ply, truth.json
  calibration  measurements.csv, robot.csv (nominal), truth.json: spheres seen by arm-borne scanner and tracker
  and always   report.png (what was made), parameters.toml, report.json (versions, timings, seed; written last)

exit code: 0 done, 2 the input cannot be used (one line says why), 1 anything else

examples:
  grindvision simulate grinding -o inputs --seed 1
  grindvision detect inputs/sample.ply inputs/test.ply -o result --scanner-pose inputs/pose.json
  grindvision simulate welding -o joints --joint t-joint --camera fine
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.formatter_class, parser.epilog = argparse.RawDescriptionHelpFormatter, EPILOG
    parser.add_argument("subject", choices=("grinding", "welding", "calibration"), help="what to simulate")
    group = parser.add_argument_group("simulation")
    group.add_argument(
        "--seed", type=whole, default=0, metavar="N", help="the same seed gives the same files (default: 0)"
    )
    group.add_argument(
        "--joint",
        choices=("all", *JOINTS),
        metavar="KIND",
        help=f"welding: this joint, or all, instead of the four pieces with a groove: {', '.join(('all', *JOINTS))}",
    )
    group.add_argument(
        "--camera", choices=("d415", "fine"), help="with --joint: a D415 or a scanner of 0.05 mm (default: d415)"
    )
    add_output_arguments(parser)


def run(options: argparse.Namespace) -> int:
    """Simulate and write; returns 0."""
    check_count("--seed", options.seed, 0, 10**18)

    from grindvision.cell.simulation import SimulateOptions, simulate
    from grindvision.cli.pictures import drawing

    draw = drawing("simulate_picture")
    what = "joints" if options.joint else options.subject
    settings = SimulateOptions(options.seed, joint=options.joint, camera=options.camera)
    with Run(options, (), ("numpy", "scipy", "matplotlib"), 4) as work:
        with work.stage("simulate"):
            made: Any = simulate(options.subject, settings)
        with work.stage("write"):
            WRITERS[what](made, work.place, options.seed)
        with work.stage("picture"):
            draw(made, what, options.seed, work.place / "report.png")
        message = "; ".join(str(one) for one in made.values()) if isinstance(made, dict) else str(made)
        work.report(message, {"seed": options.seed, "origin": "synthetic"}, {})
    return 0


def _write_grinding(scene: GrindingScene, folder: Path, seed: int) -> None:
    import numpy as np

    from grindvision.cell.places import T_BASE_PART
    from grindvision.clouds import write_ply
    from grindvision.files import write_json
    from grindvision.geometry import move_points

    bead = scene.part.bead
    T_base_test = T_BASE_PART @ scene.test.T_world_scanner
    truth = {
        "seed": seed,
        "unit": "mm",
        "frames": {
            "sample": "scanner frame of sample.ply",
            "test": "scanner frame of test.ply; T_sample_test @ p_test = p_sample",
            "base": "the robot's base; pose.json holds T_base_scanner of test.ply",
        },
        "T_sample_test": scene.T_sample_test,
        "overlap": scene.overlap,
        "bead": {"length_mm": bead.length_mm, "width_mm": bead.width_mm, "height_mm": bead.height_mm},
        "ridge_test_mm": scene.ridge_mm,
        "ridge_normals_test": scene.ridge_normals,
        "ridge_base_mm": move_points(T_base_test, scene.ridge_mm),
        "bead_points_test": np.flatnonzero(scene.on_bead),
    }
    write_ply(folder / "sample.ply", scene.sample.points)
    write_ply(folder / "test.ply", scene.test.points)
    write_json(folder / "pose.json", {"T_base_scanner": T_base_test, "base": "model"})
    write_json(folder / "truth.json", truth)


def _write_welding(scenes: dict[str, WeldScene], folder: Path, seed: int) -> None:
    import numpy as np

    from grindvision.cell.places import T_base_piece
    from grindvision.clouds import write_ply
    from grindvision.files import write_json, write_whole

    for kind, scene in scenes.items():
        groove = scene.piece.groove
        truth = {
            "seed": seed,
            "unit": "mm",
            "frames": {"camera": "frame of cloud.ply: origin in the camera, z forward; all points and directions here"},
            "groove": {"width_mm": groove.width_mm, "depth_mm": groove.depth_mm, "root_mm": groove.root_mm},
            "root_camera_mm": scene.root_mm,
            "tangents_camera": scene.tangents,
            "normals_camera": scene.normals,
        }
        write_ply(folder / kind / "cloud.ply", scene.points)
        with write_whole(folder / kind / "labels.npy") as temporary:
            np.save(temporary, scene.labels)
        write_json(
            folder / kind / "pose.json",
            {"T_base_scanner": T_base_piece(kind) @ scene.scan.T_world_scanner, "base": "model"},
        )
        write_json(folder / kind / "truth.json", truth)


def _write_joints(scenes: dict[str, JointScene], folder: Path, seed: int) -> None:
    from dataclasses import asdict

    from grindvision.clouds import write_ply
    from grindvision.files import write_json

    for kind, scene in scenes.items():
        truth = {
            "seed": seed,
            "unit": "mm",
            "frames": {"camera": "frame of cloud.ply: origin in the camera, z forward; all points and directions here"},
            "kind": kind,
            "size": asdict(scene.piece.size),
            "root_camera_mm": scene.root_mm,
            "tangents_camera": scene.tangents,
            "normals_camera": scene.normals,
            "T_piece_camera": scene.scan.T_world_scanner,
        }
        write_ply(folder / kind / "cloud.ply", scene.points)
        write_json(folder / kind / "truth.json", truth)


def _write_calibration(experiment: CalibrationExperiment, folder: Path, seed: int) -> None:
    from grindvision.arm import PARAMETERS, write_arm
    from grindvision.files import write_json, write_text

    robot = experiment.robot
    truth: dict[str, Any] = {
        "seed": seed,
        "unit": "mm and rad",
        "frames": {
            "base": "the arm's base",
            "joint": f"frame of joint {robot.true.n}, which carries the scanner; T_joint_scanner @ p_scanner = p_joint",
            "scanner": "frame of sx_mm, sy_mm, sz_mm",
            "tracker": "frame of bx_mm, by_mm, bz_mm; T_tracker_base @ p_base = p_tracker",
        },
        "T_joint_scanner": robot.T_joint4_scanner,
        "T_joint_scanner_nominal": robot.T_joint4_scanner_nominal,
        "T_tracker_base": experiment.tracker.T_tracker_base,
        "robot": {
            joint: dict(zip(PARAMETERS, row, strict=True))
            for joint, row in zip(robot.true.joints, robot.true.table.tolist(), strict=True)
        },
        "joint_noise_deg": robot.joint_noise_deg,
        "sphere_centres_base_mm": experiment.plan.centres_mm,
        "T_base_scanner": experiment.T_base_scanner,
    }
    table = experiment.table.to_csv(index=False, float_format="%.9f", lineterminator="\n")
    write_text(folder / "measurements.csv", table)
    write_arm(robot.nominal, folder / "robot.csv")
    write_json(folder / "truth.json", truth)


WRITERS: dict[str, Callable[..., None]] = {
    "grinding": _write_grinding,
    "welding": _write_welding,
    "joints": _write_joints,
    "calibration": _write_calibration,
}
