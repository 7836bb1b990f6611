import inspect
import math

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from thruster_env import PRESETS, BowThrusterEnv
from thruster_env.thruster.analysis import run_substeps, state_range, steady_state
from thruster_env.thruster.parameters import TUNNEL
from thruster_env.thruster.plant import make_plant

every_preset = pytest.mark.parametrize("preset", PRESETS)
INFO = {"state", "thrust", "measurement", "reference", "ambient_velocity", "time"}


def actions(count=500, seed=3, top=24.0):
    return np.random.default_rng(seed).uniform(-top, top, (count, 1)).astype(np.float32)


def episode(env, voltages, seed=None):
    """Observations, rewards and infos of one episode, the reset's included (with no reward)."""
    observation, info = env.reset(seed=seed)
    observations, rewards, infos = [observation], [], [info]
    for voltage in voltages:
        observation, reward, terminated, truncated, info = env.step(voltage)
        observations.append(observation)
        rewards.append(reward)
        infos.append(info)
    return np.array(observations), np.array(rewards), infos


def states(infos):
    return np.array([info["state"] for info in infos])


def assert_same_episode(one, other):
    for a, b in zip(one[:2], other[:2], strict=True):
        np.testing.assert_array_equal(a, b)
    for a, b in zip(one[2], other[2], strict=True):
        assert a.keys() == b.keys()
        for key in a:
            np.testing.assert_array_equal(a[key], b[key])


# Its advice on bounds is not ours: volts are volts, and Gaussian noise has no bounds.
@pytest.mark.filterwarnings(r"ignore:.*(symmetric and normalized|probably too):UserWarning")
@every_preset
def test_gymnasiums_checker_passes(preset):
    for arguments in ({}, {"max_voltage": 5, "ambient_velocity": 0.1}):
        env = gym.make("BowThruster-v0", preset=preset, **arguments)
        check_env(env.unwrapped, skip_render_check=True)


@every_preset
def test_stable_baselines_checker_passes(preset):
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    checker.check_env(BowThrusterEnv(preset), warn=False, skip_render_check=True)


def test_arguments_are_those_of_plant_and_task_and_go_by_name():
    parameters = inspect.signature(BowThrusterEnv).parameters
    names = "preset dt max_voltage ambient_velocity process_noise_cov measurement_noise_cov initial_state sensors"
    names += " flow amplifier uncertainty reference tracking_weight energy_weight voltage_rate_weight"
    names += " render_mode render_size"
    assert list(parameters) == names.split()
    assert {name for name, one in parameters.items() if one.kind is not one.KEYWORD_ONLY} == {"preset"}
    for name, one in inspect.signature(make_plant).parameters.items():
        assert name == "substeps" or parameters[name].default == one.default
    env = BowThrusterEnv("tunnel_physical", dt=0.02, tracking_weight=2.0)
    assert (env.plant.dt, env.task.weights[0]) == (0.02, 2.0)
    for name in ("foo", "substeps"):
        with pytest.raises(TypeError, match=rf"^BowThrusterEnv.__init__\(\) got an unexpected .* '{name}'$"):
            BowThrusterEnv(**{name: 1})
    with pytest.raises(TypeError, match=r"^BowThrusterEnv.__init__\(\) too many positional arguments$"):
        BowThrusterEnv("tunnel", 0.01)


def test_what_the_env_returns_is_not_shared():
    voltages = actions(20)
    expected = episode(BowThrusterEnv(), voltages, seed=2)
    env = BowThrusterEnv()
    observation, info = env.reset(seed=2)
    arrays = []
    for k, voltage in enumerate(voltages):
        action = voltage.copy()
        now = [observation, info["state"], info["measurement"], action]
        assert not any(np.shares_memory(a, b) for a in arrays for b in now)
        arrays += now
        for array in arrays:
            array[:] = -7.0
        info.clear()
        observation, _, _, _, info = env.step(voltage)
        np.testing.assert_array_equal(info["state"], expected[2][k + 1]["state"])
        assert set(info) == INFO


def test_the_same_seed_gives_the_same_episode():
    voltages = actions(100)
    env = gym.make("BowThruster-v0")
    first = episode(env, voltages, seed=11)
    assert_same_episode(first, episode(env, voltages, seed=11))
    assert_same_episode(first, episode(gym.make("BowThruster-v0"), voltages, seed=11))
    assert (states(episode(env, voltages, seed=12)[2]) != states(first[2])).all()


def test_unseeded_resets_differ_and_follow_from_the_seed_before():
    def starts():
        env = gym.make("BowThruster-v0")
        return [tuple(env.reset(seed=seed)[1]["state"]) for seed in (5, None, None, None)]

    assert len(set(starts())) == 4
    assert starts() == starts()
    assert BowThrusterEnv().reset()[1]["state"][0] != BowThrusterEnv().reset()[1]["state"][0]


def test_noise_of_a_seed_does_not_depend_on_the_actions():
    noises = []
    for voltages in (actions(60, seed=1), actions(60, seed=2), np.zeros((60, 1), np.float32)):
        env = BowThrusterEnv()
        _, _, infos = episode(env, voltages, seed=8)
        x = states(infos)
        inputs = (voltages[:, 0].astype(float), 0.0)
        moved = run_substeps(tuple(x[:-1].T), inputs, TUNNEL, 0.01, env.plant.substeps)
        process = x[1:] - np.transpose(moved)
        measurement = [float(info["measurement"][0]) - info["thrust"] for info in infos]
        noises.append(np.concatenate([process.ravel(), measurement]))
    np.testing.assert_allclose(noises[1], noises[0], rtol=0, atol=1e-11)
    np.testing.assert_allclose(noises[2], noises[0], rtol=0, atol=1e-11)
    assert np.abs(noises[0]).min() > 0


def test_copies_of_a_vector_env_are_single_envs_with_the_next_seeds():
    voltages = actions(20)
    vector = gym.make_vec("BowThruster-v0", num_envs=3, vectorization_mode="sync")
    observations = [vector.reset(seed=40)[0]] + [vector.step(np.tile(v, (3, 1)))[0] for v in voltages]
    for i in range(3):
        expected, _, _ = episode(gym.make("BowThruster-v0"), voltages, seed=40 + i)
        np.testing.assert_array_equal(np.array(observations)[:, i], expected)


@pytest.mark.parametrize("direction", [(1, 0), (-1, 0), (0, 1), (0, -1)])
def test_a_state_a_hundred_times_beyond_its_range_terminates(direction):
    limit = 100 * state_range(TUNNEL, 24.0)
    for factor, ends in ((0.98, False), (1.02, True)):
        x = factor * limit * direction
        env = BowThrusterEnv(initial_state=x, dt=1e-7, process_noise_cov=[0, 0])  # too short to come back
        env.reset(seed=0)
        terminated = env.step([0.0])[2]
        assert terminated is ends


@pytest.mark.parametrize("x", [[1e6, 0.0], [0.0, 1e12], [1e50, 1e50]])
def test_a_state_that_is_not_finite_terminates(x):
    env = BowThrusterEnv(initial_state=x)
    env.reset(seed=0)
    with np.errstate(all="ignore"):
        _, _, terminated, truncated, info = env.step([0.0])
    assert terminated is True and truncated is False


@every_preset
@pytest.mark.parametrize("reference", [None, 3.0])
def test_reward_is_the_squared_error_of_the_true_thrust_and_the_cost_of_the_jump(preset, reference):
    env = gym.make("BowThruster-v0", preset=preset, reference=reference)
    voltages = actions(100, top=40.0)
    _, rewards, infos = episode(env, voltages, seed=9)
    p = PRESETS[preset]
    wanted = steady_state(p, 12.0).thrust if reference is None else reference
    assert all(info["reference"] == wanted for info in infos)
    clipped = np.concatenate([[0.0], np.clip(voltages[:, 0].astype(float), -24, 24)])
    thrusts = np.array([info["thrust"] for info in infos[1:]])
    expected = -(((thrusts - wanted) / steady_state(p, 24.0).thrust) ** 2) - 0.01 * (np.diff(clipped) / 24) ** 2
    np.testing.assert_allclose(rewards, expected, rtol=1e-12)


WRONG_ACTIONS = [
    math.nan,
    [math.nan],
    np.array([np.nan], np.float32),
    [],
    [1.0, 2.0],
    np.zeros(2, np.float32),
    np.zeros((2, 1)),
    "full",
    None,
    [1j],
]


@pytest.mark.parametrize("action", WRONG_ACTIONS, ids=repr)
def test_a_wrong_action_is_refused_and_changes_nothing(action):
    expected = episode(BowThrusterEnv(), actions(3), seed=4)
    env = BowThrusterEnv()
    env.reset(seed=4)
    with pytest.raises(ValueError, match="an action must be one voltage .*, but got "):
        env.step(action)
    for voltage, info in zip(actions(3), expected[2][1:], strict=True):
        np.testing.assert_array_equal(env.step(voltage)[4]["state"], info["state"])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"preset": "canoe"}, "preset must be one of .*, but got 'canoe'"),
        ({"measurement_noise_cov": -1}, "measurement_noise_cov must be positive semidefinite .*, but got -1"),
        ({"reference": math.nan}, "reference must be a finite number, but got nan"),
        ({"reference": "full ahead"}, "reference must be a finite number, but got 'full ahead'"),
        ({"render_mode": "ansi"}, "render_mode must be None or 'human' or 'rgb_array', but got 'ansi'"),
    ],
)
def test_a_wrong_argument_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        BowThrusterEnv(**arguments)
