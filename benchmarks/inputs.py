"""What the racers get, made by the virtual cell from a seed and kept in a cache; the truth lies in another folder."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.racing import Arrays, Case
from grindvision.book.places import BUILD
from grindvision.cell import GrindingScene, StructuredLightScanner, grinding_scene
from grindvision.cell.scan import Scan
from grindvision.clouds import write_ply
from grindvision.files import write_whole

CACHE = BUILD / "benchmarks"

FINE = 1.72
"""Pixels of the fine scanner over those of the EinScan-Pro, along a row: two million points a scan."""

SIZES = {"50k": 6, "200k": 3, "500k": 2, "2M": 1}
"""Every so many-th pixel of the fine scan, along rows and columns."""


def detection_cases(size: str, count: int, seed: int) -> list[Case]:
    """``count`` pairs of scans of the whole instrument, 20 to 40 degrees apart; the same scenes at every size."""
    return [_pair(f"detect-{seed}-{number}", size, [seed, 1, number]) for number in range(count)]


def large_cases(seed: int) -> list[Case]:
    """One pair of 20 million points a scan."""
    return [_pair(f"large-{seed}", "20M", [seed, 2], {"20M": 1}, 10**0.5 * FINE)]


def coarse_cases(hard: bool, count: int, seed: int) -> list[Case]:
    """``count`` pairs 20 to 40 degrees apart; the hard ones with a fifth of the relief and 60 % overlap."""
    label, relief, overlap = ("hard", 0.2, 0.6) if hard else ("easy", 1.0, 1.0)
    return [
        _pair(f"{label}-{seed}-{number}", label, [seed, 3 + hard, number], {label: 2}, 1.0, relief, overlap)
        for number in range(count)
    ]


def _pair(
    name: str, size: str, seeds: list[int], sizes: dict[str, int] = SIZES, pixels: float = FINE,
    relief: float = 1.0, overlap: float = 1.0,
) -> Case:  # fmt: skip
    """A pair of scans in the cache; all sizes of a scene are made at once."""
    if not (CACHE / "truth" / f"{name}.npz").is_file():
        rng = np.random.default_rng(seeds)
        least = min(sizes.values())
        scene = grinding_scene(rng, relief, overlap, scanner=scanner(pixels, int(rng.integers(2**31))), every=least)
        for label, every in sizes.items():
            for scan, of in ((scene.sample, "sample"), (scene.test, "test")):
                write_ply(CACHE / "inputs" / f"{name}-{label}-{of}.ply", scan.points[_thinned(scan, every // least)])
        _write_truth(name, scene)
    files = {of: CACHE / "inputs" / f"{name}-{size}-{of}.ply" for of in ("sample", "test")}
    points = sum(file.stat().st_size // 12 for file in files.values()) // 2
    return Case(size, points, {of: str(file) for of, file in files.items()}, partial(truth, name))


def scanner(pixels: float, serial: int) -> StructuredLightScanner:
    """The structured-light scanner with ``pixels`` times as many pixels along rows and columns, all else the same."""
    one = StructuredLightScanner(serial=serial)
    size = {name: round(getattr(one, name) * pixels) for name in ("columns", "rows")}
    return replace(one, **size, focal_px=one.focal_px * pixels)


def truth(name: str) -> Arrays:
    """What is true about a case."""
    with np.load(CACHE / "truth" / f"{name}.npz") as arrays:
        return dict(arrays)


def _thinned(scan: Scan, every: int) -> np.ndarray:
    return (scan.pixels % every == 0).all(axis=1)


def _write_truth(name: str, scene: GrindingScene) -> None:
    arrays = {
        "T_sample_test": scene.T_sample_test,
        "middle": scene.test.points.mean(axis=0),
        "ridge": scene.ridge_mm,
        "overlap": scene.overlap,
    }
    with write_whole(Path(CACHE / "truth" / f"{name}.npz")) as path:
        np.savez(path, **arrays)
