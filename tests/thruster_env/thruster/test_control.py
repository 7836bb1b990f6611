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


@pytest.mark.parametrize("preset", ["tunnel", "tunnel_physical"])
def test_the_true_state_lets_thrust_rise_without_overshoot(preset):
    env = envs("", 1, preset=preset, **NOISE_FREE)
    feed_forward = PIController.for_env(env, 0.0, 0.0)
    lqr = LQRController.for_env(env)
    _, alone, _ = closed_loop(env, feed_forward, 200)
    _, thrusts, _ = closed_loop(ObserveStateVector(env), lqr, 200)
    assert alone.max() > 2 * lqr.reference  # the motor is faster than the flow
    assert thrusts.max() < 1.05 * lqr.reference


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
