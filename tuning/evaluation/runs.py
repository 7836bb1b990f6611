"""Metrics of a filter in each of its runs, without the covariances of every step.

NEES is the normalised estimation error squared, NIS the normalised innovation squared.
"""

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

FARTHEST = 1e100  # outputs are clipped to this, so that their squares are finite


class RunMetrics(NamedTuple):
    """Metrics of a filter in each of B runs, over T scored steps; those that need the truth may be None."""

    nis: np.ndarray  # (B, T), NaN where nothing was measured or S is singular
    present: np.ndarray  # (B, T), number of channels that were measured
    log_likelihoods: np.ndarray  # (B,), of the scored steps; NaN for filters without a covariance
    divergences: np.ndarray  # (B,), filter resets: restarts from the prior
    mean_squares: np.ndarray | None  # (B, n), mean square errors of the states
    start_up_squares: np.ndarray | None  # (B, steps before 50, n), square errors
    nees: np.ndarray | None  # (B, T)
    output_mean_squares: Mapping[str, np.ndarray]  # (B, 1) each, by symbol


def metrics_by_run(
    filter_: Filter, estimates: Estimates, data: Data, nees: bool = True, outputs: bool = True
) -> RunMetrics:
    """Metrics of a filter's estimates on some data, run by run, for the states that the plant has.

    The NEES is NaN unless it is wanted: for forty states it takes a tenth of the filter's own time. Errors of
    derived outputs are left out unless they are wanted.
    """
    late, measurements = data.scored, data.measurements
    present = (~np.isnan(measurements[:, late])).sum(axis=-1)
    squares = normalized_squares(estimates.innovations[:, late], estimates.innovation_covs[:, late])
    likelihoods = np.full(len(measurements), np.nan)
    if filter_.has_covariance:
        likelihoods = estimates.log_likelihoods[:, late].sum(axis=1)
    nis = np.where(present > 0, squares, np.nan)
    found = RunMetrics(nis, present, likelihoods, estimates.divergences, None, None, None, {})
    if data.states is None:
        return found
    found = found._replace(**_against_truth(filter_, estimates, data, data.states, nees))
    return found._replace(output_mean_squares=_output_mean_squares(filter_, estimates, data)) if outputs else found


def metrics_of_all(filter_: Filter, data: Data, nees: bool = True, outputs: bool = True) -> RunMetrics:
    """`metrics_by_run` of a filter on all runs of some data, in parts: the same as for all at once."""
    parts = estimates_in_parts(filter_, data)
    return joined([metrics_by_run(filter_, found, some, nees, outputs) for some, found in parts])


def joined(parts: Sequence[RunMetrics]) -> RunMetrics:
    """The metrics of all runs of a filter, from those of consecutive parts."""
    if len(parts) == 1:
        return parts[0]
    outputs = [one.output_mean_squares for one in parts]
    return RunMetrics(
        nis=np.concatenate([one.nis for one in parts]),
        present=np.concatenate([one.present for one in parts]),
        log_likelihoods=np.concatenate([one.log_likelihoods for one in parts]),
        divergences=np.concatenate([one.divergences for one in parts]),
        mean_squares=_concatenated([one.mean_squares for one in parts]),
        start_up_squares=_concatenated([one.start_up_squares for one in parts]),
        nees=_concatenated([one.nees for one in parts]),
        output_mean_squares={symbol: np.concatenate([one[symbol] for one in outputs]) for symbol in outputs[0]},
    )


def _concatenated(parts: Sequence[np.ndarray | None]) -> np.ndarray | None:
    """Parts as one array; None where there is no truth."""
    known = [part for part in parts if part is not None]
    return np.concatenate(known) if known else None


def state_errors(filter_: Filter, estimates: Estimates, data: Data) -> np.ndarray:
    """Errors (B, K + 1, n) of the plant's n states, those of angles the short way round; needs data with truth."""
    return _errors(filter_, estimates, data.known_states)


def _errors(filter_: Filter, estimates: Estimates, states: np.ndarray) -> np.ndarray:
    n = states.shape[-1]
    return difference(estimates.means[..., :n], states, filter_.model.shape.state_angles[:n])


def _against_truth(filter_: Filter, estimates: Estimates, data: Data, states: np.ndarray, wanted: bool) -> dict:
    """The fields of `RunMetrics` that need the true states."""
    n, late = states.shape[-1], data.scored
    errors = _errors(filter_, estimates, states)
    late_errors = errors[:, late]
    nees = np.full(late_errors.shape[:2], np.nan)
    if wanted:
        nees = normalized_squares(late_errors, estimates.covs[:, late, :n, :n])
    mean_squares, start_up = _means_over_steps(late_errors**2), errors[:, :FIRST_SCORED_STEP] ** 2
    return {
        "mean_squares": mean_squares,
        "start_up_squares": start_up,
        "nees": nees,
    }


def _means_over_steps(values: np.ndarray) -> np.ndarray:
    """Means (B, n) of values (B, T, n), the sums of all runs side by side: twice as fast, and the same bits."""
    if values.shape[-1] == 1:  # these NumPy adds up pairwise
        return values.mean(axis=1)
    return np.ascontiguousarray(np.swapaxes(values, 0, 1)).mean(axis=0)


def _output_mean_squares(filter_: Filter, estimates: Estimates, data: Data) -> dict[str, np.ndarray]:
    """Mean square errors of each derived output that both the truth and the filter's model have."""
    late, found = data.scored, {}
    for symbol, truth in (data.outputs or {}).items():
        if symbol not in filter_.model.outputs:
            continue
        with np.errstate(all="ignore"):  # finite estimates that are far off may have an infinite output
            values = filter_.model.output(symbol, estimates.means[:, late])
        values, angle = np.clip(values, -FARTHEST, FARTHEST), filter_.model.outputs[symbol].quantity.angle
        errors = difference(values[..., None], truth[:, late, None], (angle,))[..., 0]
        found[symbol] = (errors**2).mean(axis=1, keepdims=True)
    return found
