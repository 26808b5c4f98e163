"""``grindvision simulate``: scans and measurements of the virtual cell, with the truth beside them."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from grindvision.errors import InputError

if TYPE_CHECKING:
    import numpy as np

SUBJECTS = {
    "grinding": "sample.ply, test.ply, truth.json: two scans of a part, without and with the bead to be ground",
    "welding": "line/, curve/, box/, cylinder/, each with cloud.ply, labels.npy, truth.json",
    "calibration": "measurements.csv, robot.csv (nominal), truth.json: spheres seen by arm-borne scanner and tracker",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the command line."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = "\n".join(f"{name}: {files}" for name, files in SUBJECTS.items())
    parser.add_argument("subject", choices=SUBJECTS, help="what to simulate")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="folder to write to")
    parser.add_argument("--seed", type=int, default=0, help="the same seed gives the same files (default 0)")


def run(options: argparse.Namespace) -> int:
    """Simulate and write; returns 0.

    Raises:
        InputError: negative seed. FileError: the folder cannot be written to.
    """
    import numpy as np

    from grindvision.files import writable_folder

    if options.seed < 0:
        raise InputError(f"--seed is {options.seed}; give zero or a positive whole number")
    folder = writable_folder(options.output)
    write = {"grinding": _grinding, "welding": _welding, "calibration": _calibration}[options.subject]
    write(folder, np.random.default_rng(options.seed), options.seed)
    return 0


def _grinding(folder: Path, rng: np.random.Generator, seed: int) -> None:
    import numpy as np

    from grindvision import cell
    from grindvision.clouds import write_ply
    from grindvision.files import write_json

    scene = cell.grinding_scene(rng)
    bead = scene.part.bead
    truth = {
        "seed": seed,
        "unit": "mm",
        "frames": {
            "sample": "scanner frame of sample.ply",
            "test": "scanner frame of test.ply; T_sample_test @ p_test = p_sample",
        },
        "T_sample_test": scene.T_sample_test,
        "overlap": scene.overlap,
        "bead": {"length_mm": bead.length_mm, "width_mm": bead.width_mm, "height_mm": bead.height_mm},
        "ridge_test_mm": scene.ridge_mm,
        "ridge_normals_test": scene.ridge_normals,
        "bead_points_test": np.flatnonzero(scene.on_bead),
    }
    write_ply(folder / "sample.ply", scene.sample.points)
    write_ply(folder / "test.ply", scene.test.points)
    write_json(folder / "truth.json", truth)
    print(scene)


def _welding(folder: Path, rng: np.random.Generator, seed: int) -> None:
    import numpy as np

    from grindvision import cell
    from grindvision.clouds import write_ply
    from grindvision.files import write_json, write_whole

    for kind, piece_rng in zip(cell.KINDS, rng.spawn(len(cell.KINDS)), strict=True):
        scene = cell.weld_scene(kind, piece_rng)
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
        write_json(folder / kind / "truth.json", truth)
        print(scene)


def _calibration(folder: Path, rng: np.random.Generator, seed: int) -> None:
    from grindvision import cell
    from grindvision.arm import PARAMETERS, write_arm
    from grindvision.files import write_json, write_text

    experiment = cell.calibration_experiment(rng)
    robot = experiment.robot
    truth = {
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
    write_text(
        folder / "measurements.csv", experiment.table.to_csv(index=False, float_format="%.9f", lineterminator="\n")
    )
    write_arm(robot.nominal, folder / "robot.csv")
    write_json(folder / "truth.json", truth)
    print(experiment)
