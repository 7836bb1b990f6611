"""`tuning.train_estimator` and `thruster train-estimator`: train an estimator with a network, and compare it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from rich.console import Console
from rich.progress import TextColumn

from filters.consistency.nees import Interval
from filters.estimators.foreign import TRAINED, ForeignFilter
from filters.filter import Filter
from filters.learned import check_installed
from filters.logs.findings import colour_of
from thruster_env.core.checks import at_least, listening, one_of, positive
from thruster_env.core.files import check_target, panels
from thruster_env.core.text_tables import Table, verbatim
from tuning.api import markers
from tuning.api.markers import FILTER, INPUT, LEARNING, READ, Argument, Option, Preset, Seed, WrittenFile
from tuning.api.problems import problem_of
from tuning.api.progress import bar, console_for
from tuning.api.result import Result, about, drawn, frame, number, plain_data
from tuning.api.tune import file_name
from tuning.evaluation.baselines import ORACLE, oracle
from tuning.evaluation.tuned import read_choice
from tuning.problems.check import data_of
from tuning.problems.problem import Problem
from tuning.search.plan import HELD_OUT_SEEDS, VALIDATION_SEEDS
from tuning.search.study import STOPPING, stop_on_interrupt

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure

    from filters.learned.estimator import LearnedEstimator
    from tuning.learning import Check, Standing

FOLDER = Path("out") / "estimators"
MOST = 1_000_000


@dataclass(frozen=True, eq=False, repr=False)
class EstimatorTraining(Result):
    """A training and its result.

    Attributes:
        kind: of the estimator.
        problem: on whose runs it was trained.
        file: where the trained estimator is.
        checks: scores of validation runs during the training.
        standings: on held-out runs; the trained estimator comes last, the others are compared with the first.
        seconds: that the training took.
        filters: the same by label.
        seed: of the study to which all runs belong.
        interrupted: whether Ctrl-C ended it; the file has the best weights so far.
    """

    kind: str
    problem: Problem
    file: Path
    checks: tuple[Check, ...]
    standings: tuple[Standing, ...]
    seconds: float
    filters: Mapping[str, Filter]
    seed: int = 0
    interrupted: bool = False

    @property
    def ratio(self) -> Interval:
        """The trained estimator's score over that of the best other filter, paired on held-out runs."""
        return self.standings[-1].ratio(self.best_other)

    @property
    def best_other(self) -> Standing:
        """The filter with the lowest held-out score, without the oracle, which knows the plant's Q and R."""
        from tuning.learning import HELD_OUT

        candidates = (standing for standing in self.standings[:-1] if not standing.label.endswith(f" {ORACLE}"))
        return min(candidates, key=lambda standing: standing.evaluations[HELD_OUT].score.value)

    def sentences(self) -> list[str]:
        """Whether training paid."""
        ratio, other = self.ratio, self.best_other.label
        sentence = f"{self.kind} has {about(ratio)} of the score of {other}"
        if ratio.low > 1.0:
            verdict = f"{sentence}: it is significantly worse. Take {other}."
        elif ratio.high < 1.0:
            verdict = f"{sentence}: it is significantly better."
        else:
            verdict = f"{sentence}: no significant difference. {other} is cheaper."
        stopped = ["Interrupted: these are the best weights so far."] if self.interrupted else []
        return [verdict, *stopped]

    @property
    def title(self) -> str:
        """What was trained."""
        return f"{self.kind} trained on {self.problem.name}"

    def tables(self) -> list[Table | str]:
        """Held-out scores, also on longer and noisier runs, whether training paid, and the file."""
        from tuning.learning import HELD_OUT, LONGER, NOISIER

        first, rows = self.standings[0], []
        for standing in self.standings:
            ratios = (standing.ratio(first, name) for name in (HELD_OUT, LONGER, NOISIER))
            cells = [
                "" if standing is first else "-" if np.isnan(ratio.value) else about(ratio) for ratio in ratios
            ]
            evaluation = standing.evaluations[HELD_OUT]
            rows.append(
                [standing.label, number(evaluation.score.value), *cells, number(evaluation.nees.value, ".3g")]
            )
        count = len(first.evaluations[HELD_OUT].mean_squares)
        title = f"{count} held-out {self.problem.seed_word} of {self.problem.name}"
        columns = ["filter", "score", f"over {first.label}", LONGER, NOISIER, "NEES"]
        caption = f"{LONGER}, {NOISIER}: score over {first.label} on such runs."
        return [
            Table(title, columns, rows, caption),
            *self.sentences(),
            f"{self.seconds:.0f} s for {self.checks[-1].step} updates.",
            f"Trained estimator: {self.file}",
            f"Use it: thruster compare {self.file} --filter ekf --problem {self.problem.name}",
        ]

    def figures(self) -> dict[str, Figure]:
        """The course of the training, and one held-out run of the first filter and the estimator."""
        from tuning.reporting.time_figures import draw_estimates

        filters, seed = list(self.filters), self.problem.held_out_seeds(self.seed, 2)[0]
        pair = {name: self.filters[name] for name in (filters[0], filters[-1])}
        scored = np.flatnonzero(np.isfinite(self.problem.scale or ())).tolist()
        run = draw_estimates(pair, data_of(self.problem, [seed]), 0, self.problem.dt, scored)
        return {
            "Scores of validation runs during the training": self.plot_training(),
            f"Truth, estimate and 95 % band, if there is a covariance, of held-out seed {seed}": run,
        }

    def as_dict(self) -> dict[str, Any]:
        """All results as plain data, as in `thruster train-estimator --json`."""
        from tuning.learning import HELD_OUT

        first = self.standings[0]
        rows = []
        for standing in self.standings:
            row: dict[str, Any] = {"filter": standing.label, "nees": standing.evaluations[HELD_OUT].nees.value}
            for name, evaluation in standing.evaluations.items():
                row[name] = {"score": evaluation.score.value, "ratio": standing.ratio(first, name)._asdict()}
            rows.append(row)
        data = {
            "kind": self.kind,
            "problem": self.problem.name,
            "file": str(self.file),
            "checks": [check._asdict() for check in self.checks],
            "standings": rows,
            "seconds": self.seconds,
            "interrupted": self.interrupted,
        }
        return plain_data(data)

    def to_frame(self) -> pandas.DataFrame:
        """A row for each filter: scores on held-out, longer and noisier runs, with their ratios to the first."""
        from tuning.learning import HELD_OUT, LONGER, NOISIER

        rows = []
        for standing in self.as_dict()["standings"]:
            row = {"filter": standing["filter"], "NEES": standing["nees"]}
            for name in (HELD_OUT, LONGER, NOISIER):
                result = standing.get(
                    name, {"score": np.nan, "ratio": {"value": np.nan, "low": np.nan, "high": np.nan}}
                )
                row[name] = result["score"]
                row |= {f"{name}, ratio {key}": value for key, value in result["ratio"].items()}
            rows.append(row)
        return frame({name: [row[name] for row in rows] for name in rows[0]})

    def plot_training(self) -> Figure:
        """Validation score over updates, beside the held-out score of the first filter."""
        from tuning.learning import HELD_OUT

        figure, (axis,) = panels(1, 1, (6.0, 3.6))
        steps, scores = [check.step for check in self.checks], [check.score for check in self.checks]
        axis.plot(steps, scores, "o-", color=colour_of(self.kind), label=f"{self.kind}, validation")
        first = self.standings[0]
        level = first.evaluations[HELD_OUT].score.value
        axis.axhline(level, color=colour_of(first.name), linestyle="--", label=f"{first.label}, held out")
        axis.set_xlabel("updates of the weights")
        axis.set_ylabel("score: mean RMSE over scale [-]")
        axis.set_title(verbatim(self.problem.name), fontsize=11)
        axis.legend()
        return drawn(figure)

    def __repr__(self) -> str:
        return f"EstimatorTraining({self.kind} on {self.problem.name}, {self.file})"


def train_estimator(
    kind: Annotated[str, Argument()] = "kalmannet",
    problem: Annotated[Any, Option(INPUT, type=str, choices="problems")] = "nominal",
    *,
    preset: Preset = None,
    runs: Annotated[int, Option(LEARNING)] = 200,
    steps: Annotated[int, Option(LEARNING)] = 1000,
    batch: Annotated[int, Option(LEARNING)] = 32,
    window: Annotated[int, Option(LEARNING)] = 50,
    rate: Annotated[float, Option(LEARNING)] = 5e-3,
    width: Annotated[int | None, Option(LEARNING)] = None,
    ensemble_size: Annotated[int | None, Option(LEARNING)] = None,
    start: Annotated[str | Path | None, Option(LEARNING, metavar="FILE", type=Path, file=READ)] = None,
    against: Annotated[Sequence[str | Path], Option(FILTER, metavar="FILE", type=list[Path], file=READ)] = (),
    seeds: Annotated[int, Option(markers.RUNS)] = HELD_OUT_SEEDS,
    seed: Seed = 0,
    out: WrittenFile = None,
    progress: markers.Progress = None,
) -> EstimatorTraining:
    """Train an estimator with a network on a problem's runs, and compare it with filters on held-out ones.

    Training needs true states. It begins with the mean gain of the extended Kalman filter of the best baseline,
    and keeps the weights that are best on validation runs; Ctrl-C keeps the best so far. The table shows the score
    over that filter's, also on runs twice as long and on runs with four times the R, which no training saw.

        training = tuning.train_estimator("recursive-kalmannet", "outliers")
        tuning.compare(["ekf", training.file], "outliers")

    The file is an estimator wherever a filter is one: `--filter FILE`, `thruster compare FILE`, `EstimateState`.

    Needs the extra learned: pip install '.[learned]' in the project's folder.

    Example: thruster train-estimator recursive-kalmannet --problem outliers --steps 500

    Args:
        kind: estimator: kalmannet (a learned gain), recursive-kalmannet (the same with a covariance), gru (a
            network without a model) or differentiable-enkf (an ensemble with learned noise).
        problem: name of a problem with true states. In Python as for `tuning.tune`.
        preset: the problem of another thruster.
        runs: number of training runs.
        steps: updates of the weights.
        batch: runs in each update.
        window: steps of a run over which gradients go back.
        rate: Adam's step size at first.
        width: hidden states of a gru (64), or of each network of a differentiable-enkf (32).
        ensemble_size: members of a differentiable-enkf; 30 by default.
        start: continue from the weights of this file.
        against: also compare with this tuned file of `thruster tune`; may be repeated. In Python a list.
        seeds: number of held-out runs.
        seed: seed of all randomness; the same seed gives the same results.
        out: the trained estimator, ending in .safetensors; by default in out/estimators.
        progress: whether to show progress; by default only in terminals and notebooks.

    Returns:
        `EstimatorTraining`: `file`, `checks`, `standings`, `to_frame()`, `plot_training()`, `report(page)`.

    Raises:
        ValueError: states the rule and the value.
    """
    check_installed()
    from filters.learned.filters import LEARNED  # torch takes seconds to import
    from tuning.learning import Settings, new_estimator, standings, starting_filter

    one_of("an estimator", kind, tuple(LEARNED))
    chosen = problem_of(problem, preset)
    if chosen.scale is None:
        raise ValueError(f"training needs true states, but {chosen.name} has none")
    settings = Settings(
        at_least("steps", steps, 1, MOST),
        at_least("batch", batch, 1, MOST),
        at_least("window", window, 1, MOST),
        positive("rate", rate),
    )
    target = FOLDER / f"{kind}-{file_name(chosen.name)}{TRAINED}" if out is None else Path(out)
    if target.suffix != TRAINED:
        raise ValueError(f"out must end in {TRAINED}, but got {target}")
    check_target(target)
    competitors = {Path(path).stem: read_choice(Path(path), chosen).filter(chosen) for path in against}
    chosen.held_out_seeds(seed, seeds)  # a clear error before the training
    console = console_for(progress)
    training_seeds = chosen.training_seeds(seed, at_least("runs", runs, 1))
    data = data_of(chosen, training_seeds)
    first, filter_ = starting_filter(chosen, data, seed)
    sizes = {"width": width, "ensemble_size": ensemble_size}
    options = {name: size for name, size in sizes.items() if size is not None}
    estimator = new_estimator(kind, filter_, data, seed, start, **options)
    began = time.perf_counter()
    with stop_on_interrupt() as stopped:
        checks = _trained(estimator, chosen, data, settings, seed, target, stopped, console)
        interrupted = stopped()
    seconds = time.perf_counter() - began
    known = oracle(filter_.name, chosen)
    filters: dict[str, Filter] = {first: filter_, **competitors}
    if known is not None:
        filters[f"{filter_.name} {ORACLE}"] = known.filter(chosen)
    filters[kind] = ForeignFilter(model=estimator.model, estimator=estimator)
    with console.status("held-out runs ..."):
        rows = standings(filters, chosen, chosen.held_out_seeds(seed, seeds))
    return EstimatorTraining(kind, chosen, target, tuple(checks), tuple(rows), seconds, filters, seed, interrupted)


def _trained(
    estimator: LearnedEstimator,
    problem: Problem,
    data: Any,
    settings: Any,
    seed: int,
    target: Path,
    stopped: Callable[[], bool],
    console: Console,
) -> list[Check]:
    """The checks of a training, of which the best one is always on disk."""
    from filters.learned.filters import write_estimator
    from tuning.learning import train

    validation = data_of(problem, problem.validation_seeds(seed, VALIDATION_SEEDS))
    origin = {"problem": problem.name, "digest": problem.digest, "seed": seed, "runs": len(data.seeds)}
    origin["plant"] = problem.plant_data
    target.parent.mkdir(parents=True, exist_ok=True)
    with _bar(f"{estimator.kind} on {problem.name}", settings.steps, console) as (on_step, show):

        def on_check(check: Check) -> None:
            show(check.score)
            if check.best:
                write_estimator(target, estimator, {**origin, **settings._asdict(), "step": check.step})

        return train(estimator, data, validation, problem.scale, settings, seed, on_step, on_check, stopped)


@contextmanager
def _bar(
    title: str, total: int, console: Console
) -> Iterator[tuple[Callable[[int], None], Callable[[float], None]]]:
    """Callbacks after an update, with its number, and after a check, with its score."""
    column = TextColumn("validation {task.fields[score]}", markup=False)
    with bar(title, console, column, total=total, score="-") as update:
        scores: list[float] = []

        def on_check(score: float) -> None:
            scores.append(score)
            update(score=f"{min(scores):.4g}")

        def show(far: str) -> None:
            if far == STOPPING:
                update(description=far, refresh=True)

        with listening(show):
            yield lambda step: update(completed=step), on_check
