"""Views of one part registered to each other: poses that all pairs agree on; wrong pairs go, free motions are named."""

import re
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from grindvision.errors import AmbiguousError, DegenerateError, GrindvisionWarning, InputError
from grindvision.geometry import angle_between, inverse, random_rotation, rigid
from grindvision.vision.registration import views
from grindvision.vision.registration.view_poses import Tie, closed_ties, triangle_pairs
from grindvision.vision.registration.view_ties import tie_of
from grindvision.vision.registration.views import ViewRegistration, register_views
from tests.hand_eye_scene import part_view


def camera_poses(rng, n=5, turn_deg=25.0):
    """T_part_camera (n, 4, 4) of cameras that look down on the part from 400 mm."""
    down = np.diag([1.0, -1.0, -1.0])
    turns = [down @ Rotation.from_rotvec(np.radians(rng.uniform(-turn_deg, turn_deg, 3))).as_matrix() for _ in range(n)]
    return np.array([rigid(turn, -400.0 * turn[:, 2] + rng.uniform(-20, 20, 3)) for turn in turns])


def seen(seed, n=5, **kind):
    rng = np.random.default_rng(seed)
    poses = camera_poses(rng, n)
    return poses, [part_view(pose, rng, **kind) for pose in poses]


def worst(found: ViewRegistration, poses):
    """Largest rotation in rad and distance in mm by which the views' poses differ from the truth, of the part."""
    offset = poses[found.reference] @ inverse(found.T_part_view[found.reference])
    turns = [angle_between(offset @ found.T_part_view[row], poses[row]) for row in found.found]
    places = [
        np.linalg.norm((offset @ found.T_part_view[row] @ inverse(poses[row]) - np.eye(4))[:3, 3])
        for row in found.found
    ]
    return max(turns), max(places)


def test_views_get_the_poses_they_were_taken_from_and_the_part_s_frame_stands_in_its_middle(monkeypatch):
    poses, clouds = seen(0)
    plain, registered = views._registered, []

    def counted(*words):
        registered.append(words)
        return plain(*words)

    monkeypatch.setattr(views, "_registered", counted)
    done = []
    found = register_views(clouds, finished=lambda *counts: done.append(counts))
    assert len(registered) == 2 * 5 - 3  # the other three pairs are refined from where these put them
    assert len(found.pairs) == 10 and done == [(k, 10) for k in range(1, 11)]
    turn, place = worst(found, poses)
    assert turn < 2e-3 and place < 0.1
    assert found.found.tolist() == [0, 1, 2, 3, 4]
    middle = np.mean(
        [found.T_part_view[k, :3, :3] @ clouds[k].mean(axis=0) + found.T_part_view[k, :3, 3] for k in range(5)], axis=0
    )
    assert np.abs(middle).max() < 0.01
    assert "5 of 5 views" in str(found)


def ties_of(poses, pairs, wrong=()):
    off = rigid(None, [5.0, 0, 0])
    return {(a, b): Tie(inverse(poses[a]) @ poses[b] @ (off if (a, b) in wrong else np.eye(4)), np.zeros(3), np.eye(6))
            for a, b in pairs}  # fmt: skip


def test_few_pairs_put_every_view_into_a_loop_of_three_and_those_preferred_come_first():
    rng = np.random.default_rng(3)
    for n in (3, 5, 9):
        wanted = [tuple(pair) for pair in rng.permutation(list(combinations(range(n), 2))).tolist()]
        chosen = triangle_pairs(wanted, n)
        assert len(chosen) == 2 * n - 3 and wanted[0] in chosen and sorted(chosen, key=wanted.index) == chosen
        ties = ties_of(np.tile(np.eye(4), (n, 1, 1)), chosen)
        assert closed_ties(ties, 1.0, 50.0, np.zeros((n, 3))) == chosen
    assert triangle_pairs([(0, 1), (2, 1)], 4) == [(0, 1), (2, 1)]


def test_ties_are_closed_by_a_ring_of_any_length_unless_one_of_it_is_wrong():
    poses = camera_poses(np.random.default_rng(0), 6)
    ring, middles = [(0, 1), (1, 2), (3, 2), (3, 4), (0, 4)], np.zeros((6, 3))
    for pairs, wrong, closed in (
        (ring, (), ring),
        (ring, [(3, 2)], []),
        ([*ring, (0, 2)], [(3, 2)], [(0, 1), (1, 2), (0, 2)]),
        ([*ring, (4, 5)], (), ring),
    ):
        assert closed_ties(ties_of(poses, pairs, wrong), 1.0, 50.0, middles) == closed


def test_a_wrong_pair_is_dropped_because_its_loops_do_not_close(monkeypatch):
    poses, clouds = seen(0, 4)
    plain = tie_of

    def wrong(fine, source):
        tie = plain(fine, source)
        if source is kept[3] and not seen_pairs:
            seen_pairs.append(1)
            turned = rigid(random_rotation(np.random.default_rng(0))) @ tie.T_target_source
            return replace(tie, T_target_source=turned)
        return tie

    seen_pairs, kept = [], clouds
    monkeypatch.setattr(views, "without_strays", lambda points, name: points)
    monkeypatch.setattr(views, "check_points", lambda points, *_: points)
    monkeypatch.setattr(views, "tie_of", wrong)
    found = register_views(clouds)
    assert list(found.refused.values()) == ["does not agree with the other pairs"]
    assert worst(found, poses)[1] < 0.1


@pytest.mark.parametrize(
    ("n", "pairs"),
    [(3, [(0, 1), (0, 2), (1, 2), (2, 3)]), pytest.param(4, None, marks=pytest.mark.full)],
    ids=["one pair with it", "all pairs"],
)
def test_a_view_of_another_part_is_left_out_and_told(n, pairs):
    poses, clouds = seen(2, n)
    rng = np.random.default_rng(7)
    other = rng.normal(size=(3000, 3))
    clouds.append(60 * other / np.linalg.norm(other, axis=1)[:, None] * [1, 0.4, 0.2] + [0, 0, 400])
    with pytest.warns(GrindvisionWarning, match=f"view {n + 1} cannot be tied"):
        found = register_views(clouds, pairs=pairs)
    assert found.found.tolist() == [*range(n)]
    assert np.isnan(found.T_part_view[n]).all()
    assert worst(found, poses)[1] < 0.1


def test_a_part_on_a_table_holds_the_motions_that_the_table_leaves_free():
    poses, clouds = seen(5, 3, half_mm=(130, 90))
    rows, extent, _ = views._resistance(clouds[0])
    scale = np.array([1, 1, 1, 1 / extent, 1 / extent, 1 / extent])
    assert np.sqrt(np.linalg.eigvalsh((rows * scale).T @ (rows * scale) / len(rows))[0]) < views.MIN_STIFFNESS
    turn, place = worst(register_views(clouds), poses)
    assert turn < 2e-3 and place < 0.2


def test_a_flat_part_is_refused_and_its_three_free_motions_named():
    _, clouds = seen(3, 4, flat=True)
    with pytest.raises(AmbiguousError) as refused:
        register_views(clouds)
    assert len(re.findall("translation along", str(refused.value))) == 2
    assert len(re.findall("rotation about", str(refused.value))) == 1


def test_too_little_is_refused():
    _, clouds = seen(4, 3)
    with pytest.raises(InputError, match="2 views"):
        register_views(clouds[:2])
    with pytest.raises(DegenerateError, match="b: 100 points"):
        register_views([clouds[0], clouds[1][:100], clouds[2]], ["a", "b", "c"])
    with pytest.raises(DegenerateError, match="cannot be tied"):
        register_views(clouds, pairs=[(0, 1)])
