"""What gradients lead to: the likelihood of the innovations, or the best score at the true states."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from filters.consistency.intervals import pooled_mean
from filters.differentiated import recursion
from filters.differentiated.runs import ModelSlopes, Truth
from filters.likelihood import Likelihood
from thruster_env.core.checks import one_of
from thruster_env.core.sources import is_array
from thruster_env.model.state_space import StateSpaceModel
from tuning.evaluation.runs import metrics_of_all
from tuning.likelihood.family import Family
from tuning.problems.data import Data
from tuning.problems.parameter import Parameter
from tuning.problems.problem import Problem
from tuning.search.objectives import LIKELIHOOD, LOG_SCORE, MSE, SCORE
from tuning.search.space import Choice, neutral

OF_STATES = {  # objectives on the true states: what of them is summed over steps
    SCORE: recursion.SQUARES,
    MSE: recursion.SQUARES,
    LOG_SCORE: recursion.LOG_SCORE,
}


class Goal:
    """A function of coordinates that is to be maximised, and its gradient, for each run of some problems.

    It is the log-likelihood of a run; or minus the sum of an objective's terms over the scored steps of a run. Of
    several problems the mean of their objectives counts, as in a study, and the likelihood of all their runs.

    The score, sum_i sqrt(M_i) / (n s_i) with M_i the mean square error of state i over all runs and s_i its scale,
    is that of squares with the weights w_i = 1 / (n s_i sqrt(M_i)), and its derivative half of theirs.

    Args:
        choice: of a Kalman filter.
        problems: make its models, which have the same parameters.
        data: of each problem.
        parameters: the p parameters.
        objective: "likelihood", "score", "mse" or "log-score".
        watch: called with this goal, the coordinates and what was found there, after each evaluation.

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
        watch: Callable[[Goal, np.ndarray, Likelihood], None] = lambda goal, point, likelihood: None,
    ):
        """Find the truth that counts."""
        self._watch = watch
        self.objective = one_of("objective", objective, (LIKELIHOOD, *OF_STATES))
        self._choice, self._problems, self._data = choice, tuple(problems), tuple(data)
        self._families = [Family(choice, problem, parameters) for problem in problems]
        self._truths = [self._truth(*those) for those in zip(problems, data, self._families, strict=True)]
        self.coordinates = self._families[0].coordinates
        self.steps = sum(int(runs.scored_counts.sum()) for runs in data)

    def __call__(self, point: np.ndarray) -> Likelihood:
        """Values of all runs, (B,), and their gradients, (B, p), at coordinates."""
        blocks = []
        parts = zip(self._problems, self._data, self._families, self._truths, strict=True)
        for problem, data, family, truth in parts:
            score = OF_STATES.get(self.objective, recursion.LIKELIHOOD)
            if truth is not None and self.objective == SCORE:
                truth = truth._replace(weights=self._of_score(point, problem, data, family))
            out, _ = family.derivatives(point, data, score=score, truth=truth)
            blocks.append(out * self._weight(data))
        runs = np.concatenate(blocks)
        if self.objective == SCORE:
            runs[:, 1:] *= 0.5
        likelihood = Likelihood(runs[:, 0], runs[:, 1:])
        self._watch(self, point, likelihood)
        return likelihood

    def by_noise(self, choice: Choice) -> tuple[float, np.ndarray, np.ndarray]:
        """The sum over all runs at a choice, and its derivatives by the matrices Q (n, n) and R (m, m).

        They are those of `Family.by_noise`, for every objective but the score, which is no sum over runs.
        """
        if self.objective == SCORE:
            raise ValueError(f"an objective whose slopes by matrices are known must not be {SCORE!r}")
        score, parts = OF_STATES.get(self.objective, recursion.LIKELIHOOD), []
        for data, family, truth in zip(self._data, self._families, self._truths, strict=True):
            values, by_q, by_r = family.by_noise(choice, data, score=score, truth=truth)
            parts.append([self._weight(data) * term for term in (values.sum(), by_q, by_r)])
        value, by_q, by_r = (np.sum(np.array(of_all), axis=0) for of_all in zip(*parts, strict=True))
        return float(value), by_q, by_r

    def information(self, point: np.ndarray) -> np.ndarray:
        """Fisher's information on the coordinates in the innovations of all runs, (p, p)."""
        pairs = zip(self._families, self._data, strict=True)
        matrices = [family.derivatives(point, data, information=True)[1] for family, data in pairs]
        return np.concatenate(matrices).sum(axis=0)

    def model_at(self, point: np.ndarray) -> tuple[StateSpaceModel, ModelSlopes]:
        """The model of the first problem at coordinates, and its derivatives by them."""
        return self._families[0].at(point)

    def of_few(self, runs: int) -> Goal:
        """The same of the first runs of each problem."""
        few = [data.slice(0, runs) for data in self._data]
        return Goal(self._choice, self._problems, few, self.coordinates.free, self.objective, self._watch)

    def of(self, objective: str) -> Goal:
        """Another objective of the same runs."""
        return Goal(self._choice, self._problems, self._data, self.coordinates.free, objective, self._watch)

    @property
    def is_of_squares(self) -> bool:
        """Whether squared errors are minimised, in which the covariance does not count."""
        return self.objective in (SCORE, MSE)

    def choice_at(self, point: np.ndarray) -> Choice:
        """The choice at coordinates."""
        return self._families[0].choice_at(point)

    @property
    def untuned(self) -> np.ndarray:
        """The parameters of the choice that the goal was made of, (p,)."""
        values = [(parameter.get(self._choice), neutral(parameter.name)) for parameter in self.coordinates.free]
        return np.array([other if value is None else value for value, other in values], dtype=np.float64)

    @property
    def is_large(self) -> bool:
        """Whether a model has so many states that a run takes long."""
        return any(is_array(family.states, family.states) for family in self._families)

    @property
    def runs(self) -> int:
        """The most runs of a problem."""
        return max(len(runs.measurements) for runs in self._data)

    def level(self, value: float) -> float:
        """Log L of all runs for their sum; of other objectives their value, as a study has it."""
        return value if self.objective == LIKELIHOOD else -value / self.steps

    def unit(self, value: float) -> float:
        """In what information is counted at an optimum: in a log density, or in the mean square that remains."""
        if not self.is_of_squares:
            return 1.0
        counted = sum(int(np.isfinite(truth.states).sum()) for truth in self._truths if truth is not None)
        return (-2.0 if self.objective == MSE else -1.0) * value / counted

    def _weight(self, data: Data) -> float:
        if self.objective == LIKELIHOOD:
            return 1.0
        return self.steps / (len(self._data) * int(data.scored_counts.sum()))

    def _truth(self, problem: Problem, data: Data, family: Family) -> Truth | None:
        """The true states, NaN where the objective does not count them: those that the plant lacks, too."""
        if self.objective == LIKELIHOOD:
            return None
        if data.states is None or problem.scale is None:
            raise ValueError(f"objective must be {LIKELIHOOD!r} without true states, but got {self.objective!r}")
        scale = np.asarray(problem.scale, dtype=np.float64)
        known = np.where(data.scored[..., None] & np.isfinite(scale), data.states, np.nan)
        states = np.full((*known.shape[:2], family.states), np.nan)
        states[..., : len(scale)] = known
        weights = np.zeros(family.states)
        weights[: len(scale)] = 1.0 / np.square(scale)
        return Truth(states, weights)

    def _of_score(self, point: np.ndarray, problem: Problem, data: Data, family: Family) -> np.ndarray:
        """The weights of squares that give the score, (n,), from the filter's mean square errors."""
        metrics = metrics_of_all(family.choice_at(point).filter(problem), data, nees=False, outputs=False)
        scale, weights = np.asarray(problem.scale, dtype=np.float64), np.zeros(family.states)
        deviations = np.sqrt(pooled_mean(np.asarray(metrics.mean_squares), metrics.weights))
        with np.errstate(divide="ignore"):
            weights[: len(scale)] = 1.0 / (np.isfinite(scale).sum() * scale * deviations)
        return weights
