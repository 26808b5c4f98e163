"""Peers that are no Python packages: used where ``./run bench`` has built them, left out where not."""

from __future__ import annotations

import json
import subprocess
import tempfile
from pathlib import Path

from numpy.typing import ArrayLike

from grindvision.clouds import write_ply
from grindvision.errors import GrindvisionError
from grindvision_book.places import BUILD

#: What ``benchmarks/peers/pcl_weld.cpp`` is built to.
PCL_WELD = BUILD / "peers" / "pcl_weld"


def pcl_weld(points: ArrayLike, smoothing_mm: float, threshold_deg: float) -> dict[str, float] | None:
    """Seconds of the welding recipe on PCL, stage by stage and ``total_s``, or None where it has not been built.

    Args:
        points: cloud (N, 3), mm.
        smoothing_mm: radius of its moving least squares.
        threshold_deg: of the groove descriptor, within 5 mm.

    Raises:
        GrindvisionError: the program failed.
    """
    if not PCL_WELD.is_file():
        return None
    with tempfile.TemporaryDirectory() as folder:
        cloud = Path(folder) / "cloud.ply"
        write_ply(cloud, points)
        words = [
            str(PCL_WELD),
            str(cloud),
            str(Path(folder) / "labels"),
            f"{smoothing_mm:g}",
            "5",
            f"{threshold_deg:g}",
        ]
        done = subprocess.run(words, capture_output=True, text=True, timeout=600)
    if done.returncode:
        raise GrindvisionError(f"{PCL_WELD} failed: {done.stderr.strip() or done.returncode}; run ./run bench")
    laps = json.loads(done.stdout)["laps_s"]
    laps.pop("read")
    return {**{f"{stage}_s": seconds for stage, seconds in laps.items()}, "total_s": sum(laps.values())}
