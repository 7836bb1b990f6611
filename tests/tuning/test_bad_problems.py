"""What is no problem, or does not fit, is one clear line; a model that diverges is told its substeps."""

import gymnasium as gym
import numpy as np
import pytest
from rich.console import Console

import tuning
from filters import make_filter
from filters.consistency.nees import blow_up_sentence, root_mean_square
from filters.consistency.report import sentences
from tests import pendulum_problem
from tests.filters.checks import refused
from tests.models import wide_model
from tests.small_problems import pair, thruster
from thruster_env.model.affine import affine_model
from thruster_env.model.state_space import StateSpaceModel
from tuning.api.tune import run_tuning
from tuning.evaluation.evaluate import check_consistency
from tuning.problems.check import checked_problem
from tuning.problems.env_problem import EnvProblem
from tuning.problems.excitation import Steps
from tuning.problems.find import find_problem
from tuning.problems.model_problem import ModelProblem, RunsProblem
from tuning.problems.problem import Parameter
from tuning.reporting.tuning_report import as_json, report
from tuning.search.plan import Plan


def line(transition=lambda x, u, c: (0.9 * x[0],), **changes):
    return StateSpaceModel(
        transition=transition, observe=lambda x, c: (x[0],), inputs=0, process_noise_cov=[0.1],
        measurement_noise_cov=[1.0], prior_mean=[1.0], prior_cov=[1.0], **changes,
    )  # fmt: skip


def nowhere_else(x, u, c):  # than at the prior mean
    return (x[0] if x[0] == 1.0 else float("nan"),)


BAD = {
    "no model": (lambda: ModelProblem(3), "the truth of problem .* must be a StateSpaceModel, but it is 3"),
    "sensors": (
        lambda: pair(assumed=wide_model()),
        r"measurements of the assumed model and the truth must have the same symbols and units, but got z_1 .* a",
    ),
    "sizes": (lambda: ModelProblem(line(), wide_model()), "inputs of .* and the truth must be as many, but"),
    "units": (
        lambda: ModelProblem(line(states=[("x", "x", "m")]), line(states=[("x", "x", "km")])),
        r"states of .* must have the same symbols and units, but got x \[km\] and x \[m\]",
    ),
    "names": (
        lambda: ModelProblem(line(states=["x"]), line(states=["y"])),
        "states of the assumed model must begin with some of the truth's, x, but got y",
    ),
    "no inputs": (lambda: pair(inputs=None), r"inputs must be finite numbers \(K, 2\), an excitation, or"),
    "inputs": (lambda: pair(inputs=np.ones((60, 3))), r"inputs must be finite numbers \(K, 2\), an excitation"),
    "rows": (lambda: pair(inputs=np.ones((9, 2))), "inputs must have a row for each of 60 steps, but got 9"),
    "function": (
        lambda: pair(inputs=lambda seeds, steps: np.ones(3)).data([1]),
        r"inputs of problem a pair of models must have the shape \(1, 60, 2\), but got \(3,\)",
    ),
    "levels": (
        lambda: pair(inputs=Steps(amplitude=(1.0, 2.0, 3.0))).data([1]),
        r"amplitude must be one number, or one for each of 2 inputs, but got \(1.0, 2.0, 3.0\)",
    ),
    "steps": (lambda: pair(steps=0), "steps must be a whole number of at least 2, but got 0"),
    "scale": (
        lambda: checked_problem(pair(scale=(1.0, -1.0, 1.0))),
        "scale of problem a pair of models must be 3 positive numbers, infinite for states that are not scored",
    ),
    "true NaN": (
        lambda: ModelProblem(line(nowhere_else), steps=60).data([5]),
        "states of problem a pair of models must be finite, but those of seed 5 are not from step 1 on: "
        "x_1 was .* one step earlier; a root or a logarithm may have left its domain",
    ),
    "assumed NaN": (
        lambda: checked_problem(ModelProblem(line(), line(nowhere_else), steps=60, scale=(1.0,))),
        r"transition of the model of problem .* must be finite at the first true state, but got \(nan,\)",
    ),
    "own names": (
        lambda: checked_problem(Stranger(wide_model(), None, np.ones((60, 2)), scale=(1.0, 1.0, 1.0))),
        r"states of problem .* and its model must have the same symbols and units, but got a \[\] and x_1",
    ),
    "study": (lambda: Plan("ekf", (3,)).checked(), "a study must be of .*problem.Problem, but got 3"),
    "mixed study": (
        lambda: Plan("ekf", (thruster(), pair())).checked(),
        "problems of one study must have the same numbers of states and .* but nominal and a pair of models do",
    ),
    "argument": (
        lambda: pair().model(sigma=3.0),
        "arguments of the model of problem .* must be among process_noise_cov, .*, but got sigma",
    ),
    "parameters": (
        lambda: pair(parameters=[Parameter("sigma", 0.1, 1.0)]),
        "a model with parameters must be a function of them, but got",
    ),
    "maker": (
        lambda: ModelProblem(line(), lambda sigma: line(), parameters=[Parameter("other", 0.1, 1.0)]),
        "the model of problem .* must be made of other, but raised TypeError: .*unexpected keyword",
    ),
    "made": (
        lambda: ModelProblem(line(), lambda sigma: sigma, parameters=[Parameter("sigma", 1.0, 4.0)]),
        "the model of problem a pair of models must be a StateSpaceModel, but it is 2.0",
    ),
    "range": (lambda: Parameter("sigma", 0.0, 1.0), "low of sigma must be positive and below high, but got 0"),
    "env": (
        lambda: EnvProblem("Nowhere-v0", "random", pendulum_problem.model()),
        "it must be possible to make the env of problem an env, but NameNotFound",
    ),
    "policy": (lambda: EnvProblem("Pendulum-v1", 3, pendulum_problem.model()), "policy must be 'random', .*3"),
    "state": (
        lambda: pendulum_problem.problem(state_of=None).data([1]),
        r'must show its state in info\["state"\], or state_of must return it, but info has nothing',
    ),
    "short": (
        lambda: EnvProblem(
            "MountainCarContinuous-v0", lambda seen: np.sign(seen[1:2]), car(), steps=400, has_truth=False
        ).data([1]),
        "episodes of problem an env must last 400 steps, but that of seed 1 ended after [0-9]+$",
    ),
    "measured": (
        lambda: pendulum_problem.problem(measure=two_of_three, measurement_noise_cov=None).data([1]),
        r"measurements of problem an env must have the shape \(1, 81, 3\) of its model, but got \(1, 81, 2\)",
    ),
    "discrete": (
        lambda: EnvProblem("CartPole-v1", "random", line()),
        r"must have a Box as its action space, but that of problem 'an env' is Discrete\(2\): wrap it in ",
    ),
    "autoreset": (
        lambda: EnvProblem(lambda: gym.wrappers.Autoreset(gym.make("Pendulum-v1")), "random", line()),
        r"an env must begin episodes by reset\(\) alone, but got <Autoreset",
    ),
    "actions": (
        lambda: EnvProblem("Pendulum-v1", "random", line()),
        "the action space of problem an env must have the model's 0 entries, but got Box",
    ),
}  # fmt: skip


def two_of_three(seen, info):
    return seen[:2]


def car():
    return StateSpaceModel(
        transition=lambda x, u, c: x, observe=lambda x, c: x, process_noise_cov=[1.0, 1.0],
        measurement_noise_cov=[1.0, 1.0], prior_mean=[0.0, 0.0], prior_cov=[1.0, 1.0], inputs=1,
    )  # fmt: skip


class Stranger(ModelProblem):
    """One that says of itself what its model does not."""

    quantities = wide_model(states=["a", "b", "c"]).quantities


@pytest.mark.parametrize(("make", "line"), BAD.values(), ids=list(BAD))
def test_what_does_not_fit_is_one_clear_line(make, line):
    refused(line, make)


def test_a_module_in_the_folder_is_what_was_meant(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tank.py").write_text("problem = 3")
    for name in ("tank", "tank.py"):
        with pytest.raises(ValueError, match="did you mean 'tank:problem'") as caught:
            find_problem(name)
    assert len(str(caught.value)) < 250


def test_what_is_wrong_with_held_out_data_is_said_before_the_search(tmp_path, monkeypatch):
    def inputs(seeds, steps):
        return np.where(np.array(seeds) >= 500_000, np.nan, 1.0)[:, None, None] * np.ones((1, steps, 2))

    monkeypatch.setattr("tuning.api.tune.HELD_OUT_SEEDS", 2)
    journal = tmp_path / "study.journal"
    with pytest.raises(ValueError, match="inputs of problem .* must be finite"):
        run_tuning(Plan("ekf", (pair(inputs=inputs),)), 2, Console(quiet=True), str(journal))
    assert not journal.exists()


def model(factor, r=1e9):
    log_speed = [("log speed", "z", "m/s")]
    return affine_model(A=[[factor]], B=[[1.0]], C=[[1.0]], Q=[1e-2], R=[r], P0=[1.0], measurements=log_speed)


def problem(factor):
    rng, runs = np.random.default_rng(0), []
    for _ in range(9):
        u, x = np.sign(rng.normal(size=80)), np.zeros(81)
        for k in range(80):
            x[k + 1] = 0.9 * x[k] + u[k]
        runs.append((u, x[:, None] + 0.1 * rng.normal(size=(81, 1))))
    return RunsProblem(runs, model(factor), dt=0.1, first_scored_step=5)


def test_a_study_of_a_model_that_blows_up_names_substeps_and_dt_and_not_more_trials():
    study = tuning.tune(problem(-3e4), "kf", trials=3, progress=False, consistent=False)
    said = " ".join(one for one in report(study) if isinstance(one, str))
    assert "diverges between samples" in said and "more substeps" in said and "dt = 0.1 s" in said
    assert "More trials" not in said and "What may help" not in said
    assert as_json(study)["blows_up"][0].startswith("The model diverges between samples: its prediction of")


@pytest.mark.parametrize("factor", [-3e4, 0.9])
def test_the_advice_of_the_page_is_substeps_where_it_blows_up_and_noise_elsewhere(factor):
    mine = problem(factor)
    data = mine.data(range(9))
    said = sentences(check_consistency(make_filter("kf", model(factor, 1e-4)), data, mine.dt))[-1]
    assert ("more substeps" in said and "dt = 0.1 s" in said and "raise" not in said) == (factor < 0)
    assert ("raise R" in said or "raise Q" in said) == (factor > 0)


def test_a_prediction_a_thousand_spreads_off_is_a_blow_up_and_numbers_beyond_all_too():
    z = np.array([[1.0], [-1.0], [np.nan]])
    for off, told in ((999.0, False), (1001.0, True), (1e300, True), (np.inf, True)):
        assert bool(blow_up_sentence(np.array([[off], [off], [np.nan]]), z, ["speed"])) == told
    assert root_mean_square(np.array([3e200, 4e200, np.nan])) == pytest.approx(12.5**0.5 * 1e200)
    assert blow_up_sentence(np.full((3, 1), np.nan), z, ["speed"], 0.1) == ""
