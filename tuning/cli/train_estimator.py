"""`thruster train-estimator`: train an estimator with a network, and compare it on held-out runs."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.console import RenderableType

from tuning.api.train_estimator import DEFAULT, FOLDER, train_estimator
from tuning.api.train_estimator import RUNS as TRAINING_RUNS
from tuning.cli.options import FILTER, INPUT, LEARNING, OUTPUT, RUNS, JsonOption, OfPresetOption, SeedOption
from tuning.cli.output import announce_compilation, check_targets, emit
from tuning.cli.problems import PROBLEMS
from tuning.search.plan import HELD_OUT_SEEDS

PAGE = ".html"  # the end of a page's name


def command(
    kind: Annotated[
        str,
        typer.Argument(
            help="kalmannet (a learned gain), recursive-kalmannet (the same with a covariance), gru (a network "
            "without a model) or differentiable-enkf (an ensemble with learned noise)."
        ),
    ] = "kalmannet",
    problem: Annotated[str, typer.Option(help=PROBLEMS, rich_help_panel=INPUT)] = "nominal",
    preset: OfPresetOption = None,
    runs: Annotated[int, typer.Option(help="Number of training runs.", rich_help_panel=LEARNING)] = TRAINING_RUNS,
    steps: Annotated[int, typer.Option(help="Updates of the weights.", rich_help_panel=LEARNING)] = DEFAULT.steps,
    batch: Annotated[int, typer.Option(help="Runs in each update.", rich_help_panel=LEARNING)] = DEFAULT.batch,
    window: Annotated[
        int, typer.Option(help="Steps of a run over which gradients go back.", rich_help_panel=LEARNING)
    ] = DEFAULT.window,
    rate: Annotated[
        float, typer.Option(help="Adam's step size at first.", rich_help_panel=LEARNING)
    ] = DEFAULT.rate,
    width: Annotated[
        int | None,
        typer.Option(
            help="Hidden states of a gru (64), or of each network of a differentiable-enkf (32).",
            rich_help_panel=LEARNING,
        ),
    ] = None,
    ensemble_size: Annotated[
        int | None,
        typer.Option(help="Members of a differentiable-enkf; 30 by default.", rich_help_panel=LEARNING),
    ] = None,
    start: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Continue from the weights of this file.", rich_help_panel=LEARNING),
    ] = None,
    against: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILE",
            help="Also compare with this tuned file of `thruster tune`; may be repeated.",
            rich_help_panel=FILTER,
        ),
    ] = None,
    seeds: Annotated[int, typer.Option(help="Number of held-out seeds.", rich_help_panel=RUNS)] = HELD_OUT_SEEDS,
    seed: SeedOption = 0,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help=f"The trained estimator, ending in .safetensors; by default in {FOLDER}.",
            rich_help_panel=OUTPUT,
        ),
    ] = None,
    report: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Also write a page on it, ending in .html.", rich_help_panel=OUTPUT),
    ] = None,
    json: JsonOption = None,
) -> None:
    """Train an estimator with a network on a problem's runs, and compare it with filters on held-out ones.

    Training needs true states. It begins with the mean gain of the extended Kalman filter of the best baseline,
    and keeps the weights that are best on validation runs; Ctrl-C keeps the best so far. The table shows the score
    over that filter's, also on runs twice as long and on runs with four times the R, which no training saw.

    The file is an estimator wherever a filter is one: `--filter FILE`, `thruster compare FILE`, `EstimateState`.

    Needs the extra learned: pip install '.[learned]' in the project's folder.

    Example: thruster train-estimator recursive-kalmannet --problem outliers --steps 500
    """
    if report is not None and report.suffix != PAGE:
        raise ValueError(f"--report must end in {PAGE}, but got {report}")
    check_targets([report, out], json, [start, *(against or [])])
    options = {"width": width, "ensemble_size": ensemble_size}
    announce_compilation()
    training = train_estimator(
        kind,
        problem,
        runs=runs,
        steps=steps,
        batch=batch,
        window=window,
        rate=rate,
        options={name: value for name, value in options.items() if value is not None},
        start=start,
        against=against or (),
        seeds=seeds,
        seed=seed,
        file=out,
        preset=preset,
    )
    seconds = f"{training.seconds:.0f} s for {training.checks[-1].step} updates."
    output: list[RenderableType] = [
        training.table(),
        *training.sentences(),
        seconds,
        f"Trained estimator: {training.file}",
    ]
    output.append(f"Use it: thruster compare {training.file} --filter ekf --problem {training.problem.name}")
    if report is not None:
        output.append(f"Page: {training.report(report)}")
    emit(output, training.as_data(), json)
    if training.interrupted:
        sys.exit(130)
