"""`tuning.train_estimator`: an estimator with a network, trained on a problem's runs and compared on others."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from filters.estimators.find import TRAINED
from filters.estimators.foreign import ForeignFilter
from filters.filter import Filter
from filters.learned import check_installed
from thruster_env.core.checks import at_least, listening, one_of, positive
from thruster_env.core.files import check_target
from tuning.api.problems import problem_of
from tuning.api.progress import console_for
from tuning.api.run import file_name
from tuning.evaluation.baselines import ORACLE, oracle
from tuning.evaluation.tuned import read_choice
from tuning.learning.settings import Settings
from tuning.problems.check import data_of
from tuning.problems.problem import Problem
from tuning.search.plan import HELD_OUT_SEEDS, VALIDATION_SEEDS
from tuning.search.study import STOPPING, stop_on_interrupt

if TYPE_CHECKING:
    from filters.learned.estimator import LearnedEstimator
    from tuning.api.estimator_training import EstimatorTraining
    from tuning.learning.training import Check

FOLDER = Path("out") / "estimators"
RUNS, DEFAULT = 200, Settings()
MOST = 1_000_000


def train_estimator(
    kind: str = "kalmannet",
    problem: Any = "nominal",
    *,
    runs: int = RUNS,
    steps: int = DEFAULT.steps,
    batch: int = DEFAULT.batch,
    window: int = DEFAULT.window,
    rate: float = DEFAULT.rate,
    options: Mapping[str, int] | None = None,
    start: str | Path | None = None,
    against: Sequence[str | Path] = (),
    seeds: int = HELD_OUT_SEEDS,
    seed: int = 0,
    file: str | Path | None = None,
    preset: str | Path | None = None,
    progress: bool | None = None,
) -> EstimatorTraining:
    """Train an estimator with a network on runs whose true states are known, and compare it on held-out runs.

    It begins with the mean gain of the extended Kalman filter with the best baseline's Q and R, and keeps the
    weights of the best check on validation runs. The table has scores over that filter's, also on runs twice as
    long and on runs with four times the R. Ctrl-C keeps the best weights so far.

        training = tuning.train_estimator("recursive-kalmannet", "outliers")
        tuning.compare(["ekf", training.file], "outliers")

    Args:
        kind: "kalmannet" (a learned gain), "recursive-kalmannet" (with a covariance), "gru" (no model) or
            "differentiable-enkf" (learned noise).
        problem: as for `tuning.tune`, with true states.
        runs: number of training runs.
        steps: updates of the weights.
        batch: runs in each update.
        window: steps of a run over which gradients go back.
        rate: Adam's step size at first.
        options: of the estimator: `width` of a "gru", `ensemble_size` and `width` of a "differentiable-enkf".
        start: file of a trained estimator whose weights are the first; by default an untrained one.
        against: tuned files for the table.
        seeds: number of held-out runs.
        seed: of the study to which all runs belong, and of the weights.
        file: where the trained estimator is stored, ending in .safetensors; by default in out/estimators.
        preset: the problem of another thruster, by name or file.
        progress: whether to show progress; by default only in terminals and notebooks.

    Returns:
        `EstimatorTraining`: `file`, `checks`, `standings`, `to_frame()`, `plot_training()`, `report(page)`.

    Raises:
        ValueError: states the rule and the value.
    """
    check_installed()
    from filters.learned.file import LEARNED  # torch takes seconds to import
    from tuning.api.estimator_training import EstimatorTraining
    from tuning.learning.training import new_estimator, standings, starting_filter

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
    target = FOLDER / f"{kind}-{file_name(chosen.name)}{TRAINED}" if file is None else Path(file)
    if target.suffix != TRAINED:
        raise ValueError(f"file must end in {TRAINED}, but got {target}")
    check_target(target)
    competitors = {Path(path).stem: read_choice(Path(path), chosen).filter(chosen) for path in against}
    chosen.held_out_seeds(seed, seeds)  # a clear error before the training
    console = console_for(progress)
    training_seeds = chosen.training_seeds(seed, at_least("runs", runs, 1))
    data = data_of(chosen, training_seeds)
    first, filter_ = starting_filter(chosen, data, seed)
    estimator = new_estimator(kind, filter_, data, seed, start, **(options or {}))
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
    from filters.learned.file import write_estimator
    from tuning.learning.training import train

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
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("validation {task.fields[score]}", markup=False),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console) as progress:
        task = progress.add_task(title, total=total, score="-")
        scores: list[float] = []

        def on_check(score: float) -> None:
            scores.append(score)
            progress.update(task, score=f"{min(scores):.4g}")

        def show(far: str) -> None:
            if far == STOPPING:
                progress.update(task, description=far, refresh=True)

        with listening(show):
            yield lambda step: progress.update(task, completed=step), on_check
