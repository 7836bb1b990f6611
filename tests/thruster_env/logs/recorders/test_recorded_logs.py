"""Logs of recorders' files: columns by TOPIC.FIELD, fields with clocks of their own on one grid."""

import numpy as np
import pytest

from tests.thruster_env.logs.recorders.files import dataflash, h5py, write_ulog
from tests.thruster_env.logs.test_logs import MODEL
from thruster_env.logs.read import read_log
from thruster_env.logs.recorders.registry import fields
from thruster_env.logs.write import write_columns
from thruster_env.model.affine import affine_model

COLUMNS = {"V_s": "cmd.output[0]", "tach": "motor.speed"}


def ulog_of(path, inputs, measured, **options):
    """A log of (ticks [us], values) of an input and a measurement, each on a topic of its own."""
    topics = [
        ("cmd", 0, "double[2] output;", inputs, "output[0]"),
        ("motor", 0, "double speed;", measured, "speed"),
    ]
    write_ulog(
        path, [(name, number, text, {"timestamp": t, key: v}) for name, number, text, (t, v), key in topics]
    )
    return read_log(path, MODEL, options.pop("columns", COLUMNS), **options)


def test_fields_with_the_same_stamps_are_read_as_a_table(tmp_path):
    ticks, rng = 2_000_000 + 10_000 * np.arange(300), np.random.default_rng(1)
    u, z = rng.normal(size=(2, 300))
    log = ulog_of(tmp_path / "a.ulg", (ticks, u), (ticks, z))
    write_columns(tmp_path / "a.csv", {"time_s": ticks / 1e6, "voltage": u, "tach": z}, "exact")
    table = read_log(tmp_path / "a.csv", MODEL)
    assert (log.dt, log.steps, log.start, log.irregular) == (0.01, 299, 2.0, False)
    np.testing.assert_array_equal(log.inputs, table.inputs)
    np.testing.assert_array_equal(log.measurements, table.measurements)
    assert log.findings == table.findings


def test_an_input_at_its_own_rate_is_held_on_the_grid_of_the_measurement(tmp_path):
    """The measurement every 10 ms from 0.1 s on; the input from 0.056 s on, every 25 ms."""
    measured = 100_000 + 10_000 * np.arange(60), np.sin(np.arange(60.0))
    inputs = 56_000 + 25_000 * np.arange(40), np.arange(40.0)
    log = ulog_of(tmp_path / "a.ulg", inputs, measured)
    assert (log.dt, log.steps, log.start) == (0.01, 59, 0.1)
    np.testing.assert_array_equal(log.measurements[:, 0], measured[1])
    fine = 100_000 + np.arange(0, 590_000, 100) + 50  # the mean of what is held, over each step
    held = np.floor((fine - 56_000) / 25_000).reshape(59, 100).mean(axis=1)
    np.testing.assert_allclose(log.inputs[:, 0], held, rtol=1e-9)


def test_a_log_begins_when_all_inputs_are_known(tmp_path):
    measured = 10_000 * np.arange(50), np.cos(np.arange(50.0))
    log = ulog_of(tmp_path / "a.ulg", (203_000 + 10_000 * np.arange(20), np.arange(20.0)), measured)
    assert log.start == 0.21 and log.steps == 28
    np.testing.assert_array_equal(log.measurements[:, 0], measured[1][21:])
    assert log.inputs[0, 0] == pytest.approx(0.7)  # 0 for 3 ms, then 1 for 7 ms


def test_slower_measurements_are_missing_between(tmp_path):
    kinds = {1: ("U", "Qd", "TimeUS,V"), 2: ("M", "Qd", "TimeUS,n"), 3: ("R", "Qd", "TimeUS,n")}
    messages = [(1, (10_000 * k, float(k % 7))) for k in range(100)] + [
        (2, (10_000 * k + 400, k)) for k in range(100)
    ]
    messages += [(3, (30_000 * k + 900, float(-k))) for k in range(33)]
    (tmp_path / "a.bin").write_bytes(dataflash(kinds, sorted(messages, key=lambda one: one[1][0])))
    log = read_log(tmp_path / "a.bin", MODEL, {"V_s": "U.V", "tach": "M.n", "state:n": "R.n"})
    assert (log.dt, log.steps) == (0.01, 99)
    np.testing.assert_array_equal(log.measurements[:, 0], np.arange(100.0))
    reference = log.references["state:n"]
    np.testing.assert_array_equal(reference[::3][:33], -np.arange(33.0))
    assert np.isnan(np.delete(reference, np.s_[::3])).all()


def test_jitter_of_a_clock_moves_no_sample_to_another_row(tmp_path):
    rng = np.random.default_rng(2)
    ticks = 1_000_000 + 20_000 * np.arange(400) + rng.integers(-4000, 4000, 400)
    others = 1_000_000 + 20_000 * np.arange(400) + 10_000 + rng.integers(-4000, 4000, 400)  # half a step apart
    others[0] = 900_000
    log = ulog_of(tmp_path / "a.ulg", (others, np.arange(400.0)), (ticks, np.arange(400.0) ** 2))
    assert log.dt == pytest.approx(0.02, rel=1e-3) and log.irregular and log.steps == 399
    np.testing.assert_array_equal(log.measurements[:, 0], np.arange(400.0) ** 2)
    late = log.inputs[1:, 0] - (np.arange(1.0, 399.0) - 0.5)  # k - 1 for half of step k, then k
    assert abs(late).max() < 0.45 and abs(late.mean()) < 0.02


def test_units_clock_offsets_and_a_toml_file_count_as_they_do_for_tables(tmp_path):
    ticks = 10_000 * np.arange(50)
    (tmp_path / "a.toml").write_text('[columns]\nV_s = "cmd.output[0][mV]"\ntach = "motor.speed"\n')
    with (tmp_path / "a.toml").open("a") as file:
        file.write('[units]\n"motor.speed" = "rpm"\n[clock_offset]\ntach = 0.02\n')
    u, z = 1000.0 * np.arange(50), np.arange(50.0) ** 1.5
    log = ulog_of(tmp_path / "a.ulg", (ticks, u), (ticks, z), columns=None)
    np.testing.assert_allclose(log.inputs[:, 0], np.arange(49.0))
    np.testing.assert_allclose(log.measurements[:48, 0], z[2:] * 2 * np.pi / 60)


def test_arrays_of_equal_length_are_a_table_with_any_vector_of_times(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["V_s"], file["tach"], file["run/clock_ms"] = (
            np.arange(20.0),
            np.arange(20.0) ** 2,
            50.0 * np.arange(20),
        )
    log = read_log(tmp_path / "a.h5", MODEL, {"time": "run.clock_ms"})
    assert (log.dt, log.steps) == (0.05, 19)
    np.testing.assert_array_equal(log.measurements[:, 0], np.arange(20.0) ** 2)
    assert read_log(tmp_path / "a.h5", MODEL, dt=0.5).dt == 0.5
    with pytest.raises(ValueError, match=r"a column of times .*or a sample time"):
        read_log(tmp_path / "a.h5", MODEL)
    with h5py.File(tmp_path / "a.h5", "a") as file:
        file["run/x"] = np.arange(7.0)
    with pytest.raises(ValueError, match="must be of equal length, but .*a.h5 has run.x 7, V_s 20"):
        read_log(tmp_path / "a.h5", MODEL, {"tach": "run.x"}, dt=0.5)


def test_arrays_with_times_beside_them_have_clocks_of_their_own(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["cmd/t"], file["cmd/u"] = 0.04 * np.arange(30), np.arange(30.0)
        file["motor/t_ms"], file["motor/n"] = 10.0 * np.arange(100), np.arange(100.0) ** 2
    log = read_log(tmp_path / "a.h5", MODEL, {"V_s": "cmd.u", "tach": "motor.n"})
    assert (log.dt, log.steps) == (0.01, 99)
    np.testing.assert_allclose(log.inputs[:, 0], np.arange(99) // 4)
    with h5py.File(tmp_path / "a.h5", "a") as file:
        file["time"], file["V_s"] = 0.04 * np.arange(30), np.arange(30.0)  # found by their names
    again = read_log(tmp_path / "a.h5", MODEL, {"tach": "motor.n"})
    np.testing.assert_array_equal(again.inputs, log.inputs)
    whole = read_log(tmp_path / "a.h5", MODEL, {"V_s": "motor.n", "tach": "motor.n", "time": "motor.t_ms"})
    assert (whole.dt, whole.steps) == (0.01, 99)


@pytest.mark.parametrize(
    ("field", "unit", "wanted", "factor"),
    [
        ("gyro_rad[2]", "rad/s", "rad/s", 1.0),
        ("gyro_rad[0]", "rad/s", "rad/min", 60.0),
        ("voltage_v", "V", "mV", 1e3),
        ("voltage_v", "V", "", 1.0),
        ("baro_pressure_pa", "Pa", "kPa", 1e-3),
        ("accelerometer_m_s2[1]", "", "m/s^2", 1.0),
        ("accelerometer_m_s2[1]", "", "g_0", 1 / 9.80665),
    ],
)
def test_fields_of_px4_have_their_units(field, unit, wanted, factor, tmp_path):
    name, ticks, values = field.partition("[")[0], 10_000 * np.arange(50), np.sin(np.arange(50.0))
    kind = "double[3]" if "[" in field else "double"
    write_ulog(tmp_path / "a.ulg", [("a", 0, f"{kind} {name};double u;", {"timestamp": ticks, field: values})])
    model = affine_model(
        **{"a": [[1.0]], "b": [[1.0]], "c": [[1.0]], "process_noise_cov": [1.0], "measurement_noise_cov": [1.0]},
        **{"prior_mean": [0.0], "prior_cov": [1.0], "measurements": [("reading", "r", wanted)]},
    )
    log = read_log(tmp_path / "a.ulg", model, {"u_1": "a.u", "r": f"a.{field}"})
    np.testing.assert_allclose(log.measurements[:, 0], factor * values, rtol=1e-12)
    listed = {one.name: one.unit for one in fields(tmp_path / "a.ulg")}
    assert listed[f"a.{field}"] == unit


def test_a_unit_of_another_kind_is_refused_with_the_way_to_name_one(tmp_path):
    columns = {"V_s": "cmd.output[0]", "tach": "motor.speed[rad]"}
    ticks, values = 10_000 * np.arange(50), np.sin(np.arange(50.0))
    with pytest.raises(
        ValueError, match=r"converts to rad/s, but got 'rad' \(name another in brackets: .*\[rad/s\]\)"
    ):
        ulog_of(tmp_path / "a.ulg", (ticks, values), (ticks, values), columns=columns)
