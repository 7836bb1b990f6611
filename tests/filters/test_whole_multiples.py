"""A counter x' = (x + 1) % 49 and its turns: the same on all paths, by instructions, calls, tensors and C."""

import contextlib
import math

import numpy as np
import pytest

import filters
from filters import make_filter, run
from filters.c.programs import single_error
from tests.models import state_space
from thruster_env.core.compiled import interpreted
from thruster_env.core.streams import filter_keys

STEPS = 200


def counter(x, u, c):
    k = x[0] + 1.0
    return k % 49, k // 49 + math.floor(x[2] / 49.0), 49 * (x[2] // 49 + (k % 7 == 0.0)), (x[0] > 24) * x[2]


def called(x, u, c):
    limit = 1e9
    while x[0] > limit:  # which cannot be traced
        limit *= 2.0
    return counter(x, u, c)


def still(x, u, c):  # as differences across a jump would be no derivative
    return (1.0, 0.0, 0.0, 0.0), (0.0,) * 4, (0.0,) * 4, (0.0,) * 4


def model(transition):
    noise = {"q": [1e-30] * 4, "r": [1e6]}
    prior = {"mean": [48.0, 0.0, 49.0, 0.0], "cov": [1e-30] * 4}
    return state_space(transition, lambda x, c: (x[0],), **noise, **prior, transition_jacobian=still, inputs=0)


def expected():
    found = [(48.0, 0.0, 49.0, 0.0)]
    for _ in range(STEPS):
        found.append(counter(found[-1], (), ()))
    return np.array(found, dtype=float)


def runs_of(transition, name):
    filter_ = make_filter(name, model(transition))
    return run(filter_, filter_keys([0]), np.zeros((1, STEPS, 0)), np.full((1, STEPS + 1, 1), np.nan)).means[0]


def test_python_has_a_counter_that_returns_to_zero():
    assert (expected()[1::49, 0] == 0.0).all() and expected()[:, 0].max() == 48.0


@pytest.mark.parametrize(
    "compiled, transition, name",
    [
        (False, counter, "ekf"),
        (False, called, "ekf"),
        (True, counter, "ekf"),
        pytest.param(True, called, "ekf", marks=pytest.mark.slow),
        pytest.param(True, counter, "gsf", marks=pytest.mark.slow),
    ],
)
def test_a_filter_that_hears_nothing_counts(compiled, transition, name):
    with contextlib.nullcontext() if compiled else interpreted():
        np.testing.assert_allclose(runs_of(transition, name), expected(), atol=1e-12)


def test_tensors_count_alike():
    pytest.importorskip("torch")
    filter_ = filters.torch(make_filter("ekf", model(counter)))
    found = filter_.run(None, np.full((2, STEPS + 1, 1), np.nan))
    np.testing.assert_allclose(found.means[1], expected(), atol=1e-12)


def test_single_precision_counts_alike():
    from filters.c.programs import programs_of

    filter_ = make_filter("ekf", model(counter).replace(process_noise_cov=[1e-6] * 4, prior_cov=[1e-6] * 4))
    with interpreted():
        z = np.full((STEPS + 1, 1), np.nan)
        assert single_error(filter_, programs_of(filter_), np.zeros((STEPS, 0)), z) < 0.01
