"""Models by name as text: their settings, and around an env whose actions they ignore."""

import pickle

import gymnasium as gym
import numpy as np
import pytest

import filters
from filters.models import NAMED, named_model
from filters.named import axes_named, is_model_name, model_named, text_of
from filters.plants import pendulum
from filters.wrappers.arguments import model_for_step


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


SUMS = "constant + harmonic", "constant + harmonic:period=86400,harmonics=2", "harmonic + ar:2", "ar:1 + harmonic"
SUMS += "constant-velocity + oscillator", "ornstein-uhlenbeck + oscillator", "oscillator + seasonal:period=12"


@pytest.mark.parametrize("name", [*NAMED, *SUMS, "ar:3", "harmonic", "seasonal:period=1.2e+01,seasons=12"])
def test_a_text_of_numbers_gives_the_model_of_these_numbers(name):
    model = named_model(name)
    values = {number.name: 1.234567e5 / 7.0**i for i, number in enumerate(model.free)}
    values |= {number.name: -0.4 for number in model.free if not number.log}
    values |= {"frequency": 1e-5} if "frequency" in values else {}
    text = text_of(name, {**values, "R": 2e-7}, 2, -3.5)
    expected = model.model(values, 2e-7, 1.0, offset=-3.5, quantities=axes_named("z", 2))
    assert is_model_name(text) and "e+" not in text.replace(name, "")
    model = model_named(text)(dt=1.0)
    for parsed, matrix in zip(model.matrices(), expected.matrices(), strict=True):
        np.testing.assert_allclose(parsed, matrix, rtol=1e-5, atol=1e-9)
    q = expected.process_noise_cov
    np.testing.assert_allclose(model.process_noise_cov, q, rtol=1e-5, atol=1e-6 * np.abs(q).max())
    np.testing.assert_allclose(model.measurement_noise_cov, expected.measurement_noise_cov, rtol=1e-5)


def test_a_text_with_numbers_is_the_named_model_of_these():
    model = model_for_step("constant-velocity:axes=2,acceleration=0.04,R=0.25", 0.1)()
    axes = axes_named("z", 2)
    expected = named_model("constant-velocity").model({"acceleration": 0.04}, 0.25, 0.1, quantities=axes)
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
        ("constant:drift=1,drift=2", "settings of constant must be KEY=VALUE, each once"),
        ("constant:R=1 + oscillator:R=2", "each once, but got 'R=2' again"),
        ("harmonic:period=24,period=12", "may have period=SECONDS"),
        ("oscillator:axes=2,mean_1=3", "one for each axis, mean_1, mean_2, or one for all"),
    ],
)
def test_a_wrong_setting_is_named_with_those_that_are_right(text, message):
    with pytest.raises(ValueError, match=message):
        model_named(text)


@pytest.mark.parametrize("text", ["oscillator:frequency=1,damping=0.1", "ornstein-uhlenbeck:time_constant=3"])
def test_a_signal_about_a_mean_begins_there_with_its_stationary_covariance(text):
    model = model_named(f"{text},std=2,R=1,axes=2,mean_1=100,mean_2=-300")(dt=0.1)
    np.testing.assert_array_equal(model.prior_mean, np.zeros(model.n))
    np.testing.assert_array_equal(model.matrices()[4], [100.0, -300.0])
    for order in ("ornstein-uhlenbeck + constant", "constant + ornstein-uhlenbeck"):
        values = {"drift": 0.1, "time_constant": 3.0, "std": 2.0}
        model = named_model(order).model(values, 1.0, 0.1, first=1000.0, spread=5.0)
        of = {state.symbol: i for i, state in enumerate(model.states)}
        assert model.prior_mean[of["level"]] == 1000.0 and model.prior_mean[of["deviation"]] == 0.0
        assert model.prior_cov[of["deviation"], of["deviation"]] == pytest.approx(4.0)
    with pytest.raises(ValueError, match="partial_1 must be between -1 and 1, but got 1.5"):
        named_model("ar:1").model({"partial_1": 1.5, "std": 1.0}, 1.0, 1.0)


def test_every_cosine_of_a_season_has_the_same_noise_and_its_rows_are_a_season_apart():
    signal = named_model("seasonal:period=12,seasons=4").signal({"drift": 0.3})
    noise = np.diag(signal.noise(3.0))
    assert noise[[0, 1, 2]] == pytest.approx(0.9)
    with pytest.raises(ValueError, match="must be 3 s apart, or multiples, .* but got 1 s: harmonic:per"):
        named_model("seasonal:period=12,seasons=4").model({"drift": 0.3}, 1.0, 1.0)
    days = np.array([31.0, 28.0, 31.0, 30.0, 59.0])
    named_model(f"seasonal:period={365.25 * 86400},seasons=12").check_steps(86400.0 * days)


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
    far = name + ",mean=-1e4"
    single_env = filters.EstimateState(Drifting(), "kf", model=far)
    for wrapped in (single_env, filters.EstimateStates(copies.env, "kf", model=far)):
        with pytest.warns(UserWarning, match="the first measurement is 100 standard deviations from where"):
            wrapped.reset(seed=3)
    with pytest.raises(ValueError, match="must have a sample time, but .* has no dt here: constant:dt=..."):
        filters.EstimateState(Drifting(), model="constant:drift=0.01,R=1")


@pytest.mark.parametrize(
    "text",
    [
        "constant-velocity:acceleration=0.4,R=0.25,axes=2",
        "oscillator:frequency=0.3,damping=0.1,std=2,R=0.1,mean=3",
        "constant:drift=1,R=1 + ornstein-uhlenbeck:time_constant=2,std=1",
    ],
)
def test_steps_of_any_length_have_the_transition_and_noise_of_that_length(text, as_python):
    maker, rng = model_named(text), np.random.default_rng(2)
    plant, prior = maker.continuous(dt=0.1), maker(dt=0.1)
    z, steps = np.cumsum(rng.normal(size=(12, prior.m)), axis=0), rng.uniform(0.05, 0.25, 11)
    x, cov = prior.prior_mean, prior.prior_cov
    _, _, _, c, offset = prior.matrices()
    for k, measured in enumerate(z):
        if k:
            step = maker(dt=steps[k - 1])
            a = step.matrices()[0]
            x, cov = a @ x, a @ cov @ a.T + step.process_noise_cov
        gain = np.linalg.solve(c @ cov @ c.T + prior.measurement_noise_cov, c @ cov).T
        x, cov = x + gain @ (measured - c @ x - offset), cov - gain @ c @ cov
    filter_ = pickle.loads(pickle.dumps(filters.make_filter("ekf", plant.at(0.1))))
    estimates = filters.run(filter_, z, dt=steps, noise=plant.noise)
    np.testing.assert_allclose(estimates.means[-1], x, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(estimates.covs[-1], cov, rtol=1e-5, atol=1e-6)
