"""Dates as spreadsheets write them, clock times, and both in two columns."""

from datetime import datetime, timedelta

import numpy as np
import pytest

from thruster_env.logs.table import Table
from thruster_env.logs.times import date_of, seconds_of

STEPS = np.array([0.0, 3600.0, 86400.0, 30 * 86400.0 + 1.0])
MOMENTS = [datetime(2026, 4, 30, 22) + timedelta(seconds=step) for step in STEPS.tolist()]


@pytest.mark.parametrize(
    "form",
    [
        "%Y-%m-%dT%H:%M:%S",
        "%Y/%m/%d %H:%M:%S",
        "%d.%m.%Y %H:%M:%S",
        "%d/%m/%Y %H:%M:%S",
        "%m/%d/%Y %H:%M:%S",
        "%m-%d-%Y %I:%M:%S %p",
        "%Y-%m-%d %H:%M:%S,000",
        "%Y-%m-%d %H:%M:%S UTC",
        "%d.%m.%Y, %H:%M:%S GMT",
        "%Y/%m/%d %H:%M:%S+02:00",
    ],
)
def test_dates_of_spreadsheets_are_dates(form):
    texts = [moment.strftime(form) for moment in MOMENTS]
    np.testing.assert_array_equal(seconds_of([*texts[:1], "nan", *texts[1:]]), np.insert(STEPS, 1, np.nan))


def test_days_and_months_alone():
    np.testing.assert_array_equal(seconds_of(["1.3.2024", "02.03.2024"]), [0.0, 86400.0])
    np.testing.assert_array_equal(seconds_of(["2024-02", "2024-03", "2024-04"]), [0.0, 29 * 86400.0, 60 * 86400.0])
    np.testing.assert_array_equal(seconds_of(["1/31/2024 9:05", "2/1/2024 0:05"]), [0.0, 54000.0])


def test_clock_times_go_on_at_midnight():
    np.testing.assert_array_equal(
        seconds_of(["23:59:58.5", "nan", "0:00:00", "00:00:01"]), [0.0, np.nan, 1.5, 2.5]
    )
    np.testing.assert_array_equal(seconds_of(["11:59:59 AM", "12:00:00 PM", "01:00:00 pm"]), [0.0, 1.0, 3601.0])


@pytest.mark.parametrize("texts", [["1/2/2024", "1/3/2024"], ["13/1/2024", "1/13/2024"]])
def test_days_and_months_in_an_order_that_nothing_tells_are_refused(texts):
    with pytest.raises(ValueError, match="times must be dates as of ISO 8601, .* a day above 12, but got '1"):
        seconds_of(texts)


@pytest.mark.parametrize(
    "texts", [["00:01", "00:02"], ["Oslo"], ["1.2"], ["30.2.2024"], ["nan"], ["1:2:3"], ["12-05"]]
)
def test_other_texts_are_no_dates(texts):
    assert seconds_of(texts) is None


def table(**cells):
    return Table("log.csv", cells, range(2, 2 + len(cells["z"])))


@pytest.mark.parametrize("day", ["%Y-%m-%d", "%d.%m.%Y"])
@pytest.mark.parametrize("clock", ["%H:%M:%S", "%I:%M:%S %p"])
def test_days_and_clock_times_in_two_columns_are_one(day, clock):
    log = table(
        Datum=[moment.strftime(day) for moment in MOMENTS[:1] * 2 + MOMENTS[2:]],
        Uhrzeit=[moment.strftime(clock) for moment in MOMENTS[:1] * 2 + MOMENTS[2:]],
        z=["1", "2", "3", "4"],
    )
    for column in ("Datum", "Uhrzeit"):
        np.testing.assert_array_equal(log.dates(column), STEPS * [0.0, 0.0, 1.0, 1.0])
    assert log.dates("z") is None


def test_days_that_differ_are_not_joined_with_a_clock_time():
    log = table(day=["2024-01-01", "2024-01-02"], sunrise=["08:12:00", "08:11:00"], z=["1", "2"])
    np.testing.assert_array_equal(log.dates("day"), [0.0, 86400.0])
    assert date_of("2024-01-01") == datetime(2024, 1, 1)


def test_a_time_that_is_neither_date_nor_number_says_what_it_must_be():
    with pytest.raises(
        ValueError, match=r"times must be dates as of ISO 8601, .*, or numbers, but got '1 May' in line 2"
    ):
        table(time=["1 May"], z=["1"]).numbers("time")
