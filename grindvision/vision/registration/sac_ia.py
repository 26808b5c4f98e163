"""Sample consensus initial alignment (section 3.3) as the paper describes it, from similar FPFH.

Where the text is silent it does what PCL does, with which the authors worked: three samples; a minimum distance that is
silently halved when no sample keeps it; the correspondence drawn at random from the ``similar`` nearest histograms;
Huber's error (Eq 6) of the **squared** distance, compared with a threshold that is a length. Our own variant is
``grindvision.vision.registration.global_registration``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import DegenerateError
from grindvision.geometry import fit_rigid, move_points, rigid, small_motion
from grindvision.parallel import one_blas_thread
from grindvision.records import by_content
from grindvision.vision.surface.keypoints import Keypoints, most_similar

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

_BATCH = 1000
"""Poses computed at once."""


@by_content
@dataclass(frozen=True)
class CoarseRegistration:
    """A first pose: ``T_target_source`` (4, 4), its ``error`` (mean Huber error; of squared distances in mm^2), and the
    number of samples tried."""

    T_target_source: Floats
    error: float
    tried: int

    def __str__(self) -> str:
        return f"SAC-IA: error {self.error:.4g} after {self.tried} samples"


@one_blas_thread()
def sac_ia_paper(
    source: Keypoints,
    target: Keypoints,
    rng: np.random.Generator,
    iterations: int = 1000,
    min_distance_mm: float | None = None,
    threshold_mm: float | None = None,
    similar: int = 10,
    refine: bool = True,
) -> CoarseRegistration:
    """SAC-IA as the paper describes it (steps 1-3 and the Levenberg-Marquardt refinement).

    Args:
        min_distance_mm: minimum distance of the three samples (the paper's d_min); a tenth of the extent if left out.
        threshold_mm: the t_e of Eq 6, compared with the squared distance as PCL does; five spacings if left out.
        similar: the correspondence is drawn from so many points of most similar histograms.
        refine: run the Levenberg-Marquardt refinement.
    """
    from scipy.spatial import cKDTree

    if len(source) < 3 or len(target) < similar:
        raise DegenerateError(
            f"{len(source)} and {len(target)} keypoints are too few; scan more of the part, or more densely"
        )
    d_min = 0.1 * float(np.linalg.norm(np.ptp(source.points, axis=0))) if min_distance_mm is None else min_distance_mm
    t_e = 5 * target.spacing_mm if threshold_mm is None else float(threshold_mm)
    tree = cKDTree(target.points)
    alike = most_similar(source.features, target.features, similar)
    best, least = np.eye(4), np.inf
    for first in range(0, iterations, _BATCH):
        drawn = []
        for _ in range(first, min(first + _BATCH, iterations)):
            samples, d_min = _spread_samples(source.points, d_min, rng)
            drawn.append((samples, alike[samples, rng.integers(similar, size=3)]))
        threes = np.array(drawn)
        poses, defined = _poses_of_threes(source.points[threes[:, 0]], target.points[threes[:, 1]])
        found, least = _best_pose(poses[defined], source.points, tree, t_e, least)
        if found >= 0:
            samples, partners = threes[defined][found]
            best = fit_rigid(source.points[samples], target.points[partners]).T_target_source
            least = float(_penalties(move_points(best, source.points), tree, t_e).mean())
    if refine:
        best = refine_pose(source.points, target.points, best, t_e)
        least = float(_penalties(move_points(best, source.points), tree, t_e).mean())
    return CoarseRegistration(best, least, iterations)


def _poses_of_threes(source: Floats, target: Floats) -> tuple[Floats, Flags]:
    """Poses (K, 4, 4) as ``fit_rigid`` finds them of three points each (K, 3, 3), and whether these lie on no line."""
    thirds, defined = np.full(3, 1 / 3), np.ones(len(source), dtype=bool)
    centres = [thirds @ points for points in (source, target)]
    apart = [points - centre[:, None] for points, centre in zip((source, target), centres, strict=True)]
    for points, differences in zip((source, target), apart, strict=True):
        singular = np.linalg.svd(np.sqrt(1 / 3) * differences, compute_uv=False)
        sizes = np.abs(points).max(axis=(1, 2)) * 1e-6
        defined &= singular[:, 1] > 1e-9 * np.maximum(singular[:, 0], sizes)
    u, _, vt = np.linalg.svd(apart[1].swapaxes(1, 2) @ (apart[0] / 3))
    u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
    poses = np.tile(np.eye(4), (len(source), 1, 1))
    poses[:, :3, :3] = u @ vt
    poses[:, :3, 3] = centres[1] - (poses[:, :3, :3] @ centres[0][:, :, None])[:, :, 0]
    return poses, defined


def _best_pose(poses: Floats, points: Floats, tree: cKDTree, threshold: float, least: float) -> tuple[int, float]:
    """Index of the pose of least mean penalty, and that penalty; -1 and ``least``, where none has less than that.

    A pose is given up when a part of the points is farther off already than all points of the best pose; the most
    promising poses come first.
    """
    step, found = max(len(points) // 50, 1), -1
    spread = points[np.argsort(np.arange(len(points)) % step, kind="stable")]
    first, *further = np.split(spread, [len(points[::step]) * 3**k for k in range(3)])
    moved = first @ poses[:, :3, :3].swapaxes(1, 2) + poses[:, None, :3, 3]
    sums = _penalties(moved, tree, threshold).sum(axis=1)
    for pose in np.argsort(sums, kind="stable"):
        total = sums[pose]
        for part in further:
            if total > (1 + 1e-9) * least * len(points):
                break
            total += _penalties(move_points(poses[pose], part), tree, threshold).sum()
        else:
            value = float(_penalties(move_points(poses[pose], points), tree, threshold).mean())
            if value < least or (value == least and pose < found):
                least, found = value, int(pose)
    return found, least


def _penalties(moved: Floats, tree: cKDTree, threshold: float) -> Floats:
    """Penalties (..., N) of the squared distances of moved points (..., N, 3) from those of a tree."""
    return huber(tree.query(moved)[0] ** 2, threshold)


def huber(errors: ArrayLike, threshold: float) -> Floats:
    """Huber's penalty (Eq 6): half the square up to the threshold t_e, then growing linearly."""
    size = np.abs(np.asarray(errors, dtype=float))
    return np.where(size <= threshold, 0.5 * size**2, 0.5 * threshold * (2 * size - threshold))


def refine_pose(source: ArrayLike, target: ArrayLike, T_start: ArrayLike, threshold_mm: float) -> Floats:
    """Levenberg-Marquardt refinement of a pose: least Huber penalty of the distances to the nearest target points.

    Step and Jacobian are taken by finite differences of the distances themselves (Fitzgibbon 2003).
    """
    from scipy.optimize import least_squares
    from scipy.spatial import cKDTree

    tree, T_start = cKDTree(target), np.asarray(T_start, dtype=float)
    centre = move_points(T_start, source).mean(axis=0)
    to_centre, back = rigid(None, -centre), rigid(None, centre)
    extent = float(np.sqrt(((move_points(T_start, source) - centre) ** 2).sum(axis=1).mean()))
    scale = np.array([1, 1, 1, 1 / extent, 1 / extent, 1 / extent])

    def pose(motion: Floats) -> Floats:
        return np.asarray(back @ small_motion(motion * scale) @ to_centre @ T_start)

    def residuals(motion: Floats) -> Floats:
        distances, _ = tree.query(move_points(pose(motion), source))
        return np.sqrt(huber(distances, threshold_mm))

    return pose(least_squares(residuals, np.zeros(6), method="lm", diff_step=1e-4, max_nfev=200).x)


def _spread_samples(points: Floats, least: float, rng: np.random.Generator) -> tuple[list[int], float]:
    """Three indices at least ``least`` apart; the distance is halved after 3 N vain draws, as in PCL."""
    samples: list[int] = []
    vain = 0
    while len(samples) < 3:
        index = int(rng.integers(len(points)))
        if all(index != other and np.linalg.norm(points[index] - points[other]) >= least for other in samples):
            samples.append(index)
            vain = 0
        else:
            vain += 1
            if vain >= 3 * len(points):
                least, vain = least / 2, 0
    return samples, least
