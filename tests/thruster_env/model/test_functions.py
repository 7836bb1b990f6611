"""Functions of a model that round their results, and Jacobians that are not their slopes, as users write them."""

import math
import re
import warnings

import numpy as np
import pytest

from filters import StateSpaceModel, make_filter, run
from tests.filters.checks import refused

NOISE = {"process_noise_cov": [0.1, 0.2], "measurement_noise_cov": [0.3], "prior_cov": [1.0, 1.0]}


def swing(x, u, c):
    return x[0] + 0.05 * x[1], x[1] - 0.05 * 9.81 * math.sin(x[0]) + 0.05 * u[0]


def slopes(x, u, c):
    return (1.0, 0.05), (-0.05 * 9.81 * math.cos(x[0]), 1.0)


def look(x, c):
    return (math.sin(x[0]),)


def made(transition=swing, observe=look, **changes):
    arguments = {"prior_mean": [0.4, 0.0], "inputs": 1, **NOISE, **changes}
    return StateSpaceModel(transition=transition, observe=observe, **arguments)


def into(array):
    """A transition that assigns its results to an array of its own, as of another language."""

    def transition(x, u, c):
        result = array.copy()
        result[0], result[1] = swing(x, u, c)
        return result

    return transition


@pytest.mark.parametrize("kind", ["int64", "float32", "float16"])
def test_results_that_were_rounded_are_refused(kind):
    array = np.zeros(2, kind)
    rule = f"transition .*must return numbers of float64, but returned .*{kind}, to which they are rounded"
    refused(rule, made, into(array))
    refused(rule.replace("transition", "observe"), made, observe=lambda x, c: np.array([x[0]]).astype(kind))
    if kind != "int64":
        refused("returned float32", made, observe=lambda x, c: (np.float32(x[0]),))
    inputs, z = np.zeros((9, 1)), np.random.default_rng(0).normal(size=10)
    means = [
        run(make_filter("ekf", made(f)), inputs=inputs, measurements=z).means for f in (into(np.zeros(2)), swing)
    ]
    np.testing.assert_allclose(*means, rtol=1e-9)


def test_whole_numbers_of_python_are_numbers():
    made(observe=lambda x, c: (round(x[0]),))
    made(observe=lambda x, c: (np.round(x[0]),))


WRONG = {
    "transposed": {"transition_jacobian": lambda x, u, c: tuple(zip(*slopes(x, u, c), strict=True))},
    "sign": {"transition_jacobian": lambda x, u, c: ((1.0, 0.05), (0.05 * 9.81 * math.cos(x[0]), 1.0))},
    "forgotten": {"transition_jacobian": lambda x, u, c: ((1.0, 0.0), slopes(x, u, c)[1])},
    "degrees": {"observe_jacobian": lambda x, c: ((math.cos(x[0]) * math.pi / 180.0, 0.0),)},
}


def test_a_jacobian_is_compared_once_with_a_function():
    def forgotten(x, u, c):
        return (1.0, 0.0), slopes(x, u, c)[1]

    with pytest.warns(UserWarning, match="must be the slope"):
        model = made(transition_jacobian=forgotten)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.replace(constants=(1.0,))
    with pytest.warns(UserWarning, match="must be the slope"):
        made(lambda x, u, c: swing(x, u, c), transition_jacobian=forgotten)


@pytest.mark.parametrize("changes", WRONG.values(), ids=list(WRONG))
def test_a_jacobian_that_is_not_the_slope_is_said(changes):
    (name,) = changes
    with pytest.warns(UserWarning, match=f"{name} must be the slope of .*: leave it out") as caught:
        made(**changes)
    (warning,) = caught
    text = str(warning.message)
    i, j = map(int, re.findall(r"\[(\d)\]", text)[:2])
    at = tuple(map(float, re.findall(r"x = \[(.*?), (.*?)\]", text)[0]))
    right = slopes(at, (0.0,), ())[i][j] if name == "transition_jacobian" else (math.cos(at[0]), 0.0)[j]
    assert float(re.findall(r"the slope is ([-.\de]+):", text)[0]) == pytest.approx(right, rel=1e-3)


RIGHT = {  # the slopes are compared at 1.15
    "exact": {"transition_jacobian": slopes},
    "whole numbers": {"observe": lambda x, c: (x[1],), "observe_jacobian": lambda x, c: np.array([[0, 1]])},
    "series": {
        "transition_jacobian": lambda x, u, c: (
            (1.0, 0.05),
            (-0.05 * 9.81 * (1 - x[0] ** 2 / 2 + x[0] ** 4 / 24), 1.0),
        )
    },
    "kink": {
        "observe": lambda x, c: (abs(x[0] - 1.15),),
        "observe_jacobian": lambda x, c: ((math.copysign(1.0, x[0] - 1.15), 0.0),),
    },
    "wide prior": {"prior_cov": [1e12, 1e12], "transition_jacobian": lambda x, u, c: slopes(x, u, c)},
    "small units": {
        "prior_mean": [4e-9, 0.0],
        "prior_cov": [1e-20, 1e-20],
        "process_noise_cov": [1e-20, 1e-20],
        "transition_jacobian": lambda x, u, c: slopes(x, u, c),
    },
    "jump of an angle": {
        "observe": lambda x, c: (math.remainder(x[0] - 1.15 + math.pi - 1e-5, 2 * math.pi),),
        "observe_jacobian": lambda x, c: ((1.0, 0.0),),
        "measurements": [("angle", "a", "rad", True)],
    },
    "no value": {"observe": lambda x, c: (math.sqrt(0.5 - x[0]),), "observe_jacobian": lambda x, c: ((1.0, 0.0),)},
}


def test_a_jacobian_may_be_an_object_without_a_hash():
    class Slopes:
        __hash__ = None

        def __call__(self, x, u, c):
            return slopes(x, u, c)

    for _ in range(2):
        made(transition_jacobian=Slopes())


@pytest.mark.parametrize("changes", RIGHT.values(), ids=list(RIGHT))
def test_a_right_jacobian_is_taken_without_a_word(changes):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        made(**changes)


def test_a_model_with_other_numbers_is_a_new_one_and_refused_as_one():
    def grows(x, u, c):
        return math.sqrt(c[0]) * x[0], x[1] + c[1] / c[0]

    def means(model):
        return run(make_filter("ekf", model), None, np.zeros((1, 2, 1)), np.array([[[0.3], [0.1], [0.4]]])).means

    model, changes = made(grows, constants=(0.5, 0.1)), {"constants": (0.7, 0.2), "process_noise_cov": [0.3, 0.4]}
    before, expected = (model.digest, model.numbers.tolist()), made(grows, **changes)
    for changed in (model.replace(**changes), model.replace(**changes | {"constants": np.array([0.7, 0.2])})):
        np.testing.assert_array_equal(changed.numbers, expected.numbers)
        np.testing.assert_array_equal(means(changed), means(expected))
        assert changed.digest == expected.digest != before[0]
    assert (model.digest, model.numbers.tolist()) == before
    refused("transition must not be NaN at the prior mean", model.replace, constants=(-1.0, 0.1))
    refused("constants must be a NamedTuple or a tuple of finite", model.replace, constants=(math.nan, 0.1))
    refused("must work for 2 states and 1 input, but raised IndexError", model.replace, constants=[0.5])
    assert model.replace(constants=(0.0, 0.1)).constants == (0.0, 0.1)  # a division by zero is infinite
    moved, expected = model.replace(prior_mean=[2, 3]), made(grows, constants=(0.5, 0.1), prior_mean=[2.0, 3.0])
    np.testing.assert_array_equal(moved.numbers, expected.numbers)
    np.testing.assert_array_equal(means(moved), means(expected))
    refused("prior_mean must be 2 finite numbers, but got", model.replace, prior_mean=[math.nan, 0.0])
    refused("prior_cov must be 3 variances", model.replace, prior_mean=[1.0, 2.0, 3.0])
    of_logarithm = made(observe=lambda x, c: (math.log(x[0]),))
    refused("observe must not be NaN at the prior mean", of_logarithm.replace, prior_mean=[-1.0, 0.0])
