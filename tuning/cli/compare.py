"""`thruster compare`: filters side by side on scenarios, on held-out seeds."""

from __future__ import annotations

import sys
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import typer

from filters.estimators.find import is_trained
from filters.registry import FILTERS, filter_type
from thruster_env.core.checks import at_least
from tuning.api.compare import INTERRUPTED, left_out_lines, run_comparison
from tuning.cli.options import FILTER, INPUT, RUNS, JsonOption, OfPresetOption, SeedOption, filter_option
from tuning.cli.output import announce_compilation, emit, progress_console
from tuning.cli.problems import PROBLEMS
from tuning.evaluation.compare import DEFAULT_FILTERS, KNOWS, MOST_STATES
from tuning.evaluation.tuned import read_choice, read_tuned
from tuning.problems.assumed import unknown_in
from tuning.problems.find import find_problem
from tuning.problems.plant_packages import built_in
from tuning.problems.problem import Problem
from tuning.reporting.leaderboard import as_json, report
from tuning.search.plan import HELD_OUT_SEEDS
from tuning.thruster.logs import of_preset


def command(
    files: Annotated[
        list[Path] | None,
        typer.Argument(metavar="FILE", help="Files of `thruster tune` and `thruster train-estimator`."),
    ] = None,
    filters: Annotated[
        list[str] | None,
        filter_option(
            f"{', '.join(FILTERS)}, or module:object for an estimator of another package; may be repeated. "
            f"Without a filter or a file: {', '.join(DEFAULT_FILTERS)} (pf for up to {MOST_STATES} states)."
        ),
    ] = None,
    scenarios: Annotated[
        list[str] | None,
        typer.Option("--problem", "--scenario", help=f"{PROBLEMS} May be repeated.", rich_help_panel=INPUT),
    ] = None,
    preset: OfPresetOption = None,
    seeds: Annotated[int, typer.Option(help="Number of held-out seeds.", rich_help_panel=RUNS)] = HELD_OUT_SEEDS,
    knows: Annotated[
        str | None, typer.Option(help=f"{KNOWS[0].upper()}{KNOWS[1:]}", rich_help_panel=FILTER)
    ] = None,
    trials: Annotated[
        int | None,
        typer.Option(help="Number of trials of --knows study, which it implies.", rich_help_panel=FILTER),
    ] = None,
    augment: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME[:STD[:WALK]]",
            help="Give each --filter a second row that also estimates this constant of its model, such as "
            "ambient_velocity, with prior deviation STD and a random walk of WALK per step.",
            rich_help_panel=FILTER,
        ),
    ] = None,
    ensemble_size: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[FILTER=]N",
            help="Ensemble size of all filters or of one; 30 by default, 1000 for particles. May be repeated.",
            rich_help_panel=FILTER,
        ),
    ] = None,
    seed: SeedOption = 0,
    json: JsonOption = None,
) -> None:
    """Rank filters on scenarios by errors, consistency and cost, paired with the first one on the same seeds.

    All filters see the same truth, inputs and measurements. A filter is better or worse than the first one if the
    paired 95 % interval of the ratio of their scores excludes 1; without truth, if that of the difference of their
    log-likelihoods excludes 0. Ctrl-C keeps finished rows.

    Example: thruster compare --filter ekf --filter ekf-robust --filter pf --scenario outliers --scenario ambient

    Example: thruster compare --filter ekf --augment ambient_velocity --scenario ambient
    """
    for file in files or []:
        _check_is_file(file)
    chosen = [find_problem(name) for name in scenarios or []] or [_default(files or [])]
    chosen = [of_preset(problem, preset) for problem in chosen]
    for file, problem in product(files or [], chosen):
        if not is_trained(file):
            read_choice(file, problem)  # a clear error for a file that is for another plant
    contenders = [*sorted(files or [], key=is_trained), *(filters or [])]
    sizes, unknown = dict(map(_size, ensemble_size or [])), dict(map(unknown_in, augment or []))
    announce_compilation()
    options: dict[str, Any] = {"knows": knows, "trials": trials, "unknown": unknown, "sizes": sizes}
    comparison = run_comparison(contenders or None, chosen, seed, seeds, progress_console, **options)
    boards, interrupted = list(comparison.boards), comparison.interrupted
    output = [part for board in boards for part in report(board)]
    output += left_out_lines(comparison.left_out)
    if interrupted:
        output.append(INTERRUPTED)
    data = {"seed": seed, "knows": knows, "interrupted": interrupted, "left_out": comparison.left_out}
    emit(output, {**data, **as_json(boards)}, json)
    if interrupted:
        sys.exit(130)


def _check_is_file(file: Path) -> None:
    """Raise ValueError, with the option to use, if a name of a filter or problem stands where files do."""
    name = str(file)
    option = "--filter" if name in FILTERS else "--scenario" if name in built_in() else ""
    if not file.exists() and (option or ":" in name):
        raise ValueError(
            f"an argument of compare must be a tuned file, but got {name}: use {option or '--problem'} {name}"
        )


def _default(files: list[Path]) -> Problem:
    """The default problem: that of the first file, or nominal."""
    tuned = [file for file in files if not is_trained(file)]
    return read_tuned(tuned[0])[1] if tuned else find_problem("nominal")


def _size(text: str) -> tuple[str | None, int]:
    name, equals, number = text.rpartition("=")
    if equals:
        if not filter_type(name).has_ensemble:
            raise ValueError(f"--ensemble-size must be for a filter with an ensemble, but got {text!r}")
        return name, at_least("--ensemble-size", number, 2)
    return None, at_least("--ensemble-size", number, 2)
