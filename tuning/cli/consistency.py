"""Whether a filter's covariance is consistent: the output of `thruster evaluate --consistency`."""

from __future__ import annotations

from pathlib import Path

from filters.consistency.intervals import rmse_ratios
from filters.consistency.nees import SquaresCheck
from filters.consistency.report import ConsistencyReport
from filters.consistency.verdicts import MOST_STATES, comparison_sentence, sentences
from filters.filter import Filter
from thruster_env.core.files import check_target
from tuning.cli.output import check_picture
from tuning.evaluation.baselines import ORACLE
from tuning.evaluation.evaluate import check_consistency
from tuning.evaluation.held_out import Comparison
from tuning.problems.problem import Problem
from tuning.reporting.consistency_figures import consistency_figure
from tuning.search.space import Choice


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
    said, against, ratios = sentences(report), {}, None
    if report.has_truth and comparison.true is not None:
        ratios = rmse_ratios(comparison.tuned.mean_squares, comparison.true.mean_squares, comparison.tuned.weights)
        against[f"{name}\nover {ORACLE}"] = ratios
        named = list(zip(report.states, ratios, strict=True))
        said += [comparison_sentence(state, name, ORACLE, ratio) for state, ratio in named[:MOST_STATES]]
        if len(named) > MOST_STATES:
            said.append(f"Of {len(named)} states these are the first {MOST_STATES}.")
    title = f"{choice.name}, {name}, on {report.runs} seeds of {scenario.name}"
    consistency_figure(path, report, title, against, comparison.tuned.scored or None)
    data = {**as_data(report), "rmse_over_true": ratios, "sentences": said, "picture": str(path)}
    return [f"Is the {name} filter consistent?", *said, f"Picture: {path}"], data


def as_data(report: ConsistencyReport) -> dict:
    """The numbers of a report, by name."""
    white, ensemble = report.whiteness, report.ensemble
    members = None
    if ensemble is not None:
        ranks = [{"frequencies": found.frequencies, "p_value": found.p_value} for found in ensemble.ranks]
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
