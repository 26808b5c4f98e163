"""The standard deviation of a pose: what the errors of the normals seem to hold is not known."""

import numpy as np
import pytest

from grindvision.geometry import inverse, move_points, rigid
from grindvision.vision.registration.deformable import refine_bent
from grindvision.vision.registration.free_motions import weakest_motion
from grindvision.vision.registration.plane_icp import icp_planes
from grindvision.vision.surface.scan import prepare_pair
from tests.grinding_scene import scan, view


def apart(pose, other, points):
    """Greatest distance between where two poses bring points."""
    return float(np.linalg.norm(move_points(pose, points) - move_points(other, points), axis=1).max())


def plain(relief):
    """A plate with a boss and a rib of that height."""

    def height(x, y):
        boss = relief / (1 + np.exp((np.hypot(x - 30, y - 12) - 14) / 2.0))
        rib = relief / (1 + np.exp((np.abs(0.9 * y + 0.4 * x + 20) - 4) / 2.0)) / (1 + np.exp(np.abs(x + 25) - 25))
        return boss + rib

    return height


def pose_and_sigma(relief, seed):
    """How far the pose of a plate is off after starting 1 mm away, and its standard deviation."""
    rng = np.random.default_rng(seed)
    poses = view(0.1, (1.0, 0.3, 0.0)), view(0.3, (0.2, -0.5, 0.8))
    first, second = (scan(plain(relief), pose, 30_000, rng, window=(-80.0, 80.0, -60.0, 60.0)) for pose in poses)
    T_true = poses[0] @ inverse(poses[1])
    source, target = prepare_pair(second, first)
    points, normals = source.surfels.points, source.surfels.normals
    along = poses[0] @ rigid(None, rng.normal(size=3) * (1.0, 1.0, 0.0)) @ inverse(poses[0])
    found = refine_bent(points, normals, target.surfels, icp_planes(points, normals, target.surfels, along @ T_true))
    return apart(found.T_target_source, T_true, points[::50]), weakest_motion(found, points[::50])[0]


@pytest.mark.parametrize("seeds", [range(2), pytest.param(range(2, 6), marks=pytest.mark.full)])
def test_what_only_the_errors_of_the_normals_hold_is_not_taken_for_known(seeds):
    """A bare plane slides along itself: the information of noisy normals says that it does not."""
    off, sigma = np.array([pose_and_sigma(0.0, seed) for seed in seeds]).T
    assert (sigma > 1.0).all() and (off < 4 * sigma).all()


def test_a_motion_that_both_scans_hold_is_known_as_well_as_it_is():
    off, sigma = np.array([pose_and_sigma(6.0, seed) for seed in range(6)]).T
    assert (sigma < 0.15).all() and (off < 4 * sigma).all()
