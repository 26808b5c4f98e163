"""Accuracy of the racers' answers against the truth: the same yardstick for everyone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from benchmarks.racing import Arrays
from grindvision.geometry import angle_between, move_points

Floats = NDArray[np.float64]

WRONG_TURN_DEG, WRONG_SHIFT_MM = 5.0, 5.0
"""A first alignment farther off than this has failed."""

WRONG_OVERLAP = 30.0
"""A groove that overlaps the true one by less percent has not been found."""

WRONG_PATH_MM, MIN_SPAN = 2.0, 0.6
"""A path that lies farther from the ridge in the mean, or runs along less of it, does not follow the bead."""


def judge_pose(answer: Arrays, truth: Arrays) -> dict[str, float]:
    """Turn in degrees, and shift in mm at the middle of the test scan, of the pose from the true one."""
    true, found, middle = truth["T_sample_test"], answer["T_sample_test"], truth["middle"]
    shift = move_points(found, middle) - move_points(true, middle)
    turn_deg, shift_mm = np.degrees(angle_between(true, found)), float(np.linalg.norm(shift))
    failed = not (turn_deg <= WRONG_TURN_DEG and shift_mm <= WRONG_SHIFT_MM)
    return {"rotation_deg": float(turn_deg), "shift_mm": shift_mm, "failed": float(failed)}


def judge_detection(answer: Arrays, truth: Arrays) -> dict[str, float]:
    """The pose, and the path's distances from the bead's true ridge."""
    pose, path = judge_pose(answer, truth), judge_path(answer["path"], truth["ridge"])
    return {**pose, **path, "failed": max(pose["failed"], path["failed"])}


def judge_path(path: Floats, line: Floats) -> dict[str, float]:
    """Mean and largest distance in mm of path points (n, 3) from a line (K, 3), and the share of it they span."""
    if len(path) < 2 or not np.isfinite(path).all():
        return {"path_mean_mm": np.nan, "path_max_mm": np.nan, "path_span": 0.0, "failed": 1.0}
    distances, arcs = beside(path, line)
    mean, span = float(distances.mean()), float(np.ptp(arcs))
    failed = mean > WRONG_PATH_MM or span < MIN_SPAN
    return {"path_mean_mm": mean, "path_max_mm": float(distances.max()), "path_span": span, "failed": float(failed)}


def judge_nothing(answer: Arrays, truth: Arrays) -> dict[str, float]:
    """For processes of which only the time counts; what goes wrong in them is an error."""
    return {"failed": 0.0}


def beside(points: Floats, line: Floats) -> tuple[Floats, Floats]:
    """Distances (n,) of points from a line (K, 3) of straight pieces, and where along it they lie, 0..1."""
    starts, steps = line[:-1], np.diff(line, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    along = np.einsum("nkj,kj->nk", points[:, None] - starts, steps) / lengths**2
    along = np.clip(along, 0.0, 1.0)
    away = np.linalg.norm(points[:, None] - starts - along[..., None] * steps, axis=2)
    piece = away.argmin(axis=1)
    rows = np.arange(len(points))
    arcs = (np.cumsum(lengths) - lengths)[piece] + along[rows, piece] * lengths[piece]
    return away[rows, piece], arcs / lengths.sum()


def judge_difference(answer: Arrays, truth: Arrays) -> dict[str, float]:
    """The share of the bead's points that was found, and the overlap with them of all that was found, in percent.

    The answer holds ``changed`` flags (N,) of the test scan, or the ``points`` (K, 3) of it that stand out.
    """
    bead = truth["on_bead"]
    found = answer["changed"] if "changed" in answer else among(truth["points"], answer["points"])
    share = float(100 * (found & bead).sum() / bead.sum())
    return {"bead_percent": share, "overlap_percent": overlap_percent(found, bead), "failed": float(share < 50)}


def judge_voxels(answer: Arrays, truth: Arrays) -> dict[str, float]:
    """How far a centroid lies at most from that of the points of its voxel, with the answer's own lattice."""
    points, size, origin = answer["points"], float(answer["size_mm"]), answer["origin"]
    known = truth["points"]
    cells, cell, count = np.unique(np.floor((known - origin) / size), axis=0, return_inverse=True, return_counts=True)
    sums = np.stack([np.bincount(cell.ravel(), column, len(cells)) for column in known.T], axis=1)
    away, _ = cKDTree(sums / count[:, None]).query(points)
    shifted = float(np.quantile(away, 0.99))
    return {"voxels": len(points), "centroid_error_mm": shifted, "failed": float(shifted > 0.01 * size)}


def judge_features(answer: Arrays, truth: Arrays) -> dict[str, float]:
    """Of the test points, the share whose most similar sample point lies within 5 mm of the same place, in percent."""
    own = move_points(truth["T_sample_test"], truth["test"])
    _, match = cKDTree(answer["sample"]).query(answer["test"])
    right = np.linalg.norm(own - truth["sample"][match], axis=1) < 5.0
    return {"matches_percent": float(100 * right.mean()), "failed": float(right.mean() < 0.02)}


def judge_weld(answer: Arrays, truth: Arrays) -> dict[str, float]:
    """Overlap of the groove with the true one, and the way points' distances from its root."""
    overlap = overlap_percent(answer["labels"], truth["labels"])
    path = judge_path(answer["path"], truth["root"])
    return {"overlap_percent": overlap, **path, "failed": float(overlap < WRONG_OVERLAP or path["path_span"] == 0)}


def judge_calibration(answer: Arrays, truth: Arrays) -> dict[str, float]:
    """Distances in mm of the held-out spheres, as the calibrated cell places them, from where they truly are."""
    errors = np.linalg.norm(answer["held_out"] - truth["held_out"], axis=1)
    return {
        "error_mean_mm": float(errors.mean()),
        "error_max_mm": float(errors.max()),
        "failed": float(not errors.mean() < 1.0),
    }


def overlap_percent(found: NDArray[np.bool_], true: NDArray[np.bool_]) -> float:
    """Points found and true over points found or true, in percent."""
    return float(100 * (found & true).sum() / max((found | true).sum(), 1))


def among(points: Floats, chosen: Floats) -> NDArray[np.bool_]:
    """Mark the points (N,) of a cloud that occur in ``chosen`` (K, 3), to a thousandth of a millimetre."""
    marked = np.zeros(len(points), dtype=bool)
    if len(chosen):
        distances, rows = cKDTree(points).query(chosen)
        marked[rows[distances < 1e-3]] = True
    return marked
