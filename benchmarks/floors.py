"""How far each stage of detection is from what the machine allows: bytes to move, neighbours to visit, sums to make.

A floor counts only what no method can do without: every point read once to know the cloud's extent and once to be put
into its cell, one nearest surfel per point and iteration, and so on. It is reached by nobody; the ratio says where time
might be found.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from benchmarks import inputs, machine
from benchmarks.peers.laps import Laps
from benchmarks.races import Plan
from grindvision.clouds import read_cloud
from grindvision.vision.change.detection import Detection, detect

POINT_BYTES = 24
FEATURE_NUMBERS = 33
DISC = np.pi * np.array([2.5, 5.0]) ** 2
"""Voxels within the radii of normals and FPFH, 2.5 and 5 voxels, on a surface."""


@dataclass(frozen=True)
class Work:
    """What a stage must do: ``bytes`` to move, table rows to ``visit``, ``sums`` of two multiplied numbers."""

    bytes: float
    visits: float
    sums: float
    why: str


def least_work(found: Detection) -> dict[str, Work]:
    """The least work of each stage for a detection that was made."""
    points = len(found.sample.points) + len(found.test.points)
    keys = [len(scan.keypoints) for scan in (found.sample, found.test)]
    described = sum(keys) * (DISC[0] + 2 * DISC[1])
    pieces = [cluster.points for cluster in found.difference.clusters]
    matched, verified = found.registration, found.coarse.registration
    return {
        "read": Work(points * (12 + POINT_BYTES), 0, 0, "float32 in the file to float64 in memory"),
        "features": Work(
            2 * points * POINT_BYTES, described, 0, "points read twice; normals once, FPFH twice per pair"
        ),
        "coarse": Work(0, 0, float(np.prod(keys)) * FEATURE_NUMBERS, "every histogram against every other"),
        "verification": Work(0, 3 * 1000 * verified.iterations, 0, "3 poses, 1,000 surfels, one visit per iteration"),
        "icp": Work(0, 9 * 6000 * matched.iterations, 0, "6,000 surfels, the planes around each foot per iteration"),
        "difference": Work(0, 9 * len(found.test.surfels), 0, "every surfel, the planes around its foot"),
        "path": Work(0, sum(map(len, pieces)), 0, "every point that stands out"),
    }


def floors(plan: Plan, rounds: int = 5) -> tuple[pd.DataFrame, list[str]]:
    """Measured seconds of each stage beside its floor, for every size; and what the machine's rates are."""
    mib_per_s, sums_per_s = machine.copied_mib_per_s(), machine.sums_per_s()
    rows, visit_ns = [], []
    for size in plan.stage_sizes:
        case = inputs.detection_cases(size, 1, plan.seed)[0]
        taken: list[dict[str, float]] = []
        for _ in range(rounds + 1):
            lap = Laps()
            sample, test = (read_cloud(case.inputs[of]).points for of in ("sample", "test"))
            lap("read")
            found = detect(sample, test)
            taken.append({**lap.laps_s, **found.timings_s})
        del taken[0]  # the warm-up
        work = least_work(found)
        visit = machine.visit_s(len(found.test.surfels))
        visit_ns.append(f"{1e9 * visit:.2f} ns ({len(found.test.surfels):,} rows)")
        for stage in taken[0]:
            measured = float(np.median([one[stage] for one in taken]))
            own = work.get(stage, Work(np.nan, np.nan, np.nan, "not counted"))
            floor = own.bytes / 2**20 / mib_per_s + own.visits * visit + own.sums / sums_per_s
            rows.append(
                {
                    "size": size, "stage": stage, "measured_s": measured, "floor_s": floor,
                    "of_floor": measured / floor, "move_mib": own.bytes / 2**20, "visits": own.visits,
                    "million_sums": own.sums / 1e6, "why": own.why,
                }
            )  # fmt: skip
    table = pd.DataFrame(rows)
    rates = [
        f"Measured here: memory moves {mib_per_s / 1024:.1f} GiB/s in one thread, read and written; a point is fetched"
        f" from a random row of a table in {', '.join(visit_ns)}; BLAS does {sums_per_s / 1e9:.0f} thousand million"
        " multiply-adds of float32 a second on all cores."
    ]
    return table, rates
