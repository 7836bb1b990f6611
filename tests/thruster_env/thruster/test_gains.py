import gymnasium as gym
import numpy as np
import pytest
from scipy.linalg import solve_discrete_lyapunov

from thruster_env import PRESETS
from thruster_env.thruster.analysis import equilibrium, steady_state
from thruster_env.thruster.controllers import LQRController, lambda_gains, quadratic_gain, quadratic_problem
from thruster_env.thruster.linear import make_linear_plant, operating_points, sampled_plant
from thruster_env.thruster.plant import make_plant, make_task, thrust_scale

TURNING = [name for name in PRESETS if name != "open_bladed"]  # whose propeller hardly turns
TASK = make_task([{"name": "constant", "level": 0.5}], 1.0, 0.0, 0.01)
every_preset = pytest.mark.parametrize("preset", PRESETS)
turning_preset = pytest.mark.parametrize("preset", TURNING)


# Operating points


@pytest.mark.parametrize("ambient", [0.0, 0.5, -0.5])
@turning_preset
def test_a_thrust_is_found_among_the_steady_states(preset, ambient):
    plant = make_plant(preset, ambient_velocity=ambient)
    points = operating_points(plant)
    assert (np.diff(points.thrust) > 0).all()
    for level in (-0.5, 0.1, 0.4, 0.7):
        thrust = level * points.thrust[-1] if level > 0 else level * -points.thrust[0]
        there = steady_state(plant.parameters, float(points.interpolate(points.voltage, thrust)), ambient)
        assert there.thrust == pytest.approx(thrust, abs=(1e-3 if ambient else 2.6e-4) * thrust_scale(plant))
        flow = points.interpolate(points.flow, thrust)
        assert flow == pytest.approx(there.U_a, abs=0.01 * abs(points.flow).max())


def test_beyond_the_range_the_last_steady_state_counts():
    points = operating_points(make_plant("t200"))
    assert points.interpolate(points.voltage, np.array([-1e3, 1e3])).tolist() == [-24.0, 24.0]


@pytest.mark.parametrize("system", ["tunnel", "open_bladed"])
def test_a_linear_system_has_operating_points(system):
    plant = make_linear_plant(system)
    points = operating_points(plant)
    per_volt = equilibrium(plant.linear, (1.0, 0.0))[2]
    np.testing.assert_allclose(points.thrust, per_volt * points.voltage, rtol=1e-10)
    assert points.thrust[0] < 0 < points.thrust[-1]


# Gains of the PI controller


def loop_eigenvalues(plant, voltage, proportional, integral):
    """Eigenvalues (3,), by modulus, of the sampled plant with the integral [V] of a PI controller."""
    a, b, c = sampled_plant(plant, voltage)
    loop = np.block([[a - proportional * b @ c, b], [-integral * plant.dt * c, np.ones((1, 1))]])
    return np.array(sorted(np.linalg.eigvals(loop), key=abs))


@every_preset
def test_the_loop_is_stable_all_over_the_range(preset):
    plant = make_plant(preset)
    proportional, integral = lambda_gains(plant)
    for voltage in np.linspace(-24.0, 24.0, 14):
        assert abs(loop_eigenvalues(plant, voltage, proportional, integral)).max() < 1
        _, b, c = sampled_plant(plant, voltage)
        assert 0 < proportional * (c @ b).item() < 0.79  # as `lambda_gains` says


def test_a_first_order_lag_gets_the_time_constant_asked_for():
    plant = make_linear_plant("tunnel")
    # Thrust that follows the motor alone; the flow goes its own, slower way.
    lag = plant.linear._replace(a=np.diag([-30.0, -5.0]), b=np.diag([8.0, 0.0]), c=np.array([[2.0, 0.0]]))
    plant = plant._replace(linear=lag)
    proportional, integral = lambda_gains(plant, time_constant=0.07)
    expected = np.exp(-plant.dt * np.array([5.0, 30.0, 1 / 0.07]))  # flow, motor (cancelled), loop
    np.testing.assert_allclose(loop_eigenvalues(plant, 12.0, proportional, integral), np.sort(expected))


def test_steady_gain_and_slow_time_constant_would_make_an_unstable_loop():
    plant = make_plant("tunnel")
    a, b, c = sampled_plant(plant, 12.0)
    steady_gain = (c @ np.linalg.solve(np.eye(2) - a, b)).item()
    slow = abs(np.linalg.eigvals(a)).max()
    proportional = -np.expm1(-0.5) / (steady_gain * (1 - slow))
    integral = proportional * (1 - slow) / plant.dt
    assert abs(loop_eigenvalues(plant, 12.0, proportional, integral)).max() > 1
    assert proportional > 5 * lambda_gains(plant)[0]


def test_no_gains_are_made_up():
    with pytest.raises(ValueError, match="operating_voltage must be such that .* a slope, but got 0.0"):
        lambda_gains(make_plant("tunnel"), operating_voltage=0.0)
    with pytest.raises(ValueError, match="operating_voltage must be such that the plant is stable"):
        lambda_gains(make_linear_plant("open_bladed"))
    with pytest.raises(ValueError, match="time_constant must be positive, but got -1"):
        lambda_gains(make_plant("tunnel"), time_constant=-1)


# The gain of the LQR


def riccati_by_iteration(plant, voltage, tracking, rate):
    """K for (dx, dV_{k-1}) from the other form of the problem, whose input is the change of the voltage."""
    a_d, b_d, c = sampled_plant(plant, voltage)
    a, b = np.block([[a_d, b_d], [np.zeros((1, 2)), np.ones((1, 1))]]), np.vstack([b_d, [[1.0]]])
    q = np.zeros((3, 3))
    q[:2, :2] = tracking * c.T @ c / thrust_scale(plant) ** 2
    r, p = np.array([[rate / plant.max_voltage**2]]), q.copy()
    for _ in range(20_000):
        k = np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a)
        p = q + a.T @ p @ (a - b @ k)
    return k[0] - [0.0, 0.0, 1.0]


@pytest.mark.parametrize("voltage", [-24.0, 3.0, 12.0])
@turning_preset
def test_the_gain_is_that_of_a_riccati_iteration(preset, voltage):
    plant = make_plant(preset)
    expected = riccati_by_iteration(plant, voltage, 1.0, 0.01)
    np.testing.assert_allclose(quadratic_gain(plant, TASK, voltage), expected, rtol=1e-6, atol=1e-9)


def cost_of(gain, problem, start):
    """The exact infinite sum of the quadratic cost under dV = -K s from a start (3,)."""
    a, b, q, r, s = problem
    k = np.reshape(gain, (1, 3))
    if abs(np.linalg.eigvals(a - b @ k)).max() >= 1:
        return np.inf
    weight = q - s @ k - (s @ k).T + k.T @ r @ k
    return start @ solve_discrete_lyapunov((a - b @ k).T, weight) @ start


@turning_preset
def test_no_other_gain_costs_less(preset, weights=(1.0, 0.1, 0.02)):
    plant, task = make_plant(preset), make_task([{"name": "constant", "level": 0.5}], *weights)
    problem, gain = quadratic_problem(plant, task, 12.0), quadratic_gain(plant, task, 12.0)
    generator = np.random.default_rng(0)
    start = np.array([20.0, 0.3, 2.0])
    least = cost_of(gain, problem, start)
    for _ in range(50):
        other = gain * generator.uniform(0.8, 1.2, 3)
        assert cost_of(other, problem, start) > least
    assert cost_of(np.zeros(3), problem, start) > least  # the voltage is left at that of the steady state


def test_a_gain_needs_something_to_act_on():
    plant = make_plant("tunnel")
    with pytest.raises(ValueError, match="tracking_weight must be positive, but got 0.0"):
        quadratic_gain(plant, TASK._replace(weights=(0.0, 0.0, 0.01)), 12.0)
    with pytest.raises(ValueError, match="voltage must be such that feedback has an effect, but got 0 V"):
        quadratic_gain(plant, TASK._replace(weights=(1.0, 0.0, 0.0)), 0.0)


def test_without_a_price_on_the_voltage_thrust_comes_at_once():
    plant, task = make_plant("tunnel"), TASK._replace(weights=(1.0, 0.0, 0.0))
    a, b, q, _, _ = quadratic_problem(plant, task, 12.0)
    after = (a - b * quadratic_gain(plant, task, 12.0)) @ [5.0, 0.1, 0.0]
    assert after @ q @ after == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("preset", ["tunnel", "t200"])
def test_the_cost_is_that_of_the_envs_reward(preset):
    """For small deviations the rewards add up to the quadratic cost, without the first thrust's."""
    plant = make_plant(preset)
    points, i = operating_points(plant), 45
    voltage, thrust = points.voltage[i], points.thrust[i]
    problem = quadratic_problem(plant, TASK, voltage)
    there = np.array(steady_state(plant.parameters, float(voltage))[:2])
    start = np.append(0.01 * there, 0.0)
    quiet = {"process_noise_cov": (0.0, 0.0), "initial_state": list(there + start[:2])}
    env = gym.make("BowThruster-v0", preset=preset, reference=thrust, **quiet)
    controller = LQRController.for_env(env)
    _, info = env.reset(seed=0)
    state, cost = np.array([voltage]), 0.0
    for k in range(400):
        _, state = controller.predict(info["state"], state)  # both in float64
        _, reward, _, _, info = env.step(state)
        cost -= reward
        if k == 0:  # the env counts a change from 0 V
            cost -= 0.01 * (state.item() ** 2 - (state.item() - voltage) ** 2) / 24.0**2
    expected = cost_of(quadratic_gain(plant, TASK, voltage), problem, start)
    expected -= start @ np.diag([1.0, 1.0, 0.0]) @ problem[2] @ start
    assert cost == pytest.approx(expected, rel=0.04)
