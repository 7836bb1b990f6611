import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from thruster_env.core.derivatives import runge_kutta
from thruster_env.graphs.loops import Loops
from thruster_env.thruster.dynamics import (
    rates,
    rates_tangent,
    substep,
    substep_jacobian,
    thrust_and_torque,
    thrust_and_torque_tangent,
    variational_substep,
)
from thruster_env.thruster.parameters import ANGLES, PRESETS, TUNNEL, TUNNEL_PHYSICAL, derive_constants

CASES = {
    f"{name}, {angles}": preset._replace(angles=angles) for name, preset in PRESETS.items() for angles in ANGLES
}
SYMMETRIC = tuple(name for name, p in CASES.items() if p.thrust_asymmetry == 0)
CASES["asymmetric"] = TUNNEL._replace(thrust_asymmetry=0.2)
every_case = pytest.mark.parametrize("p", CASES.values(), ids=CASES.keys())
every_preset = pytest.mark.parametrize("p", PRESETS.values(), ids=PRESETS.keys())


def random_states(count, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(-400, 400, count), rng.uniform(-8, 8, count)


def random_inputs(count, seed=1):
    rng = np.random.default_rng(seed)
    return rng.uniform(-24, 24, count), rng.uniform(-3, 3, count)


def textbook_thrust_and_torque(omega, flow, p):
    """The equations as they are printed, with the four-quadrant inflow angle."""
    radius = p.diameter / 2
    blade = 0.7 * radius * omega / p.gear_ratio
    inflow = math.atan2(flow, blade)
    if p.angles == "as-printed":
        attack = (math.pi / 2 - p.blade_angle) - inflow
        theta = p.blade_angle - attack
    elif p.angles == "rotor-plane":
        attack, theta = p.blade_angle - inflow, inflow
    else:
        attack, theta = (math.pi / 2 - p.blade_angle) - inflow, inflow
    pressure = 0.5 * p.density * (blade**2 + flow**2) * p.area
    lift = pressure * p.lift_coefficient * math.sin(2 * attack)
    drag = pressure * p.drag_coefficient * (1 - math.cos(2 * attack))
    thrust = (lift * math.cos(theta) - drag * math.sin(theta)) * (1 + p.thrust_asymmetry * math.cos(inflow))
    torque = 0.7 * radius * (lift * math.sin(theta) + drag * math.cos(theta))
    return thrust, torque


def textbook_rates(x, u, p):
    (omega, flow), (voltage, ambient) = x, u
    thrust, torque = textbook_thrust_and_torque(omega, flow, p)
    slip = flow - ambient
    return np.array(
        [
            -p.motor_damping * omega + p.voltage_gain * voltage - p.load_gain * torque,
            -(p.momentum_drag / p.added_mass) * slip * abs(slip) + thrust / p.added_mass,
        ]
    )


def textbook_runge_kutta(x, u, p, h):
    k1 = textbook_rates(x, u, p)
    k2 = textbook_rates(x + h / 2 * k1, u, p)
    k3 = textbook_rates(x + h / 2 * k2, u, p)
    k4 = textbook_rates(x + h * k3, u, p)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def assert_close(actual, expected, tolerance=1e-12):
    """Agreement relative to the largest entry of each component."""
    for a, b in zip(actual, expected, strict=True):
        a, b = np.asarray(a), np.asarray(b)
        np.testing.assert_allclose(a, b, rtol=0, atol=tolerance * np.abs(b).max())


@every_case
def test_thrust_and_torque_are_the_trigonometric_ones(p):
    omega, flow = random_states(500)
    expected = np.array([textbook_thrust_and_torque(*x, p) for x in zip(omega, flow, strict=True)]).T
    assert_close(thrust_and_torque((omega, flow), derive_constants(p)), expected)


@every_case
@pytest.mark.parametrize("x", [(100.0, 0.0), (-100.0, 0.0), (0.0, 2.0), (0.0, -2.0), (100.0, -2.0), (-100.0, 2.0)])
def test_forces_are_right_on_the_axes_and_against_the_flow(p, x):
    expected = textbook_thrust_and_torque(*x, p)
    scale = np.abs(expected).max()
    np.testing.assert_allclose(thrust_and_torque(x, derive_constants(p)), expected, rtol=0, atol=1e-12 * scale)


def test_runge_kutta_is_the_exponential_series_to_fourth_order():
    step = runge_kutta(lambda x, u, c: (c.motor_damping * x[0],), 1)
    c = derive_constants(TUNNEL, substep=0.01)
    z = c.motor_damping * c.substep
    assert step((1.0,), (), c)[0] == pytest.approx(1 + z + z**2 / 2 + z**3 / 6 + z**4 / 24, rel=1e-14)


def test_blades_that_turn_ahead_push_ahead_and_are_braked():
    for p in PRESETS.values():
        thrust, torque = thrust_and_torque((100.0, 0.0), derive_constants(p))
        assert thrust > 0 and torque > 0


numbers = st.floats(-1e6, 1e6)


@given(st.sampled_from(SYMMETRIC), numbers, numbers, numbers, numbers)
def test_everything_is_exactly_odd(case, omega, flow, voltage, ambient):
    c = derive_constants(CASES[case], substep=1e-3)
    x, u, minus_x, minus_u = (omega, flow), (voltage, ambient), (-omega, -flow), (-voltage, -ambient)
    assert thrust_and_torque(minus_x, c) == tuple(-y for y in thrust_and_torque(x, c))
    for function in (rates, substep):
        assert function(minus_x, minus_u, c) == tuple(-y for y in function(x, u, c))


def test_asymmetric_thrust_is_stronger_ahead_than_astern_and_the_torque_is_not():
    plain, uneven = derive_constants(TUNNEL), derive_constants(TUNNEL._replace(thrust_asymmetry=0.2))
    for x, factor in (((90.0, 0.0), 1.2), ((-90.0, 0.0), 0.8), ((0.0, 2.0), 1.0)):
        thrust, torque = thrust_and_torque(x, plain)
        np.testing.assert_allclose(thrust_and_torque(x, uneven), (factor * thrust, torque), rtol=1e-14)


@every_case
def test_thrust_and_torque_are_homogeneous_of_degree_two(p):
    omega, flow = random_states(100)
    c = derive_constants(p)
    once = np.array(thrust_and_torque((omega, flow), c))
    np.testing.assert_array_equal(thrust_and_torque((8 * omega, 8 * flow), c), 64 * once)
    assert_close(thrust_and_torque((0.3 * omega, 0.3 * flow), c), 0.09 * once)


def on_floats(x, u, c):
    return [(*rates(a, b, c), *substep(a, b, c)) for a, b in zip(x.tolist(), u.tolist(), strict=True)]


def on_arrays(x, u, c):
    return np.column_stack([*rates(tuple(x.T), tuple(u.T), c), *substep(tuple(x.T), tuple(u.T), c)])


def on_tensors(x, u, c):
    torch = pytest.importorskip("torch")
    x, u = (tuple(torch.tensor(a, dtype=torch.float64).T) for a in (x, u))
    return torch.stack([*rates(x, u, c), *substep(x, u, c)], dim=1).numpy()


def in_machine_code(x, u, c):

    def evaluate(x, u, c, out):
        for j in range(x.shape[0]):
            state, given = (x[j, 0], x[j, 1]), (u[j, 0], u[j, 1])
            out[j, 0], out[j, 1] = rates(state, given, c)
            out[j, 2], out[j, 3] = substep(state, given, c)

    out = np.empty((len(x), 4))
    Loops(evaluate)(x, u, c, out)
    return out


@pytest.mark.parametrize("way", [on_floats, on_arrays, on_tensors, in_machine_code])
@every_preset
def test_one_source_gives_the_same_numbers_every_way(p, way):
    x, u = np.column_stack(random_states(100)), np.column_stack(random_inputs(100))
    c = derive_constants(p, substep=1e-3)
    expected = [
        (*textbook_rates(a, b, p), *textbook_runge_kutta(a, b, p, 1e-3)) for a, b in zip(x, u, strict=True)
    ]
    result = np.asarray(way(x, u, c))
    assert result.dtype == np.float64
    assert_close(result.T, np.transpose(expected))


@pytest.mark.parametrize("way", [on_floats, on_arrays, on_tensors, in_machine_code])
def test_nothing_moves_at_rest_and_nothing_warns(way):
    c = derive_constants(TUNNEL_PHYSICAL, substep=1e-3)
    with np.errstate(divide="raise", invalid="raise", over="raise"):
        np.testing.assert_array_equal(way(np.zeros((3, 2)), np.zeros((3, 2)), c), 0.0)


@every_case
def test_thrust_is_flat_at_rest(p):
    c = derive_constants(p)
    with np.errstate(all="raise"):
        for dx in ((1.0, 0.0), (0.0, 1.0), (-300.0, 5.0)):
            assert thrust_and_torque_tangent((0.0, 0.0), dx, c) == (0.0, 0.0)
    for size in (1e-300, 1e-160, 1e-100, 1e-60, 1e-9):
        forces = thrust_and_torque((300 * size, -5 * size), c)
        assert np.abs(forces).max() <= 1e4 * size**1.9


def central_difference(f, x, dx, h):
    ahead = np.array(f(tuple(a + h * b for a, b in zip(x, dx, strict=True))))
    behind = np.array(f(tuple(a - h * b for a, b in zip(x, dx, strict=True))))
    return (ahead - behind) / (2 * h)


@every_case
@pytest.mark.parametrize("dx", [(100.0, 0.0), (0.0, 2.0), (-70.0, 1.5)])
def test_tangents_are_the_slopes(p, dx):
    x, u, c = random_states(100), random_inputs(100), derive_constants(p)
    expected = central_difference(lambda y: thrust_and_torque(y, c), x, dx, 1e-5)
    assert_close(thrust_and_torque_tangent(x, dx, c), expected, 1e-7)
    expected = central_difference(lambda y: rates(y, u, c), x, dx, 1e-5)
    assert_close(rates_tangent(x, dx, u, c), expected, 1e-7)


@every_preset
def test_substep_jacobian_is_the_slope_of_a_substep(p):
    c = derive_constants(p, substep=1e-3)
    for x, u in zip(np.column_stack(random_states(30)), np.column_stack(random_inputs(30)), strict=True):
        x, u = tuple(x.tolist()), tuple(u.tolist())
        jacobian = np.array(substep_jacobian(x, u, c))
        expected = np.column_stack(
            [
                central_difference(lambda y, u=u: substep(y, u, c), x, (1.0, 0.0), 1e-3),
                central_difference(lambda y, u=u: substep(y, u, c), x, (0.0, 1.0), 1e-5),
            ]
        )
        scale = np.array([[1.0, 50.0], [0.02, 1.0]]) * np.abs(jacobian).max()  # a rad/s weighs 0.02 m/s
        assert (np.abs(jacobian - expected) < 1e-7 * scale).all()


def test_the_perturbed_substep_carries_the_state_of_the_plain_one():
    c = derive_constants(TUNNEL, substep=1e-3)
    y = variational_substep((150.0, 2.0, 1.0, -0.1), (12.0, 0.3), c)
    assert y[:2] == substep((150.0, 2.0), (12.0, 0.3), c)
