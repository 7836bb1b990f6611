"""`thruster tune`: an Optuna study of a filter's noise covariances and ensemble size, with held-out evaluation."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from tuning.api.run import Tuning, aim_of, name_of, run_tuning, sampler_of, with_budget
from tuning.cli.options import (
    FILTER,
    FILTER_HELP,
    INPUT,
    OUTPUT,
    RUNS,
    SEARCH,
    BlockOptions,
    GridOptions,
    JsonOption,
    SeedOption,
    filter_option,
    problems_of,
    spelt,
    with_groups,
)
from tuning.cli.output import announce_compilation, check_targets, emit, progress_console
from tuning.cli.problems import PROBLEMS
from tuning.cli.tuning_report import as_json, report
from tuning.evaluation.tuned import check_keepable
from tuning.methods.registry import DEFAULT, METHODS
from tuning.problems.assumed import augmented, unknowns_of
from tuning.search.objectives import LIKELIHOOD, OBJECTIVES
from tuning.search.plan import Plan

DEFAULT_STORAGE = "out/studies.journal"
NONE_CONSISTENT = 3  # exit code
TUNED_FILTER_HELP = f"{FILTER_HELP} Or auto: the best of all within --budget."


@with_groups
def command(
    filter_name: Annotated[str, filter_option(TUNED_FILTER_HELP)] = "enkf",
    scenario: Annotated[
        list[str] | None,
        typer.Option(
            "--problem", "--scenario", help=f"{PROBLEMS} Several: their mean, or --worst.", rich_help_panel=INPUT
        ),
    ] = None,
    trials: Annotated[
        int, typer.Option(help="Total number of finished trials of the study.", rich_help_panel=SEARCH)
    ] = 50,
    objective: Annotated[
        list[str] | None,
        typer.Option(
            help=f"What to minimise: {', '.join(OBJECTIVES)}, output:SYMBOL; two for a Pareto front.",
            rich_help_panel=SEARCH,
        ),
    ] = None,
    worst: Annotated[
        bool,
        typer.Option(
            "--worst", help="Minimise the worst of several problems instead of their mean.", rich_help_panel=SEARCH
        ),
    ] = False,
    any_nis: Annotated[
        bool,
        typer.Option(
            "--no-consistency",
            help="Do not keep the mean NIS between 0.8 and 1.25 of its expected value.",
            rich_help_panel=SEARCH,
        ),
    ] = False,
    hold_r: Annotated[
        bool,
        typer.Option("--hold-r", help="Keep R from the sensor's data sheet, tune only Q.", rich_help_panel=SEARCH),
    ] = False,
    full_q: Annotated[
        bool, typer.Option("--full-q", help="Tune the correlations of Q, too.", rich_help_panel=SEARCH)
    ] = False,
    full_r: Annotated[
        bool, typer.Option("--full-r", help="Tune the correlations of R, too.", rich_help_panel=SEARCH)
    ] = False,
    where: Annotated[
        list[str] | None,
        typer.Option(
            metavar="RELATION",
            help="A relation that parameters must obey: 'Q22 = 4 Q11', 'Q33 = Q11', 'R = 0.01' (not tuned), "
            "'Q11 = 1e-6..1e-2' (its range). May be repeated.",
            rich_help_panel=SEARCH,
        ),
    ] = None,
    forget: Annotated[
        float | None,
        typer.Option(
            metavar="SECONDS",
            help="Longest time constant of the filter's gain that is allowed: a smaller Q is raised to it.",
            rich_help_panel=SEARCH,
        ),
    ] = None,
    augment: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME[:STD[:WALK]]",
            help="Let the filter also estimate this constant of its model, such as voltage_gain, with prior "
            "deviation STD; its random walk, at first WALK per step, is tuned with Q. Give it again for more.",
            rich_help_panel=FILTER,
        ),
    ] = None,
    budget: Annotated[
        float | None,
        typer.Option(
            metavar="MICROSECONDS",
            help="Time limit of a step of the filter on one core; of auto by default 2.5 n^2 for n states.",
            rich_help_panel=FILTER,
        ),
    ] = None,
    no_pruning: Annotated[
        bool,
        typer.Option(
            "--no-pruning",
            help="Also finish trials that are significantly worse than the best on the same seeds.",
            rich_help_panel=SEARCH,
        ),
    ] = False,
    method: Annotated[
        str,
        typer.Option(
            help="A study by a sampler (tpe, gp, cma-es, nsga-ii, random, grid), gradient for Kalman filters, or "
            "a published method; `thruster methods` lists them and when to use which.",
            callback=spelt(METHODS),
            rich_help_panel=SEARCH,
        ),
    ] = DEFAULT,
    workers: Annotated[
        int, typer.Option(help="Processes on this host that share the study.", rich_help_panel=RUNS)
    ] = 1,
    storage: Annotated[
        str,
        typer.Option(
            help="Journal file for one host; for several, a database (docs/workers.md).",
            rich_help_panel=OUTPUT,
        ),
    ] = DEFAULT_STORAGE,
    *,
    logs: BlockOptions,
    reading: GridOptions,
    study: Annotated[
        str | None,
        typer.Option(help="Name of the study; by default from the options above.", rich_help_panel=OUTPUT),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Tuned file; out/STUDY.json by default.", rich_help_panel=OUTPUT)
    ] = None,
    seed: SeedOption = 0,
    json: JsonOption = None,
) -> None:
    """Find the Q, R and ensemble size that give a filter's best estimate, and evaluate it on held-out seeds.

    The score is the mean over states of RMSE over its scale, on 32 training seeds that every trial shares. The
    first trial is the rule of thumb: R from the sensor's data sheet, Q from 1 % of each state's range. Ctrl-C
    keeps all finished trials, and the same command continues the study. The report compares the filter with its
    baselines, first with your model's own Q and R, on 200 seeds that no trial saw.

    Q's variances and R are searched from 1e-10 to 1e4 times the rule of thumb, on logarithmic scales, beginning
    from 1e-5 to 1e2 (R: 1e-2 to 1e3) and ten times beyond the best trial; given values lie inside, and the report
    flags a parameter at an end of its range. Besides sampled trials the study tries the baselines (given, rule of
    thumb, scaled default, noise estimation) and the maximum-likelihood values. At the end the best trials are
    compared with the baselines on 100 validation seeds. If none is significantly better, the best baseline is
    chosen, and the report names the runs in which what was given fails.

    RMSE alone barely determines Q and R: only their ratio affects the estimate. The study therefore keeps the mean
    NIS in a band, unless --no-consistency is given, as long as that costs at most 5 % of the score. With true
    states it chooses the trial with the best log score among those within 5 % of the least error. If no trial is
    in the band, the report and the file say so, and the exit code is 3.

    --method also selects another sampler, gradients, or a published method, which runs alone: samplers end after
    --trials trials, the others by their own criterion. With a right model and true states use noise-estimation.
    With true states use log-score if the covariance matters, mse if only the estimate does. Without true states
    use likelihood, or als for a linear model on long runs, which accepts --full-q and --full-r. For an ensemble
    use the default, or desroziers without true states. With true states and a wrong model, or a dead band, add
    --full-q (and --full-r) to mse or log-score. `thruster methods` lists all methods.

    With --log the study uses recorded runs, cut into blocks of which every third is held out. It minimises the
    negative log-likelihood of the innovations, unless the logs contain the true states.

    Example: thruster tune --filter ekf --scenario mismatch --scenario outliers --trials 100

    Example: thruster tune --filter ekf --log run1.csv --log run2.csv --trials 100

    Example: thruster tune --filter ekf --method log-score --scenario mismatch

    Example: thruster tune --filter auto --budget 2 --scenario published_noise --trials 100

    Example: thruster tune --filter ekf --augment voltage_gain --scenario mismatch
    """
    sampler = sampler_of(method)
    check_keepable(filter_name)
    unknown = unknowns_of(augment or ())
    scenarios = tuple(augmented(problem, unknown) for problem in problems_of(scenario, logs, reading, "mismatch"))
    check_targets(
        (out,), json, read=(*(logs.log or []), *(logs.held_out or []), *(scenario or []), reading.preset)
    )
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
        full_r=full_r,
        where=tuple(where or ()),
        worst=worst,
        forget=forget,
    )
    plan = with_budget(plan)
    tuning = tune(plan, trials, storage, study, out, method=method, aim=aim_of(objective), workers=workers)
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
    method: str = DEFAULT,
    aim: str = LIKELIHOOD,
    workers: int = 1,
) -> Tuning:
    """Run or resume a study with a progress bar, evaluate its choice and write the tuned file."""
    name = study_name or name_of(plan, method, aim)
    file = out or Path("out") / f"{name}.json"
    announce_compilation()
    options: dict[str, Any] = {"method": method, "aim": aim, "workers": workers}
    return run_tuning(plan, trials, progress_console, storage, name, file, **options)
