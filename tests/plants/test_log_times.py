"""Times of logs: since 1970, in units that nobody states, and on several clocks."""

import csv
from datetime import UTC, datetime

import numpy as np
import pytest

from filters.logs.alarms import episode_sentence
from filters.logs.columns import columns_of
from filters.logs.estimate import estimate
from filters.monitoring.monitor import Alarm
from tests.fuzz.logs import MODEL
from thruster_env.plants.logs.findings import sentences
from thruster_env.plants.logs.read import read_log
from thruster_env.plants.logs.write import write_columns

CLOCKS = [(0.0, 0.01), (1.7e9, 0.01), (1.7e9, 1e-3), (1.7e9, 1 / 3), (-1.7e9, 0.02), (4e7, 1e-4)]


def table_of(times):
    """A run with an outlier in row 77."""
    rows = len(times)
    speed = np.cumsum(0.1 * np.random.default_rng(0).normal(size=rows))
    speed[77] += 20.0
    return {"t": times, "force": np.sign(np.sin(np.arange(rows) / 9.0)), "speed": speed}


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize(("start", "dt"), CLOCKS)
def test_estimates_are_written_with_as_many_digits_as_their_times_need(start, dt, tmp_path):
    found = estimate(table_of(start + dt * np.arange(300)), "kf", MODEL)
    write_columns(tmp_path / "estimates.csv", columns_of(found))
    with (tmp_path / "estimates.csv").open() as file:
        times = [float(row["time_s"]) for row in csv.DictReader(file)]
    np.testing.assert_allclose(np.diff(times), dt, rtol=0.11)
    again = read_log(tmp_path / "estimates.csv", MODEL, {"u_1": "input_u_1_N", "z_1": "measured_z_1_rad_per_s"})
    assert again.steps == found.log.steps and abs(again.dt - dt) < 1e-5 * dt + 1e-6


@pytest.mark.parametrize("offset", [0.0, 5e6, -1e9])
def test_numbers_that_vary_little_about_a_large_one_are_written_with_more_digits(offset, tmp_path):
    values = offset + 0.1 * np.sin(np.arange(50.0))
    write_columns(tmp_path / "table.csv", {"northing": values, "same": np.full(50, offset)})
    found = np.genfromtxt(tmp_path / "table.csv", delimiter=",", names=True)
    np.testing.assert_allclose(found["northing"], values, rtol=0, atol=1e-7 * np.ptp(values) + 2e-16 * abs(offset))
    assert (found["same"] == offset).all()


@pytest.mark.parametrize(("start", "dt"), CLOCKS)
def test_a_finding_says_when_it_was(start, dt):
    said = sentences(read_log(table_of(start + dt * np.arange(300)), MODEL).findings)[0]
    seconds = start + 77 * dt
    assert abs(float(said.partition(" at ")[2].partition(" s")[0]) - seconds) <= 0.1 * dt
    date = datetime.fromtimestamp(seconds, UTC)
    assert ("UTC" in said) == (date.year in range(1990, 2099))
    if "UTC" in said:
        assert said.endswith(f" ({date:%Y-%m-%d %H:%M:%S}.{date.microsecond // 1000:03d} UTC).")


def test_an_alarm_says_when_it_was():
    times = 1.7e9 + 0.01 * np.arange(200)
    alarm = Alarm(step=123, channel=0, test="cusum", size=0.3, since=100)
    said = episode_sentence([alarm], MODEL.measurements[0], times)
    assert said == (
        "z_1: a bias of +0.3 rad/s since 1700000001 s, found at 1700000001.23 s "
        "(2023-11-14 22:13:21.230 UTC) (cusum)"
    )
