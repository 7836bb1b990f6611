import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.thruster_env.auv import textbook
from tests.thruster_env.auv.textbook import random_states
from thruster_env.auv import dynamics
from thruster_env.auv.dynamics import attitude_of, in_earth_axes
from thruster_env.auv.model import MODELS
from thruster_env.auv.parameters import PRESETS, SEGOROGENI, derive_constants
from thruster_env.core.derivatives import euler, euler_jacobian, runge_kutta, runge_kutta_jacobian
from thruster_env.core.sources import vector_reader, vector_writer
from thruster_env.graphs.loops import Loops

every_preset = pytest.mark.parametrize("k", PRESETS.values(), ids=PRESETS)


def inputs_of(name, x, u):
    """Random inputs (count, 4) as a model takes them: with attitude, or with a current."""
    extra = {"velocities": x[:, 6:8], "current": x[:, 9:12] / 20}.get(name)
    return u if extra is None else np.hstack([u, extra])


@every_preset
def test_accelerations_are_the_printed_equations(k):
    k = k._replace(xG=0.01, B=0.99 * k.B)
    x, u = random_states(100)
    expected = [textbook.accelerations(k, a[:6], a[6], a[7], b) for a, b in zip(x, u, strict=True)]
    found = np.transpose(dynamics.motion_rates(tuple(x.T[:8]), tuple(u.T), derive_constants(k)))[:, :6]
    np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-11 * np.abs(expected).max())


def test_models_of_any_size_move_alike():
    c, (x, u) = derive_constants(SEGOROGENI), random_states(20)
    x_t, u_t = tuple(x.T), tuple(u.T)
    whole = np.array(dynamics.navigation_rates(x_t, u_t, c))
    np.testing.assert_array_equal(dynamics.motion_rates(x_t[:8], u_t, c), whole[:8])
    np.testing.assert_array_equal(dynamics.velocity_rates(x_t[:6], (*u_t, x_t[6], x_t[7]), c), whole[:6])
    still = dynamics.current_rates(x_t, (*u_t, 0.0, 0.0, 0.0), c)
    np.testing.assert_allclose(still, whole, rtol=1e-13, atol=1e-13)


def test_a_current_carries_a_vehicle_that_moves_through_the_water_as_ever():
    c, drift = derive_constants(SEGOROGENI, 0.05), np.array([0.3, -0.2, 0.05])
    x = [1.0, 0.05, -0.02, 0.1, 0.1, 0.2, 0.1, -0.3, 0.5, 0.0, 0.0, 0.0]
    u = (2.8, -0.02, 0.05, -0.08)

    def over_ground(state, sign):
        r = np.transpose([in_earth_axes(attitude_of(state[6], state[7]), state[8], *e) for e in np.eye(3)])
        return np.array([*(state[:3] + sign * r.T @ drift), *state[3:]])

    still, carried = tuple(x), tuple(over_ground(np.array(x), 1.0).tolist())
    for _ in range(200):
        still = dynamics.navigation_substep(still, u, c)
        carried = dynamics.current_substep(carried, (*u, *drift), c)
    expected = np.array(still) + [*(9 * [0.0]), *(10.0 * drift)]
    np.testing.assert_allclose(over_ground(np.array(carried), -1.0), expected, atol=2e-5)


MIRROR = np.array([1, -1, 1, -1, 1, -1, -1, 1, -1, 1, -1, 1])  # port for starboard


@every_preset
def test_port_and_starboard_are_alike_to_the_last_digit(k):
    c, (x, u) = derive_constants(k, 0.05), random_states(50)
    for a, b in zip(x, u, strict=True):
        here = np.array(dynamics.navigation_substep(tuple(a.tolist()), tuple(b.tolist()), c))
        mirrored = tuple((a * MIRROR).tolist()), tuple((b * [1, -1, 1, -1]).tolist())
        np.testing.assert_array_equal(dynamics.navigation_substep(*mirrored, c), here * MIRROR)


def on_floats(x, u, c):
    pairs = zip(x.tolist(), u.tolist(), strict=True)
    return [dynamics.current_rates(tuple(a), tuple(b), c) for a, b in pairs]


def on_tensors(x, u, c):
    torch = pytest.importorskip("torch")
    x, u = (tuple(torch.tensor(a, dtype=torch.float64).T) for a in (x, u))
    return torch.stack(dynamics.current_rates(x, u, c), dim=1).numpy()


def in_machine_code(x, u, c):
    state, given, store = vector_reader(12), vector_reader(7), vector_writer(12)

    def evaluate(x, u, c, out):
        for j in range(x.shape[0]):
            store(out[j], dynamics.current_rates(state(x[j]), given(u[j]), c))

    out = np.empty(x.shape)
    Loops(evaluate)(x, u, c, out)
    return out


@pytest.mark.parametrize("way", [on_floats, on_tensors, in_machine_code])
def test_one_source_gives_the_same_numbers_every_way(way):
    """The rates in a current, which are made of all that there is."""
    c, (x, u) = derive_constants(SEGOROGENI, 0.05), random_states(30)
    u = inputs_of("current", x, u)
    expected = np.transpose(dynamics.current_rates(tuple(x.T), tuple(u.T), c))
    result = np.asarray(way(x, u, c))
    assert result.dtype == np.float64
    np.testing.assert_allclose(result, expected, rtol=1e-12, atol=1e-12)


def differences(step, x, u, c, h=1e-5):
    x, columns = np.array(x), []
    for e in np.eye(len(x)) * h:
        columns.append((np.array(step(tuple(x + e), u, c)) - np.array(step(tuple(x - e), u, c))) / (2 * h))
    return np.transpose(columns)


@pytest.mark.parametrize("method", ["runge-kutta", "euler"])
@pytest.mark.parametrize("name", ["velocities", "motion", "navigation"])
def test_jacobians_are_the_slopes_of_a_step(name, method):
    count, rates, tangent = MODELS[name].count, MODELS[name].rates, MODELS[name].tangent
    if method == "euler":
        step, jacobian = euler(rates, count), euler_jacobian(tangent, count)
    else:
        step, jacobian = runge_kutta(rates, count), runge_kutta_jacobian(rates, tangent, count)
    for k in PRESETS.values():
        c, (x, u) = derive_constants(k._replace(xG=0.01, B=0.99 * k.B), 0.05), random_states(5, seed=3)
        for a, b in zip(x, inputs_of(name, x, u), strict=True):
            a, b = tuple(a[:count].tolist()), tuple(b.tolist())
            expected = differences(step, a, b, c)
            np.testing.assert_allclose(jacobian(a, b, c), expected, atol=1e-7 * np.abs(expected).max())


@pytest.mark.parametrize("dt, limit", [(0.001, 1e-12), (0.02, 1e-6), (0.05, 3e-5), (0.1, 1e-3)])
def test_a_step_is_near_the_solution_of_the_equations(dt, limit):
    rng, c, step = np.random.default_rng(5), derive_constants(SEGOROGENI), derive_constants(SEGOROGENI, dt)
    high = np.array([1.2, 0.1, 0.1, 0.3, 0.4, 0.4, 0.05, 0.6])
    for _ in range(20):
        x = rng.uniform(-1, 1, 8) * high
        x[0] = abs(x[0])
        u = (rng.uniform(0, 4), 0.0, *rng.choice([-0.2618, 0.2618], 2))

        def rates(t, y, u=u):
            return dynamics.motion_rates(tuple(y), u, c)

        exact = solve_ivp(rates, (0, dt), x, rtol=1e-12, atol=1e-14, method="DOP853").y[:, -1]
        assert (np.abs(dynamics.motion_substep(tuple(x.tolist()), u, step) - exact) < limit * 2 * high).all()


def test_trouble_is_not_a_number_and_not_an_error():
    c = derive_constants(SEGOROGENI, 0.05)
    for x in ((math.nan,) * 8, (1e200,) + (0.0,) * 7):
        assert not np.isfinite(dynamics.motion_substep(x, (1.0, 0.0, 0.0, 0.0), c)).all()
