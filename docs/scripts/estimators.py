"""The tables of docs/appendix/ranking.md on estimators of other packages and on those with a network.

The networks are trained first, each in some minutes on one core, and stored in out/estimators; this needs the
extra "learned". The filters are tuned each time.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from docs.scripts import by_name, digits
from docs.scripts.ranking import SEEDS, leaderboard, marked, ratio_cell, table_of
from docs.scripts.tuning import UNKNOWNS, tuned_augmented
from filters.filter import Filter
from filters.registry import make_filter
from thruster_env.core.text_tables import markdown_table
from tuning.api.train_estimator import FOLDER, train_estimator
from tuning.evaluation.compare import Contender, Row, contender
from tuning.evaluation.evaluate import evaluate
from tuning.plants.thruster import Scenario, find_scenario
from tuning.problems.check import data_of
from tuning.problems.data import held_out_seeds
from tuning.problems.problem import Problem
from tuning.search.plan import Plan
from tuning.search.space import Choice
from tuning.search.storage import quiet_optuna
from tuning.search.study import open_study, run_study

TRIALS = 50
TRAINED_ON = ("mismatch", "outliers")
TRAININGS: dict[str, dict[str, Any]] = {
    "gru": {"runs": 512, "steps": 2000, "batch": 64, "window": 150, "options": {"width": 32}},
    "kalmannet": {"runs": 512},
    "recursive-kalmannet": {"runs": 512},
    "differentiable-enkf": {"runs": 512, "steps": 200, "window": 20},
}
PAPERS = {"runs": 1000, "steps": 600, "batch": 30, "window": 100, "rate": 1e-3}  # of the paper, but for the steps
ELSEWHERE = "nominal mismatch outliers dropout ambient bias deadband reversal medium_noise".split()
FILTERPY = "filters.estimators.libraries:unscented"


def network_mismatch() -> str:
    """A wrong model: filters that believe in it, and networks, of which one never saw it."""
    return _problem_of_network("mismatch")


def network_outliers() -> str:
    """Outliers."""
    return _problem_of_network("outliers")


def network_elsewhere() -> str:
    """Scores over the EKF's, on scenarios of which an estimator has seen none or one; a dash where it refuses."""
    pairs = [("gru", "mismatch"), ("gru", "outliers"), ("kalmannet", "outliers")]
    rows = []
    for name in ELSEWHERE:
        networks = {pair: _network(pair[1], pair[0])._replace(label=" ".join(pair)) for pair in pairs}
        accepted = [network for pair, network in networks.items() if pair[0] == "gru" or name != "mismatch"]
        _, *scored = leaderboard(find_scenario(name), [contender("ekf"), *accepted]).rows
        cells = {row.label: ratio_cell(row) for row in scored}
        rows.append([f"`{name}`", *(cells.get(" ".join(pair), "-") for pair in pairs)])
    return markdown_table(["scenario", *(f"{kind}, trained on `{name}`" for kind, name in pairs)], rows)


def network_further() -> str:
    """Scores over the tuned EKF's on held-out runs, on runs twice as long, and with four times the R."""
    from tuning.learning import HELD_OUT, LONGER, NOISIER, standings

    rows = []
    for name in TRAINED_ON:
        problem = find_scenario(name)
        filters = {"ekf, tuned": _tuned("ekf", name).filter(problem)}
        filters |= {"ekf-robust, oracle": contender("ekf-robust").filter(problem)}
        filters |= {kind: _network(name, kind).filter(problem) for kind in TRAININGS}
        first, *further = standings(filters, problem, held_out_seeds(0, SEEDS))
        for number, standing in enumerate(further):
            ratios = (standing.ratio(first, runs) for runs in (HELD_OUT, LONGER, NOISIER))
            nees = standing.evaluations[HELD_OUT].nees.value
            cells = [*map(marked, ratios), "" if np.isnan(nees) else digits(nees)]
            rows.append(["" if number else f"`{name}`", standing.label, *cells])
    return markdown_table(["scenario", "filter", HELD_OUT, LONGER, NOISIER, "NEES"], rows)


def network_papers() -> str:
    """The settings of the paper on KalmanNet: mean square errors in dB."""
    from tuning.experiments import kalmannet

    settings_of, rows = {"differentiable-enkf": {"steps": 100, "window": 20}}, []
    for problem in (kalmannet.linear, kalmannet.lorenz):
        data = data_of(problem, problem.held_out_seeds(0, SEEDS))
        oracle_of = contender("ekf").filter(problem)
        filters = {"ekf, oracle": oracle_of} | {
            kind: make_filter(_trained(kind, problem, PAPERS | settings_of.get(kind, {})), problem.model())
            for kind in TRAININGS
        }
        evaluations = [evaluate(filter_, data, problem.scale) for filter_ in filters.values()]
        rows.append([problem.name, *(digits(decibels(evaluation.mean_squares)) for evaluation in evaluations)])
    return markdown_table(["setting", "ekf, oracle", *TRAININGS], rows)


def decibels(mean_squares: np.ndarray) -> float:
    """Mean square errors of runs and states, (B, n), as one figure in dB."""
    return float(10.0 * np.log10(np.mean(mean_squares)))


def filterpy() -> str:
    """FilterPy's unscented filter and ours, with the same sigma points."""
    lines = ["| filter | omega_m [rad/s] | U_a [m/s] | NEES | NIS | log L |", "|---" * 6 + "|"]
    peer = contender(FILTERPY)._replace(label="FilterPy's UKF")
    for row in leaderboard(find_scenario("nominal"), [contender("ukf"), peer], 40).rows:
        lines.append(f"| {row.label} | {_nine_digits(row)} |")
    return "\n".join(lines)


def _problem_of_network(name: str) -> str:
    """The oracle EKF first, then the tuned filters and the network that has learnt from this scenario."""
    tuned = [
        Contender(f"{kind}, tuned", lambda problem, kind=kind: _tuned(kind, name)) for kind in ("ekf", "enkf")
    ]
    alternatives = [contender("ekf-robust"), contender("enkf", ensemble_size=100)]
    oracles = [filter_._replace(label=f"{filter_.label}, oracle") for filter_ in (contender("ekf"), *alternatives)]
    informed = [RIGHT, LEARNING] if name == "mismatch" else []
    networks = [_network(name, kind) for kind in TRAININGS]
    return table_of(leaderboard(find_scenario(name), [*oracles, *tuned, *informed, *networks], SEEDS))


class _Made(NamedTuple):
    """A filter that more than a `Choice` makes."""

    make: Callable[[Scenario], Filter]

    def filter(self, scenario: Scenario) -> Filter:
        return self.make(scenario)


def _learning(scenario: Scenario) -> Filter:
    return tuned_augmented(scenario, UNKNOWNS["lift and K2"], [_tuned("ekf", scenario.name)], 2 * TRIALS)


# What a filter does that is told the plant's parameters, or that two of them are uncertain.
RIGHT = Contender("ekf, right model", lambda problem: Choice("ekf", {**problem.true, "parameter_factors": {}}, {}))
LEARNING = Contender("ekf + lift and K2, tuned", lambda problem: _Made(_learning))


@lru_cache(maxsize=8)
def _tuned(kind: str, name: str) -> Choice:
    """What a study of a scenario, on the training seeds that studies have, makes of a filter."""
    quiet_optuna()
    plan = Plan(kind, (find_scenario(name),), consistent=False)
    return run_study(open_study("page", plan, None), plan, TRIALS).choice


def _network(name: str, kind: str) -> Contender:
    return contender(_trained(kind, find_scenario(name), TRAININGS[kind]))._replace(label=kind)


def _trained(kind: str, problem: Problem, arguments: dict[str, Any]) -> str:
    """The file of an estimator trained on a problem; trained now if there is none."""
    file = FOLDER / f"{kind}-{problem.name}.safetensors"
    if not file.exists():
        train_estimator(kind, problem, out=file, seeds=2, progress=True, **arguments)
    return str(file)


def _nine_digits(row: Row) -> str:
    evaluation = row.evaluation
    intervals = *evaluation.rmse, evaluation.nees, evaluation.nis
    values = [*(interval.value for interval in intervals), evaluation.log_likelihood]
    return " | ".join(f"{value:.9g}" for value in values)


TABLES = by_name(
    *(network_mismatch, network_outliers, network_elsewhere, network_further, network_papers), filterpy
)
