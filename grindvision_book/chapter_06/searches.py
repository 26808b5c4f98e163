"""Nearest-neighbour searches of several libraries, side by side on the same points (chapter 06)."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import cv2
import numpy as np
import open3d as o3d
import small_gicp
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from grindvision.geometry.hash_grid import build_cells
from grindvision.geometry.neighbours import nearest

if TYPE_CHECKING:
    import pandas as pd

Floats = NDArray[np.float64]
Search = Callable[[Floats], Floats]

#: Edge of the cells of our grid, and how far it looks, mm.
CELL_MM, MAX_MM = 2.0, 60.0

#: Points that FLANN tunes its parameters on.
TUNED_ON = 1000

_KD_TREES = {"algorithm": 1, "trees": 4}
_AUTOTUNED = {"algorithm": 255}


def race(points: Floats, queries: Floats, autotune: bool = True) -> pd.DataFrame:
    """Build each search on ``points`` (N, 3), ask it for the neighbours of ``queries`` (M, 3), and judge its answer.

    Args:
        autotune: let FLANN look for its parameters too, on the first ``TUNED_ON`` points alone: it takes longer than
            everything else. Its index is then asked, and judged, on those points.

    Returns:
        One row per search: ``search``, ``build_s``, ``query_s``, and ``recall_percent``, the share of queries that got
        their true nearest neighbour.
    """
    import pandas as pd

    searches: dict[str, Callable[[Floats], Search]] = {
        "FLANN kd-trees (OpenCV)": _flann,
        "SciPy kd-tree": _scipy,
        "Open3D": _open3d,
        "small_gicp kd-tree": _small_gicp,
        "grid of cells (ours)": _grid,
    }
    if autotune:
        searches[f"FLANN, autotuned, on {TUNED_ON:,} points alone"] = _tuned_flann
    rows = []
    for name, build in searches.items():
        searched = points[:TUNED_ON] if build is _tuned_flann else points
        truth = cKDTree(searched).query(queries)[0]
        start = time.perf_counter()
        search = build(searched)
        built = time.perf_counter()
        found = search(queries)
        done = time.perf_counter()
        rows.append((name, built - start, done - built, 100 * np.mean(found <= truth + 1e-3)))
    return pd.DataFrame(rows, columns=["search", "build_s", "query_s", "recall_percent"])


def _flann(points: Floats) -> Search:
    return _opencv(points, _KD_TREES)


def _tuned_flann(points: Floats) -> Search:
    return _opencv(points, _AUTOTUNED)


def _opencv(points: Floats, parameters: dict[str, int]) -> Search:
    index = cv2.flann_Index(points.astype(np.float32), parameters)
    return lambda queries: np.sqrt(index.knnSearch(queries.astype(np.float32), 1, params={})[1].ravel())


def _open3d(points: Floats) -> Search:
    search = o3d.core.nns.NearestNeighborSearch(o3d.core.Tensor(points))
    search.knn_index()
    return lambda queries: np.sqrt(search.knn_search(o3d.core.Tensor(queries), 1)[1].numpy().ravel())


def _scipy(points: Floats) -> Search:
    tree = cKDTree(points)
    return lambda queries: tree.query(queries)[0]


def _small_gicp(points: Floats) -> Search:
    tree = small_gicp.KdTree(points)
    return lambda queries: np.sqrt(np.asarray(tree.batch_nearest_neighbor_search(queries)[1]).ravel())


def _grid(points: Floats) -> Search:
    cells = build_cells(points, CELL_MM)
    return lambda queries: nearest(cells, queries, MAX_MM)[1]
