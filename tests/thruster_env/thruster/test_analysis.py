"""The thruster near an operating point, and the published linear models."""

import math

import numpy as np
import pytest

from thruster_env.core.matrices import zero_order_hold
from thruster_env.thruster.analysis import (
    INPUTS,
    LinearModel,
    analyse,
    controllability,
    dc_gain,
    frequency_response,
    jacobians,
    linear_model,
    response_figure,
    response_grids,
    state_range,
    steady_state,
    step_response,
    transfer_function,
)
from thruster_env.thruster.dynamics import rates, thrust_and_torque_tangent
from thruster_env.thruster.linear import PUBLISHED, SAMPLE_TIME
from thruster_env.thruster.parameters import ANGLES, PRESETS, TUNNEL, derive_constants

every_preset = pytest.mark.parametrize("p", PRESETS.values(), ids=PRESETS.keys())
every_print = pytest.mark.parametrize("name", PUBLISHED)
every_input = pytest.mark.parametrize("input_name", INPUTS)


def at_voltage(p, voltage=12.0, ambient=0.0):
    return linear_model(p, steady_state(p, voltage, ambient)[:2], voltage, ambient)


def matrices(name):
    return LinearModel(*(np.array(matrix) for matrix in PUBLISHED[name][:3]))


@every_preset
@pytest.mark.parametrize(("flow", "ambient"), [(-1.3, 0.4), (0.8, 2.0), (2.0, -0.5)])
def test_both_columns_of_b_are_the_slopes_of_the_rates(p, flow, ambient):
    c, x, voltage = derive_constants(p), (70.0, flow), 7.0
    model = linear_model(p, x, voltage, ambient)
    for column, step in enumerate(((1e-3, 0.0), (0.0, 1e-5))):
        up, down = np.add((voltage, ambient), step), np.subtract((voltage, ambient), step)
        difference = np.subtract(rates(x, tuple(up), c), rates(x, tuple(down), c)) / (2 * sum(step))
        np.testing.assert_allclose(model.b[:, column], difference, rtol=1e-6, atol=1e-6)


def test_a_linear_model_has_the_known_jacobians():
    a, b, c = jacobians(TUNNEL, (190.0, 3.0), 12.0, 0.5)
    model = linear_model(TUNNEL, (190.0, 3.0), 12.0, 0.5)
    np.testing.assert_array_equal(model.a, a)
    np.testing.assert_array_equal(model.b, [[TUNNEL.voltage_gain, 0.0], [0.0, 2 * 0.910 / 0.954 * 2.5]])
    np.testing.assert_array_equal(model.c, c)
    np.testing.assert_array_equal(model.b[:, :1], b)


def test_controllability_by_hand():
    # B = (2, 0) and A B = (2, 6): columns of [[2, 2], [0, 6]].
    rank, condition = controllability(np.array([[1.0, 5.0], [3.0, 7.0]]), np.array([[2.0], [0.0]]))
    assert rank == 2 and condition == pytest.approx(np.linalg.cond([[2.0, 2.0], [0.0, 6.0]]))
    assert controllability(np.array([[1.0, 5.0], [0.0, 7.0]]), np.array([[2.0], [0.0]]))[0] == 1


@every_preset
def test_pairs_are_controllable_and_observable_in_motion_but_not_at_rest(p):
    spread = state_range(p, 24.0)
    moving = analyse(at_voltage(p), 0.01, spread)
    assert moving.controllability[0] == moving.observability[0] == 2
    assert 1 <= moving.controllability[1] < np.inf and 1 <= moving.observability[1] < np.inf
    resting = analyse(at_voltage(p, 0.0), 0.01, spread)
    assert (resting.controllability[0], resting.observability[0]) == (1, 0)


def test_condition_numbers_do_not_depend_on_the_units_of_the_states():
    model, units = at_voltage(TUNNEL), np.array([60 / (2 * math.pi), 100.0])  # rpm and cm/s
    other = LinearModel(model.a * units[:, None] / units, model.b * units[:, None], model.c / units)
    spread = state_range(TUNNEL, 24.0)
    one, same = analyse(model, 0.01, spread), analyse(other, 0.01, spread * units)
    assert same.controllability[1] == pytest.approx(one.controllability[1], rel=1e-9)
    assert same.observability[1] == pytest.approx(one.observability[1], rel=1e-9)


@every_preset
def test_an_analysis_samples_the_model(p):
    model = at_voltage(p)
    analysis = analyse(model, 0.02, state_range(p, 24.0))
    a_d, b_d = zero_order_hold(model.a, model.b, 0.02)
    np.testing.assert_array_equal(analysis.a_d, a_d)
    np.testing.assert_array_equal(analysis.b_d, b_d)
    np.testing.assert_allclose(np.exp(0.02 * analysis.eigenvalues), np.sort(np.linalg.eigvals(a_d)), rtol=1e-8)


@every_preset
@every_input
def test_a_transfer_function_is_the_closed_form_of_two_states(p, input_name):
    model = at_voltage(p, 12.0, 0.2)
    b, trace = model.b[:, INPUTS.index(input_name)], np.trace(model.a)
    numerator, denominator = transfer_function(model, input_name)
    np.testing.assert_allclose(denominator, [1.0, -trace, np.linalg.det(model.a)], rtol=1e-9)
    # adj(s I - A) = s I + A - tr(A) I
    expected = [0.0, (model.c @ b)[0], (model.c @ (model.a - trace * np.eye(2)) @ b)[0]]
    np.testing.assert_allclose(numerator, expected, rtol=1e-6, atol=1e-9 * np.abs(expected).max())


@every_preset
@every_input
def test_a_frequency_response_is_the_resolvent(p, input_name):
    model, w = at_voltage(p), 40.0
    direct = model.c @ np.linalg.solve(1j * w * np.eye(2) - model.a, model.b)
    gain = frequency_response(model, [1.0, w], input_name)
    assert gain.shape == (2,)
    assert gain[1] == pytest.approx(direct[0, INPUTS.index(input_name)], rel=1e-6)


@every_preset
@every_input
@pytest.mark.parametrize(("voltage", "ambient"), [(12.0, 0.0), (-12.0, 0.0), (6.0, 0.1)])
def test_a_step_ends_at_the_dc_gain_which_is_the_slope_of_the_steady_state(p, input_name, voltage, ambient):
    model, column = at_voltage(p, voltage, ambient), INPUTS.index(input_name)
    gain = dc_gain(model)[:, column]
    slowest = np.abs(np.linalg.eigvals(model.a)).min()
    response = step_response(model, np.linspace(0.0, 40.0 / slowest, 2001), input_name)
    np.testing.assert_allclose(response[-1], gain, rtol=1e-6)
    assert (response[0] == 0).all()
    assert frequency_response(model, 1e-6 * slowest, input_name) == pytest.approx(gain[2], rel=1e-4)
    dv, du = {"V_s": (1e-3, 0.0), "U_0": (0.0, 1e-4)}[input_name]
    up, down = steady_state(p, voltage + dv, ambient + du), steady_state(p, voltage - dv, ambient - du)
    np.testing.assert_allclose(gain, np.subtract(up, down) / (2 * (dv + du)), rtol=1e-4)


def test_a_step_response_is_the_sampled_model_run():
    model = at_voltage(TUNNEL)
    a_d, b_d = zero_order_hold(model.a, model.b, 0.01)
    x, expected = np.zeros(2), []
    for _ in range(30):
        expected.append([*x, *(model.c @ x)])
        x = a_d @ x + b_d[:, 0]
    np.testing.assert_allclose(step_response(model, 0.01 * np.arange(30)), expected, rtol=1e-9, atol=1e-12)


def test_nothing_settles_unless_it_is_stable():
    assert np.isnan(dc_gain(at_voltage(TUNNEL, 0.0))).all()
    assert np.isnan(dc_gain(matrices("open_bladed"))).all()


@every_preset
def test_grids_reach_beyond_all_eigenvalues(p):
    for voltage in (0.0, 12.0):
        model = at_voltage(p, voltage)
        speeds = np.abs(np.linalg.eigvals(model.a))
        frequencies, times = response_grids(model, 50)
        assert frequencies.shape == times.shape == (50,)
        assert frequencies[0] < speeds[speeds > 0].min() and frequencies[-1] > speeds.max()
        assert times[0] == 0 and times[-1] == pytest.approx(5 / speeds[speeds > 0].min())


@pytest.mark.parametrize("function", [transfer_function, lambda m, name: step_response(m, [0.0, 1.0], name)])
def test_an_unknown_input_is_refused(function):
    with pytest.raises(ValueError, match="input_name must be one of V_s, U_0, but got 'T'"):
        function(at_voltage(TUNNEL), "T")


@every_print
def test_zero_order_hold_gives_the_printed_matrices_to_every_digit(name):
    model, system = matrices(name), PUBLISHED[name]
    a_d, b_d = zero_order_hold(model.a, model.b, SAMPLE_TIME)
    np.testing.assert_allclose(a_d, system.printed_a_d, rtol=0, atol=5.1e-5)
    np.testing.assert_allclose(b_d, system.printed_b_d, rtol=0, atol=5.1e-5)


@pytest.mark.parametrize(("name", "trusted"), [("tunnel", True), ("open_bladed", False)])
def test_published_matrices_agree_with_one_another_but_for_one_entry(name, trusted):
    (_, (a_21, a_22)), (_, (_, b_22)), ((c_1, c_2),) = PUBLISHED[name][:3]
    added_mass = PRESETS[name].added_mass
    assert a_21 == pytest.approx(c_1 / added_mass, rel=0.02)
    assert (a_22 == pytest.approx(c_2 / added_mass - b_22, rel=0.02)) is trusted


def test_what_is_said_of_the_print_is_so():
    model = matrices("open_bladed")
    assert -10.4 / 4.0 - 2.73 == pytest.approx(-5.33)
    assert max(np.linalg.eigvals(model.a)) == pytest.approx(3.1872, abs=5e-5)
    assert -np.trace(model.a) == pytest.approx(523.83)
    assert np.linalg.eigvals(model.a).max() > 0
    corrected = model.a.copy()
    corrected[1, 1] = -5.33
    assert np.linalg.eigvals(corrected).max() < 0
    other = zero_order_hold(model.a, model.b / 10, SAMPLE_TIME)[1]
    assert abs(other[0, 0] - PUBLISHED["open_bladed"].printed_b_d[0][0]) > 1e-3
    assert dc_gain(matrices("tunnel"))[2, 0] == pytest.approx(-4.78, abs=0.01)


@every_print
@pytest.mark.parametrize("angles", ANGLES)
def test_in_every_state_a_slope_of_the_forces_has_another_sign_than_in_print(name, angles):
    p, model = PRESETS[name]._replace(angles=angles), matrices(name)
    c = derive_constants(p)
    printed = [*model.c[0], -model.a[0, 0] - p.motor_damping, -model.a[0, 1]]  # dT, then K_h dQ
    # The forces are homogeneous of degree two, so signs of slopes depend on the direction of the state only.
    for angle in np.linspace(0.0, 2 * math.pi, 3601):
        x = (math.cos(angle) / c.blade_speed, math.sin(angle))
        slopes = np.array([thrust_and_torque_tangent(x, dx, c) for dx in ((1.0, 0.0), (0.0, 1.0))])  # dT, dQ
        assert (slopes.T.ravel() * printed <= 0).any()


def test_published_models_belong_to_presets():
    named = [preset for system in PUBLISHED.values() for preset in system.presets]
    assert set(named) <= set(PRESETS) and len(named) == len(set(named))


def test_responses_are_drawn_into_a_whole_file(tmp_path):
    path = response_figure(tmp_path / "new" / "responses.png", at_voltage(TUNNEL), 0.01, "tunnel")
    assert path.read_bytes().startswith(b"\x89PNG")
    with pytest.raises(ValueError, match=r"the thrust must move with the voltage .* but got C = \[0.0, 0.0\]"):
        response_figure(tmp_path / "rest.png", at_voltage(TUNNEL, 0.0), 0.01, "rest")
    assert not (tmp_path / "rest.png").exists()
