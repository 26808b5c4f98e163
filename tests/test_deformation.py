"""A part that is bent against its good one is registered with a smooth field beside the pose; a rigid one never is, a
bead stays stock, and another part stays refused."""

import warnings
from functools import cache

import numpy as np
import pytest
from scipy.spatial import cKDTree

from grindvision import GrindOptions, detect, grind
from grindvision.clouds import finite_points, read_cloud
from grindvision.errors import DegenerateError
from grindvision.geometry import inverse, move_points, rigid, rotate_vectors, rotation_about
from grindvision.vision.registration.deformation import Deformation, powers_of, zero_field
from grindvision.vision.registration.deformation_fit import fit_deformation
from grindvision.vision.registration.plane_icp import icp_planes
from grindvision.vision.surface.scan import prepare_pair
from tests.grinding_scene import arc_bead, plate_height, scan, view

T_SAMPLE_PART, T_TEST_PART = view(0.1), view(-0.15, (1.0, 0.3, 0.0))
T_SAMPLE_TEST = T_SAMPLE_PART @ inverse(T_TEST_PART)
BENDS = {
    "bend": lambda x, y: 3 * x**2,
    "twist": lambda x, y: 4 * x * y,
    "s": lambda x, y: 4 * x**3,
    "saddle": lambda x, y: 3 * x**2 - 2 * y**2,
    "none": lambda x, y: 0 * x,
}


def bent(part, kind):
    """Points of the plate, frame of the part, moved up as a bent one has them."""
    up = BENDS[kind](part[:, 0] / 100, part[:, 1] / 70)
    return part + np.column_stack([np.zeros((len(part), 2)), up])


def pair(kind, seed=0, beads=(), points=25_000, other=plate_height):
    """Scans of the good plate and of a bent one."""
    rng = np.random.default_rng(seed)
    sample = scan(plate_height, T_SAMPLE_PART, points, rng)
    test = scan(other, T_TEST_PART, points, rng, beads)
    return sample, move_points(T_TEST_PART, bent(move_points(inverse(T_TEST_PART), test), kind))


def fitted(kind, seed=0, beads=()):
    """The fit from near the true pose, and the surfels' normals."""
    sample, test = pair(kind, seed, beads)
    source, target = prepare_pair(test, sample)
    points, normals = source.surfels.points[::3].copy(), source.surfels.normals[::3].copy()
    start = icp_planes(points, normals, target.surfels, T_SAMPLE_TEST, 10.0, 2.0)
    return fit_deformation(points, normals, target.surfels, start), normals


@cache
def twisted():
    return fitted("twist", 1)


def true_places(points, kind):
    """Where points of the bent plate lie on the good one, frame of the sample."""
    part = move_points(inverse(T_TEST_PART), points)
    up = BENDS[kind](part[:, 0] / 100, part[:, 1] / 70)  # the bend moves nothing in the plane
    return move_points(T_SAMPLE_PART, part - np.column_stack([np.zeros((len(part), 2)), up]))


def errors(fit, normals, kind):
    """Errors along the normal, of pose and field together, and their standard deviation by field and pose."""
    got = fit.points + fit.field.displacements(fit.points)
    pose = fit.registration.T_target_source
    up = rotate_vectors(pose, normals)
    off = ((move_points(pose, got) - true_places(fit.points, kind)) * up).sum(axis=1)
    jacobian = np.column_stack([up, np.cross(move_points(pose, fit.points) - fit.registration.centre_mm, up)])
    of_pose = np.einsum("ij,ij->i", jacobian @ fit.registration.covariance, jacobian)
    return off, np.sqrt(fit.field.variances(fit.points, normals) + of_pose)


@pytest.fixture
def field():
    """Some field of the third order over a box of 200 x 140 x 60 mm, up to about 3 mm."""
    rng = np.random.default_rng(2)
    points = rng.uniform((-100, -70, 300), (100, 70, 360), (400, 3))
    nothing = zero_field(3, points)
    coefficients = rng.normal(0, 2.0, nothing.coefficients.shape)
    made = Deformation(3, nothing.centre_mm, nothing.scale_mm, nothing.half_mm, coefficients, nothing.covariance)
    return made, points


def test_a_field_and_its_inverse_give_the_points_back(field):
    made, points = field
    assert np.abs(made.bent(points + made.displacements(points)) - points).max() < 1e-5


def test_gradients_are_the_differences_of_the_displacements(field):
    made, points = field
    inner = made.centre_mm + 0.9 * (points - made.centre_mm)
    for axis in range(3):
        step = 1e-3 * np.eye(3)[axis]
        slope = (made.displacements(inner + step) - made.displacements(inner - step)) / 2e-3
        assert np.abs(slope - made.gradients(inner)[:, :, axis]).max() < 1e-7


def test_pose_and_what_is_left_of_the_field_are_the_field(field):
    made, points = field
    motion = rigid(rotation_about((0.3, 1.0, 0.2), 0.1), (3.0, -2.0, 5.0))
    left = made.less_motion(motion)
    assert (
        np.abs(move_points(motion, points + left.displacements(points)) - points - made.displacements(points)).max()
        < 1e-9
    )
    nearest = left.nearest_motion(points)
    again = left.less_motion(nearest)
    assert np.abs(again.nearest_motion(points) - np.eye(4)).max() < 1e-9
    size, size_again = ((one.displacements(points) ** 2).sum() for one in (left, again))
    assert size_again < size


def test_the_motion_nearest_along_normals_of_a_rigid_field_is_that_motion(field):
    _, points = field
    normals = np.random.default_rng(3).normal(size=points.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    motion = rigid(rotation_about((0.3, 1.0, 0.2), 0.05), (3.0, -2.0, 5.0))
    nothing = zero_field(2, points)
    moved = nothing.less_motion(inverse(motion))  # as a field, the motion itself
    assert np.abs(points + moved.displacements(points) - move_points(motion, points)).max() < 1e-9
    assert np.abs(moved.nearest_motion(points, normals) - motion).max() < 1e-8


def test_a_field_that_folds_the_surface_has_no_inverse():
    nothing = zero_field(2, np.array([[-100.0, -70, -20], [100, 70, 20]]))
    coefficients = nothing.coefficients.copy()
    coefficients[powers_of(2).index((2, 0, 0)), 0] = 200.0
    folded = Deformation(2, nothing.centre_mm, nothing.scale_mm, nothing.half_mm, coefficients, nothing.covariance)
    places = np.array([[90.0, 0, 0], [-90.0, 0, 0]])
    assert (folded.stretches(places) < 0).any()
    with pytest.raises(DegenerateError, match="folds"):
        folded.bent(places)


def test_a_bent_plate_is_straightened_within_the_stated_sigma():
    fit, normals = twisted()
    off, sigma = errors(fit, normals, "twist")
    assert np.sqrt((off**2).mean()) < 0.03
    assert 0.2 < np.sqrt(((off / sigma) ** 2).mean()) < 1.5
    assert fit.held_out_mm[fit.order] < 0.1 * fit.held_out_mm[0]


def test_a_bead_is_not_taken_up_by_the_field():
    bead = arc_bead()
    (with_bead, _), (without, _) = fitted("twist", 1, (bead,)), twisted()
    ridge = move_points(T_TEST_PART, bent(bead.ridge(), "twist"))
    change = with_bead.field.displacements(ridge) - without.field.displacements(ridge)
    moved = [
        move_points(one.registration.T_target_source, ridge + one.field.displacements(ridge))
        for one in (with_bead, without)
    ]
    assert np.abs(change).max() < 0.3  # it may slide where nothing tells, but
    up = rotate_vectors(T_SAMPLE_PART, np.array([0.0, 0.0, 1.0]))
    assert np.abs((moved[0] - moved[1]) @ up).max() < 0.04  # of 1.5 mm
    near = cKDTree(ridge).query(with_bead.points)[0] < 1.0
    assert with_bead.after_mm[near].max() > 1.0


def test_a_rigid_plate_is_not_deformed():
    for seed, beads in ((1, ()), (2, (arc_bead(),))):
        fit, normals = fitted("none", seed, beads)
        assert fit.order == 0
        sigma = np.sqrt(fit.field.variances(fit.points, normals))
        along = (fit.field.displacements(fit.points) * normals).sum(axis=1)
        assert np.sqrt(((along / sigma) ** 2).mean()) < 1.5
        assert np.abs(along).max() < 0.1


@pytest.mark.full
@pytest.mark.parametrize("kind", list(BENDS))
def test_over_many_plates_the_field_is_right_within_its_sigma(kind):
    for seed in range(8):
        fit, normals = fitted(kind, 10 + seed, (arc_bead(),) if seed % 2 else ())
        off, sigma = errors(fit, normals, kind)
        assert (fit.order == 0) == (kind == "none")
        assert np.sqrt(((off / sigma) ** 2).mean()) < 2.0
        assert np.sqrt((off**2).mean()) < 0.04


@pytest.fixture(scope="module")
def ground():
    """The twisted plate with its bead, ground, and what was said of it."""
    sample, test = pair("twist", 1, (arc_bead(),))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = grind(sample, test, GrindOptions(seed=0))
    return found, [str(one.message) for one in caught]


def test_a_twisted_plate_is_compared_and_said_to_be_deformed(ground):
    found, said = ground
    deformed = found.compared.deformed
    assert any("deformed against the sample by up to" in sentence for sentence in said)
    part = move_points(inverse(T_TEST_PART), deformed.points)
    up = BENDS["twist"](part[:, 0] / 100, part[:, 1] / 70)
    # a part of a twist looks like a motion on a plate with relief; the rest is the field's
    assert deformed.max_mm == pytest.approx(np.abs(up).max(), rel=0.2)
    assert deformed.rms_mm == pytest.approx(np.sqrt((up**2).mean()), rel=0.2)
    assert deformed.explained > 0.99


def test_the_bead_of_a_twisted_plate_is_the_stock_and_is_ground(ground):
    found, _ = ground
    (piece,) = found.stock.pieces
    bead = arc_bead()
    low, high = bead.line.min(axis=0) - 3, bead.line.max(axis=0) + 3
    x, y = np.meshgrid(np.arange(low[0], high[0], 0.1), np.arange(low[1], high[1], 0.1))
    volume = float(bead.height(x, y).sum()) * 0.1**2
    assert piece.volume_mm3 == pytest.approx(volume, rel=0.08)
    assert abs(piece.volume_mm3 - volume) < 3 * piece.volume_sigma_mm3
    (plan,) = found.plans
    assert len(plan.passes) > 5
    ridge = move_points(T_TEST_PART, bent(bead.ridge(), "twist"))
    standing = piece.inside & (np.nan_to_num(piece.map.heights_mm) > 0.3)
    feet = move_points(piece.map.T_scan_map, piece.map.feet_mm[standing])
    assert cKDTree(ridge).query(feet)[0].max() < 4.0


@pytest.mark.full
def test_another_part_stays_refused():
    def other(x, y):
        """The same swell with other features elsewhere."""
        boss = 6 / (1 + np.exp((np.hypot(x + 40, y + 20) - 16) / 1.0))
        pocket = -5 / (1 + np.exp((np.maximum(np.abs(x - 45) - 18, np.abs(y + 25) - 12)) / 0.8))
        return 5 * np.sin(x / 42 + 1.4) * np.cos(y / 40 + 0.9) + boss + pocket

    sample, test = pair("none", 1, other=other, points=15_000)
    with pytest.raises(DegenerateError, match="nor is it one smoothly deformed part"):
        detect(sample, test)


def test_too_few_points_tell_no_field():
    sample, test = pair("twist", 1)
    source, target = prepare_pair(test, sample)
    points, normals = source.surfels.points[:900].copy(), source.surfels.normals[:900].copy()
    start = icp_planes(points, normals, target.surfels, T_SAMPLE_TEST, 10.0, 2.0)
    with pytest.raises(DegenerateError, match="900 surfels; 1000 are needed"):
        fit_deformation(points, normals, target.surfels, start)


def test_the_real_deformed_part_is_registered_and_not_refused(real_data):
    sample, test = (finite_points(read_cloud(real_data(f"dac/{name}.ply"), "m"), name) for name in ("sample", "test"))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = detect(sample, test)
    assert any("deformed against the sample by up to" in str(one.message) for one in caught)
    assert 8 < found.deformed.max_mm < 25  # up to 16 mm by the description of the data
    assert found.deformed.explained > 0.85
    assert found.confidence > 0.5
    near = cKDTree(found.sample.points).query(move_points(found.T_sample_test, test[::20]))[0]
    assert np.median(near) < 2.0
