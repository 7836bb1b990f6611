"""Filters on vector envs: every copy is what a single wrapped env would be, as others' programs ask."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import thruster_env  # noqa: F401 - registers the envs
from filters import FILTERS, EstimateState, EstimateStates, thruster_model
from filters.wrappers import ALIASES, filtered_id
from tests.filters.checks import refused
from tests.models import affine
from thruster_env.model.state_space import StateSpaceModel

COPIES, STEPS = 3, 30
MODES = ["NextStep", "SameStep", "Disabled"]
DROPOUT = {"sensors": {"thrust": [{"name": "dropout", "probability": 0.3}]}}


BOUNDED = thruster_model().replace(bounds={"omega_m": (0.0, 30.0), "U_a": (0.0, None)})
KINDS = {
    "ekf": {"filter": "ekf"},
    "enkf": {"filter": "enkf", "ensemble_size": 20},
    "smoothed": {"filter": "ekf", "smoothing_lag": 3},
    "bounded": {"filter": "ekf", "model": BOUNDED},
}
TOLD = {
    "estimate",
    "estimate_cov",
    "innovation",
    "innovation_cov",
    "estimate_divergences",
    "smoothed",
    "smoothed_cov",
}


def pair(filter_name, mode, **arguments):
    """A wrapped vector env and as many wrapped single envs, with episodes of seven steps."""
    kind = {"observation": "belief", **KINDS[filter_name]}
    name = "BowThrusterTracking-v0"
    vector = gym.make_vec(name, num_envs=COPIES, max_episode_steps=7, autoreset_mode=mode, **arguments)
    singles = [EstimateState(gym.make(name, max_episode_steps=7, **arguments), **kind) for _ in range(COPIES)]
    return EstimateStates(vector, **kind), singles


def assert_copy(vector, i, single):
    observations, info = vector
    observation, expected = single
    np.testing.assert_allclose(observations[i], observation, rtol=1e-5, atol=1e-6)
    for key in TOLD & set(expected):
        np.testing.assert_allclose(info[key][i], expected[key], rtol=1e-9, atol=1e-12)
        assert info[f"_{key}"][i]


@pytest.mark.parametrize("arguments", [{}, DROPOUT], ids=["plain", "dropout"])
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("filter_name", KINDS)
def test_a_copy_is_a_single_wrapped_env_over_several_episodes(filter_name, mode, arguments):
    vector, singles = pair(filter_name, mode, **arguments)
    start = vector.reset(seed=5)
    for i, single in enumerate(singles):
        assert_copy(start, i, single.reset(seed=5 + i))
    ended = np.zeros(COPIES, dtype=bool)
    for actions in np.random.default_rng(0).uniform(-30, 30, (STEPS, COPIES, 1)).astype(np.float32):
        observations, _, terminated, truncated, info = vector.step(actions)
        for i, single in enumerate(singles):
            if mode == "NextStep" and ended[i]:
                assert_copy((observations, info), i, single.reset())
                continue
            observation, _, *ends, expected = single.step(actions[i])
            if mode == "SameStep" and any(ends):
                np.testing.assert_allclose(info["final_obs"][i], observation, rtol=1e-5, atol=1e-6)
                for key in {"estimate", "smoothed"} & set(expected):
                    np.testing.assert_allclose(info["final_info"][key][i], expected[key], rtol=1e-9, atol=1e-12)
                observation, expected = single.reset()
            assert_copy((observations, info), i, (observation, expected))
        ended = terminated | truncated
        if mode == "Disabled" and ended.any():
            begun = vector.reset(options={"reset_mask": ended})
            for i in np.flatnonzero(ended):
                assert_copy(begun, i, singles[i].reset())


class Oscillator(gym.Env):
    """Somebody else's env: episodes end at random, and not every info has a measurement or a flag."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.steps = self.np_random.normal(size=2), 0
        return self.x.copy(), {}

    def step(self, action):
        force = float(action[0]) - self.x[0]
        self.x = self.x + 0.1 * np.array([self.x[1], force]) + 0.01 * self.np_random.normal(size=2)
        self.steps += 1
        info, reports = (
            {"measurement": self.x + 0.1 * self.np_random.normal(size=2)},
            self.np_random.random() < 0.7,
        )
        if self.steps > 1:
            info["measurement_valid"] = self.np_random.random(2) > 0.3
        return self.x.copy(), 0.0, bool(self.np_random.random() < 0.15), self.steps >= 5, info if reports else {}


def oscillator():
    return StateSpaceModel(
        transition=lambda x, u, c: (x[0] + 0.1 * x[1], x[1] + 0.1 * (u[0] - x[0])),
        observe=lambda x, c: (x[0], x[1]),
        process_noise_cov=[1e-4] * 2,
        measurement_noise_cov=[0.01] * 2,
        prior_mean=[0.0] * 2,
        prior_cov=[1.0] * 2,
    )


@pytest.mark.parametrize("mode", AutoresetMode)
@pytest.mark.parametrize("filter_name", ["ekf", "enkf"])
def test_a_copy_of_an_env_that_reports_a_measurement_now_and_then_is_a_single_env(as_python, filter_name, mode):
    kind = {"filter": filter_name, "observation": "measurement+estimate", "model": oscillator(), "monitor": 100.0}
    kind |= {"ensemble_size": 5} if filter_name == "enkf" else {}
    vector = EstimateStates(SyncVectorEnv([Oscillator] * COPIES, autoreset_mode=mode), **kind)
    singles = [EstimateState(Oscillator(), **kind) for _ in range(COPIES)]

    def compare(i, found, expected):
        (observations, info), (observation, single) = found, expected
        np.testing.assert_array_equal(observations[i], observation)
        assert info["health"][i] == single["health"]
        for key in ("estimate", "estimate_cov", "innovation", "innovation_cov", "estimate_divergences"):
            np.testing.assert_array_equal(info[key][i], single[key])

    start = vector.reset(seed=[9, 2, 2])
    for i, single in enumerate(singles):
        compare(i, start, single.reset(seed=[9, 2, 2][i]))
    ended = np.zeros(COPIES, dtype=bool)
    for actions in np.random.default_rng(0).uniform(-2, 2, (20, COPIES, 1)).astype(np.float32):
        observations, _, terminated, truncated, info = vector.step(actions)
        latest = []
        for i, single in enumerate(singles):
            if mode == AutoresetMode.NEXT_STEP and ended[i]:
                latest.append(single.reset())
            else:
                observation, _, *ends, expected = single.step(actions[i])
                if mode == AutoresetMode.SAME_STEP and any(ends):
                    compare(i, (info["final_obs"], info["final_info"]), (observation, expected))
                    observation, expected = single.reset()
                latest.append((observation, expected))
            compare(i, (observations, info), latest[i])
        ended = terminated | truncated
        if mode == AutoresetMode.DISABLED and ended.any():
            begun = vector.reset(options={"reset_mask": ended})
            for i, single in enumerate(singles):
                compare(i, begun, single.reset() if ended[i] else latest[i])


def test_many_copies_on_all_cores_are_the_few():
    many = EstimateStates(gym.make_vec("BowThruster-v0", num_envs=600), "enkf", ensemble_size=10)
    few = EstimateStates(gym.make_vec("BowThruster-v0", num_envs=2), "enkf", ensemble_size=10)
    many.reset(seed=1), few.reset(seed=1)
    for _ in range(5):
        of_many, of_few = many.step(np.full((600, 1), 9.0)), few.step(np.full((2, 1), 9.0))
    np.testing.assert_allclose(of_many[-1]["estimate"][:2], of_few[-1]["estimate"], rtol=1e-12)


def test_a_vector_env_s_own_model_gets_actions_as_the_env_does():
    plain, inside = (gym.make_vec("BowThruster-v0", num_envs=2) for _ in range(2))
    envs = [EstimateStates(env) for env in (plain, gym.wrappers.vector.ClipAction(inside))]
    for env in envs:
        env.reset(seed=1)
    infos = [env.step(np.full((2, 1), 99.0, np.float32))[-1] for env in envs]
    np.testing.assert_array_equal(infos[0]["estimate"], infos[1]["estimate"])
    rule = "must get the env's own actions, but got"
    refused(rule, EstimateStates, gym.wrappers.vector.RescaleAction(inside, np.float32(-1.0), np.float32(1.0)))


def test_a_reference_behind_the_measurements_of_copies_stays_the_env_s():
    env = gym.wrappers.vector.NormalizeObservation(gym.make_vec("BowThrusterTracking-v0", num_envs=2))
    refused("the last 1 entries of an observation must be the env's own", EstimateStates, env)


def test_copies_begin_with_a_reset_of_all():
    env = SyncVectorEnv([Oscillator] * COPIES, autoreset_mode=AutoresetMode.DISABLED)
    env = EstimateStates(env, model=oscillator())
    actions = np.zeros((COPIES, 1), np.float32)
    with pytest.raises(gym.error.ResetNeeded, match=r"must begin with reset\(\), but step came first"):
        env.step(actions)
    env.reset(seed=1)
    env.step(actions)


def test_a_third_party_vector_env_takes_a_filter_too():
    env = gym.make_vec("Pendulum-v1", num_envs=2, vectorization_mode="sync")
    wrapped = EstimateStates(env, "ekf", model="tests.filters.test_vector_wrapper:still")
    wrapped.reset(seed=0)
    observation, *_, info = wrapped.step(np.zeros((2, 1), dtype=np.float32))
    assert observation.shape == (2, 3) and info["estimate_cov"].shape == (2, 3, 3)


def still():

    return affine(np.eye(3), np.zeros((3, 1)), np.eye(3), q=[0.1] * 3, r=[0.1] * 3, mean=[0.0] * 3, cov=[1.0] * 3)


# The checker would like a bare env with actions in [-1, 1] and bounded observations; volts and a filter are meant.
@pytest.mark.filterwarnings(r"ignore:.*(symmetric and normalized|probably too|is different from the):UserWarning")
@pytest.mark.parametrize("task", ["", "Tracking", "Linear"])
def test_filtered_ids_make_single_and_vector_envs(task):
    name = f"filters:BowThruster{task}-EKF-v0"
    env = gym.make(name, observation="belief")
    check_env(env, skip_render_check=True)
    again = gym.make(EnvSpec.from_json(env.spec.to_json()))
    vector = gym.make_vec(name, num_envs=2, observation="belief")
    first = env.reset(seed=4)[0]
    np.testing.assert_array_equal(again.reset(seed=4)[0], first)
    np.testing.assert_allclose(vector.reset(seed=4)[0][0], first, rtol=1e-6)


def test_every_task_has_an_id_that_takes_any_filter_and_some_short_ones():
    assert filtered_id("BowThruster-v0", "EnKF") == "BowThruster-EnKF-v0"
    for task in ("", "Tracking", "Reversal", "Linear"):
        for word in ("Filtered", *ALIASES.values()):
            assert filtered_id(f"BowThruster{task}-v0", word) in gym.registry
    assert set(ALIASES) <= set(FILTERS)
    env = gym.make("filters:BowThruster-Filtered-v0", filter="denkf", filter_arguments={"ensemble_size": 7})
    assert (env.unwrapped.spec.id, env.get_wrapper_attr("filter").size) == ("BowThruster-Filtered-v0", 7)


def test_filter_arguments_must_be_a_mapping():
    refused("filter_arguments must be a mapping", gym.make, "filters:BowThruster-EKF-v0", filter_arguments=[1])


OF_DROPOUTS = {"sensors": {"thrust": [{"name": "dropout", "probability": 0.5}]}}


def made(name, wrapped):
    env = gym.make(name, **({} if "Linear" in name else OF_DROPOUTS))
    return EstimateState(env, filter="ekf") if wrapped else env


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("name", ["BowThrusterTracking-v0", "BowThrusterLinear-v0"])
@pytest.mark.parametrize("wrapped", [False, True])
def test_every_value_of_info_has_a_dtype_and_the_same_at_reset_and_step(name, wrapped):
    env = made(name, wrapped)
    infos = env.reset(seed=0)[1], env.step([3.0])[4]
    kinds = [{key: (np.shape(value), value.dtype) for key, value in info.items()} for info in infos]
    assert kinds[0] == kinds[1] and kinds[0]["thrust"] == ((), np.float64)
    assert all(dtype.kind != "O" for _, dtype in kinds[0].values())
    assert infos[0]["time"] == 0.0 and infos[1]["time"] == 0.01  # of its moment, not views of what goes on
    assert not wrapped or kinds[0]["estimate_divergences"] == ((), np.int64)


@pytest.mark.parametrize("mode", AutoresetMode, ids=lambda mode: mode.value)
def test_a_vector_env_says_how_it_resets_where_gymnasiums_own_do(mode):
    def envs_of(vectorization_mode, **arguments):
        return gym.make_vec("BowThruster-v0", 2, vectorization_mode=vectorization_mode, **arguments)

    native = envs_of("vector_entry_point", autoreset_mode=mode)
    sync = envs_of("sync", vector_kwargs={"autoreset_mode": mode})
    assert isinstance(sync, SyncVectorEnv) and native.autoreset_mode == sync.autoreset_mode == mode
    assert EstimateStates(native, filter="ekf").autoreset_mode == mode
    assert (
        EstimateStates(sync, filter="ekf", model="thruster_env.thruster.model:thruster_model").autoreset_mode
        == mode
    )
