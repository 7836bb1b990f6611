"""What a study is for: two studies of the same plan are one study."""

from __future__ import annotations

from typing import NamedTuple

import optuna
from optuna.distributions import BaseDistribution

from filters.registry import filter_class
from tuning.objectives import Objective, find_objective
from tuning.scenarios import Data, Scenario, held_out_seeds, training_seeds
from tuning.space import distributions, has_search_space

TRAINING_SEEDS = 32
HELD_OUT_SEEDS = 200


class Plan(NamedTuple):
    """A filter, what to tune it on, what to make small and how to search."""

    filter: str
    scenarios: tuple[Scenario, ...]
    seed: int = 0
    objectives: tuple[str, ...] = ("score",)
    consistent: bool = True  # whether the mean NIS has to be within its band
    sampler: str = "tpe"
    hold_r: bool = False  # whether R stays that of the sensor's sheet
    prune: bool = True  # whether a trial ends early that is worse than the best one on the same seeds

    @property
    def identity(self) -> dict:
        """What has to be the same for a study to go on."""
        return {
            "filter": self.filter,
            "scenarios": [scenario.name for scenario in self.scenarios],
            "seed": self.seed,
            "objectives": list(self.objectives),
            "consistent": self.consistent,
            "sampler": self.sampler,
            "hold_r": self.hold_r,
            "optuna": optuna.__version__.split(".")[0],
        }

    @property
    def is_constrained(self) -> bool:
        """Whether the mean NIS is held in its band: a filter without a covariance has none."""
        return self.consistent and filter_class(self.filter).has_covariance

    def checked(self) -> Plan:
        """The same plan; ValueError where it cannot work."""
        if not has_search_space(self.filter):
            raise ValueError(f"filter must be one that has something to tune, but got {self.filter!r}")
        if not self.scenarios:
            raise ValueError("a study must have at least one scenario, but got none")
        if not 1 <= len(self.objectives) <= 2 or len(set(self.objectives)) < len(self.objectives):
            raise ValueError(f"objectives must be one, or two different ones, but got {list(self.objectives)}")
        for name, objective in zip(self.objectives, self.found_objectives(), strict=True):
            if objective.needs_covariance and not filter_class(self.filter).has_covariance:
                raise ValueError(
                    f"the objective {name!r} needs a filter with a covariance, but got {self.filter!r}"
                )
        return self

    def found_objectives(self) -> list[Objective]:
        """The objectives themselves."""
        return [find_objective(name) for name in self.objectives]

    def space(self) -> dict[str, BaseDistribution]:
        """What a trial may choose, by name; ranges are those of the first scenario."""
        return distributions(self.filter, self.scenarios[0], hold_r=self.hold_r)

    def training_data(self) -> list[Data]:
        """Data that every trial shares, one for each scenario."""
        return [scenario.data(training_seeds(self.seed, TRAINING_SEEDS)) for scenario in self.scenarios]

    def held_out_seeds(self, count: int = HELD_OUT_SEEDS) -> range:
        """Seeds that no trial sees."""
        return held_out_seeds(self.seed, count)
