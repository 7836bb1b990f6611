"""Each source of random numbers in a run of an `EnvProblem` has a stream of its own that follows from the seed."""

import itertools
import random

import gymnasium as gym
import numpy as np
import pytest

from filters import EstimateState
from tests.filters.checks import refused
from tests.models import state_space
from tests.pendulum_problem import model as pendulum_model
from tests.thruster_env.core.test_streams import largest_correlation
from thruster_env.env.model_env import ModelEnv
from tuning.problems.env_problem import EnvProblem

SEEDS = range(40)
STEPS = 100
ENTRIES = len(SEEDS) * STEPS
BAND = 5.0  # standard deviations of a correlation of independent draws: level 1e-4 over some hundred pairs


def model(gain=1.0, noise=0.04):
    move, look = (lambda x, u, c: (0.5 * x[0] + gain * u[0],)), (lambda x, c: (x[0],))
    return state_space(move, look, q=[1.0 / 3.0], r=[noise], mean=[0.0], cov=[1.0])


class Leaky(gym.Env):
    """x' = x/2 + u + w with w uniform over (-1, 1), seen as it is; `info` holds w."""

    def __init__(self):
        self.action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float64)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.drawn = 0.0, []
        return np.array([self.x]), {"state": np.array([self.x])}

    def step(self, action):
        w = self.draw()
        self.drawn.append(w)
        self.x = 0.5 * self.x + float(action[0]) + w
        return np.array([self.x]), 0.0, False, False, {"state": np.array([self.x])}

    def draw(self):
        return float(self.np_random.uniform(-1.0, 1.0))


def problem(policy="random", env=Leaky, assumed=None, **given):
    return EnvProblem(env, policy, assumed or model(), steps=STEPS, scale=(1.0,), **given)


def noises(data):
    """w of each step, from the states and the inputs."""
    x = data.states[..., 0]
    return x[:, 1:] - 0.5 * x[:, :-1] - data.inputs[..., 0]


def test_random_actions_are_neither_the_noise_of_the_env_nor_its_first_state():
    data = problem().data(SEEDS)
    u, w = data.inputs[..., 0], noises(data)
    assert abs(np.corrcoef(u.ravel(), w.ravel())[0, 1]) < BAND / np.sqrt(ENTRIES)
    gain = np.vdot(u, u + w) / np.vdot(u, u)  # which was 2 on the same stream
    assert gain == pytest.approx(1.0, abs=BAND / np.sqrt(ENTRIES))
    pendulum = EnvProblem("Pendulum-v1", "random", pendulum_model(), steps=60, state_of=lambda env: env.state)
    data = pendulum.data(range(100))
    first = np.column_stack([data.states[:, 0], data.inputs[:, :2, 0]])
    assert largest_correlation(first.T) < BAND / np.sqrt(len(first))


def test_each_pair_of_streams_of_a_run_is_uncorrelated():
    """Of a plant that draws from an episode's key: process, measurement, added noise, and what a policy draws."""
    made, drawn = ModelEnv(model(), low=-1.0, high=1.0), []

    def policy(observation):  # draws from three places, none of which it seeds
        drawn.append([np.random.normal(), random.gauss(0.0, 1.0), float(made.action_space.sample()[0])])
        return np.array([0.3 * drawn[-1][0]])

    found = EnvProblem(made, policy, model(), steps=STEPS, scale=(1.0,), measurement_noise_cov=[1.0])
    data = found.data(SEEDS)
    own = np.array(drawn[:ENTRIES])
    silent = EnvProblem(made, policy, model(), steps=STEPS, scale=(1.0,)).data(SEEDS)
    np.testing.assert_array_equal(data.inputs, silent.inputs)
    x, u = data.states[..., 0], data.inputs[..., 0]
    streams = {
        "process": x[:, 1:] - 0.5 * x[:, :-1] - u,
        "measurement": (silent.measurements - silent.states)[:, 1:, 0],
        "added": (data.measurements - silent.measurements)[:, 1:, 0],
        "random actions": problem().data(SEEDS).inputs[..., 0],
        "NumPy's": own[:, 0],
        "Python's": own[:, 1],
        "action space": own[:, 2],
    }
    parts = np.array([np.ravel(part) for part in streams.values()])
    names = list(streams)
    for i, j in itertools.combinations(range(len(names)), 2):
        r = np.corrcoef(parts[i], parts[j])[0, 1]
        assert abs(r) < BAND / np.sqrt(ENTRIES), (names[i], names[j], r)
    assert parts[2].std() == pytest.approx(1.0, abs=0.06), "the noise that the problem adds"


def test_the_env_of_a_problem_has_the_data_of_a_seed_whatever_it_draws_from():
    class Global(Leaky):
        def draw(self):
            return float(np.random.uniform(-1.0, 1.0)) + 0.1 * random.random()

    own = problem("random", Global, measurement_noise_cov=[0.3])
    data, env = own.data([3, 7]), own.make_env()
    before = np.random.get_state()[1].copy(), random.getstate()
    _, info = env.reset(seed=7)
    found = [info["measurement"]]
    for k in range(STEPS):
        np.random.uniform()  # somebody else's
        _, _, _, _, info = env.step(data.inputs[1, k])
        found.append(info["measurement"])
    np.testing.assert_array_equal(found, data.measurements[1])
    np.testing.assert_array_equal(own.data([7]).measurements[0], data.measurements[1])
    np.random.set_state(("MT19937", before[0], 624, 0, 0.0))
    own.data([8])
    np.testing.assert_array_equal(np.random.get_state()[1], before[0]), "what others draw goes on as it would"


class Forgetful:
    """Goes on from where it was, unless it is reset."""

    def __init__(self):
        self.calls = 0

    def __call__(self, observation):
        self.calls += 1
        return np.array([np.sin(0.1 * self.calls)])


class Reset(Forgetful):
    def reset(self):
        self.calls = 0


class Seeded(Forgetful):
    def reset(self, seed):
        self.generator = np.random.default_rng(seed)

    def __call__(self, observation):
        return self.generator.uniform(-1.0, 1.0, 1)


def test_a_policy_that_remembers_is_reset_with_each_episode_or_refused():
    rule = "an env must be a function of the seed, but in two of seed 0 the inputs differ from step 0"
    refused(rule, problem(Forgetful()).data, [0, 1])
    for policy in (Reset(), Reset().__call__):
        data = problem(policy).data([0, 1])
        np.testing.assert_array_equal(data.inputs[0], data.inputs[1])
        np.testing.assert_array_equal(data.inputs[0, :, 0], np.sin(0.1 * np.arange(1, STEPS + 1)))
    data = problem(Seeded()).data([0, 1])
    assert abs(np.corrcoef(data.inputs[0, :, 0], data.inputs[1, :, 0])[0, 1]) < 0.5
    assert abs(np.corrcoef(data.inputs[..., 0].ravel(), noises(data).ravel())[0, 1]) < BAND / np.sqrt(2 * STEPS)
    np.testing.assert_array_equal(problem(Seeded()).data([1]).inputs[0], data.inputs[1])


def test_what_draws_from_a_generator_that_nobody_seeds_is_refused():
    generator, space = np.random.default_rng(1), gym.spaces.Box(-1.0, 1.0, (1,), np.float64)
    for policy in (lambda seen: generator.uniform(-1, 1, 1), lambda seen: space.sample()):
        refused("be a function of the seed, but in two of seed 4 the inputs differ", problem(policy).data, [4])

    class Unseeded(Leaky):
        def draw(self):
            return float(generator.uniform(-1.0, 1.0))

    refused("in two of seed 4 the measurements differ from step 1 on", problem("random", Unseeded).data, [4])


class Recurrent:
    """As sb3_contrib's: it counts its calls in a state that it is given back."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        assert deterministic
        count = 0 if state is None or episode_start[0] else state[0]
        return np.array([np.sin(0.1 * count)]), (count + 1,)


def test_the_state_of_a_recurrent_policy_goes_from_step_to_step_and_begins_anew():
    data = problem(Recurrent()).data([0, 1])
    for inputs in data.inputs[..., 0]:
        np.testing.assert_array_equal(inputs, np.sin(0.1 * np.arange(STEPS)))


def test_an_env_that_samples_its_own_action_space_is_a_function_of_the_seed():
    env = Leaky()
    own = problem(lambda seen: env.action_space.sample(), env)
    data = own.data(SEEDS)
    np.testing.assert_array_equal(own.data([5]).inputs[0], data.inputs[5])
    r = np.corrcoef(data.inputs[..., 0].ravel(), noises(data).ravel())[0, 1]
    assert abs(r) < BAND / np.sqrt(ENTRIES)


class Buffered(Leaky):
    """Returns its own arrays, and writes into the action."""

    def __init__(self):
        super().__init__()
        self.seen, self.told = np.zeros(1), {"state": np.zeros(1), "measurement": np.zeros(1)}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.shown()

    def step(self, action):
        super().step(action)
        action *= 7.0
        seen, told = self.shown()
        return seen, 0.0, False, False, told

    def shown(self):
        for array in (self.seen, self.told["state"], self.told["measurement"]):
            array[:] = self.x
        return self.seen, self.told


class BufferedObservation(Buffered):
    """What it measures is its observation alone."""

    def shown(self):
        seen, told = super().shown()
        return seen, {"state": told["state"]}


@pytest.mark.parametrize("env", [Buffered, BufferedObservation])
@pytest.mark.parametrize("measure", [None, lambda seen, info: seen])
def test_what_an_env_returns_is_copied(env, measure):
    given, levels = np.array([0.3]), {"name": "steps", "amplitude": 1.0, "hold": 5}
    for policy in ("random", levels, lambda seen: given):
        data = problem(policy, env, measure=measure).data([1, 2])
        plain = problem(policy, Leaky, measure=measure).data([1, 2])
        np.testing.assert_array_equal(data.measurements, plain.measurements)
        np.testing.assert_array_equal(data.states, plain.states)
        np.testing.assert_array_equal(data.inputs, plain.inputs)
        assert len(np.unique(data.measurements[0])) > STEPS // 2
    assert given[0] == 0.3, "a policy's own array stays as it is"


def test_wrappers_around_an_env_that_returns_its_buffers_keep_no_view_of_them():
    env = EstimateState(problem("random", Buffered).make_env(), filter="ekf")
    _, info = env.reset(seed=1)
    infos = [info] + [env.step(np.array([0.1]))[4] for _ in range(20)]
    for name in ("measurement", "state", "estimate", "estimate_cov", "innovation"):
        assert len({np.asarray(one[name]).tobytes() for one in infos[1:]}) > 15 or name == "estimate_cov", name
