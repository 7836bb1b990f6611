"""Paths, where a vehicle is on them, what it knows of that, and the controller to beat."""

import math

import gymnasium as gym
import numpy as np
import pytest

from thruster_env.auv.paths import MANOEUVRES, DepthAndCourse, make_path, run
from thruster_env.env.env import ObserveState, ObserveStateVector

PATH, DEPTH = "SegorogeniAUVPath-v0", "SegorogeniAUVDepth-v0"
SQUARE = [[0, 0, 1], [10, 0, 1], [10, 10, 3], [0, 10, 3]]
EXACT = {"process_noise_cov": [0.0] * 12, "measurement_noise_cov": [0.0] * 10, "initial_state": {"speed": 1.0}}
as_python = pytest.mark.usefixtures("as_python")


@pytest.mark.parametrize("name", MANOEUVRES)
def test_a_manoeuvre_ends_where_the_facts_say_and_its_path_goes_along_it(name):
    ends = {"I": (-2.415, 3.789, 0.114), "II": (20.752, 0.022, 3.770), "III": (21.143, 0.0, 0.063)}
    ends |= {"IV": (10.0, 18.0, 6.0), "dynamic": (19.01, -4.69, 0.02)}
    states = run(name)
    np.testing.assert_allclose(states[-1, 9:], ends[name], atol=6e-3)
    path = make_path(name)
    np.testing.assert_allclose(path.points[-1], states[-1, 9:], atol=1e-12)
    piece = 0
    for state in states[::10]:
        piece = path.piece(state[9:12], piece)
        across, below, _ = path.errors(state[9:12], state[8], piece)
        assert abs(across) < 4e-3 and abs(below) < 4e-3
    assert len(path.lengths) > 20 and piece >= len(path.lengths) - 2


def test_errors_are_to_starboard_below_and_clockwise_of_the_path():
    path = make_path(SQUARE)
    errors = path.errors(np.array([4.0, 1.0, 1.5]), np.array(0.3), np.array(0))  # north: east is to starboard
    np.testing.assert_allclose(errors, [1.0, 0.5, 0.3])
    errors = path.errors(np.array([9.0, 12.0, 3.0]), np.array(-math.pi), np.array(2))  # south: west is
    np.testing.assert_allclose(errors[:2], [-2.0, 0.0], atol=1e-12)
    assert abs(errors.course) < 1e-12


def test_progress_is_never_lost_and_goes_past_several_pieces():
    path = make_path(SQUARE, depth=2.0)
    assert path.points[0, 2] == 3.0
    pieces = path.piece(np.array([[5.0, 0, 1], [11.0, 5.0, 2], [12.0, 12.0, 3], [-90.0, 0, 0]]), np.zeros(4))
    np.testing.assert_array_equal(pieces, [0, 1, 2, 0])
    assert path.piece(np.zeros(3), np.array(2)) == 2 and path.piece(np.array([-50.0, 10.0, 3.0]), np.array(2)) == 2


@as_python
def test_the_env_finds_the_errors_that_the_path_has():
    env = ObserveState(gym.make(PATH, path=SQUARE, **EXACT))
    path, piece = env.unwrapped.task.path, 0
    env.reset(seed=0, options={"state": [1.0] + [0.0] * 7 + [0.9, 7.0, -1.0, 0.5]})
    for _ in range(120):
        *_, info = env.step([4.0, 0.05, -0.02])
        state = info["state"]
        piece = path.piece(state[9:12], piece)
        across, below, _ = path.errors(state[9:12], state[8], piece)
        np.testing.assert_allclose(info["path_errors"], [across, below], rtol=1e-9, atol=1e-12)
        assert info["path_piece"] == piece
    assert piece == 1


@as_python
def test_without_noise_the_vehicles_own_reckoning_is_the_truth():
    sensors = {name: [] for name in ("u", "v", "w", "p", "q", "r", "phi", "theta", "psi", "z")}
    env = gym.make(PATH, sensors=sensors, **EXACT)
    env.reset(seed=0)
    for k in range(200):
        observation, *_, info = env.step([3.0, 0.1 * math.sin(0.1 * k), 0.1])
    np.testing.assert_allclose(info["reckoned"], info["state"][[9, 10, 11, 8]], atol=2e-3)
    np.testing.assert_allclose(observation[-5:-3], info["path_errors"], atol=2e-3)
    u = info["state"][0]
    assert observation[-1] == pytest.approx(u - 1.0, abs=1e-6)
    assert observation[-3] ** 2 + observation[-2] ** 2 == pytest.approx(1.0, abs=1e-6)


@as_python
def test_the_observation_follows_from_measurements_and_never_from_the_true_position():
    """Two vehicles whose position differs by what no sensor sees have one and the same observation."""
    sensors = {name: [] for name in ("u", "v", "w", "q", "r", "phi", "theta")}
    noise = {"measurement_noise_cov": [1e-4] * 7, "process_noise_cov": [0.0] * 12}
    seen, errors = [], []
    for north in (0.0, 3.0):
        env = gym.make(PATH, sensors=sensors, initial_state={"speed": 1.0}, **noise)
        env.reset(seed=3)
        env.unwrapped._copies.memory[0, 6 + 9, 0] += north
        step = [env.step([2.0, 0.05, -0.1]) for _ in range(30)]
        seen.append([one[0] for one in step]), errors.append(step[-1][-1]["path_errors"])
    np.testing.assert_array_equal(seen[0], seen[1])
    assert np.abs(errors[0] - errors[1]).max() > 0.1


@as_python
def test_depth_steps_by_its_size_at_its_time_and_stays_within_twice_of_it():
    env = gym.make(DEPTH, hold_time=0.25, step_size=2.0, depth=6.0, sensors={"z": []}, measurement_noise_cov=[0.0])
    observation, info = env.reset(seed=0)
    levels, told = [], []
    for _ in range(300):
        told.append(observation[-6])
        observation, _, _, _, info = env.step([2.8, 0.0, 0.0])
        levels.append(info["state"][11] - info["path_errors"][1])
    np.testing.assert_allclose(told, levels, atol=1e-5)  # observation k has the depth of the next step
    steps = np.diff(np.round(levels, 6))
    np.testing.assert_array_equal(np.flatnonzero(steps) % 5, 3)
    assert set(np.abs(steps[steps != 0])) == {2.0} and set(np.round(levels)) == {2.0, 4.0, 6.0, 8.0, 10.0}


def episode(env, controller=None, steps=400):
    """Mean return of the episodes of a vector env."""
    observations, _ = env.reset(seed=0)
    total, state, action = 0.0, None, np.tile([2.845, 0.0, 0.0], (env.num_envs, 1)).astype(np.float32)
    for _ in range(steps):
        if controller is not None:
            action, state = controller.predict(observations, state)
        observations, rewards, terminated, *_ = env.step(action)
        assert not terminated.any()
        total += rewards.mean()
    return total


# A step of the depth costs whoever follows it.
@pytest.mark.parametrize(
    "name, path, share", [(PATH, "I", 0.02), (PATH, "IV", 0.02), (PATH, "dynamic", 0.05), (DEPTH, None, 0.6)]
)
def test_pd_on_measurements_beats_holding_the_planes_still(name, path, share):
    given = {} if path is None else {"path": path}
    env = gym.make_vec(name, 4, **given)
    pd = episode(env, DepthAndCourse.for_env(env))
    true = ObserveStateVector(gym.make_vec(name, 4, **given))
    on_truth = episode(true, DepthAndCourse.for_env(true, "navigation"))
    still = episode(env)
    assert pd > share * still and on_truth > share * still
    assert on_truth == pytest.approx(pd, rel=0.2, abs=3.0)


@pytest.mark.parametrize(("name", "spread"), [(PATH, 0.34), (DEPTH, 0.72)])
def test_the_reward_threshold_is_what_pd_on_measurements_has(name, spread):
    """The mean of 100 episodes has a standard error of `spread`."""
    env, spec = gym.make_vec(name, 100), gym.spec(name)
    found = episode(env, DepthAndCourse.for_env(env), spec.max_episode_steps)
    assert found == pytest.approx(spec.reward_threshold, abs=3 * spread)
    assert gym.spec("SegorogeniAUV-v0").reward_threshold is None  # nobody sees its path


@as_python
def test_a_controller_takes_one_observation_or_many_and_forgets_where_an_episode_starts():
    env = gym.make_vec(PATH, 2, path="IV")
    controller = DepthAndCourse.for_env(env)
    observations, _ = env.reset(seed=0)
    actions, state = controller.predict(observations)
    for i in range(2):
        action, of_one = controller.predict(observations[i])
        np.testing.assert_array_equal(action, actions[i])
        np.testing.assert_array_equal(of_one, state[i])
    assert actions.dtype == np.float32 and env.action_space.contains(actions)
    observations = env.step(actions)[0]
    fresh, _ = controller.predict(observations)
    mixed, _ = controller.predict(observations, state + 1.0, np.array([True, False]))
    np.testing.assert_array_equal(mixed[0], fresh[0])
    assert not np.array_equal(mixed[1], fresh[1])


@as_python
def test_a_controller_needs_a_path_and_its_sensors():
    with pytest.raises(ValueError, match="an env must observe its path, as SegorogeniAUVPath-v0 does, but got"):
        DepthAndCourse.for_env(gym.make("SegorogeniAUV-v0"))
    with pytest.raises(
        ValueError, match="sensors must include u, q, r and theta for a controller without a filter"
    ):
        DepthAndCourse.for_env(gym.make(PATH, sensors="papers"))
    with pytest.raises(ValueError, match="seen must be one of measurement, motion, navigation, but got 'stars'"):
        DepthAndCourse.for_env(gym.make(PATH), "stars")
