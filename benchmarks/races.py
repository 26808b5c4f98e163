"""The races: who runs, on what, and how the answers are judged."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from benchmarks import inputs, judging
from benchmarks.racing import Case, Judge, Racer


@dataclass(frozen=True)
class Plan:
    """How much to run: ``rounds`` per case, ``poses`` of the first alignment, ``sizes`` of the scans, ``seed``."""

    rounds: int = 5
    poses: int = 20
    sizes: tuple[str, ...] = ("500k", "2M", "200k", "50k")
    seed: int = 10

    @property
    def complete(self) -> bool:
        """Whether nothing is left out, so that the results may stand in ``figures/``."""
        return self.rounds >= 5 and self.poses >= 20 and set(self.sizes) == set(inputs.SIZES)


QUICK = Plan(rounds=1, poses=3, sizes=("50k",))


@dataclass(frozen=True)
class Race:
    """One table: ``cases(plan)`` gives the rounds of each case; of the judged ``accuracy``, ``drawn`` is in the picture."""

    name: str
    title: str
    racers: tuple[Racer, ...]
    cases: Callable[[Plan], Sequence[list[Case]]]
    judge: Judge
    accuracy: tuple[str, ...]
    drawn: tuple[str, ...]


RECIPE = (
    "1 mm voxels, points more than 0.5 mm off the sample, largest cluster, six slabs, mean of each slab's top quarter"
)

DETECT = Race(
    "detect",
    "Whole detection: two scans in files, path points out",
    (
        Racer("grindvision", "ours:detect", "ours", about="vision.detect at its defaults, after clouds.read_cloud"),
        Racer(
            "Open3D", "open3d_peer:detect", needs="open3d",
            about=f"FPFH in 4 mm voxels, RANSAC on mutual matches, plane ICP within 4 and 1 mm; {RECIPE}",
        ),
        Racer(
            "KISS-Matcher + Open3D + SciPy", "kiss_peer:detect", needs="kiss_matcher",
            about=f"KISS-Matcher with 2 mm voxels, Open3D's plane ICP, SciPy's kd-tree on all cores; {RECIPE}",
        ),
        Racer(
            "PCL, best", "pcl_peer:detect", settings={"samples": 200, "icp": "plane"}, needs="PCL", program=True,
            about=f"SAC-IA with 200 samples in 4 mm voxels, plane ICP within 4 and 1 mm; {RECIPE}",
        ),
        Racer(
            "PCL, the paper's recipe", "pcl_peer:detect", settings={"samples": 1000, "icp": "point"}, needs="PCL",
            program=True, about=f"SAC-IA with 1,000 samples, point ICP within 4 mm, 400 iterations; {RECIPE}",
        ),
    ),
    lambda plan: [inputs.detection_cases(size, plan.rounds, plan.seed) for size in plan.sizes],
    judging.judge_detection,
    ("rotation_deg", "shift_mm", "path_mean_mm", "path_max_mm"),
    ("shift_mm", "path_mean_mm"),
)  # fmt: skip

LARGE = Race(
    "large",
    "Whole detection of 20 million points a scan",
    DETECT.racers[:2],
    lambda plan: [inputs.large_cases(plan.seed)],
    judging.judge_detection,
    DETECT.accuracy,
    (),
)

RACES = (DETECT,)
ON_DEMAND = (LARGE,)
