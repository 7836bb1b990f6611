"""Standard problems with published scores, beside those of our filters.

The score of data assimilation is "rmse.a": after each analysis the root mean square error over the states, then
the mean of these over time, without the burn-in. The RMSE of our tables is pooled instead: the root mean square
over runs, steps and states, in which times when a filter has diverged have more weight. Both are reported.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from filters import StateSpaceModel, make_filter
from filters.consistency.intervals import Interval, mean_interval
from filters.engine.batch import run
from thruster_env.core.checks import at_least, one_of
from tuning.evaluation.runs import state_errors
from tuning.experiments import BENCHMARKS
from tuning.problems.model_problem import ModelProblem

RUNS = 16  # of 1000 analyses each; published scores seem to be of one such run
MOST_RUNS = 10_000
CLOSE = 0.05  # relative difference up to which two scores are called the same
WHY = "why different"
NUMBERS = {  # in words
    "ensemble_size": "N = {0}",
    "rotations": "rotations",
    "centred_perturbations": "centred perturbations",
    "regularisation": "regularisation {0:.3g}",
    "resampling_threshold": "threshold {0:g}",
}


class Row(NamedTuple):
    """The score of a filter beside a published one."""

    label: str
    theirs: float
    ours: Interval
    pooled: float  # root of the mean square error over runs, scored steps and states
    divergences: int  # filter resets: restarts from the prior
    run_median: float  # median of our score over single runs, robust against few runs that diverge for a time ...
    run_std: float  # ... and its standard deviation
    known: str  # the reason for a difference, if one is known

    @property
    def ratio(self) -> float:
        """Ours over theirs."""
        return self.ours.value / self.theirs

    @property
    def why(self) -> str:
        """The column "why different"."""
        if abs(self.ratio - 1.0) <= CLOSE:
            return f"agrees within {100 * CLOSE:.0f} %"
        if self.known:
            return self.known
        if abs(self.run_median / self.theirs - 1.0) <= CLOSE:
            return f"the median run agrees within {100 * CLOSE:.0f} %; few runs lose the truth for a time"
        scatters = abs(self.ours.value - self.theirs) < 2.0 * self.run_std
        return "within the scatter of a single run" if scatters else "no reason known to us"

    def cells(self) -> list[str]:
        """The row as text, as `Benchmark.header` has it."""
        ours = f"{self.ours.value:.3f} [{self.ours.low:.3f}, {self.ours.high:.3f}]"
        median, pooled = (f"{value:.3f}" for value in (self.run_median, self.pooled))
        return [self.label, f"{self.theirs:.4g}", ours, f"{self.ratio:.3f}", median, pooled, self.why]


OnRow = Callable[[Row], None]


class Benchmark(NamedTuple):
    """A standard problem with its filters.

    `rows(seeds, on_row)` returns the rows for some seeds, and calls `on_row` with each of them.
    """

    name: str
    about: str
    theirs: str  # heading of `Row.theirs`
    score: str  # the score that is compared
    source: str
    remarks: tuple[str, ...]
    rows: Callable[[Sequence[int], OnRow], list[Row]]

    @property
    def header(self) -> list[str]:
        """Headings of a table of rows."""
        return ["filter", self.theirs, f"ours, {self.score}", "ratio", "median run", "pooled", WHY]

    def reproduce(self, runs: int = RUNS, seed: int = 0, on_row: OnRow = lambda row: None) -> list[Row]:
        """All rows over so many seeds from `seed` on; ValueError for fewer than two."""
        first, count = at_least("seed", seed, 0), at_least("runs", runs, 2, MOST_RUNS)
        return self.rows(range(first, first + count), on_row)


class Published(NamedTuple):
    """A published score, and our filter that is compared with it."""

    filter: str
    numbers: Mapping[str, float]  # parameters of the filter
    value: float
    model: Mapping[str, float] = {}  # arguments of the model that the filter assumes
    why: str = ""  # reason for a difference

    @property
    def label(self) -> str:
        """Filter and parameters in words."""
        settings = {**self.numbers, **self.model}.items()
        return ", ".join(
            [self.filter, *(NUMBERS.get(name, f"{name} {{0:g}}").format(value) for name, value in settings)]
        )


def find_benchmark(name: str) -> Benchmark:
    """A benchmark by name; ValueError for an unknown one."""
    return importlib.import_module(BENCHMARKS[one_of("benchmark", name, tuple(BENCHMARKS))]).BENCHMARK


def noise_free_problem(truth: StateSpaceModel, **arguments) -> ModelProblem:
    """A problem whose filters assume the truth, with a Q of zero: a study tunes the filter's own parameters."""
    r = tuple(np.diag(truth.measurement_noise_cov).tolist())
    untuned = {"process_noise_cov": (0.0,) * truth.n, "measurement_noise_cov": r}
    return ModelProblem(truth, untuned=untuned, **arguments)


def mean_of_roots(errors: np.ndarray) -> np.ndarray:
    """rmse.a of each run, (B,), from its errors at the scored analyses (B, K, n)."""
    return np.sqrt(np.square(errors).mean(axis=2)).mean(axis=1)


def against_published(
    problem: ModelProblem, model: Callable[..., StateSpaceModel], published: Sequence[Published]
) -> Callable[[Sequence[int], OnRow], list[Row]]:
    """`Benchmark.rows` for published values of rmse.a.

    Args:
        problem: makes the data.
        model: makes the filters' model from the arguments `Published.model`.
        published: one for each row.
    """

    def rows(seeds: Sequence[int], on_row: OnRow) -> list[Row]:
        data, rows = problem.data(seeds), []
        for row in published:
            filter_ = make_filter(row.filter, model(**row.model), **row.numbers)
            estimates = run(filter_, data.filter_keys, data.inputs, data.measurements)
            errors = state_errors(filter_, estimates, data)[:, data.late]
            pooled, lost = np.sqrt(np.square(errors).mean()), estimates.divergences.sum()
            scores = mean_of_roots(errors)
            runs = float(np.median(scores)), float(scores.std(ddof=1))
            rows.append(Row(row.label, row.value, mean_interval(scores), float(pooled), int(lost), *runs, row.why))
            on_row(rows[-1])
        return rows

    return rows
