"""Units of a report: typeset in one way."""

from math import nan

import pytest

from filters.consistency.nees import Interval, span
from thruster_env.core.text_tables import Table, typeset
from tuning.reporting.page import Words
from tuning.reporting.tables import about, limit_cell, unless_blank


@pytest.mark.parametrize(
    ("unit", "page"), [("m^3/s", "m³/s"), ("(m/s)^2", "(m/s)²"), ("1/s", "1/s"), ("s^-1", "s⁻¹"), ("m", "m")]
)
def test_units_are_typeset_in_words_and_tables(unit, page):
    assert typeset(unit) == page
    assert (
        page in Words([f"It is 1 {unit}."]).html() and page in Table("", ["", f"q [{unit}]"], [["a", "1"]]).html()
    )


def test_a_number_that_rounds_to_zero_has_no_minus():
    cells = [
        unless_blank(value, form) for value, form in ((-0.3, "+.0f"), (-0.004, ".2f"), (-1.2, "+.0f"), (nan, ""))
    ]
    assert cells == ["0", "0.00", "-1", ""]


def test_small_errors_on_a_terminal_have_powers_of_ten():
    value = Interval(8.59e-6, 8.37e-6, 8.81e-6)
    assert about(value, 8) == "8.59e-06 ±2e-07" and limit_cell(7.5e-6, 8) == "7.50e-06"
    assert about(value._replace(value=0.1, low=0.09, high=0.11), 4) == "0.1000 ±0.0100"
    assert about(value._replace(value=float("nan")), 8) == limit_cell(float("nan"), 8) == ""


@pytest.mark.parametrize(
    ("value", "said"),
    [
        ((26.0, 25.0, 27.0), "26 % [25, 27]"),
        ((26.0, 25.86, 26.14), "26.0 % [25.9, 26.1]"),
        ((26.0, 25.99, 26.01), "26.00 % [25.99, 26.01]"),
        ((26.0, 26.0, 26.0), "26 %"),
        ((26.0, 26.0 - 1e-6, 26.0 + 1e-6), "26 %"),
        ((0.0, -0.2, 0.6), "0 % [0, 1]"),
    ],
)
def test_the_ends_of_an_interval_differ_or_are_left_out(value, said):
    assert span(Interval(*value), 0, " %") == said
