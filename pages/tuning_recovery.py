"""Make the tables of docs/tuning.md on what a study finds again where the model is perfect.

    python -m pages.tuning_recovery [FOLDER]

If there is a tuning.md in FOLDER, docs/ by default, its two tables are written anew, which takes two minutes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np

from filters.consistency.intervals import Interval
from pages.page import make_page
from thruster_env.core.text_tables import markdown_table
from tuning.evaluation.evaluate import score_ratio
from tuning.evaluation.held_out import evaluate_held_out
from tuning.likelihood.gradient import BAD_START
from tuning.likelihood.identifiability import Identifiability, identify
from tuning.search.plan import Plan
from tuning.search.space import Choice, oracle_choice, parameters_of
from tuning.search.study import open_study, quiet_optuna, run_study
from tuning.thruster.scenario import Scenario, find_scenario

STUDIES = ("ekf", "nominal", 100), ("kf", "published_tunnel", 100), ("kf", "published_open_bladed", 100)
SEEDS = range(8)  # of studies
EQUAL = 0.005  # a score this close to the true filter's is as good


class Found(NamedTuple):
    """What one study found."""

    over_true: np.ndarray  # (p,), numbers over the true ones
    score: Interval  # over that of the true filter, paired on held-out seeds
    known: Identifiability


def bad_start(kind: str, scenario: Scenario) -> Choice:
    """The true filter with a hundredth of Q22 and a hundred times R."""
    true = oracle_choice(kind, scenario)
    q, r = np.array(true.model["process_noise_cov"]), true.model["measurement_noise_cov"]
    bad = {"process_noise_cov": tuple((q * BAD_START[:2]).tolist()), "measurement_noise_cov": r * BAD_START[2]}
    return true._replace(model=bad)


@cache
def found_again(kind: str, name: str, trials: int, seeds: Sequence[int] = SEEDS) -> list[Found]:
    """What studies with several seeds find from the bad start."""
    quiet_optuna()
    scenario = find_scenario(name)
    true, recovered = parameters_of(oracle_choice(kind, scenario)), []
    for seed in seeds:
        plan = Plan(kind, (scenario,), seed)
        study = open_study("page", plan, None, bad_start(kind, scenario))
        choice = run_study(study, plan, trials).or_interrupted().choice
        comparison = evaluate_held_out(choice, scenario, seed)
        known = identify(choice, plan.scenarios, plan.training_data(), plan.space())
        ratios = known.tuned / [true[number] for number in known.names]
        recovered.append(Found(ratios, score_ratio(comparison.tuned, comparison.true), known))
    return recovered


def numbers_found() -> str:
    """Numbers over the true ones, and what the innovations determine."""
    rows = []
    for kind, name, trials in STUDIES:
        recovered = found_again(kind, name, trials)
        title = f"`{name}`, `{kind}`, {trials} trials"
        for i, number in enumerate(recovered[0].known.names):
            ratios = [study.over_true[i] for study in recovered]
            factors = [study.known.factors[i] for study in recovered if study.known.identified[i]]
            span, start = f"{min(ratios):.2g} to {max(ratios):.2g}", f"{BAD_START[i]:g}"
            within = f"within a factor of {max(factors):.2f}" if factors else "no"
            part = f" in {len(factors)} of {len(recovered)}" if 0 < len(factors) < len(recovered) else ""
            rows.append(["" if i else title, number, start, span, within + part])
    return markdown_table(["study", "", "start over true", "found over true", "determined"], rows)


def scores_reached() -> str:
    """Excess of the score over the true filter's."""
    rows = []
    for kind, name, trials in STUDIES:
        scores = sorted(study.score for study in found_again(kind, name, trials))
        median = np.median([score.value for score in scores])
        excess = [f"{100 * (value - 1):.2f} %" for value in (median, scores[-1].value)]
        worst = " to ".join(f"{100 * (end - 1):.2f}" for end in scores[-1][1:])
        count = sum(score.high < 1 + EQUAL for score in scores)
        title = f"`{name}`, `{kind}`, {trials} trials"
        rows.append([title, excess[0], f"{excess[1]} ({worst})", f"{count} of {len(scores)}"])
    return markdown_table(["study", "median excess of the score", "largest (95 %)", "surely below 0.5 %"], rows)


TABLES: dict[str, Callable[[], str]] = {table.__name__: table for table in (numbers_found, scores_reached)}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    make_page("tuning", "pages.tuning_recovery", {}, TABLES, __doc__.splitlines()[0], arguments)


if __name__ == "__main__":
    main()
