"""PCL through our two small programs, pcl_grind.cpp and pcl_weld.cpp."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.peers.laps import Answer
from benchmarks.peers.programs import run_pcl
from benchmarks.peers.recipe import THRESHOLD_MM


def detect(sample: str, test: str, samples: int, icp: str) -> Answer:
    """The whole pipeline: SAC-IA with so many ``samples``, then ICP to planes or points."""
    return run_pcl("pcl_grind", "detect", sample, test, os.devnull, samples, icp)


def coarse(sample: str, test: str, method: str, voxel_mm: float, tries: int) -> Answer:
    """The first alignment by ``sacia`` or ``prerejective``."""
    return run_pcl("pcl_grind", "coarse", sample, test, os.devnull, method, voxel_mm, tries)


def icp(sample: str, test: str, start: str, method: str) -> Answer:
    """ICP to ``plane`` or ``point`` on voxels of 1 mm."""
    return run_pcl("pcl_grind", "icp", sample, test, os.devnull, method, start)


def difference(sample: str, test: str) -> Answer:
    """Points farther than 0.5 mm from their nearest neighbour, on all cores."""
    answer, distances = _with_numbers("pcl_grind", "difference", sample, test)
    return {**answer, "changed": distances > THRESHOLD_MM}


def voxels(cloud: str, size_mm: float = 2.0) -> Answer:
    """The voxel grid filter."""
    answer, numbers = _with_numbers("pcl_grind", "voxel", cloud, words=(size_mm,))
    return {**answer, "points": numbers.reshape(-1, 3), "size_mm": np.array(size_mm), "origin": np.zeros(3)}


def fpfh(sample: str, test: str, radius_mm: float = 10.0) -> Answer:
    """Histograms of both scans' points."""
    found = [_with_numbers("pcl_grind", "fpfh", cloud, words=(radius_mm,)) for cloud in (sample, test)]
    measured = [answer["measured"] for answer, _ in found]
    both = {name: sum(one[name] for one in measured) for name in ("wall_s", "cpu_s")}
    both |= {name: max(one[name] for one in measured) for name in ("peak_mib", "growth_mib")}
    laps = [answer["laps_s"] for answer, _ in found]
    histograms = (numbers.reshape(-1, 33) for _, numbers in found)
    return {
        **dict(zip(("sample", "test"), histograms, strict=True)),
        "measured": both,
        "laps_s": {name: sum(one[name] for one in laps) for name in laps[0]},
    }


def groove(cloud: str, smoothing_mm: float, radius_mm: float, threshold_deg: float) -> Answer:
    """The second paper's recipe: moving least squares, normals, histograms, vote, clusters, geometric medians."""
    answer, labels = _with_numbers("pcl_weld", cloud, words=(smoothing_mm, radius_mm, threshold_deg), kind=np.uint8)
    laps = answer["laps_s"]
    stages = {"groove": sum(laps[name] for name in ("smoothing", "normals", "descriptor", "groove"))}
    stages = {"read": laps["read"], **stages, "trajectory": laps["trajectory"]}
    return {**answer, "labels": labels.astype(bool), "laps_s": stages}


def _with_numbers(
    name: str, *files: str, words: tuple[object, ...] = (), kind: type = np.float32
) -> tuple[Answer, np.ndarray]:
    """Run a program that writes raw numbers to a file named behind its clouds."""
    with tempfile.TemporaryDirectory() as folder:
        result = Path(folder) / "numbers"
        answer = run_pcl(name, *files, result, *words)
        return answer, np.fromfile(result, dtype=kind)
