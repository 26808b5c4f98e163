"""Laws of rigid transforms: inverses, chains, angles that stay exact near 0 and pi, and what is refused at the door."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from grindvision import geometry
from grindvision.errors import InputError, NotRigidError


@pytest.fixture
def T_a_b(rng):
    return geometry.rigid(geometry.random_rotation(rng), rng.uniform(-500, 500, 3))


def test_inverse_undoes_and_swaps_the_order_of_a_chain(T_a_b, rng):
    T_b_c = geometry.rigid(geometry.random_rotation(rng), [1.0, -2.0, 3.0])
    assert geometry.inverse(T_a_b) @ T_a_b == pytest.approx(np.eye(4), abs=1e-12)
    chain = geometry.inverse(T_a_b @ T_b_c)
    assert chain == pytest.approx(geometry.inverse(T_b_c) @ geometry.inverse(T_a_b), abs=1e-10)
    stack = np.stack([T_a_b, T_b_c])
    assert geometry.inverse(stack) == pytest.approx(np.linalg.inv(stack), abs=1e-10)


def test_points_move_and_vectors_only_turn(T_a_b, rng):
    p, v = rng.uniform(-1, 1, (2, 5, 3))
    homogeneous = np.column_stack([p, np.ones(5)]) @ T_a_b.T
    assert geometry.move_points(T_a_b, p) == pytest.approx(homogeneous[:, :3])
    moved = geometry.move_points(T_a_b, p + v) - geometry.move_points(T_a_b, p)
    assert geometry.rotate_vectors(T_a_b, v) == pytest.approx(moved)
    assert geometry.move_points(geometry.inverse(T_a_b), geometry.move_points(T_a_b, p)) == pytest.approx(p)
    assert geometry.move_points(T_a_b, p[0]) == pytest.approx(homogeneous[0, :3])


@pytest.mark.parametrize("angle_rad", [0.0, 1e-9, 1e-4, 1.0, np.pi - 1e-6, np.pi])
def test_angles_are_exact_over_their_whole_range(angle_rad, rng):
    start = geometry.random_rotation(rng)
    turned = start @ geometry.rotation_about(rng.normal(size=3), angle_rad)
    assert geometry.angle_between(start, turned) == pytest.approx(angle_rad, abs=2e-8)
    assert geometry.angle_between(turned, start) == pytest.approx(angle_rad, abs=2e-8)
    vector = np.array([np.cos(angle_rad), np.sin(angle_rad), 0.0])
    assert geometry.vector_angle([3.0, 0, 0], 0.1 * vector) == pytest.approx(angle_rad, abs=1e-15, rel=1e-12)


def test_the_angle_to_a_zero_vector_is_not_a_number():
    assert np.isnan(geometry.vector_angle([0, 0, 0], [1, 0, 0]))


def test_rotation_about_an_axis_is_its_matrix_exponential(rng):
    axis = rng.normal(size=3)
    generator = geometry.skew(axis / np.linalg.norm(axis))
    assert geometry.rotation_about(5 * axis, 0.7) == pytest.approx(expm(0.7 * generator), abs=1e-12)
    b = rng.normal(size=(4, 3))
    assert np.einsum("kij,kj->ki", geometry.skew(b[::-1]), b) == pytest.approx(np.cross(b[::-1], b))


def test_nearest_rotation_is_nearest_and_never_a_reflection(rng):
    for matrix in rng.normal(size=(20, 3, 3)):
        nearest = geometry.nearest_rotation(matrix)
        assert np.linalg.det(nearest) == pytest.approx(1)
        assert nearest @ nearest.T == pytest.approx(np.eye(3), abs=1e-12)
        step = geometry.rotation_about(rng.normal(size=3), 0.05)
        assert np.linalg.norm(step @ nearest - matrix) >= np.linalg.norm(nearest - matrix)


def test_rounding_a_rotation_is_mended_within_the_rounding(T_a_b):
    printed = np.round(T_a_b, 4)
    with pytest.raises(NotRigidError, match="orthonormalised"):
        geometry.check_rigid(printed, "T_a_b")
    mended = geometry.check_rigid(geometry.orthonormalised(printed), "T_a_b")
    assert np.abs(mended - printed).max() < 1e-4
    assert geometry.angle_between(mended, T_a_b) < 2e-4


def test_the_mean_of_transforms_lies_in_their_middle_and_moves_with_the_world(T_a_b, rng):
    turns = [geometry.rigid(geometry.rotation_about([0, 0, 1], a), [10 * a, 0, 0]) for a in (-0.3, 0.0, 0.3)]
    assert geometry.mean_rigid(turns) == pytest.approx(np.eye(4), abs=1e-12)
    moved = geometry.mean_rigid(T_a_b @ np.array(turns))
    assert moved == pytest.approx(T_a_b @ geometry.mean_rigid(turns), abs=1e-9)


def test_a_small_motion_is_undone_by_its_negative_to_second_order(rng):
    twist = np.concatenate([rng.normal(size=3), 1e-5 * rng.normal(size=3)])
    back = geometry.small_motion(-twist) @ geometry.small_motion(twist)
    assert back == pytest.approx(np.eye(4), abs=1e-4)
    assert geometry.small_motion(twist)[:3, :3] == pytest.approx(np.eye(3) + geometry.skew(twist[3:]), abs=1e-9)


def test_random_rotations_repeat_and_have_no_preferred_direction():
    draws = [geometry.random_rotation(np.random.default_rng(seed)) for seed in range(400)]
    assert draws[7] == pytest.approx(geometry.random_rotation(np.random.default_rng(7)))
    assert np.abs(np.mean(draws, axis=0)).max() < 5 * np.sqrt(1 / 3 / 400)


BAD = {
    "shape": (np.eye(3), r"shape \(3, 3\)"),
    "text": ([["a"] * 4] * 4, "not a 4x4 matrix of numbers"),
    "nan": (np.full((4, 4), np.nan), "NaN"),
    "transposed": (geometry.rigid(translation_mm=[1, 2, 3]).T, "transposed"),
    "reflection": (np.diag([1.0, 1.0, -1.0, 1.0]), "reflection"),
    "scaled": (np.diag([2.0, 2.0, 2.0, 1.0]), "not a rotation"),
}


@pytest.mark.parametrize("case", BAD)
def test_what_is_not_rigid_is_refused_with_its_name_and_reason(case):
    matrix, reason = BAD[case]
    with pytest.raises(NotRigidError, match=f"T_tracker_base.*{reason}"):
        geometry.check_rigid(matrix, "T_tracker_base")


def test_an_axis_without_direction_and_a_mean_of_nothing_are_refused():
    with pytest.raises(InputError, match="length zero"):
        geometry.rotation_about([0, 0, 0], 1.0)
    with pytest.raises(InputError, match="mean needs transforms"):
        geometry.mean_rigid(np.empty((0, 4, 4)))


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.3, 2.0, np.pi - 1e-7, np.pi])
def test_axis_and_angle_are_scipy_s(rng, angle):
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    turn = geometry.rotation_about(axis, angle)
    np.testing.assert_allclose(turn, Rotation.from_rotvec(angle * axis).as_matrix(), atol=1e-15)
    assert geometry.angle_between(np.eye(3), turn) == pytest.approx(angle, abs=1e-7)
    if angle > 1e-7:
        np.testing.assert_allclose(np.cross(geometry.rotation_axis(turn), axis), 0, atol=1e-7)
        assert geometry.rotation_axis(turn) @ axis > 0 or angle == np.pi


def test_the_axis_of_a_rotation_points_the_way_it_was_made(rng):
    for axis, angle in zip(unit_vectors(rng, 60), rng.uniform(0.05, 3.0, 60), strict=True):
        np.testing.assert_allclose(geometry.rotation_axis(geometry.rotation_about(axis, angle)), axis, atol=1e-9)


def unit_vectors(rng, count):
    vectors = rng.normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1)[:, None]
