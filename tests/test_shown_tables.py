"""Tables as a person reads them."""

import numpy as np
import pandas as pd
import pytest
from IPython.core.interactiveshell import InteractiveShell

import grindvision_book as book
from grindvision_book.machinery.shown_tables import cell_texts, heading, table_html


@pytest.mark.parametrize(
    "column, words",
    [
        ("turn_deg", "turn (°)"),
        ("x_mm", "x (mm)"),
        ("mm", "mm"),
        ("std", "standard deviation"),
        (("x_mm", 0.1), "x (mm), 0.1"),
    ],
)
def test_a_heading_is_words_and_a_unit(column, words):
    assert heading(column) == words


def test_printed_values_keep_their_digits_and_a_missing_one_is_not_printed():
    printed = pd.Series([30.3999, 30.45, np.nan, 27.0], name="paper_height_mm")
    assert cell_texts(printed) == ["30.3999", "30.45", "not printed", "27"]
    assert cell_texts(printed.rename("height_mm").where([True, True, False, True]))[2] == ""


def test_values_that_lie_close_together_keep_the_decimals_that_tell_them_apart():
    assert cell_texts(pd.Series([30.38812, 30.41547], name="z_mm")) == ["30.388", "30.415"]
    assert cell_texts(pd.Series([1234.567, 0.0123456], name="z")) == ["1235", "0.01235"]


def test_row_numbers_are_not_shown_and_names_of_rows_are():
    assert "<td>0</td>" not in table_html(pd.DataFrame({"a": ["x"]}))
    assert "<td>first</td>" in table_html(pd.DataFrame({"a": ["x"]}, index=["first"]))


def test_text_cannot_bring_markup_into_a_page():
    assert "<b>" not in table_html(pd.DataFrame({"<b>": ["<b>"]}))


def test_a_chapter_that_has_begun_shows_its_tables_so():
    shell = InteractiveShell.instance()
    try:
        book.start("01")
        shown = shell.display_formatter.format(pd.DataFrame({"paper_mm": [np.nan], "turn_deg": [2.0]}))[0]["text/html"]
        assert "turn (°)" in shown and "not printed" in shown and "NaN" not in shown
    finally:
        InteractiveShell.clear_instance()
