"""A sensor that turns in a gap of its log: the filter begins anew behind it, at the attitude of a measurement."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation as Turned

from filters.inertial import attitude, attitude_imu
from filters.logs.estimate import estimate, lost_in_gaps
from filters.logs.findings import findings, verdict
from thruster_env.logs.log import piece_of
from thruster_env.logs.read import read_log

DT, ROWS, GAP = 0.02, 600, slice(300, 400)  # a gap of 2 s
MODEL = attitude(DT, accelerometer=0.05, magnetometer=0.5, acceleration=0.05, gyroscope=1e-3)


def table(rate):
    """A sensor that turns about up and east, with its reference, without the rows of the gap."""
    draw, t = np.random.default_rng(4).normal, DT * np.arange(ROWS)
    turn = Turned.from_rotvec(np.column_stack([0.05 * np.sin(t), 0 * t, rate * np.sin(0.8 * t)]))
    gyro = np.zeros((ROWS, 3))
    gyro[1:] = (turn[:-1].inv() * turn[1:]).as_rotvec() / DT
    dip = np.radians(60.0)
    acc = turn.inv().apply([0.0, 0.0, 9.81]) + 0.05 * draw(size=(ROWS, 3))
    mag = turn.inv().apply([0.0, 50 * np.cos(dip), -50 * np.sin(dip)]) + 0.5 * draw(size=(ROWS, 3))
    q = turn.as_quat()
    columns = {"time": t}
    for name, values in (("gyr", gyro), ("acc", acc), ("mag", mag)):
        columns |= {f"{name}_{axis}": values[:, i] for i, axis in enumerate("xyz")}
    columns |= {f"q_{axis}": q[:, i] for i, axis in enumerate("xyzw")}
    return {name: np.delete(values, np.arange(ROWS)[GAP]) for name, values in columns.items()}


@pytest.mark.parametrize("grid", [True, False])
def test_the_filter_begins_anew_after_a_gap(grid):
    """After it estimates are those of the rest of the log alone, with small errors."""
    log = read_log(table(2.0), MODEL, grid=grid)
    (row,) = lost_in_gaps(MODEL, log)
    assert row == (GAP.stop if grid else GAP.start)
    whole = estimate(log, "ekf", MODEL)
    rest = estimate(piece_of(log, row, log.steps + 1 - row), "ekf", MODEL)
    np.testing.assert_array_equal(whole.means[row:], rest.means)
    np.testing.assert_array_equal(whole.covs[row:], rest.covs)
    found = findings(whole)
    (angle,) = (reference for reference in found.references if reference.quantity.symbol == "q_angle")
    assert angle.rmse < 1.5
    assert "The sensor turns in gaps: after the gap the filter begins anew" in " ".join(verdict(whole, found))


def test_a_sensor_that_barely_turns_or_has_no_magnetometer_goes_on():
    assert lost_in_gaps(MODEL, read_log(table(0.0), MODEL)) == []
    blind = attitude_imu(DT)
    assert lost_in_gaps(blind, read_log(table(2.0), blind)) == []
