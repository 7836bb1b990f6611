"""Functions of floats that tensors would answer for one trajectory: refused, as for two."""

import math

import numpy as np
import pytest

import filters
from filters import make_filter, run
from tests.models import state_space
from thruster_env.core.streams import filter_keys

torch = pytest.importorskip("torch")
Z = np.array([0.3, 1.1, 0.4, 0.9])[None, :, None]
TABLE = [0.5, 0.9]


def model(transition):
    return state_space(
        transition, lambda x, c: (x[0],), q=[0.1, 0.1], r=[0.1], mean=[0.3, 0.2], cov=[1.0, 1.0], inputs=0
    )


def rounds(x, u, c):
    k = 0.0
    while x[0] > k:
        k += 1.0
    return math.exp(-0.1 * x[0]) + 0.01 * k, x[1]


def looks_up(x, u, c):
    return TABLE[int(x[1] > 0)] * x[0], x[1]


def interpolates(x, u, c):
    return np.interp(x[0], [0.0, 1.0], [0.0, 1.0], period=2.0), x[1]


@pytest.mark.parametrize("function", [rounds, looks_up, interpolates])
@pytest.mark.parametrize("count", [1, 2])
def test_a_function_that_asks_a_tensor_for_a_number_is_refused(function, count):
    filter_ = filters.torch(make_filter("ekf", model(function)))
    for _ in range(2):  # the second time, too
        with pytest.raises(ValueError, match=r"transition must accept tensors[^\n]*asked for one number"):
            filter_.run(None, np.repeat(Z, count, axis=0))


def exponential(x, u, c):
    return (math.exp(-0.1 * x[0]) if x[0] > -50.0 else x[0]), 0.5 * sum([x[0] > 0.5, x[1] > 0.1, x[0] > 0.2])


@pytest.mark.parametrize("count", [1, 2])
def test_branches_and_functions_of_math_have_their_numbers_and_derivatives(count, as_python):
    filter_ = make_filter("ekf", model(exponential))
    expected = run(filter_, filter_keys([0]), np.zeros((1, 3, 0)), Z)
    found = filters.torch(filter_).run(None, np.repeat(Z, count, axis=0))
    np.testing.assert_allclose(found.means, np.repeat(expected.means, count, axis=0), rtol=1e-12)
    assert found.means.dtype is torch.float64


@pytest.mark.parametrize("count", [1, 2])
def test_a_given_function_may_not_ask_either_but_may_leave_torch(count):
    filter_ = make_filter("ekf", model(exponential))
    asking = filters.torch(filter_, transition=lambda x, u, c: (math.exp(-0.1 * x[0]), x[1]))
    with pytest.raises(ValueError, match="asked for one number"):
        asking.run(None, np.repeat(Z, count, axis=0))
    given = filters.torch(filter_, transition=lambda x, u, c: (torch.exp(-0.1 * x[0]), x[1]))
    assert given.run(None, np.repeat(Z, count, axis=0)).means.isfinite().all()


def test_a_sum_of_comparisons_that_tensors_have_otherwise_is_refused():
    def f(x, u, c):
        kinds = {0: 0.5}
        return kinds[0 if len(str(type(x[0]))) else 1] * x[0], ((x[0] > 0.5) + (x[1] > 0.5)) * hash_free(x[1])

    def hash_free(value):
        return {value: 1.0}[value]  # which keeps it from being traced

    with pytest.raises(ValueError, match="a sum of comparisons is no number"):
        filters.torch(make_filter("ekf", model(f))).run(None, Z)
