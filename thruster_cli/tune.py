"""`thruster tune`: an Optuna study of a filter's noise covariances and ensemble size, with its proof."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from numerics.checks import at_least, one_of
from numerics.files import check_target
from numerics.progress import listening
from thruster_cli.log_problems import problems_of
from thruster_cli.options import (
    FILTER,
    FILTER_HELP,
    INPUT,
    OUTPUT,
    RUNS,
    SEARCH,
    BlocksOption,
    ClockOption,
    ColumnOption,
    DtOption,
    HeldOutOption,
    JsonOption,
    LeadOption,
    LogOption,
    LogPresetOption,
    ModelOption,
    SeedOption,
    SensorOption,
    filter_option,
    spelt,
)
from thruster_cli.output import announce_compilation, check_targets, emit, progress_console, working
from thruster_cli.problems import PROBLEMS
from thruster_cli.tuning_report import Tuning, as_json, report
from tuning.evaluation.held_out import prove
from tuning.evaluation.tuned import check_keepable, write_tuned
from tuning.likelihood.gradient import DIFFERENTIABLE, maximise_likelihood
from tuning.likelihood.identifiability import identify
from tuning.problems.problem import Problem
from tuning.search.filter_types import kinds_running
from tuning.search.objectives import OBJECTIVES
from tuning.search.outcome import best_trial
from tuning.search.plan import Plan
from tuning.search.samplers import SAMPLERS
from tuning.search.storage import open_storage
from tuning.search.study import OnTrial, finished_trials, open_study, quiet_optuna, run_study, run_trials
from tuning.search.workers import run_in_workers

DEFAULT_STORAGE = "out/studies.journal"
MOST_TRIALS = 1_000_000
MOST_WORKERS = 1000
METHODS = ("optuna", "gradient")
NONE_CONSISTENT = 3  # exit code
TUNED_FILTER_HELP = f"{FILTER_HELP} Or auto: the best of all within --budget."


def command(
    filter_name: Annotated[str, filter_option(TUNED_FILTER_HELP)] = "enkf",
    scenario: Annotated[
        list[str] | None,
        typer.Option("--problem", "--scenario", help=f"{PROBLEMS} Several are averaged.", rich_help_panel=INPUT),
    ] = None,
    trials: Annotated[
        int, typer.Option(help="Finished trials that the study shall have in total.", rich_help_panel=SEARCH)
    ] = 50,
    objective: Annotated[
        list[str] | None,
        typer.Option(
            help=f"What to minimise: {', '.join(OBJECTIVES)}, output:SYMBOL; two for a Pareto front.",
            rich_help_panel=SEARCH,
        ),
    ] = None,
    any_nis: Annotated[
        bool,
        typer.Option(
            "--no-consistency",
            help="Do not hold the mean NIS between 0.8 and 1.25 of what is right.",
            rich_help_panel=SEARCH,
        ),
    ] = False,
    hold_r: Annotated[
        bool, typer.Option("--hold-r", help="Leave R at the sensor's sheet, tune Q alone.", rich_help_panel=SEARCH)
    ] = False,
    full_q: Annotated[
        bool, typer.Option("--full-q", help="Tune the correlations of Q, too.", rich_help_panel=SEARCH)
    ] = False,
    budget: Annotated[
        float | None,
        typer.Option(
            metavar="MICROSECONDS",
            help="What a step of the filter may cost, in time of one core.",
            rich_help_panel=FILTER,
        ),
    ] = None,
    sampler: Annotated[
        str, typer.Option(help=", ".join(SAMPLERS), callback=spelt(SAMPLERS), rich_help_panel=SEARCH)
    ] = "tpe",
    no_pruning: Annotated[
        bool,
        typer.Option(
            "--no-pruning",
            help="Do not end a trial that is significantly worse than the best on the same seeds.",
            rich_help_panel=SEARCH,
        ),
    ] = False,
    method: Annotated[
        str,
        typer.Option(
            help="optuna, or gradient: maximum likelihood, for kf and ekf; optuna runs for comparison.",
            rich_help_panel=SEARCH,
        ),
    ] = "optuna",
    workers: Annotated[
        int, typer.Option(help="Processes on this host that share the study.", rich_help_panel=RUNS)
    ] = 1,
    storage: Annotated[
        str,
        typer.Option(
            help="Journal file for one host; for several, a database as docs/workers.md tells.",
            rich_help_panel=OUTPUT,
        ),
    ] = DEFAULT_STORAGE,
    log: LogOption = None,
    held_out: HeldOutOption = None,
    blocks: BlocksOption = None,
    lead: LeadOption = None,
    preset: LogPresetOption = None,
    model: ModelOption = None,
    sensor: SensorOption = None,
    column: ColumnOption = None,
    clock_offset: ClockOption = None,
    dt: DtOption = None,
    study: Annotated[
        str | None, typer.Option(help="Name of the study; by default from the above.", rich_help_panel=OUTPUT)
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Tuned file; out/STUDY.json by default.", rich_help_panel=OUTPUT)
    ] = None,
    seed: SeedOption = 0,
    json: JsonOption = None,
) -> None:
    """Find the Q, R and ensemble size that make a filter's estimate best, and prove it on held-out seeds.

    The score is the mean over states of RMSE over its bound, on 32 training seeds that every trial shares.
    The first trial is the rule of thumb: R from the sensor's sheet, Q from 1 % of each state's range. Ctrl-C
    keeps all finished trials: the same command goes on with the study. The report is on 200 seeds that no trial
    saw, against the scaled default first: the rule of thumb with one factor on its Q that makes the mean NIS on
    the training runs right.

    RMSE alone hardly tells Q and R: only their ratio matters to the estimate. So the mean NIS is held in a band
    unless --no-consistency is given, and the report says what that costs. Where no trial is in the band, the one
    with the least error is written, the report and the file say so, and the exit code is 3.

    With --log it learns from recorded runs instead, cut into blocks of which every third proves the choice. What
    is made small is the negative log-likelihood of the innovations, unless the logs hold the true states.

    Example: thruster tune --filter ekf --scenario mismatch --scenario outliers --trials 100

    Example: thruster tune --filter ekf --log run1.csv --log run2.csv --trials 100

    Example: thruster tune --filter auto --budget 2 --scenario published_noise --trials 100
    """
    one_of("method", method, METHODS)
    check_keepable(filter_name)
    of_logs = {"preset": preset, "model": model, "sensors": sensor, "columns": column}
    of_logs |= {"clock_offset": clock_offset, "dt": dt, "held_out": held_out, "blocks": blocks, "lead": lead}
    scenarios = problems_of(scenario, log, of_logs, "mismatch")
    check_targets((out,), json, read=(*(log or []), *(held_out or [])))
    objectives = tuple(objective or ["score" if scenarios[0].scale is not None else "likelihood"])
    plan = Plan(
        filter_name,
        scenarios,
        seed,
        objectives,
        consistent=not any_nis,
        sampler=sampler,
        hold_r=hold_r,
        prune=not no_pruning,
        budget=budget,
        full_q=full_q,
    )
    tuning = tune(plan, trials, storage, study, out, by_gradient=method == "gradient", workers=workers)
    emit(report(tuning), as_json(tuning), json)
    if tuning.result.interrupted:
        sys.exit(130)
    if tuning.result.consistent is False:
        sys.exit(NONE_CONSISTENT)


def tune(
    plan: Plan,
    trials: int,
    storage: str = DEFAULT_STORAGE,
    study_name: str | None = None,
    out: Path | None = None,
    *,
    by_gradient: bool = False,
    workers: int = 1,
) -> Tuning:
    """Run or resume a study with a progress bar, prove its choice and write the tuned file."""
    trials, workers = at_least("trials", trials, 1, MOST_TRIALS), at_least("workers", workers, 1, MOST_WORKERS)
    if by_gradient:
        one_of("a filter whose likelihood has a gradient", plan.filter, DIFFERENTIABLE)
        if plan.hold_r:
            raise ValueError("R must be free for --method gradient, but got --hold-r")
        if plan.full_q:
            raise ValueError("Q must be diagonal for --method gradient, but got --full-q")
        if plan.budget is not None:
            raise ValueError("--method gradient must come without a budget, but got --budget")
    name = study_name or _name(plan, by_gradient)
    if "/" in name:
        raise ValueError(f"study must be a name without slashes, but got {name!r}")
    file = out or Path("out") / f"{name}.json"
    check_target(file)
    quiet_optuna()
    announce_compilation()
    study = open_study(name, plan, open_storage(storage))
    already = finished_trials(study)
    if already:
        progress_console.print(f"study {name!r} goes on after {already} finished trials")
    with _bar(plan, trials, already) as (advance, show_kinds):
        if workers == 1:
            run = partial(run_trials, on_choice=lambda choice: show_kinds([choice.name]))
        else:
            run = partial(run_in_workers, storage=storage, workers=workers)
        result = run_study(study, plan, trials, advance, run)
    gradient = rival = None
    if by_gradient:
        with working("maximising the likelihood"):
            gradient = maximise_likelihood(plan.filter, plan.scenarios[0], plan.training_data()[0])
        rival = prove(result.choice, plan.scenarios[0], plan.seed)
        result = result._replace(choice=gradient.choice, consistent=None, nis=())
    try:
        with working("proving the choice on held-out seeds"):
            proofs = tuple(prove(result.choice, scenario, plan.seed) for scenario in plan.scenarios)
    except KeyboardInterrupt:
        progress_console.print(f"study {name!r} keeps its trials: the same command goes on with the proof")
        raise
    write_tuned(file, plan, result, proofs, name, METHODS[by_gradient])
    known = None if by_gradient else identify(result.choice, plan.scenarios, plan.training_data(), plan.space())
    return Tuning(name, plan, result, proofs, file, gradient, rival, known)


def _name(plan: Plan, by_gradient: bool) -> str:
    """A name for a study of a plan: what differs from the default is in it."""
    parts = [plan.filter, _scenarios(plan).replace(", ", "+"), f"seed{plan.seed}"]
    parts += ["+".join(plan.objectives)] * (plan.objectives != ("score",))
    parts += ["hold-r"] * plan.hold_r + ["full-q"] * plan.full_q
    parts += [] if plan.budget is None else [f"budget{plan.budget:g}"]
    parts += ["any-nis"] * (not plan.consistent) + [plan.sampler] * (plan.sampler != "tpe")
    return "-".join(parts + ["gradient"] * by_gradient)


def _scenarios(plan: Plan) -> str:
    return ", ".join(map(_short, plan.scenarios))


def _short(problem: Problem) -> str:
    """A problem's name as that of a study and of a file has it: without folders and colons."""
    name = Path(problem.name)
    return (name.stem if name.suffix == ".toml" else name.name).replace(":", "-").replace(" ", "-")


@contextmanager
def _bar(plan: Plan, total: int, done: int) -> Iterator[tuple[OnTrial, Callable[[Sequence[str]], None]]]:
    """What is called after each trial, and with the kinds of filters that are under trial."""
    title = f"tuning {{}} on {_scenarios(plan)}"
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("best {task.fields[best]}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=progress_console) as progress:
        shown = title.format(plan.filter)
        task = progress.add_task(shown, total=total, completed=min(done, total), best="-")

        def show_kinds(kinds: Sequence[str]) -> None:
            if len(plan.kinds) > 1:
                progress.update(task, description=title.format(f"{plan.filter} ({', '.join(kinds)})"))

        def advance(study, finished: int) -> None:
            trials = study.get_trials(deepcopy=False)
            best = best_trial(trials)
            progress.update(task, completed=finished, best="-" if best is None else f"{best.values[0]:.3f}")
            if running := kinds_running(trials):
                show_kinds(running)

        def show_rest(far: str) -> None:
            if progress.tasks[task].finished:  # what comes after the last trial
                progress.update(task, description=f"ensemble sizes, {far}" if far.startswith("N: ") else far)

        with listening(show_rest):
            yield advance, show_kinds
