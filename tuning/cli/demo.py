"""`thruster demo`: tune a filter, evaluate it on held-out data, report it."""

from __future__ import annotations

import os
import shutil
import sys
import time
import warnings
from pathlib import Path
from typing import Annotated

from thruster_env.core.text_tables import Table
from tuning.api.markers import OUTPUT, RUNS, Option, Seed
from tuning.api.progress import working
from tuning.api.report import Report
from tuning.api.report import report as write_report
from tuning.api.result import INTERRUPTED, Printed
from tuning.api.study import Study
from tuning.api.tune import run_tuning
from tuning.cli.output import progress_console
from tuning.evaluation.evaluate import score_ratio
from tuning.plants.thruster import find_scenario
from tuning.reporting.tables import comparison_table
from tuning.reporting.tuning_report import as_json
from tuning.search.plan import TRAINING_SEEDS, Plan
from tuning.search.space import AUTO

FILTER, SCENARIO = "ekf", "outliers"  # where tuning Q and R is worth most: docs/tuning.md
BUDGET = 1.0  # us/step of the filters among which the second study chooses


def command(
    out: Annotated[Path, Option(OUTPUT)] = Path("out"),
    trials: Annotated[int, Option(RUNS)] = 50,
    seed: Seed = 0,
) -> Printed:
    """Tune an extended Kalman filter, evaluate it on held-out seeds, write its report.

    One thrust in twenty is off by some 10 N, which the sensor's data sheet does not mention. Table and page
    compare the tuned filter with four others on the same 200 held-out runs. A second study chooses the filter
    type, too, among all that take at most a microsecond a step.

    Args:
        out: folder of the report and the tuned files.
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
        report = write_report(file, out, storage=storage, progress=False)
    seconds = time.perf_counter() - started
    data = {
        "tuning": as_json(tuning),
        "best_type": None if best is None else as_json(best),
        "advice": report.advice,
        "report": str(report.page),
        "seconds": seconds,
    }
    output = [*result(tuning, best, report, seconds), *files(file, best, report), *next_steps()]
    return Printed(output, data, INTERRUPTED if best is None or best.result.interrupted else 0)


def best_type(plan: Plan, trials: int, storage: str, out: Path) -> Study:
    """A study of the filter type and its parameters, within the budget, on the same runs."""
    plan = plan._replace(filter=AUTO, budget=BUDGET)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # few trials: a demo is short
        file = out / f"{AUTO}-{SCENARIO}-seed{plan.seed}.json"
        return run_tuning(plan, trials, progress_console, storage, out=file)


def result(tuning: Study, best: Study | None, report: Report, seconds: float) -> list[str | Table]:
    """What was tuned on what, the errors before and after, and one sentence on the gain."""
    outcome, comparison = tuning.result, tuning.comparison
    stopped = ", interrupted," if outcome.interrupted else ""
    evaluations, advice = dict(comparison.evaluations), []
    if best is not None:
        evaluations[f"auto: {best.result.choice.name}"] = best.comparison.tuned
        advice.append(advice_on_type(tuning, best))
    where = f"{len(comparison.seeds)} held-out runs"
    return [
        f"An extended Kalman filter (EKF) where {tuning.problem.about}: {outcome.finished} trials{stopped} on "
        f"{TRAINING_SEEDS} runs, evaluated on {len(comparison.seeds)} others, in {seconds:.0f} s.",
        report.advice,
        "",
        comparison_table(evaluations, comparison.bound, where),
        *advice,
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


def files(tuned: Path, best: Study | None, report: Report) -> list[str]:
    """The paths of all files."""
    about = {
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
