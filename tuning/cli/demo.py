"""`thruster demo`: tune a filter, evaluate it on held-out data, draw it, report it."""

from __future__ import annotations

import os
import shutil
import sys
import time
import warnings
from pathlib import Path
from typing import Annotated

from rich.table import Table as RichTable

from filters.filter import Filter
from thruster_env.core.files import save_figure
from thruster_env.core.text_tables import Table
from tuning.api.markers import OUTPUT, RUNS, Option, Seed
from tuning.api.progress import working
from tuning.api.report import Report
from tuning.api.report import report as write_report
from tuning.api.result import Printed
from tuning.api.study import INTERRUPTED, Study
from tuning.api.tune import run_tuning
from tuning.cli.output import progress_console
from tuning.evaluation.baselines import NOISE, ORACLE, TUNED, baselines, same_filter
from tuning.evaluation.evaluate import score_ratio
from tuning.plants.thruster import find_scenario
from tuning.problems.problem import score_label
from tuning.reporting.leaderboard import above_bound, consistency_cells
from tuning.reporting.search_figures import draw_comparison, draw_history
from tuning.reporting.time_figures import estimates_figure
from tuning.reporting.tuning_report import as_json
from tuning.search.plan import TRAINING_SEEDS, Plan
from tuning.search.space import AUTO

FILTER, SCENARIO = "ekf", "outliers"  # where tuning Q and R is worth most: docs/tuning.md
BUDGET = 1.0  # us/step of the filters among which the second study chooses
LEGEND = (
    "Above bound: excess of RMSE over the posterior Cramér-Rao bound.\nScore: mean RMSE over bound. NEES, "
    "NIS: normalised errors, innovations squared."
)


def command(
    out: Annotated[Path, Option(OUTPUT)] = Path("out"),
    trials: Annotated[int, Option(RUNS)] = 50,
    seed: Seed = 0,
) -> Printed:
    """Tune an extended Kalman filter, evaluate it on held-out seeds, draw it before and after, write its report.

    One thrust in twenty is off by some 10 N, which the sensor's data sheet does not mention. Table, pictures and
    page compare the tuned filter with four others on the same 200 held-out runs. A second study chooses the filter
    type, too, among all that take at most a microsecond a step.

    Args:
        out: folder of the pictures, the report and the tuned file.
        trials: total number of finished trials of the study.
        seed: seed of all randomness; the same seed gives the same results.
    """
    started = time.perf_counter()
    storage = str(out / "studies.journal")
    plan = Plan(FILTER, (find_scenario(SCENARIO),), seed)
    file = out / f"{FILTER}-{SCENARIO}-seed{seed}.json"
    tuning = run_tuning(plan, trials, progress_console, storage, out=file)
    best = None if tuning.result.interrupted else best_type(plan, trials, storage, out)
    with working("drawing", progress_console):
        pictures = draw(tuning, out)
        report = write_report(file, out, storage=storage, progress=False)
    seconds = time.perf_counter() - started
    data = {
        "tuning": as_json(tuning),
        "best_type": None if best is None else as_json(best),
        "advice": report.advice,
        "pictures": list(map(str, pictures)),
        "report": str(report.page),
        "seconds": seconds,
    }
    output = [*result(tuning, best, report, seconds), *files(file, best, pictures, report), *next_steps()]
    return Printed(output, data, INTERRUPTED if best is None or best.result.interrupted else 0)


def best_type(plan: Plan, trials: int, storage: str, out: Path) -> Study:
    """A study of the filter type and its parameters, within the budget, on the same runs."""
    plan = plan._replace(filter=AUTO, budget=BUDGET)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # few trials: a demo is short
        file = out / f"{AUTO}-{SCENARIO}-seed{plan.seed}.json"
        return run_tuning(plan, trials, progress_console, storage, out=file)


def result(tuning: Study, best: Study | None, report: Report, seconds: float) -> list[str | RichTable]:
    """What was tuned on what, the errors before and after, and one sentence on the gain."""
    outcome, seeds = tuning.result, len(tuning.comparison.seeds)
    stopped = ", interrupted," if outcome.interrupted else ""
    return [
        f"An extended Kalman filter (EKF) where {tuning.problem.about}: {outcome.finished} trials{stopped} on "
        f"{TRAINING_SEEDS} runs, evaluated on {seeds} others, in {seconds:.0f} s.",
        report.advice,
        "",
        error_table(tuning, best),
        LEGEND,
        *([] if best is None else [advice_on_type(tuning, best)]),
        "",
    ]


def advice_on_type(tuning: Study, best: Study) -> str:
    """What the choice of the filter type is worth."""
    ratio = score_ratio(best.comparison.tuned, tuning.comparison.tuned)
    gain = f"{100 * (1 - ratio.value):.0f} % below" if ratio.high < 1 else "no better than"
    count, name = len(best.plan.filter_types), best.result.choice.name
    return (
        f"A second study (--filter auto --budget {BUDGET:g}) also chose the filter type, among {count}: {name}. "
        f"Its score is {gain} that of the tuned {FILTER}."
    )


def error_table(tuning: Study, best: Study | None) -> RichTable:
    """A row a filter: its R, the RMSE of both states and how far above the bound it lies, mean NEES and NIS."""
    comparison, scenario = tuning.comparison, tuning.problem
    choices = {TUNED: tuning.result.choice, **baselines(FILTER, scenario, tuning.plan.seed)}
    rows = []
    evaluations, reference = dict(comparison.evaluations), {*comparison.evaluations} - {TUNED}
    if best is not None:
        name = f"auto: {best.result.choice.name}"
        evaluations[name], choices[name] = best.comparison.tuned, best.result.choice
    for name, evaluation in evaluations.items():
        if name in reference and same_filter(choices[name], choices[TUNED]):
            continue  # its numbers stand in the row "tuned"
        pairs = zip(evaluation.rmse, above_bound(evaluation, comparison.bound), strict=True)
        errors = [cell for rmse, above in pairs for cell in (f"{rmse.value:#.3g}", f"{above:+.0f} %")]
        ((variance,),) = choices[name].filter(scenario).model.measurement_noise_cov
        rows.append([name, f"{variance:.3g}", *errors, *consistency_cells(evaluation)])
    speed, flow = (f"{limit:#.3g}" for limit in comparison.bound)
    rows.append(["bound", "", speed, "", flow, "", str(len(comparison.bound)), "1"])
    heads = [
        head
        for state in scenario.model().states
        for head in ("\n".join([*state.name.split(), f"[{state.unit}]"]), "above\nbound")
    ]
    output = Table("", ["filter", "R\n[N^2]", *heads, "mean\nNEES", "mean\nNIS"], rows).__rich__()
    output.show_edge = False
    return output


def draw(tuning: Study, out: Path) -> dict[Path, str]:
    """Draw the tuned filter before and after, errors and search; return a caption for each file."""
    comparison, scenario = tuning.comparison, tuning.problem
    label, data = f"{tuning.result.choice.name} on {scenario.name}", scenario.data(comparison.seeds[:1])
    run = estimates_figure(out / "estimates.png", before_and_after(tuning), data, 0, scenario.dt)
    drawn = draw_comparison(comparison, f"{label}: RMSE on {len(comparison.seeds)} held-out seeds")
    errors = save_figure(drawn, out / "rmse.png")
    drawn = draw_history(tuning.result.trials, f"Study of {label}", score_label((scenario,)))
    search = save_figure(drawn, out / "history.png")
    return {
        run: f"one of these runs: {best_baseline(tuning)}, then tuned",
        errors: "the errors of the table",
        search: "the search, trial by trial",
    }


def before_and_after(tuning: Study) -> dict[str, Filter]:
    """The best baseline and the tuned filter, by the titles of their pictures."""
    before = best_baseline(tuning)
    choices = {before: baselines(FILTER, tuning.problem, tuning.plan.seed)[before], TUNED: tuning.result.choice}
    words = (f"before: {before}", f"after: {TUNED}")
    return {word: choice.filter(tuning.problem) for word, choice in zip(words, choices.values(), strict=True)}


def best_baseline(tuning: Study) -> str:
    """The baseline with the lowest score among those that need no truth."""
    evaluations = tuning.comparison.evaluations
    return min(
        (name for name in evaluations if name not in (TUNED, NOISE, ORACLE)),
        key=lambda name: evaluations[name].score.value,
    )


def files(tuned: Path, best: Study | None, pictures: dict[Path, str], report: Report) -> list[str]:
    """The paths of all files."""
    about = {
        **pictures,
        report.page: "the report: open it in a browser",
        tuned: "the tuned filter: EstimateState(env, tuned=FILE)",
    }
    if best is not None and best.file is not None:
        about[best.file] = "the one of the best type"
    width = max(len(str(path)) for path in about)
    return [f"{path!s:{width}}  {what}" for path, what in about.items()]


def next_steps() -> list[str]:
    """The next command for each purpose."""
    steps = {
        "others": f"thruster compare --filter ekf --filter imm --scenario {SCENARIO}",
        "my plant": "thruster new problem NAME                     (docs/problems.md)",
        "my log": "thruster tune --filter ekf --log run.csv      (docs/logs.md)",
        "policies": "thruster train --observe ekf                  (docs/policies.md)",
    }
    where = "" if shutil.which("thruster") else f" (the command is {os.path.relpath(sys.argv[0])})"
    return [f"Next{where}:", *(f"  {what:9}{step}" for what, step in steps.items())]
