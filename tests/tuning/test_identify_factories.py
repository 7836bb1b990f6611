"""Identification of models whose functions are written within a factory: the numbers of functions of a module."""

import numpy as np
import pytest

from thruster_env.numerics.streams import filter_keys
from thruster_env.plants.state_space import StateSpaceModel
from tuning.identification import identify
from tuning.identification.objective import Objective
from tuning.problems.coordinates import Coordinates
from tuning.problems.data import Data
from tuning.problems.parameter import Parameter

DT = 0.1
FREE = (
    Parameter("gain", 0.2, 20.0, default=1.5),
    Parameter("rate", 0.1, 10.0, default=0.8),
    Parameter("r", 1e-3, 1.0, default=0.05),
)
REST = {
    "process_noise_cov": [1e-4],
    "prior_mean": [0.0],
    "prior_cov": [1.0],
    "inputs": 1,
}


def transition(x, u, c):
    return (x[0] + DT * (c[0] * u[0] - c[1] * x[0]),)


def observe(x, c):
    return (x[0],)


def of_module(gain=2.0, rate=1.0, r=0.04):
    return StateSpaceModel(
        transition=transition,
        observe=observe,
        measurement_noise_cov=[r],
        constants=(gain, rate),
        **REST,
    )


def of_factory(gain=2.0, rate=1.0, r=0.04):
    step = DT

    def move(x, u, c):
        return (x[0] + step * (c[0] * u[0] - c[1] * x[0]),)

    return StateSpaceModel(
        transition=move,
        observe=lambda x, c: (x[0],),
        measurement_noise_cov=[r],
        constants=(gain, rate),
        **REST,
    )


def with_one_lambda(gain=2.0, rate=1.0, r=0.04):
    return of_module(gain, rate, r).replace(observe=lambda x, c: (x[0],))


def in_closure(gain=2.0, rate=1.0, r=0.04):
    """The parameters are in the functions themselves: models differ in more than numbers."""

    def move(x, u, c):
        return (x[0] + DT * (gain * u[0] - rate * x[0]),)

    return StateSpaceModel(transition=move, observe=observe, measurement_noise_cov=[r], **REST)


def recorded(runs=2, steps=60):
    rng = np.random.default_rng(0)
    inputs, measured = rng.normal(size=(runs, steps, 1)), np.zeros((runs, steps + 1, 1))
    x = np.zeros(runs)
    for k in range(steps + 1):
        measured[:, k, 0] = x + 0.2 * rng.normal(size=runs)
        if k < steps:
            x = x + DT * (2.0 * inputs[:, k, 0] - x) + 0.01 * rng.normal(size=runs)
    return Data(tuple(range(runs)), inputs, measured, filter_keys(range(runs)), 0)


@pytest.mark.parametrize("make", [of_factory, with_one_lambda])
def test_the_log_likelihood_and_its_derivatives_are_those_of_functions_of_a_module(as_python, make):
    data, coordinates = recorded(steps=30), Coordinates(FREE)
    one, other = (Objective(data, made, coordinates) for made in (of_module, make))
    assert other.rough == one.rough == ()
    for a, b in zip(one(coordinates.start()), other(coordinates.start()), strict=True):
        np.testing.assert_array_equal(a, b)


def test_scores_and_information_of_parameters_in_a_closure_are_those_of_constants(as_python):
    """By differences: each block of a run has a score of its own, and two such parameters are correlated."""
    data, coordinates = recorded(steps=30), Coordinates(FREE)
    one, other = (Objective(data, made, coordinates) for made in (of_module, in_closure))
    at = coordinates.of([2.0, 1.0, 0.04])
    expected, found = one(at), other(at)
    assert found.value == pytest.approx(expected.value, rel=1e-12)
    assert found.scores.shape == (20, 3) == expected.scores.shape
    np.testing.assert_allclose(found.scores, expected.scores, atol=2e-3 * abs(expected.scores).max())
    np.testing.assert_allclose(found.part_values, expected.part_values, rtol=1e-9)
    assert found.part_values.sum() == pytest.approx(found.value)


def test_the_curvature_of_two_parameters_in_a_closure_is_that_of_the_log_likelihood(as_python):
    data, coordinates = recorded(steps=30), Coordinates(FREE)
    objective, at = Objective(data, in_closure, coordinates), coordinates.of([2.0, 1.0, 0.04])
    smooth, step = Objective(data, of_module, coordinates), 1e-3 * np.eye(3)
    of_gradients = [(smooth(at - one).gradient - smooth(at + one).gradient) / 2e-3 for one in step]
    np.testing.assert_allclose(objective(at).information[:2, :2], np.array(of_gradients)[:2, :2], rtol=2e-2)


@pytest.mark.slow
@pytest.mark.parametrize("make", [of_factory, with_one_lambda, in_closure])
def test_standard_errors_are_those_of_functions_of_a_module(make):
    data = recorded(steps=120)
    expected, found = (identify(data, made, FREE[:2]) for made in (of_module, make))
    for name in ("gain", "rate"):
        assert found.values[name] == pytest.approx(expected.values[name], rel=1e-3)
        assert found.standard_errors[name] == pytest.approx(expected.standard_errors[name], rel=0.1)
