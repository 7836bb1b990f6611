"""`Plan`: what a study is for. Two studies with the same plan are the same study.

NIS is the normalised innovation squared.
"""

from __future__ import annotations

from typing import NamedTuple

import optuna
from optuna.distributions import BaseDistribution

from filters.registry import filter_class
from numerics.checks import positive, shown
from tuning.problems.data import Data
from tuning.problems.parameter import Parameter
from tuning.problems.problem import Problem
from tuning.search.objectives import Objective, check_objectives, find_objective
from tuning.search.space import AUTO, AUTO_FILTER_TYPES, has_search_space, joint_distributions, joint_parameters

TRAINING_SEEDS = 32
HELD_OUT_SEEDS = 200
SIZE_SEEDS = 100  # enough to distinguish an ensemble that is 1 % worse than the best, as N = 30 from N = 50


class Plan(NamedTuple):
    """A filter, what to tune it on, what to minimise and how to search."""

    filter: str  # a name, or "auto" for the best of many filter types
    scenarios: tuple[Problem, ...]
    seed: int = 0
    objectives: tuple[str, ...] = ("score",)
    consistent: bool = True  # whether the mean NIS has to be within its band
    sampler: str = "tpe"
    hold_r: bool = False  # whether R stays that of the sensor's data sheet
    prune: bool = True  # whether a trial is pruned that is worse than the best one on the same seeds
    budget: float | None = None  # us/step that the filter may take, as `cost.microseconds_a_step` measures them
    full_q: bool = False  # whether Q has correlations

    @property
    def identity(self) -> dict:
        """What has to be the same for a study to be continued."""
        return {
            "filter": self.filter,
            "kinds": list(self.filter_types),
            "budget": self.budget,
            "full_q": self.full_q,
            "scenarios": [scenario.name for scenario in self.scenarios],
            "scenario_digests": [scenario.digest for scenario in self.scenarios],
            "seed": self.seed,
            "objectives": list(self.objectives),
            "consistent": self.consistent,
            "sampler": self.sampler,
            "hold_r": self.hold_r,
            "optuna": optuna.__version__.split(".")[0],
        }

    @property
    def filter_types(self) -> tuple[str, ...]:
        """Names of the filters among which a trial chooses."""
        return AUTO_FILTER_TYPES if self.filter == AUTO else (self.filter,)

    @property
    def is_constrained(self) -> bool:
        """Whether the mean NIS has to be within its band: a filter without a covariance has no NIS."""
        return self.consistent and self._has_covariance

    @property
    def _has_covariance(self) -> bool:
        return all(filter_class(name).has_covariance for name in self.filter_types)

    @property
    def asks_for_cost(self) -> bool:
        """Whether the cost of a step has to be measured."""
        return self.budget is not None or "cost" in self.objectives

    def checked(self) -> Plan:
        """The same plan; ValueError for one that cannot work."""
        if not all(map(has_search_space, self.filter_types)):
            raise ValueError(f"filter must be one that has something to tune, but got {self.filter!r}")
        if not self.scenarios:
            raise ValueError("a study must have at least one scenario, but got none")
        self._check_problems()
        if not 1 <= len(self.objectives) <= 2 or len(set(self.objectives)) < len(self.objectives):
            raise ValueError(f"objectives must be one, or two different ones, but got {list(self.objectives)}")
        for name, objective in zip(self.objectives, self.found_objectives(), strict=True):
            if objective.needs_covariance and not self._has_covariance:
                raise ValueError(
                    f"the objective {name!r} needs a filter with a covariance, but got {self.filter!r}"
                )
        for problem in self.scenarios:
            check_objectives(self.objectives, problem)
        parameters = self.scenarios[0].parameters
        if parameters is not None and (self.full_q or self.hold_r):
            names = ", ".join(one.name for one in parameters)
            raise ValueError(
                f"a full Q or an R that is held must be asked of a problem that tunes Q and R, but "
                f"{self.scenarios[0].name} tunes {names}"
            )
        if self.full_q and not self._has_covariance:
            raise ValueError(f"a full Q needs a filter with a covariance, but got {self.filter!r}")
        if self.budget is not None:
            positive("budget", self.budget)
        elif self.filter == AUTO and "cost" not in self.objectives:
            raise ValueError(
                "a study of filter 'auto' must have a budget of microseconds a step (an ekf takes about 0.1, an "
                "enkf of 30 members 0.7, a pf of 1000 particles 20) or the objective 'cost', but got neither"
            )
        return self

    def _check_problems(self) -> None:
        """Raise ValueError unless all scenarios are problems, and the same parameters have a meaning for each."""
        shapes = []
        for one in self.scenarios:
            if not isinstance(one, Problem):
                raise ValueError(f"a study must be of tuning.problems.problem.Problem, but got {shown(one)}")
            sizes = len(one.quantities.states), len(one.quantities.measurements)
            shapes.append((sizes, [parameter.name for parameter in one.parameters or ()]))
            if shapes[-1] != shapes[0]:
                raise ValueError(
                    "problems of one study must have as many states and measurements, and the same parameters, "
                    f"but {self.scenarios[0].name} and {one.name} have not"
                )

    def found_objectives(self) -> list[Objective]:
        """The objectives themselves."""
        return [find_objective(name) for name in self.objectives]

    def space(self) -> dict[str, BaseDistribution]:
        """The distributions of a trial's parameters by name; ranges are those of the first scenario.

        The scale of P_0 is one of them where a scenario scores the start-up.
        """
        return joint_distributions(self.filter_types, self.scenarios[0], **self._options)

    def parameters(self) -> dict[str, Parameter]:
        """A trial's parameters by name, without the filter type."""
        return joint_parameters(self.filter_types, self.scenarios[0], **self._options)

    @property
    def tunes_noise(self) -> bool:
        """Whether Q and R are tuned: the problem has no parameters of its own, the filters a covariance."""
        return self.scenarios[0].parameters is None and self._has_covariance

    @property
    def _options(self) -> dict:
        prior = self.tunes_noise and any(scenario.counts_start_up for scenario in self.scenarios)
        return {"hold_r": self.hold_r, "full_q": self.full_q, "prior": prior}

    def training_data(self) -> list[Data]:
        """Data that all trials share, one for each scenario."""
        return [scenario.data(scenario.training_seeds(self.seed, TRAINING_SEEDS)) for scenario in self.scenarios]

    def size_data(self) -> list[Data]:
        """Data that choose the ensemble size once Q and R are chosen, one for each scenario."""
        return [scenario.data(scenario.size_seeds(self.seed, SIZE_SEEDS)) for scenario in self.scenarios]
