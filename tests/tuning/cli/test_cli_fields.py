"""Files of recorders and tables on the command line: what is in them, what is not read, the numbers of both."""

import csv

import numpy as np
import pytest
from scipy.io import savemat

from tests.thruster_env.logs.recorders.files import h5py, write_bag, write_ulog
from tests.thruster_env.logs.recorders.test_bad_recordings import write_good
from tests.thruster_env.logs.recorders.test_formats import bag_topics
from tests.tuned_files import write_untuned
from thruster_env.logs.table import read_table

COLUMNS = ("--column", "V_s=actuator_outputs.output[2]", "--column", "thrust=load_cell#1.force")


def recorded(path, table, kind="double"):
    """A run of `thruster simulate` as a ULog of numbers of a kind, the command and the load cell on topics."""
    ticks = 3_000_000 + np.round(1e6 * table.numbers("time_s")).astype(np.int64)
    u, force = table.numbers("voltage_V"), table.numbers("measured_thrust_N")
    known = ~np.isnan(u)
    outputs = {"timestamp": ticks[known], "output[2]": u[known]}
    cells = [("load_cell", k, f"{kind} force;", {"timestamp": ticks, "force": k * force}) for k in (0, 1)]
    write_ulog(path, [("actuator_outputs", 0, f"{kind}[4] output;", outputs), *cells])


def columns_of(path):
    with open(path, encoding="utf-8") as file:
        rows = [*csv.reader(file)]
    return {name: np.array(cells, float) for name, *cells in zip(*rows, strict=True) if name != "time_s"}


@pytest.mark.parametrize(("kind", "within"), [("double", 1e-9), ("float", 1e-5)])
def test_an_estimate_of_a_ulog_is_that_of_the_csv_of_the_run(thruster, tmp_path, kind, within):
    write_untuned(tmp_path / "tuned.json")
    assert thruster("simulate", "--out", "run.csv", "--steps", 300, "--seed", 4).returncode == 0
    recorded(tmp_path / "run.ulg", read_table(tmp_path / "run.csv"), kind)
    for log, more in (("run.csv", ()), ("run.ulg", COLUMNS)):
        done = thruster("estimate", log, "--tuned", "tuned.json", *more, "--out", f"{log}.est.csv")
        assert done.returncode == 0, done.stderr
    of_table, of_ulog = (columns_of(tmp_path / f"{log}.est.csv") for log in ("run.csv", "run.ulg"))
    estimated = [name for name in of_ulog if name in of_table]
    assert len(estimated) >= 4
    for name in estimated:
        some = ~np.isnan(of_table[name]) & ~np.isnan(of_ulog[name])
        assert some.sum() >= 299
        off = abs(of_table[name][some] - of_ulog[name][some]).max()
        assert off <= within * max(1.0, abs(of_table[name][some]).max()), name


def test_fields_are_listed_and_sought(thruster, as_json, tmp_path):
    ticks = 10_000 * np.append(np.arange(50), np.arange(150, 200))
    rows = {"timestamp": ticks, "output[0]": np.arange(100.0), "output[1]": -5.0}
    name = "a_topic_of_a_name_so_long_that_no_terminal_of_eighty_columns_shows_it_in_one_line"
    topics = [(topic, 0, "double[3] output;", rows) for topic in ("actuator_outputs", name)]
    write_ulog(tmp_path / "a.ulg", topics)
    said = thruster("log", "a.ulg").stdout
    (line,) = [one for one in said.splitlines() if "actuator_outputs.output[0]" in one]
    assert " ".join(line.split()) == "actuator_outputs.output[0] 100 49.75 1.01 0 1.99 0 99 ▁▂▃▄▅▆▇█"
    assert f"{name}.output[1]" in said and "a.ulg: ULog, 6 fields" in said
    data = as_json("log", "a.ulg", "--only", "OUTPUTS.OUT")
    assert data["format"] == "ULog"
    assert [one["name"] for one in data["fields"]] == [f"actuator_outputs.output[{k}]" for k in range(3)]
    first = data["fields"][0]
    assert (first["samples"], first["least"], first["greatest"], len(first["course"])) == (100, 0.0, 99.0, 8)
    assert first["longest_gap_s"] == pytest.approx(1.01) and first["rate_hz"] == pytest.approx(99 / 1.99)
    assert thruster("log", "a.ulg", "--json", "out.json").stdout.startswith("a.ulg: ULog")
    assert (tmp_path / "out.json").exists()
    for arguments, message in (
        (("a.ulg", "--only", "rudder"), "a field whose name contains 'rudder', but a.ulg has none among 6 fields"),
        (("a.csv", "--only", "x"), "--only must go with a recorder's file, .ulg, "),
        (("a.ulg", "--json", "b.mcap"), "--json must be no log"),
        (("a.ulg", "--column", "V_s=actuator_output.output[0]"), "near it are actuator_outputs.output"),
    ):
        (tmp_path / "a.csv").write_text("time_s,voltage,thrust\n0,1,2\n1,2,3\n2,3,5\n")
        done = thruster("log", *arguments)
        assert done.returncode == 2 and message in " ".join(done.stderr.split()), done.stderr


def test_a_recorders_file_is_read_as_a_log_where_columns_are_told(thruster, as_json, tmp_path):
    assert thruster("simulate", "--out", "run.csv", "--steps", 200, "--seed", 4).returncode == 0
    recorded(tmp_path / "run.ulg", read_table(tmp_path / "run.csv"))
    data = as_json("log", "run.ulg", *COLUMNS)
    assert data["samples"] == {"input:V_s": 200, "measurement:thrust": 201} and data["rows"] == 201
    told = '[columns]\nV_s = "actuator_outputs.output[2]"\nthrust = "load_cell#1.force"\n'
    (tmp_path / "run.toml").write_text(told)
    assert as_json("log", "run.ulg") == data
    assert len(as_json("log", "run.ulg", "--only", "force")["fields"]) == 2
    with h5py.File(tmp_path / "named.h5", "w") as file:
        for name in ("time_s", "voltage_V", "measured_thrust_N"):
            file[name] = read_table(tmp_path / "run.csv").numbers(name)
    assert as_json("log", "named.h5", "--preset", "tunnel")["rows"] == 201  # by their names, as columns of a table
    write_bag(tmp_path / "bag", bag_topics(), "mcap")
    said = thruster("log", "bag", "--only", "vel").stdout
    assert said.startswith("bag: bag of ROS 2, 6 fields") and "/vel.twist.linear.x" in said


def test_the_columns_of_a_table_that_is_no_thrusters_are_listed(thruster, as_json, tmp_path):
    rows = "\n".join(f"{0.5 * k},{k},{'on' if k else 'off'}" for k in range(9))
    (tmp_path / "tank.csv").write_text(f"time_s,level [m],valve\n{rows}\n")
    said = thruster("log", "tank.csv").stdout
    (line,) = [one for one in said.splitlines() if "level" in one]
    assert line.split()[-9:-1] == ["9", "2", "0.5", "0", "4", "m", "0", "8"]
    assert "tank.csv: table, 2 columns" in said
    assert "Not read: valve (columns must hold numbers, but got 'off' in line 2" in said
    data = as_json("log", "tank.csv")
    assert [one["name"] for one in data["fields"]] == ["time_s", "level [m]"] and [*data["not_read"]] == ["valve"]
    (tmp_path / "run.csv").write_text("time_s,thrust\n0,1\n1,2\n2,4\n")  # a thruster's, in part
    done = thruster("log", "run.csv")
    assert done.returncode == 2 and "a log must have a column for the input" in " ".join(done.stderr.split())


def test_what_is_not_read_and_what_is_damaged_is_said(thruster, tmp_path):
    data = write_good(tmp_path / "a.bin").read_bytes()
    (tmp_path / "a.bin").write_bytes(data[:3000] + bytes(57) + data[3057:])
    assert "bytes in 1 place of the log belong to no message." in thruster("log", "a.bin").stdout
    savemat(tmp_path / "a.mat", {"t": np.arange(9.0), "z": 1j * np.arange(9.0)})
    assert "Not read: z (of complex numbers)." in thruster("log", "a.mat").stdout
    savemat(tmp_path / "b.mat", {"z": 1j * np.arange(9.0)})
    done = thruster("log", "b.mat")
    assert done.returncode == 2 and "not read are z (of complex numbers)" in " ".join(done.stderr.split())
