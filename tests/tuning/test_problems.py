"""Whatever makes data is a problem by one contract: scenarios, pairs of models, Gymnasium envs; excitations."""

import dataclasses
import functools
import pickle

import gymnasium as gym
import numpy as np
import pytest

import thruster_env  # noqa: F401 - registers the envs
from filters.bounds import posterior_bound
from filters.tuned_file import NOISE
from tests import pendulum_problem
from tests.filters.checks import refused
from tests.models import wide_model
from tests.oracles import each_equal
from tests.small_problems import pair, thruster
from tests.tuned_files import write_untuned
from thruster_env.core.streams import episode_keys
from thruster_env.thruster.controllers import PIController
from thruster_env.thruster.plant import make_plant
from tuning.evaluation import held_out as summary
from tuning.evaluation.baselines import Scaled
from tuning.evaluation.tuned import read_choice, read_tuned
from tuning.likelihood.objective import Objective
from tuning.likelihood.parametric import Family
from tuning.plants.thruster import ClosedLoop, find_scenario, voltages_of
from tuning.problems import model_problem
from tuning.problems.check import checked_problem
from tuning.problems.env_problem import EnvProblem
from tuning.problems.excitation import EXCITATIONS, BinarySequence, Dwells, MultiSine, Steps
from tuning.problems.model_problem import ModelProblem
from tuning.search.plan import Plan
from tuning.search.space import choice_of, oracle_choice, parameters, parameters_of, untuned_choice

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
    assert problem.untuned == problem.given == {"sigma": 0.1}, "the default of the user's function"
    refused("needs a problem that tunes Q and R, but .* tunes sigma", Plan("ekf", (problem,), hold_r=True).checked)


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
    assert oracle_choice("ekf", found) is None


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


def test_the_inputs_of_data_are_what_the_env_applied_and_measurements_have_units():
    def pendulum(wrapper=lambda env: env):
        return EnvProblem(lambda: wrapper(gym.make("Pendulum-v1")), BinarySequence(amplitude=9.0, hold=5),
                          pendulum_problem.model(), steps=60, state_of=pendulum_problem.state)  # fmt: skip

    plain, clipped = pendulum().data([3]), pendulum(gym.wrappers.ClipAction).data([3])
    each_equal((clipped.inputs, clipped.measurements), (plain.inputs, plain.measurements))
    assert abs(plain.inputs).max() == 2.0
    with pytest.raises(ValueError, match="measurements must be in the model's units, but got <NormalizeObserv"):
        pendulum(gym.wrappers.NormalizeObservation).data([3])


@pytest.mark.parametrize(
    "make", [pytest.param(MAKERS["two sensors"], marks=pytest.mark.slow), pair], ids=["two sensors", "pair"]
)
def test_several_sensors_are_kept_by_a_tuned_file(make, tmp_path, monkeypatch):
    monkeypatch.setattr(summary, "scaled_default", lambda *_: Scaled(None, None, None, "not here"))
    problem = make(name="mine")
    path = write_untuned(tmp_path / "t.json", problem)
    assert read_tuned(path, [problem]) == (untuned_choice("ekf", problem), problem, 0)
    assert read_choice(path, problem) == untuned_choice("ekf", problem)


def test_the_gradient_of_correlated_sensors_is_that_of_their_likelihood():
    problem = pair(steps=20, first_scored_step=5)
    data, choice, numbers = problem.data([1]), untuned_choice("ekf", problem), parameters("ekf", problem)
    family = Family(choice, problem, numbers, data)
    likelihood = Objective([family])
    point = family.coordinates.of([one.get(choice) for one in numbers])

    def log_likelihood(step):
        return likelihood.value(point + step)

    steps = 1e-4 * np.eye(len(point))
    differences = [(log_likelihood(step) - log_likelihood(-step)) / 2e-4 for step in steps]
    np.testing.assert_allclose(likelihood(point).gradient, differences, rtol=1e-4, atol=1e-5)
    model = family.at(point)[0]
    np.testing.assert_allclose(model.measurement_noise_cov, problem.truth.measurement_noise_cov)


PLANT = make_plant()
KEYS = episode_keys(range(40))
OF_ANY_PLANT = [kind for kind in EXCITATIONS.effects.values() if kind.__module__ != "tuning.plants.auv"]
every_excitation = pytest.mark.parametrize("kind", OF_ANY_PLANT)


@every_excitation
def test_a_seed_s_voltages_depend_on_that_seed_alone(kind):
    together = voltages_of(kind(), PLANT, KEYS, 120)
    assert together.shape == (40, 120) and np.isfinite(together).all()
    np.testing.assert_array_equal(together, voltages_of(kind(), PLANT, KEYS, 120))
    np.testing.assert_array_equal(together[7:9], voltages_of(kind(), PLANT, KEYS[7:9], 120))
    assert len(np.unique(together, axis=0)) > 10, "seeds differ"


@every_excitation
def test_an_excitation_is_a_value_that_json_can_hold(kind):
    one = kind()
    (again,) = EXCITATIONS.make([one.as_mapping()])
    assert again == one and hash(again) == hash(one)
    with pytest.raises(dataclasses.FrozenInstanceError):
        setattr(one, dataclasses.fields(one)[0].name, 1.0)


def test_a_binary_sequence_has_two_levels_with_equal_chance_and_holds_them():
    voltages = voltages_of(BinarySequence(amplitude=5.0, hold=10), PLANT, KEYS, 500)
    levels = voltages.reshape(40, 50, 10)
    assert set(np.unique(voltages)) == {-5.0, 5.0} and (levels == levels[:, :, :1]).all()
    assert abs((levels[:, :, 0] > 0).mean() - 0.5) < 5 * 0.5 / np.sqrt(2000)


def test_sines_have_their_amplitude_offset_and_periods():
    voltages = voltages_of(MultiSine(amplitude=3.0, offset=1.0, periods=(0.5, 0.2)), PLANT, KEYS, 500)
    spectrum = np.abs(np.fft.rfft(voltages, axis=1)) / 500
    expected = np.zeros(251)
    expected[[0, 10, 25]] = 1.0, 1.5, 1.5  # 5 s hold ten and 25 periods
    np.testing.assert_allclose(spectrum, np.broadcast_to(expected, spectrum.shape), atol=1e-9)


def test_dwells_rest_at_zero_half_of_the_time_and_move_slowly_between():
    excitation = Dwells(amplitude=2.0, ramp=50, dwell=25)
    voltages = voltages_of(excitation, PLANT, KEYS, 750)
    assert np.abs(voltages).max() <= 2.0
    assert np.abs(np.diff(voltages)).max() <= 2 * 2.0 / 50 + 1e-12
    rests = voltages.reshape(40, 10, 75)[:, :, :25]
    assert (rests == rests[:, :, :1]).all()
    assert abs((rests[:, :, 0] == 0).mean() - 0.5) < 5 * 0.5 / np.sqrt(400)
    crossed = (voltages[:, :-1] < 0) & (voltages[:, 1:] > 0)
    assert crossed.sum() > 20


@pytest.mark.parametrize("name", ["nominal", "mixed"])
def test_a_closed_loop_is_that_of_the_tracking_env_under_pi(name):
    loop = ClosedLoop(low=-0.4, high=0.6, hold_time=0.3)
    scenario = find_scenario(name).replace(excitation=loop, steps=80)
    data = scenario.data([3, 4])
    reference = [{"name": "steps", "low": -0.4, "high": 0.6, "hold_time": 0.3}]
    env = gym.make("BowThrusterTracking-v0", reference=reference, **scenario.plant_arguments)
    controller, state = PIController.for_env(env), None
    observation, info = env.reset(seed=4)
    for k in range(80):
        action, state = controller.predict(observation, state)
        assert action[0] == data.inputs[1, k, 0]
        observation, _, _, _, info = env.step(action)
    np.testing.assert_array_equal(info["state"], data.states[1, -1])


@pytest.mark.parametrize(
    ("make", "rule"),
    [
        (lambda: Steps(amplitude=-1.0), "amplitude must be zero or positive, but got -1.0"),
        (lambda: Steps(hold=0), "hold must be a whole number of at least 1, but got 0"),
        (lambda: MultiSine(periods=(1.0, 0.0)), "periods must be positive, but got 0.0"),
        (lambda: Dwells(zeros=2.0), "zeros must be within plus and minus 1, but got 2.0"),
        (lambda: ClosedLoop(low=1.0, high=0.0), "low must be at most high, but got 1.0 and 0.0"),
        (lambda: EXCITATIONS.make([{"name": "noise"}]), "entry of excitation must be a mapping whose name is"),
    ],
)
def test_wrong_arguments_are_refused_with_the_rule_and_the_value(make, rule):
    refused(rule, make)


def test_a_closed_loop_needs_the_thrust():
    plant = make_plant(sensors=["speed"])
    refused("a closed loop must measure the thrust, but got speed", ClosedLoop().voltages, plant, KEYS, 10)
