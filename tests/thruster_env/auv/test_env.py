"""The vehicle's env: its interface, its noise, its reward and its ends."""

import json
import math
import tomllib
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import thruster_env.auv  # noqa: F401 - registers the envs
from filters import EstimateState
from thruster_env.auv.equations import simulate as simulate_plant
from thruster_env.auv.plant import make_plant
from thruster_env.core.streams import draw_key
from thruster_env.model.simulate import simulate

IDS = ["SegorogeniAUV-v0", "SegorogeniAUVPath-v0", "SegorogeniAUVDepth-v0"]
every_id = pytest.mark.parametrize("name", IDS)
CRUISE = np.array([2.845, 0.0, 0.0])
EXACT = {"process_noise_cov": [0.0] * 12, "initial_state": {"speed": 1.0}}
DISTURBED = {
    "sensors": {
        "u": [{"name": "outliers", "std": 0.5}, {"name": "sample-every", "steps": 3}],
        "theta": [{"name": "bias", "std": 0.01, "drift": 0.001}, {"name": "dropout", "probability": 0.3}],
        "q": [{"name": "delay", "steps": 2}],
        "r": [{"name": "quantisation", "step": 0.001}],
        "x_gps": [{"name": "near-surface"}, {"name": "student-t", "scale": 0.3}],
    },
    "current": {"north": 0.2, "east": [{"name": "gauss-markov", "std": 0.1, "time_constant": 5.0}]},
    "plane_lag": 0.1,
    "propeller_lag": 1.0,
}
pytestmark = pytest.mark.usefixtures("as_python")


def rng(seed=0):
    return np.random.default_rng(seed)


def some_actions(count, seed=0):
    low, high = [0.0, -0.25, -0.25], [4.0, 0.25, 0.25]
    return rng(seed).uniform(low, high, (count, 3)).astype(np.float32)


def infos_of(env, actions, **reset):
    _, info = env.reset(**reset)
    return [info] + [env.step(action)[-1] for action in actions]


@every_id
def test_gymnasiums_checker_passes(name):
    check_env(gym.make(name, **DISTURBED).unwrapped, skip_render_check=True)


@every_id
def test_stable_baselines_checker_passes(name, recwarn):
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    checker.check_env(gym.make(name).unwrapped, skip_render_check=True)


def test_spaces_are_those_that_the_class_says():
    env = gym.make("SegorogeniAUV-v0")
    np.testing.assert_allclose(env.action_space.high, [4.0, math.radians(15), math.radians(15)], rtol=1e-6)
    np.testing.assert_allclose(env.action_space.low, [0.0, -math.radians(15), -math.radians(15)], rtol=1e-6)
    assert env.observation_space.shape == (10 + 4,) and env.unwrapped.appended_entries == 4
    assert gym.make("SegorogeniAUVPath-v0").observation_space.shape == (14 + 6,)
    assert gym.make("SegorogeniAUV-v0", propeller_torque=None).action_space.shape == (4,)
    assert {gym.spec(name).max_episode_steps for name in IDS} == {1200, 600}
    content = tomllib.loads((Path(__file__).parents[3] / "pyproject.toml").read_text())
    assert content["project"]["entry-points"]["filters.plants"] == {"thruster_env": "thruster_env"}


def test_truth_and_measurements_are_those_of_the_model_with_the_same_key():
    env, actions = gym.make("SegorogeniAUV-v0"), some_actions(9)
    infos = infos_of(env, actions, seed=5)
    key = draw_key(gym.utils.seeding.np_random(5)[0])
    model = env.unwrapped.state_space_model()
    expected = simulate(model, key[None], actions[None].astype(np.float64))
    np.testing.assert_allclose([i["state"] for i in infos], expected.states[0], rtol=1e-12, atol=1e-14)
    valid = np.array([i["measurement_valid"] for i in infos])
    found = np.array([i["measurement"] for i in infos])
    np.testing.assert_allclose(found[valid], expected.measurements[0][valid], rtol=1e-12, atol=1e-14)
    assert model.n == 12 and infos[-1]["time"] == pytest.approx(0.45)


@pytest.mark.parametrize("given", [{}, DISTURBED], ids=["plain", "disturbed"])
def test_a_simulated_batch_is_the_env(given):
    env, actions = gym.make("SegorogeniAUV-v0", **given), some_actions(8)
    infos = infos_of(env, actions, seed=4)
    key = draw_key(gym.utils.seeding.np_random(4)[0])
    run = simulate_plant(make_plant(**given), key[None], actions[None].astype(np.float64))
    np.testing.assert_allclose(run.states[0], [i["state"] for i in infos], rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(run.measurements[0], [i["measurement"] for i in infos], rtol=1e-12, atol=1e-14)
    np.testing.assert_array_equal(run.valid[0], [i["measurement_valid"] for i in infos])
    with pytest.raises(ValueError, match=r"inputs must be without NaN and of shape \(1, K, 3\)"):
        simulate_plant(make_plant(), key[None], np.zeros((1, 5)))


def test_commands_are_clipped_for_the_filter_too():
    env = gym.make("SegorogeniAUV-v0", **EXACT)
    beyond, within = np.array([99.0, 1.0, -1.0]), env.action_space.high * [1.0, 1.0, -1.0]
    states, means = [], []
    for action in (beyond, within):
        wrapped = EstimateState(gym.make("SegorogeniAUV-v0", **EXACT), "ekf")
        wrapped.reset(seed=1)
        info = wrapped.step(action)[-1]
        states.append(info["state"]), means.append(info["estimate"])
        np.testing.assert_allclose(info["inputs"], [4.0, -0.024, within[1], within[2]], rtol=1e-6)
    np.testing.assert_allclose(states[0], states[1], rtol=0, atol=1e-7)
    np.testing.assert_allclose(means[0], means[1], rtol=0, atol=1e-7)


def test_lags_are_of_first_order_and_off_by_default():
    env = gym.make("SegorogeniAUV-v0", plane_lag=0.1, propeller_lag=1.0)
    infos = infos_of(env, [np.array([2.0, 0.1, -0.2])] * 4, seed=0)
    past = 0.05 * np.arange(5)
    reached = np.stack([1 - np.exp(-past / 1.0), 1 - np.exp(-past / 0.1)])
    expected = np.stack([2.0 * reached[0], -0.012 * reached[0], 0.1 * reached[1], -0.2 * reached[1]], axis=-1)
    np.testing.assert_allclose([i["inputs"] for i in infos], expected, rtol=1e-12, atol=1e-15)
    plain = infos_of(gym.make("SegorogeniAUV-v0"), [np.array([2.0, 0.1, -0.2])], seed=0)
    np.testing.assert_allclose(plain[-1]["inputs"], [2.0, -0.012, 0.1, -0.2])


def test_a_free_torque_is_an_input_of_env_and_model():
    env = gym.make("SegorogeniAUV-v0", propeller_torque=None, preset="segorogeni_papers", **EXACT)
    info = infos_of(env, [np.array([2.845, 0.02, 0.0, 0.1])], seed=0)[-1]
    np.testing.assert_allclose(info["inputs"], [2.845, 0.02, 0.0, 0.1])
    assert env.unwrapped.state_space_model().inputs == 4 and info["state"][3] > 0.0


def test_reward_has_its_four_terms():
    env = gym.make("SegorogeniAUV-v0", **EXACT)
    env.reset(seed=0, options={"state": [0.8, 0, 0, 0, 0, 0, 0, 0, 0, 5.0, 2.0, -3.0]})
    _, reward, _, _, info = env.step(np.array([0.0, 0.1, -0.05]))
    y, z, u = info["state"][10], info["state"][11], info["state"][0]
    np.testing.assert_allclose(info["path_errors"], [y, z], rtol=1e-12)
    planes = (0.1**2 + 0.05**2) / math.radians(15) ** 2
    assert reward == pytest.approx(-(y**2 + z**2 + 0.1 * (u - 1) ** 2 + 0.01 * planes), rel=1e-9)


@pytest.mark.parametrize("theta, ends", [(1.39, False), (1.41, True), (-1.41, True), (math.nan, True)])
def test_a_pitch_beyond_80_degrees_ends_an_episode(theta, ends):
    env = gym.make("SegorogeniAUV-v0", **EXACT)
    env.reset(seed=0)
    env.unwrapped._copies.memory[0, 6 + 7, 0] = theta
    env.unwrapped._copies.memory[0, 6, 0] = 0.0
    observation, reward, terminated, *_ = env.step(np.zeros(3))
    assert terminated == ends and np.isfinite(reward) and not np.isnan(observation).any()


def test_episodes_begin_where_they_are_told():
    mean = [i["state"] for i in (gym.make("SegorogeniAUV-v0").reset(seed=s)[1] for s in range(200))]
    np.testing.assert_allclose(np.mean(mean, axis=0), np.eye(12)[0], atol=0.012)
    np.testing.assert_allclose(np.std(mean, axis=0), [0.05] + [0.02] * 5 + [0.01] * 6, rtol=0.2)
    rest = gym.make("SegorogeniAUV-v0", initial_state={"speed": 0.0}).reset(seed=0)[1]["state"]
    np.testing.assert_array_equal(rest, np.zeros(12))
    state = rng().uniform(-0.5, 0.5, 12)
    env = gym.make("SegorogeniAUV-v0")
    np.testing.assert_allclose(env.reset(seed=0, options={"state": state})[1]["state"], state)
    assert not np.allclose(env.reset()[1]["state"], state)
    depth = gym.make("SegorogeniAUVDepth-v0", depth=3.0, **EXACT).reset(seed=0)[1]["state"]
    assert depth[11] == 3.0


def test_the_same_seed_gives_the_same_episode_and_the_action_leaves_the_noise_alone():
    one, two = (infos_of(gym.make("SegorogeniAUV-v0", **DISTURBED), some_actions(5), seed=3) for _ in range(2))
    np.testing.assert_equal(one, two)
    other = infos_of(gym.make("SegorogeniAUV-v0", **DISTURBED), some_actions(5, 1), seed=3)
    np.testing.assert_equal([i["current"] for i in other], [i["current"] for i in one])


@every_id
def test_an_env_survives_json(name):
    env = gym.make(name, **DISTURBED)
    content = env.spec.to_json()
    assert json.loads(content)["kwargs"]["plane_lag"] == 0.1
    again = gym.make(gym.envs.registration.EnvSpec.from_json(content))
    np.testing.assert_equal(infos_of(again, some_actions(3), seed=2), infos_of(env, some_actions(3), seed=2))


WRONG = [
    ({"sensors": {"u": [{"name": "fog"}]}}, "each entry of sensors must be a mapping whose name is one of"),
    ({"preset": "titanic"}, "preset must be one of segorogeni"),
    ({"current": [0.1, 0.2]}, r"current must be three velocities \(north, east, down\)"),
    ({"current": {"west": 1.0}}, "directions of current must be among north, east, down, but got"),
    ({"current": {"north": 1000.0}}, "the current north must be within plus and minus 100, but got"),
    ({"plane_lag": -1.0}, "plane_lag must be zero or positive, but got -1.0"),
    ({"path": "V"}, "path must be one of I, II, III, IV, dynamic, but got 'V'"),
    ({"path": [[0, 0, 0]]}, "path must be a manoeuvre's name or two or more points of three finite numbers"),
    ({"path": [[0, 0, 0], [0, 0, 9]]}, "each piece of path must lead somewhere else than up or down"),
    ({"depth": math.nan}, "depth must be a finite number, but got nan"),
    ({"vertical_weight": -1}, "vertical_weight must be zero or positive, but got -1"),
    ({"render_mode": "ascii"}, "render_mode must be None or 'human' or 'rgb_array', but got 'ascii'"),
]


@pytest.mark.parametrize("given, rule", WRONG, ids=range(len(WRONG)))
def test_a_wrong_argument_is_refused_in_one_line(given, rule):
    for make in (gym.make, lambda name, **more: gym.make_vec(name, 2, **more)):
        if "render_mode" not in given or make is gym.make:
            with pytest.raises(ValueError, match=rule) as error:
                make("SegorogeniAUVPath-v0", **given)
            assert "\n" not in str(error.value)


def test_a_wrong_mass_matrix_and_a_wrong_action_are_refused():
    preset = thruster_env.auv.PRESETS["segorogeni"]._asdict() | {"Ix": -1.0}
    with pytest.raises(ValueError, match="Ix must be zero or positive"):
        gym.make("SegorogeniAUV-v0", preset=preset)
    with pytest.raises(ValueError, match="the mass matrix must be positive definite, but got the smallest"):
        gym.make("SegorogeniAUV-v0", preset=preset | {"Ix": 0.0, "Kpd": 1.0})
    env = gym.make("SegorogeniAUV-v0").unwrapped
    env.reset(seed=1)
    rule = r"an action must be 3 numbers and not NaN \(thrust \[N\], stern plane \[rad\], rudder \[rad\]\)"
    for action in ([1.0], [1.0, 0.0, math.nan], "no"):
        with pytest.raises(ValueError, match=rule):
            env.step(action)


@pytest.mark.parametrize("sensors, states", [("default", 12), ("motion", 8), ("papers", 8), ("full", 12)])
def test_the_env_offers_the_smaller_model_that_predicts_all_channels(sensors, states):
    env = EstimateState(gym.make("SegorogeniAUV-v0", sensors=sensors), filter="ekf")
    assert env.filter.model.n == states
    observation, info = env.reset(seed=0)
    flags = env.unwrapped.appended_entries
    assert observation.shape == (states + flags,) and info["estimate_cov"].shape == (states, states)


def test_six_velocities_are_a_model_of_the_papers_sensors():
    arguments = {"states": "velocities"}
    env = EstimateState(gym.make("SegorogeniAUV-v0", sensors="papers"), filter="ekf", model_arguments=arguments)
    env.reset(seed=0)
    assert env.filter.model.n == 6 and np.isfinite(env.step(CRUISE)[-1]["estimate"]).all()


def test_a_model_that_cannot_predict_a_channel_is_refused():
    env = gym.make("SegorogeniAUV-v0")
    with pytest.raises(ValueError, match="sensors of a model of 8 states must measure u, v, .*but got psi, z"):
        EstimateState(env, filter="ekf", model_arguments={"states": "motion"})
    with pytest.raises(ValueError, match="arguments of a vehicle's model must be among states, "):
        EstimateState(env, filter="ekf", model_arguments={"shape": "round"})
