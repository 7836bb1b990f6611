"""Tables of a report: what filters achieve on held-out seeds, and their numbers."""

from __future__ import annotations

from math import isnan

from filters.consistency.intervals import Interval
from filters.consistency.verdicts import rounded
from plants.quantities import Quantity
from tuning.evaluation.baselines import RULE, TUNED, Scaled, baselines, rule_label
from tuning.evaluation.evaluate import NOTHING
from tuning.evaluation.held_out import Comparison
from tuning.likelihood.identifiability import Identifiability
from tuning.problems.problem import Problem
from tuning.reporting.page import Table
from tuning.reporting.units import number_rows
from tuning.search.space import Choice

MOST_ACROSS = 3  # states side by side; more stand one below the other
EXPECTED = "bound; expected value"  # what stands beside the metrics


def errors_table(scenario: Problem, proof: Comparison) -> Table:
    """Metrics of a tuned filter and its baselines on held-out seeds, and the bound.

    A row is a filter; of more states than fit side by side, and of derived outputs then, a row is a state and a
    column a filter. Without truth the metrics are those of the innovations.
    """
    seeds = f"{scenario.seed_word} {proof.seeds.start} to {proof.seeds.stop - 1}"
    where = f"{scenario.name}, held-out {seeds}, with 95 % intervals"
    if not proof.tuned.has_truth:
        return _innovations_table(proof, where)
    return _errors_across(proof, where) if len(proof.bound) <= MOST_ACROSS else _errors_below(proof, where)


def _errors_across(proof: Comparison, where: str) -> Table:
    ratios, outputs = proof.ratios, proof.tuned.outputs
    rows = [
        [
            proof.label(name),
            *map(_span, e.rmse),
            *(_span(e.output_rmse.get(symbol, NOTHING)) for symbol in outputs),
        ]
        + [*map(_span, (e.score, e.nees, e.nis)), _span(ratios[name]) if name in ratios else ""]
        for name, e in proof.evaluations.items()
    ]
    right = [str(len(proof.bound)), f"{proof.tuned.expected_nis:.3g}"] if rows[0][-2] else ["", ""]
    bound = ["" if isnan(part) else rounded(part) for part in proof.bound]
    rows.append([EXPECTED, *bound, *("" for _ in outputs), "", *right, ""])
    columns = ["filter", *map(_state_label, proof.tuned.states), *map(_output_label, outputs.values())]
    return Table(where, [*columns, "score", "mean NEES", "mean NIS", "score of tuned over this"], rows)


def _errors_below(proof: Comparison, where: str) -> Table:
    ratios, found, tuned = proof.ratios, proof.evaluations, proof.tuned
    bound = ["" if isnan(part) else rounded(part) for part in proof.bound]
    rows = [
        [_state_label(state), *(_span(e.rmse[i]) for e in found.values()), bound[i]]
        for i, state in enumerate(tuned.states)
    ]
    rows += [
        [_output_label(output), *(_span(e.output_rmse.get(symbol, NOTHING)) for e in found.values()), ""]
        for symbol, output in tuned.outputs.items()
    ]
    right = [str(len(proof.bound)), f"{tuned.expected_nis:.3g}"] if not isnan(tuned.nis.value) else ["", ""]
    rows.append(["score", *(_span(e.score) for e in found.values()), ""])
    rows.append(["mean NEES", *(_span(e.nees) for e in found.values()), right[0]])
    rows.append(["mean NIS", *(_span(e.nis) for e in found.values()), right[1]])
    rows.append(["score of tuned over this", *(_span(ratios.get(name, NOTHING)) for name in found), ""])
    return Table(where, ["", *map(proof.label, found), EXPECTED], rows)


def _innovations_table(proof: Comparison, where: str) -> Table:
    gains = proof.likelihood_gains
    rows = [
        [proof.label(name), "" if isnan(e.log_likelihood) else f"{e.log_likelihood:.2f}", _span(e.nis)]
        + [_span(gains.get(name, NOTHING)), str(e.divergences)]
        for name, e in proof.evaluations.items()
    ]
    right = "" if isnan(proof.tuned.nis.value) else f"{proof.tuned.expected_nis:.3g}"
    rows.append(["expected value", "", right, "", ""])
    columns = ["filter", "log-likelihood of a run", "mean NIS", "that of tuned less this", "restarts"]
    return Table(where, columns, rows)


def _state_label(state: Quantity) -> str:
    return f"RMSE {state.text_symbol} [{state.unit}]" if state.unit else f"RMSE {state.text_symbol}"


def _output_label(output: Quantity) -> str:
    return f"RMSE {output.label}"


def numbers_table(choice: Choice, scenario: Problem, seed: int, default: Scaled | None = None) -> Table:
    """The numbers of a tuned filter and of its baselines; the scaled default is found unless it is given."""
    found = baselines(choice.name, scenario, seed, default)
    choices, usual = {TUNED: choice, **found}, found[RULE].numbers
    whole = [one._replace(numbers={**usual, **one.numbers}) for one in choices.values()]
    rows = number_rows(whole, choice.name, scenario, _number, "²")
    return Table(
        f"Parameters of the {choice.name} filter",
        ["", *(rule_label(scenario) if name == RULE else name for name in choices)],
        rows,
    )


def _number(value: float | None) -> str:
    """A number of a filter; empty where a choice lacks it."""
    return "" if value is None else f"{value:.4g}"


def known_table(found: Identifiability) -> Table:
    """What the innovations alone say of the numbers, and whether they determine them."""
    columns = found.names, found.tuned, found.likeliest, found.factors, found.identified
    rows = [
        [name, f"{tuned:.4g}", f"{best:.4g}", f"{factor:.3g}" if known else "", "yes" if known else "no"]
        for name, tuned, best, factor, known in zip(*columns, strict=True)
    ]
    header = ["", "tuned", "most likely", "known within a factor of", "determined"]
    return Table("What the innovations of the training runs say, with 95 % probability", header, rows)


def _span(value: Interval) -> str:
    """A value with its 95 % interval in brackets; empty if there is no value."""
    middle, low, high = (f"{part:#.4g}".rstrip(".") for part in value)
    return "" if isnan(value.value) else f"{middle} [{low}, {high}]"
