"""`thruster tune`: an Optuna study of a filter's noise covariances and ensemble size, with its proof."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, NamedTuple

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from filters.consistency.verdicts import mean_sentence
from filters.registry import filter_class
from thruster_cli.output import FILTER_HELP, JsonOption, SeedOption, announce_compilation, emit, progress_console
from thruster_cli.tables import choice_table, comparison_table, span
from thruster_env.checks import at_least
from thruster_env.files import check_target
from tuning.evaluate import Evaluation, Interval, score_ratio
from tuning.scenarios import Scenario, find_scenario
from tuning.space import true_choice, untuned_choice
from tuning.storage import open_storage
from tuning.study import (
    SIZE_LADDER,
    Comparison,
    StudyResult,
    finished_trials,
    open_study,
    prove,
    quiet_optuna,
    run_study,
)
from tuning.tuned import summary, write_tuned

DEFAULT_STORAGE = "out/studies.journal"


class Tuning(NamedTuple):
    """All that a tuning made."""

    study: str
    scenario: Scenario
    result: StudyResult
    proof: Comparison
    file: Path


def command(
    filter_name: Annotated[str, typer.Option("--filter", help=FILTER_HELP)] = "enkf",
    scenario: Annotated[str, typer.Option(help="nominal, published_noise or mismatch.")] = "mismatch",
    trials: Annotated[int, typer.Option(help="Finished trials that the study shall have in total.")] = 50,
    storage: Annotated[
        str, typer.Option(help="Journal file, or an Optuna storage URL such as postgresql+psycopg2://...")
    ] = DEFAULT_STORAGE,
    study: Annotated[str | None, typer.Option(help="Name of the study; by default from the above.")] = None,
    out: Annotated[Path | None, typer.Option(help="Tuned file; out/STUDY.json by default.")] = None,
    seed: SeedOption = 0,
    json: JsonOption = None,
) -> None:
    """Find the Q, R and ensemble size that make a filter's estimate best, and prove it on held-out seeds.

    The score is the mean over states of RMSE over its bound, on 32 training seeds that every trial shares.
    The first trial is the untuned filter. Ctrl-C keeps all finished trials: the same command goes on with
    the study. The report is on 200 seeds that no trial saw.
    """
    tuning = tune(filter_name, scenario, trials, storage, study, out, seed)
    emit(report(tuning), as_json(tuning), json)
    if tuning.result.interrupted:
        sys.exit(130)


def tune(
    filter_name: str,
    scenario_name: str,
    trials: int,
    storage: str = DEFAULT_STORAGE,
    study_name: str | None = None,
    out: Path | None = None,
    seed: int = 0,
) -> Tuning:
    """Run or resume a study with a progress bar, prove its choice and write the tuned file."""
    filter_class(filter_name)
    scenario, trials = find_scenario(scenario_name), at_least("trials", trials, 1)
    name = study_name or f"{filter_name}-{scenario_name}-seed{seed}"
    if "/" in name:
        raise ValueError(f"study must be a name without slashes, but got {name!r}")
    file = out or Path("out") / f"{name}.json"
    check_target(file)
    quiet_optuna()
    announce_compilation()
    study = open_study(name, filter_name, scenario, seed, open_storage(storage))
    already = finished_trials(study)
    if already:
        progress_console.print(f"study {name!r} goes on after {already} finished trials")
    best = f"{study.best_value:.3f}" if already else "-"
    with _bar(f"tuning {filter_name} on {scenario_name}", trials, already, best) as advance:
        result = run_study(study, filter_name, scenario, seed, trials, advance)
    with progress_console.status("proving the choice on held-out seeds ..."):
        proof = prove(result.choice, scenario, seed)
    write_tuned(file, scenario, seed, result, proof, name)
    return Tuning(name, scenario, result, proof, file)


@contextmanager
def _bar(title: str, total: int, done: int, best: str) -> Iterator:
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("best score {task.fields[best]}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=progress_console) as progress:
        task = progress.add_task(title, total=total, completed=min(done, total), best=best)

        def advance(study, finished: int) -> None:
            progress.update(task, completed=finished, best=f"{study.best_value:.3f}")

        yield advance


def report(tuning: Tuning) -> list:
    """Tables and sentences that say what a tuning found and what it is worth."""
    result, proof, scenario = tuning.result, tuning.proof, tuning.scenario
    choice = result.choice
    choices = {
        "untuned": untuned_choice(choice.name, scenario),
        "tuned": choice,
        "true": true_choice(choice.name, scenario),
    }
    evaluations = {"untuned": proof.untuned, "tuned": proof.tuned, "true Q, R": proof.true}
    title = f"RMSE on held-out seeds {proof.seeds.start} to {proof.seeds.stop - 1}, scenario {scenario.name}"
    shown = [choice_table(choices, scenario), comparison_table(evaluations, proof.bound, title)]
    if result.sizes:
        kept = choice.numbers["ensemble_size"]
        ratios = ", ".join(f"{row.size}: {row.ratio:.3f}" for row in result.sizes if row.size in SIZE_LADDER)
        shown.append(
            f"Score over the best by ensemble size, on the training seeds: {ratios}. "
            f"N = {kept} is the smallest within 1 %."
        )
    ratio = score_ratio(proof.tuned, proof.untuned)
    shown.append(
        f"Tuned against untuned on {len(proof.seeds)} held-out seeds: score x {span(ratio, 3)} "
        f"(paired 95 % interval). {_verdict(ratio)}"
    )
    shown.append(_consistency_sentence(proof.tuned, len(proof.bound)))
    trained = f"{len(result.trials)} trials, {result.seconds:.1f} s in this run"
    shown.append(f"Study {tuning.study!r}: {trained}. Tuned filter: {tuning.file}")
    if result.interrupted:
        shown.append("Interrupted: this is on the trials that were finished; the same command goes on.")
    return shown


def as_json(tuning: Tuning) -> dict:
    """The result of a tuning as plain data."""
    result, proof = tuning.result, tuning.proof
    return {
        "study": tuning.study,
        "scenario": tuning.scenario.name,
        "filter": result.choice._asdict(),
        "trials": len(result.trials),
        "best_training_score": result.best_value,
        "interrupted": result.interrupted,
        "sizes": [{"N": r.size, "ratio": r.ratio, "score": r.evaluation.score.value} for r in result.sizes],
        "held_out": {
            "seeds": [proof.seeds.start, proof.seeds.stop],
            "bound": proof.bound,
            **{name: summary(getattr(proof, name)) for name in ("untuned", "tuned", "true")},
            "tuned_over_untuned": score_ratio(proof.tuned, proof.untuned),
        },
        "file": str(tuning.file),
    }


def _verdict(ratio: Interval) -> str:
    if ratio.high < 1:
        return f"Tuning lowers the error by {100 * (1 - ratio.value):.0f} %."
    return "Tuning makes it worse." if ratio.low > 1 else "No difference that these seeds can show."


def _consistency_sentence(evaluation: Evaluation, n: int) -> str:
    said = mean_sentence("NEES", evaluation.nees, n)
    return said if said.startswith("Consistent") else f"{said} RMSE alone does not see the covariance."
