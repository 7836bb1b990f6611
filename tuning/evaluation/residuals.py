"""Noise estimation: sample covariances of the residuals of a model's two equations on the truth."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from thruster_env.core.angles import difference
from thruster_env.core.checks import correlation_flaws
from thruster_env.core.compiled import CompiledOrPython, function_fingerprint, is_interpreting
from thruster_env.core.sources import vector_reader, vector_writer
from thruster_env.model.shape import Functions, Shape, constants_reader, number_places
from thruster_env.model.state_space import StateSpaceModel
from tuning.evaluation.outliers import heavy_tails
from tuning.problems.check import data_of
from tuning.problems.data import Data
from tuning.problems.problem import Problem
from tuning.search.plan import TRAINING_SEEDS

FEWEST = 10  # residuals for each entry of a mean, below which there is no covariance worth the name
LEAST_EIGENVALUE = 1e-9  # of R's correlations: channels that are copies of each other have none
TOLERANCE = 0.1  # of variances and correlations of residuals, relative, within which a model is right
ROUNDING = 1e-12  # of a state's largest value, below which residuals are rounding


class Residuals(NamedTuple):
    """Residuals of a model on true states and on measurements, one per row."""

    process: np.ndarray  # (N, n), x_{k+1} - f(x_k, u_k)
    measurement: np.ndarray  # (N', m), z_k - h(x_k), of the times at which all channels were measured
    process_pairs: tuple[np.ndarray, np.ndarray]  # those of which the next one is there, too, and the next ones
    measurement_pairs: tuple[np.ndarray, np.ndarray]


class Estimated(NamedTuple):
    """Sample means and covariances of residuals, or the reason why there are none."""

    process_cov: np.ndarray | None = None  # (n, n)
    measurement_cov: np.ndarray | None = None  # (m, m)
    process_mean: np.ndarray | None = None  # (n,): what the model lacks in the mean, which no Q can stand for
    measurement_mean: np.ndarray | None = None  # (m,)
    process_correlation: np.ndarray | None = None  # (n,), of each w_k with w_{k+1}: noise that is white has none
    measurement_correlation: np.ndarray | None = None  # (m,)
    reason: str = ""
    tails: Mapping[str, float] = {}  # heavy ones, "v of thrust": share beyond four robust standard deviations


def residuals(model: StateSpaceModel, data: Data) -> Residuals:
    """Residuals of a model on runs with known true states, scored steps only.

    w_k = x_{k+1} - f(x_k, u_k),   v_k = z_k - h(x_k);  angles wrapped

    Args:
        model: with as many states as are known.
        data: with true states.
    """
    states = np.ascontiguousarray(data.known_states[:, data.late])
    inputs = np.ascontiguousarray(data.inputs[:, data.late], dtype=np.float64)
    expected, outputs = predicted(model, states, inputs)
    shape, measured = model.shape, data.late_scored(data.measurements)
    process = difference(states[:, 1:], expected, shape.state_angles)
    measurement = difference(measured, outputs, shape.measurement_angles)
    complete = [np.isfinite(rows).all(axis=-1) for rows in (process, measurement)]
    both = [mask[:, :-1] & mask[:, 1:] for mask in complete]
    pairs = [
        (rows[:, :-1][mask], rows[:, 1:][mask]) for rows, mask in zip((process, measurement), both, strict=True)
    ]
    return Residuals(process[complete[0]], measurement[complete[1]], *pairs)


def predicted(model: StateSpaceModel, states: np.ndarray, inputs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """F along states (B, T, n) and inputs (B, T - 1, p), (B, T - 1, n), and h, (B, T, m)."""
    expected, outputs = np.empty_like(states[:, 1:]), np.empty((*states.shape[:2], model.m))
    steps = _steps(model.functions, model.shape, is_interpreting())
    steps(np.ascontiguousarray(states), inputs, model.numbers, expected, outputs)
    return expected, outputs


@lru_cache(maxsize=16)
def noise_estimation(problem: Problem, seed: int = 0) -> Estimated:
    """Sample covariances of the residuals of a problem's model before tuning, on the training runs of a seed.

    Q is zero if the residuals of all states are rounding. If there is no truth, if the model has states that the
    truth lacks, or if R would be singular, the result is a reason instead.
    """
    if problem.scale is None:
        return Estimated(reason="there is no truth")
    data = data_of(problem, problem.training_seeds(seed, TRAINING_SEEDS))
    return estimated_from(problem.model(**problem.untuned), data)


def estimated_from(model: StateSpaceModel, data: Data) -> Estimated:
    """Sample covariances of a model's residuals on some runs, or the reason why there are none."""
    if data.states is None:
        return Estimated(reason="there is no truth")
    if data.known_states.shape[-1] != model.n:
        return Estimated(reason=f"of the model's {model.n} states only {data.known_states.shape[-1]} are known")
    model_residuals = residuals(model, data)
    for rows, what in zip(model_residuals[:2], ("states", "channels"), strict=True):
        if len(rows) < FEWEST * rows.shape[1]:
            return Estimated(reason=f"there are too few steps at which all {what} are known")
    q, r = (np.atleast_2d(np.cov(rows, rowvar=False)) for rows in model_residuals[:2])
    if (np.sqrt(np.diag(q)) <= ROUNDING * np.nanmax(np.abs(data.known_states), axis=(0, 1))).all():
        q = np.zeros_like(q)
    if not _is_regular(r):
        return Estimated(reason="the measurements have no noise")
    mean_w, mean_v = (rows.mean(axis=0) for rows in model_residuals[:2])
    names = (
        [f"w of {state.symbol}" for state in model.states],
        [f"v of {channel.symbol}" for channel in model.measurements],
    )
    w, v = (heavy_tails(*pair) for pair in zip(model_residuals[:2], names, strict=True))
    of_w, of_v = (_correlation(rows) for rows in model_residuals[2:])
    tails = {**(w if q.any() else {}), **v}
    return Estimated(q, r, mean_w, mean_v, of_w, of_v, tails=tails)


@lru_cache(maxsize=16)
def model_error(problem: Problem, seed: int = 0) -> str:
    """How a problem's model differs from its plant, in a few words; empty if it does not, or if nothing tells.

    On true states, the residuals r of a right model are white with the plant's own variances s^2:

        E[r_k^2]/s^2 = 1,  E[r_k r_{k+1}]/s^2 = 0,  each within 0.1 + 5 sqrt(2/N) of N residuals

    Args:
        problem: with the plant's own Q and R (`true`), and true states of all the model's states.
        seed: of the study whose training runs are taken.
    """
    if problem.true is None or problem.scale is None:
        return ""
    model, data = problem.model(**problem.true), data_of(problem, problem.training_seeds(seed, TRAINING_SEEDS))
    if data.states is None or data.known_states.shape[-1] != model.n:
        return ""
    model_residuals = residuals(model, data)
    rounding = ROUNDING * np.nanmax(np.abs(data.known_states), axis=(0, 1))
    errors = _errors(
        model.states,
        np.diag(model.process_noise_cov),
        model_residuals.process,
        model_residuals.process_pairs,
        rounding,
    )
    variances = np.diag(model.measurement_noise_cov)
    errors |= _errors(
        model.measurements, variances, model_residuals.measurement, model_residuals.measurement_pairs, 0.0
    )
    return errors[max(errors)] if errors else ""


def _errors(quantities, variances, rows, pairs, rounding) -> dict[float, str]:
    """The components of residuals (N, d) that are not white with some variances (d,), by error over tolerance."""
    if len(rows) < FEWEST:
        return {}
    tolerance, errors = TOLERANCE + 5.0 * np.sqrt(2.0 / len(rows)), {}
    scale = np.maximum(np.sqrt(variances), rounding)
    squares = (rows**2).mean(axis=0) / scale**2
    lags = (pairs[0] * pairs[1]).mean(axis=0) / scale**2 if len(pairs[0]) >= FEWEST else np.zeros(len(scale))
    for quantity, variance, square, lag in zip(quantities, variances, squares, lags, strict=True):
        error = square - 1.0 if variance == 0.0 else max(abs(square - 1.0), abs(lag))
        if error > tolerance:
            words = f"the residuals of {quantity.short_label} have {square:.3g} times the plant's own variance"
            if variance == 0.0:
                words = f"{quantity.short_label} has residuals where the plant has no noise"
            elif abs(lag) > tolerance:
                words += f" and a correlation of {lag / square:.2f} from step to step"
            errors[error / tolerance] = words
    return errors


def _correlation(pairs: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Correlation of each component of residuals (N, n) with that a step later, (n,); 0 where nothing varies."""
    if len(pairs[0]) < FEWEST:  # channels that are never measured at two steps in a row
        return np.zeros(pairs[0].shape[1])
    now, later = (values - values.mean(axis=0) for values in pairs)
    spread = np.sqrt((now**2).sum(axis=0) * (later**2).sum(axis=0))
    return np.divide((now * later).sum(axis=0), spread, out=np.zeros(now.shape[1]), where=spread > 0)


def _is_regular(cov: np.ndarray) -> bool:
    """Whether a covariance is positive definite, by its correlations."""
    return bool(np.isfinite(cov).all() and correlation_flaws(cov)[0] > LEAST_EIGENVALUE)


@lru_cache(maxsize=64)
def _steps(functions: Functions, shape: Shape, interpreting: bool):
    """The function steps(states, inputs, numbers, expected, outputs) that evaluates f and h along true states."""
    n, m, transition, observe = shape.n, shape.m, functions.transition, functions.observe
    substeps = number_places(n, m).substeps
    state, store_state, store_measurement = vector_reader(n), vector_writer(n), vector_writer(m)
    control, constants = vector_reader(shape.inputs), constants_reader(shape)
    fingerprint = function_fingerprint(transition, observe, within=__name__)

    def steps(states, inputs, numbers, expected, outputs):
        fingerprint  # noqa: B018 - part of the cache's key
        x, z, u, c = np.zeros(n), np.zeros(m), np.zeros(inputs.shape[2]), constants(numbers)
        for b in range(states.shape[0]):
            for k in range(states.shape[1]):
                for i in range(n):
                    x[i] = states[b, k, i]
                store_measurement(z, observe(state(x), c))
                for i in range(m):
                    outputs[b, k, i] = z[i]
                if k < expected.shape[1]:
                    for i in range(u.shape[0]):
                        u[i] = inputs[b, k, i]
                    for _ in range(int(numbers[substeps])):
                        store_state(x, transition(state(x), control(u), c))
                    for i in range(n):
                        expected[b, k, i] = x[i]

    return CompiledOrPython(steps)
