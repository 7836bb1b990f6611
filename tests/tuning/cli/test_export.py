"""`thruster export`: a tuned filter as C, which filters a log as `thruster estimate` does."""

import subprocess

import numpy as np

from tests.tuned_files import write_untuned


def built(folder, name):
    """The program that filters a log."""
    build = ["gcc", "-std=c99", "-O2", "-Werror", "-Wall", f"{name}.c", "main.c", "-lm", "-o", f"{name}_log"]
    assert subprocess.run(build, cwd=folder).returncode == 0
    return folder / f"{name}_log"


def columns(path, names):
    table = np.genfromtxt(path, delimiter=",", names=True)
    return np.array([table[name] for name in names])


def test_the_program_writes_what_estimate_writes(thruster, as_json, tmp_path):
    tuned = write_untuned(tmp_path / "tuned.json")
    assert thruster("simulate", "--steps", 60, "--out", "run.csv").returncode == 0
    assert thruster("estimate", "run.csv", tuned, "--out", "estimate.csv").returncode == 0
    found = as_json("export", tuned, "--out", "boat", "--name", "bow")
    assert found["single_error"] is None and len(found["files"]) == 6
    program = built(tmp_path / "boat", "bow")
    with open(tmp_path / "run.csv") as log, open(tmp_path / "c.csv", "w") as out:
        assert subprocess.run([program], stdin=log, stdout=out).returncode == 0
    names = (tmp_path / "c.csv").read_text().splitlines()[0].split(",")
    assert names[:3] == ["time_s", "omega_m_rad_per_s", "std_omega_m_rad_per_s"]
    of_c, ours = (columns(tmp_path / name, names) for name in ("c.csv", "estimate.csv"))
    np.testing.assert_allclose(of_c, ours, rtol=1e-8, atol=1e-9)


def test_an_ensemble_with_a_monitor_writes_what_estimate_writes(thruster, as_json, tmp_path):
    """Of a log whose sensor is stuck."""
    tuned = write_untuned(tmp_path / "tuned.json", name="etkf")
    assert thruster("simulate", "--steps", 100, "--out", "run.csv").returncode == 0
    header, *rows = (tmp_path / "run.csv").read_text().splitlines()
    place = header.split(",").index("measured_thrust_N")
    cells = [row.split(",") for row in rows]
    for row in cells[70:]:
        row[place] = cells[70][place]
    (tmp_path / "run.csv").write_text("\n".join([header, *map(",".join, cells)]) + "\n")
    options = "--monitor", 100_000
    assert thruster("estimate", "run.csv", tuned, "--out", "estimate.csv", "--skip", 50, *options).returncode == 0
    as_json("export", tuned, "--out", "boat", "--name", "bow", *options)
    program = built(tmp_path / "boat", "bow")
    with open(tmp_path / "run.csv") as log, open(tmp_path / "c.csv", "w") as out:
        assert subprocess.run([program], stdin=log, stdout=out).returncode == 0
    names = (tmp_path / "c.csv").read_text().splitlines()[0].split(",")
    assert names[-1] == "alarm_thrust"
    of_c, ours = (columns(tmp_path / name, names) for name in ("c.csv", "estimate.csv"))
    np.testing.assert_allclose(of_c, ours, rtol=1e-8, atol=1e-9)
    assert ours[-1, 79] >= 1.0 and not ours[-1, :70].any()


def test_what_cannot_be_exported_is_refused(thruster, tmp_path):
    tuned = write_untuned(tmp_path / "tuned.json")
    for arguments, message in [
        (("--language", "ada"), "a language must be one of c, but got 'ada'"),
        (("--name", "a b"), "a name in C must be letters, digits and _, and no keyword, but got 'a b'"),
    ]:
        done = thruster("export", tuned, "--out", "boat", *arguments)
        assert done.returncode == 2 and message in " ".join(done.stderr.split())
        assert not (tmp_path / "boat").exists() or not list((tmp_path / "boat").iterdir())
