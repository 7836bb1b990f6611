"""Logs at the command line: estimate, tune --log, export and what follows; what is found in logs."""

import json
import subprocess

import numpy as np
import pytest

import thruster_env  # noqa: F401 - registers the env
import tuning
from filters import thruster_model
from filters.logs.estimate import estimate
from tests.models import state_space
from tests.tuned_files import write_untuned
from thruster_env.logs.read import read_log
from thruster_env.logs.write import write_columns
from thruster_env.thruster.parameters import PRESETS, PresetFile, write_preset
from tuning.logs.problem import log_problem


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
    log = read_log(tmp_path / "run.csv", thruster_model(), columns)
    again = read_log(tmp_path / "grid.csv", thruster_model())
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
    assert not told["references"]
    assert told["log_likelihood"] == as_json("estimate", "whole.csv", "--skip", 9)["log_likelihood"]


def test_a_load_cell_is_held_against_what_the_tachometer_tells(simulated, as_json):
    simulated("run.csv")
    columns = "--column", "speed=omega_m_rad_per_s", "--column", "thrust=thrust_N"
    data = as_json("estimate", "run.csv", "--sensor", "speed", *columns)
    assert list(data["one_step_ahead"]) == ["speed"] and "T" in data["references"]


def test_rows_in_which_nothing_was_measured_tell_nothing(thruster, tmp_path):
    rows = [f"{0.01 * k:.2f},{k % 7},{k * 0.1 if k < 30 else ''}" for k in range(200)]
    (tmp_path / "run.csv").write_text("time_s,voltage_V,measured_thrust_N\n" + "\n".join(rows) + "\n")
    said = " ".join(thruster("estimate", "run.csv").stdout.split())
    assert "Nothing was measured in the rows that count, from 50 on" in said


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


OWN = """
from thruster_env.model.affine import affine_model

def model(gain=0.5, process_noise_cov=0.01, measurement_noise_cov=0.04):
    return affine_model(
        a=[[0.9]],
        b=[[gain]],
        c=[[1.0]],
        process_noise_cov=[process_noise_cov],
        measurement_noise_cov=[measurement_noise_cov],
        prior_mean=[0.0],
        prior_cov=[1.0],
        states=[("speed", "x", "m/s")],
        input_quantities=[("force", "u", "N")],
        measurements=[("log speed", "z", "m/s")],
    )
"""
MODEL = ("--model", "own:model")


def table(steps=700, seed=0):
    """A run of the model above."""
    rng = np.random.default_rng(seed)
    u, x = np.sign(np.sin(0.07 * np.arange(steps))), np.zeros(steps)
    for k in range(1, steps):
        x[k] = 0.9 * x[k - 1] + 0.5 * u[k - 1] + 0.1 * rng.normal()
    return {"time_s": 0.1 * np.arange(steps), "u": u, "z": x + 0.2 * rng.normal(size=steps)}


def without(values, first, last):
    return {name: np.delete(one, np.s_[first:last]) for name, one in values.items()}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "own.py").write_text(OWN)
    monkeypatch.syspath_prepend(str(tmp_path))
    whole, stuck, gap, wild = (table(seed=seed) for seed in range(4))
    stuck["z"][300:380] = stuck["z"][300]
    wild["z"][[100, 200, 500]] += 4.0
    for name, one in (("whole", whole), ("stuck", stuck), ("gap", without(gap, 300, 340)), ("wild", wild)):
        write_columns(tmp_path / f"{name}.csv", one, "exact")
    return tmp_path


def test_a_log_is_shown_with_what_was_found(folder, thruster, as_json):
    data = as_json("log", "gap.csv", *MODEL, "--plot", "gap.png")
    (gap,) = data["findings"]
    assert data["pieces"] == [[0, 300], [340, 360]]
    assert (gap["kind"], gap["first"], gap["count"]) == ("gap", 300, 40)
    assert (folder / "gap.png").stat().st_size > 5000 and data["samples"]["measurement:z"] == 660
    said = thruster("log", "stuck.csv", *MODEL).stdout
    assert "z is stuck at" in said and "measurement z [m/s]" in said
    assert "Nothing stands out" in thruster("log", "whole.csv", *MODEL).stdout
    assert thruster("log", "whole.csv", *MODEL, "--plot", "whole.txt").returncode == 2


def test_an_estimate_does_not_praise_a_stuck_sensor(folder, thruster, as_json):
    data = as_json("estimate", "stuck.csv", *MODEL)
    assert data["findings"][0]["kind"] == "stuck"
    assert "First mend what was found in the log (stuck)" in data["sentences"][-1]
    assert "is stuck at" in data["sentences"][0]
    said = " ".join(thruster("estimate", "gap.csv", *MODEL).stdout.split())
    assert "a gap: 40 rows (4 s) are missing" in said and "predicts with the last input held" in said
    clean = as_json("estimate", "whole.csv", *MODEL)
    assert clean["findings"] == [] and "mend" not in " ".join(clean["sentences"])
    mine = tuning.estimate(("own:model", str(folder / "stuck.csv")))
    assert mine.sentences() == data["sentences"] and mine.log.findings[0].kind == "stuck"
    assert "is stuck at" in mine._repr_html_()


@pytest.mark.usefixtures("undrawn")
def test_a_study_of_logs_and_its_page_say_what_was_found(folder, thruster):
    logs = ("--log", "gap.csv", "--log", "stuck.csv", *MODEL)
    done = thruster("tune", "--filter", "kf", *logs, "--trials", 3, "--out", "tuned.json")
    said = " ".join(done.stdout.split())
    assert done.returncode in (0, 3), done.stderr
    assert "gap.csv: a gap: 40 rows (4 s) are missing" in said and "stuck.csv: z is stuck at" in said
    assert "Runs are cut at gaps" in said
    assert thruster("report", "tuned.json", "--problem", "own:model", "--model", "own:model").returncode in (0, 2)
    assert thruster("report", "tuned.json", "--model", "own:model").returncode == 0
    page = (folder / "tuned.html").read_text()
    assert "<h2>The data</h2>" in page and "a gap: 40 rows" in page
    assert thruster("verify", "tuned.json", *MODEL).returncode == 0
    options = "--trials", 3, "--out", "held.json", "--hold-gaps", "--study", "b"
    other = thruster("tune", "--filter", "kf", *logs, *options)
    assert other.returncode in (0, 3)
    content = json.loads((folder / "held.json").read_text())["problems"]
    assert next(iter(content.values()))["content"]["options"]["hold_gaps"] is True
    assert thruster("verify", "held.json", *MODEL).returncode == 0


def test_a_model_that_blows_up_is_told_its_substeps(folder):
    def explode(x, u, c):
        return (x[0] - 400.0 * x[0] + u[0],)

    of_log = {"input_quantities": [("force", "u", "N")], "measurements": [("log speed", "z", "m/s")]}
    model = state_space(explode, lambda x, c: (x[0],), q=[1e-2], r=[1e9], mean=[0.0], cov=[1.0], **of_log)
    found = tuning.estimate(tuning.read_logs(table(), model=model), filter="open-loop")
    said = found.sentences()[-1]
    assert "diverges between samples" in said and "substeps" in said and "dt = 0.1 s" in said
    assert "too small" not in said


def test_recorders_of_two_rates_are_told_the_option(folder, thruster):
    slow = table()
    slow["time_s"] = slow["time_s"] * 1.01
    write_columns(folder / "slow.csv", slow, "exact")
    for command in ("tune --log whole.csv --log slow.csv", "identify whole.csv slow.csv --free gain"):
        done = thruster(*command.split(), *MODEL)
        assert done.returncode == 2 and "put them on one grid with --dt 0.1, in Python dt=0.1" in done.stderr
    both = log_problem([table(), slow], model="own:model", dt=0.1)
    assert both.dt == 0.1 and len(both.logs) == 2


def test_estimate_tells_of_alarms(folder, thruster, as_json):
    data = as_json("estimate", "stuck.csv", *MODEL, "--monitor", "100000", "--out", "e.csv", "--plot", "e.png")
    tests = {one["test"] for one in data["alarms"]}
    assert "stuck" in tests and {one["channel"] for one in data["alarms"]} == {"z"}
    assert min(one["step"] for one in data["alarms"]) in range(300, 310)
    assert "alarm_z" in (folder / "e.csv").read_text().splitlines()[0] and (folder / "e.png").is_file()
    shown = thruster("estimate", "stuck.csv", *MODEL, "--monitor", "100000").stdout
    assert "Alarms:" in shown and "- z: " in shown and "false alarms expected if the model is right" in shown
    assert "No alarm in" in thruster("estimate", "whole.csv", *MODEL, "--monitor", "1e9").stdout
    for wrong, rule in (
        (("--isolate",), "isolate (--isolate) must come with monitor (--monitor STEPS)"),
        (("--monitor", "1000", "--isolate"), "can be isolated among two or more, but the filter has one"),
        (("--monitor", "3"), "steps_between must be from 100 to 1e12, but got 3"),
        (("--monitor", "often"), "monitor (--monitor) must be steps, or 'tuned', but got often"),
        (("--monitor", "tuned"), "monitor (--monitor) tuned must come with a tuned file, but got none"),
        (("--no-grid",), "set_dt needs a model with a constant dt"),
    ):
        done = thruster("estimate", "whole.csv", *MODEL, *wrong)
        assert done.returncode == 2 and rule in done.stderr


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
