"""What halving and doubling the constants that decide changes on small scenes: ``python -m tests.sensitivity``.

Prints the table of ``docs/decisions/constants.md``. Each row is one constant on the scenes that it decides; everything
else stays as it is. Scenes and draws are fixed, so that a change of the code shows as a change of the table.
"""

from __future__ import annotations

import argparse
import importlib
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from grindvision import CalibrateOptions, calibrate, find_grooves
from grindvision.errors import GrindvisionError, NoGrooveError
from grindvision.vision.surface.stray_points import stray_points
from tests.calibration_rig import er3a, rig
from tests.grinding_scene import pair
from tests.groove_scenes import cloud, grid, straight_groove, vee

Floats = NDArray[np.float64]

FACTORS = (0.5, 1.0, 2.0)


def strays() -> str:
    """Points left out of 12,000, of which 20 stand far away and single ones 15, 30 and 60 mm beside the plate."""
    points = pair(seed=11, n_points=12_000).test
    far = points[:20] + [0, 0, 900]
    beside = points[np.argmax(points[:, 0])] + np.array([[15.0, 0, 0], [30, 0, 0], [60, 0, 0]])
    return str(int(stray_points(np.vstack([points, far, beside])).sum()))


def root() -> str:
    """Mean distance of the found root from the true one, and the points between the edges: 10 mm wide, 6 mm deep."""
    points, _ = straight_groove(np.random.default_rng(3), spacing_mm=1.0)

    def found() -> str:
        groove = find_grooves(points).grooves[0]
        return f"{1000 * np.abs(groove.root[:, 1]).mean():.1f} um, {len(groove.members)} points"

    return answer(found)


def grooves() -> str:
    """Grooves found 10 mm wide and 2.0, 1.2 and 0.8 mm deep in a plate that waves by 0.3 mm, and in the plate alone."""
    rng = np.random.default_rng(3)
    places = grid(spacing_mm=1.0)
    waves = 0.3 * np.sin(places[:, 0] / 15)
    clouds = [cloud(places, waves + vee(places[:, 1], 10.0, depth), rng) for depth in (2.0, 1.2, 0.8, 0.0)]
    return " / ".join(answer(partial(number_of_grooves, points)) for points in clouds)


def number_of_grooves(points: Floats) -> str:
    try:
        return str(len(find_grooves(points).grooves))
    except NoGrooveError:
        return "0"


def calibration() -> str:
    """Rows left out of 54, of which four carry slips of 3, 0.5, 0.35 and 0.25 mm, and the error of held-out rows."""
    made = rig(er3a(), np.random.default_rng(1), test=12)
    tracker = made.measurements.tracker_mm.copy()
    for row_, slip_mm in ((5, 3.0), (17, 0.5), (29, 0.35), (41, 0.25)):
        tracker[row_, 0] += slip_mm
    rows = replace(made.measurements, tracker_mm=tracker)

    def fitted() -> str:
        result = calibrate(rows, er3a(), CalibrateOptions(beyond_geometry=False))
        return f"{len(result.dropped)} rows, {1000 * result.errors(train=False).mean:.1f} um"

    return answer(fitted)


def answer(measure: Callable[[], str]) -> str:
    """What comes out, or the class of the refusal."""
    try:
        return measure()
    except GrindvisionError as refusal:
        return type(refusal).__name__


@dataclass(frozen=True)
class Constant:
    """A constant of a module and the scenes that show what it decides."""

    module: str
    name: str
    scenes: tuple[Callable[[], str], ...]

    @property
    def value(self) -> float:
        """As it stands in the code."""
        return float(getattr(importlib.import_module(f"grindvision.{self.module}"), self.name))


CONSTANTS = (
    Constant("vision.surface.stray_points", "MAX_STRAY", (strays,)),
    Constant("vision.surface.stray_points", "CELLS_ACROSS", (strays,)),
    Constant("vision.seam.valley", "SMOOTHING_FRACTION", (grooves, root)),
    Constant("vision.seam.valley", "FLANK_FRACTION", (grooves, root)),
    Constant("vision.seam.valley", "ENOUGH_VOLUME", (grooves, root)),
    Constant("vision.seam.valley", "MIN_RELIEF", (grooves,)),
    Constant("vision.seam.valley", "MIN_CONTRAST", (grooves,)),
    Constant("vision.seam.groove_fit", "MIN_WALL_SLOPE", (grooves,)),
    Constant("calibration.robust", "FALSE_ALARM", (calibration,)),
    Constant("calibration.diagnosis", "SUSPICIOUS_MM", (calibration,)),
)


@contextmanager
def scaled(constant: Constant, factor: float) -> Iterator[None]:
    """The constant times a factor, in its module and in those that have imported it."""
    home = importlib.import_module(f"grindvision.{constant.module}")
    kept = getattr(home, constant.name)
    holders = [
        module
        for name, module in list(sys.modules.items())
        if name.startswith("grindvision.") and vars(module).get(constant.name) is kept
    ]
    for module in holders:
        setattr(module, constant.name, type(kept)(kept * factor))
    try:
        yield
    finally:
        for module in holders:
            setattr(module, constant.name, kept)


def row(constant: Constant, factors: tuple[float, ...] = FACTORS) -> list[str]:
    """Cells of the table: room, name and value, then what comes out at each factor."""
    cells = [constant.module.rpartition(".")[2], f"`{constant.name}` = {constant.value:g}"]
    for factor in factors:
        with scaled(constant, factor), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            cells.append("; ".join(scene() for scene in constant.scenes))
    return cells


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="these constants alone")
    names = parser.parse_args().only
    print("| module | constant | halved | as it is | doubled |\n|---|---|---|---|---|")
    for constant in CONSTANTS:
        if not names or constant.name in names:
            print("| " + " | ".join(row(constant)) + " |", flush=True)


if __name__ == "__main__":
    main()
