"""Whatever makes data is a problem by one contract: scenarios of the thruster, pairs of models, Gymnasium envs."""

import functools
import pickle

import numpy as np
import pytest

from filters.bounds import posterior_bound
from filters.likelihood import likelihood
from plants.state_space import StateSpaceModel
from tests import pendulum_problem
from tests.models import wide_model
from tests.tuned_files import write_untuned
from tuning.evaluation import held_out
from tuning.evaluation.baselines import Scaled
from tuning.evaluation.tuned import read_choice, read_tuned
from tuning.likelihood.noise import noise_family
from tuning.problems import model_problem
from tuning.problems.check import checked_problem
from tuning.problems.env_problem import EnvProblem
from tuning.problems.excitation import BinarySequence, MultiSine, Steps
from tuning.problems.model_problem import ModelProblem
from tuning.problems.parameter import Parameter
from tuning.problems.problem import NOISE, scored_states
from tuning.search.plan import Plan
from tuning.search.space import choice_of, parameters, parameters_of, true_choice, untuned_choice
from tuning.thruster.find import find_scenario

UNITS = {"states": ["p", ("q", "q", "m"), "r"], "measurements": [("one", "a", "N"), "b"]}
pytestmark = pytest.mark.usefixtures("as_python")


def thruster(**changes):
    return find_scenario("nominal").replace(steps=60, **changes)


def pair(**changes):
    model = wide_model(**UNITS)
    given = {"inputs": Steps(amplitude=(1.0, 2.0), hold=5), "steps": 60, "scale": (0.5, np.inf, 1.0)}
    return ModelProblem(model, **{"assumed": model, **given, **changes})


MAKERS = {
    "thruster": thruster,
    "two sensors": functools.partial(thruster, sensors=["thrust", "speed"], measurement_noise_cov=[0.25, 4.0]),
    "pair": pair,
    "env": functools.partial(pendulum_problem.problem, steps=60),
    "one number": functools.partial(pendulum_problem.of_one_number, steps=60),
}
every_problem = pytest.mark.parametrize("make", MAKERS.values(), ids=list(MAKERS))


@every_problem
def test_a_problem_says_what_a_study_has_to_know(make):
    problem = checked_problem(make())
    data, n = problem.data([3, 4, 5]), len(problem.scale)
    model = problem.model()
    assert data.inputs.shape == (3, 60, model.inputs) and data.measurements.shape == (3, 61, model.m)
    assert data.states.shape == (3, 61, n) and data.filter_keys.shape == (3, 2) and not data.states.flags.writeable
    assert problem.quantities == model.quantities and problem.bound(data.slice(0, 1)).shape == (n,)
    assert set(scored_states(problem)) <= {state.symbol for state in model.states}
    for given in (problem.untuned, problem.true or {}, {"prior_cov_factor": 4.0}):
        assert problem.model(**given).quantities == model.quantities
    np.testing.assert_allclose(problem.model(prior_cov_factor=4.0).prior_cov, 4.0 * model.prior_cov)
    q = np.diag(np.arange(1.0, model.n + 1))
    np.testing.assert_array_equal(problem.model(**{NOISE[0]: q}).process_noise_cov, q)


@every_problem
def test_a_seed_s_data_depend_on_that_seed_alone_and_survive_a_pickle(make):
    problem = make()
    together, alone = problem.data([3, 4, 5]), make().data([4])
    for part, one in zip(together.slice(1, 2)[1:4], alone[1:4], strict=True):
        np.testing.assert_array_equal(part, one)
    np.testing.assert_array_equal(together.states[1], alone.states[0])
    again = pickle.loads(pickle.dumps(problem))
    assert again.digest == problem.digest
    np.testing.assert_array_equal(again.data([4]).measurements, alone.measurements)


@every_problem
def test_a_digest_is_the_same_for_the_same_and_another_for_another(make):
    problem = make()
    assert problem.digest == make().digest and len(problem.digest) == 12
    assert problem.digest not in {other().digest for other in MAKERS.values() if other is not make}


@every_problem
def test_each_parameter_is_what_was_set_and_the_untuned_choice_is_within_all_ranges(make):
    problem = make()
    choice = untuned_choice("enkf", problem)
    assert choice_of("enkf", parameters_of(choice), problem) == choice and choice.filter(problem).name == "enkf"
    free = {"full_q": True, "prior": True} if problem.parameters is None else {}
    for one in parameters("enkf", problem, **free):
        assert one.get(choice) is None or one.low <= one.get(choice) <= one.high, one.name
        value = one.low if one.integer else (one.low + one.high) / 2
        assert one.get(one.set(choice, value)) == pytest.approx(value, rel=1e-12), one.name


def test_by_default_a_study_tunes_a_variance_a_state_and_a_channel_each_in_its_unit():
    found = {one.name: one.unit for one in parameters("ekf", pair())}
    assert found == {"Q11": "", "Q22": "m^2", "Q33": "", "R11": "N^2", "R22": ""}
    sensors = {one.name: one.unit for one in parameters("ekf", MAKERS["two sensors"](), hold_r=False)}
    assert sensors == {"Q11": "(rad/s)^2", "Q22": "(m/s)^2", "R11": "N^2", "R22": "(rad/s)^2"}
    choice = untuned_choice("ekf", pair())
    correlated = choice.model["measurement_noise_cov"]
    moved = {one.name: one for one in parameters("ekf", pair())}["R11"].set(choice, 2.0).model[NOISE[1]]
    assert moved[0][0] == pytest.approx(2.0) and moved[1][1] == pytest.approx(correlated[1][1])
    before, after = (np.array(r)[0, 1] / np.sqrt(r[0][0] * r[1][1]) for r in (correlated, moved))
    assert after == pytest.approx(before), "correlated sensors stay so"


def test_one_number_may_stand_for_the_whole_noise():
    problem = pendulum_problem.of_one_number()
    assert [one.name for one in parameters("ekf", problem)] == ["sigma"]
    choice = choice_of("ekf", {"sigma": 0.5}, problem)
    assert choice.model == {"sigma": 0.5} and parameters_of(choice) == {"sigma": 0.5}
    np.testing.assert_allclose(choice.filter(problem).model.process_noise_cov, np.diag([0.025**2, 0.25]))
    assert problem.untuned == {"sigma": pytest.approx(np.sqrt(1e-3))}
    with pytest.raises(ValueError, match="must be asked of a problem that tunes Q and R, but .* tunes sigma"):
        Plan("ekf", (problem,), full_q=True).checked()


def test_the_scale_of_a_pair_is_the_bound_of_the_truth_or_the_open_loop_s_error(monkeypatch):
    monkeypatch.setattr(model_problem, "SCALE_SEEDS", range(2))
    problem = pair(scale=None, steps=8, first_scored_step=2)
    bound = posterior_bound(problem.truth, problem.data(range(2)).inputs)
    expected = np.sqrt(np.einsum("bkii->bki", bound)[:, 2:].mean(axis=(0, 1)))
    np.testing.assert_allclose(problem.scale, expected, rtol=1e-12)
    still = {"process_noise_cov": [0.3, 0.0, 0.4]}
    singular = ModelProblem(wide_model(**still), None, MultiSine(), steps=8, first_scored_step=2)
    assert np.isnan(singular.bound(singular.data([0]))).all() and np.isfinite(singular.scale).all()
    assert "Q22" in {one.name for one in parameters("ekf", singular)}, "its range is known"


def test_a_pair_compares_the_states_that_both_have():
    truth = wide_model(states=["p", "q", "r"])
    found = ModelProblem(truth, wide_model(states=["r", "p", "bias"]), np.ones((60, 2)), scale=(1.0, 1.0))
    drawn = ModelProblem(truth, None, np.ones((60, 2)), scale=(1.0, 1.0, 1.0)).data([1])
    np.testing.assert_array_equal(found.data([1]).states, drawn.states[..., [2, 0]])
    assert found.true is None and checked_problem(found).untuned[NOISE[0]][2] == pytest.approx(0.4)
    assert true_choice("ekf", found) is None


def test_inputs_are_an_array_a_function_of_seeds_an_excitation_or_none():
    array = np.arange(120.0).reshape(60, 2)
    np.testing.assert_array_equal(pair(inputs=array).data([1, 2]).inputs, [array, array])
    made = pair(inputs=lambda seeds, steps: np.array(seeds, float)[:, None, None] * np.ones((1, steps, 2)))
    assert made.data([7, 9]).inputs[:, 5, 1].tolist() == [7.0, 9.0]
    two = pair(inputs=BinarySequence(amplitude=(1.0, 3.0), hold=4)).data([1]).inputs
    assert set(np.abs(two[0]).max(axis=0)) == {1.0, 3.0} and (np.sign(two[0, :, 0]) != np.sign(two[0, :, 1])).any()
    alone = wide_model(b=np.zeros((3, 0)))
    assert ModelProblem(alone, steps=60, scale=(1.0, 1.0, 1.0)).data([1]).inputs.shape == (1, 60, 0)


def test_an_env_shows_its_state_and_its_noise_is_the_seeds_alone():
    quiet, noisy = (pendulum_problem.problem(measurement_noise_cov=r) for r in (None, (0.01, 0.04, 0.25)))
    exact, seen = quiet.data(range(6)), noisy.data(range(6))
    np.testing.assert_array_equal(exact.states, seen.states)
    np.testing.assert_allclose(exact.measurements[..., 0], np.cos(exact.states[..., 0]), atol=1e-6)
    noise = (seen.measurements - exact.measurements).reshape(-1, 3)
    np.testing.assert_allclose(noise.std(axis=0), (0.1, 0.2, 0.5), rtol=0.15)
    model = pendulum_problem.model()
    step = model.transition(tuple(exact.states[0, 7]), tuple(exact.inputs[0, 7]), ())
    np.testing.assert_allclose(step, exact.states[0, 8], atol=1e-6)
    blind = pendulum_problem.problem(has_truth=False)
    assert blind.data([1]).states is None and blind.scale is None and checked_problem(blind) is blind


def test_policies_act_on_what_the_env_shows():
    still = EnvProblem("Pendulum-v1", lambda seen: -seen[1:2] - 9.0, pendulum_problem.model(), steps=60,
                       state_of=lambda env: env.state)  # fmt: skip
    assert (still.data([1]).inputs == -2.0).all(), "clipped as the env does"
    drawn = EnvProblem("Pendulum-v1", "random", pendulum_problem.model(), steps=60, state_of=lambda env: env.state)
    inputs = drawn.data([1, 2]).inputs
    assert np.abs(inputs).max() <= 2.0 and inputs.std() > 1.0 and not np.array_equal(*inputs)


@pytest.mark.parametrize("make", [MAKERS["two sensors"], pair], ids=["two sensors", "pair"])
def test_several_sensors_are_kept_by_a_tuned_file(make, tmp_path, monkeypatch):
    monkeypatch.setattr(held_out, "scaled_default", lambda *_: Scaled(None, None, None, "not here"))
    problem = make(name="mine")
    path = write_untuned(tmp_path / "t.json", problem)
    assert read_tuned(path, [problem]) == (untuned_choice("ekf", problem), problem, 0)
    assert read_choice(path, problem) == untuned_choice("ekf", problem)


def test_the_gradient_of_correlated_sensors_is_that_of_their_likelihood():
    problem = pair(steps=20, first_scored_step=5)
    data, choice, numbers = problem.data([1]), untuned_choice("ekf", problem), parameters("ekf", problem)
    noise_at = noise_family(choice, problem, numbers)
    values = np.array([one.get(choice) for one in numbers])

    def log_likelihood(logarithms):
        return likelihood(*noise_at(values * np.exp(logarithms), data)).values[0]

    steps = 1e-4 * np.eye(len(values))
    differences = [(log_likelihood(step) - log_likelihood(-step)) / 2e-4 for step in steps]
    found = likelihood(*noise_at(values, data)).gradients[0]
    np.testing.assert_allclose(found, differences, rtol=1e-4, atol=1e-5)
    model = noise_at(values, data)[0]
    np.testing.assert_allclose(model.measurement_noise_cov, problem.truth.measurement_noise_cov)


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
        "scale of problem a pair of models must be 3 positive numbers, infinite for states that do not count",
    ),
    "true NaN": (
        lambda: ModelProblem(line(nowhere_else), steps=60).data([5]),
        "states of problem a pair of models must be finite, but those of seed 5 are not from step 1 on",
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
        "problems of one study must have as many states and .* but nominal and a pair of models have",
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
        "the env of problem an env must be one that can be made, but NameNotFound",
    ),
    "policy": (lambda: EnvProblem("Pendulum-v1", 3, pendulum_problem.model()), "policy must be 'random', .*3"),
    "state": (
        lambda: pendulum_problem.problem(state_of=None).data([1]),
        r'must show its state in info\["state"\], or state_of must tell it, but info has nothing',
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
        measurement_noise_cov=[1.0, 1.0], prior_mean=[0.0, 0.0], prior_cov=[1.0, 1.0],
    )  # fmt: skip


class Stranger(ModelProblem):
    """One that says of itself what its model does not."""

    quantities = wide_model(states=["a", "b", "c"]).quantities


@pytest.mark.parametrize(("make", "line"), BAD.values(), ids=list(BAD))
def test_what_does_not_fit_is_one_clear_line(make, line):
    with pytest.raises(ValueError, match=line) as caught:
        make()
    assert "\n" not in str(caught.value)
