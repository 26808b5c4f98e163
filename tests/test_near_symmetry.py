"""Parts that look alike from several sides: blades of a propeller, walls of a box of which each scan shows another."""

import numpy as np
import pytest

from grindvision.errors import AmbiguousError

pytest.importorskip("open3d", reason="needs the extra sim")
pytest.importorskip("manifold3d", reason="needs the extra sim")

import manifold3d as m3

from grindvision.cell.rays import target_of
from grindvision.cell.scanners import StructuredLightScanner
from grindvision.cell.solids import Shape, box
from grindvision.cell.views import view_from
from grindvision.geometry import inverse, move_points, random_rotation
from grindvision.vision.registration.face_poses import face_poses, square_to
from grindvision.vision.registration.pose_candidates import PoseJudge
from grindvision.vision.registration.scan_registration import RegisterOptions, register
from grindvision.vision.surface.scan import prepare_pair


def propeller(blades):
    """A hub with so many blades at 25 degrees, and nothing that tells one from the next."""
    body = m3.Manifold.cylinder(24, 14, 14, 96) - m3.Manifold.cylinder(60, 6, 6, 96).translate([0, 0, -1])
    for k in range(blades):
        blade = m3.Manifold.cube([55, 16, 4], False).translate([0, -8, -2]).rotate([25, 0, 0])
        body = body + (
            blade.translate([0, 0, 12]).rotate([0, 0, 360 * k / blades]) - m3.Manifold.cylinder(60, 6, 6, 96)
        )
    return Shape.named(body, "body").solid()


def two_scans(solid, seed):
    """Points of two scans from places 30 to 60 degrees apart about the part's axis, and the true pose between them."""
    rng = np.random.default_rng(seed)
    turn, tilt = rng.uniform(0, 2 * np.pi), rng.uniform(0.66, 0.9)
    poses = [view_from((0, 0, 12), 410.0, tilt, at, rng.uniform(-1, 1)) for at in (turn, turn + rng.uniform(0.5, 1))]
    scans = [StructuredLightScanner(serial=seed).scan(target_of(solid), pose, rng, 4).points for pose in poses]
    return *scans, inverse(poses[0]) @ poses[1]


@pytest.mark.parametrize(("blades", "seed"), [(4, 0)])
def test_which_blade_is_which_is_never_guessed(blades, seed):
    target, source, _ = two_scans(propeller(blades), seed)
    with pytest.raises(AmbiguousError, match="a rotation"):
        register(source, target, RegisterOptions(seed=seed))


def test_two_walls_of_a_box_tell_the_third():
    rng = np.random.default_rng(2)
    walls = random_rotation(rng)
    (third,) = square_to(walls[:2])
    assert abs(third @ walls[2]) == pytest.approx(1)
    assert len(square_to(walls)) == 0  # all are shown
    slanting = walls[0] + 0.5 * walls[1]
    assert len(square_to(np.stack([walls[0], slanting / np.linalg.norm(slanting)]))) == 0


def test_walls_of_which_each_scan_shows_another_are_laid_at_right_angles():
    """A block with a boss; one scan shows one of its walls, the other the next."""
    boss = m3.Manifold.cylinder(8, 9, 9, 64).translate([20, 6, 19])
    solid = (box("body", [-45, -45, 0], [45, 45, 20]) + Shape.named(boss, "body")).solid()
    rng = np.random.default_rng(5)
    poses = [view_from((0, 0, 10), 410.0, 0.8, azimuth, 0.3) for azimuth in (0, np.pi / 2)]
    target, source = (StructuredLightScanner().scan(target_of(solid), pose, rng, 6).points for pose in poses)
    judge = PoseJudge(*prepare_pair(source, target, (None, None)), rng, 2000)
    truth = inverse(poses[0]) @ poses[1]
    off = [np.linalg.norm(move_points(pose, judge.points) - move_points(truth, judge.points), axis=1).max()
           for pose in face_poses(judge)]  # fmt: skip
    assert min(off) < 6.0  # ICP does the rest
