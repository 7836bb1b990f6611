"""Make the tables of docs/ranking.md on other people's estimators: a recurrent network beside tuned filters.

    python -m pages.ranking_estimators [PAGE] [--table NAME]...

The networks are trained first, each in some minutes on one core, and kept in out/networks; this needs torch (the
extra "rl"). The filters are tuned anew each time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import NamedTuple

from filters.filter import Filter
from pages.ranking_tables import SEEDS, leaderboard, main, ratio_cell, table_of
from pages.tuning_mismatch import UNKNOWNS, tuned_augmented
from tuning.evaluation.compare import Contender, Row, contender
from tuning.search.plan import Plan
from tuning.search.space import Choice
from tuning.search.study import open_study, quiet_optuna, run_study
from tuning.thruster.find import find_scenario
from tuning.thruster.scenario import Scenario

TRIALS = 50
TRAINED_ON = ("mismatch", "outliers")
ELSEWHERE = (
    "nominal",
    "mismatch",
    "outliers",
    "dropout",
    "ambient",
    "bias",
    "deadband",
    "reversal",
    "medium_noise",
)
FILTERPY = "filters.estimators.filterpy:unscented"


def network_mismatch() -> str:
    """A wrong model: filters that believe in it, and a network that never saw it."""
    return _problem_of_network("mismatch")


def network_outliers() -> str:
    """Outliers."""
    return _problem_of_network("outliers")


def network_elsewhere() -> str:
    """Scores of the networks over that of the EKF, on scenarios of which they have seen none or one."""
    lines = [
        "| scenario | " + " | ".join(f"gru, trained on `{name}`" for name in TRAINED_ON) + " |",
        "|---" * (len(TRAINED_ON) + 1) + "|",
    ]
    for name in ELSEWHERE:
        networks = [_network(trained, f"gru {trained}") for trained in TRAINED_ON]
        _, *rows = leaderboard(find_scenario(name), [contender("ekf"), *networks]).rows
        lines.append(f"| `{name}` | {' | '.join(map(ratio_cell, rows))} |")
    return "\n".join(lines)


def filterpy() -> str:
    """FilterPy's unscented filter and ours, with the same sigma points."""
    lines = ["| scenario | filter | omega_m [rad/s] | U_a [m/s] | NEES | NIS | log L |", "|---" * 7 + "|"]
    for name in ("nominal", "mismatch"):
        peer = contender(FILTERPY)._replace(label="FilterPy's UKF")
        for row in leaderboard(find_scenario(name), [contender("ukf"), peer], 40).rows:
            lines.append(f"| `{name}` | {row.label} | {_nine_digits(row)} |")
    return "\n".join(lines)


def _problem_of_network(name: str) -> str:
    """The oracle EKF first, then the tuned filters and the network that has learnt from this scenario."""
    tuned = [
        Contender(f"{kind}, tuned", lambda problem, kind=kind: _tuned(kind, name)) for kind in ("ekf", "enkf")
    ]
    others = [contender("ekf-robust"), contender("enkf", ensemble_size=100)]
    oracles = [one._replace(label=f"{one.label}, oracle") for one in (contender("ekf"), *others)]
    told = [RIGHT, LEARNING] if name == "mismatch" else []
    found = leaderboard(find_scenario(name), [*oracles, *tuned, *told, _network(name, "gru 32")], SEEDS)
    return table_of(found)


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


def _network(name: str, label: str) -> Contender:
    from pages.ranking_network import trained_on  # torch takes seconds to import

    return contender(trained_on(name))._replace(label=label)


def _nine_digits(row: Row) -> str:
    found = row.evaluation
    values = [*(one.value for one in found.rmse), found.nees.value, found.nis.value, found.log_likelihood]
    return " | ".join(f"{value:.9g}" for value in values)


TABLES: dict[str, Callable[[], str]] = {
    table.__name__: table for table in (network_mismatch, network_outliers, network_elsewhere, filterpy)
}


def run_main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    main(arguments, TABLES, "pages.ranking_estimators", __doc__)


if __name__ == "__main__":
    run_main()
