"""grindvision's own racers: the public functions at their defaults."""

from __future__ import annotations

from benchmarks.peers.laps import Laps
from grindvision import vision
from grindvision.clouds import read_cloud
from grindvision.vision.detection import detect as _detect  # noqa: F401  imports belong before the clock


def detect(sample: str, test: str) -> dict:
    """Two scans in, path points out."""
    lap = Laps()
    clouds = [read_cloud(path).points for path in (sample, test)]
    lap("read")
    found = vision.detect(*clouds)
    path = found.path_points[:6]
    return {"T_sample_test": found.T_sample_test, "path": path, "laps_s": {**lap.laps_s, **found.timings_s}}
