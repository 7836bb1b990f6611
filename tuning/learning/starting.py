"""The filter that a training starts from, and the scales of its quantities on the training runs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from filters.engine.batch import run
from filters.filter import Filter
from filters.learned import read_estimator
from filters.learned.equations import Equations
from filters.learned.estimator import LearnedEstimator, Scales
from filters.learned.file import LEARNED
from thruster_env.core.angles import wrapped_where
from thruster_env.model.state_space import StateSpaceModel
from tuning.evaluation.baselines import ORACLE, baselines
from tuning.evaluation.evaluate import values_of
from tuning.problems.data import Data
from tuning.problems.problem import Problem

START = "ekf"
SMALLEST = 1e-12  # of a scale: a quantity that stays at zero is divided by this, and stays there


def starting_filter(problem: Problem, data: Data, seed: int) -> tuple[str, Filter]:
    """The extended Kalman filter that a training starts from: the baseline that is best on the training runs.

    The oracle is none of them: a training does not know the plant's Q and R.

    Returns:
        Its label, such as "ekf scaled default", and the filter.
    """
    choices = {name: choice for name, choice in baselines(START, problem, seed).items() if name != ORACLE}
    filters = {f"{START} {name}": choice.filter(problem) for name, choice in choices.items()}
    return min(filters.items(), key=lambda entry: values_of(entry[1], data, problem.scale).score.value)


def new_estimator(
    kind: str, filter_: Filter, data: Data, seed: int, start: str | Path | None = None, **options: int
) -> LearnedEstimator:
    """An estimator that is not trained yet, or that continues from the weights of a file.

    Args:
        kind: of the estimator.
        filter_: the filter that it starts from.
        data: training runs, from which its scales are taken.
        seed: of its first weights.
        start: file of a trained estimator of the same kind and model; None for new weights.
        **options: of the estimator.

    Raises:
        ValueError: for a wrong option, or a file of another kind or model.
    """
    if start is not None:
        trained = read_estimator(start)
        if trained.name != kind or options:
            raise ValueError(
                f"start must be a {kind}'s file, and options its own, but got {start}, a {trained.name}"
            )
        return trained(filter_.model)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return LEARNED[kind](filter_.model, scales_of(filter_, data), **options)


def scales_of(filter_: Filter, data: Data) -> Scales:
    """Sizes of a filter's quantities over the steps of some runs that count; see `Scales`.

    The gain is that of the corrections K v that are nearest to the filter's, by least squares.
    """
    runs, model = data.seen, filter_.model
    estimates = run(filter_, runs.filter_keys, runs.inputs, runs.measurements)
    states = data.known_states
    mean, n = estimates.means, states.shape[-1]
    innovation = np.where(np.isnan(runs.measurements), 0.0, estimates.innovations)
    counted = np.isfinite(states).all(axis=-1)
    later = counted[:, 1:]
    corrected = wrapped_where(mean[:, 1:] - _predicted(model, mean, runs.inputs), model.shape.state_angles)
    changes = wrapped_where(np.diff(mean, axis=1), model.shape.state_angles)
    measured = wrapped_where(np.diff(runs.measurements, axis=1), model.shape.measurement_angles)
    error = np.ones(model.n)
    error[:n] = _size(wrapped_where((mean[..., :n] - states)[counted], model.shape.state_angles[:n]))
    truth = states[counted] if n == model.n else mean[counted]
    _check_measured(runs.measurements, model)
    gain = np.linalg.lstsq(innovation[:, 1:][later], corrected[later], rcond=None)[0].T
    spread = _large(np.nanstd(runs.measurements, axis=(0, 1)))
    steps = _size(measured[later])
    return Scales(
        truth.mean(axis=0),
        _large(truth.std(axis=0)),
        _size(changes[later]),
        _size(corrected[later]),
        error,
        np.nanmean(runs.measurements, axis=(0, 1)),
        spread,
        np.where(np.isnan(steps), spread, steps),  # of a channel that is never measured twice in a row
        _size(innovation[counted]),
        runs.inputs.mean(axis=(0, 1)),
        _large(runs.inputs.std(axis=(0, 1))),
        gain,
    )


def _check_measured(measurements: np.ndarray, model: StateSpaceModel) -> None:
    """Raise ValueError unless each channel (B, K + 1, m) has measurements, without which it has no scale."""
    for channel, values in zip(model.measurements, np.moveaxis(measurements, -1, 0), strict=True):
        if not np.isfinite(values).any():
            raise ValueError(f"a training must have measurements of each channel, but {channel.symbol} has none")


def _predicted(model: StateSpaceModel, mean: np.ndarray, inputs: np.ndarray) -> np.ndarray:
    """The predictions (B, K, n) from means (B, K + 1, n) and inputs (B, K, p)."""
    x, u = (torch.tensor(values).flatten(0, 1) for values in (mean[:, :-1], inputs))
    return Equations(model).moved(x, u).numpy().reshape(mean[:, 1:].shape)


def _size(values: np.ndarray) -> np.ndarray:
    """Root mean squares of rows (rows, size); NaN for a column of which nothing is known."""
    counts, sums = (~np.isnan(values)).sum(axis=0), np.nansum(values**2, axis=0)
    return _large(np.sqrt(np.divide(sums, counts, out=np.full(len(sums), np.nan), where=counts > 0)))


def _large(values: np.ndarray) -> np.ndarray:
    return np.maximum(values, SMALLEST)
