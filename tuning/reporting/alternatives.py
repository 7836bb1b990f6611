"""Text alternatives of pictures, for readers who cannot see them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import isfinite

import numpy as np
from optuna.trial import FrozenTrial, TrialState

from filters.engine.batch import Estimates
from filters.filter import Filter
from tuning.evaluation.held_out import Comparison
from tuning.evaluation.sizes import SizeRow
from tuning.problems.data import Data
from tuning.reporting.time_figures import one_run
from tuning.search.objectives import reported, reported_name
from tuning.search.trials import best_trial

NO_TRIALS = "No trial was finished."
TWO_SIDED = 1.96


def of_history(trials: Sequence[FrozenTrial], objective: str) -> str:
    """First and best trial of a study, and how many were pruned."""
    done = [trial for trial in trials if trial.state == TrialState.COMPLETE]
    best = best_trial(done) if done else None
    if best is None:
        return NO_TRIALS
    early = sum(trial.state == TrialState.PRUNED for trial in trials)
    first, last = (
        f"trial {trial.number + 1} has {reported(objective, trial.values[0]):.4g}" for trial in (done[0], best)
    )
    return (
        f"{reported_name(objective)} of {len(trials)} trials, {early} of them pruned: {first}; the best, {last}."
    )


def of_comparison(comparison: Comparison) -> str:
    """RMSE of every filter, state by state, and the bound."""
    sentences = []
    for i, state in enumerate(comparison.tuned.states):
        values = [f"{name} {evaluation.rmse[i].value:.3g}" for name, evaluation in comparison.evaluations.items()]
        values += [f"bound {comparison.bound[i]:.3g}"] if isfinite(comparison.bound[i]) else []
        sentences.append(f"RMSE of {state.name}{f' in {state.unit}' if state.unit else ''}: {', '.join(values)}")
    return f"Bars with whiskers. {'; '.join(sentences)}."


def of_importances(importances: Mapping[str, float]) -> str:
    """Every importance."""
    return f"Bars: {', '.join(f'{name} {value:.2f}' for name, value in importances.items())}."


def of_slices(trials: Sequence[FrozenTrial]) -> str:
    """Parameters of the best trial, and the range of the trials."""
    done = [trial for trial in trials if trial.state == TrialState.COMPLETE]
    best = best_trial(done) if done else None
    if best is None:
        return NO_TRIALS
    ranges = []
    for name, value in best.params.items():
        if isinstance(value, (int, float)):
            tried = [trial.params[name] for trial in done if name in trial.params]
            ranges.append(f"{name} {value:.3g}, tried from {min(tried):.3g} to {max(tried):.3g}")
    return f"Scatter of {len(done)} complete trials. The best has {'; '.join(ranges)}."


def of_front(front: Sequence[FrozenTrial], objectives: Sequence[str]) -> str:
    """Both ends of a Pareto front."""
    ends = sorted(trial.values for trial in front)
    described = [
        " and ".join(
            f"{reported_name(name)} {reported(name, value):.3g}"
            for name, value in zip(objectives, end, strict=True)
        )
        for end in ends
    ]
    return f"Pareto front of {len(front)} trials, from {described[0]} to {described[-1]}."


def of_sizes(sizes: Sequence[SizeRow], chosen: int) -> str:
    """RMSE at the smallest, the kept and the largest size."""
    states, sentences = sizes[0].evaluation.states, []
    for i, state in enumerate(states):
        ends = {sizes[0].size, chosen, sizes[-1].size}
        values = [f"{row.evaluation.rmse[i].value:.3g} at N = {row.size}" for row in sizes if row.size in ends]
        sentences.append(f"RMSE of {state.name}{f' in {state.unit}' if state.unit else ''}: {', '.join(values)}")
    return f"{'; '.join(sentences)}."


def of_estimates(filters: Mapping[str, Filter], data: Data, index: int, dt: float | None) -> str:
    """RMSE of each filter in one run and the share of the truth, or of the innovations, in its band."""
    sentences = []
    for name, filter_ in filters.items():
        run, parts = one_run(filter_, data, index, dt), []
        values, covs, what = _against(run.errors, run.innovations, run.estimates)
        quantities = filter_.model.states if run.errors is not None else filter_.model.measurements
        for i in range(values.shape[-1]):
            finite = np.isfinite(values[:, i]) & np.isfinite(covs[:, i, i])
            inside = np.abs(values[finite, i]) <= TWO_SIDED * np.sqrt(covs[finite, i, i])
            size = np.sqrt(np.mean(values[np.isfinite(values[:, i]), i] ** 2))
            share = f", {100 * inside.mean():.0f} % in the band" if finite.any() else ""
            parts.append(f"{quantities[i].name} {size:.3g} {quantities[i].unit}".rstrip() + share)
        sentences.append(f"{name}: {what} {'; '.join(parts)}")
    return f"{'. '.join(sentences)}."


def of_series(names: Sequence[str], values: np.ndarray, units: Sequence[str]) -> str:
    """Range and mean of every column of values (K, m), and how many are missing."""
    sentences = []
    for name, unit, column in zip(names, units, values.T, strict=True):
        finite = column[np.isfinite(column)]
        if not finite.size:
            sentences.append(f"{name}: nothing")
            continue
        missing = f", {len(column) - len(finite)} of {len(column)} missing" if len(finite) < len(column) else ""
        ends = f"from {finite.min():.3g} to {finite.max():.3g} {unit}".rstrip()
        sentences.append(f"{name} {ends}, mean {finite.mean():.3g}{missing}")
    return f"{'; '.join(sentences)}."


def _against(errors, innovations: np.ndarray, estimates: Estimates):
    """What is compared with a band: values, covariances and their name."""
    if errors is not None:
        return errors, estimates.covs[0], "RMSE of"
    return innovations, estimates.innovation_covs[0], "RMS innovation of"
