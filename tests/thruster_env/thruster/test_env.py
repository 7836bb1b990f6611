import importlib
import inspect
import json
import math
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec

import thruster_env
from thruster_env import PRESETS, BowThrusterEnv
from thruster_env.thruster.analysis import run_substeps, state_range, steady_state
from thruster_env.thruster.parameters import TUNNEL, TUNNEL_PHYSICAL
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


def test_spaces_are_one_voltage_in_and_one_thrust_out():
    env = gym.make("BowThruster-v0")
    assert env.action_space == gym.spaces.Box(-24.0, 24.0, (1,), np.float32)
    assert env.observation_space == gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)
    assert BowThrusterEnv(max_voltage=5.0).action_space == gym.spaces.Box(-5.0, 5.0, (1,), np.float32)


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


def test_results_have_the_types_of_the_interface():
    env = gym.make("BowThruster-v0")
    observation, info = env.reset(seed=0)
    step = env.step(actions(1)[0])
    for seen, told in ((observation, info), (step[0], step[4])):
        assert seen.shape == (1,) and seen.dtype == np.float32
        assert set(told) == INFO
        assert told["state"].shape == (2,) and told["state"].dtype == np.float64
        assert told["measurement"].shape == (1,) and told["measurement"].dtype == np.float64
        assert all(type(told[key]) is np.float64 for key in ("thrust", "reference", "time"))
        assert seen[0] == np.float32(told["measurement"][0])
    assert (type(step[1]), type(step[2]), type(step[3])) == (float, bool, bool)


def test_time_counts_the_steps():
    _, _, infos = episode(gym.make("BowThruster-v0", dt=0.02), actions(5), seed=1)
    np.testing.assert_allclose([info["time"] for info in infos], 0.02 * np.arange(6), rtol=1e-12)


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


@every_preset
def test_an_ordinary_episode_is_truncated_after_500_steps(preset):
    env = gym.make("BowThruster-v0", preset=preset)
    env.reset(seed=6)
    ends = [env.step(voltage)[2:4] for voltage in np.where(actions() > 0, 24.0, -24.0).astype(np.float32)]
    assert ends == [(False, False)] * 499 + [(False, True)]


def test_the_class_itself_has_no_time_limit():
    env = BowThrusterEnv()
    env.reset(seed=6)
    assert not any(env.step([1.0])[3] for _ in range(510))


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


def test_a_thrust_beyond_float32_does_not_warn():
    env = BowThrusterEnv(initial_state=[1e25, 0.0])
    assert np.isinf(env.reset(seed=0)[0]).all()


def test_a_slow_thruster_in_a_fast_flow_is_not_absurd():
    env = BowThrusterEnv("open_bladed", ambient_velocity=5.0)
    env.reset(seed=0)
    assert not any(env.step([12.0])[2] for _ in range(400))


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


@pytest.mark.parametrize(
    "initial_state",
    [[150.0, 2.0], {"voltage": -6.0}, {"mean": [150.0, 2.0], "cov": [0.0, 0.0]}],
    ids=["fixed", "steady", "mean"],
)
def test_an_episode_starts_where_it_was_told(initial_state):
    x = BowThrusterEnv(initial_state=initial_state).reset(seed=1)[1]["state"]
    expected = steady_state(TUNNEL, -6.0)[:2] if "voltage" in initial_state else (150.0, 2.0)
    assert tuple(x) == expected


@pytest.mark.parametrize(
    "action", [6.0, [6.0], np.float32(6.0), np.array(6.0), np.array([6.0], np.float32)], ids=repr
)
def test_one_voltage_may_come_in_any_shape(action):
    env = BowThrusterEnv()
    env.reset(seed=4)
    state = env.step(action)[4]["state"]
    env.reset(seed=4)
    np.testing.assert_array_equal(state, env.step(np.array([6.0]))[4]["state"])


@pytest.mark.parametrize("action", [np.inf, 1e30, 25.0])
def test_a_voltage_beyond_the_maximum_is_the_maximum(action):
    env = BowThrusterEnv()
    for sign in (1, -1):
        env.reset(seed=4)
        given = np.array([sign * action])
        state = env.step(given)[4]["state"]
        assert given[0] == sign * action  # the caller's array
        env.reset(seed=4)
        np.testing.assert_array_equal(state, env.step([sign * 24.0])[4]["state"])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"reference": math.nan}, "reference must be a finite number, but got nan"),
        ({"reference": "full ahead"}, "reference must be a finite number, but got 'full ahead'"),
        ({"render_mode": "ansi"}, "render_mode must be None or 'human' or 'rgb_array', but got 'ansi'"),
    ],
)
def test_a_wrong_argument_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        BowThrusterEnv(**arguments)


@pytest.mark.parametrize(
    "arguments",
    [
        {},
        {"preset": "tunnel_physical", "dt": 0.02, "max_voltage": 12, "ambient_velocity": 0.2, "reference": 2.0},
        {"preset": TUNNEL_PHYSICAL._asdict()},
        {"preset": TUNNEL_PHYSICAL},
        {"process_noise_cov": [[1.0, 0.01], [0.01, 4e-4]], "measurement_noise_cov": 0.5},
        {"process_noise_cov": [0.0, 0.0], "initial_state": {"mean": [1.0, 0.0], "cov": [1.0, 0.0]}},
        {"initial_state": {"voltage": 3.0}},
    ],
    ids=["plain", "numbers", "mapping", "parameters", "covariances", "distribution", "steady"],
)
def test_an_env_survives_json(arguments):
    env = gym.make("BowThruster-v0", **arguments)
    text = env.spec.to_json()
    again = gym.make(EnvSpec.from_json(text))
    assert again.unwrapped.plant.parameters == env.unwrapped.plant.parameters
    assert_same_episode(episode(env, actions(30), seed=5), episode(again, actions(30), seed=5))
    assert EnvSpec.from_json(again.spec.to_json()) == EnvSpec.from_json(text)


def test_parameters_are_kept_as_a_mapping():
    env = gym.make("BowThruster-v0", preset=TUNNEL_PHYSICAL)
    assert env.spec.kwargs["preset"] == TUNNEL_PHYSICAL._asdict()
    assert json.loads(env.spec.to_json())["kwargs"]["preset"]["angles"] == "rotor-plane"
    assert "preset" not in gym.spec("BowThruster-v0").kwargs


def test_importing_twice_registers_once(recwarn):
    importlib.reload(thruster_env)
    assert not [w for w in recwarn if "BowThruster" in str(w.message)]
    assert gym.spec("BowThruster-v0").max_episode_steps == 500


def test_the_id_with_the_package_name_imports_the_package():
    code = (
        "import gymnasium as gym; env = gym.make('thruster_env:BowThruster-v0', preset='tunnel'); "
        "print(env.spec.max_episode_steps, env.reset(seed=3)[1]['state'].tolist())"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    state = gym.make("BowThruster-v0").reset(seed=3)[1]["state"].tolist()
    assert result.stdout.strip() == f"500 {state}"


def test_a_picture_shows_what_a_step_reports():
    env = BowThrusterEnv(ambient_velocity=0.2, sensors=["speed", "thrust"], render_mode="rgb_array")
    env.reset(seed=1)
    *_, info = env.step(np.array([9.0]))
    shown = env.moment_of(env._report.tolist())
    assert (shown.omega_m, shown.U_a) == tuple(info["state"])
    assert shown.measured_thrust == info["measurement"][1] and shown.voltage == 9.0
    assert all(getattr(shown, name) == info[name] for name in ("time", "thrust", "reference", "ambient_velocity"))
    env.close()
