"""Shortest ways along graphs: lengths by a plain relaxation, and the way itself."""

import numpy as np

from grindvision.geometry.graphs import edge_graph, farthest, shortest_way, walking_distances
from grindvision.geometry.hash_grid import build_cells
from grindvision.geometry.neighbours import within_radius


def relaxed(starts, ends, lengths, count, start):
    """Lengths of the shortest ways: every edge, both ways, until nothing becomes shorter (Bellman and Ford)."""
    walked = np.full(count, np.inf)
    walked[start] = 0.0
    while True:
        before = walked.copy()
        np.minimum.at(walked, ends, walked[starts] + lengths)
        np.minimum.at(walked, starts, walked[ends] + lengths)
        if (walked == before).all():
            return walked


def test_walking_distances_are_the_shortest(rng):
    points = np.concatenate([rng.uniform(0, 20, (400, 3)), rng.uniform(0, 5, (20, 3)) + 100])
    around = within_radius(build_cells(points, 2.5), points, 2.5)
    starts, ends = np.repeat(np.arange(len(points)), np.diff(around.starts)), around.indices
    lengths = np.sqrt(around.squared_mm2)
    graph = edge_graph(starts, ends, lengths, len(points))
    walked = walking_distances(graph, 7)
    np.testing.assert_allclose(walked, relaxed(starts, ends, lengths, len(points), 7), rtol=1e-12)
    assert np.isinf(walked[-1])
    last = farthest(walked)
    way = shortest_way(graph, 7, last)
    assert way[0] == 7 and way[-1] == last == np.argmax(np.where(np.isfinite(walked), walked, -1))
    assert np.isclose(np.linalg.norm(np.diff(points[way], axis=0), axis=1).sum(), walked[last], rtol=1e-12)
