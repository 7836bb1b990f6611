"""Logs in files: columns by name, units, what is said beside a file, and one line for what is wrong."""

import sys

import numpy as np
import pytest

from plants.logs.read import read_log
from plants.logs.units import converted, parted
from plants.logs.write import write_columns, write_log
from tests.plants.test_logs import MODEL, log_of
from thruster_env.model import thruster_model

GOOD = "time_s,voltage_V,tach\n0,1,2\n0.1,2,3\n0.2,3,4\n"


def test_what_simulate_writes_is_read_with_its_truth(tmp_path):
    header = "time_s,voltage_V,omega_m_rad_per_s,U_a_m_per_s,thrust_N,measured_thrust_N"
    rows = "0,6,0,0,0,0.5\n0.01,7,1,0.1,2,1.5\n0.02,nan,2,0.2,3,2.5\n"
    (tmp_path / "sim.csv").write_text(f"{header}\n{rows}")
    model = thruster_model()
    log = read_log(tmp_path / "sim.csv", model)
    np.testing.assert_array_equal(log.measurements[:, 0], [0.5, 1.5, 2.5])
    np.testing.assert_array_equal(log.inputs[:, 0], [6, 7])
    np.testing.assert_array_equal(log.true_states(model), [[0, 0], [1, 0.1], [2, 0.2]])
    np.testing.assert_array_equal(log.references["output:T"], [0, 2, 3])


@pytest.mark.parametrize("suffix", [".csv", ".npz", ".parquet"])
def test_a_log_comes_back_to_the_bit(tmp_path, suffix):
    if suffix == ".parquet":
        pytest.importorskip("pyarrow")
    noise = np.random.default_rng(1).normal(size=(20, 3))
    columns = {"t": 0.1 * np.arange(20), "voltage": noise[:, 0], "tach": noise[:, 1], "n": noise[:, 2]}
    columns["tach"][7] = np.nan
    write_columns(tmp_path / "first.csv", columns)
    log = read_log(tmp_path / "first.csv", MODEL)
    write_log(tmp_path / f"again{suffix}", log)
    again = read_log(tmp_path / f"again{suffix}", MODEL)
    assert again.digest == log.digest and again.dt == log.dt
    np.testing.assert_array_equal(again.references["state:n"], log.references["state:n"])


@pytest.mark.parametrize(
    ("header", "base", "unit"),
    [
        ("omega_m_rad_per_s", "omega_m", "rad/s"),
        ("y_tach_abs_rad_s", "y_tach_abs", "rad/s"),
        ("U_a_m_per_s", "U_a", "m/s"),
        ("a_m_per_s2", "a", "m/s^2"),
        ("time_s", "time", "s"),
        ("load cell [kgf]", "load cell", "kgf"),
        ("loadcell_N", "loadcell", "N"),
        ("x_1", "x_1", None),
        ("force_x", "force_x", None),
        ("m_s", "m", "s"),
    ],
)
def test_a_header_tells_its_unit(header, base, unit):
    assert parted(header) == (base, unit)


def test_units_are_converted(tmp_path):
    pytest.importorskip("pint")
    text = "t_ms,supply [mV],motor_rpm\n0,1000,60\n100,2000,120\n200,0,180\n"
    columns = {"V_s": "supply [mV]", "tach": "motor_rpm"}
    log = log_of(tmp_path / "run.csv", text, columns=columns)
    assert log.dt == pytest.approx(0.1)
    np.testing.assert_allclose(log.inputs[:, 0], [1.0, 2.0])
    np.testing.assert_allclose(log.measurements[:, 0], 2 * np.pi * np.array([1, 2, 3]))
    again = log_of(tmp_path / "b.csv", text.replace("_rpm", ""), columns=columns | {"tach": "motor[rpm]"})
    np.testing.assert_array_equal(again.measurements, log.measurements)
    for unit, said in (
        ("kgf", "must be one that converts to rad/s, but got 'kgf'"),
        ("furl", "must be one that pint knows"),
    ):
        with pytest.raises(ValueError, match=f"the unit of column 'motor' of .*b.csv {said}"):
            read_log(tmp_path / "b.csv", MODEL, columns | {"tach": f"motor[{unit}]"})


DATES = ["2026-05-01T12:00:00.900", "2026-05-01T12:00:01", "2026-05-01T12:00:01.100", "2026-05-01T12:00:01.200"]


@pytest.mark.parametrize("zone", ["", "Z", "+02:00"])
def test_times_may_be_dates(tmp_path, zone):
    rows = [f"{date}{zone},{k},{k * k}" for k, date in enumerate(DATES)]
    log = log_of(tmp_path / "run.csv", "Timestamp,voltage,tach\n" + "\n".join(rows))
    assert log.dt == pytest.approx(0.1) and log.start == 0.0 and log.steps == 3 and not log.irregular
    apart = [
        DATES[0] + "+02:00",
        "2026-05-01T10:00:01Z",
        "2026-05-01T13:00:01.100+03:00",
    ]  # one clock, three zones
    mixed = "t,voltage,tach\n" + "\n".join(f"{date},{k},{k}" for k, date in enumerate(apart))
    assert log_of(tmp_path / "b.csv", mixed).dt == pytest.approx(0.1)
    for wrong, said in (
        ("noon", "times must be dates as of ISO 8601.*, but got 'noon' in line 4, column 't'"),
        ("2026-05-01T12:00:02", "times must all have a time zone, or none, .* in column 't' of .*b.csv"),
        ("", "every row must have a time, but there is none in line 4"),
    ):
        with pytest.raises(ValueError, match=said):
            log_of(tmp_path / "b.csv", mixed.replace(apart[2], wrong))


def test_tables_of_pandas_have_dates_and_objects():
    pandas = pytest.importorskip("pandas")
    values = {"voltage": [1.0, 2.0, 3.0, 4.0], "tach": [2, None, "5", 7.5]}
    for zone in (None, "Europe/Berlin"):
        dates = pandas.to_datetime(DATES, format="ISO8601").tz_localize(zone)
        column = pandas.DataFrame({"datetime": dates, **values}, columns=["datetime", "voltage", "tach"])
        column["tach"] = column["tach"].astype(object)
        for frame in (column, column.set_index("datetime"), column.assign(datetime=DATES)):
            log = read_log(frame, MODEL)
            assert log.dt == pytest.approx(0.1) and not log.irregular
            np.testing.assert_array_equal(log.measurements[:, 0], [2.0, np.nan, 5.0, 7.5])
    column.loc[2, "tach"] = "off"
    with pytest.raises(
        ValueError, match="columns must hold numbers, but got 'off' in row 3, column 'tach' of run"
    ):
        read_log(column, MODEL, name="run")


@pytest.mark.parametrize(
    ("unit", "wanted", "factor"),
    [
        ("mV", "V", 1e-3),
        ("ms", "s", 1e-3),
        ("µA", "A", 1e-6),
        ("min", "s", 60.0),
        ("rpm", "rad/s", 2 * np.pi / 60),
        ("deg/min", "rad/s", np.pi / 180 / 60),
        ("rad/s", "rpm", 60 / (2 * np.pi)),
        ("mm/s^2", "m/s^2", 1e-3),
        ("kNm", "N*m", 1e3),
        ("g", "kg", 1e-3),
    ],
)
def test_simple_units_need_no_package(monkeypatch, unit, wanted, factor):
    monkeypatch.setitem(sys.modules, "pint", None)
    np.testing.assert_allclose(converted(np.array([3.0]), unit, wanted, "here"), [3.0 * factor], rtol=1e-15)
    for other in ("degC", "kgf", "min"):
        with pytest.raises(ValueError, match="units must be converted by pint, which is not installed"):
            converted(np.array([3.0]), other, "K", "here")


def test_a_header_may_be_named_without_its_unit(tmp_path):
    text = "t,U_mot [mV],n_mot (rpm)\n0,1000,60\n0.1,2000,120\n0.2,0,180\n"
    log = log_of(tmp_path / "run.csv", text, columns={"V_s": "U_mot", "tach": "n_mot"})
    np.testing.assert_allclose(log.inputs[:, 0], [1.0, 2.0])
    np.testing.assert_allclose(log.measurements[:, 0], 2 * np.pi * np.array([1, 2, 3]))
    two = text.replace("n_mot (rpm)", "U_mot [V]")
    with pytest.raises(ValueError, match="the column for V_s must be one of t, U_mot"):
        log_of(tmp_path / "run.csv", two, columns={"V_s": "U_mot"})


def test_a_file_beside_tells_columns_units_and_clocks(tmp_path):
    pytest.importorskip("pint")
    (tmp_path / "run.toml").write_text(
        'dt = 0.1\n[columns]\nV_s = "u"\ntach = "motor"\n[units]\nmotor = "rpm"\n[clock_offset]\ntach = 0.1\n'
    )
    log = log_of(tmp_path / "run.csv", "u,motor\n1,60\n2,120\n3,180\n")
    np.testing.assert_allclose(log.measurements[:, 0], 2 * np.pi * np.array([2, 3, np.nan]))
    assert log.offsets == {"measurement:tach": 0.1}
    told = read_log(tmp_path / "run.csv", MODEL, {"tach": "u"}, clock_offset={"tach": 0.0})
    np.testing.assert_array_equal(told.measurements[:, 0], [1, 2, 3])
    (tmp_path / "run.toml").write_text("speed = 1\n")
    with pytest.raises(ValueError, match=r"keys beside a log must be among columns.*run.toml has \['speed'\]"):
        read_log(tmp_path / "run.csv", MODEL)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "a log must have a header and rows, but .*run.csv is empty"),
        ("time_s,voltage_V,tach\n", "has only a header"),
        ("0,1,2\n0.1,2,3\n", r"the first line must name the columns, but line 1 of .*run.csv has numbers"),
        ("t,tach,tach\n0,1,2\n", "names of columns must differ from one another, but line 1 .* has 'tach' twice"),
        (
            GOOD + "1e9,4,5\n",
            "a log must be at most 10000000 steps long, but .*run.csv has 1e.10 from first to last time",
        ),
        (GOOD + "0.3,4\n", "rows must have as many cells as the header, 3, but got 2 in line 5"),
        (GOOD + "0.3,4,off\n", "columns must hold numbers, but got 'off' in line 5, column 'tach' of .*run.csv"),
        (
            "t;voltage;tach\n0;1,5;2\n1;2,5;3\n2;3;4\n",
            "must hold numbers, with decimal points, but got '1,5' in line 2, column 'voltage'",
        ),
        (GOOD + "0.3,4,inf\n", "numbers must be finite, but got inf in line 5, column 'tach'"),
        (GOOD + "0.15,4,5\n", "times must increase .* 0.15 s follows 0.2 s in line 5, column 'time_s'"),
        (GOOD + ",4,5\n", "every row must have a time, but there is none in line 5, column 'time_s'"),
        ("t,voltage,tach\n0,1,2\n1,1,3\n", "a log must have at least 3 rows, but .*run.csv has 2"),
        (
            "t,voltage,tach\n0,1,2\n1,2,2\n2,3,2\n",
            "a measurement must vary, but column 'tach' .* is 2 in all rows",
        ),
        (
            "t,voltage,tach\n0,,2\n1,2,3\n2,3,2\n",
            "an input must be known from the first row on.*line 2, column 'volt",
        ),
        (
            "t,voltage,tach\n0,1,\n1,2,\n2,3,\n",
            "a column must hold numbers, but column 'tach' of .*run.csv has none",
        ),
        (
            "voltage,tach\n0,1\n1,2\n2,3\n",
            "a log must have a column of times .* or a sample time .*has voltage, tach",
        ),
        (
            "t,voltage,speed\n0,1,2\n",
            r"a log must have a column for the measurement tachometer \[rad/s\] \(say --column",
        ),
        (
            "clock,u,speed\n0,1,2\n",
            r"for the input voltage \[V\] .*and for the measurement tachometer .* and for times \(say --column "
            r"time=HEADER, or --dt\), but .* has clock, u, speed; in Python columns=\{'V_s': 'HEADER'\}",
        ),
    ],
)
def test_what_is_wrong_is_one_line_with_its_place(tmp_path, text, said):
    with pytest.raises(ValueError, match=said) as error:
        log_of(tmp_path / "run.csv", text)
    assert "\n" not in str(error.value)


def test_an_unnamed_index_is_left_out(tmp_path):
    lines = GOOD.splitlines()
    indexed = [f",{lines[0]}", *(f"{i},{line}" for i, line in enumerate(lines[1:]))]
    log = log_of(tmp_path / "run.csv", "\n".join(indexed))
    np.testing.assert_array_equal(log.measurements[:, 0], [2, 3, 4])


def test_a_file_of_another_kind_is_refused_in_one_line(tmp_path):
    for name, said in (("a.npz", "an npz file must hold arrays of numbers by name"), ("b.csv", "text in UTF-8")):
        (tmp_path / name).write_bytes(b"\xff\xfe\x00PK")
        with pytest.raises(ValueError, match=f"must .*{said}|{said}"):
            read_log(tmp_path / name, MODEL)


def test_columns_that_are_told_have_to_be_there(tmp_path):
    refused = {
        "the column for tach must be one of time_s, voltage_V, tach, but got 'rpm'": {"tach": "rpm"},
        "columns must be given for some of V_s, tach, n, time, but got 'flow'=tach": {"flow": "tach"},
        "a column must be given once for voltage, but got tach and voltage_V": {
            "V_s": "tach",
            "voltage": "voltage_V",
        },
    }
    for said, columns in refused.items():
        with pytest.raises(ValueError, match=said):
            log_of(tmp_path / "run.csv", GOOD, columns=columns)
    with pytest.raises(ValueError, match="clock offsets must be of channels V_s, tach, but got 'n'"):
        log_of(tmp_path / "run.csv", GOOD, clock_offset={"n": 1.0})
    with pytest.raises(ValueError, match="a log must be a file that can be read, but nowhere.csv is not: No such"):
        read_log("nowhere.csv", MODEL)
    with pytest.raises(
        ValueError, match="a log must be a file that ends in .csv, .parquet, .npz, but got 'run.txt'"
    ):
        read_log("run.txt", MODEL)
