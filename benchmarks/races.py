"""The races: who runs, on what, and how the answers are judged."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from benchmarks import inputs, judging
from benchmarks.entries import open3d, ours, pcl, process, small_gicp
from benchmarks.hand_eye_race import judge_hand_eye
from benchmarks.racing import Case, Judge, Racer
from grindvision.cell import KINDS

LARGE_CAMERA = 4.4
"""Pixels of a camera over those of the D415, along a row, that sees five million points of a plate."""


@dataclass(frozen=True)
class Plan:
    """How much to run.

    ``rounds`` per case, ``scenes`` on which whole detections are judged, ``poses`` of the first alignment, ``sizes`` of
    the scans for the whole and ``stage_sizes`` for single stages, ``pieces`` to weld, ``arm_poses`` to calibrate with,
    ``sequences`` of hand-eye poses, ``seed``.
    """

    rounds: int = 5
    scenes: int = 20
    poses: int = 20
    sizes: tuple[str, ...] = ("50k", "200k", "500k", "2M")
    stage_sizes: tuple[str, ...] = ("500k", "2M")
    pieces: tuple[str, ...] = KINDS
    arm_poses: tuple[str, ...] = tuple(inputs.SPHERES)
    sequences: int = 200
    seed: int = 10

    @property
    def complete(self) -> bool:
        """Whether nothing is left out, so that the results may stand in ``figures/``."""
        full = Plan()
        least = all(getattr(self, name) >= getattr(full, name) for name in ("rounds", "scenes", "poses", "sequences"))
        return least and (self.sizes, self.pieces) == (full.sizes, full.pieces)


QUICK = Plan(
    rounds=1, scenes=2, poses=2, sizes=("50k",), stage_sizes=("50k",), pieces=("box",), arm_poses=("54",), sequences=20,
)  # fmt: skip


@dataclass(frozen=True)
class Race:
    """One table: ``cases(plan)`` gives the rounds of each case.

    Of the answers ``accuracy`` is judged, and of it ``drawn`` is in the picture. In the race of a ``stage`` the time to
    read the files does not count. ``more(plan)`` gives further rounds of some cases, in which only the answers count,
    and only those of racers that are no programs of their own: those are slow.
    """

    name: str
    title: str
    racers: tuple[Racer, ...]
    cases: Callable[[Plan], Sequence[list[Case]]]
    judge: Judge
    accuracy: tuple[str, ...]
    drawn: tuple[str, ...]
    stage: bool = True
    spare: bool = True
    lap: str = ""
    more: Callable[[Plan], Sequence[list[Case]]] = lambda plan: []


PATH = "largest cluster that stands out by 0.5 mm, six slabs, mean of each slab's highest quarter"
NEAREST = "points farther than 0.5 mm from their nearest neighbour"


DETECT = Race(
    "detect",
    "Whole detection: two scan files in, path points out",
    (
        ours("grindvision", "detect", "clouds.read_cloud, vision.detect at its defaults"),
        open3d("Open3D", "detect", f"FPFH in 4 mm voxels, RANSAC on mutual matches, plane ICP on 1 mm voxels; {PATH}"),
        Racer(
            "KISS-Matcher + Open3D + SciPy", "kiss_peer:detect", needs="kiss_matcher",
            about=f"KISS-Matcher in 2 mm voxels, Open3D's plane ICP on 1 mm voxels, SciPy's kd-tree; {PATH}",
        ),
        pcl("PCL, best", "detect", f"SAC-IA, 200 samples, 4 mm voxels, plane ICP; {PATH}", samples=200, icp="plane"),
        pcl(
            "PCL, the paper's recipe", "detect", f"SAC-IA, 1,000 samples, 4 mm voxels, point ICP; {PATH}",
            samples=1000, icp="point",
        ),
    ),
    lambda plan: [inputs.detection_cases(size, plan.rounds, plan.seed) for size in plan.sizes],
    judging.judge_detection,
    ("rotation_deg", "shift_mm", "path_mean_mm", "path_max_mm"),
    ("shift_mm", "path_mean_mm"),
    stage=False,
    more=lambda plan: [
        inputs.detection_cases(size, plan.scenes, plan.seed)[plan.rounds :] for size in plan.stage_sizes
    ],
)  # fmt: skip

COARSE = Race(
    "coarse",
    "First alignment of two scans, features included",
    (
        ours("grindvision", "coarse", "features, proposals and verification of vision.detect"),
        open3d("Open3D RANSAC, 4 mm", "coarse", "FPFH, RANSAC on mutual matches, 100,000 tries", voxel_mm=4.0),
        open3d("Open3D RANSAC, 2 mm", "coarse", "the same in 2 mm voxels, a million tries", voxel_mm=2.0, tries=10**6),
        Racer("KISS-Matcher, 2 mm", "kiss_peer:coarse", about="its own defaults, 2 mm voxels", needs="kiss_matcher"),
        pcl(
            "PCL SAC-IA, 4 mm", "coarse", "1,000 samples, the five most similar histograms, 4 mm voxels",
            method="sacia", voxel_mm=4.0, tries=1000,
        ),
        pcl(
            "PCL prerejective, 2 mm", "coarse", "20,000 tries, the five most similar histograms, 2 mm voxels",
            method="prerejective", voxel_mm=2.0, tries=20_000,
        ),
    ),
    lambda plan: [inputs.coarse_cases(hard, plan.poses, plan.seed) for hard in (False, True)],
    judging.judge_pose,
    ("rotation_deg", "shift_mm"),
    ("shift_mm",),
    spare=False,
)  # fmt: skip

GROOVE = Race(
    "groove",
    "Cloud to groove, and on to way points",
    (
        ours("grindvision", "groove", "vision.trace_weld at its defaults", variant="ours"),
        ours("the paper's method", "groove", "vision.trace_weld(variant='paper')", "paper_variant", variant="paper"),
        pcl(
            "PCL, fastest", "groove", "moving least squares 4 mm, normals and histograms 5 mm, threshold 9 deg",
            smoothing_mm=4.0, radius_mm=5.0, threshold_deg=9.0,
        ),
        pcl(
            "PCL, smoothest", "groove", "moving least squares 8 mm, normals and histograms 6 mm, threshold 9 deg",
            smoothing_mm=8.0, radius_mm=6.0, threshold_deg=9.0,
        ),
        Racer(
            "Open3D + NumPy", "open3d_peer:groove", settings={"radius_mm": 5.0, "threshold_deg": 8.0}, needs="open3d",
            about="normals and histograms 5 mm, threshold 8 deg, no smoothing", warm_up=False,
        ),
    ),
    lambda plan: [inputs.groove_cases(kind, plan.rounds, plan.seed) for kind in plan.pieces],
    judging.judge_weld,
    ("overlap_percent", "path_mean_mm", "path_max_mm"),
    ("overlap_percent", "path_mean_mm"),
    lap="groove",
)  # fmt: skip

DIFFERENCE = Race(
    "difference",
    "What stands out of the sample, the scans being in one frame",
    (
        ours("grindvision", "difference", "surfels and features of both scans (prepare), then vision.find_change"),
        open3d("Open3D", "difference", f"compute_point_cloud_distance: {NEAREST}"),
        Racer("SciPy", "scipy_peer:difference", about=f"cKDTree on all cores: {NEAREST}", needs="scipy"),
        small_gicp("small_gicp", "difference", f"KdTree on all cores: {NEAREST}"),
        pcl("PCL", "difference", f"kd-tree on all cores: {NEAREST}"),
        Racer(
            "CloudCompare", "cloudcompare_peer:difference", needs="CloudCompare", warm_up=False,
            about=f"C2C_DIST, times from its log, memory not measured: {NEAREST}",
        ),
    ),
    lambda plan: [inputs.difference_cases(size, plan.rounds, plan.seed) for size in plan.stage_sizes],
    judging.judge_difference,
    ("bead_percent", "overlap_percent"),
    ("overlap_percent",),
    lap="difference",
)  # fmt: skip

ICP = Race(
    "icp",
    "ICP from 2 degrees and 1.5 mm off: voxels and normals included",
    (
        ours("grindvision, planes", "icp", "vision.icp_planes on surfels"),
        ours("grindvision, points", "icp_paper", "vision.icp_points on 1 mm voxels, as the paper", "paper_variant"),
        open3d("Open3D, planes", "icp", "1 mm voxels, within 4 and then 1 mm"),
        small_gicp("small_gicp, GICP", "icp", "1 mm voxels, within 4 and then 1 mm", method="GICP"),
        small_gicp("small_gicp, planes", "icp", "1 mm voxels, within 4 and then 1 mm", method="PLANE_ICP"),
        pcl("PCL, planes", "icp", "1 mm voxels, within 4 and then 1 mm", method="plane"),
        pcl("PCL, points", "icp", "1 mm voxels, within 4 mm, at most 400 iterations", method="point"),
    ),
    lambda plan: [inputs.icp_cases(plan.stage_sizes[0], plan.rounds, plan.seed)],
    judging.judge_pose,
    ("rotation_deg", "shift_mm"),
    ("rotation_deg", "shift_mm"),
    lap="icp",
)

CALIBRATION = Race(
    "calibration",
    "Calibration of scanner, arm and base",
    (
        ours("grindvision", "calibrate", "calibration.calibrate at its defaults: covariance and rank included"),
        Racer(
            "SciPy least squares", "scipy_peer:calibrate", needs="scipy",
            about="least_squares with its numerical Jacobian over 32 numbers, no covariance",
        ),
    ),
    lambda plan: [inputs.calibration_cases(poses, plan.rounds, plan.seed) for poses in plan.arm_poses],
    judging.judge_calibration,
    ("error_mean_mm", "error_max_mm"),
    ("error_mean_mm",),
)  # fmt: skip

HAND_EYE = Race(
    "hand_eye",
    "Where a camera sits on an arm, from the same poses of arm and board",
    (
        ours("grindvision", "hand_eye", "calibration.hand_eye at its defaults: covariance, poses left out in turn"),
        *(
            Racer(
                f"OpenCV, {method.capitalize()}", "hand_eye_peers:opencv", settings={"method": method},
                needs="cv2.calibrateHandEye",
                about=f"cv2.calibrateHandEye, CALIB_HAND_EYE_{method}",
            )
            for method in ("TSAI", "PARK", "HORAUD", "ANDREFF", "DANIILIDIS")
        ),
        *(
            Racer(
                f"kinhec, {method}" + ", refined" * refined, "hand_eye_peers:kinhec", needs="kinhec",
                settings={"method": method, "refined": refined}, warm_up=not refined,
                about=f"solvers.{method}{equation}" + (", then its least squares" if refined else ""),
            )
            for method, equation, refined in (
                ("park_martin", " on all pairs of poses", False), ("daniilidis", " on all pairs of poses", False),
                ("shah", "", False), ("shah", "", True),
            )
        ),
    ),
    lambda plan: [inputs.hand_eye_cases(plan.sequences, plan.seed)],
    judge_hand_eye,
    ("shift_mm", "rotation_deg", "shift_90_mm", "rotation_90_deg"),
    ("shift_mm", "rotation_deg"),
    spare=False,
)  # fmt: skip

VOXEL = Race(
    "voxel",
    "Voxel grid filter of 2 mm",
    (
        ours("grindvision", "voxels", "voxel_grid: centroids, counts, and the voxel of every point"),
        open3d("Open3D", "voxels", "voxel_down_sample"),
        small_gicp("small_gicp", "voxels", "voxelgrid_sampling, one thread"),
        pcl("PCL", "voxels", "VoxelGrid"),
    ),
    lambda plan: [inputs.voxel_cases(size, plan.rounds, plan.seed) for size in plan.stage_sizes],
    judging.judge_voxels,
    ("voxels", "centroid_error_mm"),
    ("centroid_error_mm",),
)

FPFH = Race(
    "fpfh",
    "FPFH of two scans in 2 mm voxels, radius 10 mm",
    (
        ours("grindvision", "fpfh", "compute_fpfh"),
        open3d("Open3D", "fpfh", "compute_fpfh_feature"),
        pcl("PCL", "fpfh", "FPFHEstimationOMP"),
    ),
    lambda plan: [inputs.fpfh_cases(plan.stage_sizes[0], plan.rounds, plan.seed)],
    judging.judge_features,
    ("matches_percent",),
    ("matches_percent",),
)

OPEN3D_SCRIPT = "from benchmarks.peers.open3d_peer import detect; detect({sample!r}, {test!r})"


STARTUP = Race(
    "startup",
    "Whole processes that do nothing but start",
    (
        process("import grindvision", "ours", "{python}", "-c", "import grindvision"),
        process("grindvision --help", "ours", "{python}", "-m", "grindvision", "--help"),
        process("vision.detect, imported", "ours", "{python}", "-c", "from grindvision import vision; vision.detect"),
        process(
            "one kernel on three points", "ours", "{python}", "-c",
            "import numpy as np; from grindvision import vision; vision.detect;"
            " from grindvision.vision.surface.voxel_grid import voxel_grid; voxel_grid(np.eye(3), 1.0)",
            about="the first call of a compiled kernel: what numba itself takes",
        ),
        process("python, nothing else", "baseline", "{python}", "-c", "pass"),
        process("import open3d", "peer", "{python}", "-c", "import open3d", needs="open3d"),
    ),
    lambda plan: [inputs.process_cases(plan.rounds)],
    judging.judge_nothing,
    (),
    (),
    spare=False,
)  # fmt: skip

FIRST_CALL = Race(
    "first_call",
    "Whole processes that detect: start, imports, files, report",
    (
        process(
            "grindvision detect", "ours", "{python}", "-m", "grindvision", "detect", "{sample}", "{test}", "-o",
            "{folder}/out", about="the command, kernels compiled before, report and picture written",
        ),
        process(
            "grindvision detect, nothing compiled", "ours", "{python}", "-m", "grindvision", "detect", "{sample}",
            "{test}", "-o", "{folder}/out", compiled=False, about="the same on the first day",
        ),
        process(
            "vision.detect in a script", "ours", "{python}", "-c",
            "from benchmarks.peers.ours_grinding import detect; detect({sample!r}, {test!r})",
        ),
        process("Open3D in a script", "peer", "{python}", "-c", OPEN3D_SCRIPT, needs="open3d"),
        process(
            "PCL, best", "peer", "{programs}/pcl_grind", "detect", "{sample}", "{test}", "{folder}/numbers", "200",
            "plane", needs="PCL",
        ),
    ),
    lambda plan: [inputs.detection_cases(plan.stage_sizes[0], plan.rounds, plan.seed)],
    judging.judge_nothing,
    (),
    (),
)  # fmt: skip

LARGE_DETECT = Race(
    "large_detect",
    "Whole detection of 20 million points a scan",
    DETECT.racers[:2],
    lambda plan: [inputs.large_cases(plan.seed)],
    judging.judge_detection,
    DETECT.accuracy,
    (),
    stage=False,
)

LARGE_GROOVE = Race(
    "large_groove",
    "Cloud to groove and way points on 5 million points",
    GROOVE.racers[:1],
    lambda plan: [inputs.groove_cases("line", 1, plan.seed, LARGE_CAMERA)],
    judging.judge_weld,
    GROOVE.accuracy,
    (),
    lap="groove",
)

RACES = (DETECT, COARSE, GROOVE, DIFFERENCE, ICP, CALIBRATION, HAND_EYE, VOXEL, FPFH, STARTUP, FIRST_CALL)
LARGE = (LARGE_DETECT, LARGE_GROOVE)
