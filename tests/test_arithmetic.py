"""Laws of the arithmetic: neither the last digits of the points nor their order move a path, and the book's pins."""

import numpy as np
import pytest

from grindvision.calibration import Measurements
from grindvision.errors import GrindvisionError
from grindvision.vision import detect
from grindvision_book.chapter_08 import compound, registered
from grindvision_book.machinery.arithmetic import PINS, pins
from grindvision_book.studies.running import case_rng
from tests.grinding_scene import arc_bead, pair


def moved(points, rng):
    """The points in another order, each by 1e-12 of its size elsewhere."""
    return rng.permutation(nudged(points, rng))


def nudged(values, rng):
    return values * (1 + 1e-12 * rng.uniform(-1, 1, values.shape))


def largest_change(seed, n_points):
    rng = np.random.default_rng([seed, 17])
    scene = pair(seed=seed, n_points=n_points, beads=[arc_bead()], angle_rad=rng.uniform(0.2, 0.6))
    found = detect(scene.sample, scene.test)
    again = detect(moved(scene.sample, rng), moved(scene.test, rng))
    spots = scene.test[::500]
    apart = (found.T_sample_test - again.T_sample_test) @ np.column_stack([spots, np.ones(len(spots))]).T
    return max(np.abs(found.path_points - again.path_points).max(), np.abs(apart).max())


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.full) for seed in (0, 2))])
def test_order_and_last_digits_of_the_points_move_no_path(seed):
    assert largest_change(seed, 40_000) < 1e-6


@pytest.mark.full
@pytest.mark.parametrize("tens", range(10))
def test_order_and_last_digits_move_no_path_of_a_hundred_scenes(tens):
    seeds = range(10 * tens, 10 * tens + 10)
    changes = {seed: largest_change(seed, 40_000) for seed in seeds}
    assert max(changes.values()) < 1e-4, changes


class Instruments:
    """What scanner and tracker of a robot cell of chapter 08 give: kept from one run, and moved in the next."""

    def __init__(self, monkeypatch):
        self.kept, self.rng = [], None
        self.left = iter(())
        for name in ("_scan_of_spot", "measured"):
            monkeypatch.setattr(compound, name, self.once(getattr(compound, name)))
        monkeypatch.setattr(registered.RegisteredPair, "near", self.moved(registered.RegisteredPair.near))
        monkeypatch.setattr(registered.RegisteredPair, "with_test", self.moved(registered.RegisteredPair.with_test))
        monkeypatch.setattr(compound, "Measurements", self.measurements)

    def once(self, make):
        def kept(*arguments, **named):
            rng = next(one for one in arguments if isinstance(one, np.random.Generator))
            if self.rng is None:
                made = make(*arguments, **named)
                self.kept.append((made, rng.bit_generator.state))
            else:
                made, rng.bit_generator.state = next(self.left)
            return made

        return kept

    def moved(self, register):
        def registered(*arguments):
            if self.rng is not None:
                return register(*(moved(a, self.rng) if np.shape(a)[1:] == (3,) else a for a in arguments))
            return register(*arguments)

        return registered

    def measurements(self, q_rad, scanner_mm, tracker_mm, sphere):
        if self.rng is None:
            return Measurements(q_rad, scanner_mm, tracker_mm, sphere=sphere)
        order = self.rng.permutation(len(q_rad))
        q_rad, scanner_mm, tracker_mm = (nudged(one[order], self.rng) for one in (q_rad, scanner_mm, tracker_mm))
        return Measurements(q_rad, scanner_mm, tracker_mm, sphere=sphere[order])

    def numbers(self, cell, again):
        """Every number of one cell of the study; None where it is refused."""
        self.rng, self.left = (np.random.default_rng([cell, 17]), iter(self.kept)) if again else (None, iter(()))
        compound._drawn_cell.cache_clear()  # calibrate anew, from the moved measurements
        if not again:
            self.kept.clear()
        try:
            return np.array(list(compound.compound_case(case_rng(8, cell)).values()))
        except GrindvisionError:
            return None


def largest_change_of_a_cell(cell, instruments):
    found, again = (instruments.numbers(cell, again) for again in (False, True))
    if found is None or again is None:
        return 0.0 if found is again else np.inf
    return np.abs(found - again).max()


def test_order_and_last_digits_move_no_number_of_a_robot_cell(monkeypatch):
    assert largest_change_of_a_cell(0, Instruments(monkeypatch)) < 1e-4


@pytest.mark.full
@pytest.mark.parametrize("tens", range(20))
def test_order_and_last_digits_move_no_number_of_two_hundred_robot_cells(tens, monkeypatch):
    instruments = Instruments(monkeypatch)
    changes = {cell: largest_change_of_a_cell(cell, instruments) for cell in range(10 * tens, 10 * tens + 10)}
    assert max(changes.values()) < 1e-4, changes


def test_pins_leave_what_the_environment_says():
    assert not set(pins(dict.fromkeys(PINS, "x"))) & set(PINS)
    assert pins({"OMP_NUM_THREADS": "3"}).get("OMP_NUM_THREADS") is None
