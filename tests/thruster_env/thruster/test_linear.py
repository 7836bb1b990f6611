import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from thruster_env.core.matrices import observability, zero_order_hold
from thruster_env.thruster.analysis import jacobians, required_substeps, run_substeps, state_range, steady_state
from thruster_env.thruster.dynamics import rates, thrust_and_torque
from thruster_env.thruster.parameters import (
    OPEN_BLADED,
    OPEN_BLADED_CORRECTED,
    PRESETS,
    TUNNEL,
    TUNNEL_PHYSICAL,
    derive_constants,
)

every_preset = pytest.mark.parametrize("p", PRESETS.values(), ids=PRESETS.keys())
DISC = math.pi * TUNNEL.diameter**2 / 4


def exact_step(x, u, p, dt):
    """The flow of the equations from many states at once, x = (omega_m, U_a) and u = (V_s, U_0)."""
    c, count = derive_constants(p), len(x[0])

    def slopes(_, y):
        return np.concatenate(rates((y[:count], y[count:]), u, c))

    solution = solve_ivp(slopes, (0, dt), np.concatenate(x), method="DOP853", rtol=1e-10, atol=1e-13)
    return solution.y[:, -1].reshape(2, count)


def settled(p, voltage, ambient=0.0):
    """Where a thruster ends that starts at rest; the printed open-bladed one takes its time."""
    c = derive_constants(p)

    def slopes(_, y):
        return rates(tuple(y), (voltage, ambient), c)

    return solve_ivp(slopes, (0, 1e5), (0.0, 0.0), method="LSODA", rtol=1e-10, atol=1e-13).y[:, -1]


@pytest.mark.parametrize(
    ("load_gain", "area", "voltage", "omega", "flow", "thrust"),
    [
        (17.79, 0.00445, 6, 96.913, 1.837, 3.072),
        (17.79, 0.00445, 12, 193.803, 3.674, 12.286),
        (17.79, 0.00445, 24, 387.515, 7.347, 49.123),
        (17790, 0.00456, 6, 87.647, 1.669, 2.533),
        (17790, 0.00456, 12, 162.113, 3.086, 8.667),
        (17790, 0.00456, 24, 287.727, 5.477, 27.302),
    ],
)
def test_steady_states_have_the_known_values(load_gain, area, voltage, omega, flow, thrust):
    p = TUNNEL._replace(load_gain=load_gain, area=area)
    assert steady_state(p, voltage) == pytest.approx((omega, flow, thrust), rel=0, abs=5.1e-4)


@pytest.mark.parametrize(
    ("p", "a", "a_digits", "eigenvalues"),
    [
        (TUNNEL._replace(area=DISC), [[-70.24, 3.21], [0.407, -21.38]], [[2, 2], [3, 2]], None),
        (
            TUNNEL._replace(area=DISC, load_gain=17790.0),
            [[-148.8, 2688], [0.340, -17.89]],
            [[1, 0], [3, 2]],
            (-155, -11.2),
        ),
        # Known for a rotor disc rounded to 0.01767 m^2.
        (
            OPEN_BLADED_CORRECTED._replace(area=0.01767),
            [[-310.3, 4067], [0.326, -21.68]],
            [[1, 0], [3, 2]],
            (-315, -17.2),
        ),
    ],
    ids=["tunnel", "tunnel, strong load", "open-bladed"],
)
def test_jacobians_at_12_volts_have_the_known_values(p, a, a_digits, eigenvalues):
    matrix, b, _ = jacobians(p, steady_state(p, 12.0)[:2], 12.0)
    assert (np.abs(matrix - a) <= 0.51 * 10.0 ** -np.array(a_digits)).all()
    np.testing.assert_array_equal(b, [[p.voltage_gain], [0.0]])
    if eigenvalues:
        fast, slow = sorted(np.linalg.eigvals(matrix))
        assert fast == pytest.approx(eigenvalues[0], abs=0.5)
        assert slow == pytest.approx(eigenvalues[1], abs=0.05)


def test_thrust_slopes_at_12_volts_have_the_known_values():
    p = TUNNEL._replace(area=DISC)
    _, _, slopes = jacobians(p, steady_state(p, 12.0)[:2], 12.0)
    assert slopes.shape == (1, 2)
    assert slopes[0] == pytest.approx((0.388, -13.68), rel=0, abs=5e-3)
    assert slopes[0, 0] == pytest.approx(0.388, rel=0, abs=5e-4)


def test_open_bladed_steady_state_has_the_known_value():
    assert steady_state(OPEN_BLADED_CORRECTED, 12.0)[:2] == pytest.approx((60.03, 0.904), rel=1e-3)


@every_preset
@pytest.mark.parametrize("ambient", [0.0, 1.5, -2.0])
def test_jacobians_are_the_slopes_of_the_rates_and_of_the_thrust(p, ambient):
    c, x, voltage = derive_constants(p), (70.0, -1.3), 7.0
    a, b, slopes = jacobians(p, x, voltage, ambient)
    for i, h in enumerate((1e-4, 1e-5)):
        dx = np.zeros(2)
        dx[i] = h
        up, down = tuple(x + dx), tuple(x - dx)
        difference = np.subtract(rates(up, (voltage, ambient), c), rates(down, (voltage, ambient), c)) / (2 * h)
        np.testing.assert_allclose(a[:, i], difference, rtol=1e-6, atol=1e-6 * np.abs(a).max())
        thrusts = thrust_and_torque(up, c)[0], thrust_and_torque(down, c)[0]
        assert slopes[0, i] == pytest.approx((thrusts[0] - thrusts[1]) / (2 * h), rel=1e-6)
    one_volt_more = np.subtract(rates(x, (voltage + 1, ambient), c), rates(x, (voltage, ambient), c))
    np.testing.assert_allclose(b[:, 0], one_volt_more, rtol=1e-9)


@every_preset
@pytest.mark.parametrize("voltage", [-24.0, -3.0, 0.5, 12.0, 24.0])
def test_a_steady_state_is_what_a_voltage_settles_to(p, voltage):
    omega, flow, thrust = steady_state(p, voltage)
    assert settled(p, voltage) == pytest.approx((omega, flow), rel=1e-6)
    assert thrust == thrust_and_torque((omega, flow), derive_constants(p))[0]


@every_preset
@pytest.mark.parametrize("ambient", [0.0, 0.2, -0.5])
@pytest.mark.parametrize("voltage", [-24.0, -6.0, 0.0, 1.0, 12.0, 24.0])
def test_a_steady_state_is_an_equilibrium_of_the_stepper(p, voltage, ambient):
    x = steady_state(p, voltage, ambient)[:2]
    substeps = required_substeps(p, 0.01, 24.0, ambient)
    after = run_substeps(x, (voltage, ambient), p, 0.01, substeps)
    assert (np.abs(np.subtract(after, x)) <= 1e-8 * np.maximum(state_range(p, 24.0), np.abs(x))).all()


@every_preset
@pytest.mark.parametrize("ambient", [0.0, 0.3])
def test_steady_states_are_odd(p, ambient):
    p = p._replace(thrust_asymmetry=0.0)  # the one thing that is not odd
    ahead, astern = steady_state(p, 11.0, ambient), steady_state(p, -11.0, -ambient)
    assert astern == pytest.approx([-y for y in ahead], rel=1e-9)


@every_preset
def test_nothing_turns_without_voltage_and_flow(p):
    assert steady_state(p, 0.0) == (0.0, 0.0, 0.0)


FLOWS = [
    (p, *at) for p in (TUNNEL, TUNNEL_PHYSICAL, OPEN_BLADED) for at in [(-12, 1), (-1, 0.5), (0, 2), (12, -2)]
]
FLOWS += [(OPEN_BLADED_CORRECTED, *at) for at in [(-1, 0.5), (-12, 2), (-1.5, 1), (-12, 5)]]


@pytest.mark.parametrize(("p", "voltage", "ambient"), FLOWS)
def test_a_voltage_in_a_flow_settles_to_its_steady_state(p, voltage, ambient):
    x = steady_state(p, voltage, ambient)[:2]
    assert settled(p, voltage, ambient) == pytest.approx(x, rel=1e-5, abs=1e-6)


@every_preset
def test_the_range_spans_both_directions(p):
    top, bottom = steady_state(p, 24.0), steady_state(p, -24.0)
    np.testing.assert_allclose(state_range(p, 24.0), np.subtract(top, bottom)[:2], rtol=1e-9)


def states_and_voltages(p, max_voltage):
    """Random ones, and every reversal between steady states."""
    rng = np.random.default_rng(3)
    top = np.array(steady_state(p, max_voltage)[:2])
    x, voltages = rng.uniform(-1, 1, (200, 2)) * top, rng.uniform(-1, 1, 200) * max_voltage
    levels = np.linspace(-1, 1, 9) * max_voltage
    resting = np.array([steady_state(p, level)[:2] for level in levels])
    x = np.concatenate([x, np.repeat(resting, 9, axis=0)])
    return tuple(x.T), np.concatenate([voltages, np.tile(levels, 9)])


@every_preset
@pytest.mark.parametrize(
    ("dt", "max_voltage", "ambient"),
    [(0.01, 24.0, 0.0), (0.01, 6.0, 0.0), (0.01, 48.0, 0.0), (0.02, 24.0, 0.0), (0.01, 24.0, 1.0)],
)
def test_the_one_step_map_is_accurate_to_a_ten_thousandth_of_the_range(p, dt, max_voltage, ambient):
    x, voltages = states_and_voltages(p, max_voltage)
    substeps = required_substeps(p, dt, max_voltage, ambient)
    error = np.abs(
        run_substeps(x, (voltages, ambient), p, dt, substeps) - exact_step(x, (voltages, ambient), p, dt)
    )
    assert (error.max(axis=1) <= 1e-4 * state_range(p, max_voltage)).all()


@pytest.mark.parametrize(
    "p", [TUNNEL, TUNNEL_PHYSICAL, OPEN_BLADED_CORRECTED], ids=lambda p: f"K2 {p.voltage_gain}"
)
def test_a_single_runge_kutta_step_would_not_do(p):
    x, voltages = states_and_voltages(p, 24.0)
    error = np.abs(run_substeps(x, (voltages, 0.0), p, 0.01, 1) - exact_step(x, (voltages, 0.0), p, 0.01))
    assert (error.max(axis=1) > 1e-4 * state_range(p, 24.0)).any()


@pytest.mark.parametrize("dt", [10.0, 1e300])
def test_a_sample_time_that_no_substeps_can_follow_is_refused(dt):
    with pytest.raises(ValueError, match="dt must be short enough"):
        required_substeps(TUNNEL, dt, 24.0)


def test_zero_order_hold_has_the_closed_form_of_one_state():
    a_d, b_d = zero_order_hold(np.array([[-3.0]]), np.array([[2.0, 5.0]]), 0.1)
    assert a_d == pytest.approx(np.array([[math.exp(-0.3)]]))
    assert b_d == pytest.approx(np.array([[2.0, 5.0]]) * (1 - math.exp(-0.3)) / 3.0)


def test_observability_tells_seen_from_hidden():
    shift = np.array([[1.0, 0.1], [0.0, 1.0]])
    rank, condition = observability(shift, np.array([[1.0, 0.0]]))
    assert rank == 2
    assert condition == pytest.approx(np.linalg.cond([[1.0, 0.0], [1.0, 0.1]]))
    assert observability(shift, np.array([[0.0, 1.0]]))[0] == 1
