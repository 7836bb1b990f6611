"""From a user's own file to a tuned filter around an env, by the command line and by Python."""

import copy
import re
import shutil
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import optuna
import pytest

import tuning
from filters import EstimateState
from filters.engine.batch import run
from filters.tuned_file import read_tuned_file
from tests import pendulum_problem
from tests.filters.checks import refused
from tests.linear_problem import LinearProblem
from tests.tuned_files import rewrite
from thruster_env.core.compiled import interpreted
from tuning.api.verify import verify
from tuning.evaluation.baselines import SCALED
from tuning.evaluation.held_out import evaluate_held_out
from tuning.evaluation.tuned import read_choice, read_tuned, write_tuned
from tuning.likelihood.gradient import tune_by_gradient
from tuning.plants.thruster import find_scenario
from tuning.problems.check import checked_problem
from tuning.problems.find import find_problem
from tuning.search.among_types import noise_by_gradient
from tuning.search.plan import Plan
from tuning.search.space import choice_of, parameters
from tuning.search.storage import open_storage
from tuning.search.study import open_study, run_study
from tuning.search.workers import find_same


@pytest.fixture(scope="module")
def tuned(tmp_path_factory):
    """A tuned file of the pendulum's one number, by Python."""
    problem = find_problem("tests.pendulum_problem:of_one_number")
    plan = Plan("ekf", (problem,))
    result = run_study(open_study("s", plan, optuna.storages.InMemoryStorage()), plan, 8)
    path = tmp_path_factory.mktemp("pendulum") / "ekf.json"
    write_tuned(path, plan, result, [evaluate_held_out(result.choice, problem, 0, 4)], "s")
    return path, result, problem


@pytest.mark.slow
def test_by_python_a_study_of_one_number_comes_near_its_most_likely_value(tuned):
    path, result, problem = tuned
    assert set(result.trials[0].params) == {"sigma"}
    assert result.validation.chosen == SCALED  # whose Q sigma cannot give
    assert read_tuned(path, [problem]) == (result.choice, problem, 0) and verify(path, problem=[problem]).holds
    content = read_tuned_file(path)
    assert content["problem"] == problem.name and content["digest"] == problem.digest and content["plant"] is None
    assert content["model"]["states"][0] == ["angle", "theta", "rad", True] and content["model"]["dt"] == 0.05
    assert content["problems"] == {problem.name: {"digest": problem.digest, "content": None}}
    (data,) = Plan("ekf", (problem,)).training_data()
    found = tune_by_gradient("ekf", problem, data)
    assert found.names == ("sigma",) and found.agree and found.identified.all()

    def log_likelihood(factor):
        choice = choice_of("ekf", {"sigma": factor * found.choice.model["sigma"]}, problem)
        return run(choice.filter(problem), data.filter_keys, data.inputs, data.measurements).log_likelihoods.sum()

    assert log_likelihood(1.0) == pytest.approx(found.best.value, rel=1e-9)
    assert log_likelihood(1.0) > max(log_likelihood(0.95), log_likelihood(1.05))


def test_a_number_that_changes_functions_has_no_gradient():
    def of_step(dt):
        return pendulum_problem.model(transition=lambda x, u, c: (x[0] + dt * x[1], x[1]))

    problem = pendulum_problem.problem(of_step, parameters=[pendulum_problem.Parameter("dt", 0.1, 1.0)])
    with pytest.raises(ValueError, match="must change numbers of the model alone, but dt changes its functions"):
        tune_by_gradient("ekf", problem, problem.data([1, 2]))
    plan = Plan("ekf", (problem,))
    assert noise_by_gradient(open_study("functions", plan), plan) is None


def pendulum(dt=0.05, model=None):
    env = gym.make("Pendulum-v1")
    env.unwrapped.dt = dt
    if model is not None:
        env.unwrapped.state_space_model = model
    return env


def other_swing(x, u, c):
    return (x[0] + 0.05 * x[1], x[1])


def rate_alone(x, c):
    return (x[1],)


OTHERS = {
    "dt": (lambda: pendulum(0.1), pendulum_problem.model, r"dt 0.05 \(here 0.1\);"),
    "states": (
        pendulum,
        lambda: pendulum_problem.model(states=["theta", ("rate", "omega", "deg/s")]),
        r"states theta \[rad\], omega \[rad/s\] \(here theta, omega \[deg/s\]\);",
    ),
    "sensors": (
        pendulum,
        lambda: pendulum_problem.model(observe=rate_alone, measurement_noise_cov=[0.1], measurements=["w"]),
        r"measurements cosine, sine, rate \[rad/s\] \(here w\);",
    ),
    "equations": (
        pendulum,
        lambda: pendulum_problem.model(transition=other_swing),
        r"a model of digest [0-9a-f]{12} \(here [0-9a-f]{12}\);",
    ),
}


@pytest.mark.parametrize(("env", "model", "said"), OTHERS.values(), ids=list(OTHERS))
@pytest.mark.parametrize("offered", [False, True], ids=["given", "offered"])
def test_a_tuned_file_on_another_model_is_refused_and_the_difference_named(env, model, said, offered, tuned):
    path, found = str(tuned[0]), model()
    wrapped = env()
    if offered:
        wrapped.unwrapped.state_space_model = lambda **changes: found.replace(**changes)
    rule = "a tuned file must be for the model it is used with, but .*ekf.json was tuned for " + said
    with pytest.raises(ValueError, match=rule):
        EstimateState(wrapped, tuned=path, model=None if offered else found)


def test_a_tuned_file_takes_the_same_model_from_the_env_a_factory_or_the_caller(tuned):
    path = str(tuned[0])
    env = pendulum(model=pendulum_problem.model)
    found = [EstimateState(env, tuned=path), EstimateState(env, tuned=path, model="tests.pendulum_problem:model")]
    found.append(EstimateState(env, tuned=path, model=pendulum_problem.model()))
    covs = [one.filter.model.process_noise_cov for one in found]
    np.testing.assert_allclose(covs[1:], [covs[0]] * 2, rtol=1e-12)
    found = EstimateState(tuned[2].make_env(), tuned=path)  # the line that a report gives to copy
    np.testing.assert_allclose(found.filter.model.process_noise_cov, covs[0], rtol=1e-12)
    with pytest.raises(ValueError, match="must come with a model, but got .* alone: pass model=..."):
        EstimateState(gym.make("Pendulum-v1"), tuned=path)


def test_a_problem_that_has_changed_is_not_what_a_file_was_tuned_on(tuned, tmp_path):
    path, _, problem = tuned
    changed = pendulum_problem.problem(pendulum_problem.model, parameters=problem.parameters, steps=61,
                                       name=problem.name)  # fmt: skip
    rule = f"must be the one it was tuned on, {problem.name} of digest {problem.digest}"
    with pytest.raises(ValueError, match=rule):
        read_tuned(path, [changed])
    assert read_choice(path, changed).model.keys() == {"sigma"}, "it may be evaluated there all the same"
    refused("was tuned for states theta", read_choice, path, find_scenario("nominal"))
    refused("must be the same in all processes, of digest 0, but here it has ", find_same, "nominal", "0")

    def module(content):
        content["problem"] = "os:getcwd"
        content["problems"] = {"os:getcwd": {"digest": "0", "content": None}}

    copy = rewrite(Path(shutil.copy(path, tmp_path / "t.json")), module)
    refused("a problem that is code must be given, but .*t.json only names 'os:getcwd'", read_tuned, copy)
    with pytest.raises(ValueError, match="must be the one it was tuned on, os:getcwd, but got nominal: use"):
        read_tuned(copy, [find_scenario("nominal")])


@pytest.mark.parametrize(
    ("text", "name", "line"),
    [
        (None, "my_nothing:problem", "that can be imported, but 'my_nothing:problem' is not: No module named"),
        ("x = 1", "my_bad:problem", "that can be imported, but .* has no attribute 'problem'"),
        ("1 / 0", "my_bad:problem", "module must import, but 'my_bad:problem' raised ZeroDivisionError: "),
        ("x = (", "my_bad:problem", "module must import, but 'my_bad:problem' raised SyntaxError: "),
        ("def f():\n    raise KeyError('a')", "my_bad:f", "without arguments, but .* raised KeyError: 'a'"),
        ("def f(seed): pass", "my_bad:f", "without arguments, but 'my_bad:f' raised TypeError: "),
        ("x = 1", "my_bad:x", "a problem must be a tuning.problems.problem.Problem, but 'my_bad:x' is 1"),
        ("def f(): return 'a\\nb'", "my_bad:f", "must be a tuning.problems.problem.Problem, but 'my_bad:f' is"),
    ],
)
def test_what_is_no_problem_is_one_clear_line(text, name, line, thruster, tmp_path):
    if text is not None:
        (tmp_path / "my_bad.py").write_text(text)
    refused(line, find_problem, name)
    done = thruster("evaluate", "--filter", "ekf", "--problem", name)
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and done.stderr.startswith("thruster: ")
    sys.modules.pop("my_bad", None)


def test_the_problems_of_the_page_are_problems():
    page = (Path(__file__).parents[2] / "docs" / "problems.md").read_text(encoding="utf-8")
    names = {"__name__": "page"}  # as other tests call it, which may have run before
    for code in re.findall(r"```python\n(.*?)```", page, flags=re.DOTALL):
        exec(compile(code, "docs/problems.md", "exec"), names)
    with interpreted():
        assert [one.symbol for one in checked_problem(names["problem"]).quantities.states] == ["theta", "omega"]
        assert [one.name for one in parameters("kf", checked_problem(names["pair"]))] == ["Q11", "Q22", "R"]
        assert [one.name for one in parameters("kf", checked_problem(names["one_number"]))] == ["sigma_a"]
        tank, level = names["tank"], (0.008 / 0.002) ** 2 / 19.62  # where as much flows out as in
        stands = tank.transition((level, 0.008), (0.008,), tank.constants)
        np.testing.assert_allclose(stands, (level, 0.008), rtol=1e-12)


def test_a_file_on_an_object_of_the_users_says_how_to_give_it(tuned, tmp_path):
    problem = copy.copy(tuned[2])
    problem.name = "motor"
    study = tuning.tune(problem, trials=1, progress=False)
    file = study.save(tmp_path / "motor.json")
    said = r"motor.json was tuned on 'motor', an object of yours: pass problem=... \(--problem module:object\)"
    for call in (tuning.evaluate, tuning.report, verify):
        refused(said, call, file)
    assert tuning.evaluate(file, problem, seeds=2).choice == study.choice


CODE = """
import numpy as np
from tuning.problems.problem import Parameter

class Still:
    def __init__(self, model, gain):
        self.model, self.gain = model, gain

    def reset(self, key, z):
        self.mean = np.zeros(self.model.n)
        return self.mean, np.eye(self.model.n)

    def step(self, u, z):
        self.mean = self.mean + FACTOR * self.gain
        return self.mean, np.eye(self.model.n)

def make(model, gain=0.5):
    return Still(model, gain)

make.parameters = [Parameter("gain", 0.1, 1.0, default=0.5)]
"""


def plan_of(folder, factor, monkeypatch):
    """A plan with the estimator as its file says it; another folder, so that nobody remembers the one before."""
    (folder / str(factor)).mkdir()
    (folder / str(factor) / "of_somebody.py").write_text(CODE.replace("FACTOR", str(factor)))
    monkeypatch.syspath_prepend(str(folder / str(factor)))
    sys.modules.pop("of_somebody", None)
    return Plan("of_somebody:make", (LinearProblem(),))


def test_a_study_of_an_estimator_whose_code_changed_is_refused(tmp_path, monkeypatch):
    storage = open_storage(str(tmp_path / "studies.journal"))
    first = plan_of(tmp_path, 1.0, monkeypatch)
    open_study("mine", first, storage)
    assert open_study("mine", first, storage).user_attrs["identity"] == first.identity
    second = plan_of(tmp_path, 2.0, monkeypatch)
    refused("the code of of_somebody:make is not what 'mine' was made with", open_study, "mine", second, storage)
    sys.modules.pop("of_somebody", None)
    assert "estimators" not in Plan("kf", (LinearProblem(),)).identity
