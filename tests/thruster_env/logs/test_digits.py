"""Dates and clock times that are written as numbers."""

from datetime import datetime, timedelta

import numpy as np
import pytest

from thruster_env.logs.times import in_seconds

FIRST = datetime(2024, 1, 30, 22)


def stamps(form, step, count=60):
    return np.array([float((FIRST + k * step).strftime(form)) for k in range(count)])


@pytest.mark.parametrize(
    ("form", "step"),
    [
        ("%Y%m%d", timedelta(days=1)),
        ("%Y%m%d%H", timedelta(hours=1)),
        ("%Y%m%d%H%M", timedelta(minutes=7)),
        ("%Y%m%d%H%M%S", timedelta(seconds=31)),
    ],
)
def test_dates_in_digits_are_equal_steps_over_the_end_of_a_month(form, step):
    seconds, words = in_seconds(stamps(form, step), None, "timestamp", "column 'timestamp'")
    np.testing.assert_array_equal(np.diff(seconds), step.total_seconds())
    assert words.startswith("times in column 'timestamp' are taken as dates such as 2026050")


def test_digits_count_since_1970_and_keep_missing_times_and_fractions():
    seconds, _ = in_seconds(
        np.array([20240131235959.5, np.nan, 20240201000000.0, 20240201000001.0]), None, "t", "t"
    )
    np.testing.assert_array_equal(seconds, [1706745599.5, np.nan, 1706745600.0, 1706745601.0])


@pytest.mark.parametrize(
    "numbers",
    [
        1706745600.0 + np.arange(60.0),  # seconds since 1970
        20240101.0 + np.arange(60.0),  # a counter that goes on to 20240132
        20240229.0 - 365e4 + np.arange(3.0),  # 20590229, which is no leap year's
        1e7 + np.arange(60.0),
    ],
)
def test_numbers_that_are_no_dates_stay_seconds(numbers):
    np.testing.assert_array_equal(in_seconds(numbers, None, "t", "t")[0], numbers)


def test_a_unit_that_is_given_wins():
    dates = stamps("%Y%m%d", timedelta(days=1))
    np.testing.assert_array_equal(in_seconds(dates, "s", "Date", "Date")[0], dates)


@pytest.mark.parametrize(
    ("header", "numbers", "step", "name"),
    [
        ("Date", 45292.0 + np.round(np.arange(60.0) / 24.0, 6), 3600.0, "days"),
        ("date", 739252.0 + np.arange(60.0), 86400.0, "days"),
        ("Datum", 2460310.5 + np.arange(60.0), 86400.0, "days"),
        ("Year", 1700.0 + np.arange(60.0), 365.25 * 86400.0, "years"),
    ],
)
def test_numbers_in_a_column_of_dates_are_days_or_years(header, numbers, step, name):
    seconds, words = in_seconds(numbers, None, header, f"column {header!r}")
    np.testing.assert_allclose(np.diff(seconds), step, rtol=1e-9)
    assert words == f"times in column {header!r} are taken as {name}"


def test_other_numbers_in_a_column_of_dates_are_seconds_and_that_is_said():
    seconds, words = in_seconds(np.arange(60.0), None, "date", "column 'date'")
    np.testing.assert_array_equal(seconds, np.arange(60.0))
    assert words == "times in column 'date' are taken as s; if they are days, use --column 'time=date[d]'"
    np.testing.assert_array_equal(in_seconds(np.arange(60.0), "d", "date", "date")[0], 86400.0 * np.arange(60.0))


@pytest.mark.parametrize(("form", "step"), [("%H%M", 60.0), ("%H%M%S", 1.0), ("%H%M%S", 20.0), ("%H%M%S", 60.0)])
def test_clock_times_in_digits_are_refused(form, step):
    begin = datetime(2024, 1, 1, 9, 58, 30)
    numbers = np.array([float((begin + timedelta(seconds=k * step)).strftime(form)) for k in range(200)])
    with pytest.raises(
        ValueError, match=r"times must be numbers of one unit, or dates, but in t \d+ is followed by"
    ):
        in_seconds(numbers, None, "t", "t")


@pytest.mark.parametrize(
    "numbers", [50.0 * np.arange(60.0), 100.0 * np.arange(60.0), 20.0 * np.arange(3.0), 0.5 * np.arange(400.0)]
)
def test_seconds_that_look_like_clock_times_stay_seconds(numbers):
    np.testing.assert_array_equal(in_seconds(numbers, None, "t", "t")[0], numbers)


@pytest.mark.parametrize(("first", "step", "said"), [(45292.0, 1 / 24, "3600"), (739252.0, 1 / 96, "900")])
def test_seconds_that_may_be_days_are_said(first, step, said):
    numbers = np.round(first + step * np.arange(60.0), 6)
    seconds, words = in_seconds(numbers, None, "time", "column 'time'")
    np.testing.assert_array_equal(seconds, numbers)
    assert words.endswith(f"it is {said} s: use --column 'time=time[d]'")


@pytest.mark.parametrize(("first", "step"), [(45292.0, 0.02), (45292.0, 0.05), (0.0, 1 / 24), (45292.0, 0.0333)])
def test_seconds_beyond_doubt_are_not(first, step):
    assert in_seconds(np.round(first + step * np.arange(60.0), 6), None, "time", "time")[1] == ""
