"""Logs on a grid: gaps, irregular stamps, several rates, clock offsets; axes and units of inertial sensors."""

import pickle
import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation as Turned

from filters.inertial import attitude
from tests.models import affine
from thruster_env.logs.grid import Series, grid_of, mean_held, sampled
from thruster_env.logs.log import Log, at_offset
from thruster_env.logs.read import read_log

MODEL = affine(
    *([[0.9]], [[1.0]], [[1.0]]),
    **{"q": [0.1], "r": [0.1], "mean": [0.0], "cov": [1.0]},
    states=[("speed", "n", "rad/s")],
    input_quantities=[("voltage", "V_s", "V")],
    measurements=[("tachometer", "tach", "rad/s")],
)


def log_of(path, text, **options):
    path.write_text(text, encoding="utf-8")
    return read_log(path, MODEL, **options)


def test_rows_of_a_regular_log_are_taken_as_they_are(tmp_path):
    log = log_of(tmp_path / "run.csv", "time_s,V_s_V,tach_rad_per_s,n\n5.0,1,2,3\n5.1,4,5,6\n5.2,,8,9\n")
    assert (log.dt, log.steps, log.start, log.irregular) == (0.1, 2, 5.0, False)
    np.testing.assert_array_equal(log.inputs, [[1], [4]])
    np.testing.assert_array_equal(log.measurements, [[2], [5], [8]])
    np.testing.assert_array_equal(log.references["state:n"], [3, 6, 9])
    np.testing.assert_array_equal(log.true_states(MODEL), [[3], [6], [9]])
    assert log.channels == ("input:V_s", "measurement:tach", "state:n")
    assert not log.inputs.flags.writeable and pickle.loads(pickle.dumps(log)).digest == log.digest


def test_a_missing_row_is_a_gap_and_a_missing_input_is_held(tmp_path):
    log = log_of(tmp_path / "run.csv", "t,voltage,tach\n0,1,2\n0.1,3,\n0.4,,5\n0.5,7,6\n0.6,7,7\n")
    assert log.dt == pytest.approx(0.1) and not log.irregular
    np.testing.assert_array_equal(log.measurements[:, 0], [2, np.nan, np.nan, np.nan, 5, 6, 7])
    np.testing.assert_array_equal(log.inputs[:, 0], [1, 3, 3, 3, 3, 7])


def test_jitter_within_a_tenth_of_a_step_is_none():
    stamps = 0.04 * np.arange(50)
    jittered = stamps + np.random.default_rng(0).uniform(-0.0015, 0.0015, 50)
    jittered[0], jittered[-1] = 0.0, stamps[-1]
    grid = grid_of(jittered)
    assert not grid.irregular and grid.rows == 50 and grid.dt == 0.04
    drifting = grid_of(np.arange(2000) / 30)  # thirds of a second have no few digits
    assert not drifting.irregular and drifting.dt == pytest.approx(1 / 30, rel=2e-9)


def test_irregular_stamps_go_to_the_nearest_grid_time():
    stamps = np.array([0.0, 0.1, 0.24, 0.27, 0.4, 0.5, 0.6])
    grid = grid_of(stamps)
    assert grid.irregular and grid.dt == pytest.approx(0.1) and grid.rows == 7
    values = sampled(Series(grid.times, np.arange(7.0)), grid.dt, grid.rows)
    np.testing.assert_array_equal(values, [0, 1, 2, 3, 4, 5, 6])
    np.testing.assert_array_equal(sampled(Series(grid.times, np.arange(7.0)), 0.2, 4), [0, 2, 4, 6])
    np.testing.assert_array_equal(
        sampled(Series(stamps[[0, 2, 6]], np.arange(3.0)), 0.1, 7)[[0, 1, 2, 3]], [0, np.nan, 1, np.nan]
    )


def test_an_input_off_the_grid_is_the_mean_of_what_is_held():
    steps = Series(np.array([0.0, 0.25, 0.9]), np.array([1.0, 3.0, -1.0]))
    np.testing.assert_allclose(mean_held(steps, 0.1, 10), [1, 1, 2, 3, 3, 3, 3, 3, 3, -1], rtol=1e-12)
    np.testing.assert_allclose(mean_held(steps, 0.1, 4, offset=-0.5), [1, 1, 1, 1])  # before the first: its value


def test_a_clock_offset_moves_a_channel_continuously_and_back():
    times = 0.04 * np.arange(101)
    wave = np.sin(3 * times)
    log = Log("run", 0.04, np.cos(times[:-1, None]), wave[:, None], MODEL.input_quantities, MODEL.measurements)
    ahead = at_offset(log, "measurement:tach", 0.05)  # stamps tell 0.05 s too much
    inside = slice(0, 99)
    np.testing.assert_allclose(ahead.measurements[inside, 0], np.sin(3 * (times[inside] + 0.05)), atol=0.002)
    assert np.isnan(ahead.measurements[-1, 0])
    nearby = at_offset(log, "measurement:tach", 0.0500001)
    assert np.nanmax(abs(nearby.measurements - ahead.measurements)) < 1e-6
    np.testing.assert_array_equal(at_offset(ahead, "measurement:tach", 0.0).measurements, log.measurements)
    whole = at_offset(log, "measurement:tach", 0.08)
    np.testing.assert_array_equal(whole.measurements[:-2], log.measurements[2:])
    moved = at_offset(log, "input:V_s", 0.04)
    np.testing.assert_array_equal(moved.inputs[:-1], log.inputs[1:])
    half = at_offset(log, "input:V_s", 0.02)
    np.testing.assert_allclose(half.inputs[:-1], (log.inputs[:-1] + log.inputs[1:]) / 2, rtol=1e-12)
    with pytest.raises(
        ValueError, match="a channel of log run must be one of input:V_s, measurement:tach, but got 'x'"
    ):
        at_offset(log, "x", 0.0)


def test_a_slow_channel_keeps_its_rate_under_an_offset():
    slow = Series(np.array([0.0, 1.0, 2.0]), np.array([5.0, 6.0, 7.0]))
    found = sampled(slow, 0.1, 21, offset=0.04)
    assert np.flatnonzero(~np.isnan(found)).tolist() == [0, 10, 20]
    assert np.flatnonzero(~np.isnan(sampled(slow, 0.1, 21, offset=-0.06))).tolist() == [1, 11]


def test_a_log_s_arrays_have_to_fit():
    with pytest.raises(ValueError, match=r"measurements of log run must be finite or NaN and of shape \(4, 1\)"):
        Log("run", 0.1, np.zeros((3, 1)), np.zeros((3, 1)), MODEL.input_quantities, MODEL.measurements)
    with pytest.raises(ValueError, match="inputs of log run must be finite"):
        Log("run", 0.1, np.full((3, 1), np.nan), np.zeros((4, 1)), MODEL.input_quantities, MODEL.measurements)


DT, ROWS = 0.015, 1500


@pytest.fixture(scope="module")
def sensors():
    """Gyroscope, accelerometer and magnetometer (rows, 3) of a body that tumbles, by scipy's rotations."""
    t, draw = np.arange(ROWS) * DT, np.random.default_rng(4).normal
    rates = np.column_stack([np.sin(1.9 * t), 1.2 * np.cos(1.3 * t), 0.8 * np.sin(0.7 * t + 1.0)])
    at, attitudes = Turned.from_euler("zyx", [2.0, 0.4, -0.6]), []
    for rate in rates:  # until its row
        at = at * Turned.from_rotvec(rate * DT)
        attitudes.append(at.inv().as_matrix())
    to_body, push = np.array(attitudes), np.column_stack([np.sin(7 * t), np.cos(6 * t), np.sin(8 * t)])
    specific_force = np.einsum("kij,kj->ki", to_body, [0.0, 0.0, 9.81] + 0.8 * push)
    field = to_body @ [0.0, 20.0, -43.0]
    return rates + 0.02, specific_force + 0.05 * draw(size=(ROWS, 3)), field + 0.6 * draw(size=(ROWS, 3))


def _sentences(gyr, acc, mag, dt=DT):
    table = {"time": np.arange(ROWS) * dt}
    for name, values in (("gyr", gyr), ("acc", acc), ("mag", mag)):
        table |= {f"{name}_{axis}": values[:, i] for i, axis in enumerate("xyz")}
    log = read_log(table, attitude())
    return [finding.sentence for finding in log.findings if finding.kind == "axes or units"]


def test_right_axes_and_units_are_not_mentioned_whatever_the_unit_of_the_field(sensors):
    gyr, acc, mag = sensors
    assert _sentences(gyr, acc, mag) == _sentences(gyr, acc, mag / 100) == []


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda g, a, m: (np.rad2deg(g), a, m), "accelerometer and magnetometer turn 0.017.*in deg/s"),
        (lambda g, a, m: (g, a / 9.81, m), r"median of \|acc\| is 1 .*in g;"),
        (lambda g, a, m: (g[:, [1, 0, 2]], a, m), r"and magnetometer .* are \(gyr y, gyr x, gyr z\)"),
        (lambda g, a, m: (-g, a, m), r"and magnetometer .* are \(gyr -x, gyr -y, gyr -z\)"),
        # m' = (y, z, -x) of m, so m = (-z, x, y) of m', or the negative of that
        (lambda g, a, m: (g, a, m[:, [1, 2, 0]] * [1, 1, -1]), r"The magnetometer .* \(mag z, mag -x, mag -y\)"),
        (lambda g, a, m: (g, a[:, [1, 0, 2]] * [1, 1, -1], m), r"The accelerometer .* \(acc y, acc x, acc -z\)"),
    ],
    ids=["deg/s", "g", "swapped gyroscope", "gyroscope's sign", "cycled magnetometer", "accelerometer in NED"],
)
def test_wrong_axes_and_units_are_said_with_what_fits(sensors, change, expected):
    sentences = _sentences(*change(*sensors))
    assert len(sentences) == 1 and re.search(expected, sentences[0]), sentences


def test_times_in_milliseconds_are_said(sensors):
    assert any("times may be in ms" in sentence for sentence in _sentences(*sensors, dt=DT * 1000))


def test_a_sensor_that_begins_late_is_said(sensors):
    gyr, acc, mag = (array.copy() for array in sensors)
    mag[:200] = np.nan
    (sentence,) = _sentences(gyr, acc, mag)
    assert sentence.startswith("The magnetometer begins after 3 s")
