"""What can be known, which poses to choose, and sphere centres out of clouds."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from grindvision.arm import joint_transforms, moved_by_twist
from grindvision.calibration import (
    Options,
    Unknowns,
    analyse,
    calibrate,
    choose_poses,
    consistent_rows,
    correlations,
    design_matrix,
    find_sphere,
    noise_clumping,
    table_entries,
    unit_sizes,
)
from grindvision.calibration.causes import _session_causes
from grindvision.calibration.model import carried, carry
from grindvision.calibration.statistics import whitening
from grindvision.errors import DegenerateError, InputError
from grindvision.geometry import fit_sphere
from tests.calibration_rig import er3a, rig, ur5


def nominal_design(rng, base: int = 0):
    made = rig(er3a(), rng, noise_mm=0, joint_rad=0, base="same", off_mm=0, off_rad=0)
    unknowns = Unknowns(6, table_entries(er3a()), base)
    measurements = made.measurements
    design = design_matrix(made.cell, measurements.q_rad, measurements.scanner_mm, unknowns)
    return made, design, unknowns, unit_sizes(measurements, unknowns)


def test_twenty_of_the_papers_23_unknowns_can_be_known(rng):
    _, design, unknowns, units = nominal_design(rng)
    found = analyse(design.reshape(-1, 23), unknowns.names, units)
    assert len(unknowns) == 23
    assert found.rank == found.rank_qr == 20
    assert set(found.sentences) == {
        "scanner z and d4 only as a sum",
        "scanner rz and theta4 only as a sum",
        "d2 and d3 only as a sum",
    }
    assert found.known.sum() == 17


def test_a_tilt_behind_the_joint_mends_nothing(rng):
    """The paper does not say where its beta_3 stands; behind joint 3 it only mimics what others do: rank 19."""
    made, design, unknowns, units = nominal_design(rng)
    frame = joint_transforms(made.cell.arm, made.measurements.q_rad)[:, 3]
    axis, origin = frame[:, :3, 1], frame[:, :3, 3]
    twist = np.concatenate([np.cross(origin, axis), axis], axis=1)[:, :, None]
    points = made.cell.points_base(made.measurements.q_rad, made.measurements.scanner_mm)
    behind = design.copy()
    behind[:, :, [unknowns.names.index("beta3_rad")]] = moved_by_twist(twist, points)
    found = analyse(behind.reshape(-1, 23), unknowns.names, units)
    assert found.rank == found.rank_qr == 19


def test_a_free_base_hides_four_more(rng):
    _, design, unknowns, units = nominal_design(rng, base=6)
    found = analyse(design.reshape(-1, 29), unknowns.names, units)
    assert (found.rank, len(found.names)) == (22, 29)
    assert "d1 and base z only as a sum" in found.sentences


@pytest.mark.parametrize("base", [0, 6])
def test_what_is_said_and_in_which_order_does_not_hang_on_rounding(base, rng):
    """Equations mixed by a rotation say the same: sentences stand in the order of the unknowns, first named first."""
    _, design, unknowns, units = nominal_design(rng, base)
    matrix = design.reshape(-1, len(unknowns))
    found = analyse(matrix, unknowns.names, units)
    for _ in range(20):
        turn = np.linalg.qr(rng.normal(size=(len(matrix),) * 2))[0]
        again = analyse(turn @ matrix, unknowns.names, units)
        assert again.sentences == found.sentences
        np.testing.assert_allclose(again.null_space, found.null_space, atol=1e-6)
    firsts = [np.flatnonzero(column)[0] for column in found.null_space.T]
    assert firsts == sorted(firsts)


def test_null_space_moves_nothing(rng):
    _, design, unknowns, units = nominal_design(rng, base=6)
    found = analyse(design.reshape(-1, 29), unknowns.names, units)
    assert np.abs(design.reshape(-1, 29) @ found.null_space).max() < 1e-8


def test_words_for_every_kind_of_confusion(rng):
    a, b, c = rng.normal(size=(3, 30))
    matrix = np.column_stack([a, b, a, -2 * b, 0 * a, c, a + b + c])
    names = ("a_mm", "b_mm", "twin_mm", "twice_rad", "none_mm", "c_mm", "mix_mm")
    found = analyse(matrix, names, np.ones(7))
    assert found.rank == found.rank_qr == 3
    assert "none moves no measured point: it cannot be known" in found.sentences
    assert not found.known.any()
    difference = analyse(np.column_stack([a, -a]), names[:2], np.ones(2))
    assert difference.sentences == ("a and b only as a difference",)
    together = analyse(np.column_stack([a, 3 * a]), ("a_mm", "b_rad"), np.ones(2))
    assert together.sentences == ("a and b only together",)
    sums = analyse(np.column_stack([a, a, a]), ("d2_mm", "d3_mm", "d4_mm"), np.ones(3))
    assert sums.sentences == ("d2, d3 and d4 only as a sum",)
    triple = analyse(np.column_stack([a, b, a + b]), ("a_mm", "b_mm", "c_mm"), np.ones(3))
    assert triple.sentences == ("a, b and c only in combination",)


def test_what_noise_drowns_is_not_known(rng):
    a = rng.normal(size=(30, 2))
    matrix = np.column_stack([a[:, 0], a[:, 0] + 1e-4 * a[:, 1]])
    assert analyse(matrix, ("a_mm", "b_mm"), np.ones(2)).rank == 2
    assert analyse(matrix, ("a_mm", "b_mm"), np.ones(2), worst_std=10.0).rank == 1


def test_analysis_refuses_shapes_that_do_not_fit():
    with pytest.raises(InputError, match="do not fit 2 names"):
        analyse(np.zeros((4, 3)), ("a_mm", "b_mm"), np.ones(2))


def test_observability_indices_of_a_diagonal_matrix():
    indices = analyse(np.diag([4.0, 2.0, 1.0]), ("a_mm", "b_mm", "c_mm"), np.ones(3)).observability
    assert indices["O1"] == pytest.approx(2.0)
    assert (indices["O2"], indices["O3"], indices["O4"]) == pytest.approx((0.25, 1.0, 0.25))
    assert indices["O5"] == pytest.approx(1 / (1 / 4 + 1 / 2 + 1))


def test_correlations_are_between_minus_one_and_one_where_known(rng):
    result = calibrate(rig(er3a(), rng).measurements, er3a())
    table = correlations(result.covariance, result.identifiability.known)
    known = result.identifiability.known
    assert np.allclose(np.diag(table)[known], 1)
    assert np.nanmax(np.abs(table)) <= 1 + 1e-9
    assert np.isnan(table[~known]).all()


def test_usual_unknowns_of_a_six_joint_arm():
    names = Unknowns(6, table_entries(ur5()), 6).names
    assert len(names) == 6 + 26 + 6
    assert {"beta3_rad", "beta4_rad"} <= set(names)
    assert "beta2_rad" not in names and "beta1_rad" not in names


def test_exchange_finds_the_best_of_all_subsets(rng):
    blocks = rng.normal(size=(9, 1, 3))
    choice = choose_poses(blocks, 4, rng)
    information = [np.linalg.det(sum(b.T @ b for b in blocks[list(c)])) for c in combinations(range(9), 4)]
    best = list(combinations(range(9), 4))[int(np.argmax(information))]
    assert choice.chosen.tolist() == list(best)
    assert choice.log_determinant >= choice.start_log_determinant


def test_chosen_poses_tell_more_than_random_ones(rng):
    _, design, _, units = nominal_design(rng)
    choice = choose_poses(design * units, 20, rng)
    assert len(set(choice.chosen)) == 20
    gain = choice.log_determinant - choice.start_log_determinant
    assert gain > 3
    random = np.linalg.svd((design * units)[:20].reshape(-1, 23), compute_uv=False)[19]
    assert np.linalg.svd((design * units)[choice.chosen].reshape(-1, 23), compute_uv=False)[19] > random


def test_choice_refuses_too_few_poses(rng):
    blocks = rng.normal(size=(30, 3, 10))
    with pytest.raises(DegenerateError, match="3 poses give 9 rows for 10 combinations"):
        choose_poses(blocks, 3, rng)
    with pytest.raises(InputError, match="31 poses asked for out of 30"):
        choose_poses(blocks, 31, rng)


def test_whitening_scales_covariances_to_one(rng):
    factors = rng.normal(size=(50, 3, 3))
    covariances = factors @ np.swapaxes(factors, 1, 2) + 0.01 * np.eye(3)
    matrices = whitening(covariances)
    np.testing.assert_allclose(
        matrices @ covariances @ np.swapaxes(matrices, 1, 2), np.tile(np.eye(3), (50, 1, 1)), atol=1e-9
    )
    np.testing.assert_allclose(matrices, np.linalg.inv(np.linalg.cholesky(covariances)), rtol=1e-9, atol=1e-12)


def test_slopes_in_blocks_are_the_slopes(rng):
    made = rig(er3a(), rng)
    points = carry(made.cell, made.measurements.q_rad, made.measurements.scanner_mm)
    many = carry(made.cell, *(np.tile(part, (20, 1)) for part in (points.q_rad, points.scanner_mm)))
    unknowns = Unknowns(6, table_entries(er3a()), 6)
    assert len(list(many.blocks())) > 1
    blocks = np.concatenate([part.design(unknowns) for _, part in many.blocks()])
    np.testing.assert_array_equal(blocks, many.design(unknowns))


def test_consistent_rows_bear_almost_half_of_wrong_ones(rng):
    residuals = rng.normal(0, 0.1, (100, 3))
    residuals[:40] += [5, 0, 0]
    kept = consistent_rows(residuals, np.tile(0.01 * np.eye(3), (100, 1, 1)))
    assert not kept[:40].any()
    assert kept[40:].all()


CENTRE, RADIUS = np.array([12.0, -7.0, 402.0]), 19.05


def scanned_sphere(rng, noise_mm: float = 0.03, nest: bool = True, outliers: int = 60) -> np.ndarray:
    """A cap of 70 deg that faces the scanner, the nest below (+y) touching it, and stray points."""
    angle, turn = np.arccos(rng.uniform(np.cos(1.2), 1, 4000)), rng.uniform(0, 2 * np.pi, 4000)
    normals = np.column_stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), -np.cos(angle)])
    covered = normals[:, 1] > 0.75
    cloud = [CENTRE + (RADIUS + noise_mm * rng.normal(size=(4000, 1))) * normals][0][~covered if nest else slice(None)]
    if nest:
        phi, along = rng.uniform(np.pi, 2 * np.pi, 900), rng.uniform(0.75 * RADIUS, 1.4 * RADIUS, 900)
        cloud = np.vstack([cloud, CENTRE + np.column_stack([12.6 * np.cos(phi), along, 12.6 * np.sin(phi)])])
    return np.vstack([cloud, CENTRE + rng.uniform(-60, 60, (outliers, 3))])


@pytest.mark.parametrize("radius_mm", [RADIUS, None])
def test_sphere_is_found_beside_nest_and_strays(radius_mm):
    errors, stated = [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        fit = find_sphere(scanned_sphere(rng), rng, radius_mm)
        errors.append(fit.centre_mm - CENTRE)
        stated.append(np.sqrt(np.diag(fit.centre_covariance)))
        assert fit.radius_mm == pytest.approx(RADIUS, abs=0.02)
    assert np.abs(errors).max() < 0.02
    assert np.sqrt(np.mean((np.array(errors) / stated) ** 2)) < 2.5


def test_exact_sphere_is_found_exactly(rng):
    fit = find_sphere(scanned_sphere(rng, noise_mm=0, outliers=0), rng, RADIUS)
    assert np.abs(fit.centre_mm - CENTRE).max() < 1e-6


def test_clumped_noise_is_noticed(rng):
    cloud = scanned_sphere(rng, nest=False, outliers=0)
    normals = (cloud - CENTRE) / np.linalg.norm(cloud - CENTRE, axis=1, keepdims=True)
    assert noise_clumping(cloud, fit_sphere(cloud, RADIUS)) < 2
    wavy = cloud + 0.03 * np.sin(9 * normals[:, :1]) * normals
    assert noise_clumping(wavy, fit_sphere(wavy, RADIUS)) > 10


def test_no_sphere_in_the_cloud(rng):
    with pytest.raises(DegenerateError):
        find_sphere(rng.uniform(-100, 100, (500, 3)), rng, RADIUS)
    with pytest.raises(DegenerateError, match="at least 4 needed"):
        find_sphere(np.zeros((2, 3)), rng)


def test_options_refuse_nonsense():
    with pytest.raises(InputError, match="choose ours or paper"):
        Options(variant="best")
    with pytest.raises(InputError, match="tolerance is 0"):
        Options(tolerance=0)


def test_a_jump_is_looked_for_between_poses_with_at_least_four_rows_on_either_side(rng):
    made = rig(er3a(), rng, rows=24)
    first_rows = [0, 2, 3, 4, 9, 15, 20, 21, 23]
    pose = np.array([f"P{np.searchsorted(first_rows, row, side='right')}" for row in range(24)])
    measurements = replace(made.measurements, pose=pose)
    causes = _session_causes(carried(made.cell, measurements), measurements)
    steps = [cause.course for cause in causes if cause.course is not None and set(cause.course) == {0.0, 1.0}]
    assert {int(np.argmax(course)) for course in steps} == {4, 9, 15, 20}
    assert all((np.diff(course) >= 0).all() for course in steps)
