"""What a grinding job needs to be gone on with later: its stock, its passes and the good scan, in one file."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from grindvision.errors import FileError, GrindvisionError
from grindvision.files import plain, write_whole
from grindvision.formats.arrays import DAMAGED
from grindvision.geometry import check_rigid
from grindvision.geometry.height_map import HeightMap
from grindvision.input_files import check_memory, open_input
from grindvision.motion.grinding import GrindingPass, GrindingPlan, Stroke, Workpiece
from grindvision.motion.grinding_options import GrindingOptions
from grindvision.records import by_content
from grindvision.vision.change.stock import MappedPlace, StockPiece

Floats = NDArray[np.float64]

PLAN_FILE = "plan.npz"
FORMAT = 2

#: Numbers of a workpiece that are kept beside its maps.
WORK_NUMBERS = ("level_mm", "sigma_mm", "offset_mm", "offset_sigma_mm")

#: Numbers of a pass that are kept beside its strokes and heights.
PASS_NUMBERS = ("number", "floor_mm", "depth_mm", "feed_mm_s", "force_n", "removed_mm3")


@by_content
@dataclass(frozen=True)
class GrindingJob:
    """A job as it was written: ``T_sample_test`` (4, 4), the ``places`` of its pieces, their ``sigma_mm`` (R, C) and
    ``plans`` (None where a piece has none), in the frame of the test scan; ``sample``: path, sha256, unit, box of the
    good scan; ``T_base_scanner`` (4, 4) of the test scan, where it was given."""

    sample: Mapping[str, Any]
    T_sample_test: Floats
    places: tuple[MappedPlace, ...]
    sigma_mm: tuple[Floats, ...]
    plans: tuple[GrindingPlan | None, ...]
    options: GrindingOptions
    T_base_scanner: Floats | None = None


def job_of(
    T_sample_test: Floats,
    pieces: tuple[StockPiece, ...],
    plans: tuple[GrindingPlan | None, ...],
    options: GrindingOptions,
    sample: Mapping[str, Any] | None = None,
    T_base_scanner: Floats | None = None,
) -> GrindingJob:
    """What a job is gone on with: the places of its ``pieces``, and their ``plans``."""
    places, sigmas = tuple(piece.place for piece in pieces), tuple(piece.sigma_mm for piece in pieces)
    return GrindingJob(sample or {}, T_sample_test, places, sigmas, plans, options, T_base_scanner)


def write_job(path: str | Path, job: GrindingJob, pieces: tuple[StockPiece, ...]) -> None:
    """Write a job, whole or not at all; the ``pieces`` are those that it was made of.

    Raises:
        FileError: the file cannot be written.
    """
    content: dict[str, Any] = {
        "format": FORMAT, "sample": dict(job.sample), "T_sample_test": job.T_sample_test,
        "options": asdict(job.options), "T_base_scanner": job.T_base_scanner, "pieces": [],
    }  # fmt: skip
    arrays: dict[str, Any] = {}
    for number, (piece, place, plan) in enumerate(zip(pieces, job.places, job.plans, strict=True)):
        key = f"piece{number}_"
        arrays |= {f"{key}frame": place.map.T_scan_map, f"{key}ground": place.map.ground_mm}
        arrays |= {f"{key}normals": place.map.normals, f"{key}sigma": piece.sigma_mm}
        arrays |= {f"{key}inside": place.inside, f"{key}unchanged": place.unchanged}
        arrays |= {f"{key}heights": piece.map.heights_mm, f"{key}floor": piece.map.ground_mm}
        entry: dict[str, Any] = {"spacing_mm": place.map.spacing_mm, "highest_mm": place.highest_mm, "plan": None}
        if plan is not None:
            entry["plan"] = {
                **{name: getattr(plan.work, name) for name in WORK_NUMBERS},
                "leave_mm": plan.leave_mm, "options": asdict(plan.options),
                "passes": [
                    {name: getattr(one, name) for name in PASS_NUMBERS} | {"strokes": len(one.strokes)}
                    for one in plan.passes
                ],
            }  # fmt: skip
            arrays[f"{key}keep"] = plan.work.keep
            if plan.work.centreline_mm is not None:
                arrays[f"{key}course"] = plan.work.centreline_mm
            for at, one in enumerate(plan.passes):
                arrays[f"{key}pass{at}_heights"] = one.heights_mm
                for line, stroke in enumerate(one.strokes):
                    arrays[f"{key}pass{at}_poses{line}"] = stroke.poses
                    arrays[f"{key}pass{at}_lifts{line}"] = stroke.lifts_mm
        content["pieces"].append(entry)
    arrays["content"] = np.array(json.dumps(plain(content)))
    with write_whole(path) as temporary:
        np.savez_compressed(temporary, **arrays)


def read_job(folder: str | Path) -> GrindingJob:
    """Read the job that a run of ``grindvision grind`` left in a folder.

    Raises:
        FileError: there is none, or it is damaged or of another version.
    """
    path = Path(folder) / PLAN_FILE
    if "\0" in str(folder) or not path.is_file():
        raise FileError(f"{folder}: no {PLAN_FILE} in it; give the folder that `grindvision grind -o` wrote")
    try:
        with open_input(path) as file, zipfile.ZipFile(file) as archive:
            check_memory(path, 2.0 * sum(entry.file_size for entry in archive.infolist()))
            with np.load(file, allow_pickle=False) as arrays:
                return _job(path, arrays)
    except FileError:
        raise
    except (*DAMAGED, AttributeError, GrindvisionError) as error:
        raise FileError(f"{path}: damaged ({' '.join(str(error).split())[:80]}); plan the job again") from None


def _job(path: Path, arrays: Mapping[str, Any]) -> GrindingJob:
    content = json.loads(str(arrays["content"]))
    if content["format"] != FORMAT:
        raise FileError(f"{path}: format {str(content['format'])[:20]} is of another version; plan the job again")
    read = [_piece(arrays, number, entry) for number, entry in enumerate(content["pieces"])]
    return GrindingJob(
        content["sample"],
        check_rigid(content["T_sample_test"], f"{path}: T_sample_test"),
        tuple(one[0] for one in read),
        tuple(one[1] for one in read),
        tuple(one[2] for one in read),
        GrindingOptions(**content["options"]),
        None
        if content["T_base_scanner"] is None
        else check_rigid(content["T_base_scanner"], f"{path}: T_base_scanner"),
    )


def _piece(
    arrays: Mapping[str, Any], number: int, entry: Mapping[str, Any]
) -> tuple[MappedPlace, Floats, GrindingPlan | None]:
    key = f"piece{number}_"
    frame, ground, normals = (arrays[f"{key}{name}"] for name in ("frame", "ground", "normals"))
    heights, inside = arrays[f"{key}heights"], arrays[f"{key}inside"]
    bare = HeightMap(frame, entry["spacing_mm"], ground, normals, heights)
    place = MappedPlace(bare, inside, arrays[f"{key}unchanged"], entry["highest_mm"])
    sigma = arrays[f"{key}sigma"]
    if not heights.shape == inside.shape == place.unchanged.shape == sigma.shape == ground.shape == normals.shape[:2]:
        raise ValueError(f"the maps of piece {number} differ in size")
    found = entry["plan"]
    if found is None:
        return place, sigma, None
    course = arrays.get(f"{key}course")
    over = HeightMap(frame, entry["spacing_mm"], arrays[f"{key}floor"], normals, heights)
    numbers = {name: found[name] for name in WORK_NUMBERS}
    work = Workpiece(over, inside, arrays[f"{key}keep"], centreline_mm=course, **numbers)
    passes = []
    for at, one in enumerate(found["passes"]):
        strokes = tuple(
            Stroke(arrays[f"{key}pass{at}_poses{line}"], arrays[f"{key}pass{at}_lifts{line}"])
            for line in range(one["strokes"])
        )
        numbers = {name: one[name] for name in PASS_NUMBERS}
        passes.append(GrindingPass(**numbers, strokes=strokes, heights_mm=arrays[f"{key}pass{at}_heights"]))
    return place, sigma, GrindingPlan(work, GrindingOptions(**found["options"]), found["leave_mm"], tuple(passes))
