"""Tables of metrics of filters: any number of states, derived outputs and channels, with or without truth."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from math import inf, isfinite, isnan, log10

import numpy as np
from rich.table import Table

from filters.consistency.intervals import Interval
from thruster_env.core.text_tables import table
from thruster_env.model.quantities import Quantity
from tuning.evaluation.evaluate import Evaluation

ABOVE = "above\n[%]"  # head of the columns that need a bound
MOST_DECIMALS = 6  # beyond which a column has powers of ten, as 8.59e-06
MOST_COLUMNS = 5  # of errors, that fit into 80 columns with their intervals


def comparison_table(
    evaluations: Mapping[str, Evaluation], bound: np.ndarray, where: str, scale_about: str = ""
) -> Table:
    """Metrics of filters on the same seeds: RMSE, distance from the bound and consistency.

    A row is a filter. Where states are more than fit side by side, a row is a state of a filter; without truth the
    metrics are those of the innovations.

    Args:
        evaluations: by what the filters are called.
        bound: (n,), NaN where there is none.
        where: seeds and scenario, for the title.
        scale_about: the scale of the score, in words, for the caption if there is no bound.
    """
    first = next(iter(evaluations.values()))
    if not first.has_truth:
        return _innovations_table(evaluations, where)
    outputs = {symbol: output for e in evaluations.values() for symbol, output in e.outputs.items()}
    layout = _across if 2 * len(first.states) + len(outputs) <= MOST_COLUMNS else _below
    columns, rows = layout(evaluations, bound, outputs)
    has_bound = not np.isnan(bound).all()
    if has_bound:
        above = "above: the bound. "
    else:
        above = f"No bound; the score is RMSE over {scale_about}. " if scale_about else ""
        columns, rows = without(columns, rows, ABOVE)
    caption = f"{above}±: half of the 95 % interval. Ideal: NEES {len(bound)}, NIS {right_nis(first)}."
    lines = 1 if layout is _across else len(first.states) + len(outputs)
    index = lowest([evaluation.score.value for evaluation in evaluations.values()])
    best = range(index * lines, (index + 1) * lines) if index is not None else ()
    return table(f"RMSE on {where}", columns, rows, caption=caption, best=best)


def lowest(values: Sequence[float]) -> int | None:
    """Index of the lowest of several values, ignoring NaN; None if there are none to compare."""
    known = [value for value in values if not isnan(value)]
    return list(values).index(min(known)) if len(known) > 1 else None


def without(columns: Sequence[str], rows: Sequence[Sequence[str]], head: str) -> tuple[list, list]:
    """Columns and rows less the columns of one head."""
    indices = [i for i, column in enumerate(columns) if column != head]
    return [columns[i] for i in indices], [[row[i] for i in indices] for row in rows]


def _across(evaluations: Mapping[str, Evaluation], bound: np.ndarray, outputs: Mapping[str, Quantity]) -> tuple:
    """Columns and rows with all states side by side."""
    first = next(iter(evaluations.values()))
    digits, rows = decimals(first), []
    for name, evaluation in evaluations.items():
        above = [unless_blank(part, "+.0f") for part in above_bound(evaluation, bound)]
        pairs = zip(evaluation.rmse, digits, above, strict=True)
        states = [cell for rmse, count, over in pairs for cell in (about(rmse, count), over)]
        rows.append(
            [name, *states, *(_output(evaluation, symbol) for symbol in outputs), *consistency_cells(evaluation)]
        )
    limits = [cell for limit, count in zip(bound, digits, strict=True) for cell in (limit_cell(limit, count), "")]
    rows.append([expected_word(bound), *limits, *("" for _ in outputs), str(len(bound)), right_nis(first)])
    heads = [head for state in first.states for head in (two_lines(state), ABOVE)]
    return ["filter", *heads, *map(two_lines, outputs.values()), "NEES", "NIS"], rows


def _below(evaluations: Mapping[str, Evaluation], bound: np.ndarray, outputs: Mapping[str, Quantity]) -> tuple:
    """Columns and rows with a filter's states and outputs one below the other."""
    first = next(iter(evaluations.values()))
    digits, rows = decimals(first), []
    for name, evaluation in evaluations.items():
        above = [unless_blank(part, "+.0f") for part in above_bound(evaluation, bound)]
        columns = evaluation.states, evaluation.rmse, digits, above
        block = [[s.short_label, about(rmse, d), over] for s, rmse, d, over in zip(*columns, strict=True)]
        block += [[outputs[symbol].short_label, _output(evaluation, symbol), ""] for symbol in outputs]
        heads = [[name, *consistency_cells(evaluation)]] + [["", "", ""]] * (len(block) - 1)
        rows += [[head[0], *cells, *head[1:]] for head, cells in zip(heads, block, strict=True)]
    limits = [[s.short_label, limit_cell(b, d), ""] for s, b, d in zip(first.states, bound, digits, strict=True)]
    limits = limits if any(cells[1] for cells in limits) else [["", "", ""]]
    heads = [[expected_word(bound), str(len(bound)), right_nis(first)]] + [["", "", ""]] * (len(limits) - 1)
    rows += [[head[0], *cells, *head[1:]] for head, cells in zip(heads, limits, strict=True)]
    return ["filter", "state", "RMSE", ABOVE, "NEES", "NIS"], rows


def _innovations_table(evaluations: Mapping[str, Evaluation], where: str) -> Table:
    """Metrics of the innovations, a row per filter."""
    first = next(iter(evaluations.values()))
    rows = [
        [
            name,
            unless_blank(evaluation.log_likelihood, ".2f"),
            consistency_cells(evaluation)[1],
            str(evaluation.divergences),
        ]
        for name, evaluation in evaluations.items()
    ]
    caption = f"log L: of a run, higher is better. Ideal: NIS {right_nis(first)}. div.: restarts."
    return table(f"Innovations on {where}", ["filter", "log L", "NIS", "div."], rows, caption=caption)


def above_bound(evaluation: Evaluation, bound: np.ndarray) -> list[float]:
    """The excess of each state's RMSE over the bound in percent; NaN where there is none."""
    return [100.0 * (rmse.value / limit - 1.0) for rmse, limit in zip(evaluation.rmse, bound, strict=True)]


def decimals(evaluation: Evaluation) -> list[int]:
    """Decimals of each state's RMSE: three where its scale, or without one its RMSE, is about one, four at 0.1."""
    sizes = [
        min(s if isfinite(s) else inf, rmse.value)
        for s, rmse in zip(evaluation.scale, evaluation.rmse, strict=True)
    ]
    return [max(0, 3 - round(log10(size))) if 0 < size < inf else 3 for size in sizes]


def consistency_cells(evaluation: Evaluation) -> list[str]:
    """Mean NEES and NIS; empty without a covariance or, of NEES, without truth."""
    return [unless_blank(mean.value, ".3g") for mean in (evaluation.nees, evaluation.nis)]


def right_nis(evaluation: Evaluation) -> str:
    """The expected mean NIS: the mean number of channels present."""
    return unless_blank(evaluation.expected_nis, ".3g")


def two_lines(quantity: Quantity) -> str:
    """Symbol above unit, as columns of tables have it."""
    return f"{quantity.symbol}\n[{quantity.unit}]" if quantity.unit else f"{quantity.symbol}\n"


def expected_word(bound: np.ndarray) -> str:
    """The label of the row below the filters: without a bound it has the expected NEES and NIS."""
    return "expected" if np.isnan(bound).all() else "bound"


def limit_cell(bound: float, digits: int) -> str:
    """A bound with so many decimals; empty where there is none."""
    return unless_blank(bound, ".2e" if digits > MOST_DECIMALS else f".{digits}f")


def _output(evaluation: Evaluation, symbol: str) -> str:
    """RMSE of a derived output; empty where the filter's model has none."""
    rmse = evaluation.output_rmse.get(symbol)
    return "" if rmse is None else about(rmse, 3) if rmse.value >= 0.01 else f"{rmse.value:.3g}"


def about(value: Interval, digits: int) -> str:
    """A value with half of its 95 % interval; empty if there is no value."""
    half_width = (value.high - value.low) / 2
    if digits > MOST_DECIMALS and not isnan(value.value):
        return f"{value.value:.2e} ±{half_width:.0e}"
    return "" if isnan(value.value) else f"{value.value:.{digits}f} ±{half_width:.{digits}f}"


def unless_blank(value: float, form: str) -> str:
    """A value in a form; empty if there is no value."""
    return "" if isnan(value) else re.sub(r"^-(0(?:\.0*)?)$", r"\1", format(value, form))  # no -0
