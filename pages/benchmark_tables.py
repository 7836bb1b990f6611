"""Make the tables of docs/benchmarks.md: standard problems that others have solved, beside ours.

    python -m pages.benchmark_tables [PAGE] [--table NAME]...

The tables between the comments of PAGE, docs/benchmarks.md by default, are written anew, in some minutes. Every
run gives the same.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from pages.page import DOCS
from thruster_env.core.files import write_whole
from thruster_env.core.text_tables import markdown_table, with_tables
from tuning.evaluation.held_out import evaluate_held_out
from tuning.experiments import BENCHMARKS
from tuning.experiments.benchmark import find_benchmark
from tuning.experiments.lorenz63 import problem as lorenz63
from tuning.experiments.lorenz96 import tune_inflation
from tuning.experiments.pendulum import problem as pendulum
from tuning.search.plan import Plan
from tuning.search.study import open_study, quiet_optuna, run_study

RUNS, TRIALS = 16, 20


def published(name: str) -> str:
    """A standard problem: theirs, ours, why different."""
    benchmark = find_benchmark(name)
    remarks = "\n".join(f"- {remark}" for remark in benchmark.remarks)
    return f"{markdown_table(benchmark.header, [row.cells() for row in benchmark.reproduce(RUNS)])}\n\n{remarks}"


def inflation() -> str:
    """Inflation that a study finds on Lorenz-63."""
    rows = []
    for name in ("enkf", "etkf", "denkf"):
        choice, score = tune_inflation(name, lorenz63, TRIALS, RUNS)
        parameters = choice.numbers
        numbers = [
            f"{parameters['ensemble_size']}",
            f"{parameters['inflation']:.3f}",
            f"{parameters['relaxation']:.3f}",
        ]
        rows.append([name, *numbers, f"{score.value:.3f} [{score.low:.3f}, {score.high:.3f}]"])
    return markdown_table(["filter", "N", "inflation", "relaxation", "rmse.a on held-out seeds"], rows)


def pendulum_errors() -> str:
    """Filters of the pendulum before and after tuning."""
    quiet_optuna()
    rows = []
    for name in ("ekf", "ukf"):
        plan = Plan(name, (pendulum,))
        choice = run_study(open_study("pendulum", plan, None), plan, TRIALS).choice
        comparison = evaluate_held_out(choice, pendulum, 0)
        for word, evaluation in (("rule of thumb", comparison.untuned), ("tuned", comparison.tuned)):
            sigma = choice.model["sigma"] if word == "tuned" else pendulum.untuned["sigma"]
            errors = [f"{part.value:.3f} ± {(part.high - part.low) / 2:.3f}" for part in evaluation.rmse]
            rows.append(
                [
                    name,
                    word,
                    f"{sigma:.3f}",
                    *errors,
                    f"{evaluation.nees.value:.2f}",
                    f"{evaluation.nis.value:.2f}",
                ]
            )
    header = ["filter", "", "sigma [rad/s]", "theta [rad]", "omega [rad/s]", "mean NEES", "mean NIS"]
    return markdown_table(header, rows)


TABLES: dict[str, Callable[[], str]] = {
    **{name.replace("-", "_"): partial(published, name) for name in BENCHMARKS},
    "inflation": inflation,
    "pendulum": pendulum_errors,
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(prog="python -m pages.benchmark_tables", description=__doc__.splitlines()[0])
    parser.add_argument("page", nargs="?", type=Path, default=DOCS / "benchmarks.md", metavar="PAGE")
    parser.add_argument("--table", action="append", choices=list(TABLES), help="only this one; may be repeated")
    options = parser.parse_args(arguments)
    for name in options.table or TABLES:  # written one by one, so that what is done stays
        write_whole(options.page, with_tables(options.page.read_text(), {name: TABLES[name]}))


if __name__ == "__main__":
    main()
