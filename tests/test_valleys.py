"""Valleys of a height field: the compiled kernels agree with their plain twins."""

import numpy as np
import pytest
from scipy import ndimage

from grindvision.vision.seam.valley_parts import connected_parts, inner_radius


@pytest.mark.parametrize("share", [0.02, 0.3, 0.5, 1.0])
def test_connected_parts_agree_with_the_plain_twin(rng, share):
    depth = np.where(rng.random((60, 45)) < share, rng.random((60, 45)), 0).astype(np.float32)
    names, volumes, boxes = connected_parts(depth, np.float32(0.2))
    plain, count = ndimage.label(depth > np.float32(0.2), np.ones((3, 3)))
    np.testing.assert_array_equal(names, plain)
    assert len(volumes) == len(boxes) == count
    np.testing.assert_allclose(volumes, np.bincount(plain.ravel(), depth.ravel(), count + 1)[1:], rtol=1e-6)
    for box, (rows, columns) in zip(boxes, ndimage.find_objects(plain), strict=True):
        assert box.tolist() == [rows.start, rows.stop, columns.start, columns.stop]


def test_a_map_without_depth_has_no_parts():
    names, volumes, boxes = connected_parts(np.zeros((5, 4), np.float32), np.float32(0))
    assert not names.any() and len(volumes) == 0 and boxes.shape == (0, 4)


@pytest.mark.parametrize("shape", [(40, 30), (3, 50), (50, 1)])
@pytest.mark.parametrize("share", [0.0, 0.5, 0.97, 1.0])
def test_inner_radius_agrees_with_the_plain_twin(rng, shape, share):
    inside = rng.random(shape) < share
    expected = ndimage.distance_transform_edt(np.pad(inside, 1)).max()
    assert inner_radius(inside) == pytest.approx(expected, abs=1e-12)
