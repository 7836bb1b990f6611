"""The output of `thruster compare` for one scenario: tables, a sentence on the winner, or plain data.

The tables of metrics hold any number of states, derived outputs and channels, with or without truth.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from math import inf, isfinite, isnan, log10

import numpy as np
from rich.console import RenderableType
from rich.table import Table

from filters.consistency.intervals import Interval, slightly
from thruster_env.core.text_tables import table
from thruster_env.model.quantities import Quantity
from tuning.evaluation.compare import Leaderboard, Row, belief_sentences, noise_sentence, winners
from tuning.evaluation.evaluate import Evaluation, restart_sentences
from tuning.evaluation.held_out import summary
from tuning.evaluation.worth import slowest_sentence, without_truth

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


def report(board: Leaderboard) -> list[RenderableType]:
    """Two tables of a scenario, one without truth, and a sentence on the winner."""
    scenario, evaluation = board.scenario, board.rows[0].evaluation
    title = f"{scenario.name}: {scenario.about}" if scenario.about else scenario.name
    seeds = f"held-out {scenario.seed_word} {board.seeds[0]} to {board.seeds[-1]}"
    if not evaluation.has_truth:
        tables = [_predictions(board, f"{title}\nInnovations on {seeds}")]
        remarks = [without_truth(scenario.name)]
    else:
        errors = _errors_across if 2 * len(evaluation.states) < MOST_COLUMNS else _errors_below
        tables, remarks = [errors(board, f"{title}\nRMSE on {seeds}"), _against(board)], []
    noise = noise_sentence(board.rows, "--knows")
    beliefs = belief_sentences(board.rows)
    hint = ["--augment NAME:STD:WALK changes these assumptions."] if beliefs else []
    restarts = restart_sentences({row.label: row.evaluation for row in board.rows})
    restarts.append(slowest_sentence({row.label: row.evaluation for row in board.rows}, scenario))
    return [*tables, *([noise] if noise else []), *beliefs, *hint, *remarks, *restarts, f"{winners(board)}\n"]


def winner(board: Leaderboard) -> int | None:
    """Index of the row with the lowest score, without truth the highest log-likelihood; None if there is none."""
    evaluations = [row.evaluation for row in board.rows]
    return lowest([e.score.value if e.has_truth else -e.log_likelihood for e in evaluations])


def _errors_across(board: Leaderboard, title: str) -> Table:
    """RMSE of all states side by side, a row per filter."""
    states, digits = board.rows[0].evaluation.states, decimals(board.rows[0].evaluation)
    rows = []
    for row in board.rows:
        cells = []
        for rmse, above, count in zip(row.evaluation.rmse, row.above_bound, digits, strict=True):
            cells += [about(rmse, count), unless_blank(100.0 * above, "+.0f")]
        rows.append([row.label, *cells, *map(_start_up, row.evaluation.start_up_rmse)])
    limits = [
        cell for bound, count in zip(board.bound, digits, strict=True) for cell in (limit_cell(bound, count), "")
    ]
    if not np.isnan(board.bound).all():
        rows.append(["bound", *limits, *("" for _ in states)])
    heads = [head for state in states for head in (two_lines(state), ABOVE)]
    begun = [f"{'' if i else 'start-up'}\n{f'[{s.unit}]' if s.unit else ''}" for i, s in enumerate(states)]
    columns, rows, caption = _with_bound_or_not(board, ["filter", *heads, *begun], rows)
    return table(title, columns, rows, caption=caption, best=[winner(board)])


def _errors_below(board: Leaderboard, title: str) -> Table:
    """RMSE of many states, a row per state of a filter."""
    states, digits, rows = board.rows[0].evaluation.states, decimals(board.rows[0].evaluation), []
    for row in board.rows:
        first = row.label == board.rows[0].label
        evaluation = row.evaluation
        columns = states, evaluation.rmse, digits, row.above_bound, evaluation.start_up_rmse, row.ratios
        block = [
            [state.short_label, about(rmse, count), unless_blank(100.0 * above, "+.0f"), _start_up(begun)]
            + ["1" if first else about(ratio, 3)]
            for state, rmse, count, above, begun, ratio in zip(*columns, strict=True)
        ]
        rows += [[row.label if i == 0 else "", *cells] for i, cells in enumerate(block)]
    limits = zip(states, board.bound, digits, strict=True)
    bounds = [[state.short_label, limit_cell(bound, count), "", "", ""] for state, bound, count in limits]
    if any(cells[1] for cells in bounds):
        rows += [["bound" if i == 0 else "", *cells] for i, cells in enumerate(bounds)]
    heads = ["filter", "state", "RMSE", ABOVE, "start-up", f"over\n{board.rows[0].label}"]
    index, lines = winner(board), len(states)
    best = () if index is None else range(index * lines, (index + 1) * lines)
    heads, rows, caption = _with_bound_or_not(board, heads, rows)
    return table(title, heads, rows, caption=caption, best=best)


def _with_bound_or_not(board: Leaderboard, heads: list[str], rows: list[list[str]]) -> tuple:
    """Columns, rows and caption; without a bound the caption describes the scale."""
    rest = "±: half of the 95 % interval. start-up: the first 50 steps."
    if not np.isnan(board.bound).all():
        return heads, rows, f"above: the bound. {rest}"
    return *without(heads, rows, ABOVE), f"No bound; the score is RMSE over {board.scenario.scale_about}. {rest}"


def _start_up(rmse: float) -> str:
    return unless_blank(rmse, ".3g")


def _against(board: Leaderboard) -> Table:
    """Errors over those of the first filter, consistency and cost; errors of few states only."""
    states, first, n = board.rows[0].evaluation.states, board.rows[0].label, len(board.bound)
    listed = states if 2 * n < MOST_COLUMNS else ()
    rows = []
    for row in board.rows:
        ratios = [*row.ratios[: len(listed)], row.score_ratio]
        cells = ["1" if row.label == first else about(ratio, 4 if slightly(ratio) else 3) for ratio in ratios]
        nees, nis = consistency_cells(row.evaluation)
        if nees:
            nees = f"{'~' if row.nees_is_median else ''}{row.nees:.3g}"
        cost = [str(row.evaluation.divergences), f"{row.microseconds:.3g}"]
        rows.append([row.label, *cells, nees, nis, *cost])
    medians = any(row.nees_is_median for row in board.rows)
    right = f"NEES {n}, NIS {right_nis(board.rows[0].evaluation)}{_median(n) if medians else ''}"
    heads = ["filter", *(state.symbol for state in listed), "score", "NEES", "NIS", "div.", "us/step"]
    caption = f"±: half of the 95 % interval. Ideal: {right}. div.: restarts."
    title = f"Over {first}, paired; consistency and cost"
    return table(title, heads, rows, caption=caption, best=[winner(board)])


def _median(n: int) -> str:
    """The expected median of the NEES of n states, from the chi-square distribution."""
    from scipy.special import chdtri

    return f" (~ median NEES, {chdtri(n, 0.5):.2f})"


def _predictions(board: Leaderboard, title: str) -> Table:
    """How well filters predict the measurements, and their cost."""
    first, rows = board.rows[0].label, []
    for row in board.rows:
        evaluation = row.evaluation
        gain = (
            "0" if row.label == first and not isnan(row.likelihood_gain.value) else about(row.likelihood_gain, 2)
        )
        cells = [unless_blank(evaluation.log_likelihood, ".2f"), gain, consistency_cells(evaluation)[1]]
        rows.append([row.label, *cells, str(evaluation.divergences), f"{row.microseconds:.3g}"])
    right = right_nis(board.rows[0].evaluation)
    caption = f"log L: of a run. ±: half of the 95 % interval. Ideal: NIS {right}. div.: restarts."
    heads = ["filter", "log L", f"less that\nof {first}", "NIS", "div.", "us/step"]
    return table(title, heads, rows, caption=caption, best=[winner(board)])


def as_json(boards: list[Leaderboard]) -> dict:
    """The leaderboards as plain data."""
    return {
        "seeds": [boards[0].seeds[0], boards[0].seeds[-1] + 1],
        "states": [state.short_label for state in boards[0].rows[0].evaluation.states],
        "scenarios": {
            board.scenario.name: {
                "about": board.scenario.about,
                "bound": board.bound,
                "scale": board.scenario.scale,
                **_own_states(board, boards[0]),
                "filters": {row.label: _row_as_json(row) for row in board.rows},
            }
            for board in boards
        },
    }


def _own_states(board: Leaderboard, first: Leaderboard) -> dict:
    """The names of a scenario's states where they are not those of the first one."""
    names, known = (
        [state.short_label for state in compared.rows[0].evaluation.states] for compared in (board, first)
    )
    return {} if names == known else {"states": names}


def _row_as_json(row: Row) -> dict:
    gain = {} if row.evaluation.has_truth else {"log_likelihood_less_first": row.likelihood_gain}
    return {
        "filter": row.filter_name,
        **({"knows": row.knows} if row.knows else {}),
        **({"beliefs": {name: belief._asdict() for name, belief in row.beliefs.items()}} if row.beliefs else {}),
        **summary(row.evaluation),
        "median_nees": row.evaluation.median_nees,
        "above_bound": row.above_bound,
        "microseconds_a_step": row.microseconds,
        "rmse_over_first": row.ratios,
        "score_over_first": row.score_ratio,
        **gain,
        "verdict": row.verdict,
    }
