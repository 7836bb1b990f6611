"""`thruster compare`: filters side by side on scenarios, on seeds that no study saw."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import product
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from filters.augmented import Unknown
from filters.registry import FILTERS, filter_class
from numerics.checks import at_least
from thruster_cli.output import JsonOption, SeedOption, announce_compilation, emit, progress_console, table
from thruster_cli.tables import about, unless_blank
from tuning.evaluation.compare import Contender, Leaderboard, Row, compare, contender, sized
from tuning.evaluation.evaluate import STATES
from tuning.evaluation.tuned import check_plant, read_tuned, summary
from tuning.problems.seeds import held_out_seeds
from tuning.search.plan import HELD_OUT_SEEDS
from tuning.search.space import has_ensemble
from tuning.thruster.find import find_scenario
from tuning.thruster.scenario import Scenario
from tuning.thruster.scenarios import SCENARIOS

DEFAULT_FILTERS = ("ekf", "enkf", "pf")


def command(
    files: Annotated[
        list[Path] | None, typer.Argument(metavar="FILE", help="Tuned files, as `thruster tune` writes them.")
    ] = None,
    filters: Annotated[
        list[str] | None,
        typer.Option(
            "--filter", help=f"{', '.join(FILTERS)}; may be repeated. Without any, or a file: ekf, enkf, pf."
        ),
    ] = None,
    scenarios: Annotated[
        list[str] | None,
        typer.Option("--scenario", help=f"{', '.join(SCENARIOS)}, or a .toml file; may be repeated."),
    ] = None,
    seeds: Annotated[int, typer.Option(help="Number of held-out seeds.")] = HELD_OUT_SEEDS,
    knows: Annotated[
        str,
        typer.Option(
            help="What a filter named by --filter knows of the plant's noise: true (oracle), scaled (scaled "
            "default) or untuned (rule of thumb)."
        ),
    ] = "true",
    augment: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME[:STD[:WALK]]",
            help="Give each --filter a second row, where it also estimates this constant of its model, such as "
            "ambient_velocity, believed to within STD at first and to change by WALK a step.",
        ),
    ] = None,
    ensemble_size: Annotated[
        list[str] | None,
        typer.Option(metavar="[FILTER=]N", help="Ensemble size, of all filters or of one; may be repeated."),
    ] = None,
    seed: SeedOption = 0,
    json: JsonOption = None,
) -> None:
    """Rank filters on scenarios: errors, consistency, cost, and which beat the first one on the same seeds.

    All filters meet the same truth, inputs and measurements. A filter is better or worse than the first one if
    the paired 95 % interval of the ratio of their scores leaves out 1. Ctrl-C keeps the rows that are done.

    Example: thruster compare --filter ekf --filter ekf-robust --filter pf --scenario outliers --scenario ambient

    Example: thruster compare --filter ekf --augment ambient_velocity --scenario ambient
    """
    contenders, default = _contenders(files or [], filters or [], knows, augment or [], ensemble_size or [], seed)
    chosen = [find_scenario(name) for name in scenarios] if scenarios else [default]
    for file, scenario in product(files or [], chosen):
        check_plant(file, scenario)
    held_out = held_out_seeds(seed, seeds)
    announce_compilation()
    with _bar(len(contenders) * len(chosen)) as on_row:
        boards, interrupted = compare(contenders, chosen, held_out, on_row)
    shown = [part for board in boards for part in report(board)]
    if interrupted:
        shown.append("Interrupted: these are the rows that were done.")
    emit(shown, {"seed": seed, "knows": knows, "interrupted": interrupted, **as_json(boards)}, json)
    if interrupted:
        sys.exit(130)


def _contenders(files, filters, knows, augment, sizes, seed) -> tuple[list[Contender], Scenario]:
    """The filters that take part, and the scenario where none is named: that of the first file, or nominal."""
    wanted = dict(_size(text) for text in sizes)
    unknown = dict(_unknown(text) for text in augment)
    out, default = [], find_scenario("nominal")
    for place, file in enumerate(files):
        choice, scenario, _ = read_tuned(file)
        if place == 0:
            default = scenario
        choice = sized(choice, wanted.get(choice.name, wanted.get(None)))
        out.append(Contender(file.stem, lambda scenario, choice=choice: choice))
    for name in filters or ([] if files else DEFAULT_FILTERS):
        size = wanted.get(name, wanted.get(None)) if has_ensemble(name) else None
        out.append(contender(name, knows, seed=seed, ensemble_size=size))
        if unknown and filter_class(name).has_covariance:
            out.append(contender(name, knows, unknown, seed, ensemble_size=size))
    return out, default


def _size(text: str) -> tuple[str | None, int]:
    name, equals, number = text.rpartition("=")
    if equals:
        if not has_ensemble(name):
            raise ValueError(f"--ensemble-size must be for a filter with an ensemble, but got {text!r}")
        return name, at_least("--ensemble-size", number, 2)
    return None, at_least("--ensemble-size", number, 2)


def _unknown(text: str) -> tuple[str, Unknown | None]:
    name, *numbers = text.split(":")
    try:
        return name, Unknown(*map(float, numbers)) if numbers else None
    except (TypeError, ValueError):
        raise ValueError(f"--augment must be NAME, NAME:STD or NAME:STD:WALK, but got {text!r}") from None


@contextmanager
def _bar(total: int) -> Iterator:
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=progress_console) as progress:
        task, begun = progress.add_task("comparing ...", total=total), []

        def on_row(scenario: Scenario, label: str) -> None:
            progress.update(task, description=f"{label} on {scenario.name}", completed=len(begun))
            begun.append(label)

        yield on_row
        progress.update(task, completed=len(begun))


def report(board: Leaderboard) -> list:
    """Two tables of a scenario and a sentence on who wins."""
    scenario, seeds = board.scenario, board.seeds
    first = board.rows[0].label
    title = f"{scenario.name}: {scenario.about}" if scenario.about else scenario.name
    errors = table(
        f"{title}\nRMSE on held-out seeds {seeds[0]} to {seeds[-1]}",
        ["filter", "omega_m\n[rad/s]", "above\n[%]", "U_a\n[m/s]", "above\n[%]", "start-up\n[rad/s]", "\n[m/s]"],
        [_errors(row) for row in board.rows] + [_bound_row(board)],
        caption="above: the bound. ±: half of the 95 % interval. start-up: the first 50 steps.",
    )
    right = f"NEES {len(board.bound)}, NIS 1" + (
        " (~ median NEES, 1.39)" if any(r.nees_is_median for r in board.rows) else ""
    )
    ratios = table(
        f"Over {first}, paired; consistency and cost",
        ["filter", "omega_m", "U_a", "score", "NEES", "NIS", "div.", "us a step"],
        [_against(row, row.label == first) for row in board.rows],
        caption=f"±: half of the 95 % interval. Honest: {right}. div.: restarts.",
    )
    for shown in (errors, ratios):
        shown.columns[0].overflow = "fold"
    return [errors, ratios, winners(board)]


def winners(board: Leaderboard) -> str:
    """Who is significantly better or worse than the first filter."""
    first, *others = board.rows
    if not others:
        return f"On {board.scenario.name} there is nothing to compare {first.label} with."
    said = []
    for verdict, words in (("better", "better"), ("worse", "worse"), ("tie", "no different")):
        names = [row.label for row in others if row.verdict == verdict]
        said += [f"{words}: {', '.join(names)}"] if names else []
    return f"On {board.scenario.name}, against {first.label} by the score: {'; '.join(said)}.\n"


def _errors(row: Row) -> list[str]:
    speed, flow = row.evaluation.rmse
    above = [unless_blank(100.0 * part, "+.0f") for part in row.above_bound]
    at_first = [f"{part:.3g}" for part in row.evaluation.start_up_rmse]
    return [row.label, about(speed, 3), above[0], about(flow, 4), above[1], *at_first]


def _bound_row(board: Leaderboard) -> list[str]:
    return ["bound", unless_blank(board.bound[0], ".3f"), "", unless_blank(board.bound[1], ".4f"), "", "", ""]


def _against(row: Row, is_first: bool) -> list[str]:
    ratios = [about(part, 3) for part in (*row.ratios, row.score_ratio)]
    ratios = ["1", "1", "1"] if is_first else ratios
    honest = row.evaluation.nees.value == row.evaluation.nees.value  # baselines have no covariance
    nees = f"{'~' if row.nees_is_median else ''}{row.nees:.3g}" if honest else ""
    nis = f"{row.evaluation.nis.value:.3g}" if honest else ""
    return [row.label, *ratios, nees, nis, f"{row.evaluation.divergences}", f"{row.microseconds:.3g}"]


def as_json(boards: list[Leaderboard]) -> dict:
    """The leaderboards as plain data."""
    return {
        "seeds": [boards[0].seeds[0], boards[0].seeds[-1] + 1],
        "states": STATES,
        "scenarios": {
            board.scenario.name: {
                "about": board.scenario.about,
                "bound": board.bound,
                "scale": board.scenario.scale,
                "filters": {row.label: _row_as_json(row) for row in board.rows},
            }
            for board in boards
        },
    }


def _row_as_json(row: Row) -> dict:
    return {
        "filter": row.filter_name,
        **summary(row.evaluation),
        "median_nees": row.evaluation.median_nees,
        "above_bound": row.above_bound,
        "microseconds_a_step": row.microseconds,
        "rmse_over_first": row.ratios,
        "score_over_first": row.score_ratio,
        "verdict": row.verdict,
    }
