"""Make the table of docs/tuning.md on pruning: whether studies with and without it end at the same score.

    python -m pages.tuning_pruning [FOLDER]

Wilcoxon's test ranks the scores of single runs, the objective pools the squares of all: where few runs carry the
error, the two could disagree. If there is a tuning.md in FOLDER, docs/ by default, its table is written anew,
which takes some ten minutes. Every run gives the same.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from optuna.trial import TrialState
from scipy.stats import t as student

from filters.consistency.intervals import Interval
from pages.page import make_page
from thruster_env.core.text_tables import markdown_table
from tuning.evaluation.evaluate import evaluate, score_ratio
from tuning.search.plan import HELD_OUT_SEEDS, TRAINING_SEEDS, Plan
from tuning.search.space import choice_of
from tuning.search.study import open_study, quiet_optuna, run_study
from tuning.search.trials import measure
from tuning.thruster.scenario import find_scenario

CASES = ("startup", "ekf"), ("startup", "enkf"), ("outliers", "ekf"), ("outliers", "enkf"), ("mismatch", "ekf")
SEEDS, TRIALS = range(10), 60
TOP_RUNS = 3  # of the training runs, whose part in the squares is told


class Pair(NamedTuple):
    """One study with pruning and the same without."""

    ratio: float  # score of what the one chose over that of the other, on the same held-out seeds
    pruned: int  # trials that ended early
    missed: int  # of them, those whose score on all training seeds is below the best of their study
    gain: float  # the lowest of those scores over that best; 1 where none is below
    skipped: float  # share of the runs that pruning saved
    concentration: (
        float  # share of the squares that the worst runs of the best trial carry, the larger of the states'
    )


def pair(kind: str, name: str, trials: int, seed: int) -> Pair:
    """Run a study of a filter on a scenario with pruning and without, and score again what was pruned."""
    scenario, results = find_scenario(name), {}
    for prune in (True, False):
        plan = Plan(kind, (scenario,), seed, prune=prune)
        results[prune] = run_study(open_study("page", plan, None), plan, trials)
    held_out, training = scenario.data(scenario.held_out_seeds(seed, HELD_OUT_SEEDS)), plan.training_data()
    pruning, without = (
        evaluate(results[prune].choice.filter(scenario), held_out, scenario.scale) for prune in (True, False)
    )
    early = [
        trial for trial in results[True].trials if trial.state == TrialState.PRUNED and trial.intermediate_values
    ]
    best = results[True].best_value
    full_scores = [
        measure(choice_of(kind, trial.params, scenario), plan, training)[0].score.value for trial in early
    ]
    (chosen,) = measure(results[True].choice, plan, training)
    worst = np.sort(chosen.mean_squares, axis=0)[-TOP_RUNS:].sum(axis=0) / chosen.mean_squares.sum(axis=0)
    return Pair(
        score_ratio(pruning, without).value,
        len(early),
        sum(value < best for value in full_scores),
        min([1.0, *(value / best for value in full_scores)]),
        sum(TRAINING_SEEDS - len(trial.intermediate_values) for trial in early) / (TRAINING_SEEDS * trials),
        float(worst.max()),
    )


def over_studies(ratios: Sequence[float]) -> Interval:
    """Geometric mean of ratios of independent studies, with Student's 95 % interval of their logarithms."""
    logs = np.log(ratios)
    half = student.ppf(0.975, len(logs) - 1) * logs.std(ddof=1) / len(logs) ** 0.5
    return Interval(*np.exp([logs.mean(), logs.mean() - half, logs.mean() + half]))


def pruning() -> str:
    """With pruning over without, a row per filter and scenario."""
    quiet_optuna()
    rows = []
    for name, kind in CASES:
        pairs = [pair(kind, name, TRIALS, seed) for seed in SEEDS]
        ratios = [study_pair.ratio for study_pair in pairs]
        ratio = over_studies(ratios)
        count = sum(study_pair.pruned for study_pair in pairs)
        rows.append(
            [
                f"`{name}`",
                f"`{kind}`",
                f"{100 * np.mean([study_pair.concentration for study_pair in pairs]):.0f} %",
                f"{ratio.value:.4f} [{ratio.low:.4f}, {ratio.high:.4f}]",
                f"{min(ratios):.3f} to {max(ratios):.3f}",
                f"{sum(study_pair.missed for study_pair in pairs)} of {count}",
                f"{100 * (1 - min(study_pair.gain for study_pair in pairs)):.2f} %",
                f"{100 * np.mean([study_pair.skipped for study_pair in pairs]):.0f} %",
            ]
        )
    header = ["scenario", "filter", f"squares in {TOP_RUNS} of {TRAINING_SEEDS} runs", "with over without"]
    return markdown_table([*header, "single studies", "better ones pruned", "by at most", "runs saved"], rows)


TABLES: dict[str, Callable[[], str]] = {"pruning": pruning}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    make_page("tuning", "pages.tuning_pruning", {}, TABLES, __doc__.splitlines()[0], arguments)


if __name__ == "__main__":
    main()
