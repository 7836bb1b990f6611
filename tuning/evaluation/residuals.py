"""Noise estimation: sample covariances of what a model's two equations leave of the truth."""

from __future__ import annotations

from functools import cache, lru_cache
from typing import NamedTuple

import numpy as np

from numerics.angles import difference
from numerics.compiled import CompiledOrPython, function_fingerprint, is_interpreting
from numerics.tuples import vector_reader, vector_writer
from plants.layout import constants_reader, number_places
from plants.shape import Functions, Shape
from plants.state_space import StateSpaceModel
from tuning.problems.check import data_of
from tuning.problems.data import Data
from tuning.problems.problem import Problem
from tuning.search.plan import TRAINING_SEEDS

FEWEST = 10  # residuals for each entry of a mean, below which there is no covariance worth the name
LEAST_EIGENVALUE = 1e-9  # of R's correlations: channels that are copies of each other have none
ROUNDING = 1e-12  # of a state's largest value, below which residuals are rounding


class Residuals(NamedTuple):
    """What a model leaves of true states and of measurements, in a row each."""

    process: np.ndarray  # (N, n), x_{k+1} - f(x_k, u_k)
    measurement: np.ndarray  # (N', m), z_k - h(x_k), of the times at which all channels were measured


class Estimated(NamedTuple):
    """Sample means and covariances of residuals, or the reason why there are none."""

    process_cov: np.ndarray | None = None  # (n, n)
    measurement_cov: np.ndarray | None = None  # (m, m)
    process_mean: np.ndarray | None = None  # (n,): what the model lacks in the mean, which no Q can stand for
    measurement_mean: np.ndarray | None = None  # (m,)
    reason: str = ""


def residuals(model: StateSpaceModel, data: Data) -> Residuals:
    """Residuals of a model on runs whose true states are known, scored steps only.

        w_k = x_{k+1} - f(x_k, u_k),   v_k = z_k - h(x_k);  of angles the short way round

    Args:
        model: with as many states as are known.
        data: with true states.
    """
    states = np.ascontiguousarray(data.known_states[:, data.late])
    inputs = np.ascontiguousarray(data.inputs[:, data.late], dtype=np.float64)
    expected, seen = np.empty_like(states[:, 1:]), np.empty((*states.shape[:2], model.m))
    steps = _steps(model.functions, model.shape, is_interpreting())
    steps(states, inputs, model.numbers, expected, seen)
    shape, measured = model.shape, data.late_scored(data.measurements)
    process = difference(states[:, 1:], expected, shape.state_angles).reshape(-1, model.n)
    measurement = difference(measured, seen, shape.measurement_angles).reshape(-1, model.m)
    return Residuals(*(rows[np.isfinite(rows).all(axis=1)] for rows in (process, measurement)))


@lru_cache(maxsize=16)
def noise_estimation(problem: Problem, seed: int = 0) -> Estimated:
    """Sample covariances of the residuals of a problem's model before tuning, on the training runs of a seed.

    Q is zero if the residuals of all states are rounding. If there is no truth, if the model has states that the
    truth lacks, or if R would be singular, the result is a reason instead.
    """
    if problem.scale is None:
        return Estimated(reason="there is no truth")
    model = problem.model(**problem.untuned)
    data = data_of(problem, problem.training_seeds(seed, TRAINING_SEEDS))
    if data.known_states.shape[-1] != model.n:
        return Estimated(reason=f"of the model's {model.n} states only {data.known_states.shape[-1]} are known")
    found = residuals(model, data)
    for rows, what in ((found.process, "states"), (found.measurement, "channels")):
        if len(rows) < FEWEST * rows.shape[1]:
            return Estimated(reason=f"there are too few steps at which all {what} are known")
    q, r = (np.atleast_2d(np.cov(rows, rowvar=False)) for rows in found)
    if (np.sqrt(np.diag(q)) <= ROUNDING * np.nanmax(np.abs(data.known_states), axis=(0, 1))).all():
        q = np.zeros_like(q)
    if not _is_regular(r):
        return Estimated(reason="the measurements have no noise")
    return Estimated(q, r, found.process.mean(axis=0), found.measurement.mean(axis=0))


def _is_regular(cov: np.ndarray) -> bool:
    """Whether a covariance is positive definite, by its correlations."""
    deviations = np.sqrt(np.diag(cov))
    if not (np.isfinite(cov).all() and (deviations > 0).all()):
        return False
    return float(np.linalg.eigvalsh(cov / np.outer(deviations, deviations)).min()) > LEAST_EIGENVALUE


@cache
def _steps(functions: Functions, shape: Shape, interpreting: bool):
    """The function steps(states, inputs, numbers, expected, seen) that evaluates f and h along true states."""
    n, m, transition, observe = shape.n, shape.m, functions.transition, functions.observe
    substeps = number_places(n, m).substeps
    state, store_state, store_measurement = vector_reader(n), vector_writer(n), vector_writer(m)
    control, constants = vector_reader(shape.inputs), constants_reader(shape)
    fingerprint = function_fingerprint(transition, observe, within=__name__)

    def steps(states, inputs, numbers, expected, seen):
        fingerprint  # noqa: B018 - part of the cache's key
        x, z, u, c = np.zeros(n), np.zeros(m), np.zeros(inputs.shape[2]), constants(numbers)
        for b in range(states.shape[0]):
            for k in range(states.shape[1]):
                for i in range(n):
                    x[i] = states[b, k, i]
                store_measurement(z, observe(state(x), c))
                for i in range(m):
                    seen[b, k, i] = z[i]
                if k < expected.shape[1]:
                    for i in range(u.shape[0]):
                        u[i] = inputs[b, k, i]
                    for _ in range(int(numbers[substeps])):
                        store_state(x, transition(state(x), control(u), c))
                    for i in range(n):
                        expected[b, k, i] = x[i]

    return CompiledOrPython(steps)
