"""Models by name as text: their settings, and around an env whose actions they ignore."""

import gymnasium as gym
import numpy as np
import pytest

import filters
from filters.models import kalman_filter
from filters.named import model_for_step, model_named
from filters.plants import pendulum


@pytest.mark.parametrize(
    ("text", "values", "axes"),
    [
        ("constant-velocity", {}, 1),
        ("Constant-Velocity:axes=2, R=0.25", {"R": 0.25}, 2),
        ("oscillator:std=2 + ornstein-uhlenbeck:std=1e+3,time_constant=4", {}, 1),
        ("constant:drift=2e-3 + harmonic:period=24,harmonics=2", {"constant_drift": 2e-3}, 1),
    ],
)
def test_settings_are_numbers_of_the_model_its_axes_or_those_of_its_name(text, values, axes):
    maker = model_named(text)
    assert len(maker.quantities) == axes and set(maker.values) <= set(maker.names)
    assert {name: maker.values[name] for name in values} == values
    assert model_named(maker.name).names == maker.names


def test_a_named_model_is_that_of_the_kalman_filter_of_its_numbers():
    model = model_for_step("constant-velocity:axes=2,acceleration=0.04,R=0.25", 0.1)()
    expected = kalman_filter("constant-velocity", dt=0.1, noise=0.25, axes=2, acceleration=0.04).model
    for name in ("process_noise_cov", "measurement_noise_cov", "prior_cov", "constants"):
        np.testing.assert_array_equal(getattr(model, name), getattr(expected, name))
    swinging = model_for_step("pendulum:length=0.4", 0.01)(damping=0.2)
    assert swinging.digest == pendulum(length=0.4, damping=0.2).at(0.01).digest


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("constant:axes=0", "axes of constant must be positive"),
        ("constant:drift=x", "drift of constant must be"),
        ("constant-velocity:jerk=1", "a setting of constant-velocity must be one of acceleration, R"),
        ("pendulum:long=1", "a setting of pendulum must be one of length"),
        ("pendulum:length=", "length of pendulum must be a finite number"),
        ("pendulum:length=1,length=2", "KEY=VALUE, each once"),
    ],
)
def test_a_wrong_setting_is_named_with_those_that_are_right(text, message):
    with pytest.raises(ValueError, match=message):
        model_named(text)


def test_texts_that_are_no_names_are_left_to_others():
    assert [model_named(text) for text in ("oscillator:plant", "my_module:model", "mine", 3)] == [None] * 4
    with pytest.raises(ValueError, match="constant must come with drift, R, as constant:drift=...,R=..., but"):
        model_named("constant")(dt=0.1)


class Drifting(gym.Env):
    """A level that random steps move, whatever the action."""

    action_space = gym.spaces.Box(-1.0, 1.0, (2,))
    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.level = 0.0
        return np.zeros(1), {}

    def step(self, action):
        self.level += 0.1 * self.np_random.normal()
        return np.array([self.level + self.np_random.normal()]), 0.0, False, False, {}


def test_a_filter_of_a_model_without_inputs_ignores_the_actions(as_python):
    name = "constant:drift=0.01,R=1,dt=1"
    env = filters.EstimateState(Drifting(), "kf", model=name)
    assert env.observation_space.shape == (1,) and env.get_wrapper_attr("filter").model.inputs == 0
    copies = filters.EstimateStates(gym.vector.SyncVectorEnv([Drifting] * 2), "kf", model=name)
    copies.reset(seed=3)
    env.reset(seed=3)
    for _ in range(3):
        single = env.step(np.zeros(2))[4]["estimate"]
        several = copies.step(np.ones((2, 2)))[4]["estimate"]
    np.testing.assert_allclose(several[0], single, rtol=1e-12)
    env = filters.EstimateState(gym.make("BowThruster-v0"), "kf", model="constant:drift=1,R=0.25")  # of its dt
    assert env.filter.model.process_noise_cov[0, 0] == pytest.approx(env.unwrapped.plant.dt)
    with pytest.raises(ValueError, match="must have a sample time, but .* has no dt here: constant:dt=..."):
        filters.EstimateState(Drifting(), model="constant:drift=0.01,R=1")
