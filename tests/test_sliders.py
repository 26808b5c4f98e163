"""Sliders: a strip of pictures that repeats byte for byte where nobody can move one."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.axes import Axes

import grindvision_book as book
from grindvision.errors import InputError
from grindvision_book.machinery import sliders
from grindvision_book.machinery.figures import is_live


def draw(axes: Axes, exponent: float) -> pd.DataFrame:
    x = np.linspace(0, 1, 5)
    axes.plot(x, x**exponent)
    return pd.DataFrame({"x_mm": x, "y_mm": x**exponent})


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("GRINDVISION_FIGURES", str(tmp_path))
    book.start("01")
    return tmp_path


def test_a_strip_holds_the_chosen_values_and_repeats_byte_for_byte(folder: Path) -> None:
    made = []
    for _ in range(2):
        book.slider(draw, [1, 2, 3, 4, 5], "slider_test", "size of it, mm", "A caption", strip=[1, 3, 4])
        made.append([(folder / f"slider_test.{kind}").read_bytes() for kind in ("svg", "png", "csv")])
    assert made[0] == made[1]
    table = pd.read_csv(folder / "slider_test.csv")
    assert list(table.columns) == ["size_of_it_mm", "x_mm", "y_mm"]
    assert list(table["size_of_it_mm"].unique()) == [1, 3, 4]
    assert np.allclose(table["y_mm"], table["x_mm"] ** table["size_of_it_mm"], atol=1e-6)


def test_a_strip_that_is_not_chosen_runs_from_end_to_end(folder: Path) -> None:
    book.slider(draw, [1, 2, 3, 4, 5, 6, 7], "slider_test", "exponent", "A caption")
    assert list(pd.read_csv(folder / "slider_test.csv")["exponent"].unique()) == [1, 3, 5, 7]


def test_a_live_notebook_gets_a_slider_over_pictures_of_one_scale_with_their_caption_and_no_file(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: dict[str, Any] = {}
    displayed: list[Any] = []
    monkeypatch.setattr(sliders, "is_live", lambda: True)
    monkeypatch.setattr("ipywidgets.interact", lambda show, value: shown.update(knob=value, show=show))
    monkeypatch.setattr("IPython.display.display", lambda *things: displayed.extend(things))
    book.slider(draw, [1, 2, 3], "slider_test", "exponent", "A caption")
    assert [choice for _, choice in shown["knob"].options] == [1, 2, 3] and shown["knob"].value == 2
    for value in (1, 3):
        shown["show"](value)
    first, caption, last, _ = displayed
    assert first.data != last.data and first.data.startswith(b"\x89PNG") and caption.data == "*A caption*"
    assert list(folder.iterdir()) == []


def test_nobody_moves_sliders_while_the_book_is_rebuilt(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("JPY_SESSION_NAME", "01_scanning_a_part.ipynb")
    assert not is_live()


def test_a_slider_that_cannot_show_anything_is_refused(folder: Path) -> None:
    with pytest.raises(InputError, match="at least 3 values"):
        book.slider(draw, [1, 2], "slider_test", "exponent", "A caption")
    with pytest.raises(InputError, match=r"\[9\]"):
        book.slider(draw, [1, 2, 3], "slider_test", "exponent", "A caption", strip=[1, 9])


def test_the_pictures_of_a_page_share_one_scale_and_the_middle_one_is_shown():
    drawn = []

    def draw(axes, value):
        axes.plot([0, value], [0, -value])
        drawn.append(axes)
        return pd.DataFrame({"size_mm": [value]})

    page = sliders.frames_html(draw, [1, 2, 3], "edge, mm", 'A "caption"')
    assert {axes.get_xlim() for axes in drawn} == {drawn[2].get_xlim()}
    assert len({axes.get_ylim() for axes in drawn}) == 1
    assert page.count("<img ") == 3 and page.count(" hidden>") == 2
    assert "<output>edge 2 mm</output>" in page and 'A "caption"' not in page
    assert page.endswith("<figcaption>A &quot;caption&quot;</figcaption></figure>")
