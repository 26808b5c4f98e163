"""Functions with the arguments they had before: what old names of ``vision`` stand for, for one version."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.vision.change.change_detection import (
    Difference,
    NearestSearch,
    find_change,
    find_change_paper,
    kd_tree_distances,
)
from grindvision.vision.registration.icp import FineRegistration
from grindvision.vision.surface.scan import Scan


def find_difference(sample: Scan, test: Scan, registration: FineRegistration, least_surfels: int = 10) -> Difference:
    """``find_change`` with the sample, its target, first."""
    return find_change(test, sample, registration, least_surfels)


def difference_paper(
    sample: ArrayLike,
    test_in_sample: ArrayLike,
    threshold_mm: float,
    squared: bool = True,
    search: NearestSearch = kd_tree_distances,
) -> NDArray[np.bool_]:
    """``find_change_paper`` with the sample, its target, first."""
    return find_change_paper(test_in_sample, sample, threshold_mm, squared, search)
