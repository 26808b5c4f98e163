"""The constants of the sensitivity table are those of the code, and scaling them leaves nothing behind."""

import importlib

import pytest

from tests.sensitivity import CONSTANTS, Constant, row, scaled, strays


@pytest.mark.parametrize("constant", CONSTANTS, ids=lambda constant: constant.name)
def test_a_constant_is_scaled_where_it_is_used_and_put_back(constant):
    home = importlib.import_module(f"grindvision.{constant.module}")
    before = getattr(home, constant.name)
    with scaled(constant, 2.0):
        assert getattr(home, constant.name) == type(before)(2 * before)
    assert getattr(home, constant.name) is before


def test_a_row_of_the_table_shows_what_the_constant_decides():
    _, named, halved, as_it_is, _ = row(Constant("vision.surface.stray_points", "MAX_STRAY", (strays,)))
    assert named == "`MAX_STRAY` = 0.002" and int(halved) < int(as_it_is)
