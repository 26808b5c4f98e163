"""What the racers get, made by the virtual cell from a seed and kept in a cache; the truth lies in another folder."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
import pandas as pd

from benchmarks.hand_eye_race import simulated_sequences
from benchmarks.racing import Arrays, Case
from grindvision import cell, paper
from grindvision.cell import StructuredLightScanner
from grindvision.cell.scanners import Scanner
from grindvision.clouds import read_cloud, write_ply
from grindvision.files import write_text, write_whole
from grindvision.geometry import move_points, rigid, rotation_about
from grindvision.vision.surface.normals import estimate_normals
from grindvision.vision.surface.voxel_grid import voxel_grid
from grindvision_book.machinery.places import BUILD

AnyScanner = TypeVar("AnyScanner", bound=Scanner)

CACHE = BUILD / "benchmarks"

FINE = 1.72
"""Pixels of the fine scanner over those of the EinScan-Pro, along a row: two million points a scan."""

SIZES = {"50k": 6, "200k": 3, "500k": 2, "2M": 1}
"""Every so many-th pixel of the fine scan, along rows and columns."""

START_TURN_RAD, START_SHIFT_MM = np.radians(2.0), 1.5
"""How far ICP starts from the truth."""

KEY_MM = 2.0
"""Voxels of the points that are described by FPFH."""

SPHERES = {"54": 9, "300": 50, "1000": 167}
"""Spheres, each measured from six directions, for so many poses."""


def detection_cases(size: str, count: int, seed: int) -> list[Case]:
    """``count`` pairs of scans of the whole instrument, 20 to 40 degrees apart; the same scenes at every size."""
    return [_pair(f"detect-{seed}-{number}", size, [seed, 1, number], SIZES, FINE) for number in range(count)]


def large_cases(seed: int) -> list[Case]:
    """One pair of 20 million points a scan."""
    return [_pair(f"large-{seed}", "20M", [seed, 2], {"20M": 1}, 10**0.5 * FINE)]


def coarse_cases(hard: bool, count: int, seed: int) -> list[Case]:
    """``count`` pairs 20 to 40 degrees apart; the hard ones with a fifth of the relief and 60 % overlap."""
    label, relief, overlap = ("hard", 0.2, 0.6) if hard else ("easy", 1.0, 1.0)
    return [
        _pair(f"{label}-{seed}-{number}", label, [seed, 3 + hard, number], {label: 2}, 1.0, relief, overlap)
        for number in range(count)
    ]


def icp_cases(size: str, count: int, seed: int) -> list[Case]:
    """Pairs with a pose to start from, 2 degrees and 1.5 mm off the true one."""
    return [_with_start(case, [seed, 5, number]) for number, case in enumerate(detection_cases(size, count, seed))]


def difference_cases(size: str, count: int, seed: int) -> list[Case]:
    """Pairs whose test scan has been moved into the sample's frame."""
    return [_aligned(case) for case in detection_cases(size, count, seed)]


def _points_of(file: str) -> Arrays:
    return {"points": read_cloud(file).points}


def voxel_cases(size: str, count: int, seed: int) -> list[Case]:
    """Single scans."""
    files = [case.inputs["sample"] for case in detection_cases(size, count, seed)]
    return [
        Case(
            size,
            Path(file).stat().st_size // 12,
            {"cloud": file},
            partial(_points_of, file),
        )
        for file in files
    ]


def fpfh_cases(size: str, count: int, seed: int) -> list[Case]:
    """Pairs of scans thinned to voxels, with normals."""
    return [_described(case) for case in detection_cases(size, count, seed)]


def groove_cases(kind: str, count: int, seed: int, pixels: float = 1.0) -> list[Case]:
    """``count`` frames of a weld piece."""
    return [
        _weld(f"weld-{kind}-{pixels:g}-{seed}-{number}", kind, [seed, 6, number], pixels) for number in range(count)
    ]


def calibration_cases(poses: str, count: int, seed: int) -> list[Case]:
    """``count`` calibration experiments with so many poses to calibrate with and 60 held out."""
    return [_calibration(f"calibration-{poses}-{seed}-{number}", poses, [seed, 7, number]) for number in range(count)]


def hand_eye_cases(sequences: int, seed: int) -> list[Case]:
    """One case of so many sequences of poses from which a camera on an arm sees a board."""
    name = f"hand-eye-{sequences}-{seed}"
    given = _input_file(f"{name}.npz")
    if not _truth_file(name).is_file():
        shown, known = simulated_sequences(np.random.default_rng([seed, 8]), sequences)
        with write_whole(given) as path:
            np.savez(path, allow_pickle=False, **shown)
        _write_truth(name, known)
    with np.load(given) as arrays:
        poses = int(arrays["lengths"].sum())
    return [Case(f"{sequences} sequences", poses, {"sequences": str(given)}, partial(truth, name))]


def process_cases(count: int) -> list[Case]:
    """Rounds of processes that read nothing."""
    return [Case("start", 0, {}, dict)] * count


def truth(name: str) -> Arrays:
    """What is true about a case."""
    with np.load(_truth_file(name)) as arrays:
        return dict(arrays)


def scanner(pixels: float, serial: int) -> StructuredLightScanner:
    """The structured-light scanner with ``pixels`` times as many pixels along rows and columns, all else the same."""
    return _finer(StructuredLightScanner(serial=serial), pixels)


def _finer(one: AnyScanner, pixels: float) -> AnyScanner:
    columns, rows = round(one.columns * pixels), round(one.rows * pixels)
    return replace(one, columns=columns, rows=rows, focal_px=one.focal_px * pixels)


def _pair(
    name: str, size: str, seeds: list[int], sizes: Mapping[str, int], pixels: float,
    relief: float = 1.0, overlap: float = 1.0,
) -> Case:  # fmt: skip
    """A pair of scans in the cache; all sizes of a scene are made at once."""
    if not _truth_file(name).is_file():
        rng = np.random.default_rng(seeds)
        least = min(sizes.values())
        one = scanner(pixels, int(rng.integers(2**31)))
        scene = cell.grinding_scene(rng, relief, overlap, scanner=one, every=least)
        known: dict[str, np.ndarray] = {
            "T_sample_test": scene.T_sample_test,
            "ridge": scene.ridge_mm,
            "overlap": np.array(scene.overlap),
        }
        for label, every in sizes.items():
            for of, scan in (("sample", scene.sample), ("test", scene.test)):
                kept = (scan.pixels % (every // least) == 0).all(axis=1)
                write_ply(_input_file(f"{name}-{label}-{of}.ply"), scan.points[kept])
            known[f"on_bead_{label}"] = scene.on_bead[kept]
        _write_truth(name, {**known, "middle": scene.test.points.mean(axis=0)})
    files = {of: str(_input_file(f"{name}-{size}-{of}.ply")) for of in ("sample", "test")}
    points = sum(Path(file).stat().st_size // 12 for file in files.values()) // 2
    return Case(size, points, files, partial(truth, name))


def _with_start(case: Case, seeds: list[int]) -> Case:
    file = Path(case.inputs["test"]).with_suffix(".start.f64")
    if not file.is_file():
        rng, known = np.random.default_rng(seeds), case.truth()
        axis, aside = (vector / np.linalg.norm(vector) for vector in rng.normal(size=(2, 3)))
        about = rigid(None, known["middle"])
        turned = rigid(rotation_about(axis, START_TURN_RAD), START_SHIFT_MM * aside)
        start = known["T_sample_test"] @ about @ turned @ np.linalg.inv(about)
        with write_whole(file) as path:
            start.tofile(path)
    return replace(case, inputs={**case.inputs, "start": str(file)})


def _aligned(case: Case) -> Case:
    file = Path(case.inputs["test"]).with_suffix(".aligned.ply")
    if not file.is_file():
        write_ply(file, move_points(case.truth()["T_sample_test"], read_cloud(case.inputs["test"]).points))
    return replace(
        case,
        inputs={**case.inputs, "test": str(file)},
        truth=lambda: {"on_bead": case.truth()[f"on_bead_{case.label}"], "points": read_cloud(file).points},
    )


def _described(case: Case) -> Case:
    files = {of: Path(file).with_suffix(".keys.ply") for of, file in case.inputs.items()}
    for of, file in files.items():
        if not file.is_file():
            points = voxel_grid(read_cloud(case.inputs[of]).points, KEY_MM).centroids
            write_ply(file, points, estimate_normals(points, 2.5 * KEY_MM, 40, np.zeros(3)))
    described = {of: read_cloud(file).points for of, file in files.items()}
    return replace(
        case,
        points=sum(len(points) for points in described.values()) // 2,
        inputs={of: str(file) for of, file in files.items()},
        truth=lambda: {**case.truth(), **described},
    )


def _weld(name: str, kind: str, seeds: list[int], pixels: float) -> Case:
    cloud = _input_file(f"{name}.ply")
    if not _truth_file(name).is_file():
        rng = np.random.default_rng(seeds)
        camera = _finer(cell.DepthCamera(serial=int(rng.integers(2**31))), pixels)
        scene = cell.weld_scene(kind, rng, camera=camera)
        write_ply(cloud, scene.points)
        _write_truth(name, {"labels": scene.labels, "root": scene.root_mm})
    return Case(kind, cloud.stat().st_size // 12, {"cloud": str(cloud)}, partial(truth, name))


def _calibration(name: str, poses: str, seeds: list[int]) -> Case:
    files = {of: _input_file(f"{name}-{of}.csv") for of in ("train", "test")}
    if not _truth_file(name).is_file():
        rng = np.random.default_rng(seeds)
        done = cell.calibration_experiment(rng, SPHERES[poses], 6, every=None)
        train = done.plan.train
        unknown = ["bx_mm", "by_mm", "bz_mm"]
        write_text(files["train"], done.table[train].drop(columns="split").to_csv(index=False))
        write_text(files["test"], done.table[~train].drop(columns=[*unknown, "split"]).to_csv(index=False))
        spheres = move_points(done.tracker.T_tracker_base, done.plan.centres_mm)
        _write_truth(name, {"held_out": spheres[done.plan.sphere[~train]]})
    robot = paper.data_folder() / "robots" / "er3a_c60.csv"
    inputs = {**{of: str(file) for of, file in files.items()}, "robot": str(robot)}
    return Case(f"{poses} poses", len(pd.read_csv(files["train"])), inputs, partial(truth, name))


def _input_file(name: str) -> Path:
    return CACHE / "inputs" / name


def _truth_file(name: str) -> Path:
    return CACHE / "truth" / f"{name}.npz"


def _write_truth(name: str, known: Mapping[str, np.ndarray]) -> None:
    with write_whole(_truth_file(name)) as path:
        np.savez(path, allow_pickle=False, **known)
