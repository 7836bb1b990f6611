"""Logs at the command line: estimate, tune --log, and what follows; one line for what is wrong."""

import numpy as np
import pytest

import thruster_env  # noqa: F401 - registers the env
from filters import thruster_model
from filters.logs.estimate import estimate
from thruster_env.logs.read import read_log
from thruster_env.thruster.parameters import PRESETS, PresetFile, write_preset


@pytest.fixture
def simulated(thruster):
    def make(*names):
        for seed, name in enumerate(names):
            assert thruster("simulate", "--out", name, "--steps", 300, "--seed", seed).returncode == 0

    return make


def test_a_log_is_written_as_it_is_read(thruster, tmp_path):
    """With dates, another unit and stamps off the grid: the exported program in C reads what comes of it."""
    rng, rows = np.random.default_rng(0), ["when (UTC),U_kV,load [mN],x"]
    for k in range(40):
        second = 0.01 * k + 0.003 * rng.random()
        rows.append(f"2026-05-01T12:00:{second:09.6f},{0.001 * (k % 7)},{rng.normal():.4f},a")
    (tmp_path / "run.csv").write_text("\n".join(rows) + "\n")
    options = ["--column", "V_s=U_kV", "--column", "thrust=load [mN]", "--column", "time=when (UTC)"]
    done = thruster("log", "run.csv", *options, "--out", "grid.csv")
    assert done.returncode == 0 and "wrote grid.csv" in done.stdout
    columns = {"V_s": "U_kV", "thrust": "load [mN]", "time": "when (UTC)"}
    log, again = (
        read_log(tmp_path / "run.csv", thruster_model(), columns),
        read_log(tmp_path / "grid.csv", thruster_model()),
    )
    assert log.irregular and not again.irregular and log.dt == again.dt
    np.testing.assert_array_equal(again.inputs, log.inputs)
    np.testing.assert_array_equal(again.measurements, log.measurements)
    before = (tmp_path / "grid.csv").read_bytes()
    for arguments in (["run.csv", *options[:-1], "time=x"], ["run.csv", *options, "--dt", "0.02"]):
        done = thruster("log", *arguments, "--out", "grid.csv")
        assert done.returncode == 2 and (tmp_path / "grid.csv").read_bytes() == before


def test_a_simulated_log_goes_through_estimate(simulated, as_json, thruster, tmp_path):
    simulated("run.csv")
    data = as_json("estimate", "run.csv", "--filter", "ekf", "--out", "est.csv", "--plot", "est.png")
    assert data["rows"] == 301 and data["first_row"] == 50 and data["files"] == ["est.csv", "est.png"]
    assert set(data["references"]) == {"omega_m", "U_a", "T"}
    found = estimate("run.csv", "ekf", "thruster_env.thruster.model:thruster_model")
    table = np.genfromtxt(tmp_path / "est.csv", delimiter=",", names=True)
    np.testing.assert_allclose(table["omega_m_rad_per_s"], found.means[:, 0], rtol=1e-9)
    done = thruster("estimate", "run.csv")
    assert "mean NIS over channels" in done.stdout and "Estimate less reference, not seen" in done.stdout
    simulated("again.npz")
    assert as_json("estimate", "again.npz")["log_likelihood"] == pytest.approx(data["log_likelihood"], rel=1e-6)


def test_what_is_simulated_has_the_sensors_that_are_asked_for(thruster, as_json):
    options = "--steps", 100, "--sensor", "thrust", "--sensor", "speed"
    data = as_json("simulate", "--out", "run.csv", *options)
    assert data["columns"][-2:] == ["measured_thrust_N", "measured_speed_rad_per_s"]
    table = np.genfromtxt("run.csv", delimiter=",", names=True)
    errors = table["measured_speed_rad_per_s"] - table["omega_m_rad_per_s"]
    assert abs(errors.mean()) < 0.8 and 1.5 < errors.std() < 2.5  # of 2 rad/s
    as_json("simulate", "--out", "alone.csv", *options[:2])
    alone = np.genfromtxt("alone.csv", delimiter=",", names=True)
    np.testing.assert_array_equal(alone["measured_thrust_N"], table["measured_thrust_N"])
    assert set(as_json("estimate", "run.csv", *options[2:])["one_step_ahead"]) == {"thrust", "speed"}


def test_a_simulated_log_may_be_without_truth(thruster, as_json):
    options = "--steps", 60, "--seed", 3, "--sensor", "thrust", "--sensor", "speed"
    as_json("simulate", "--out", "whole.csv", *options)
    data = as_json("simulate", "--out", "run.csv", *options, "--measured-only")
    measured = ["time_s", "voltage_V", "measured_thrust_N", "measured_speed_rad_per_s"]
    table, whole = (np.genfromtxt(name, delimiter=",", names=True) for name in ("run.csv", "whole.csv"))
    assert data["columns"] == list(table.dtype.names) == measured
    for name in measured:
        np.testing.assert_array_equal(table[name], whole[name])
    told = as_json("estimate", "run.csv", "--skip", 9)
    assert (
        not told["references"]
        and told["log_likelihood"] == as_json("estimate", "whole.csv", "--skip", 9)["log_likelihood"]
    )


def test_a_load_cell_is_held_against_what_the_tachometer_tells(simulated, as_json):
    simulated("run.csv")
    columns = "--column", "speed=omega_m_rad_per_s", "--column", "thrust=thrust_N"
    data = as_json("estimate", "run.csv", "--sensor", "speed", *columns)
    assert list(data["one_step_ahead"]) == ["speed"] and "T" in data["references"]


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (("estimate", "no.csv"), "a log must be a file that can be read, but no.csv is not: No such file"),
        (
            ("estimate", "run.csv", "--column", "thrust"),
            "columns (--column) must have the form NAME=VALUE, but got 'thrust'",
        ),
        (("estimate", "run.csv", "--column", "flow=x"), "columns must be given for some of V_s, thrust, omega_m"),
        (
            ("estimate", "run.csv", "--column", "thrust=x"),
            "the column for thrust must be one of time_s, voltage_V",
        ),
        (
            ("estimate", "run.csv", "--model", "m:x", "--preset", "tunnel"),
            "must be of model (--model) or of a thruster",
        ),
        (
            ("estimate", "run.csv", "--filter", "ekf", "--tuned", "x.json"),
            "give either a tuned file or a filter (--filter NAME)",
        ),
        (("estimate", "run.csv", "--out", "est.txt"), "--out must end in .csv, .parquet or .npz"),
        (("estimate", "run.csv", "--plot", "est.tex"), "--plot must end in .png, .svg or .pdf, but got"),
        (("estimate", "run.csv", "--skip", "9999"), "skip must be at most 60, but got 9999"),
        (
            ("estimate", "run.csv", "--clock-offset", "thrust=late"),
            "clock_offset (--clock-offset) of thrust must be seconds",
        ),
        (("estimate", "run.csv", "--clock-offset", "thrust=-0.6"), "thrust must be shorter than the log, 0.6 s"),
        (("estimate", "run.csv", "--out", "./run.csv"), "an output file must not replace an input file"),
        (("estimate", "run.csv", "--out", "est.csv", "--json", "run.csv"), "must not replace an input file"),
        (("estimate", "run.csv", "--out", "est.csv", "--json", "."), "must be where it can be written, but . is"),
        (("identify", "run.csv", "--json", "run.csv"), "must not replace an input file"),
        (
            ("simulate", "--out", "new.csv", "--sensor", "torque"),
            "a channel of sensors must be one of thrust, speed",
        ),
        (("tune", "--log", "run.csv", "--lead", "60"), "a log must have at least 63 rows"),
        (("tune", "--log", "run.csv", "--problem", "nominal"), "must be of --log or of --problem, but got both"),
        (("tune", "--blocks", "3"), "--blocks must come with --log, but got --blocks 3 without one"),
    ],
)
def test_a_mistake_with_a_log_is_one_line_and_nothing_is_written(arguments, line, thruster, tmp_path):
    times = 0.01 * np.arange(61)
    rows = [f"{t:.2f},{6 * np.sin(t):.4f},{np.cos(9 * t):.4f}" for t in times]
    (tmp_path / "run.csv").write_text("time_s,voltage_V,measured_thrust_N\n" + "\n".join(rows) + "\n")
    done = thruster(*arguments)
    assert done.returncode == 2 and line in done.stderr and done.stderr.count("thruster:") == 1
    assert (tmp_path / "run.csv").read_text().startswith("time_s,voltage_V,measured_thrust_N")
    assert {path.name for path in tmp_path.iterdir()} <= {"run.csv", "out"}


def test_rows_in_which_nothing_was_measured_tell_nothing(thruster, tmp_path):
    rows = [f"{0.01 * k:.2f},{k % 7},{k * 0.1 if k < 30 else ''}" for k in range(200)]
    (tmp_path / "run.csv").write_text("time_s,voltage_V,measured_thrust_N\n" + "\n".join(rows) + "\n")
    assert "Nothing was measured in the rows that count, from 50 on" in " ".join(
        thruster("estimate", "run.csv").stdout.split()
    )


def test_clock_offsets_of_a_preset_file_are_taken_off(thruster, as_json, tmp_path):
    thruster("simulate", "--out", "run.csv", "--steps", 200)
    table = (tmp_path / "run.csv").read_text().splitlines()
    rows = [line.split(",") for line in table]
    late = [row[:5] + [rows[max(k - 4, 1)][5]] for k, row in enumerate(rows[1:], start=1)]  # by 40 ms
    (tmp_path / "late.csv").write_text("\n".join(",".join(row[:2] + row[5:]) for row in [rows[0], *late]) + "\n")
    recorder = {"sensors": ["thrust"], "clock_offset": {"thrust": 0.04}}
    write_preset(tmp_path / "mine.toml", PresetFile(PRESETS["tunnel"], recorder=recorder))
    told = as_json("estimate", "late.csv", "--preset", "mine.toml")
    assert told["mean_nis"] == pytest.approx(as_json("estimate", "run.csv")["mean_nis"], rel=0.05)
    assert told == as_json("estimate", "late.csv", "--clock-offset", "thrust=0.04")
    assert as_json("estimate", "late.csv", "--preset", "mine.toml", "--clock-offset", "thrust=0")["mean_nis"] > 2
