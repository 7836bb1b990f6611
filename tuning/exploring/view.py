"""What one sees of a filter: estimates with their bands, innovations, consistency over time, and figures.

NEES is the normalised estimation error squared, NIS the normalised innovation squared.

The data that a bench shows: runs of a plant, or recorded logs as a whole with the blocks they are cut into.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from filters.consistency.nees import LAGS, band_of_means, whiteness
from filters.engine.batch import Estimates
from filters.filter import Filter
from thruster_env.core.streams import filter_keys
from tuning.evaluation.evaluate import Evaluation, compute_metrics
from tuning.evaluation.runs import RunMetrics, metrics_by_run, metrics_of_all
from tuning.problems.check import data_of
from tuning.problems.data import Data, estimates_on, mask_of, only, padded
from tuning.problems.log_problem import LogProblem
from tuning.problems.problem import Problem, score_label


class PageData(NamedTuple):
    """What is drawn, and what is counted: the same runs, unless they are logs."""

    drawn: Data  # of a plant the runs of some seeds; of logs each log as a whole
    counted: Data  # of a plant the same; of logs the training blocks
    held_out: Data | None  # of logs the held-out blocks; None of a plant


@lru_cache(maxsize=8)
def page_data(problem: Problem, seeds: int, seed: int, held_out: bool) -> PageData:
    """The data of a problem for a bench.

    Args:
        problem: what makes the data.
        seeds: number of seeds; logs are shown whole.
        seed: of the study whose training seeds, or held-out seeds, these are.
        held_out: whether they are those on which a study's choice is evaluated, as `thruster evaluate` does it.
    """
    if isinstance(problem, LogProblem):
        blocks = [
            data_of(problem, choose(seed, seeds)) for choose in (problem.training_seeds, problem.held_out_seeds)
        ]
        return PageData(_whole(problem), *blocks)
    choose = problem.held_out_seeds if held_out else problem.training_seeds
    data = data_of(problem, choose(seed, seeds))
    return PageData(data, data, None)


def _whole(problem: LogProblem) -> Data:
    """Each log from its first row to its last, with the random numbers of `thruster estimate`."""
    logs, model = problem.logs, problem.model()
    rows = max(len(log.measurements) for log in logs)
    data = Data(
        tuple(range(len(logs))),
        padded([log.inputs[: len(log.measurements) - 1] for log in logs], rows - 1, None),
        padded([log.measurements for log in logs], rows),
        np.repeat(filter_keys([0]), len(logs), axis=0),
        problem.first_scored_step,
        counted=mask_of([len(log.measurements) for log in logs], rows),
    )
    if problem.scale is None:
        return data.read_only()
    states = padded([truth for log in logs if (truth := log.true_states(model)) is not None], rows)
    known = only(data.counted, ~np.isnan(states).any(axis=-1))
    return data._replace(states=states, counted=known).read_only()


LOWER, HIGHER, NEAR = "lower", "higher", "near"  # what is better in a figure


class Figure(NamedTuple):
    """A figure that sums up what is seen."""

    value: float
    unit: str
    better: str  # "lower", "higher", or "near" its target
    target: float | None = None  # the expected value of NEES and NIS


class View(NamedTuple):
    """A filter on S runs of K rows: of a plant one a seed, of logs one a log; NaN where there is nothing."""

    time: np.ndarray  # (S, K), [s], or steps where there is no sample time
    truth: np.ndarray | None  # (S, K, n), None where it is unknown
    estimate: np.ndarray  # (S, K, n)
    deviation: np.ndarray  # (S, K, n), standard deviations; half of the 95 % band is 1.96 of it
    innovation: np.ndarray  # (S, K, m), NaN where nothing was measured
    innovation_deviation: np.ndarray  # (S, K, m)
    nees: np.ndarray | None  # (S, K), NaN where a step is not scored; None without truth
    nis: np.ndarray  # (S, K), likewise
    nees_band: tuple[np.ndarray, np.ndarray] | None  # (K,) each: where the mean over the runs lies with 95 %
    nis_band: tuple[np.ndarray, np.ndarray]  # likewise
    autocorrelation: np.ndarray  # (m, L), of each channel's whitened innovations with themselves, lags 1 to L
    autocorrelation_band: float  # of white ones it lies within plus and minus this with 95 %
    figures: Mapping[str, Figure]


def view_of(filter_: Filter, page_data: PageData, problem: Problem) -> View:
    """A filter on the data of a bench."""
    data = page_data.drawn
    estimates = estimates_on(filter_, data)
    runs = metrics_by_run(filter_, estimates, data, outputs=False, scale=problem.scale)
    measured, n = ~np.isnan(data.seen.measurements), len(problem.quantities.states)
    white = _whiteness(estimates, data)
    truth = data.states is not None
    return View(
        time=_times(filter_, data, 1.0 if problem.dt is None else problem.dt),
        truth=data.known_states if truth else None,
        estimate=_there(data, estimates.means[..., :n]),
        deviation=_there(data, _deviations(estimates.covs)[..., :n]),
        innovation=np.where(measured, estimates.innovations, np.nan),
        innovation_deviation=np.where(measured, _deviations(estimates.innovation_covs), np.nan),
        nees=_padded_scores(runs.nees, data) if truth and runs.nees is not None else None,
        nis=_padded_scores(runs.nis, data),
        nees_band=_band(np.where(data.scored, float(n), 0.0)) if truth else None,
        nis_band=_band(np.where(data.scored, measured.sum(axis=-1), 0).astype(np.float64)),
        autocorrelation=white[0],
        autocorrelation_band=white[1],
        figures=_figures(filter_, page_data, runs, problem),
    )


def _times(filter_: Filter, data: Data, dt: float) -> np.ndarray:
    """Times (S, K) of all rows; of logs on their own stamps the last input says how many dt a step is."""
    runs, even = data.inputs.shape[0], dt * np.arange(data.steps + 1)
    if not filter_.model.shape.step_ratio:
        return np.broadcast_to(even, (runs, len(even)))
    return dt * np.concatenate([np.zeros((runs, 1)), np.cumsum(data.inputs[..., -1], axis=1)], axis=1)


def _figures(filter_: Filter, page_data: PageData, runs: RunMetrics, problem: Problem) -> dict[str, Figure]:
    """The figures of a bench: those of `tuning.evaluation`, without intervals."""
    data, scale = page_data.counted, problem.scale
    evaluation = _summed(filter_, data, scale, runs if data is page_data.drawn else None)
    figures = {**_of_states(evaluation, problem), **_of_innovations(evaluation)}
    if page_data.held_out is not None:
        held_out = _summed(filter_, page_data.held_out, scale)
        held_out_figures = {**_of_states(held_out, problem), **_of_innovations(held_out)}
        figures |= {f"held-out {name}": figure for name, figure in held_out_figures.items() if name != "restarts"}
    return figures


def _summed(filter_: Filter, data: Data, scale, runs: RunMetrics | None = None) -> Evaluation:
    """An evaluation without intervals and derived outputs, of metrics that are there or to be found."""
    metrics = metrics_of_all(filter_, data, outputs=False, scale=scale) if runs is None else runs
    return compute_metrics(filter_, metrics, data, scale, intervals=False, variances=False)


def _of_states(evaluation: Evaluation, problem: Problem) -> dict[str, Figure]:
    if not evaluation.has_truth:
        return {}
    rmse = {
        f"RMSE {state.symbol}": Figure(error.value, state.unit, LOWER)
        for state, error in zip(evaluation.states, evaluation.rmse, strict=True)
    }
    score = {score_label([problem]).partition(" [")[0]: Figure(evaluation.score.value, "-", LOWER)}
    nees = Figure(evaluation.nees.value, "-", NEAR, float(len(evaluation.rmse)))
    rest = {"NEES": nees, "log score": Figure(evaluation.log_score.value, "nat", HIGHER)}
    return {**rmse, **score, **{name: figure for name, figure in rest.items() if not np.isnan(figure.value)}}


def _of_innovations(evaluation: Evaluation) -> dict[str, Figure]:
    restarts = {"restarts": Figure(float(evaluation.divergences), "-", LOWER)}
    if np.isnan(evaluation.log_likelihood):
        return restarts
    nis = Figure(evaluation.nis.value, "-", NEAR, evaluation.expected_nis)
    return {"NIS": nis, "log-likelihood": Figure(evaluation.log_likelihood, "nat", HIGHER), **restarts}


def _padded_scores(late: np.ndarray, data: Data) -> np.ndarray:
    """Values (S, T) of late steps as those of all steps, NaN before."""
    values = np.full(data.measurements.shape[:2], np.nan)
    values[:, data.late] = late
    return values


def _there(data: Data, values: np.ndarray) -> np.ndarray:
    """Values (S, K, n), NaN in the padding of shorter runs."""
    if (data.rows == data.steps + 1).all():
        return values
    return np.where((np.arange(data.steps + 1) < data.rows[:, None])[..., None], values, np.nan)


def _band(freedom: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    low, high = band_of_means(freedom).T
    return low, high


def _deviations(covs: np.ndarray) -> np.ndarray:
    """Standard deviations (S, K, d) of covariances (S, K, d, d); zero without a covariance."""
    return np.sqrt(np.maximum(np.einsum("...ii->...i", covs), 0.0))


def _whiteness(estimates: Estimates, data: Data) -> tuple[np.ndarray, float]:
    """Autocorrelations (m, L) of the scored innovations, and the half-width of their band."""
    late = data.late
    present = ~np.isnan(data.late_scored(data.measurements))
    result = whiteness(
        estimates.innovations[:, late],
        estimates.innovation_covs[:, late],
        present,
        min(LAGS, present.shape[1] - 1),
    )
    widths = np.einsum("lii->il", result.half_widths)
    informative = widths[
        widths < 1.0
    ]  # of slow sensors some lags have no pairs, and any correlation lies within theirs
    return np.einsum("lii->il", result.correlations).copy(), float(informative.max(initial=0.0)) or 1.0
