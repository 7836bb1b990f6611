"""Make the tables of docs/ranking.md on moving-horizon estimation: where it is the right filter, and where not.

python -m pages.ranking_horizon [PAGE] [--table NAME]...
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from filters import StateSpaceModel, make_filter, run
from filters.filter import Filter
from filters.horizon.window import LOSSES, STUDENT
from pages.page import digits
from pages.ranking_tables import EKF, IEKF, ROBUST, SEEDS, leaderboard, main, ratio_cell
from thruster_env.core.streams import episode_keys, filter_keys
from thruster_env.core.text_tables import markdown_table
from thruster_env.model.simulate import simulate
from tuning.evaluation.compare import contender
from tuning.problems.seeds import held_out_seeds
from tuning.thruster.scenario import find_scenario

STEPS, SETTLED = 100, 20  # of a batch, of which errors count from a step on
POSITIVE = {0: (0.0, None), 1: (0.0, None)}


def react(x, u, c):
    """Partial pressures of A and B after 0.1 of a time unit of 2 A -> B at k = 0.16, solved exactly."""
    left = x[0] / (1.0 + 0.032 * x[0])
    return left, x[1] + 0.5 * (x[0] - left)


def total_pressure(x, c):
    """The sum of the pressures, which is measured."""
    return (x[0] + x[1],)


def reactor(prior_mean: Sequence[float], prior_cov: Sequence[float], **changes) -> StateSpaceModel:
    """A batch reactor, as its operator believes it to begin.

    Source: Haseltine, Rawlings (2005), "Critical evaluation of extended Kalman filtering and moving-horizon
    estimation", Industrial & Engineering Chemistry Research 44(8), section 4.1.
    """
    return StateSpaceModel(
        transition=react,
        observe=total_pressure,
        process_noise_cov=[1e-6, 1e-6],
        measurement_noise_cov=[0.01],
        prior_mean=prior_mean,
        prior_cov=prior_cov,
        inputs=0,
        **changes,
    )


def assumed(**changes) -> StateSpaceModel:
    """The reactor as filters assume it."""
    return reactor([0.1, 4.5], [36.0, 36.0], **changes)


def batches(count: int) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], np.ndarray]:
    """What `filters.run` takes of batches, and their states (count, K + 1, 2)."""
    seeds, inputs = held_out_seeds(0, count), np.zeros((count, STEPS, 0))
    truth = simulate(reactor([3.0, 1.0], [0.0, 0.0]), episode_keys(seeds), inputs)
    return (filter_keys(seeds), inputs, truth.measurements), truth.states


def batch_reactor() -> str:
    """A batch reactor whose initial pressures are far from what the filters assume."""
    arguments, states = batches(SEEDS)
    rows = []
    for label, filter_ in _of_reactor().items():
        estimates = run(filter_, *arguments)
        errors = estimates.means - states
        rmse = np.sqrt(np.square(errors[:, SETTLED:]).mean(axis=(0, 1)))
        lost = (np.abs(errors[:, -1]).max(axis=1) > 0.5).sum()
        row = [label, *map(digits, rmse), digits(estimates.means[:, 1:, 0].min()), f"{lost} of {SEEDS}"]
        rows.append(row)
    return markdown_table(["filter", "p_A", "p_B", "least p_A", "lost"], rows)


def _of_reactor() -> dict[str, Filter]:
    within = {by: assumed(bounds=POSITIVE, bounded_by=by) for by in ("truncation", "projection")}
    filters: dict[str, Filter] = {
        name: make_filter(name, assumed(), **numbers)
        for name, numbers in (("ekf", {}), ("iekf", {}), ("ukf", {}), ("enkf", {"ensemble_size": 100}))
    }
    for by, model in within.items():
        filters |= {f"{name}, bounded by {by}": make_filter(name, model) for name in ("ekf", "ukf")}
    filters["mhe without bounds"] = make_filter("mhe", assumed())
    for length in (5, 10, 30):
        filters[f"mhe, L = {length}"] = make_filter("mhe", within["projection"], horizon=length)
    filters["mhe, L = 30, Student's loss"] = make_filter("mhe", within["projection"], horizon=30, loss=STUDENT)
    return filters


def horizon() -> str:
    """Scenarios of the thruster, where a window of past states tells little."""
    filters = [EKF, IEKF, ROBUST, *(contender("mhe", loss=loss) for loss in LOSSES)]
    rows = []
    for name in ("outliers", "deadband", "startup", "published_noise", "nominal"):
        board = leaderboard(find_scenario(name), filters)
        for row in board.rows:
            first = row is board.rows[0]
            errors = (digits(error.value) for error in row.evaluation.rmse)
            cells = [f"`{name}`" if first else "", row.label, *errors, "" if first else ratio_cell(row)]
            rows.append([*cells, digits(row.nees)])
    return markdown_table(["scenario", "filter", "omega_m [rad/s]", "U_a [m/s]", "score over ekf", "NEES"], rows)


TABLES: dict[str, Callable[[], str]] = {table.__name__: table for table in (batch_reactor, horizon)}


if __name__ == "__main__":
    main(None, TABLES, "pages.ranking_horizon", __doc__)
