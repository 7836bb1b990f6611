"""Columns of numbers with their times: what is read, found and refused, and numbers that are no measurements."""

import math

import numpy as np
import pytest

import tuning
from tests.filters.checks import refused
from tests.tuning.test_series import NILE, simulated
from thruster_env.logs.findings import unmeasured
from tuning.series.column import column_of, resolution_of_values

Z = np.random.default_rng(1).normal(size=60)


def test_an_index_of_dates_and_a_file_are_the_same_numbers(tmp_path):
    pandas = pytest.importorskip("pandas")
    index = pandas.date_range("2026-01-01", periods=len(Z), freq="100ms")
    of_series = column_of(pandas.Series(Z, index=index, name="depth [m]"))
    file = tmp_path / "depth.csv"
    file.write_text("t,depth [m]\n" + "".join(f"{0.1 * k:.1f},{float(value)!r}\n" for k, value in enumerate(Z)))
    of_file = column_of(file)
    for column in (of_series, of_file):
        np.testing.assert_array_equal(column.values, Z)
        assert column.dt == pytest.approx(0.1) and column.quantities[0][:3] == ("depth", "depth", "m")
    assert column_of(list(Z)).dt == 1.0 and column_of([*Z[:30], None]).measured.sum() == 30


def test_a_pandas_index_of_times_is_taken_and_one_that_counts_is_not():
    pandas = pytest.importorskip("pandas")
    z, dates = np.arange(40.0) % 7.0, pandas.date_range("2026-01-01", periods=40, freq="100ms")
    seconds = 0.1 * np.arange(40.0)
    for index in (seconds, pandas.Index(seconds, name="elapsed"), pandas.Index(1e3 * seconds, name="elapsed_ms")):
        assert column_of(pandas.Series(z, index=index)).dt == pytest.approx(0.1)
    assert column_of(pandas.Series(z, index=map(str, dates))).dt == pytest.approx(0.1)
    hours = pandas.period_range("2026-01-01", periods=40, freq="h")
    assert column_of(pandas.DataFrame({"z": z}, index=hours)).dt == 3600.0
    for index in (None, np.arange(40.0), range(100, 140), [f"row {k}" for k in range(40)]):
        assert column_of(pandas.Series(z, index=index)).dt == 1.0
    with pytest.raises(ValueError, match="index of numbers must increase, but 3.8.* follows 3.9"):
        column_of(pandas.Series(z, index=seconds[::-1]))
    table = pandas.DataFrame({"time": np.arange(40.0), "z": z}, index=seconds)
    assert column_of(table).dt == 1.0  # its column of times is meant
    missing = column_of(pandas.Series(z, index=seconds).drop(seconds[[5, 6]]))
    assert np.flatnonzero(np.isnan(missing.values)).tolist() == [5, 6]


@pytest.mark.parametrize(
    ("times", "header", "dt"),
    [
        ([f"2026-05-01T12:{k // 60:02d}:{k % 60:02d}" for k in range(0, 120, 2)], "Datum", 2.0),
        ([100000 * k for k in range(60)], "micros", 0.1),
        ([20 * k for k in range(60)], "millis", 0.02),
        ([0.5 * k for k in range(60)], "Zeit", 0.5),
        ([0.5 * k for k in range(60)], "T", 0.5),
        ([0.5 * k for k in range(60)], "Sekunde", 1.0),  # no name of times
        ([20.0 + k % 7 for k in range(60)], "T", 1.0),  # a temperature
    ],
)
def test_times_are_found_beside_a_column_or_their_lack_is_said(tmp_path, times, header, dt):
    file = tmp_path / "log.csv"
    rows = [f"{t},{v!r}\n" for t, v in zip(times, Z.tolist(), strict=True)]
    file.write_text(f"{header},Füllstand\n" + "".join(rows))
    column = column_of(file, column="Füllstand")
    assert column.dt == pytest.approx(dt)
    lacks = f"no column of times was found (columns {header}, Füllstand): 1 s is assumed, give --dt, or --column "
    assert (f"{lacks}Füllstand,time={header}." in column.remarks) == (dt == 1.0)
    if header == "Sekunde":
        stated = column_of(file, column="Füllstand,time=Sekunde")
        assert stated.dt == 0.5 and stated.remarks == () and column_of(file, 0.25, column="Füllstand").dt == 0.25
        assert column_of(file, column="time=Sekunde").dt == 0.5


@pytest.mark.parametrize("times", ["date", "t", "time"])
def test_a_temperature_beside_times_is_no_time(times):
    table = {times: 2.0 * np.arange(60), "T": 20.0 + np.arange(60.0)}
    column = column_of(table)
    assert column.quantities[0].symbol == "T" and column.dt == 2.0


@pytest.mark.parametrize("unit", ["kPa", "degC", "Hz", "deg", "km"])
def test_numbers_keep_the_unit_of_their_column(tmp_path, unit):
    file = tmp_path / "log.csv"
    file.write_text(f"t,value [{unit}]\n" + "".join(f"{k},{v!r}\n" for k, v in enumerate(Z.tolist())))
    column = column_of(file)
    np.testing.assert_array_equal(column.values, Z)
    assert column.quantities[0].unit == unit


def test_times_of_an_array_are_seconds_whatever_their_size():
    for times in (2.6e6 * np.arange(60.0), 1e12 + np.arange(60.0), 1e9 * np.arange(60.0)):
        column = column_of(Z, times=times)
        np.testing.assert_array_equal(column.times, times - times[0])
        assert not column.remarks


def test_tune_names_fit_for_a_log_that_is_a_column_of_numbers(tmp_path):
    file = tmp_path / "level.csv"
    file.write_text("t,level [m]\n" + "".join(f"{k},{z!r}\n" for k, z in enumerate(map(float, NILE.split()))))
    refused(r"level.csv has t, level \[m\]: `thruster fit .*level.csv`", tuning.tune, tuning.read_logs(file))
    fit = tuning.fit(file, model="constant")
    assert fit.r == pytest.approx(15098.5, rel=1e-4) and fit.numbers[1].unit == "m^2"
    file.write_text("t,level\n" + "1,2\n2,3\n" * 30)
    refused("times must increase", tuning.fit, file)


@pytest.mark.parametrize(
    ("z", "options", "message"),
    [
        ([1.0] * 30, {}, "must vary"),
        ([1.0, 2.0], {}, "at least 20 numbers"),
        ([math.nan] * 50, {}, "at least 20 numbers, but has 0"),
        (["a"] * 30, {}, "z must be numbers"),
        (np.zeros((30, 9)), {}, "a column of numbers"),
        ([*range(30), math.inf], {}, "numbers must be finite"),
        (np.arange(30.0), {"model": "seasonal"}, "must have period="),
        (np.arange(30.0), {"model": "ar"}, "must have an order of 1 to 8, as ar:2, but got ''"),
        (np.arange(30.0) % 7.0, {"model": "ar:1", "dt": 1.0 + 0.1 * np.arange(29.0)}, "must have equal steps"),
        (np.arange(30.0) % 11.0, {"model": "harmonic:period=7,harmonics=4"}, "two samples .* a period of 1.75 s"),
        (np.arange(30.0), {"times": np.arange(30.0)[::-1]}, "times must increase"),
        (np.arange(30.0), {"dt": np.ones(30)}, "a time for each number, so one step .* 30 numbers and 31 times"),
        (np.arange(30.0), {"dt": np.ones(29), "times": np.arange(30.0)}, "but got both"),
        ({"z": np.arange(30.0)}, {"dt": np.ones(29)}, "the times of a table or a file must be one of its columns"),
        (1e-160 * np.arange(30.0), {}, "must vary by 1e-60 to 1e.60.* use another unit"),
        (np.arange(30.0), {"model": "constant-speed"}, "a model must be one of"),
        (np.arange(30.0), {"dt": -1.0}, "dt must be positive"),
        (np.arange(30.0), {"model": ["constant"]}, "model .* must be auto, or a model's name, but got"),
        ({"t": np.arange(30.0), "a": np.arange(30.0), "b": np.arange(30.0)}, {}, "one column of numbers beside"),
    ],
)
def test_wrong_numbers_are_refused_in_one_line(z, options, message):
    refused(message, tuning.fit, z, **options)


def test_data_without_noise_are_called_that():
    tiny = 1.0 + 1e-13 * np.random.default_rng(0).normal(size=100)
    for exact in (tiny, 3.0 + 2.0 * (0.1 * np.arange(200))):
        refused("z must have noise, .* lie on a smooth curve to", tuning.fit, exact, 0.1)


def test_samples_that_are_no_measurements_do_not_change_q_and_r():
    """Placeholders, a sensor that sticks, and one that is slower than the log."""
    clean = simulated("constant", 600) + 20.0
    missing, rows = clean.copy(), np.arange(600)
    missing[(200 <= rows) & (rows < 240)] = np.nan
    reference = tuning.fit(missing, 0.1, model="constant")
    for number in (-999.0, 0.0, clean[199]):
        fit = tuning.fit(np.where(np.isnan(missing), number, missing), 0.1, model="constant")
        assert fit.r == pytest.approx(reference.r, rel=0.02) and fit.q == pytest.approx(reference.q, rel=0.02)
        assert any("left out" in sentence for sentence in fit.sentences())
    slow, held = (tuning.fit(*record, model="constant") for record in ((clean, 0.5), (np.repeat(clean, 5), 0.1)))
    assert held.r == pytest.approx(slow.r, rel=1e-9) and held.q == pytest.approx(slow.q, rel=1e-9)
    assert held.column.dt == pytest.approx(0.5) and "5 times" in " ".join(held.sentences())


ROWS = np.arange(1000)
DRAWN = np.random.default_rng(2)
CHARGE = np.round(100.0 - 0.03 * ROWS + np.cumsum(DRAWN.normal(0.0, 0.02, 1000)))  # per cent
NOISY = np.round(20.0 + np.cumsum(DRAWN.normal(0.0, 0.1, 1000)) + DRAWN.normal(0.0, 0.3, 1000), 1)


@pytest.mark.parametrize(
    "values",
    [CHARGE, np.round(100.0 - 0.01 * ROWS), np.cumsum(DRAWN.random(1000) < 0.3), 12.3 + 0.1 * (ROWS // 7)],
)
def test_a_channel_that_moves_by_single_steps_is_quantised_and_no_slower_sensor(values):
    left_out, texts = unmeasured(values.astype(float))
    assert not left_out.any() and not texts


@pytest.mark.parametrize("values", [np.repeat(NOISY[:200], 5), np.repeat(np.cumsum(DRAWN.random(200)), 5)])
def test_a_slower_sensor_is_still_one(values):
    assert unmeasured(values)[0].sum() == 800


@pytest.mark.parametrize(
    ("values", "step"), [(CHARGE, 1.0), (NOISY, 0.1), (0.25 * CHARGE + 1e6, 0.25), (DRAWN.normal(size=100), 0.0)]
)
def test_resolution_of_values(values, step):
    assert resolution_of_values(values) == pytest.approx(step, rel=1e-6)


def test_rounding_is_said_where_it_looks_like_signal():
    level = np.round(20.0 + 2.0 * np.sin(ROWS / 700.0), 1)
    fit = tuning.fit(level, dt=1.0, model="local-trend")
    text = " ".join(fit.sentences())
    assert fit.r < 1e-4
    assert "z changes in steps of 0.1, and 9" in text and "R is at least 0.1^2/12 = 0.000833" in text
    assert fit.jumps and "jumps" not in text and fit.as_dict()["jumps"] == []  # by one step of the resolution each
    fit = tuning.fit(NOISY, dt=1.0, model="constant")
    assert "in steps of" not in " ".join(fit.sentences())
    assert fit.r == pytest.approx(0.09, rel=0.2)
    fit = tuning.fit(CHARGE, dt=1.0, model="constant-velocity")
    assert len(fit.column.values) == 1000 and "repeats are left out" not in str(fit)
    assert "R is at least 1^2/12 = 0.0833" in " ".join(fit.sentences())
