"""Standard problems with published scores, beside those of our filters.

The score of data assimilation is "rmse.a": after each analysis the root mean square error over the states, then
the mean of these over time, without the burn-in. The RMSE of our tables is pooled instead: the root mean square
over runs, steps and states, in which times when a filter has diverged have more weight. Both are reported.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import numpy as np

from filters import StateSpaceModel, make_filter
from filters.consistency.nees import Interval, mean_interval
from filters.engine.batch import run
from filters.filter import Filter
from thruster_env.core.checks import at_least, one_of
from thruster_env.core.files import read_toml
from thruster_env.core.text_tables import Table, markdown_table
from tuning.api.markers import RUNS as RUNS_PANEL
from tuning.api.markers import Option, PythonOnly, Seed
from tuning.api.result import Printed
from tuning.cli.output import progress_of
from tuning.evaluation.runs import state_errors
from tuning.problems.data import Data
from tuning.problems.model_problem import ModelProblem
from tuning.search.plan import Plan
from tuning.search.space import Choice

if TYPE_CHECKING:
    from tuning.search.study import StudyResult

BENCHMARKS = {
    "lorenz63": "tuning.experiments.lorenz63:BENCHMARK",
    "lorenz63-sparse": "tuning.experiments.lorenz63:SPARSE",
    "lorenz96": "tuning.experiments.lorenz96:BENCHMARK",
    "range-bearing": "tuning.experiments.range_bearing:BENCHMARK",
}  # objects of modules by name
RUNS, TRIALS = 16, 20  # of 1000 analyses each; published scores seem to be of one such run
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
    remarks: Sequence[str]
    rows: Callable[[Sequence[int], OnRow], list[Row]]
    published: Sequence[Published] = ()

    @property
    def header(self) -> list[str]:
        """Headings of a table of rows."""
        return ["filter", self.theirs, f"ours, {self.score}", "ratio", "median run", "pooled", WHY]

    def markdown(self) -> str:
        """The rows without pooled errors, with a reason only where a score differs, and the remarks."""
        remarks = "\n".join(f"- {remark}" for remark in self.remarks)
        rows = [[*row.cells()[:-2], "" if abs(row.ratio - 1.0) <= CLOSE else row.why] for row in self.reproduce()]
        return f"{markdown_table([*self.header[:-2], WHY], rows)}\n\n{remarks}"

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
    module, _, benchmark = BENCHMARKS[one_of("benchmark", name, tuple(BENCHMARKS))].partition(":")
    return getattr(importlib.import_module(module), benchmark)


def reproduce(
    name: Annotated[str, PythonOnly()], runs: Annotated[int, Option(RUNS_PANEL)] = RUNS, seed: Seed = 0
) -> Printed:
    """Solve a standard problem with our filters, and compare them with published results or another package.

    The table compares a score of each filter, with its 95 % interval. Median run: median score of single runs.
    Pooled: the RMSE of our tables.

    Example: thruster reproduce lorenz63

    Args:
        name: of the problem.
        runs: independent runs, at least 2; few make wide intervals.
        seed: seed of all randomness; the same seed gives the same results.
    """
    benchmark = find_benchmark(name)
    with progress_of("...") as progress:
        rows = benchmark.reproduce(runs, seed, lambda row: progress(f"done: {row.label}", 0, 0))
    columns = benchmark.header
    columns[2] = f"ours ({runs} runs)"
    table = Table(benchmark.about, columns, [row.cells() for row in rows], words=[WHY])
    data = {
        "settings": {"runs": runs, "seed": seed},
        "source": benchmark.source,
        "score": benchmark.score,
        "theirs": benchmark.theirs,
        "rows": [row._asdict() | {"ratio": row.ratio, "why": row.why} for row in rows],
        "statements": list(benchmark.remarks),
    }
    remarks = [f"- {remark}" for remark in benchmark.remarks]
    return Printed([table, f"Score: {benchmark.score}. Source: {benchmark.source}", *remarks], data)


def run_in_memory(plan: Plan, trials: int, start: Choice | None = None) -> StudyResult:
    """The result of a study that is not stored; its first trial is `start`, by default the untuned filter."""
    from tuning.search.storage import quiet_optuna
    from tuning.search.study import open_study, run_study

    quiet_optuna()
    return run_study(open_study("in memory", plan, None, start), plan, trials).or_interrupted()


def noise_free_problem(truth: StateSpaceModel, **arguments) -> ModelProblem:
    """A problem whose filters assume the truth, with a Q of zero: a study tunes the filter's own parameters."""
    r = tuple(np.diag(truth.measurement_noise_cov).tolist())
    untuned = {"process_noise_cov": (0.0,) * truth.n, "measurement_noise_cov": r}
    return ModelProblem(truth, untuned=untuned, **arguments)


def analysis_errors(filter_: Filter, data: Data) -> tuple[np.ndarray, int]:
    """Errors (B, K, n) of a filter at the scored analyses, and how often it restarted."""
    estimates = run(filter_, data.filter_keys, data.inputs, data.measurements)
    return state_errors(filter_, estimates, data)[:, data.late], int(estimates.divergences.sum())


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
            errors, lost = analysis_errors(filter_, data)
            pooled = np.sqrt(np.square(errors).mean())
            scores = mean_of_roots(errors)
            runs = float(np.median(scores)), float(scores.std(ddof=1))
            rows.append(Row(row.label, row.value, mean_interval(scores), float(pooled), lost, *runs, row.why))
            on_row(rows[-1])
        return rows

    return rows


def published_benchmark(
    name: str, problem: ModelProblem, model: Callable[..., StateSpaceModel], *more: Published
) -> Benchmark:
    """A benchmark of `published.toml` by name, with more published scores after those of the file.

    Args:
        name: of the benchmark.
        problem: makes the data.
        model: makes the filters' model from the arguments `Published.model`.
        *more: scores.
    """
    entry = read_toml(Path(__file__).with_name("published.toml"), "published scores")[name]
    published = [*(Published(**score) for score in entry.pop("published")), *more]
    return Benchmark(name, **entry, rows=against_published(problem, model, published), published=published)
