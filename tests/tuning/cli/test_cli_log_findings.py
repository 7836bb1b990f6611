"""What commands say of the logs that they read: `thruster log`, estimate, identify, tune --log and the report."""

import json

import numpy as np
import pytest

import tuning
from thruster_env.logs.write import write_columns
from thruster_env.model.state_space import StateSpaceModel
from tuning.logs.problem import log_problem

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
    assert (gap["kind"], gap["first"], gap["count"]) == ("gap", 300, 40) and data["pieces"] == [
        [0, 300],
        [340, 360],
    ]
    assert (folder / "gap.png").stat().st_size > 5000 and data["samples"]["measurement:z"] == 660
    said = thruster("log", "stuck.csv", *MODEL).stdout
    assert "z is stuck at" in said and "measurement z [m/s]" in said
    assert "Nothing stands out" in thruster("log", "whole.csv", *MODEL).stdout
    assert thruster("log", "whole.csv", *MODEL, "--plot", "whole.txt").returncode == 2


def test_an_estimate_does_not_praise_a_stuck_sensor(folder, thruster, as_json):
    data = as_json("estimate", "stuck.csv", *MODEL)
    assert data["findings"][0]["kind"] == "stuck"
    assert (
        "First mend what was found in the log (stuck)" in data["sentences"][-1]
        and "is stuck at" in data["sentences"][0]
    )
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
    other = thruster(
        "tune", "--filter", "kf", *logs, "--trials", 3, "--out", "held.json", "--hold-gaps", "--study", "b"
    )
    assert other.returncode in (0, 3)
    content = json.loads((folder / "held.json").read_text())["problems"]
    assert next(iter(content.values()))["content"]["options"]["hold_gaps"] is True
    assert thruster("verify", "held.json", *MODEL).returncode == 0


def test_a_model_that_blows_up_is_told_its_substeps(folder):
    def explode(x, u, c):
        return (x[0] - 400.0 * x[0] + u[0],)

    model = StateSpaceModel(
        transition=explode,
        observe=lambda x, c: (x[0],),
        process_noise_cov=[1e-2],
        measurement_noise_cov=[1e9],
        prior_mean=[0.0],
        prior_cov=[1.0],
        inputs=1,
        input_quantities=[("force", "u", "N")],
        measurements=[("log speed", "z", "m/s")],
    )
    found = tuning.estimate(tuning.read_logs(table(), model=model), filter="open-loop")
    said = found.sentences()[-1]
    assert (
        "diverges between samples" in said
        and "substeps" in said
        and "dt = 0.1 s" in said
        and "too small" not in said
    )


def test_recorders_of_two_rates_are_told_the_option(folder, thruster):
    slow = table()
    slow["time_s"] = slow["time_s"] * 1.01
    write_columns(folder / "slow.csv", slow, "exact")
    for command in (
        ("tune", "--log", "whole.csv", "--log", "slow.csv"),
        ("identify", "whole.csv", "slow.csv", "--free", "gain"),
    ):
        done = thruster(*command, *MODEL)
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
