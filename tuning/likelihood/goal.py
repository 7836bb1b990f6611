"""What gradients lead to: the likelihood of the innovations, or the best score at the true states."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from filters.differentiated import recursion
from filters.differentiated.runs import Truth
from filters.likelihood import Likelihood
from numerics.checks import one_of
from numerics.sources import is_array
from tuning.likelihood.family import Family
from tuning.problems.data import Data
from tuning.problems.parameter import Parameter
from tuning.problems.problem import Problem
from tuning.search.objectives import LIKELIHOOD, LOG_SCORE, MSE
from tuning.search.space import Choice, neutral

OF_STATES = {MSE: recursion.SQUARES, LOG_SCORE: recursion.LOG_SCORE}  # objectives on the true states


class Goal:
    """A function of coordinates that is to be maximised, and its gradient, for each run of some problems.

    It is the log-likelihood of a run; or minus the sum of an objective's terms over the scored steps of a run. Of
    several problems the mean of their objectives counts, as in a study, and the likelihood of all their runs.

    Args:
        choice: of a Kalman filter.
        problems: make its models, which have the same parameters.
        data: of each problem.
        parameters: the p parameters.
        objective: "likelihood", "mse" or "log-score".

    Raises:
        ValueError: for another objective, one on true states without these, or a parameter that has no gradient.
    """

    def __init__(
        self,
        choice: Choice,
        problems: Sequence[Problem],
        data: Sequence[Data],
        parameters: Sequence[Parameter],
        objective: str = LIKELIHOOD,
    ):
        """Find the truth that counts."""
        self.objective = one_of("objective", objective, (LIKELIHOOD, *OF_STATES))
        self._choice, self._problems, self._data = choice, tuple(problems), tuple(data)
        self._families = [Family(choice, problem, parameters) for problem in problems]
        self.coordinates = self._families[0].coordinates
        self._truths = [self._truth(*pair) for pair in zip(problems, data, strict=True)]
        self.steps = sum(int(one.scored_counts.sum()) for one in data)

    def __call__(self, point: np.ndarray) -> Likelihood:
        """Values of all runs, (B,), and their gradients, (B, p), at coordinates."""
        found = []
        for family, data, truth in zip(self._families, self._data, self._truths, strict=True):
            score = OF_STATES.get(self.objective, recursion.LIKELIHOOD)
            out, _ = family.derivatives(point, data, score=score, truth=truth)
            found.append(out * self._weight(data))
        runs = np.concatenate(found)
        return Likelihood(runs[:, 0], runs[:, 1:])

    def of_few(self, runs: int) -> Goal:
        """The same of the first runs of each problem."""
        few = [one.slice(0, runs) for one in self._data]
        return Goal(self._choice, self._problems, few, self.coordinates.free, self.objective)

    def choice_at(self, point: np.ndarray) -> Choice:
        """The choice at coordinates."""
        return self._families[0].choice_at(point)

    @property
    def untuned(self) -> np.ndarray:
        """The parameters of the choice that the goal was made of, (p,)."""
        values = [(one.get(self._choice), neutral(one.name)) for one in self.coordinates.free]
        return np.array([other if value is None else value for value, other in values], dtype=np.float64)

    @property
    def is_large(self) -> bool:
        """Whether a model has so many states that a run takes long."""
        return any(is_large(problem) for problem in self._problems)

    @property
    def runs(self) -> int:
        """The most runs of a problem."""
        return max(len(one.measurements) for one in self._data)

    def level(self, value: float) -> float:
        """Log L of all runs for their sum; of other objectives their value, as a study has it."""
        return value if self.objective == LIKELIHOOD else -value / self.steps

    def unit(self, value: float) -> float:
        """In what information is counted at an optimum: in a log density, or in the mean square that remains."""
        if self.objective != MSE:
            return 1.0
        counted = sum(int(np.isfinite(one.states).sum()) for one in self._truths if one is not None)
        return -2.0 * value / counted

    def _weight(self, data: Data) -> float:
        if self.objective == LIKELIHOOD:
            return 1.0
        return self.steps / (len(self._data) * int(data.scored_counts.sum()))

    def _truth(self, problem: Problem, data: Data) -> Truth | None:
        """The true states, NaN where the objective does not count them."""
        if self.objective == LIKELIHOOD:
            return None
        if data.states is None or problem.scale is None:
            raise ValueError(f"objective must be {LIKELIHOOD!r} without true states, but got {self.objective!r}")
        scale = np.asarray(problem.scale, dtype=np.float64)
        states = np.where(data.scored[..., None] & np.isfinite(scale), data.states, np.nan)
        return Truth(states, 1.0 / np.square(scale))


def is_large(problem: Problem) -> bool:
    """Whether a problem's model has so many states that its likelihood takes long."""
    count = len(problem.quantities.states)
    return is_array(count, count)
