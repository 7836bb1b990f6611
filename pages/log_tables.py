"""Make the table of docs/logs.md: what tuning loses where the true states are hidden.

    python -m pages.log_tables [FOLDER]

If there is a logs.md in FOLDER, docs/ by default, its table is written anew, which takes two minutes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from pages.page import make_page
from thruster_env.core.text_tables import markdown_table
from tuning.experiments.hidden_truth import CASES, MANY_RUNS, RUNS, TRIALS, Hidden, hide_truth
from tuning.problems.find import find_problem


def hidden_truth(
    trials: int = TRIALS, cases: Sequence[tuple[str, str]] = CASES, runs: Sequence[int] = (RUNS, MANY_RUNS)
) -> str:
    """Score of filters tuned on logs over that of the same ones tuned with the truth."""
    rows = []
    for scenario, name in cases:
        comparisons = [hide_truth(name, find_problem(scenario), trials, runs=count) for count in runs]
        sizes = ", ".join(filter(None, [_size(comparisons[-1].seen), _size(comparisons[-1].blind)]))
        states = ", ".join(f"{ratio:.3f}" for ratio in comparisons[-1].rmse_ratios)
        rows.append([f"`{scenario}`", f"`{name}`", *map(_ratio, comparisons), states, sizes])
    counts = [f"{count} logs" for count in runs]
    return markdown_table(
        ["scenario", "filter", *counts, f"RMSE of each state, {counts[-1]}", "N, seen and hidden"], rows
    )


def _ratio(comparison: Hidden) -> str:
    ratio = comparison.ratio
    return f"{ratio.value:.3f} ({ratio.low:.3f} to {ratio.high:.3f})"


def _size(choice) -> str:
    return str(choice.numbers.get("ensemble_size", ""))


TABLES: dict[str, Callable[[], str]] = {"hidden_truth": hidden_truth}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    make_page("logs", "pages.log_tables", {}, TABLES, __doc__.splitlines()[0], arguments)


if __name__ == "__main__":
    main()
