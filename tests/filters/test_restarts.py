"""Restarts are told: how many, the first step and states, and the likely cause, on every path."""

import math
import pickle
import warnings

import numpy as np
import pytest

import filters
from filters import EstimateState, RestartWarning, StateSpaceModel, make_filter, restarts_of
from filters.logs.estimate import estimate_with
from filters.logs.findings import findings
from filters.logs.verdict import verdict
from thruster_env.plants.logs.log import Log
from thruster_env.plants.model_env import ModelEnv
from tuning.evaluation.evaluate import evaluate, restart_sentences
from tuning.problems.data import Data


def model(**changes):
    """Two states, the second one driven by the input; each change makes it fail where x_2 is beyond 5."""
    arguments = {
        "transition": lambda x, u, c: (0.9 * x[0], x[1] + u[0]),
        "observe": lambda x, c: (x[0] + x[1],),
        "process_noise_cov": [0.1, 0.1],
        "measurement_noise_cov": [100.0],
        "prior_mean": [0.0, 0.0],
        "prior_cov": [1.0, 0.01],
        "inputs": 1,
        "states": [("first", "a", "m"), ("second", "b", "m")],
    }
    return StateSpaceModel(**{**arguments, **changes})


def lost_f(x, u, c):
    """NaN beyond 5."""
    return 0.9 * x[0], x[1] + u[0] if x[1] < 5.0 else math.nan


def jacobian_of_f(x, u, c):
    """NaN beyond 5."""
    return (0.9, 0.0), (0.0, 1.0 + 0.0 * math.sqrt(5.0 - x[1]) if x[1] < 5.0 else math.nan)


def jacobian_of_h(x, c):
    """NaN beyond 5."""
    return ((1.0, 1.0 if x[1] < 5.0 else math.nan),)


FAILING = {
    "f(x, u) is NaN": (("b",), {"transition": lost_f}),
    "f(x, u) is infinite, it overflows": (
        ("a",),
        {"transition": lambda x, u, c: (0.9 * x[0] if x[1] < 5.0 else math.inf, x[1] + u[0])},
    ),
    "F = df/dx is NaN": (("b",), {"transition_jacobian": jacobian_of_f}),
    "h(x) is NaN": (("a", "b"), {"observe": lambda x, c: (x[0] + x[1] if x[1] < 5.0 else math.nan,)}),
    "H = dh/dx is NaN": (("b",), {"observe_jacobian": jacobian_of_h}),
}


def data(count=1, lost=0):
    """Inputs that drive the second state beyond 5 at step 3 of one run, and measurements that follow."""
    inputs = np.zeros((count, 6, 1))
    inputs[lost, 1:3] = 4.0
    measurements = np.concatenate([np.zeros((count, 1, 1)), np.cumsum(inputs, axis=1)], axis=1)
    return inputs, measurements


@pytest.mark.parametrize("cause", FAILING)
@pytest.mark.usefixtures("as_python")
def test_the_first_step_states_and_cause_are_told(cause):
    states, changes = FAILING[cause]
    filter_, (inputs, z) = make_filter("ekf", model(**changes)), data(3, lost=1)
    with pytest.warns(RestartWarning, match="in 1 of 3 runs, first at step .* of run 1") as caught:
        found = filters.run(filter_, None, inputs, z)
    told = restarts_of(filter_, found.divergences, None, inputs, z)
    assert told.cause == cause and told.states == states and told.sentence == str(caught[0].message)
    assert (told.times, told.runs, told.of_runs, told.run) == (found.divergences.sum(), 1, 3, 1)
    assert told.step == (3 if cause.startswith(("h", "H")) else 4)
    assert pickle.loads(pickle.dumps(told)) == told


@pytest.mark.usefixtures("as_python")
def test_without_restarts_nothing_is_told():
    filter_, (inputs, z) = make_filter("ekf", model()), data()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = filters.run(filter_, None, inputs, z)
    assert restarts_of(filter_, found.divergences, None, inputs, z) is None


@pytest.mark.usefixtures("as_python")
def test_a_covariance_that_overflows_is_told_and_so_are_noises_of_each_step():
    filter_ = make_filter(
        "kf",
        filters.affine_model(
            a=[[1.0]],
            b=[[1.0]],
            c=[[1.0]],
            process_noise_cov=[0.1],
            measurement_noise_cov=[1.0],
            prior_mean=[0.0],
            prior_cov=[1.0],
        ),
    )
    inputs, z = np.zeros((1, 4, 1)), np.full((1, 5, 1), np.nan)
    q = np.full((4, 1, 1), 0.1)
    q[2] = 1e305
    with pytest.warns(RestartWarning):
        found = filters.run(filter_, None, inputs, z, process_noise_covs=q)
    told = restarts_of(filter_, found.divergences, None, inputs, z, process_noise_covs=q)
    assert told.step == 3


@pytest.mark.usefixtures("as_python")
def test_logs_wrappers_and_evaluations_tell_the_same():
    cause = "F = df/dx is NaN"
    filter_, (inputs, z) = make_filter("ekf", model(**FAILING[cause][1])), data()
    names = filter_.model
    log = Log("log", 1.0, inputs[0], z[0], names.input_quantities, names.measurements)
    found = estimate_with(filter_, log)
    assert found.restarts.cause == cause and found.restarts.step == 4
    assert found.restarts.sentence in verdict(found, findings(found, 0))
    env = EstimateState(ModelEnv(model(), model, low=-9.0, high=9.0, dt=1.0), filter_)
    _, info = env.reset(seed=0)
    assert "estimate_restarts" not in info
    for u in inputs[0]:
        *_, info = env.step(u)
    assert cause in info["estimate_restarts"] and "first at step" in info["estimate_restarts"]
    runs = Data((0, 1), *data(2, lost=1), np.zeros((2, 2)), 0)
    evaluation = evaluate(filter_, runs, None)
    assert evaluation.restarts.run == 1 and evaluation.restarts.cause == cause
    assert restart_sentences({"ekf": evaluation, "other": evaluation._replace(restarts=None)}) == [
        f"ekf: {evaluation.restarts.sentence}"
    ]
