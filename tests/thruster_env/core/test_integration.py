"""Steps of rates, their Jacobians, and results of functions as arrays."""

import numpy as np
import pytest

from thruster_env.core.derivatives import euler, euler_jacobian, runge_kutta, runge_kutta_jacobian
from thruster_env.core.streams import nearest_whole
from thruster_env.graphs.loops import Loops
from thruster_env.model.traced import _array_valued


class Step:
    substep = 0.1


def oscillators(x, u, c):
    return (x[1], -x[0] - x[1] * abs(x[1]) + u[0])


def oscillators_tangent(x, dx, u, c):
    return (dx[1], -dx[0] - 2.0 * abs(x[1]) * dx[1])


@pytest.mark.parametrize(
    "step, jacobian",
    [
        (runge_kutta(oscillators, 2), runge_kutta_jacobian(oscillators, oscillators_tangent, 2)),
        (euler(oscillators, 2), euler_jacobian(oscillators_tangent, 2)),
    ],
)
def test_the_jacobian_of_a_step_is_its_slope_and_of_small_models_a_tuple(step, jacobian):
    x, u, h = np.array([0.4, -0.7]), (0.3,), 1e-6
    found = jacobian(tuple(x), u, Step)
    columns = [
        (np.array(step(tuple(x + d), u, Step)) - step(tuple(x - d), u, Step)) / (2 * h) for d in h * np.eye(2)
    ]
    np.testing.assert_allclose(found, np.transpose(columns), atol=1e-9)
    assert type(found) is tuple and type(found[0]) is tuple


def test_the_same_rates_give_the_same_step_so_that_a_model_made_anew_is_not_compiled_anew():
    assert runge_kutta(oscillators, 2) is runge_kutta(oscillators, 2)
    assert euler(oscillators, 2) is euler(oscillators, 2)


def test_a_state_of_another_size_than_count_is_refused():
    with pytest.raises(ValueError, match=r"count of runge_kutta.* must be the number of states, but got 2"):
        runge_kutta(oscillators, 2)((1.0, 0.0, 1.0, 0.0), (0.0,), Step)


def test_euler_is_the_first_order_of_runge_kutta():
    assert euler(oscillators, 2)((1.0, 0.5), (0.0,), Step) == (1.05, 0.5 + 0.1 * (-1.0 - 0.25))


def rows_of_six(x):
    other = (0.0, 0.0, x[1], 0.0, 0.0, 0.0)
    return (x[0], 1.0, 2, 3.0, 4.0, 5.0), other, other, other, other, other


def test_rows_of_a_large_matrix_are_compiled_and_not_run_as_python():
    rows = _array_valued(rows_of_six, "x", 6, 6)

    def evaluate(x, out):
        out[:] = rows(x)

    function, result = Loops(evaluate), np.empty((6, 6))
    function((7.0, 8.0), result)
    assert not function.in_python
    np.testing.assert_array_equal(result, rows_of_six((7.0, 8.0)))


def test_the_nearest_whole_number_is_found_on_either_side():
    x = np.array([-2.6, -2.4, -0.3, 0.0, 0.2, 0.7, 1e9 + 0.4])
    np.testing.assert_allclose(nearest_whole(x), np.round(x), rtol=0, atol=2e-16)
