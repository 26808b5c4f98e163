"""grindvision's own racers of groove detection: the public functions at their defaults."""

from __future__ import annotations

from benchmarks.peers.laps import Answer, Laps
from grindvision.clouds import read_cloud
from grindvision.vision.seam.weld import TraceWeldOptions, trace_weld


def groove(cloud: str, variant: str) -> Answer:
    """A cloud in, groove points and way points out."""
    lap = Laps()
    points = read_cloud(cloud).points
    lap("read")
    found = trace_weld(points, TraceWeldOptions(variant=variant))
    laps = {"groove": found.timings_s["detect"], "trajectory": found.timings_s["path"]}
    return {"labels": found.labels, "path": found.path.points, "laps_s": {**lap.laps_s, **laps}}
