import functools
import warnings
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

from thruster_env import PRESETS
from thruster_env.env.env import ObserveState, ObserveStateVector
from thruster_env.thruster.analysis import steady_state
from thruster_env.thruster.controllers import (
    LQRController,
    PIController,
    PredictiveController,
    lambda_gains,
    quadratic_gain,
)
from thruster_env.thruster.plant import make_task, thrust_scale

NOISE_FREE = {"process_noise_cov": (0.0, 0.0), "measurement_noise_cov": 0.0, "initial_state": (0.0, 0.0)}
# `open_bladed` is left out where a thrust is held: its propeller hardly turns, and the flow on which its thrust of
# some millinewtons depends takes a minute to settle.
TURNING = [name for name in PRESETS if name != "open_bladed"]
TASK = make_task([{"name": "constant", "level": 0.5}], 1.0, 0.0, 0.01)
turning_preset = pytest.mark.parametrize("preset", TURNING)
every = pytest.mark.parametrize("controller", [PIController, LQRController, PredictiveController])


class NoAction:
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.zeros((*observation.shape[:-1], 1), dtype=np.float32), None


def envs(task, count, **arguments):
    return gym.make_vec(f"BowThruster{task}-v0", num_envs=count, **arguments)


def observing(controller, env):
    """The env as a controller observes it."""
    return env if controller is PIController else ObserveStateVector(env)


def closed_loop(env, policy, steps=500, references=None):
    """Returns (n,), thrusts (steps, n) and voltages (steps, n); `references` (steps,) hide those of the env."""
    observation, _ = env.reset(seed=0)
    state, rewards, thrusts, voltages = None, [], [], []
    for k in range(steps):
        if references is not None:
            observation[:, -1] = references[k]
        action, state = policy.predict(observation, state)
        observation, reward, _, _, info = env.step(action)
        rewards.append(reward)
        thrusts.append(info["thrust"])
        voltages.append(action[:, 0])
    return np.sum(rewards, axis=0), np.array(thrusts), np.array(voltages)


@functools.cache
def made(controller, preset):
    """A controller for `BowThrusterTracking-v0`; it does not depend on noise and initial state."""
    return controller.for_env(gym.make("BowThrusterTracking-v0", preset=preset))


@functools.cache
def returns(task, **arguments):
    """Returns (n,) of each policy, on the same seeds."""
    env = envs(task, 50 if task == "Reversal" else 20, **arguments)  # where rewards differ little, more copies
    policies = {
        "nothing": (NoAction(), env),
        "feed-forward": (PIController.for_env(env, 0.0, 0.0), env),
        "PI": (PIController.for_env(env), env),
        "LQR": (LQRController.for_env(env), ObserveStateVector(env)),
        "MPC": (PredictiveController.for_env(env), ObserveStateVector(env)),
    }
    return {name: closed_loop(env, policy)[0] for name, (policy, env) in policies.items()}


def better(one, other):
    """Whether paired returns differ by more than two standard errors."""
    gain = one - other
    return gain.mean() > 2 * gain.std(ddof=1) / len(gain) ** 0.5


# Closed loops


@every
@turning_preset
def test_a_constant_thrust_is_held_without_an_error(preset, controller):
    env = envs("Tracking", 1, preset=preset, **NOISE_FREE)
    scale, accuracy = thrust_scale(env.plant), 2.6e-4 if controller is LQRController else 1e-5  # of `POINTS`
    for level in (-0.6, 0.3, 0.9):
        references = np.full(450, level * scale)
        _, thrusts, _ = closed_loop(observing(controller, env), made(controller, preset), 450, references)
        assert thrusts[-1, 0] == pytest.approx(level * scale, abs=accuracy * scale)


@turning_preset
def test_the_integral_makes_up_for_a_wrong_feed_forward(preset):
    env, pi = envs("Tracking", 1, preset=preset, **NOISE_FREE), made(PIController, preset)
    wrong = replace(pi, points=pi.points._replace(voltage=0.8 * pi.points.voltage))
    reference = 0.4 * thrust_scale(env.plant)
    _, thrusts, _ = closed_loop(env, wrong, 480, np.full(480, reference))
    assert thrusts[-1, 0] == pytest.approx(reference, rel=1e-3)


def test_a_step_of_the_reference_is_no_error_yet():
    pi = made(PIController, "tunnel")
    _, state = pi.predict([12.0, 12.0])
    action, state = pi.predict([12.0, 20.0], state)
    np.testing.assert_allclose(action, pi.points.interpolate(pi.points.voltage, 20.0), rtol=1e-6)
    np.testing.assert_array_equal(state, [0.0, 20.0])


@pytest.mark.parametrize("preset", ["tunnel", "tunnel_physical"])
def test_the_true_state_lets_thrust_rise_without_overshoot(preset):
    env = envs("", 1, preset=preset, **NOISE_FREE)
    feed_forward = PIController.for_env(env, 0.0, 0.0)
    lqr = LQRController.for_env(env)
    _, alone, _ = closed_loop(env, feed_forward, 200)
    _, thrusts, _ = closed_loop(ObserveStateVector(env), lqr, 200)
    assert alone.max() > 2 * lqr.reference  # the motor is faster than the flow
    assert thrusts.max() < 1.05 * lqr.reference


@turning_preset
def test_lqr_undoes_a_disturbance_better_than_a_constant_voltage(preset):
    there = steady_state(PRESETS[preset], 12.0)
    env = envs("Tracking", 1, preset=preset, **NOISE_FREE | {"initial_state": (there.omega_m, 0.7 * there.U_a)})
    feed_forward = replace(made(PIController, preset), proportional_gain=0.0, integral_gain=0.0)
    costs = []
    for policy, observed in ((made(LQRController, preset), ObserveStateVector(env)), (feed_forward, env)):
        _, thrusts, _ = closed_loop(observed, policy, 300, np.full(300, there.thrust))
        costs.append(((thrusts - there.thrust) ** 2).sum())
    assert costs[0] < 0.7 * costs[1]


def without_clamping(pi, observation, state):
    """The textbook's PI controller with the same gains, whose integral runs on."""
    integral, last_reference = (0.0, observation[0, -1]) if state is None else state
    error = last_reference - observation[0, 0]
    steady = np.interp(observation[0, -1], pi.points.thrust, pi.points.voltage)
    voltage = np.clip(steady + pi.proportional_gain * error + integral, -24, 24)
    return np.array([[voltage]]), (integral + pi.integral_gain * pi.plant.dt * error, observation[0, -1])


@turning_preset
def test_the_integral_does_not_wind_up(preset):
    """After 2 s of a thrust out of reach, the next one within is held as if nothing had been."""
    env, pi = envs("Tracking", 1, preset=preset, **NOISE_FREE), made(PIController, preset)
    scale = thrust_scale(env.plant)
    references = scale * np.repeat([1.3, 0.5], [200, 150])
    _, thrusts, voltages = closed_loop(env, pi, 350, references)
    assert (voltages[50:199] == 24.0).all()

    class Textbook:
        predict = staticmethod(functools.partial(without_clamping, pi))

    _, winding, _ = closed_loop(env, Textbook, 350, references)
    error, wound_error = (np.abs(t[230:, 0] - references[230:]) / scale for t in (thrusts, winding))
    assert error.max() < 0.06  # 0.3 s later
    assert wound_error.max() > 0.4
    # No overshoot on the far side but that of the plant itself, whose thrust falls before its flow does.
    gentle = scale * np.repeat([0.999, 0.5], [200, 150])
    _, never_cut_off, _ = closed_loop(env, pi, 350, gentle)
    assert thrusts[200:].min() > never_cut_off[200:].min() - 0.1 * scale


@pytest.mark.parametrize("preset", ["tunnel", "tunnel_physical", "open_bladed_corrected"])
@every
def test_symmetric_thrusters_are_driven_symmetrically(preset, controller):
    policy, scale = made(controller, preset), thrust_scale(made(PIController, preset).plant)
    generator = np.random.default_rng(1)
    observations = generator.normal(size=(40, 3)) * [100.0, 2.0, 0.5 * scale]
    if controller is PIController:
        observations = observations[:, ::2]
    state = other = None
    for _ in range(3):
        actions, state = policy.predict(observations, state)
        opposite, other = policy.predict(-observations, other)
        np.testing.assert_allclose(actions, -opposite, rtol=1e-6, atol=1e-9)


@turning_preset
def test_the_controllers_feedback_is_the_gain_to_first_order(preset):
    controller = made(LQRController, preset)
    plant = controller.plant
    for i in (5, 30, 45):
        voltage, thrust = controller.points.voltage[i], controller.points.thrust[i]
        state = steady_state(plant.parameters, float(voltage))

        def voltage_at(deviation, thrust=thrust, voltage=voltage, state=state):
            observed = [state.omega_m + deviation[0], state.U_a + deviation[1], thrust]
            return controller.predict(observed, [voltage + deviation[2]])[1][0]

        # Central differences; the thrust is quadratic.
        steps = np.diag(1e-3 * np.abs([state.omega_m, state.U_a, voltage]))
        slopes = [(voltage_at(step) - voltage_at(-step)) / (2 * step.sum()) for step in steps]
        expected = -quadratic_gain(plant, TASK, voltage)
        np.testing.assert_allclose(slopes, expected, rtol=1e-4, atol=1e-4 * abs(expected[2]))


# The interface


@every
def test_a_batch_is_driven_as_each_env_alone(controller):
    env, policy = observing(controller, envs("Reversal", 3)), made(controller, "tunnel")
    observation, _ = env.reset(seed=4)
    state, alone = None, [None, None, None]
    for _ in range(60):
        actions, state = policy.predict(observation, state)
        assert actions.shape == (3, 1) and actions.dtype == np.float32
        for i in range(3):
            action, alone[i] = policy.predict(observation[i], alone[i])
            assert action.shape == (1,) and alone[i].shape == state.shape[1:]
            np.testing.assert_array_equal(action, actions[i])
        observation = env.step(actions)[0]


@every
def test_an_episode_start_forgets(controller):
    env, policy = observing(controller, envs("Tracking", 3)), made(controller, "tunnel")
    observation, _ = env.reset(seed=4)
    _, state = policy.predict(observation)
    for _ in range(5):
        observation = env.step(policy.predict(observation, state)[0])[0]
        _, state = policy.predict(observation, state)
    kept = state.copy()
    fresh, _ = policy.predict(observation)
    going_on, _ = policy.predict(observation, state)
    actions, _ = policy.predict(observation, state, episode_start=np.array([False, True, False]))
    assert not np.array_equal(fresh[1], going_on[1])
    np.testing.assert_array_equal(actions[[0, 2]], going_on[[0, 2]])
    np.testing.assert_array_equal(actions[1], fresh[1])
    np.testing.assert_array_equal(state, kept)  # the caller's own
    one, _ = policy.predict(observation[1], state[1], episode_start=np.array([True]))
    np.testing.assert_array_equal(one, fresh[1])


def test_episodes_that_follow_one_another_start_afresh():
    env = envs("Tracking", 2, max_episode_steps=20)  # resets on the next step
    pi = PIController.for_env(env)
    observation, _ = env.reset(seed=0)
    state, done, starts = None, np.zeros(2, dtype=bool), np.ones(2, dtype=bool)
    for k in range(60):
        action, state = pi.predict(observation, state, starts)
        if k in (21, 42):
            np.testing.assert_array_equal(action, pi.predict(observation)[0])
        starts = done
        observation, _, terminated, truncated, _ = env.step(action)
        done = terminated | truncated
        assert done.all() == (k in (19, 40))


def test_further_channels_and_flags_do_not_disturb():
    sensors = {"speed": [], "thrust": [{"name": "dropout", "probability": 0.5}]}
    env = gym.make("BowThrusterTracking-v0", sensors=sensors)
    plain = PIController.for_env(gym.make("BowThrusterTracking-v0"))
    action, _ = PIController.for_env(env).predict([180.0, 9.0, 1.0, 12.0])
    np.testing.assert_array_equal(action, plain.predict([9.0, 12.0])[0])


@every
def test_voltages_stay_within_the_range(controller):
    policy = controller.for_env(gym.make("BowThrusterTracking-v0", max_voltage=10.0))
    observations = np.random.default_rng(0).normal(size=(200, 3)) * [100.0, 3.0, 20.0]
    actions, _ = policy.predict(observations[:, 1:] if controller is PIController else observations)
    assert actions.min() == -10.0 and actions.max() == 10.0


def test_gains_may_be_given():
    env = gym.make("BowThruster-v0")
    found = lambda_gains(env.unwrapped.plant, 6.0, 0.1)
    pi = PIController.for_env(env, proportional_gain=0.3, operating_voltage=6.0, time_constant=0.1)
    assert (pi.proportional_gain, pi.integral_gain) == (0.3, found[1])
    with pytest.raises(ValueError, match="integral_gain must be a finite number"):
        PIController.for_env(gym.make("BowThruster-v0"), integral_gain="large")
    with pytest.raises(ValueError, match="sensors must include the thrust, but the env has speed"):
        PIController.for_env(gym.make("BowThruster-v0", sensors=["speed"]))


def test_lqr_wants_the_state():
    with pytest.raises(ValueError, match="an observation must begin with the state, but has 2 entries"):
        made(LQRController, "tunnel").predict([1.0, 2.0])


@pytest.mark.parametrize("task", ["", "Tracking"])
@every
def test_stable_baselines_evaluates_the_controllers(task, controller):
    evaluation = pytest.importorskip("stable_baselines3.common.evaluation")
    env = gym.make(f"BowThruster{task}-v0")
    env = env if controller is PIController else ObserveState(env)
    policy = controller.for_env(env)
    env.reset(seed=7)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of a Monitor that this does not need
        mean, _ = evaluation.evaluate_policy(policy, env, n_eval_episodes=2)
    assert -3 < mean < -0.01


# What the tasks pay


@pytest.mark.parametrize("task", ["", "Tracking", "Reversal"])
@pytest.mark.parametrize("preset", ["tunnel", "tunnel_physical"])
def test_feedback_pays(task, preset):
    got = returns(task, preset=preset)
    assert better(got["PI"], got["nothing"])
    assert better(got["PI"], got["feed-forward"])
    assert better(got["LQR"], got["PI"]) and better(got["MPC"], got["LQR"])


def test_feed_forward_may_be_worse_than_nothing():
    """About zero thrust a flow that lags behind turns what a steady voltage gives."""
    got = returns("Reversal", preset="tunnel_physical")
    assert better(got["nothing"], got["feed-forward"])


@pytest.mark.parametrize("task", ["", "Tracking", "Reversal"])
def test_where_thrust_follows_at_once_there_is_little_to_feed_back(task):
    """The t200 settles within two samples. What PI then integrates at each start is over when it acts."""
    got = returns(task, preset="t200")
    assert better(got["LQR"], got["feed-forward"])
    assert (got["feed-forward"] - got["PI"]).mean() < 0.02  # of hundreds that doing nothing costs
    assert better(got["PI"], got["nothing"] + 10)


def test_a_thruster_that_is_not_the_nominal_one_needs_an_integral():
    spread = {name: {"name": "log-normal", "std": 0.2} for name in ("load_gain", "voltage_gain")}
    env = envs("Tracking", 20, uncertainty=spread)
    pi = closed_loop(env, PIController.for_env(env))[0]
    assert better(pi, closed_loop(env, PIController.for_env(env, 0.0, 0.0))[0])
    assert better(pi, closed_loop(ObserveStateVector(env), LQRController.for_env(env))[0])


def test_the_published_linear_tunnel_is_driven_too():
    env = envs("Linear", 20)
    feed_forward = closed_loop(env, PIController.for_env(env, 0.0, 0.0))[0]
    pi = closed_loop(env, PIController.for_env(env))[0]
    lqr = closed_loop(ObserveStateVector(env), LQRController.for_env(env))[0]
    assert better(lqr, pi) and better(pi, feed_forward)
