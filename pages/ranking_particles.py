"""Make the tables of docs/ranking.md on kinds of particles: fewer states sampled, or sampled better.

    python -m pages.ranking_particles [PAGE] [--table NAME]...

All take a minute or two on two cores. Every run gives the same.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.stats import chi2

from filters import Unknown, make_filter, run
from filters.consistency.intervals import rmse_intervals
from filters.consistency.nees import whitened
from pages.page import DOCS
from pages.ranking_tables import leaderboard, main, table_of
from thruster_env.core.text_tables import markdown_table
from tuning.evaluation.compare import contender
from tuning.experiments import mixed_linear
from tuning.problems.model_problem import ModelProblem
from tuning.problems.seeds import held_out_seeds
from tuning.thruster.scenario import find_scenario

SEEDS = 200
Numbers = dict[str, object]
KINDS: list[tuple[str, Numbers]] = [
    ("pf", {"ensemble_size": 100, "proposal": "optimal"}),
    ("pf", {"ensemble_size": 1000, "proposal": "optimal"}),
    ("pf", {"ensemble_size": 1000, "resampling": "gaussian", "resampling_threshold": 1.0}),
]


def conditional() -> str:
    """A model that is linear where one state is known."""
    filters: list[tuple[str, Numbers]] = [("ekf", {}), ("ukf", {})]
    filters += [("pf", {"ensemble_size": size}) for size in (100, 300, 1000, 10_000)]
    filters += [("rbpf", {"ensemble_size": size}) for size in (30, 100, 1000)]
    return errors_of(mixed_linear.problem, [*filters, *KINDS])


def accurate() -> str:
    """The same with accurate sensors."""
    filters: list[tuple[str, Numbers]] = [("ekf", {}), ("ukf", {}), ("enkf", {"ensemble_size": 100})]
    filters += [("pf", {"ensemble_size": size}) for size in (100, 1000, 10_000)]
    filters += [("apf", {"ensemble_size": 1000}), *KINDS, ("rbpf", {"ensemble_size": 100})]
    return errors_of(mixed_linear.problem_of(mixed_linear.model(1e-3)), filters)


def constants() -> str:
    """A flow that is a further state, constant, for particles whose copies stay together or are smoothed."""
    known = {"ambient_velocity": Unknown(std=1.0)}
    filters = [contender("ekf", unknown=known), contender("enkf", unknown=known, ensemble_size=100)]
    for size in (300, 1000):
        filters.append(contender("pf", unknown=known, ensemble_size=size))
        smoothed = contender("pf", unknown=known, ensemble_size=size, smoothed=(-1,), regularisation=1.0)
        filters.append(smoothed._replace(label=f"pf {size} smoothed + U_0"))
    return table_of(leaderboard(find_scenario("ambient"), filters))


def errors_of(problem: ModelProblem, filters: list[tuple[str, Numbers]]) -> str:
    """RMSE by state, the median NEES and the log-likelihood, a row per filter."""
    data, model = problem.data(held_out_seeds(0, SEEDS)), problem.model()
    symbols = [state.symbol for state in model.states]
    rows = []
    for name, numbers in filters:
        estimates = run(make_filter(name, model, **numbers), data.filter_keys, data.inputs, data.measurements)
        errors, covs = (estimates.means - data.states)[:, data.late], estimates.covs[:, data.late]
        parts = rmse_intervals(np.square(errors).mean(axis=1))
        squares = np.square(whitened(errors, covs)).sum(axis=-1)
        nees = np.median(np.where(np.isnan(squares), np.inf, squares))  # of a singular P: no error is within it
        level = estimates.log_likelihoods[:, data.late].sum(axis=1).mean()
        label = " ".join([name, *(str(value) for key, value in numbers.items() if key != "resampling_threshold")])
        cells = [f"{part.value:.3f} ± {(part.high - part.low) / 2:.3f}" for part in parts]
        rows.append([label, *cells, f"{nees / chi2.median(model.n):.2f}", f"{level:.1f}"])
    return markdown_table(["filter", *symbols, "NEES", "log L"], rows)


TABLES: dict[str, Callable[[], str]] = {table.__name__: table for table in (conditional, accurate, constants)}

if __name__ == "__main__":
    main(None, TABLES, "pages.ranking_particles", __doc__, DOCS / "ranking.md")
