"""Means over training seeds, with intervals for the variation of both policies and episodes.

A figure is a number with its values when one training seed, or one episode, is left out. So differences and ratios
of figures are figures, and their intervals follow from the jackknife: each source of variation k has a variance

    v_k = (n_k - 1)/n_k sum_i (f_(i) - mean f_(i))^2,    f_(i) the figure without its i-th seed or episode

and the interval is f -+ t sqrt(sum_k v_k), with Student's t of (sum v_k)^2/sum (v_k^2/(n_k - 1)) degrees of
freedom. For one mean it is Student's interval, for a difference Welch's. Episodes are one source, because they are
the same for all policies; the training seeds of each policy are a separate source, because two policies are
trained independently. (The variation of one policy in one episode is in both sources, which is conservative.) With
five seeds it covers 95 %, where the middle 95 % of bootstrap resamples cover less than 90 %; a test simulates
both.

Sources: B. Efron, C. Stein (1981), "The jackknife estimate of variance", Annals of Statistics 9(3), 586-596;
B. L. Welch (1947), "The generalization of Student's problem when several different population variances are
involved", Biometrika 34, 28-35.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.stats import t as student

from filters.consistency.intervals import Interval
from tuning.policies.comparison.runs import Result

EPISODES = "episodes"  # the source of variation that all figures share


@dataclass(frozen=True)
class Figure:
    """A number, and by source of variation its values (n_k,) with one seed or episode left out each."""

    value: float
    without: Mapping[Hashable, np.ndarray] = field(default_factory=dict)

    def __sub__(self, other: Figure) -> Figure:
        """The difference of two figures."""
        return combined(lambda a, b: a - b, self, other)

    def __truediv__(self, other: Figure) -> Figure:
        """The ratio of two figures."""
        return combined(lambda a, b: a / b, self, other)


def combined(function: Callable, *figures: Figure) -> Figure:
    """A function of figures as a figure; a seed or episode is left out of all of them at the same time."""
    sources = dict.fromkeys(source for figure in figures for source in figure.without)
    return Figure(
        function(*(figure.value for figure in figures)),
        {k: function(*(figure.without.get(k, figure.value) for figure in figures)) for k in sources},
    )


def mean_figure(of_seeds: np.ndarray, without_episode: np.ndarray, source: Hashable) -> Figure:
    """The mean over training seeds of a quantity.

    Args:
        of_seeds: its values (S,), one a seed.
        without_episode: the same (E, S) with each of E episodes left out.
        source: name of the variation of these seeds; it cannot be estimated from one seed.
    """
    count, total = len(of_seeds), of_seeds.sum()
    without: dict[Hashable, np.ndarray] = {EPISODES: without_episode.mean(axis=1)}
    if count > 1:
        without[source] = (total - of_seeds) / (count - 1)
    return Figure(float(total / count), without)


def typical_return(results: Sequence[Result]) -> Figure:
    """Mean over seeds and episodes of the return of one policy."""
    returns = np.stack([result.scores.returns for result in results], axis=1)
    return mean_figure(returns.mean(axis=0), _left_out(returns) / max(len(returns) - 1, 1), _source(results))


def typical_error(results: Sequence[Result], part: str) -> Figure:
    """Mean over seeds of the pooled thrust error in a part of `Scores`, RMS [N]; NaN where no step counts."""
    parts = [result.scores.parts[part] for result in results]
    squares, steps = (np.stack(columns, axis=1) for columns in zip(*parts, strict=True))
    with np.errstate(invalid="ignore"):
        of_seeds = np.sqrt(squares.sum(axis=0) / steps.sum(axis=0))
        # By rounding a sum of squares that should be zero may be negative.
        return mean_figure(
            of_seeds, np.sqrt(np.maximum(_left_out(squares), 0) / _left_out(steps)), _source(results)
        )


def as_interval(figure: Figure) -> Interval:
    """The figure with its 95 % interval."""
    variances, freedoms = [], []
    for values in figure.without.values():
        if len(values) > 1:
            variances.append((len(values) - 1) * values.var())
            freedoms.append(len(values) - 1)
    variance = sum(variances)
    if not variance > 0:
        return Interval(figure.value, figure.value, figure.value)
    freedom = variance**2 / sum(v**2 / n for v, n in zip(variances, freedoms, strict=True))
    half = student.ppf(0.975, freedom) * np.sqrt(variance)
    return Interval(float(figure.value), float(figure.value - half), float(figure.value + half))


def _left_out(values: np.ndarray) -> np.ndarray:
    """Sums over episodes of values (E, S) with each of them left out, (E, S)."""
    return values.sum(axis=0) - values


def _source(results: Sequence[Result]) -> Hashable:
    run = results[0].run
    return run.noise, run.kind, run.label
