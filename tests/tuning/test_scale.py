"""What errors are measured in: the bound, or the open loop's error where there is none; and what a file says."""

from dataclasses import fields
from pathlib import Path

import numpy as np
import optuna
import pytest

from tuning.api.verify import verify
from tuning.evaluation.evaluate import evaluate
from tuning.evaluation.held_out import evaluate_held_out
from tuning.evaluation.tuned import write_tuned
from tuning.search.plan import Plan
from tuning.search.space import untuned_choice
from tuning.search.study import open_study, run_study
from tuning.thruster.scenario import SCENARIOS, find_scenario, is_stable


@pytest.fixture
def file(tmp_path, monkeypatch):
    """Write a scenario file in the working folder and read it."""
    monkeypatch.chdir(tmp_path)

    def write(text):
        (tmp_path / "my.toml").write_text(text)
        return find_scenario("my.toml")

    return write


def test_where_q_is_singular_a_score_is_skill_against_the_open_loop(file):
    scenario = file("process_noise_cov = [1.0, 0.0]\nsteps = 120")
    assert not scenario.has_bound and np.isnan(scenario.bound(scenario.data([1, 2]))).all()
    data = scenario.data(range(200))
    open_loop = evaluate(untuned_choice("open-loop", scenario).filter(scenario), data, scenario.scale)
    assert open_loop.score.value == pytest.approx(1.0, rel=1e-9)
    choice = untuned_choice("ekf", scenario)
    told = choice._replace(model={**scenario.true})
    assert evaluate(told.filter(scenario), data, scenario.scale).score.value < 1.0


def test_the_open_loop_that_is_the_measure_knows_the_plant(file):
    plain = file("process_noise_cov = [1.0, 0.0]\nsteps = 60")
    mismatched = file("process_noise_cov = [1.0, 0.0]\nsteps = 60\nparameter_factors = {voltage_gain = 0.9}")
    assert plain.scale == mismatched.scale


def test_a_study_and_its_file_do_without_a_bound(file):
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    plan = Plan("ekf", (file("process_noise_cov = [1.0, 0.0]\nsteps = 80"),))
    result = run_study(open_study("s", plan, optuna.storages.InMemoryStorage()), plan, 3)
    write_tuned("t.json", plan, result, [evaluate_held_out(result.choice, plan.scenarios[0], 0, 4)], "s")
    assert "NaN" not in Path("t.json").read_text() and verify("t.json").holds


def test_only_the_open_bladed_system_is_unstable():
    unstable = {name for name, scenario in SCENARIOS.items() if not is_stable(scenario.plant)}
    assert unstable == {"published_open_bladed"}
    with pytest.raises(ValueError, match="a bound or a stable open loop .* Q is singular, .*, and .* is unstable"):
        SCENARIOS["published_open_bladed"].replace(process_noise_cov=(1.0, 0.0)).computed_scale(2)


def test_another_content_of_a_file_is_another_study(file):
    storage = optuna.storages.InMemoryStorage()
    text = "scale = [1.0, 0.05]\nsteps = 60\nmeasurement_noise_cov = {}"
    open_study("s", Plan("ekf", (file(text.format(1.0)),)), storage)
    open_study("s", Plan("ekf", (file(text.format(1.0) + "\nabout = 'the same'"),)), storage)
    rule = "'s' exists here for another model or other logs: give it another name"
    with pytest.raises(ValueError, match=rule):
        open_study("s", Plan("ekf", (file(text.format(2.0)),)), storage)


def test_every_field_but_name_and_about_is_in_the_digest():
    nominal = find_scenario("nominal")
    changes = {
        "process_noise_cov": (2.0, 4e-4), "measurement_noise_cov": 1.0, "scale": (1.0, 1.0), "steps": 400,
        "parameter_factors": {"area": 1.1}, "excitation": {"name": "prbs"}, "first_scored_step": 7, "dt": 0.02,
        "preset": "t200", "max_voltage": 12.0, "ambient_velocity": 0.1, "initial_state": [0.0, 0.0],
        "sensors": ["speed"], "flow": [{"name": "gusts"}], "amplifier": [{"name": "dead-band", "width": 1.0}],
        "uncertainty": {"load_gain": {"name": "log-normal", "std": 0.1}}, "system": "tunnel",
    }  # fmt: skip
    digests = {nominal.replace(**{name: value}).digest for name, value in changes.items()}
    assert set(changes) == {entry.name for entry in fields(nominal)} - {"name", "about"}
    assert len(digests) == len(changes) and nominal.digest not in digests
    assert nominal.replace(name="x", about="y").digest == nominal.digest
    assert nominal.replace(scale=tuple(part * (1 + 1e-12) for part in nominal.scale)).digest == nominal.digest
