"""`EstimateState`: what it promises of observation, info, seeds, specifications and bad arguments."""

import json
import math

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env

import thruster_env  # noqa: F401 - registers the env
from filters import (
    FILTERS,
    EstimateState,
    EstimateStates,
    StateSpaceModel,
    make_filter,
    run,
    smooth,
    thruster_model,
)
from tests.filters.checks import refused
from tests.models import TUNED, affine, state_space
from tests.oracles import each_equal
from thruster_env.thruster.parameters import TUNNEL, derive_constants

# Both checkers would like a bare env with actions in [-1, 1]; volts and a wrapper are what is tested here.
quiet = pytest.mark.filterwarnings(
    "ignore::UserWarning:gymnasium.utils.env_checker", "ignore::UserWarning:stable_baselines3.common.env_checker"
)

FORMS = {"estimate": 2, "measurement+estimate": 3, "belief": 4}
ADDED = {"estimate": (2,), "estimate_cov": (2, 2), "innovation": (1,), "innovation_cov": (1, 1)}


def bow_thruster(**arguments):
    return gym.make("BowThruster-v0", **arguments)


def wrapped(filter="enkf", env=None, **arguments):
    if filter == "enkf":
        arguments.setdefault("ensemble_size", 20)
    return EstimateState(bow_thruster() if env is None else env, filter=filter, **arguments)


def voltages(steps, seed=0, top=12.0):
    levels = np.random.default_rng(seed).uniform(-top, top, size=(-(-steps // 25), 1))
    return np.repeat(levels, 25, axis=0)[:steps].astype(np.float32)


def played(env, actions, seed=None):
    """Observations, rewards and infos of an episode."""
    observation, info = env.reset(seed=seed)
    rows = [(observation, 0.0, info)]
    for action in actions:
        observation, reward, terminated, truncated, info = env.step(action)
        rows.append((observation, reward, info))
        if terminated or truncated:
            break
    return [list(part) for part in zip(*rows, strict=True)]


def infos_of(name, infos):
    return np.array([info[name] for info in infos])


class Scripted(gym.Env):
    """An env of two inputs that reports given measurements, so that a test knows what the filter was told."""

    action_space = gym.spaces.Box(-2.0, 2.0, shape=(2,), dtype=np.float32)
    observation_space = gym.spaces.Box(-np.inf, np.inf, shape=(2,), dtype=np.float32)

    def __init__(self, measurements, valid=None, in_info=True):
        self.measurements, self.valid, self.in_info = np.array(measurements), valid, in_info

    def report(self):
        z, info = self.measurements[self.time], {}
        if self.in_info:
            info["measurement"] = z.copy()
        if self.valid is not None:
            info["measurement_valid"] = np.array(self.valid[self.time])
        return z.astype(np.float32), info

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.time = 0
        return self.report()

    def step(self, action):
        self.time += 1
        observation, info = self.report()
        return observation, 0.0, False, False, info


def two_channels():
    """A model with two states, two inputs and two measurements."""
    noise = {"q": [0.3, 0.2], "r": [[0.5, -0.25], [-0.25, 0.4]]}
    prior = {"mean": [1.0, -1.0], "cov": [1.0, 0.5]}
    return affine(
        [[0.9, 0.3], [-0.2, 0.8]], [[1.0, 0.2], [0.5, -1.0]], [[1.0, 0.4], [-0.3, 1.5]], **noise, **prior
    )


class Offering(Scripted):
    """The same env, which says what model it has."""

    def state_space_model(self, noise=1.0):
        return two_channels().replace(process_noise_cov=[noise, noise])


SCRIPT = np.random.default_rng(1).normal(size=(6, 2))


class TestGymnasium:
    @quiet
    @pytest.mark.usefixtures("as_python")
    @pytest.mark.parametrize("filter", FILTERS)
    @pytest.mark.parametrize("observation", FORMS)
    def test_both_checkers_accept_every_filter_and_observation(self, filter, observation):
        checkers = pytest.importorskip("stable_baselines3.common.env_checker")
        env = wrapped(filter, observation=observation)
        check_env(env, skip_render_check=True)
        checkers.check_env(wrapped(filter, observation=observation), skip_render_check=True)

    def test_observations_are_what_their_names_say(self):
        for form, length in FORMS.items():
            env = wrapped("ekf", observation=form)
            observations, _, infos = played(env, voltages(5), seed=3)
            assert env.observation_space.shape == (length,)
            for observation, info in zip(observations, infos, strict=True):
                deviations = np.sqrt(np.diag(info["estimate_cov"]))
                parts = {
                    "estimate": [info["estimate"]],
                    "measurement+estimate": [info["measurement"], info["estimate"]],
                    "belief": [info["estimate"], deviations],
                }
                np.testing.assert_array_equal(observation, np.concatenate(parts[form]).astype(np.float32))
                assert observation.dtype == np.float32

    @pytest.mark.usefixtures("as_python")
    @pytest.mark.parametrize("filter", FILTERS)
    def test_info_gains_fresh_arrays_of_constant_shape(self, filter):
        env = wrapped(filter)
        kept = []
        for _, _, info in zip(*played(env, voltages(4), seed=1), strict=True):
            for name, shape in ADDED.items():
                value = info[name]
                assert (value.shape, value.dtype) == (shape, np.float64)
                assert all(not np.shares_memory(value, other) for other in kept)
                kept.append(value)
            assert info["estimate_divergences"] == 0
            assert {"state", "thrust", "measurement", "reference", "time"} <= set(info)

    def test_what_a_caller_does_with_info_does_not_reach_the_filter(self):
        calm, careless = wrapped(), wrapped()
        calm.reset(seed=1)
        _, info = careless.reset(seed=1)
        for action in voltages(5):
            for value in info.values():
                if isinstance(value, np.ndarray):
                    value[:] = np.nan
            expected = calm.step(action)[4]["estimate"]
            info = careless.step(action)[4]
            np.testing.assert_array_equal(info["estimate"], expected)

    def test_the_env_runs_as_if_there_were_no_filter(self):
        actions = voltages(40)
        bare, env = bow_thruster(), wrapped()
        for seed in (5, None, None):
            one, other = played(bare, actions, seed), played(env, actions, seed)
            for name in ("state", "measurement", "thrust"):
                np.testing.assert_array_equal(infos_of(name, one[2]), infos_of(name, other[2]))
            assert one[1] == other[1]  # rewards
        assert bare.unwrapped.np_random.bit_generator.state == env.unwrapped.np_random.bit_generator.state


class TestNumbers:
    def test_the_filter_is_told_the_action_that_the_env_applied(self):
        env = EstimateState(Scripted(SCRIPT), filter="kf", model=two_channels())
        wild = np.array([[5.0, -7.0], [1.0, 100.0], [-3.0, 0.5], [0.0, 0.0], [2.5, -2.5]], dtype=np.float32)
        inputs = np.clip(wild, -2.0, 2.0).astype(np.float64)[None]
        expected = run(make_filter("kf", two_channels()), np.zeros((1, 2)), inputs, SCRIPT[None])
        found = infos_of("estimate", played(env, wild, seed=0)[2])
        np.testing.assert_allclose(found, expected.means[0], rtol=1e-12, atol=1e-12)

    def test_the_measurement_is_that_of_info_in_float64_and_else_the_observation(self):
        inputs = np.zeros((1, 5, 2))
        for in_info, z in ((True, SCRIPT), (False, SCRIPT.astype(np.float32))):
            env = EstimateState(Scripted(SCRIPT, in_info=in_info), filter="kf", model=two_channels())
            infos = played(env, inputs[0], seed=0)[2]
            expected = run(make_filter("kf", two_channels()), np.zeros((1, 2)), inputs, z[None])
            np.testing.assert_allclose(infos_of("estimate", infos), expected.means[0], rtol=1e-13, atol=1e-13)

    @pytest.mark.parametrize("per_channel", [True, False])
    def test_a_measurement_that_is_not_valid_is_left_out(self, per_channel):
        valid = np.ones((6, 2), dtype=bool)
        valid[2] = False
        if per_channel:
            valid[4, 1] = False
        z = np.where(valid, SCRIPT, np.nan)
        flags = valid if per_channel else valid.all(axis=1)
        env = EstimateState(Scripted(SCRIPT, flags), "kf", "measurement+estimate", two_channels())
        observations, _, infos = played(env, np.zeros((5, 2)), seed=0)
        expected = run(make_filter("kf", two_channels()), np.zeros((1, 2)), np.zeros((1, 5, 2)), z[None])
        np.testing.assert_allclose(infos_of("estimate", infos), expected.means[0], rtol=1e-13, atol=1e-13)
        np.testing.assert_array_equal(infos[2]["innovation"], np.zeros(2))
        assert np.isfinite(infos[2]["innovation_cov"]).all()
        assert np.isfinite(observations).all()

    def test_restarts_are_counted_in_info_and_info_is_never_nan(self):
        unstable = two_channels().replace(constants=(1e200, *two_channels().constants[1:]))
        env = EstimateState(Scripted(SCRIPT), filter="kf", model=unstable, observation="belief")
        observations, _, infos = played(env, np.zeros((5, 2)), seed=0)
        assert infos[0]["estimate_divergences"] == 0
        assert infos[-1]["estimate_divergences"] > 0
        for name in ("estimate", "estimate_cov", "innovation", "innovation_cov"):
            assert np.isfinite(infos_of(name, infos)).all()
        assert np.isfinite(observations).all()


class TestSeeds:
    @pytest.fixture
    def still(self):
        """An env without noise, in which episodes differ by the filter's own numbers only."""
        env = bow_thruster(process_noise_cov=[0, 0], measurement_noise_cov=0, initial_state=[0, 0])
        return wrapped(env=env, model_arguments={"process_noise_cov": [1.0, 4e-4], "measurement_noise_cov": 0.25})

    def test_an_episode_s_key_follows_from_the_seed_and_changes_from_reset_to_reset(self, still):
        def episodes():
            found = []
            for seed in (3, None, None):
                infos = played(still, voltages(5), seed)[2]
                found.append(infos_of("estimate", infos))
            return found

        first, again = episodes(), episodes()
        np.testing.assert_array_equal(first, again)
        assert not np.array_equal(first[0], first[1])
        assert not np.array_equal(first[1], first[2])

    def test_another_seed_is_another_key(self, still):
        one, other = (infos_of("estimate", played(still, voltages(5), seed)[2]) for seed in (1, 2))
        assert not np.array_equal(one, other)

    def test_envs_that_were_never_seeded_differ(self):
        one, other = (played(wrapped(), [])[2][0]["estimate"] for _ in range(2))
        assert not np.array_equal(one, other)


def own_model(process_noise_cov=(1.0, 4e-4)):
    """What "module:factory" names in the tests below."""
    return thruster_model(process_noise_cov=list(process_noise_cov))


class TestSpecifications:
    def rebuilt(self, env):
        return gym.make(EnvSpec.from_json(env.spec.to_json()))

    @pytest.mark.parametrize(
        "arguments",
        [
            {"filter": "kf", "model_arguments": {"operating_voltage": 6.0}, "observation": "belief"},
            {"filter": "ekf", "model_arguments": {"parameter_factors": {"lift_coefficient": 1.15}}},
            {
                "ensemble_size": 7,
                "filter": "enkf",
                "model_arguments": {"process_noise_cov": [[2, 0.01], [0.01, 1e-3]]},
            },
            {
                "filter": "enkf",
                "model_arguments": {"measurement_noise_cov": 0.5},
                "observation": "measurement+estimate",
            },
            {
                "filter": "ekf",
                "model": f"{__name__}:own_model",
                "model_arguments": {"process_noise_cov": [9.0, 9.0]},
            },
            {},
        ],
    )
    def test_make_to_json_to_make_is_the_same_env(self, arguments):
        env = EstimateState(bow_thruster(max_voltage=12.0), **arguments)
        again = self.rebuilt(env)
        assert isinstance(again, EstimateState)
        assert again.spec.to_json() == env.spec.to_json()
        actions = voltages(20)
        one, other = played(env, actions, 2), played(again, actions, 2)
        each_equal((one[0], infos_of("estimate_cov", one[2])), (other[0], infos_of("estimate_cov", other[2])))

    def test_a_model_object_is_refused_by_json_in_one_clear_line(self):
        env = EstimateState(bow_thruster(), filter="ekf", model=thruster_model())
        played(env, voltages(3), 1)
        with pytest.raises((TypeError, ValueError), match="model") as error:
            env.spec.to_json()
        assert "\n" not in str(error.value)

    def test_a_tuned_file_gives_filter_numbers_and_model(self, tmp_path):
        path = tmp_path / "tuned.json"
        path.write_text(json.dumps(TUNED))
        env = EstimateState(bow_thruster(), tuned=str(path))
        rescaled = EstimateState(
            bow_thruster(), filter="enkf", ensemble_size=20, model_arguments={"process_noise_cov": [1, 4e-4]}
        )
        again = self.rebuilt(env)
        actions = voltages(10)
        found = [infos_of("estimate", played(e, actions, 4)[2]) for e in (env, rescaled, again)]
        each_equal((found[0], found[0]), (found[1], found[2]))
        assert env.filter.ensemble_size == 20


def assumed(**arguments):
    return {"model_arguments": arguments}


class TestModels:
    def test_without_a_model_it_assumes_the_env_s_own_plant(self):
        arguments = {"preset": "tunnel_physical", "dt": 0.005, "process_noise_cov": [4.0, 0.01]}
        env = wrapped("ekf", env=bow_thruster(**arguments))
        expected = thruster_model(**arguments)
        np.testing.assert_array_equal(env.filter.model.numbers, expected.numbers)

    def test_the_noise_is_the_filter_s_own_where_it_is_given(self):
        model = wrapped("ekf", **assumed(process_noise_cov=[4.0, 0.01], measurement_noise_cov=9.0)).filter.model
        each_equal((model.process_noise_cov, model.measurement_noise_cov), (np.diag([4.0, 0.01]), [[9.0]]))

    def test_a_mismatch_is_a_factor_on_a_parameter_of_the_model_alone(self):
        factors = {"lift_coefficient": 1.15, "voltage_gain": 0.95}
        env = wrapped("ekf", **assumed(parameter_factors=factors))
        found, true = env.filter.model.constants, thruster_model().constants
        scaled = TUNNEL._replace(lift_coefficient=1.15 * 1.75, voltage_gain=0.95 * 1133.2)
        expected = derive_constants(scaled, substep=true.substep)
        np.testing.assert_allclose(found, expected, rtol=1e-12)
        assert found.motor_damping == true.motor_damping
        actions = np.full((300, 1), 10.0, dtype=np.float32)
        one, other = played(env, actions, 1)[2], played(wrapped("ekf"), actions, 1)[2]
        np.testing.assert_array_equal(infos_of("state", one), infos_of("state", other))
        error = [abs((infos_of("estimate", i) - infos_of("state", i))[100:, 0].mean()) for i in (one, other)]
        assert error[0] > 2.0 > 1.0 > error[1]  # a voltage gain 5 % low: 4 rad/s of bias at 80

    def test_a_module_s_factory_makes_the_model_from_its_arguments(self):
        env = wrapped("ekf", model=f"{__name__}:own_model", **assumed(process_noise_cov=[9.0, 0.1]))
        np.testing.assert_array_equal(env.filter.model.process_noise_cov, np.diag([9.0, 0.1]))

    def test_a_kalman_filter_works_about_the_operating_voltage(self):
        default, other = wrapped("kf"), wrapped("kf", **assumed(operating_voltage=-3.0))
        assert default.filter.model.operating_input.tolist() == [12.0]
        assert other.filter.model.operating_input.tolist() == [-3.0]


def test_a_filter_that_is_made_is_run_as_it_is():
    made = make_filter("enkf", thruster_model(measurement_noise_cov=9.0), ensemble_size=7)
    actions = np.full((20, 1), 10.0, dtype=np.float32)
    env = EstimateState(gym.make("BowThruster-v0"), filter=made)
    named = wrapped("enkf", ensemble_size=7, **assumed(measurement_noise_cov=9.0))
    one, other = played(env, actions, 1)[2], played(named, actions, 1)[2]
    assert env.filter is made
    np.testing.assert_array_equal(infos_of("estimate", one), infos_of("estimate", other))
    for wrong in ({"model": thruster_model()}, {"ensemble_size": 9}, assumed(measurement_noise_cov=1.0)):
        with pytest.raises(ValueError, match="a filter that is made must come without model"):
            EstimateState(gym.make("BowThruster-v0"), filter=made, **wrong)


@pytest.mark.parametrize(
    ("arguments", "rule"),
    [
        ({"filter": "no filter"}, "filter must be one of .*but got 'no filter'"),
        ({"filter": 3}, "filter must be a name, a filter that is made .*but got 3"),
        ({"observation": "state"}, "observation must be one of estimate, .*but got 'state'"),
        ({"filter": "enkf", "ensemble_size": 1}, "ensemble_size must be .*at least 2, but got 1"),
        ({"filter": "enkf", "size": 9}, "one of ensemble_size, .*model_arguments.*, but got 'size'"),
        ({"filter": "ekf", "ensemble_size": 9}, "one of form .* but got 'ensemble_size'"),
        ({"process_noise_cov": [1.0, 1.0]}, "go into model_arguments.*but got 'process_noise_cov'"),
        ({"model_arguments": [1]}, "model_arguments must be a mapping"),
        ({"model_arguments": {"alpha": 0.5}}, "a bow thruster's model must be among .*'alpha'"),
        (
            {"model_arguments": {"process_noise_cov": [-1.0, 1.0]}},
            "process_noise_cov must be positive semidefinite.*-1",
        ),
        ({"model_arguments": {"measurement_noise_cov": 0.0}}, "measurement_noise_cov must be positive definite"),
        (
            {"model_arguments": {"parameter_factors": {"lift": 1.1}}},
            r"parameter_factors must name fields of .*\['lift'\]",
        ),
        (
            {"model_arguments": {"parameter_factors": {"voltage_gain": -1.0}}},
            "voltage_gain must be positive, but got -1",
        ),
        (
            {"model_arguments": {"operating_voltage": math.nan}},
            "operating_voltage must be a finite number, but got nan",
        ),
        ({"model": "no_such_module:model"}, "model must be 'module:factory'.*'no_such_module:model'"),
        ({"model": "math:no_such_name"}, "model must be 'module:factory'.*'math:no_such_name'"),
        ({"model": "no factory at all"}, "model must be 'module:factory'.*'no factory at all'"),
        ({"model": 3}, "model must be 'module:factory'.*got 3"),
        ({"model": "math:pi"}, "model 'math:pi'"),
        ({"model": "builtins:dict"}, "StateSpaceModel.*builtins:dict|builtins:dict.*StateSpaceModel"),
        ({"model": f"{__name__}:own_model", "model_arguments": {"no_argument": 1}}, "no_argument"),
        (
            {"model": own_model(), "model_arguments": {"process_noise_cov": [1.0, 1.0]}},
            "must come without arguments",
        ),
        ({"tuned": "nowhere.json"}, "a tuned file must be readable"),
        ({"tuned": "nowhere.json", "filter": "ekf"}, "tuned must come without filter, numbers"),
        ({"tuned": "nowhere.json", "ensemble_size": 9}, "tuned must come without filter, numbers"),
    ],
)
def test_a_wrong_argument_is_refused_with_rule_and_value(arguments, rule):
    refused(rule, EstimateState, bow_thruster(), **arguments)


class TestOtherEnvs:
    def test_an_env_without_a_known_plant_needs_a_model(self):
        refused("must come with a model", EstimateState, gym.make("Pendulum-v1"))

    def test_actions_must_be_a_box(self):
        with pytest.raises(ValueError, match="action space must be a Box, but got Discrete"):
            EstimateState(gym.make("CartPole-v1"), model=two_channels())

    def test_actions_must_be_as_many_as_the_model_s_inputs(self):
        with pytest.raises(ValueError, match="action space must have the model's 2 entries"):
            EstimateState(gym.make("Pendulum-v1"), model=two_channels())

    def test_measurements_must_be_as_many_as_the_model_s(self):
        model = two_channels()
        a, b, offset, c, shift = model.matrices()
        prior = {"mean": model.prior_mean, "cov": model.prior_cov}
        one_input = affine(a, b[:, :1], c, q=model.process_noise_cov, r=model.measurement_noise_cov, **prior)
        with pytest.raises(ValueError, match="measurement|observation"):
            EstimateState(bow_thruster(), model=one_input).reset(seed=0)

    def test_a_bow_thruster_offers_its_model(self):
        assert isinstance(bow_thruster().unwrapped.state_space_model(), StateSpaceModel)

    def test_any_env_may_offer_its_model(self):
        env = EstimateState(Offering(SCRIPT), "kf", model_arguments={"noise": 4.0})
        np.testing.assert_array_equal(env.filter.model.process_noise_cov, 4.0 * np.eye(2))


@pytest.mark.parametrize("lag", [None, 2])
def test_what_a_function_reads_outside_is_read_when_a_run_begins(lag):
    """By env, copies, sessions and beliefs as by `filters.run`; a model of a run stays as it is."""
    gain = np.array([1.0])

    def swinging(x, u, c):
        return x[0] + 0.1 * x[1], x[1] - 0.1 * gain[0] * math.sin(x[0]) + 0.1 * u[0] + 0.1 * u[1]

    numbers = {"q": [0.01, 0.02], "r": [0.1, 0.2], "mean": [1.0, 0.0], "cov": [0.5, 0.4]}
    model = state_space(swinging, lambda x, c: (x[0], x[1]), inputs=2, **numbers)
    filter_, actions = make_filter("ekf", model), np.full((5, 2), 0.5)
    env = EstimateState(Scripted(SCRIPT), filter_, smoothing_lag=lag)
    copies = gym.vector.SyncVectorEnv([lambda: Scripted(SCRIPT)] * 2)
    copies = EstimateStates(copies, filter_, smoothing_lag=lag)
    session = filter_.session()
    for gain[0] in (1.0, 4.0):
        expected = run(filter_, inputs=actions, measurements=SCRIPT).means
        info = played(env, actions)[2][-1]
        np.testing.assert_allclose(info["estimate"], expected[-1], rtol=1e-9)
        copies.reset()
        session.start(z=SCRIPT[0])
        belief = filter_.update(filter_.init(), SCRIPT[0])[0]
        for action, z in zip(actions, SCRIPT[1:], strict=True):
            infos = copies.step(np.tile(action, (2, 1)))[-1]
            session.step(action, z)
            belief = filter_.update(filter_.predict(belief, action), z)[0]
        for mean in (*infos["estimate"], session.mean, belief.mean):
            np.testing.assert_allclose(mean, expected[-1], rtol=1e-9)
        if lag:
            smoothed = smooth(filter_, inputs=actions, measurements=SCRIPT, lag=lag).means[3]
            np.testing.assert_allclose(info["smoothed"], smoothed, rtol=1e-9)
            np.testing.assert_allclose(infos["smoothed"][1], smoothed, rtol=1e-9)


class TestWrappersInside:
    """Of Gymnasium's own, between env and filter, as a user may have them by habit."""

    def test_actions_are_clipped_where_the_env_clips_them(self):
        plain, clipped = wrapped("ekf"), wrapped("ekf", gym.wrappers.ClipAction(bow_thruster()))
        actions = 10.0 * voltages(30)
        expected, estimates = (infos_of("estimate", played(env, actions, seed=0)[2]) for env in (plain, clipped))
        np.testing.assert_array_equal(estimates, expected)
        outside = gym.wrappers.TransformAction(
            gym.wrappers.ClipAction(Scripted(SCRIPT)), lambda a: a, Scripted.action_space
        )
        EstimateState(outside, "kf", model=two_channels())

    @pytest.mark.parametrize(
        "wrapper",
        [
            lambda env: gym.wrappers.RescaleAction(env, np.float32(-1.0), np.float32(1.0)),
            lambda env: gym.wrappers.TransformAction(env, np.negative, env.action_space),
            lambda env: gym.wrappers.StickyAction(env, 0.5),
            lambda env: gym.wrappers.MaxAndSkipObservation(env, 2),
        ],
    )
    def test_the_env_s_own_model_gets_the_env_s_own_actions(self, wrapper):
        refused("must get the env's own actions, but got", EstimateState, wrapper(bow_thruster()))
        wrapper(EstimateState(bow_thruster()))
        EstimateState(wrapper(Scripted(SCRIPT)), model=two_channels())  # whose inputs are the outer actions

    def test_an_offer_of_a_wrapper_is_of_that_wrappers_actions(self):
        env = gym.wrappers.RescaleAction(bow_thruster(), np.float32(-1.0), np.float32(1.0))
        env.state_space_model = bow_thruster().unwrapped.state_space_model
        EstimateState(gym.wrappers.TimeLimit(env, 5))

    def test_an_env_that_begins_episodes_within_a_step_is_refused(self):
        rule = r"must begin episodes by reset\(\) alone, but got <Autoreset"
        refused(rule, EstimateState, gym.wrappers.Autoreset(bow_thruster()))

    @pytest.mark.parametrize("kind", ["TimeAwareObservation", "NormalizeObservation", "FrameStackObservation"])
    def test_a_reference_behind_the_measurement_stays_the_env_s(self, kind):
        arguments = (2,) if kind == "FrameStackObservation" else ()
        wrapper = getattr(gym.wrappers, kind)
        rule = f"the last 1 entries of an observation must be the env's own, but got <{kind}"
        refused(rule, EstimateState, wrapper(gym.make("BowThrusterTracking-v0"), *arguments))
        wrapper(EstimateState(gym.make("BowThrusterTracking-v0")), *arguments).reset(seed=0)
        EstimateState(wrapper(bow_thruster(), *arguments))  # which has nothing behind it

    def test_normalised_observations_are_no_measurements(self):
        env = gym.wrappers.NormalizeObservation(Scripted(SCRIPT, in_info=False))
        refused("must be in the model's units, but got", EstimateState(env, model=two_channels()).reset)
        EstimateState(gym.wrappers.NormalizeObservation(Scripted(SCRIPT)), model=two_channels()).reset()


def swing(x, u, c):
    """Gymnasium's pendulum: angle from upright [rad], speed [rad/s]; gravity 10, length and mass 1, dt 0.05."""
    speed = x[1] + 0.05 * (15.0 * math.sin(x[0]) + 3.0 * u[0])
    speed = min(max(speed, -8.0), 8.0)
    return (x[0] + 0.05 * speed, speed)


def see(x, c):
    return (math.cos(x[0]), math.sin(x[0]), x[1])


class TestPendulum:
    def wrapped(self, filter):
        model = state_space(swing, see, q=[1e-6, 1e-6], r=[1e-4, 1e-4, 1e-4], mean=[0.0, 0.0], cov=[1.0, 1.0])
        numbers = {"ensemble_size": 50} if filter == "enkf" else {}
        return EstimateState(gym.make("Pendulum-v1"), filter=filter, model=model, **numbers)

    @quiet
    def test_both_checkers_accept_it(self):
        checkers = pytest.importorskip("stable_baselines3.common.env_checker")
        check_env(self.wrapped("ekf"), skip_render_check=True)
        checkers.check_env(self.wrapped("ekf"), skip_render_check=True)

    @pytest.mark.parametrize("filter", ["ekf", "enkf"])
    def test_the_estimate_follows_the_hidden_state(self, filter):
        env = self.wrapped(filter)
        observation, info = env.reset(seed=2)
        for k in range(150):
            action = np.array([3.0 * math.sin(0.3 * k)], dtype=np.float32)  # beyond the limits of 2
            observation, _, _, _, info = env.step(action)
            angle, speed = env.unwrapped.state
            difference = np.angle(np.exp(1j * (info["estimate"][0] - angle)))
            if k > 20:
                assert abs(difference) < 0.02
                assert abs(info["estimate"][1] - speed) < 0.05
        np.testing.assert_array_equal(observation, info["estimate"].astype(np.float32))
        assert info["estimate_divergences"] == 0
