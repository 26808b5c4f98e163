"""The rough course of a bead: walking distances are SciPy's."""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from grindvision.geometry.hash_grid import build_cells
from grindvision.geometry.neighbours import within_radius
from grindvision.vision.change.centreline import walking_distances


def test_walking_distances_are_dijkstra_s(rng):
    points = np.concatenate([rng.uniform(0, 20, (400, 3)), rng.uniform(0, 5, (20, 3)) + 100])
    around = within_radius(build_cells(points, 2.5), points, 2.5)
    rows = np.repeat(np.arange(len(points)), np.diff(around.starts))
    graph = coo_array((np.sqrt(around.squared_mm2), (rows, around.indices)), shape=(len(points),) * 2).tocsr()
    walked = walking_distances(around, 7)
    np.testing.assert_allclose(walked, dijkstra(graph, indices=7))
    assert np.isinf(walked[-1])
