"""Pages of filters of models whose functions are called, along constants, and of models of any size."""

import math
from functools import partial

import numpy as np
import pytest

from filters import differentiated
from filters.differentiated import AT_ONCE, Wanted, recursion_of
from filters.pages.page import called_at_points
from filters.sensitivity import differentiable, likelihood, state_score
from tests.filters.test_differentiated import units
from tests.filters.test_likelihood import directions
from tests.filters.test_pages import NAMES, assert_slopes, gaze, gaze_slopes, made, whirl, wide_pendulum
from tests.filters.test_sensitivity import ring
from tests.filters.test_state_scores import data_of
from tests.models import random_affine, simulated

PLAIN = Wanted(information=False, constants=False, tails=False)


def turn_if(x, u, c):
    """The pendulum, by a function that cannot be traced."""
    return (0.0, 0.0) if int(abs(x[1]) > 1e6) else whirl(x, u, c)


def at_once(model, filter_):
    used, page, _ = differentiable(model, filter_)
    return recursion_of(used.functions, used.shape, PLAIN, page, True).at_once


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("name", NAMES)
def test_functions_that_are_called_have_the_derivatives_of_those_that_are_traced(name):
    model = wide_pendulum()
    decides = model.replace(transition=turn_if)
    _, inputs, z, x = data_of(model, steps=12)
    slopes = tuple(map(np.array, directions(model)))
    assert (at_once(model, made(name, model)), at_once(decides, made(name, decides))) == (
        AT_ONCE,
        1,
    )
    for work in (likelihood, partial(state_score, states=x)):
        given = {"inputs": inputs, "measurements": z, "q_slopes": slopes[0], "r_slopes": slopes[1]}
        traced, called = (work(one, **given, filter=made(name, one)) for one in (model, decides))
        np.testing.assert_allclose(called.values, traced.values, rtol=1e-11)
        assert_slopes(called.gradients, traced.gradients, 1e-8)


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("name", NAMES)
def test_a_model_that_is_too_large_to_be_written_out_is_called(name, monkeypatch):
    monkeypatch.setattr(differentiated, "most_operations", lambda shape: 50)
    recursion_of.cache_clear()
    model = random_affine(n=7, m=2, p=1)  # its matrices are arrays
    inputs, z = simulated(model, 3, count=2, missing=0.2)
    slopes = units(model)
    slopes = slopes[0], np.array([np.zeros((2, 2))] * 7 + [np.eye(2)])
    assert at_once(model, made(name, model)) == 1
    kalman, other = (likelihood(model, inputs, z, *slopes, filter=one) for one in (None, made(name, model)))
    recursion_of.cache_clear()
    np.testing.assert_allclose(other.values, kalman.values, rtol=1e-11)
    np.testing.assert_allclose(other.gradients, kalman.gradients, rtol=1e-7, atol=1e-7)


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("points", [3, 40])
def test_the_slope_of_points_goes_the_short_way_over_the_cut(points):
    model = wide_pendulum()
    values, slopes = called_at_points(model.functions, model.shape, "sight", False, points)
    x, dx = (np.tile([[a], [b]], points) for a, b in ((math.pi, 1.0), (1.0, 0.5)))
    seen, expected = gaze(x[:, 0], model.constants), np.array(gaze_slopes(x[:, 0], model.constants)) @ dx[:, 0]
    np.testing.assert_allclose(np.array(values(x, model.constants)).T, [seen] * points)
    found = np.array(slopes(x, np.ones(2), model.constants, dx))
    np.testing.assert_allclose(found.T, [expected] * points, rtol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES[:1])
def test_forty_states_have_the_derivatives_of_kalmans_filter(name):
    model = ring(40)
    inputs, z = simulated(model, 20, count=2, missing=0.2)
    q, r = np.array([np.eye(40), np.zeros((40, 40))]), np.array([np.zeros((20, 20)), np.eye(20)])
    kalman, other = (likelihood(model, inputs, z, q, r, filter=one) for one in (None, made(name, model)))
    np.testing.assert_allclose(other.values, kalman.values, rtol=1e-11)
    np.testing.assert_allclose(other.gradients, kalman.gradients, rtol=1e-7)
