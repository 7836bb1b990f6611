"""Metrics of a filter in each of its runs: log score, errors, NEES and NIS, without storing every covariance."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from filters.consistency.nees import normalized_squares, sums_of_squares, whitened
from filters.engine.batch import Estimates
from filters.filter import Filter
from thruster_env.core.angles import difference
from thruster_env.model.euler import EulerAngle
from thruster_env.model.quantities import Quantity
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.model.turns import Turn, errors_of, leading, readings
from tuning.problems.data import FIRST_SCORED_STEP, Data, estimates_in_parts, where_true

LEAST = -1e6  # log score of a step whose covariance is singular or not finite
FARTHEST = 1e100  # outputs are clipped to this, so that their squares are finite


def log_scores_of(
    filter_: Filter, estimates: Estimates, data: Data, scale: np.ndarray | Sequence[float] | None
) -> np.ndarray:
    """Log N(x; x^, P) of late steps, (B, T); NaN where a step is not scored, and without truth or covariance.

    The density is that of the states of finite scale alone. A step at which their P is singular or not finite
    has the lowest score, -1e6: a filter gains nothing by an invalid covariance.

    Args:
        filter_: the filter of the estimates.
        estimates: of all steps.
        data: of the same runs.
        scale: (n,), of rotations (t,), infinite for states that are not scored; None without truth.

    Source: Gneiting, Raftery (2007), "Strictly proper scoring rules, prediction, and estimation", JASA 102(477).
    """
    if data.states is None or scale is None or not filter_.has_covariance:
        return np.full(data.measurements[:, data.late].shape[:2], np.nan)
    indices, late = np.flatnonzero(np.isfinite(scale)), data.late
    covs = estimates.covs[:, late][..., indices[:, None], indices]
    with np.errstate(all="ignore"):
        errors = errors_of(filter_.model, estimates.means[:, late], data.states[:, late])[..., indices]
        logarithms, squares = np.linalg.slogdet(covs)[1], sums_of_squares(whitened(errors, covs))
        scores = -0.5 * (len(indices) * math.log(2.0 * math.pi) + logarithms + squares)
    scores = np.where(np.isfinite(scores), np.maximum(scores, LEAST), LEAST)
    return np.where(data.scored[:, late], scores, np.nan)


class RunMetrics(NamedTuple):
    """Metrics of a filter in each of B runs, over T late steps; those that need the truth may be None.

    Only scored late steps count (`Data.scored`).
    """

    nis: np.ndarray  # (B, T), NaN where nothing was measured or S is singular, or the step is not scored
    present: np.ndarray  # (B, T), number of channels that were measured; 0 where the step is not scored
    log_likelihoods: np.ndarray  # (B,), of the scored steps; NaN for filters without a covariance
    divergences: np.ndarray  # (B,), filter resets: restarts from the prior
    mean_squares: np.ndarray | None  # (B, n), mean square errors of the states
    start_up_squares: np.ndarray | None  # (B, steps before 50, n), square errors
    nees: np.ndarray | None  # (B, T)
    output_mean_squares: Mapping[str, np.ndarray]  # (B, 1) each, by symbol
    counts: np.ndarray  # (B,), number of scored steps
    log_scores: np.ndarray | None = None  # (B, T), log N(x; x^, P); None if not wanted, NaN where there is none
    state_nees: np.ndarray | None = None  # (B, n), means of e_i^2 / P_ii; NaN without the NEES

    @property
    def weights(self) -> np.ndarray | None:
        """Weights by which runs are pooled, (B,): their numbers of scored steps; None if these are equal."""
        return None if (self.counts == self.counts[0]).all() else self.counts.astype(np.float64)


def metrics_by_run(
    filter_: Filter,
    estimates: Estimates,
    data: Data,
    nees: bool = True,
    outputs: bool = True,
    scale: np.ndarray | Sequence[float] | None = None,
) -> RunMetrics:
    """Metrics of a filter's estimates on some data, run by run, for the states that the plant has.

    The NEES, joint and of each state, is NaN unless requested: for forty states it takes a tenth of the filter's
    own time. Errors of
    derived outputs are omitted unless requested; log scores are those of the states with a finite scale,
    and omitted without a scale.
    """
    late, measurements = data.late, data.measurements
    turns = filter_.model.measured_turns
    present = (~np.isnan(readings(data.late_scored(measurements), turns))).sum(axis=-1)
    squares = normalized_squares(estimates.innovations[:, late], estimates.innovation_covs[:, late])
    likelihoods = np.full(len(measurements), np.nan)
    if filter_.has_covariance:
        likelihoods = _sums(data, estimates.log_likelihoods)
    nis = np.where(present > 0, squares, np.nan)
    metrics = RunMetrics(
        nis, present, likelihoods, estimates.divergences, None, None, None, {}, data.scored_counts
    )
    if scale is not None:
        metrics = metrics._replace(log_scores=log_scores_of(filter_, estimates, data, scale))
    if data.states is None:
        return metrics
    metrics = metrics._replace(**_against_truth(filter_, estimates, data, nees))
    return (
        metrics._replace(output_mean_squares=_output_mean_squares(filter_, estimates, data))
        if outputs
        else metrics
    )


def metrics_of_all(
    filter_: Filter,
    data: Data,
    nees: bool = True,
    outputs: bool = True,
    scale: np.ndarray | Sequence[float] | None = None,
) -> RunMetrics:
    """`metrics_by_run` of a filter on all runs of some data, in parts: the same as for all at once."""
    parts = estimates_in_parts(filter_, data)
    return joined([metrics_by_run(filter_, estimates, part, nees, outputs, scale) for part, estimates in parts])


def joined(parts: Sequence[RunMetrics]) -> RunMetrics:
    """The metrics of all runs of a filter, from those of consecutive parts."""
    if len(parts) == 1:
        return parts[0]
    outputs = [part.output_mean_squares for part in parts]
    return RunMetrics(
        nis=np.concatenate([part.nis for part in parts]),
        present=np.concatenate([part.present for part in parts]),
        log_likelihoods=np.concatenate([part.log_likelihoods for part in parts]),
        divergences=np.concatenate([part.divergences for part in parts]),
        mean_squares=_concatenated([part.mean_squares for part in parts]),
        start_up_squares=_concatenated([part.start_up_squares for part in parts]),
        nees=_concatenated([part.nees for part in parts]),
        output_mean_squares={
            symbol: np.concatenate([squares[symbol] for squares in outputs]) for symbol in outputs[0]
        },
        counts=np.concatenate([part.counts for part in parts]),
        log_scores=_concatenated([part.log_scores for part in parts]),
        state_nees=_concatenated([part.state_nees for part in parts]),
    )


def _concatenated(parts: Sequence[np.ndarray | None]) -> np.ndarray | None:
    """Parts as one array; None where there is no truth."""
    known = [part for part in parts if part is not None]
    return np.concatenate(known) if known else None


def state_errors(filter_: Filter, estimates: Estimates, data: Data) -> np.ndarray:
    """Errors (B, K + 1, n) of the plant's n states, with angles wrapped; needs data with truth.

    Those of rotations are on their tangent, as P is. They are NaN at steps that are not scored.
    """
    return errors_of(filter_.model, estimates.means, data.known_states)


def _against_truth(filter_: Filter, estimates: Estimates, data: Data, wanted: bool) -> dict:
    """The fields of `RunMetrics` that need the true states."""
    errors = state_errors(filter_, estimates, data)  # NaN where a step does not count
    n, late = errors.shape[-1], data.late
    late_errors = errors[:, late]
    nees, state_nees = np.full(late_errors.shape[:2], np.nan), np.full((len(errors), n), np.nan)
    if wanted:
        covs = estimates.covs[:, late, :n, :n]
        nees, state_nees = normalized_squares(late_errors, covs), _state_nees(late_errors, covs)
    mean_squares, start_up = _means(data, late_errors**2), errors[:, :FIRST_SCORED_STEP] ** 2
    return {
        "mean_squares": mean_squares,
        "start_up_squares": start_up,
        "nees": nees,
        "state_nees": state_nees,
    }


def _state_nees(errors: np.ndarray, covs: np.ndarray) -> np.ndarray:
    """Means (B, n) of e_i^2 / P_ii over the steps that have both, NaN of a state without a variance."""
    variances = np.einsum("btii->bti", covs)
    with np.errstate(all="ignore"):  # of a filter that has diverged
        ratios = np.where(variances > 0.0, errors**2 / variances, np.nan)
        return np.nansum(ratios, axis=1) / (~np.isnan(ratios)).sum(axis=1)


def _sums(data: Data, values: np.ndarray) -> np.ndarray:
    """Sums (B,) of values (B, K + 1) over each run's scored steps."""
    late_values = data.late_scored(values)
    return (
        late_values.sum(axis=1)
        if data.counted is None
        else np.where(np.isnan(late_values), 0.0, late_values).sum(axis=1)
    )


def _means(data: Data, values: np.ndarray) -> np.ndarray:
    """Means (B, n) of late values (B, T, n) over each run's scored steps."""
    if data.counted is None:
        return _means_over_steps(values)
    counted = where_true(data.counted[:, data.late], values, 0.0)
    return counted.sum(axis=1) / np.maximum(data.scored_counts, 1)[:, None]


def _means_over_steps(values: np.ndarray) -> np.ndarray:
    """Means (B, n) of values (B, T, n), the sums of all runs side by side: twice as fast, and the same bits."""
    if values.shape[-1] == 1:  # these NumPy adds up pairwise
        return values.mean(axis=1)
    return np.ascontiguousarray(np.swapaxes(values, 0, 1)).mean(axis=0)


def outputs_of(model: StateSpaceModel, known: int | None = None) -> dict[str, Quantity]:
    """A model's outputs by symbol, and the angle of the error [deg] of each rotation among the known states."""
    outputs = {
        symbol: output.quantity
        for symbol, output in model.outputs.items()
        if not isinstance(output.function, EulerAngle)  # which jump where the pitch is 90 degrees
    }
    for turn in leading(model.turns, model.n if known is None else known):
        symbol = f"{model.states[turn.stored].symbol.rpartition('_')[0]}_angle"
        outputs[symbol] = Quantity(f"{turn.name} angle", symbol, "deg")
    return outputs


def _output_mean_squares(filter_: Filter, estimates: Estimates, data: Data) -> dict[str, np.ndarray]:
    """Mean square errors of each output that both the truth and the filter's model have, and of rotations."""
    late, model, mean_squares = data.late, filter_.model, dict[str, np.ndarray]()

    def mean_of(squares: np.ndarray) -> np.ndarray:
        return squares.mean(axis=1, keepdims=True) if data.counted is None else _means(data, squares[..., None])

    known = 0 if data.states is None else data.states.shape[-1]
    if data.states is not None and (turns := leading(model.turns, known)):
        errors = np.rad2deg(
            rotation_angles(errors_of(model, estimates.means[:, late], data.states[:, late]), turns)
        )
        symbols = list(outputs_of(model, known))[-len(turns) :]
        mean_squares |= {symbol: mean_of(part**2) for symbol, part in zip(symbols, errors, strict=True)}
    for symbol, truth in (data.outputs or {}).items():
        if symbol not in outputs_of(model):
            continue
        with np.errstate(all="ignore"):  # finite estimates that are far off may have an infinite output
            values = filter_.model.output(symbol, estimates.means[:, late])
        values, angle = np.clip(values, -FARTHEST, FARTHEST), filter_.model.outputs[symbol].quantity.angle
        errors = difference(values[..., None], truth[:, late, None], (angle,))[..., 0]
        mean_squares[symbol] = mean_of(errors**2)
    return mean_squares


def rotation_angles(errors: np.ndarray, turns: Sequence[Turn]) -> np.ndarray:
    """The angle [rad] of the error of each rotation, pose or direction, (turns, ...) of errors (..., t)."""
    parts = [slice(turn.tangent, turn.tangent + min(turn.size, 3)) for turn in turns]
    return np.array([np.sqrt((errors[..., part] ** 2).sum(axis=-1)) for part in parts])
