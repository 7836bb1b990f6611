"""Tables of a report: metrics of filters on held-out seeds, and their parameters."""

from __future__ import annotations

from math import isnan

import numpy as np

from filters.consistency.intervals import Interval
from filters.consistency.report import rounded
from tuning.evaluation.baselines import TUNED, Scaled, baseline_size, baselines
from tuning.evaluation.evaluate import NOTHING
from tuning.evaluation.held_out import Comparison
from tuning.likelihood.identifiability import Identifiability
from tuning.problems.problem import Problem
from tuning.reporting.choice_words import number_rows, power_of_ten, scaled_unit
from tuning.reporting.page import Table
from tuning.search.space import Choice

MOST_ACROSS = 3  # errors of states and outputs side by side; more stand one below the other
RATIO = "score of tuned over this"


def errors_table(scenario: Problem, comparison: Comparison) -> Table:
    """Metrics of a tuned filter and its baselines on held-out seeds, and the bound.

    A row is a filter; of more states than fit side by side, and of derived outputs then, a row is a state and a
    column a filter. Without truth the metrics are those of the innovations.
    """
    seeds = f"{scenario.seed_word} {comparison.seeds.start} to {comparison.seeds.stop - 1}"
    where = f"{scenario.name}, held-out {seeds}, with 95 % intervals"
    if not comparison.tuned.has_truth:
        return _innovations_table(comparison, where)
    count = len(comparison.bound) + len(comparison.tuned.outputs)
    return _errors_across(comparison, where) if count <= MOST_ACROSS else _errors_below(comparison, where)


def _errors_across(comparison: Comparison, where: str) -> Table:
    ratios, tuned, errors = comparison.ratios, comparison.tuned, _errors(comparison)
    rows = [
        [name, _span(ratios.get(name, NOTHING)), _span(evaluation.score)]
        + [*(cells[column] for _, cells, _ in errors), *map(_span, (evaluation.nees, evaluation.nis))]
        for column, (name, evaluation) in enumerate(comparison.evaluations.items())
    ]
    right = [str(len(comparison.bound)), f"{tuned.expected_nis:.3g}"] if not isnan(tuned.nis.value) else ["", ""]
    rows.append([_expected(comparison), "", "", *(bound for *_, bound in errors), *right])
    columns = ["filter", RATIO, "score", *(label for label, *_ in errors), "mean NEES", "mean NIS"]
    return Table(where, columns, rows)


def _errors_below(comparison: Comparison, where: str) -> Table:
    ratios, evaluations, tuned = comparison.ratios, comparison.evaluations, comparison.tuned
    right = [str(len(comparison.bound)), f"{tuned.expected_nis:.3g}"] if not isnan(tuned.nis.value) else ["", ""]
    rows = [
        [RATIO, *(_span(ratios.get(name, NOTHING)) for name in evaluations), ""],
        ["score", *(_span(e.score) for e in evaluations.values()), ""],
        *([label, *cells, bound] for label, cells, bound in _errors(comparison)),
        ["mean NEES", *(_span(e.nees) for e in evaluations.values()), right[0]],
        ["mean NIS", *(_span(e.nis) for e in evaluations.values()), right[1]],
    ]
    return Table(where, ["", *evaluations, _expected(comparison)], rows)


def _errors(comparison: Comparison) -> list[tuple[str, list[str], str]]:
    """RMSE of each state and output: label, a cell per filter, and the bound, all with one power of ten."""
    evaluations, rows = comparison.evaluations.values(), []
    parts = [
        (state.text_symbol, state.unit, [e.rmse[i] for e in evaluations], float(comparison.bound[i]))
        for i, state in enumerate(comparison.tuned.states)
    ]
    parts += [
        (output.name, output.unit, [e.output_rmse.get(symbol, NOTHING) for e in evaluations], float("nan"))
        for symbol, output in comparison.tuned.outputs.items()
    ]
    for name, unit, values, bound in parts:
        power = power_of_ten([value.value for value in values])
        cells = [_span(Interval(*(part / 10.0**power for part in value))) for value in values]
        label = scaled_unit(unit, power)
        limit = "" if isnan(bound) else rounded(bound / 10.0**power)
        rows.append((f"RMSE {name} [{label}]" if label else f"RMSE {name}", cells, limit))
    return rows


def _expected(comparison: Comparison) -> str:
    """The label of the row beside the metrics."""
    return "expected" if np.isnan(comparison.bound).all() else "bound; expected"


def _innovations_table(comparison: Comparison, where: str) -> Table:
    gains = comparison.likelihood_gains
    rows = [
        [name, "" if isnan(e.log_likelihood) else f"{e.log_likelihood:.2f}", _span(e.nis)]
        + [_span(gains.get(name, NOTHING)), str(e.divergences)]
        for name, e in comparison.evaluations.items()
    ]
    right = "" if isnan(comparison.tuned.nis.value) else f"{comparison.tuned.expected_nis:.3g}"
    rows.append(["expected", "", right, "", ""])
    columns = ["filter", "log-likelihood of a run", "mean NIS", "tuned less this", "restarts"]
    return Table(where, columns, rows)


def numbers_table(choice: Choice, scenario: Problem, seed: int, default: Scaled | None = None) -> Table:
    """The parameters of a tuned filter and of its baselines; the scaled default is computed unless given."""
    reference = baselines(choice.name, scenario, seed, default, baseline_size(choice))
    choices, usual = {TUNED: choice, **reference}, next(iter(reference.values())).numbers
    complete = [each._replace(numbers={**usual, **each.numbers}) for each in choices.values()]
    rows = number_rows(complete, choice.name, scenario, _number, "²")
    return Table(
        f"Parameters of the {choice.name} filter",
        ["", *choices],
        rows,
    )


def _number(value: float | None) -> str:
    """A parameter of a filter; empty if a choice lacks it."""
    return "" if value is None else f"{value:.4g}"


def known_table(result: Identifiability) -> Table:
    """The parameters as the innovations determine them."""
    identified = result.identified & (not result.tails)
    columns = result.names, result.tuned, result.most_likely, result.factors, identified
    rows = [
        [name, f"{tuned:.4g}", f"{best:.4g}", f"{factor:.3g}" if known else "", "yes" if known else "no"]
        for name, tuned, best, factor, known in zip(*columns, strict=True)
    ]
    if result.tails:
        rows = [row[:3] for row in rows]
        return Table("Parameters by maximum likelihood", ["", "tuned", "maximum likelihood"], rows)
    header = ["", "tuned", "maximum likelihood", "known within a factor of", "determined"]
    return Table(
        "Parameters determined by the innovations of the training runs, with 95 % probability", header, rows
    )


def _span(value: Interval) -> str:
    """A value with its 95 % interval in brackets; empty if there is no value."""
    middle, low, high = (f"{part:#.4g}".rstrip(".") for part in value)
    return "" if isnan(value.value) else f"{middle} [{low}, {high}]"
