"""Times of logs: since 1970, in units that nobody states, and on several clocks."""

import csv
from datetime import UTC, datetime

import numpy as np
import pytest
from scipy.io import savemat

from filters.logs.estimate import estimate
from filters.logs.findings import columns_of
from tests.fuzz.logs import MODEL
from thruster_env.logs.findings import sentences
from thruster_env.logs.read import read_log
from thruster_env.logs.write import write_columns

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


K = np.arange(60)
JITTER = np.random.default_rng(1).integers(-20, 20, 60)
SEC = 1_700_000_000


def run_of(header, stamps):
    """A run of 60 rows with these stamps."""
    return {header: stamps, "force": np.sign(np.sin(K / 9.0)), "speed": np.sin(K / 7.0)}


@pytest.mark.parametrize(
    ("header", "stamps", "dt", "start", "unit"),
    [
        ("timestamp", SEC * 10**9 + 5_000_000 * K, 0.005, SEC, "ns"),  # EuRoC's, ROS's
        ("timestamp", 4000 * K + 123_456, 0.004, 0.123456, "us"),  # PX4's
        ("timestamp", 10_000 * K + 1_234_567_890 + JITTER, None, None, "us"),
        ("timestamp", 20_000_000 * K, 0.02, 0.0, "ns"),
        ("Time", SEC * 10**6 + 7812 * K, 0.007812, SEC, "us"),  # APDM's
        ("t", SEC * 10**3 + 10 * K, 0.01, SEC, "ms"),
        ("time", 10_000 * K, 0.01, 0.0, "us"),
        ("t", 10_000_000 * K, 0.01, 0.0, "ns"),
        ("t", SEC + 10 * K, 10.0, SEC, ""),
        ("timestamp", SEC + 0.01 * K, 0.01, SEC, ""),
        ("timestamp", 900 * K, 900.0, 0.0, ""),
        ("t", 3600 * K, 3600.0, 0.0, ""),
        ("t", 100 * K, 100.0, 0.0, "s"),
        ("t", 10 * K, 10.0, 0.0, "s"),  # or ms
        ("time", 5 * K + 12, 5.0, 12.0, "s"),
        ("t", K, 1.0, 0.0, ""),
        ("t_s", 10 * K, 10.0, 0.0, ""),
        ("t", 0.25 * K, 0.25, 0.0, ""),
        ("t_s", 10_000 * K, 10_000.0, 0.0, ""),
        ("time_us", 10_000 * K, 0.01, 0.0, ""),
    ],
)
def test_stamps_without_a_unit_are_in_the_one_that_is_possible(header, stamps, dt, start, unit, tmp_path):
    log = read_log(run_of(header, stamps), MODEL)
    taken = [one.sentence for one in log.findings if one.kind == "clock"]
    assert len(taken) == bool(unit) and all(f"are taken as {unit}" in one for one in taken)
    if dt is None:
        dt, start = 0.01, 1234.56789
    assert (log.dt, log.start) == (pytest.approx(dt, rel=1e-5), pytest.approx(start, rel=1e-8))
    assert log.steps == 59
    (tmp_path / "run.csv").write_text(
        f"#{header},force,speed\n"
        + "".join(
            f"{one!r},{u},{z}\n"
            for one, u, z in zip(stamps.tolist(), *list(run_of("t", K).values())[1:], strict=True)
        )
    )
    assert read_log(tmp_path / "run.csv", MODEL).digest == log.digest
    savemat(tmp_path / "run.mat", run_of(header, stamps))
    if header != "timestamp":
        assert read_log(tmp_path / "run.mat", MODEL).dt == log.dt


@pytest.mark.parametrize(("header", "step"), [("timestamp", 10**6), ("t", 2000), ("time", 10**6), ("t", 10**11)])
def test_stamps_that_may_be_in_several_units_are_refused(header, step):
    with pytest.raises(ValueError, match=rf"^times must be in seconds, .*\(use --column 'time={header}\[us\]'"):
        read_log(run_of(header, step * K), MODEL)
    assert read_log(run_of(header, step * K), MODEL, {"time": f"{header}[us]"}).dt == pytest.approx(step * 1e-6)
    assert read_log(run_of(header, step * K), MODEL, {"time": f"{header}[s]"}).dt == step


@pytest.mark.parametrize("first", [46_143.0, 739_738.5, 2_461_162.25])  # of Excel, of MATLAB, Julian
def test_dates_in_days_are_not_seconds(first, tmp_path):
    """A sample time of 0.1 us was taken."""
    run = run_of("t", first + 0.1 * K / 86400.0)
    with pytest.raises(
        ValueError, match=r"^times must be in seconds, .*'time=t\[d\]' for dates in days, or \[s\]"
    ):
        read_log(run, MODEL)
    log = read_log(run, MODEL, {"time": "t[d]"})
    assert (log.dt, log.start) == (pytest.approx(0.1, rel=1e-3), pytest.approx(86400.0 * first))
    assert read_log(run, MODEL, {"time": "t[s]"}).dt < 2e-6
    assert read_log(run_of("t", 1e-6 * K), MODEL).dt == 1e-6
