"""Pieces of joints: closed solids whose true seam lies on them, found again in a scan to what the camera shows."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from grindvision.cell import JOINTS, JointSize, StructuredLightScanner, joint_piece, joint_scene
from grindvision.errors import InputError
from grindvision.vision.seam.joint_names import FAMILIES, KINDS
from grindvision.vision.seam.seams import find_seams


@pytest.mark.parametrize("kind", JOINTS)
def test_the_seam_lies_on_a_closed_solid(kind):
    piece = joint_piece(kind)
    assert piece.solid.watertight and kind in KINDS
    np.testing.assert_allclose(np.linalg.norm(piece.normals, axis=1), 1, atol=1e-9)
    np.testing.assert_allclose(np.einsum("ij,ij->i", piece.normals, piece.tangents), 0, atol=0.02)


@pytest.mark.parametrize("kind", ["t-joint", "lap-joint", "butt-gap", "tube-on-plate", "bevel-groove"])
def test_a_scanned_joint_is_found_and_named(kind):
    every = 1 if kind in ("butt-gap", "bevel-groove") else 2
    scene = joint_scene(kind, np.random.default_rng(1), every=every)
    found = find_seams(scene.points)
    assert found.seams[0].kind == kind
    shown = scene.root_mm + scene.root_errors_mm
    off = cKDTree(shown).query(found.seams[0].root[2:-2])[0]
    assert off.mean() < (0.9 if kind == "bevel-groove" else 0.5)


def test_a_finer_scanner_shows_the_seam_to_a_tenth():
    camera = StructuredLightScanner(serial=3)
    scene = joint_scene("t-joint", np.random.default_rng(3), JointSize(length_mm=90), camera, 400.0, every=2)
    (seam,) = find_seams(scene.points).seams
    off = cKDTree(scene.root_mm + scene.root_errors_mm).query(seam.root[2:-2])[0]
    assert off.mean() < 0.2


def test_bad_sizes_are_named():
    with pytest.raises(InputError, match="gap_mm is 0 mm"):
        JointSize(gap_mm=0)
    with pytest.raises(InputError, match="30 to 150 deg"):
        JointSize(angle_deg=10)
    with pytest.raises(InputError, match="branch"):
        JointSize(branch_mm=40)
    with pytest.raises(InputError, match="no joint 'x'"):
        joint_piece("x")


def test_the_line_where_noisy_tubes_meet_is_found_among_pixels_without_depth():
    size = JointSize(length_mm=250, radius_mm=40, branch_mm=30)
    rng = np.random.default_rng(1)
    scene = joint_scene("saddle", rng, size, None, 500.0, every=2)
    noisy = scene.points + rng.normal(0, 0.4, scene.points.shape)
    found = find_seams(np.concatenate([noisy, np.zeros((len(noisy) // 10, 3))]))
    (seam,) = found.seams
    assert seam.kind in FAMILIES["fillet"] and seam.length_mm > 0.4 * 0.5 * len(scene.root_mm)
    assert cKDTree(scene.root_mm + scene.root_errors_mm).query(seam.root)[0].mean() < 1.2
    assert not found.labels[len(noisy) :].any()
