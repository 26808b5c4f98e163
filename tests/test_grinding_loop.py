"""The loop on the twin: a wheel that is touched off, or learns from its own cut, leaves the good surface whole."""

import warnings

import numpy as np
import pytest

pytest.importorskip("open3d", reason="needs the extra sim")

from benchmarks.grinding import outcome
from grindvision.cell.grinding_scene import grinding_scene
from grindvision.errors import GrindvisionWarning
from grindvision_book.chapter_16.loop import Shop, jobs


@pytest.mark.parametrize("seed", [7, pytest.param(1, marks=pytest.mark.full)])
def test_a_wheel_that_was_not_touched_off_learns_where_it_runs(seed):
    """The arm runs 0.15 mm too low: sent where the scan says, it would ruin the part."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GrindvisionWarning)
        scene = grinding_scene(np.random.default_rng(seed), every=2)
        loop = list(jobs(scene, Shop(arm_mm=-0.15), seed, every=2))
    assert len(loop) > 1 and max(job.gouge_mm for job in loop) <= 0.05
    assert loop[-1].left_95_mm <= 0.2 and loop[-1].left_95_mm < loop[0].left_95_mm
    sigmas = [job.plan.work.offset_sigma_mm for job in loop]
    assert sigmas[1] < 0.4 * sigmas[0]


@pytest.mark.full
def test_what_must_be_shown_of_fifty_instruments():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GrindvisionWarning)
        rows = [outcome(seed, 1) for seed in range(50)]
    off = np.array([(row.volume_off, row.sigmas_off, row.k_off) for row in rows])
    assert np.median(np.abs(off[:, 0])) < 0.02
    assert 0.6 <= np.mean(np.abs(off[:, 1]) < 1) <= 0.76
    told = np.abs(off[np.isfinite(off[:, 2]), 2])
    assert len(told) >= 15 and np.median(told) < 0.05 and np.mean(told < 0.05) >= 0.9
    for name, held in (("touched", 1.0), ("loop", 0.9)):
        gouges, left = (np.array([getattr(row, f"{name}_{what}_mm") for row in rows]) for what in ("gouge", "left"))
        assert gouges.max() <= 0.05 and np.mean(left <= 0.15) >= held
    blind = np.array([row.blind_gouge_mm for row in rows])
    assert np.mean(blind > 0.05) > 0.05  # no plan that trusts the scan alone can hold it
