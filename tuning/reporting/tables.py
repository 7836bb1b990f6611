"""Tables of metrics, of parameters, of what a search tried, and of what data determine; the output of `compare`.

The tables of metrics hold any number of states, derived outputs and channels, with or without truth.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from math import inf, isfinite, isnan, log10
from typing import Any, NamedTuple

import numpy as np

from filters.consistency.nees import Interval, slightly
from thruster_env.core.text_tables import Table
from thruster_env.model.quantities import Quantity
from tuning.evaluation.compare import OF_FILE, OF_FILTER, STUDY, Leaderboard, Row, winners
from tuning.evaluation.evaluate import Evaluation, restart_sentences
from tuning.evaluation.held_out import summary
from tuning.evaluation.worth import slowest_sentence, without_truth
from tuning.problems.problem import Problem
from tuning.reporting.choice_words import number_rows
from tuning.search.among_types import TypeResult
from tuning.search.plan import Plan, reported_name
from tuning.search.space import Choice

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
    cells = zip(*map(consistency_cells, evaluations.values()), strict=True)
    of_filter = [Column("NEES", [*next(cells)], str(len(bound))), Column("NIS", [*next(cells)], right_nis(first))]
    ideal = f"±: half of the 95 % interval. Ideal: NEES {len(bound)}, NIS {right_nis(first)}."
    return errors_table(evaluations, bound, f"RMSE on {where}", ideal, scale_about, of_filter=of_filter)


class Column(NamedTuple):
    """A column beside errors: its head, a cell for each filter (of states a list), and that of the last row."""

    head: str
    cells: Sequence[Any]
    last: str = ""


def errors_table(
    evaluations: Mapping[str, Evaluation],
    bound: np.ndarray,
    title: str,
    caption: str,
    scale_about: str = "",
    of_state: Sequence[Column] = (),
    of_filter: Sequence[Column] = (),
) -> Table:
    """RMSE and the distance from the bound, with further columns; the best score stands out.

    A row is a filter, or where states and outputs do not fit side by side one of them.
    """
    first = next(iter(evaluations.values()))
    outputs = {symbol: output for e in evaluations.values() for symbol, output in e.outputs.items()}
    outputs = outputs if of_filter else {}
    digits, states, rows = decimals(first), first.states, []
    across = 2 * len(states) + len(outputs) <= MOST_COLUMNS
    for number, (name, evaluation) in enumerate(evaluations.items()):
        above = [unless_blank(part, "+.0f") for part in above_bound(evaluation, bound)]
        errors = [about(rmse, count) for rmse, count in zip(evaluation.rmse, digits, strict=True)]
        further = [column.cells[number] for column in of_state]
        values, last = [_output(evaluation, symbol) for symbol in outputs], [c.cells[number] for c in of_filter]
        if across:
            pairs = [cell for pair in zip(errors, above, strict=True) for cell in pair]
            rows.append([name, *pairs, *values, *(cell for cells in further for cell in cells), *last])
            continue
        block = [[s.short_label, *cells] for s, *cells in zip(states, errors, above, *further, strict=True)]
        block += [
            [o.short_label, v, "", *[""] * len(of_state)] for o, v in zip(outputs.values(), values, strict=True)
        ]
        rows += _block(name, block, last)
    limits, has_bound = list(map(limit_cell, bound, digits)), not np.isnan(bound).all()
    word, last = "bound" if has_bound else "expected", [column.last for column in of_filter]
    blank, heads = [""] * len(of_state), [column.head for column in of_filter]
    if across:
        pairs = [cell for limit in limits for cell in (limit, "")]
        rows.append([word, *pairs, *("" for _ in outputs), *blank * len(states), *last])
        of_states = [
            f"{'' if i else column.head}\n{f'[{state.unit}]' if state.unit else ''}"
            for column in of_state
            for i, state in enumerate(states)
        ]
        errors = [head for state in states for head in (two_lines(state), ABOVE)]
        columns = ["filter", *errors, *map(two_lines, outputs.values()), *of_states, *heads]
    else:
        labels = [state.short_label for state in states] if has_bound else [""]
        rows += _block(
            word, [[label, limit, "", *blank] for label, limit in zip(labels, limits, strict=False)], last
        )
        columns = ["filter", "state", "RMSE", ABOVE, *(column.head for column in of_state), *heads]
    if not has_bound:
        rows = rows if of_filter else rows[:-1]
        columns, rows = without(columns, rows, ABOVE)
    above_words = "above: the bound. " if has_bound else ""
    if not has_bound and scale_about:
        above_words = f"No bound; the score is RMSE over {scale_about}. "
    lines = 1 if across else len(states) + len(outputs)
    index = lowest([evaluation.score.value for evaluation in evaluations.values()])
    best = range(index * lines, (index + 1) * lines) if index is not None else ()
    return Table(title, columns, rows, f"{above_words}{caption}", best=best)


def _block(name: str, rows: Sequence[list[str]], last: Sequence[str]) -> list[list[str]]:
    """Rows of one filter: its name and last cells stand in the first."""
    blank = [""] * len(last)
    return [[*(("",) if i else (name,)), *row, *(blank if i else last)] for i, row in enumerate(rows)]


def lowest(values: Sequence[float]) -> int | None:
    """Index of the lowest of several values, ignoring NaN; None if there are none to compare."""
    known = [value for value in values if not isnan(value)]
    return list(values).index(min(known)) if len(known) > 1 else None


def without(columns: Sequence[str], rows: Sequence[Sequence[str]], head: str) -> tuple[list, list]:
    """Columns and rows less the columns of one head."""
    indices = [i for i, column in enumerate(columns) if column != head]
    return [columns[i] for i in indices], [[row[i] for i in indices] for row in rows]


def _innovations_table(evaluations: Mapping[str, Evaluation], where: str) -> Table:
    first = next(iter(evaluations.values()))
    rows = []
    for name, evaluation in evaluations.items():
        likelihood, nis = unless_blank(evaluation.log_likelihood, ".2f"), consistency_cells(evaluation)[1]
        rows.append([name, likelihood, nis, str(evaluation.divergences)])
    caption = f"log L: of a run, higher is better. Ideal: NIS {right_nis(first)}. div.: restarts."
    return Table(f"Innovations on {where}", ["filter", "log L", "NIS", "div."], rows, caption=caption)


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


SAID = {
    "true": "the plant's own (oracle; {option} true)",
    "scaled": "the scaled default ({option} scaled)",
    "untuned": "the rule of thumb ({option} untuned)",
    "given": "those that the model came with ({option} given)",
    "noise": "noise estimation ({option} noise)",
    STUDY: "the best trial of a study ({option} study)",
    OF_FILE: "the tuned ones",
    OF_FILTER: "those of the filter itself",
}


def noise_sentence(rows: Sequence[Any], option: str = "knows") -> str:
    """The source of the Q and R of the filters in a comparison, and why; empty if not stated.

    Args:
        rows: with a label, the source of the filter's Q and R, and a note on it.
        option: the user's name for the choice among these.
    """
    groups: dict[str, list[str]] = {}
    for row in rows:
        if row.knows:
            groups.setdefault(SAID[row.knows].format(option=option), []).append(row.label)
    if not groups:
        return ""
    notes = "".join(dict.fromkeys(f" {row.note}" for row in rows if row.note))
    if len(groups) == 1:
        return f"Q and R: {next(iter(groups))}.{notes}"
    parts = [f"of {', '.join(labels)} {words}" for words, labels in groups.items()]
    return f"Q and R: {'; '.join(parts)}.{notes}"


def belief_sentences(rows: Sequence[Any]) -> list[str]:
    """The prior of each constant that filters estimate, the same for all filters, a sentence per constant."""
    beliefs = {name: belief for row in rows for name, belief in row.beliefs.items()}
    return [
        f"{name} has a prior mean of {belief.mean:.4g}, a standard deviation of {belief.std:.3g} and a random "
        f"walk of {belief.walk_std:.3g} per step (standard deviation; all in its own unit)."
        for name, belief in beliefs.items()
    ]


def report(board: Leaderboard) -> list[Table | str]:
    """Two tables of a scenario, one without truth, and a sentence on the winner."""
    scenario, evaluation = board.scenario, board.rows[0].evaluation
    title = f"{scenario.name}: {scenario.about}" if scenario.about else scenario.name
    seeds = f"held-out {scenario.seed_word} {board.seeds[0]} to {board.seeds[-1]}"
    if not evaluation.has_truth:
        tables = [_predictions(board, f"{title}\nInnovations on {seeds}")]
        remarks = [without_truth(scenario.name)]
    else:
        tables, remarks = [_errors(board, f"{title}\nRMSE on {seeds}"), _against(board)], []
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


def _errors(board: Leaderboard, title: str) -> Table:
    """RMSE of all states, also of the first steps, and of many states over those of the first filter."""
    rows, first = board.rows, board.rows[0]
    of_state = [
        Column("start-up", [[unless_blank(e, ".3g") for e in row.evaluation.start_up_rmse] for row in rows])
    ]
    if 2 * len(first.evaluation.states) > MOST_COLUMNS:
        ratios = [["1" if row is first else about(ratio, 3) for ratio in row.ratios] for row in rows]
        of_state.append(Column(f"over\n{first.label}", ratios))
    caption = "±: half of the 95 % interval. start-up: the first 50 steps."
    evaluations = {row.label: row.evaluation for row in rows}
    return errors_table(evaluations, board.bound, title, caption, board.scenario.scale_about, of_state)


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
    return Table(title, heads, rows, caption=caption, best=[winner(board)])


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
    return Table(title, heads, rows, caption=caption, best=[winner(board)])


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


def choice_table(choices: Mapping[str, Choice], scenario: Problem) -> Table:
    """The parameters of filters of one type, a column each."""
    kind, caption = next(iter(choices.values())).name, ""
    model = scenario.model()
    rows = number_rows(list(choices.values()), kind, scenario, cell_of)
    if kind == "kf" and model.operating_input is not None:
        pairs = zip(model.operating_input, model.input_quantities, strict=True)
        about = ", ".join(f"{value:g} {quantity.unit}".rstrip() for value, quantity in pairs)
        caption = f"kf: on the affine approximation about {about}"
    return Table(f"Parameters of the {kind} filter", ["", *choices], rows, caption=caption)


def cell_of(value) -> str:
    """A parameter as a cell."""
    return "default" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


def kinds_table(kinds: Sequence[TypeResult], plan: Plan) -> Table:
    """Filter types that a study tried, the best first."""
    objective = plan.objectives[0]
    rows = [
        [kind.name, str(kind.trials), str(kind.pruned), str(kind.over_budget), kind.best(objective)]
        + ["" if kind.microseconds is None else f"{kind.microseconds:.3g}"]
        for kind in kinds
    ]
    columns = ["filter", "trials", "pruned", "over\nbudget", f"best\n{reported_name(objective)}", "us/step"]
    caption = (
        "us/step: time of the best trial, or of the fastest if none is complete. *: mean NIS outside its band."
    )
    best = [0] if len(rows) > 1 else []
    title = f"Filters that were tried, on the training {plan.scenarios[0].seed_word}"
    return Table(title, columns, rows, caption=caption, best=best)
