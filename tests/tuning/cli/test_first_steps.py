"""`thruster demo` and `thruster new`: a result in 42 lines, and files that work as they stand and replace none."""

import importlib
import json
import pickle
import runpy
import sys
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import thruster_env  # noqa: F401 - registers the env
from filters import EstimateState, make_filter, run
from filters.registry import filter_type
from filters.sensitivity import likelihood
from tests.filters.test_differentiated import swing_if
from tests.models import pendulum, simulated, swing
from thruster_env.core.compiled import interpreted
from thruster_env.core.text_tables import console
from thruster_env.thruster.model import thruster_model
from thruster_env.thruster.parameters import TUNNEL_PHYSICAL, read_preset
from tuning.api.report import Report
from tuning.cli import demo
from tuning.cli.main import main
from tuning.evaluation.baselines import rule_of_thumb
from tuning.problems.find import find_problem
from tuning.search.parameters import filter_parameters
from tuning.search.space import AUTO_FILTER_TYPES


@pytest.fixture
def run_demo(tmp_path, monkeypatch, capsys):
    """Run it with three trials in an empty folder; returns exit code and lines of standard output."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(console, "width", 80)
    monkeypatch.setattr(sys, "argv", ["thruster", "demo", "--trials", "3", "--json", "demo.json"])

    def run():
        with pytest.raises(SystemExit) as stop:
            main()
        return stop.value.code or 0, capsys.readouterr().out.splitlines()

    return run


def test_demo_tells_its_result_in_42_lines(run_demo, tmp_path):
    code, lines = run_demo()
    assert code == 0 and len(lines) <= 42 and max(map(len, lines)) <= 80
    data = json.loads((tmp_path / "demo.json").read_text())
    held_out = data["tuning"]["held_out"]["outliers"]
    words = " ".join(" ".join(lines).split())
    assert words.startswith("An extended Kalman filter")
    assert 0 < words.index(data["advice"]) < words.index("rule of thumb")
    (row,) = [line.split() for line in lines if line.startswith(" tuned ")]
    found = [rmse[0] for rmse in held_out["tuned"]["rmse"]]
    assert [float(row[1]), float(row[3])] == pytest.approx(found, rel=0.006)
    told = [tmp_path / line.split()[0] for line in lines if line.startswith("out/")]
    written = data["report"], data["tuning"]["file"], data["best_type"]["file"]
    assert told == [tmp_path / name for name in written]
    best = data["best_type"]["held_out"]["outliers"]["tuned"]["rmse"]
    (row,) = [line.split() for line in lines if line.startswith(" auto: ")]
    assert [float(row[2]), float(row[4])] == pytest.approx([rmse[0] for rmse in best], rel=0.006)
    assert f"also chose the filter type, among {len(AUTO_FILTER_TYPES)}: {row[1]}." in words
    assert "<html" in told[0].read_text()
    sensors = {"thrust": [{"name": "outliers", "std": 10.0, "probability": 0.05}]}
    assert EstimateState(gym.make("BowThruster-v0", sensors=sensors), tuned=str(told[1]))


def test_a_demo_whose_search_was_interrupted_says_so_and_exits_with_130(run_demo, monkeypatch):
    tune, page = demo.run_tuning, Path("out/page.html")

    def interrupted(*arguments, **options):
        tuning = tune(*arguments, **options)
        return replace(tuning, result=tuning.result._replace(interrupted=True))

    monkeypatch.setattr(demo, "run_tuning", interrupted)
    monkeypatch.setattr(demo, "write_report", lambda *_, **options: Report(page, page, "Tuning lowers the score."))
    code, lines = run_demo()
    assert code == 130 and "3 trials, interrupted, on 32 runs" in " ".join(lines)


def test_a_demo_that_is_interrupted_later_exits_with_130(run_demo, monkeypatch):
    def interrupted(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(demo, "run_tuning", interrupted)
    assert run_demo() == (130, [])


@pytest.fixture
def new(thruster, monkeypatch, tmp_path):
    """Write a file and say what its module is called; modules are forgotten afterwards."""
    monkeypatch.syspath_prepend(tmp_path)
    known = set(sys.modules)

    def write(kind, name):
        done = thruster("new", kind, name)
        assert done.returncode == 0 and f"wrote {name}." in done.stdout
        text = next(tmp_path.glob(f"{name}.*")).read_text()
        assert "template" not in text
        return name

    yield write
    for name in set(sys.modules) - known:
        if name.startswith("a_new_"):
            del sys.modules[name]


def naive_correntropy(model, bandwidth, iterations, inputs, measurements):
    """Means of one run of Chen's filter, as the paper has it, for a model with one channel."""
    x, p, found = model.prior_mean, model.prior_cov, []
    for k, z in enumerate(measurements):
        if k:
            for _ in range(model.substeps):
                f = np.array(model.transition_jacobian(tuple(x), tuple(inputs[k - 1]), model.constants))
                x, p = np.array(model.transition(tuple(x), tuple(inputs[k - 1]), model.constants)), f @ p @ f.T
            p = p + model.process_noise_cov
        h = np.array(model.observe_jacobian(tuple(x), model.constants))
        v, r = z - np.array(model.observe(tuple(x), model.constants)), model.measurement_noise_cov
        root, step = np.linalg.cholesky(p), p @ h.T @ np.linalg.solve(h @ p @ h.T + r, v)
        for _ in range(iterations):
            e_x, e_z = np.linalg.solve(root, step), (v - h @ step) / np.sqrt(r[0, 0])
            spread = root @ np.diag(np.exp(e_x**2 / (2 * bandwidth**2))) @ root.T
            noise = r * np.exp(e_z[0] ** 2 / (2 * bandwidth**2))
            gain = spread @ h.T @ np.linalg.inv(h @ spread @ h.T + noise)
            step = gain @ v
        rest = np.eye(len(x)) - gain @ h
        x, p = x + step, rest @ p @ rest.T + gain @ r @ gain.T
        found.append(x)
    return np.array(found)


def test_a_filter_is_that_of_its_paper_on_every_path(new):
    kind = importlib.import_module(new("filter", "a_new_filter")).ANewFilter
    assert filter_type("a_new_filter:ANewFilter").filter_class is kind
    model = thruster_model(measurement_noise_cov=0.2)
    inputs, z = simulated(model, 30)
    z[0, 9] += 8.0  # an outlier
    filter_ = make_filter("a_new_filter:ANewFilter", model, bandwidth=2.0, iterations=3)
    estimates = run(filter_, None, inputs, z)
    expected = naive_correntropy(model, 2.0, 3, inputs[0], z[0])
    np.testing.assert_allclose(estimates.means[0], expected, rtol=1e-9, atol=1e-9)
    belief, _ = filter_.update(filter_.init(), z[0, 0])
    for k, u in enumerate(inputs[0]):
        belief, _ = filter_.update(filter_.predict(belief, u), z[0, k + 1])
    np.testing.assert_allclose(belief.mean, expected[-1], rtol=1e-9)
    assert pickle.loads(pickle.dumps(filter_)).bandwidth == 2.0
    wide = run(make_filter("a_new_filter:ANewFilter", model, bandwidth=1e9), None, inputs, z)
    np.testing.assert_allclose(wide.means, run(make_filter("ekf", model), None, inputs, z).means, rtol=1e-9)


def test_a_filter_is_differentiated_and_stands_around_an_env(new):
    new("filter", "a_new_slope")
    model = thruster_model()
    inputs, z = simulated(model, 20)
    q, r = np.array([np.diag([1.0, 0.0]), np.zeros((2, 2))]), np.array([np.zeros((1, 1)), np.eye(1)])

    def level(q11, r11):
        cov = model.process_noise_cov + np.diag([q11, 0.0])
        changed = model.replace(process_noise_cov=cov, measurement_noise_cov=model.measurement_noise_cov + r11)
        return run(make_filter("a_new_slope:ANewSlope", changed), None, inputs, z).log_likelihoods.sum()

    with interpreted():
        found = likelihood(model, inputs, z, q, r, filter=make_filter("a_new_slope:ANewSlope", model))
        h = 1e-4 * np.array([model.process_noise_cov[0, 0], model.measurement_noise_cov[0, 0]])
        expected = [(level(*step) - level(*-step)) / (2 * step.sum()) for step in np.diag(h)]
        np.testing.assert_allclose(found.gradients[0], expected, rtol=1e-5)
        env = EstimateState(gym.make("BowThruster-v0"), filter="a_new_slope:ANewSlope")
        env.reset(seed=1)
        *_, info = env.step(env.action_space.sample())
    assert np.isfinite(info["estimate"]).all()


def test_a_filter_runs_on_a_model_that_cannot_be_traced(new):
    kind = importlib.import_module(new("filter", "a_new_call")).ANewCall
    inputs, z = simulated(pendulum(), 10, count=2, missing=0.2)
    with interpreted():
        one, other = (run(kind(model=pendulum(transition=f)), None, inputs, z) for f in (swing, swing_if))
    np.testing.assert_allclose(one.means, other.means, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(one.covs, other.covs, rtol=1e-7, atol=1e-9)


def test_studies_search_the_range_of_a_filters_parameter(new):
    new("filter", "a_new_range")
    (found,) = filter_parameters(filter_type("a_new_range:ANewRange"), True)
    assert (found.name, found.low, found.high, found.default, found.log) == ("bandwidth", 1.0, 20.0, 3.0, True)
    choice = rule_of_thumb("a_new_range:ANewRange", find_problem("outliers"))
    assert choice.numbers == {"bandwidth": 3.0} and choice.filter(find_problem("outliers")).bandwidth == 3.0


def test_an_env_is_estimated_and_is_a_problem(new):
    module = importlib.import_module(new("env", "a_new_env"))
    with interpreted():
        env = EstimateState(module.SpringEnv(), filter="ekf")
        env.reset(seed=1)
        errors = []
        for _ in range(100):
            *_, info = env.step(env.action_space.sample())
            errors.append(info["estimate"] - info["state"])
    stds = np.sqrt(np.diag(info["estimate_cov"]))
    assert (np.std(errors, axis=0) < 2 * stds).all()
    problem = find_problem("a_new_env:problem")
    assert problem.name == "a_new_env:problem" and len(problem.data([3, 4]).states[0]) == 301


def test_a_model_estimates_the_log_that_it_writes(new, as_json, monkeypatch, tmp_path):
    name = new("model", "a_new_model")
    with interpreted():
        runpy.run_path(str(tmp_path / f"{name}.py"), run_name="__main__")
    whose = f"{name}.csv", "--model", f"{name}:model"
    found = as_json("estimate", *whose, "--filter", "ekf")
    assert found["nis_band"][0] < found["mean_nis"] < found["nis_band"][1]


def test_a_preset_is_a_thruster(new, as_json):
    name = new("preset", "a_new_preset")
    found = read_preset(f"{name}.toml").parameters
    for one, other in zip(found, TUNNEL_PHYSICAL, strict=True):
        assert one == (pytest.approx(other, rel=1e-6) if isinstance(other, float) else other)
    assert as_json("inspect", "--preset", f"{name}.toml")["preset"] == f"{name}.toml"
    assert gym.make("BowThruster-v0", preset=f"{name}.toml").unwrapped.plant.parameters == found
