"""`thruster evaluate`: a filter, tuned or not, on a scenario."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import RenderableType

from filters.consistency.intervals import rmse_ratios
from filters.consistency.nees import SquaresCheck
from filters.consistency.report import MOST_STATES, ConsistencyReport, comparison_sentence, sentences
from filters.filter import Filter
from filters.registry import filter_type
from thruster_env.core.files import check_target
from tuning.api.evaluate import subject_of
from tuning.api.held_out import on_held_out
from tuning.api.study import DEFAULT_FILTER
from tuning.cli.options import (
    FILTER,
    FILTER_HELP,
    INPUT,
    OUTPUT,
    RUNS,
    JsonOption,
    LogModelOption,
    OfPresetOption,
    SeedOption,
    filter_option,
    one_file,
)
from tuning.cli.output import announce_compilation, check_picture, emit, progress_console, working
from tuning.cli.problems import PROBLEMS
from tuning.cli.tables import choice_table
from tuning.evaluation.baselines import GIVEN, ORACLE, TUNED, given_noise
from tuning.evaluation.evaluate import check_consistency
from tuning.evaluation.held_out import Comparison
from tuning.problems.problem import Problem
from tuning.reporting.leaderboard import comparison_table
from tuning.reporting.search_figures import consistency_figure
from tuning.search.plan import HELD_OUT_SEEDS
from tuning.search.space import Choice

# Whether a filter's covariance is consistent: the output of `thruster evaluate --consistency`.


def check_request(path: Path, filter_: Filter) -> None:
    """Raise ValueError if a filter has no covariance to check, or its picture cannot be written."""
    check_picture(path, "--consistency")
    if not filter_.has_covariance:
        raise ValueError(f"--consistency must be for a filter with a covariance, but got {filter_.name!r}")
    check_target(path)


def check_covariance(
    choice: Choice, name: str, scenario: Problem, comparison: Comparison, path: Path
) -> tuple[list[str], dict]:
    """Draw the checks of a choice, called `name`; return the text to print and the numbers behind it."""
    report = check_consistency(choice.filter(scenario), scenario.data(comparison.seeds), scenario.dt)
    messages, against, ratios = sentences(report), {}, None
    if report.has_truth and comparison.true is not None:
        ratios = rmse_ratios(comparison.tuned.mean_squares, comparison.true.mean_squares, comparison.tuned.weights)
        against[f"{name}\nover {ORACLE}"] = ratios
        named = list(zip(report.states, ratios, strict=True))
        messages += [comparison_sentence(state, name, ORACLE, ratio) for state, ratio in named[:MOST_STATES]]
        if len(named) > MOST_STATES:
            messages.append(f"Of {len(named)} states these are the first {MOST_STATES}.")
    title = f"{choice.name}, {name}, on {report.runs} seeds of {scenario.name}"
    consistency_figure(path, report, title, against, comparison.tuned.scored or None)
    data = {**as_data(report), "rmse_over_true": ratios, "sentences": messages, "picture": str(path)}
    return [f"Is the {name} filter consistent?", *messages, f"Picture: {path}"], data


def as_data(report: ConsistencyReport) -> dict:
    """The numbers of a report, by name."""
    white, ensemble = report.whiteness, report.ensemble
    members = None
    if ensemble is not None:
        ranks = [{"frequencies": rank.frequencies, "p_value": rank.p_value} for rank in ensemble.ranks]
        members = {"size": ensemble.size, "ranks": ranks, "crps": ensemble.crps}
    return {
        "states": report.states,
        "nees": _of_squares(report.nees),
        "nis": _of_squares(report.nis),
        "innovations": {
            "correlations": white.correlations,
            "statistic": white.statistic,
            "p_value": white.p_value,
        },
        "coverage_95": report.coverage,
        "crps": report.crps,
        "crps_if_honest": report.crps_expected,
        "members": members,
        "channels": report.channels,
        "innovation_coverage_95": report.innovation_coverage,
        "divergences": report.divergences,
    }


def _of_squares(check: SquaresCheck) -> dict:
    return {
        "mean": check.mean,
        "right": check.dimension,
        "share_of_steps_in_95_band": check.share_inside,
        "share_beyond_95_point": check.beyond,
        "distance_from_chi_square": check.distribution.distance,
        "p_value": check.distribution.p_value,
    }


def command(
    file: Annotated[
        Path | None,
        typer.Argument(metavar="FILE", help="Tuned file; it names filter, parameters and scenario."),
    ] = None,
    tuned: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The same as the argument.", rich_help_panel=FILTER)
    ] = None,
    filter_name: Annotated[str | None, filter_option(f"Without a tuned file. {FILTER_HELP}")] = None,
    own: Annotated[
        bool,
        typer.Option(
            "--given",
            help="Use the Q and R of the problem's model instead of the rule of thumb.",
            rich_help_panel=FILTER,
        ),
    ] = False,
    scenario: Annotated[
        str | None,
        typer.Option(
            "--problem",
            "--scenario",
            help=f"By default the tuned file's, or nominal. {PROBLEMS}",
            rich_help_panel=INPUT,
        ),
    ] = None,
    preset: OfPresetOption = None,
    seeds: Annotated[int, typer.Option(help="Number of held-out seeds.", rich_help_panel=RUNS)] = HELD_OUT_SEEDS,
    consistency: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Also check whether the filter's covariance is consistent, and draw it: .png, .svg or .pdf.",
            rich_help_panel=OUTPUT,
        ),
    ] = None,
    model: LogModelOption = None,
    seed: SeedOption = 0,
    json: JsonOption = None,
) -> None:
    """Run a filter on held-out seeds of a scenario and compare it with its baselines.

    The rule of thumb takes R from the sensor's data sheet and Q from 1 % of each state's range. The scaled default
    is the same with one factor on Q that brings the mean NIS (normalised innovation squared) to 1. The oracle has
    the plant's own Q and R.

    --given evaluates the model's own Q and R, in an ekf unless --filter names another filter.

    --consistency compares a filter's errors and innovations with its covariances: NEES, NIS,
    whiteness, coverage, CRPS and, for ensembles, rank histograms, with a sentence on each and one picture.

    Example: thruster evaluate out/enkf-mismatch-seed0.json

    Example: thruster evaluate --filter enkf --scenario mismatch --consistency calibrated.png
    """
    tuned = one_file(file, tuned)
    if own and tuned is not None:
        raise ValueError(f"--given must come without a tuned file, but got both, with {tuned}")
    filter_name = filter_name or (DEFAULT_FILTER if own else None)
    if (tuned is None) == (filter_name is None):
        got = "none" if tuned is None else f"both, {tuned} and {filter_name}"
        raise ValueError(f"give either a tuned file or --filter NAME, but got {got}")
    choice, chosen, _ = subject_of(tuned or filter_name, scenario, preset, model)
    if own:
        choice = _given(choice.name, chosen)
    if consistency is not None:
        check_request(consistency, choice.filter(chosen))
    announce_compilation()
    evaluation = on_held_out(choice, chosen, seed, seeds, is_tuned=tuned is not None, console=progress_console)
    comparison, data = evaluation.comparison, evaluation.to_dict()
    seeds_used = f"{chosen.seed_word} {comparison.seeds.start} to {comparison.seeds.stop - 1}"
    where = f"held-out {seeds_used}, scenario {chosen.name}"
    output: list[RenderableType] = [choice_table(evaluation.choices, chosen)]
    output.append(comparison_table(evaluation.evaluations, comparison.bound, where, chosen.scale_about))
    output += evaluation.sentences()
    if consistency is not None:
        name = TUNED if tuned is not None else GIVEN if own else comparison.rule
        with working("checking the covariance"):
            words, data["consistency"] = check_covariance(choice, name, chosen, comparison, consistency)
        output += words
    emit(output, data, json)


def _given(name: str, problem: Problem) -> Choice:
    """The filter with the given Q and R of the problem's model; ValueError if there are none."""
    if not filter_type(name).has_covariance:
        raise ValueError(f"--given must be used with a filter that has a Q and R, but got {name}")
    choice = given_noise(name, problem)
    if choice is None:
        raise ValueError(
            f"--given must be used with a problem whose model has a given Q and R, but got {problem.name}"
        )
    return choice
