"""The extended filter as a page: it is the filter, and its derivatives are exact, whatever a model is made of."""

import math

import numpy as np
import pytest

from filters import differentiated
from filters.differentiated import Wanted, recursion_of
from filters.sensitivity import ModelSlopes, information, likelihood, sensitivity
from tests.filters.test_sensitivity import case, slopes_of
from tests.filters.test_sensitivity import pendulum as turning_pendulum
from tests.models import DT, pendulum, simulated, swing, wide_model
from thruster_env.core.compiled import interpreted
from thruster_env.graphs import machine_code

PLAIN = Wanted(information=False, constants=False, tails=False)


def swing_if(x, u, c):
    """The pendulum, by a function that cannot be traced."""
    if int(abs(x[1]) > 1e6):
        return (0.0, 0.0)
    return swing(x, u, c)


def swing_by_kind(x, u, c):
    """The pendulum, but for numbers that are no floats."""
    found = swing(x, u, c)
    return found if hasattr(x[0], "is_integer") else (found[0], 0.5 * found[1])


def swing_undefined(x, u, c):
    """Not a number anywhere near where graphs are compared."""
    return (math.sqrt(x[0] - 1e3), x[1])


def at_once(model):
    with interpreted():
        return recursion_of(model.functions, model.shape, PLAIN, differentiated.EXTENDED, True).at_once


@pytest.mark.usefixtures("as_python")
def test_only_what_can_be_traced_becomes_a_program():
    assert at_once(pendulum()) == at_once(wide_model()) == at_once(turning_pendulum()) == differentiated.AT_ONCE
    assert at_once(pendulum(transition=swing_if)) == at_once(pendulum(transition=swing_by_kind)) == 1
    assert at_once(pendulum(transition=swing_undefined, prior_mean=[2e3, 0.0])) == 1


@pytest.mark.usefixtures("as_python")
def test_a_graph_that_is_too_large_is_called(monkeypatch):
    monkeypatch.setattr(differentiated, "most_operations", lambda shape: 50)
    recursion_of.cache_clear()
    assert at_once(wide_model()) == 1
    recursion_of.cache_clear()


def units(model):
    q = [np.diag(row) for row in np.eye(model.n)] + [np.zeros((model.n, model.n))]
    return np.array(q), np.array([np.zeros((model.m, model.m))] * model.n + [np.ones((model.m, model.m))])


@pytest.mark.usefixtures("as_python")
def test_functions_that_are_called_have_the_derivatives_of_those_that_are_traced():
    inputs, z = simulated(pendulum(), 10, count=2, missing=0.2)
    found = []
    for function in (swing, swing_if):
        model = pendulum(transition=function)
        q, r = units(model)
        slopes = ModelSlopes(np.array([[0.1, 0.0], [0.0, 0.01], [0, 0]]), q, r, np.eye(3)[:, :2], q)
        for degrees in (math.inf, 4.0):
            found.append(sensitivity(model, inputs, z, slopes, degrees=degrees, predicted=[False, True], blocks=2))
            found.append(sensitivity(model, inputs, z, slopes, degrees=degrees))
        found.append([information(model, inputs, z, q, r), *likelihood(model, inputs, z, q, r)])
    for one, other in zip(found[:5], found[5:], strict=True):
        for a, b in zip(one, other, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5 * abs(b).max())  # differences of differences


def likelihood_of_complex(model, q, r, inputs, measurements):
    """The pendulum's log-likelihood as a textbook has it, of complex Q and R."""
    (gravity, damping), total = model.constants, 0.0
    x, p = model.prior_mean + 0j, model.prior_cov + 0j
    for k, z in enumerate(measurements):
        if k:
            sign = -1.0 if x[1].real < 0 else 1.0
            rate = x[1] + DT * (-gravity * np.sin(x[0]) - damping * x[1] * x[1] * sign + inputs[k - 1, 0])
            lower = [-DT * gravity * np.cos(x[0]), 1.0 - 2.0 * DT * damping * x[1] * sign]
            f = np.array([[1.0 + DT * lower[0], DT * lower[1]], lower])
            x, p = np.array([x[0] + DT * rate, rate]), f @ p @ f.T + q
        there = ~np.isnan(z)
        if there.any():
            h = np.array([[np.cos(x[0]), 0.0], [x[1], x[0]]])[there]
            v, s = (z - np.array([np.sin(x[0]), x[0] * x[1]]))[there], h @ p @ h.T + r[np.ix_(there, there)]
            gain = np.linalg.solve(s, h @ p).T
            total -= 0.5 * (v @ np.linalg.solve(s, v) + np.log(np.linalg.det(2 * np.pi * s)))
            x, p = x + gain @ v, p - gain @ s @ gain.T
    return total


def test_the_gradient_of_a_model_without_jacobians_is_exact():
    model = pendulum()
    inputs, z = simulated(model, 40, count=6, missing=0.2)
    q_slopes, r_slopes = units(model)
    found = likelihood(model, inputs, z, q_slopes, r_slopes)
    q, r = model.process_noise_cov, model.measurement_noise_cov
    for b in range(6):
        for j, (dq, dr) in enumerate(zip(q_slopes, r_slopes, strict=True)):
            value = likelihood_of_complex(model, q + 1e-30j * dq, r + 1e-30j * dr, inputs[b], z[b])
            assert found.values[b] == pytest.approx(value.real, rel=1e-12)
            assert found.gradients[b, j] == pytest.approx(value.imag / 1e-30, rel=1e-10)


def test_runs_that_lie_together_do_not_know_of_one_another():
    make, values, sizes, inputs, z = case("pendulum", count=7, steps=20)
    slopes = slopes_of(make, values, sizes)
    together = sensitivity(make(**values), inputs, z, slopes, blocks=3)
    for b in range(7):
        alone = sensitivity(make(**values), inputs[b : b + 1], z[b : b + 1], slopes, blocks=3)
        for one, other in zip(together, alone, strict=True):
            np.testing.assert_array_equal(one[b], other[0])


def test_machine_code_of_a_program_is_found_again_and_that_of_another_is_not_taken(monkeypatch):
    inputs, z = simulated(pendulum(), 3)
    for gain, functions in ((1.0, 2), (1.5, 1)):
        for _ in range(functions):
            model = pendulum(transition=partial_swing(gain))
            found = likelihood(model, inputs, z, *units(model))
            with interpreted():
                expected = likelihood(model, inputs, z, *units(model))
            np.testing.assert_allclose(found.values, expected.values, rtol=1e-12)
    compiled = recursion_of(model.functions, model.shape, PLAIN, differentiated.EXTENDED, False).run
    recursion_of.cache_clear()
    monkeypatch.setattr(machine_code, "_compiled", lambda text: pytest.fail("the code is compiled again"))
    again = recursion_of(model.functions, model.shape, PLAIN, differentiated.EXTENDED, False).run
    assert again is not compiled


def partial_swing(gain):
    def swing_with(x, u, c):
        return swing(x, (gain * u[0],), c)

    return swing_with
