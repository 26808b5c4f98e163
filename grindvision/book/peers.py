"""Peers that are no Python packages: used where they have been built, left out where not."""

from __future__ import annotations

import json
import subprocess
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from grindvision.book.places import BUILD
from grindvision.errors import GrindvisionError

#: What ``benchmarks/pcl_weld.cpp`` is built to; its first lines tell how.
PCL_WELD = BUILD / "pcl_weld"


def pcl_weld(points: ArrayLike, smoothing_mm: float, threshold_deg: float) -> dict[str, float] | None:
    """Seconds of the welding recipe on PCL, stage by stage and ``total_s``, or None where it has not been built.

    Args:
        points: cloud (N, 3), mm.
        smoothing_mm: radius of its moving least squares.
        threshold_deg: of the groove descriptor.

    Raises:
        GrindvisionError: the program failed.
    """
    if not PCL_WELD.is_file():
        return None
    with tempfile.TemporaryDirectory() as folder:
        cloud = Path(folder) / "cloud.f32"
        np.asarray(points, dtype=np.float32).tofile(cloud)
        words = [str(PCL_WELD), str(cloud), f"{smoothing_mm:g}", f"{threshold_deg:g}"]
        done = subprocess.run(words, capture_output=True, text=True, timeout=600)
    if done.returncode:
        raise GrindvisionError(f"{PCL_WELD} failed: {done.stderr.strip() or done.returncode}; build it anew")
    return json.loads(done.stdout)
