"""The loss of tuning without true states: from logs of a simulation, and with its truth; two minutes."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np

from filters.consistency.nees import Interval
from thruster_env.core.text_tables import markdown_table
from thruster_env.logs.log import Log
from tuning.evaluation.evaluate import Evaluation, evaluate, score_ratio
from tuning.experiments.benchmark import run_in_memory
from tuning.problems.find import find_problem
from tuning.problems.log_problem import LogProblem
from tuning.problems.problem import Problem
from tuning.search.plan import HELD_OUT_SEEDS, Plan
from tuning.search.space import Choice

TRIALS = 60
RUNS, MANY_RUNS = 96, 300  # logs, two thirds of which are for training
FILTERS = ("kf", "ekf", "enkf")
CASES = (*product(("nominal", "outliers"), FILTERS), ("published_tunnel", "kf"))


class Hidden(NamedTuple):
    """Two studies of one filter on the same runs, both evaluated on the same held-out seeds with truth."""

    seen: Choice  # of the study with true states
    blind: Choice  # of the study on logs without them
    seen_evaluation: Evaluation
    blind_evaluation: Evaluation

    @property
    def ratio(self) -> Interval:
        """Score of the study without truth over that with truth, paired: 1 where the truth has no effect."""
        return score_ratio(self.blind_evaluation, self.seen_evaluation)

    @property
    def rmse_ratios(self) -> np.ndarray:
        """RMSE of the study without truth over that with truth, (n,), by state."""
        pairs = zip(self.blind_evaluation.rmse, self.seen_evaluation.rmse, strict=True)
        return np.array([blind.value / informed.value for blind, informed in pairs])


def logs_of(problem: Problem, seed: int = 0, count: int = RUNS) -> list[Log]:
    """Logs of runs with a problem's training seeds: inputs and measurements only."""
    data, model, dt = problem.data(problem.training_seeds(seed, count)), problem.model(), problem.dt
    if dt is None:
        raise ValueError(f"logs must have a sample time, but problem {problem.name} has none")
    return [
        Log(f"run{i}", dt, inputs, measurements, model.input_quantities, model.measurements)
        for i, (inputs, measurements) in enumerate(zip(data.inputs, data.measurements, strict=True))
    ]


def hide_truth(
    filter_name: str,
    problem: Problem,
    trials: int = TRIALS,
    seed: int = 0,
    runs: int = RUNS,
    held_out: int = HELD_OUT_SEEDS,
) -> Hidden:
    """Tune a filter on a problem with its truth, and on logs of the same runs without it.

    Args:
        filter_name: name of the filter.
        problem: a problem with truth.
        trials: number of trials of each study.
        seed: seed of both studies.
        runs: number of logs, every third of which is held out by their problem; the study with truth has 32 runs.
        held_out: number of held-out seeds of the problem for the evaluation of both.
    """
    blind_problem = LogProblem(logs_of(problem, seed, runs), problem.model(), blocks=1, name="logs")
    plans = Plan(filter_name, (problem,), seed), Plan(filter_name, (blind_problem,), seed, ("likelihood",))
    informed, blind = (run_in_memory(plan, trials).choice for plan in plans)
    data = problem.data(problem.held_out_seeds(seed, held_out))
    by_seen, by_blind = (evaluate(choice.filter(problem), data, problem.scale) for choice in (informed, blind))
    return Hidden(informed, blind, by_seen, by_blind)


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


TABLES = {"hidden_truth": hidden_truth}
