"""Identification of models whose functions are written within a factory: the numbers of functions of a module."""

import types
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
import pytest

from thruster_env.core.streams import filter_keys
from thruster_env.logs.log import in_any_steps
from thruster_env.model.continuous import ContinuousModel
from thruster_env.model.state_space import StateSpaceModel
from tuning.likelihood.recorded import likelihood_of
from tuning.problems.data import Data
from tuning.problems.problem import Coordinates, Parameter

DT = 0.1
FREE = Parameter("gain", 0.2, 20.0, default=1.5), Parameter("rate", 0.1, 10.0, default=0.8)
FREE += (Parameter("r", 1e-3, 1.0, default=0.05),)
REST = {"process_noise_cov": [1e-4], "prior_mean": [0.0], "prior_cov": [1.0], "inputs": 1}


def transition(x, u, c):
    return (x[0] + DT * (c[0] * u[0] - c[1] * x[0]),)


def observe(x, c):
    return (x[0],)


def of_module(gain=2.0, rate=1.0, r=0.04):
    arguments = {"measurement_noise_cov": [r], "constants": (gain, rate), **REST}
    return StateSpaceModel(transition=transition, observe=observe, **arguments)


def of_factory(gain=2.0, rate=1.0, r=0.04):
    step = DT

    def move(x, u, c):
        return (x[0] + step * (c[0] * u[0] - c[1] * x[0]),)

    return of_module(gain, rate, r).replace(transition=move, observe=lambda x, c: (x[0],))


def with_one_lambda(gain=2.0, rate=1.0, r=0.04):
    return of_module(gain, rate, r).replace(observe=lambda x, c: (x[0],))


def in_closure(gain=2.0, rate=1.0, r=0.04):
    """The parameters are in the functions themselves: models differ in more than numbers."""

    def move(x, u, c):
        return (x[0] + DT * (gain * u[0] - rate * x[0]),)

    return StateSpaceModel(transition=move, observe=observe, measurement_noise_cov=[r], **REST)


def with_jacobians(gain=2.0, rate=1.0, r=0.04):
    model, step = in_closure(gain, rate, r), DT
    slopes = {"observe_jacobian": lambda x, c: ((1.0,),)}
    return model.replace(transition_jacobian=lambda x, u, c: ((1.0 - step * rate,),), **slopes)


def complex_steps(gain=2.0, rate=1.0, r=0.04):
    return in_closure(gain, rate, r).replace(analytic=True)


class Plant:
    def __init__(self, gain, rate):
        self.gain, self.rate = gain, rate

    def move(self, x, u, c):
        return (x[0] + DT * (self.gain * u[0] - self.rate * x[0]),)


def of_an_object(gain=2.0, rate=1.0, r=0.04):
    plant = Plant(gain, rate)
    return in_closure(r=r).replace(transition=lambda x, u, c: plant.move(x, u, c))


def of_a_method(gain=2.0, rate=1.0, r=0.04):
    return in_closure(r=r).replace(transition=Plant(gain, rate).move)


def of_a_partial(gain=2.0, rate=1.0, r=0.04):
    def move(given, x, u, c):
        return (x[0] + DT * (given[0] * u[0] - given[1] * x[0]),)

    return in_closure(r=r).replace(transition=partial(move, (gain, rate)))


def of_an_array(gain=2.0, rate=1.0, r=0.04):
    matrix = np.array([[1.0 - DT * rate, DT * gain]])

    def move(x, u, c):
        return (matrix[0, 0] * x[0] + matrix[0, 1] * u[0],)

    return in_closure(r=r).replace(transition=move)


def of_a_local_class(gain=2.0, rate=1.0, r=0.04):
    class Local:
        def __init__(self):
            self.numbers = types.MappingProxyType({"gain": np.float64(gain), "rate": np.array(rate)})

        def move(self, x, u, c):
            return (x[0] + DT * (self.numbers["gain"] * u[0] - self.numbers["rate"] * x[0]),)

    return in_closure(r=r).replace(transition=Local().move)


@dataclass(slots=True)
class Callable:
    gain: float
    rate: float

    def __call__(self, x, u, c):
        return (x[0] + DT * (self.gain * u[0] - self.rate * x[0]),)


@dataclass
class WithoutHash(Callable):
    """Dataclasses that can be changed have no hash."""


def of_a_callable_without_hash(gain=2.0, rate=1.0, r=0.04):
    return in_closure(r=r).replace(transition=WithoutHash(gain, rate))


def of_a_callable(gain=2.0, rate=1.0, r=0.04):
    return in_closure(r=r).replace(transition=Callable(gain, rate))


GAIN = 2.0


def read_global(x, u, c):
    return (x[0] + DT * (GAIN * u[0] - c[0] * x[0]),)


def of_a_global(gain=2.0, rate=1.0, r=0.04):
    global GAIN
    GAIN = gain
    return in_closure(r=r).replace(transition=read_global, constants=(rate,))


class Step(NamedTuple):
    substep: float = DT


class StepAndNumbers(NamedTuple):
    substep: float
    gain: float
    rate: float


def continuous(rates, constants, r):
    arguments = {name: value for name, value in REST.items() if name != "process_noise_cov"}
    arguments["measurement_noise_cov"] = [r]
    numbers = {"densities": [1e-3], "constants": constants, "arguments": arguments}
    return ContinuousModel(rates=rates, observe=observe, **numbers).at(DT)


def in_continuous_time(gain=2.0, rate=1.0, r=0.04):
    return continuous(lambda x, u, c: (gain * u[0] - rate * x[0],), Step(), r)


def of_constants_in_continuous_time(gain=2.0, rate=1.0, r=0.04):
    return continuous(lambda x, u, c: (c.gain * u[0] - c.rate * x[0],), StepAndNumbers(DT, gain, rate), r)


def of_floats_alone(gain=2.0, rate=1.0, r=0.04):
    """It cannot be traced: each value of a parameter is another function, along which there are differences."""

    def move(x, u, c):
        int(x[0])  # asks for a float
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


CAPTURED = [in_closure, with_jacobians, complex_steps, of_an_object, of_a_method, of_a_partial, of_an_array]
CAPTURED += [of_a_local_class, of_a_callable, of_a_callable_without_hash]
PAIRS = [*((of_module, one) for one in CAPTURED), (of_constants_in_continuous_time, in_continuous_time)]


def assert_equal(expected, make, data, tolerance=1e-6):
    """Log-likelihood and derivatives of two factories are the same, and no parameter is without sensitivities."""
    coordinates = Coordinates(FREE)
    one, other = (likelihood_of(data, factory, coordinates) for factory in (expected, make))
    assert other.rough == ()
    at = coordinates.of([1.8, 0.9, 0.05])
    for a, b in zip(one(at), other(at), strict=True):
        np.testing.assert_allclose(b, a, rtol=tolerance, atol=tolerance * np.abs(a).max())


@pytest.mark.parametrize("make", [of_factory, with_one_lambda])
def test_the_log_likelihood_and_its_derivatives_are_those_of_functions_of_a_module(as_python, make):
    assert_equal(of_module, make, recorded(steps=30), 0.0)


@pytest.mark.parametrize(("expected", "make"), PAIRS)
def test_parameters_in_a_closure_have_the_derivatives_of_constants(as_python, expected, make):
    assert_equal(expected, make, recorded(steps=30))


def test_a_factory_that_sets_a_global_for_its_functions_is_refused(as_python):
    with pytest.raises(ValueError, match="must not read values that its factory sets, but 'gain' changes those"):
        likelihood_of(recorded(steps=30), of_a_global, Coordinates(FREE))


def test_parameters_in_a_closure_are_constants_of_steps_of_any_length_too(as_python):
    data = recorded(steps=30)
    ratios = np.random.default_rng(1).uniform(0.2, 1.8, (2, 30, 1))
    data = data._replace(inputs=np.concatenate([data.inputs, ratios], axis=2))
    makes = of_constants_in_continuous_time, in_continuous_time
    assert_equal(*(lambda make=make, **v: in_any_steps(make(**v)) for make in makes), data)


def test_a_number_in_a_function_that_differs_elsewhere_only_is_refused(as_python):
    def make(gain=2.0, rate=1.0, r=0.04):
        other = 2.0 if abs(gain - 7.77) < 1e-3 else 1.0
        return in_closure(r=r).replace(transition=lambda x, u, c: (other * x[0] - rate * x[0] + gain * u[0],))

    coordinates = Coordinates(FREE)
    objective = likelihood_of(recorded(steps=30), make, coordinates)
    with pytest.raises(ValueError, match="transition must differ .* pass the parameters to it as constants"):
        objective(coordinates.of([7.77, 1.0, 0.04]))


def test_blocks_have_scores_of_their_own_along_parameters_without_derivatives(as_python):
    data, coordinates = recorded(steps=30), Coordinates(FREE)
    one, other = (likelihood_of(data, made, coordinates) for made in (of_module, of_floats_alone))
    assert other.rough == (0, 1)
    at = coordinates.of([2.0, 1.0, 0.04])
    expected, found = one(at), other(at)
    assert found.value == pytest.approx(expected.value, rel=1e-9)
    assert found.scores.shape == (20, 3) == expected.scores.shape
    np.testing.assert_allclose(found.scores, expected.scores, atol=2e-3 * abs(expected.scores).max())
    np.testing.assert_allclose(found.part_values, expected.part_values, rtol=1e-9)
    assert found.part_values.sum() == pytest.approx(found.value)


def test_two_parameters_without_derivatives_are_correlated_as_the_log_likelihood_says(as_python):
    data, coordinates = recorded(steps=30), Coordinates(FREE)
    objective, at = likelihood_of(data, of_floats_alone, coordinates), coordinates.of([2.0, 1.0, 0.04])
    smooth, step = likelihood_of(data, of_module, coordinates), 1e-3 * np.eye(3)
    of_gradients = np.array([(smooth(at - one).gradient - smooth(at + one).gradient) / 2e-3 for one in step])
    np.testing.assert_allclose(objective(at).information[:2, :2], of_gradients[:2, :2], rtol=2e-2)
