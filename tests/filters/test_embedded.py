"""Models of fewer states within larger ones: functions and slopes in tuples and in arrays."""

import pickle

import numpy as np
import pytest

from filters import StateSpaceModel
from filters.augmented import embedded_model
from thruster_env.core.compiled import interpreted


def pushed(x, u, c):
    return [x[i] + 0.1 * x[i - 1] ** 2 for i in range(len(x))]


def slopes(x, u, c):
    found = np.eye(len(x))
    for i in range(len(x)):
        found[i, i - 1] += 0.2 * x[i - 1]
    return found


def corner(x, c):
    return (x[0] * x[1],)


def corner_slopes(x, c):
    return (tuple(float(x[1 - i]) if i < 2 else 0.0 for i in range(len(x))),)


@pytest.mark.parametrize("n", [3, 7, 40])
def test_slopes_within_a_larger_model_are_those_of_its_functions(n):
    """In tuples, in arrays, and of tuples within arrays; also after pickle."""

    def model(size, names):
        return StateSpaceModel(
            transition=pushed,
            observe=corner,
            transition_jacobian=slopes,
            observe_jacobian=corner_slopes,
            process_noise_cov=np.full(size, 0.1),
            measurement_noise_cov=[1.0],
            prior_mean=np.linspace(1.0, 2.0, size),
            prior_cov=np.full(size, 0.1),
            states=names,
        )

    names = [f"s{i}" for i in range(n)]
    small, whole = model(n - 1, names[:0:-1]), model(n, names)
    one = pickle.loads(pickle.dumps(embedded_model(small, whole)))
    x = np.random.default_rng(n).normal(size=n)
    with interpreted():
        given = (tuple(x) if n <= 36 else x), (0.0,), ()
        np.testing.assert_allclose(one.functions.transition(*given)[0], x[0])
        np.testing.assert_allclose(one.functions.transition(*given)[1:], pushed(x[:0:-1], (), ())[::-1])
        f, h = np.zeros((n, n)), np.zeros((1, n))
        f[0, 0], f[1:, 1:], h[0, 1:] = (
            1.0,
            slopes(x[:0:-1], (), ())[::-1, ::-1],
            corner_slopes(x[:0:-1], ())[0][::-1],
        )
        np.testing.assert_allclose(one.functions.transition_jacobian(*given), f)
        np.testing.assert_allclose(one.functions.observe_jacobian(given[0], ()), h)
