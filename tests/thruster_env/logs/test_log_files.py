"""Logs in files: columns by name, units, what is said beside a file, and one line for what is wrong."""

import numpy as np
import pytest

from tests.thruster_env.logs.test_logs import MODEL, log_of
from thruster_env.logs.read import read_log
from thruster_env.logs.write import write_columns, write_log
from thruster_env.thruster.model import thruster_model

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


def test_a_measurement_goes_before_what_only_has_its_name(tmp_path):
    model = thruster_model()  # measures the thrust, called thrust; its output T has the name "thrust", too
    (tmp_path / "run.csv").write_text("time_s,voltage,thrust\n0,1,2\n1,2,3\n2,3,5\n")
    log = read_log(tmp_path / "run.csv", model)
    assert log.measurements[:, 0].tolist() == [2.0, 3.0, 5.0] and not log.references
    (tmp_path / "run.csv").write_text("time_s,voltage,thrust,measured_thrust\n0,1,2,4\n1,2,3,5\n2,3,5,7\n")
    log = read_log(tmp_path / "run.csv", model)
    assert log.measurements[:, 0].tolist() == [4.0, 5.0, 7.0] and log.references["output:T"].tolist() == [2, 3, 5]


@pytest.mark.parametrize("name", [r"$\frac$", "[/]", "a,b", 'say "V"', "x;y", "n" * 400, "two\nlines", " spaces"])
def test_names_of_columns_are_quoted_where_they_have_to_be(tmp_path, name):
    columns = {"t": np.arange(4.0), name: np.ones(4), "tach": np.arange(4.0)}
    for digits in ("exact", "%.10g"):
        (tmp_path / "run.csv").unlink(missing_ok=True)
        write_columns(tmp_path / "run.csv", columns, digits)
        log = read_log(tmp_path / "run.csv", MODEL, {"V_s": name.strip()})
        assert log.inputs[:, 0].tolist() == [1.0] * 3
    text = (tmp_path / "run.csv").read_text()
    assert text.startswith("t,") and text.endswith("\n3,1,3\n")
    for suffix in (".npz",):
        write_columns(tmp_path / f"run{suffix}", columns)
        assert read_log(tmp_path / f"run{suffix}", MODEL, {"V_s": name}).steps == 3


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
            r"a log must have a column for the measurement tachometer \[rad/s\] \(use --column",
        ),
        (
            "clock,u,speed\n0,1,2\n",
            r"for the input voltage \[V\] .*and for the measurement tachometer .* and for times \(use --column "
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
        ValueError,
        match="a log must be a file that ends in .csv, .parquet, .npz, .ulg, .*.h5, .*but got 'run.txt'",
    ):
        read_log("run.txt", MODEL)


@pytest.mark.parametrize("suffix", [".csv", ".npz"])
def test_no_log_is_written_over_but_estimates_are_by_later_ones(tmp_path, suffix):
    path, columns = tmp_path / f"run{suffix}", {"t_s": np.arange(4.0), "F_N": np.ones(4)}
    path.touch()  # nothing is there yet
    write_columns(path, columns)
    before = path.read_bytes()
    write_columns(path, columns)  # the very same
    later = {**columns, "F_N": np.zeros(4)}
    for changed, again in ((later, False), ({"t_s": np.arange(4.0), "x": np.ones(4)}, True)):
        with pytest.raises(ValueError, match="because logs are never overwritten, but .* exists"):
            write_columns(path, changed, again=again)
        assert path.read_bytes() == before
    write_columns(path, later, again=True)
    assert path.read_bytes() != before
