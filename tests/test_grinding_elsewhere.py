"""A verdict on the pieces of a job says nothing of the rest of the part: what a new scan shows there is told."""

import warnings

import numpy as np
import pytest

from grindvision.errors import GrindvisionWarning
from grindvision.grinding import GrindOptions, grind
from grindvision.grinding_again import GrindAgainOptions, grind_again
from grindvision.grinding_files import job_of
from grindvision.motion.grinding_options import GrindingOptions
from tests.grinding_scene import Bead, arc_bead, pair

ELSEWHERE = np.column_stack([np.linspace(30.0, 50.0, 300), np.full(300, -35.0)])


@pytest.fixture(scope="module")
def job():
    scene = pair(0, 30_000, beads=[arc_bead(width_mm=6.0)])
    found = grind(scene.sample, scene.test, GrindOptions(GrindingOptions(depth_mm=0.4)))
    return scene.sample, job_of(found.T_sample_test, found.stock.pieces, found.plans, GrindingOptions(depth_mm=0.4))


@pytest.mark.parametrize(
    ("height_mm", "said"), [(1.5, "stands out beside the pieces"), (-1.5, "material is missing in 1 place"), (0.0, "")]
)
def test_what_stands_or_is_missing_beside_the_pieces_is_told(job, height_mm, said):
    sample, planned = job
    new = pair(5, 30_000, beads=[Bead(ELSEWHERE, 6.0, height_mm)]).test
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        after = grind_again(planned, sample, new, GrindAgainOptions(tolerance_mm=0.4))
    words = " ".join(str(one.message) for one in told if issubclass(one.category, GrindvisionWarning))
    assert after.judged[0].met
    assert said in words if said else "beside the pieces" not in words
