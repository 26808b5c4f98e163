"""What limits a ground part: the error of the registration, where the wheel runs, its width, the depth of cut."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from grindvision.cell.grinding_part import grinding_part
from grindvision.cell.grinding_scene import GrindingScene, grinding_scene
from grindvision.grinding import Grinding, GrindOptions
from grindvision.motion.grinding import plan_grinding
from grindvision.motion.grinding_options import GrindingOptions
from grindvision.vision.change.comparison import compare
from grindvision.vision.change.stock import Stock, measure_stock
from grindvision.vision.registration.scan_registration import StageClock
from grindvision_book.chapter_16.loop import Job, Shop, first_job, jobs, true_map, true_volume_mm3

Floats = NDArray[np.float64]


def by_registration(found: Grinding, errors_mm: Sequence[float]) -> pd.DataFrame:
    """Volume of the bead in mm3, and what an error of the registration along the bead's normal makes of it: with the
    good surface around the bead as its datum, and as the error would have it without (error times area)."""
    compared, piece = found.compared, found.stock.pieces[0]
    registration = compared.registration
    up = registration.fine.T_target_source[:3, :3] @ piece.map.T_scan_map[:3, 2]
    rows = []
    for error_mm in errors_mm:
        moved = registration.fine.T_target_source.copy()
        moved[:3, 3] += error_mm * up
        off = replace(registration.fine, T_target_source=moved)
        stock = measure_stock(registration.source, registration.target, off, compared.difference)
        without = piece.volume_mm3 + error_mm * float(piece.map.areas_mm2[piece.inside].sum())
        rows.append((error_mm, stock.pieces[0].volume_mm3, without))
    return pd.DataFrame(rows, columns=["error_mm", "volume_mm3", "without_datum_mm3"])


def by_offset(scene: GrindingScene, found: Grinding, offsets_mm: Sequence[float]) -> pd.DataFrame:
    """What stays, and how deep the part is cut, where the wheel runs higher or lower than it is sent."""
    rows = []
    high_mm = _touched_mm(scene, found)
    for offset_mm in offsets_mm:
        job = first_job(scene, Shop(arm_mm=high_mm + offset_mm), found)
        rows.append((offset_mm, job.left_95_mm, job.gouge_mm))
    return pd.DataFrame(rows, columns=["offset_mm", "left_95_mm", "gouge_mm"])


def by_wheel(
    scene: GrindingScene, found: Grinding, widths_mm: Sequence[float], depths_mm: Sequence[float]
) -> pd.DataFrame:
    """What wheels of some widths and passes of some depths leave, touched off, and how long they are in contact."""
    plan = found.plans[0]
    assert plan is not None
    settings = [("width_mm", width, replace(plan.options, width_mm=width)) for width in widths_mm]
    settings += [("depth_mm", depth, replace(plan.options, depth_mm=depth)) for depth in depths_mm]
    rows = []
    for varied, value, options in settings:
        again = replace(found, plans=(plan_grinding(plan.work, options),))
        job = first_job(scene, Shop(touched_off=True, passes=options), again)
        rows.append((varied, value, len(job.plan.passes), job.plan.seconds, job.left_95_mm, job.gouge_mm))
    return pd.DataFrame(rows, columns=["varied", "value", "passes", "contact_s", "left_95_mm", "gouge_mm"])


def volumes(first: tuple[int, GrindingScene, Stock], others: Sequence[int], every: int) -> pd.DataFrame:
    """Volume of the bead of several instruments, with sigma, against the solid's: of the ``first``, its seed, scene and
    stock, and of ``others``, their seeds, which scan the same part."""
    seed, scene, stock = first
    measured = [(seed, stock)]
    for seed in others:
        pair = grinding_scene(np.random.default_rng(seed), part=scene.part, every=every)
        compared = compare(pair.sample.points, pair.test.points, GrindOptions(), StageClock())
        found = compared.registration
        measured.append((seed, measure_stock(found.source, found.target, found.fine, compared.difference)))
    true_mm3 = true_volume_mm3(scene)
    rows = [(seed, true_mm3, of.pieces[0].volume_mm3, of.pieces[0].volume_sigma_mm3) for seed, of in measured]
    table = pd.DataFrame(rows, columns=["seed", "true_mm3", "found_mm3", "sigma_mm3"])
    return table.assign(off_percent=100 * (table["found_mm3"] / table["true_mm3"] - 1))


def learnt(seeds: Sequence[int], k_factor: float, passes: GrindingOptions, every: int) -> pd.DataFrame:
    """Preston's coefficient from one scan after some passes of a wheel that is touched off, against the true one."""
    rows = []
    part = grinding_part()
    for seed in seeds:
        scene = grinding_scene(np.random.default_rng(seed), part=part, every=every)
        told = next(jobs(scene, Shop(k_factor, touched_off=True, passes=passes), seed, every)).learnt
        if told is not None:
            sigma = told.k_sigma_mm2_n / passes.k_mm2_n
            rows.append((seed, k_factor, told.factor, sigma, 100 * (told.factor / k_factor - 1)))
    return pd.DataFrame(rows, columns=["seed", "true", "learnt", "sigma", "off_percent"])


def table_of(loop: Sequence[Job]) -> pd.DataFrame:
    """The loop job by job: what was known of the wheel, what the true part has left, what the scan told."""
    rows = []
    for number, job in enumerate(loop, start=1):
        told, after = job.learnt, job.after
        rows.append(
            {
                "job": number,
                "passes": len(job.plan.passes),
                "offset_sigma_mm": job.plan.work.offset_sigma_mm,
                "left standing_mm": job.plan.leave_mm,
                "true left_95_mm": job.left_95_mm,
                "true gouge_mm": job.gouge_mm,
                "learnt offset_mm": np.nan if told is None else job.plan.work.offset_mm + told.offset_mm,
                "verdict": "" if after is None else "met" if after.met else "not met",
            }
        )
    return pd.DataFrame(rows)


def _touched_mm(scene: GrindingScene, found: Grinding) -> float:
    """How much the arm must err for the wheel to run as one that is touched off."""
    piece = found.stock.pieces[0]
    return float(np.nanmean(true_map(scene.part.sample, scene.test, piece.map)[piece.unchanged]))
