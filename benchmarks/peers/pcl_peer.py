"""PCL through our two small programs, pcl_grind.cpp and pcl_weld.cpp."""

from __future__ import annotations

import os

from benchmarks.peers.programs import run_pcl


def detect(sample: str, test: str, samples: int, icp: str) -> dict:
    """The whole pipeline: SAC-IA with so many ``samples``, then ICP to planes or points."""
    return run_pcl("pcl_grind", "detect", sample, test, os.devnull, samples, icp)


def coarse(sample: str, test: str, method: str, voxel_mm: float, tries: int) -> dict:
    """The first alignment by ``sacia`` or ``prerejective``."""
    return run_pcl("pcl_grind", "coarse", sample, test, os.devnull, method, voxel_mm, tries)
