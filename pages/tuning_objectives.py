"""Make the table of docs/tuning.md on objectives: what a study of the log score costs in error, and what it earns.

    python -m pages.tuning_objectives [FOLDER]

If there is a tuning.md in FOLDER, docs/ by default, its table is written anew, which takes some three minutes.
Every run gives the same.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from filters.consistency.intervals import Interval
from pages.page import make_page
from thruster_env.core.text_tables import markdown_table
from tuning.evaluation.evaluate import Evaluation, evaluate, score_ratio
from tuning.search.objectives import LOG_SCORE, nees_ratio, nis_ratio
from tuning.search.plan import HELD_OUT_SEEDS, Plan
from tuning.search.study import open_study, quiet_optuna, run_study
from tuning.thruster.scenario import find_scenario

SCENARIOS = "nominal", "published_tunnel", "outliers", "mismatch", "startup"
SEEDS, TRIALS, FILTER = range(5), 40, "ekf"


class Pair(NamedTuple):
    """Filters that two studies chose, on the same held-out seeds."""

    score: Evaluation  # of the score, with the mean NIS in its band
    log_score: Evaluation

    @property
    def ratio(self) -> Interval:
        """Score of the second over that of the first."""
        return score_ratio(self.log_score, self.score)


def pair(name: str, seed: int, trials: int = TRIALS) -> Pair:
    """Run a study of the score and one of the log score, of the same seed."""
    scenario = find_scenario(name)
    held_out = scenario.data(scenario.held_out_seeds(seed, HELD_OUT_SEEDS))
    evaluations = []
    for objective in ("score", LOG_SCORE):
        plan = Plan(FILTER, (scenario,), seed, (objective,))
        choice = run_study(open_study("page", plan, None), plan, trials).choice
        evaluations.append(evaluate(choice.filter(scenario), held_out, scenario.scale))
    return Pair(*evaluations)


def objectives() -> str:
    """Score, NEES and NIS by either objective, a row a scenario: medians over studies, and all ratios."""
    quiet_optuna()
    rows = []
    for name in SCENARIOS:
        pairs = [pair(name, seed) for seed in SEEDS]
        ratios = [study_pair.ratio.value for study_pair in pairs]
        cells = [f"{np.median(ratios):.3f}", f"{min(ratios):.3f} to {max(ratios):.3f}"]
        for ratio in (nees_ratio, nis_ratio):
            for index in range(2):
                cells.append(f"{np.median([ratio(study_pair[index]) for study_pair in pairs]):.3g}")
        rows.append([f"`{name}`", *cells])
    heads = ["scenario", "score, log score over score", "single studies", "NEES, by score", "by log score"]
    return markdown_table([*heads, "NIS, by score", "by log score"], rows)


TABLES: dict[str, Callable[[], str]] = {"objectives": objectives}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    make_page("tuning", "pages.tuning_objectives", {}, TABLES, __doc__.splitlines()[0], arguments)


if __name__ == "__main__":
    main()
