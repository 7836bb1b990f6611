"""The output of `thruster compare` for one scenario: tables, a sentence on the winner, or plain data."""

from __future__ import annotations

from math import isnan

import numpy as np
from rich.console import RenderableType
from rich.table import Table

from filters.consistency.intervals import slightly
from thruster_env.core.text_tables import table
from tuning.evaluation.compare import Leaderboard, Row, winners
from tuning.evaluation.evaluate import restart_sentences
from tuning.evaluation.knowledge import belief_sentences, noise_sentence
from tuning.evaluation.summary import summary
from tuning.evaluation.worth import slowest_sentence, without_truth
from tuning.reporting.error_tables import (
    ABOVE,
    MOST_COLUMNS,
    about,
    consistency_cells,
    decimals,
    limit_cell,
    lowest,
    right_nis,
    two_lines,
    unless_blank,
    without,
)


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
