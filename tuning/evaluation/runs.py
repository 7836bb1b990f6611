"""What a filter achieved in each of its runs: all that metrics are made of, without covariances of every step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from filters.consistency.nees import normalized_squares
from filters.engine.batch import Estimates
from filters.filter import Filter
from numerics.angles import difference
from tuning.problems.data import FIRST_SCORED_STEP, Data
from tuning.problems.in_parts import estimates_in_parts

FARTHEST = 1e100  # an output beyond this is this: its square is a number


class RunMetrics(NamedTuple):
    """What a filter achieved in each of B runs, over T steps that count; without truth some of it is None."""

    nis: np.ndarray  # (B, T), NaN where nothing was measured or S is singular
    present: np.ndarray  # (B, T), number of channels that were measured
    log_likelihoods: np.ndarray  # (B,), of the steps that count; NaN for filters that give no covariance
    divergences: np.ndarray  # (B,), restarts from the prior
    mean_squares: np.ndarray | None  # (B, n), mean square errors of the states
    start_up_squares: np.ndarray | None  # (B, steps before 50, n), square errors
    nees: np.ndarray | None  # (B, T)
    output_mean_squares: Mapping[str, np.ndarray]  # (B, 1) each, by symbol


def metrics_by_run(filter_: Filter, estimates: Estimates, data: Data, nees: bool = True) -> RunMetrics:
    """What the estimates of a filter on some data are worth, run by run, of the states that the plant has.

    The NEES is NaN where it is not wanted: of forty states it takes a tenth of what the filter takes.
    """
    late, measurements = data.scored, data.measurements
    present = (~np.isnan(measurements[:, late])).sum(axis=-1)
    squares = normalized_squares(estimates.innovations[:, late], estimates.innovation_covs[:, late])
    likelihoods = np.full(len(measurements), np.nan)
    if filter_.has_covariance:
        likelihoods = estimates.log_likelihoods[:, late].sum(axis=1)
    nis = np.where(present > 0, squares, np.nan)
    return RunMetrics(
        nis, present, likelihoods, estimates.divergences, *_against_truth(filter_, estimates, data, nees)
    )


def metrics_of_all(filter_: Filter, data: Data, nees: bool = True) -> RunMetrics:
    """`metrics_by_run` of a filter on all runs of some data, some at a time: the same as of all at once."""
    parts = estimates_in_parts(filter_, data)
    return joined([metrics_by_run(filter_, found, some, nees) for some, found in parts])


def joined(parts: Sequence[RunMetrics]) -> RunMetrics:
    """The metrics of all runs from those of some after the others, of one filter."""
    if len(parts) == 1:
        return parts[0]
    *arrays, outputs = zip(*parts, strict=True)
    whole = [None if some[0] is None else np.concatenate(some) for some in arrays]
    return RunMetrics(*whole, {symbol: np.concatenate([one[symbol] for one in outputs]) for symbol in outputs[0]})


def state_errors(filter_: Filter, estimates: Estimates, data: Data) -> np.ndarray:
    """Errors (B, K + 1, n) of the plant's n states, those of angles the short way round."""
    n = data.states.shape[-1]
    return difference(estimates.means[..., :n], data.states, filter_.model.shape.state_angles[:n])


def _against_truth(filter_: Filter, estimates: Estimates, data: Data, wanted: bool) -> tuple:
    """The last fields of `RunMetrics`."""
    if data.states is None:
        return None, None, None, {}
    n, late = data.states.shape[-1], data.scored
    errors = state_errors(filter_, estimates, data)
    late_errors = errors[:, late]
    nees = np.full(late_errors.shape[:2], np.nan)
    if wanted:
        nees = normalized_squares(late_errors, estimates.covs[:, late, :n, :n])
    mean_squares, start_up = (errors[:, late] ** 2).mean(axis=1), errors[:, :FIRST_SCORED_STEP] ** 2
    return mean_squares, start_up, nees, _output_mean_squares(filter_, estimates, data)


def _output_mean_squares(filter_: Filter, estimates: Estimates, data: Data) -> dict[str, np.ndarray]:
    """Mean square errors of each derived output that both the truth and the filter's model have."""
    late, found = data.scored, {}
    for symbol, truth in (data.outputs or {}).items():
        if symbol not in filter_.model.outputs:
            continue
        with np.errstate(all="ignore"):  # estimates far off, though finite, may have an output that is not
            values = filter_.model.output(symbol, estimates.means[:, late])
        values, angle = np.clip(values, -FARTHEST, FARTHEST), filter_.model.outputs[symbol].quantity.angle
        errors = difference(values[..., None], truth[:, late, None], (angle,))[..., 0]
        found[symbol] = (errors**2).mean(axis=1, keepdims=True)
    return found
