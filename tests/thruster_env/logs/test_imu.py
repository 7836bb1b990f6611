"""`thruster_env.logs.imu`: wrong axes and units of a gyroscope, accelerometer or magnetometer are said."""

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation as Turned

from filters.inertial import attitude
from thruster_env.logs.read import read_log

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
