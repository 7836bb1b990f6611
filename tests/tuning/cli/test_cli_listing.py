"""`thruster log` of what is no thruster's, of damaged files and of what is not read."""

import numpy as np
from scipy.io import savemat

from tests.thruster_env.logs.recorders.test_bad_recordings import write_good


def test_the_columns_of_a_table_that_is_no_thrusters_are_listed(thruster, as_json, tmp_path):
    rows = "\n".join(f"{0.5 * k},{k},{'on' if k else 'off'}" for k in range(9))
    (tmp_path / "tank.csv").write_text(f"time_s,level [m],valve\n{rows}\n")
    said = thruster("log", "tank.csv").stdout
    (line,) = [one for one in said.splitlines() if "level" in one]
    assert (
        line.split()[-9:-1] == ["9", "2", "0.5", "0", "4", "m", "0", "8"] and "tank.csv: table, 2 columns" in said
    )
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
