"""An objective of runs as a function of a model's parameters: its value, gradient and information matrix.

In order: how innovations count, with more outliers than normal ones or without those beyond a gate; a part of an
objective, which is runs and the model that a filter assumes of them; the objective.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from copy import copy
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from filters import differentiated
from filters.consistency.nees import pooled_mean
from filters.filter import Filter
from filters.sensitivity import Density, ModelSlopes, Truth, derivatives
from filters.starts import Starts, as_the_prior_says
from thruster_env.core.checks import one_of
from thruster_env.core.sources import is_array
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.model.turns import Turn, innovations_of, leading, stored_of
from tuning.evaluation.runs import metrics_of_all
from tuning.likelihood.ascent import Evaluation
from tuning.problems.data import Data
from tuning.problems.problem import Coordinates
from tuning.search.plan import LIKELIHOOD, LOG_SCORE, MSE, SCORE
from tuning.search.space import Choice

OF_STATES = {  # objectives on the true states: what of them is summed over steps
    SCORE: differentiated.SQUARES,
    MSE: differentiated.SQUARES,
    LOG_SCORE: differentiated.LOG_SCORE,
}
LARGE_STEP = 1e-2  # of differences of the objective itself
COVARIANCES = "process_noise_cov", "measurement_noise_cov", "prior_cov"
BLOCKS = 20  # least number of blocks of all runs, whose scores give the scatter


class Innovations(NamedTuple):
    """How innovations count in a robust likelihood.

    Attributes:
        degrees: of freedom of Student-t innovations, above 2; infinite for normal ones.
        predicted: symbols of channels that the filter predicts, but does not use.
        gate: number of standard deviations beyond which samples were left out; infinite if none were. The squares
            of what is left are then smaller than S by `kept_variance`, and are divided by that.
        starts: of runs that do not begin as the model's prior says; None if all do.
    """

    degrees: float = math.inf
    predicted: tuple[str, ...] = ()
    gate: float = math.inf
    starts: Starts | None = None


def kept_variance(gate: float) -> float:
    """Variance of a standard normal number that is kept where its magnitude is at most c.

        E[x^2 | |x| <= c] = 1 - 2 c phi(c)/(2 Phi(c) - 1)

    Args:
        gate: c, positive; infinite for no gate, where it is 1.

    Source: Johnson, Kotz, Balakrishnan (1994), Continuous Univariate Distributions, volume 1, section 13.10.1.
    """
    return 1.0 - _edge(gate)


def lost_information(gate: float) -> float:
    """How much larger the variance of an estimated log-variance is: 2/var(x^2 | |x| <= c), 1 without a gate.

    That of a constant, 1/kappa^2 with kappa the `kept_variance`, is smaller.
    """
    variance = kept_variance(gate)
    fourth = 3.0 * variance - (_edge(gate) * gate**2 if gate < math.inf else 0.0)
    return 2.0 / (fourth - variance**2)


def _edge(gate: float) -> float:
    """2 c phi(c)/(2 Phi(c) - 1)."""
    if gate > 38.0:  # phi is no number of floating point any more
        return 0.0
    return 2.0 * gate * math.exp(-0.5 * gate**2) / math.sqrt(2.0 * math.pi) / math.erf(gate / math.sqrt(2.0))


class Part:
    """Runs, and the model that a filter assumes of them as a function of coordinates (p,).

    Attributes:
        coordinates: of the parameters.
        states: number of states of the models.
        turns: rotations among these.
        data: `Data`, or what `data_at` makes these of.
        untuned: the parameters before, (p,).
        rough: indices of the parameters without sensitivities, which move the data or functions of the model.
        used: the filter; None for the (extended) Kalman filter.
        leads_in: whether the steps before the first scored one do not count.
        scale: of the errors of the states that the plant has, where the true ones are known.
    """

    coordinates: Coordinates
    states: int
    turns: tuple[Turn, ...] = ()
    data: Any
    untuned: np.ndarray
    rough: tuple[int, ...] = ()
    used: Filter | None = None
    leads_in = False
    scale: Sequence[float] | None = None

    def at(self, point: np.ndarray, indices: Sequence[int] | None = None) -> tuple[StateSpaceModel, ModelSlopes]:
        """The model at coordinates, and its derivatives by some of them, by all if None."""
        raise NotImplementedError

    def model_at(self, point: np.ndarray) -> StateSpaceModel:
        """The model at coordinates, as the filter runs on it."""
        return self.at(point, ())[0]

    def model_of(self, choice: Choice) -> StateSpaceModel:
        """The model of a choice, as the filter runs on it."""
        raise NotImplementedError

    def choice_at(self, point: np.ndarray) -> Choice:
        """The choice at coordinates."""
        raise NotImplementedError

    def filter_at(self, point: np.ndarray) -> Filter:
        """The filter at coordinates."""
        raise NotImplementedError

    def data_at(self, point: np.ndarray) -> Data:
        """The runs at coordinates."""
        return self.data

    def noise_factors(self, point: np.ndarray) -> np.ndarray | None:
        """Factors on R of each channel (m,), where data are interpolated."""
        return None

    def of_few(self, runs: int) -> Part:
        """The same with the first runs."""
        few = copy(self)
        few.data = self.data.slice(0, runs)
        return few


class Objective:
    """A function of coordinates that is to be maximised, with its gradient and Fisher information.

    It is the log-likelihood of runs; or minus the sum of an objective's terms over the scored steps of runs. Of
    several parts the mean of their objectives counts, as in a study, and the likelihood of all their runs.

    The score, sum_i sqrt(M_i) / (n s_i) with M_i the mean square error of state i over all runs and s_i its scale,
    is that of squares with the weights w_i = 1 / (n s_i sqrt(M_i)), and its derivative half of theirs.

    Args:
        parts: runs and models, which have the same parameters.
        objective: "likelihood", "score", "mse" or "log-score".
        innovations: how they count in a robust likelihood; None for those of normal noise, all from the prior.
        information: whether Fisher's information is wanted, too.
        watch: called with this objective, the coordinates and the evaluation there, after each evaluation.

    Attributes:
        rough: indices of the parameters along which differences of the objective are used.
        unseen: (m,) which channels are predicted only.
        evaluations: how many there were.

    Raises:
        ValueError: for another objective, one on true states without these, or unknown channels.
    """

    def __init__(
        self,
        parts: Sequence[Part],
        objective: str = LIKELIHOOD,
        *,
        innovations: Innovations | None = None,
        information: bool = False,
        watch: Callable[[Objective, np.ndarray, Evaluation], None] | None = None,
    ):
        """Find the truth that counts."""
        self.objective = one_of("objective", objective, (LIKELIHOOD, *OF_STATES))
        self.parts, self.informative, self._watch = tuple(parts), information, watch
        self.coordinates, self.evaluations = parts[0].coordinates, 0
        self.rough = tuple(sorted({index for part in parts for index in part.rough}))
        self._smooth = [j for j in range(len(self.coordinates.free)) if j not in self.rough]
        first = [part.data_at(self.coordinates.start()) for part in parts]
        self._truths = [self._truth(*pair) for pair in zip(parts, first, strict=True)]
        self.steps = sum(int(runs.scored_counts.sum()) for runs in first)
        self.innovations, self.blocks, self.unseen = innovations, 1, list[bool]()
        if innovations is None:
            return
        if not innovations.degrees > 2:
            raise ValueError(f"degrees of freedom must be above 2, but got {innovations.degrees!r}")
        self.unseen = _checked_channels(innovations.predicted, parts[0].model_at(self.coordinates.start()))
        count = sum(len(runs.measurements) for runs in first)
        self.blocks = 1 if count >= BLOCKS else -(-BLOCKS // count)

    def with_changes(self, **changes) -> Objective:
        """The same with other parts, objective or fields of `Innovations`."""
        parts, objective = changes.pop("parts", self.parts), changes.pop("objective", self.objective)
        innovations = (self.innovations or Innovations())._replace(**changes) if changes else self.innovations
        return Objective(
            parts, objective, innovations=innovations, information=self.informative, watch=self._watch
        )

    def of_few(self, runs: int) -> Objective:
        """The same of the first runs of each part."""
        return self.with_changes(parts=[part.of_few(runs) for part in self.parts])

    @property
    def starts(self) -> Starts | None:
        """Of runs that do not begin as the model's prior says; None if all do."""
        return None if self.innovations is None else self.innovations.starts

    @property
    def gate(self) -> float:
        """Number of standard deviations beyond which samples were left out."""
        return math.inf if self.innovations is None else self.innovations.gate

    def value(self, point: np.ndarray) -> float:
        """The sum over all runs; minus infinity where it is not finite."""
        return self._evaluated(point, ()).value

    def __call__(self, point: np.ndarray) -> Evaluation:
        """The sum over all runs at coordinates, with its derivatives."""
        here = self._evaluated(point, self._smooth)
        if self.rough:
            here = self._with_differences(here, point)
        if self._watch is not None:
            self._watch(self, point, here)
        return here

    def _with_differences(self, here: Evaluation, point: np.ndarray) -> Evaluation:
        """Derivatives also by the parameters without sensitivities, by differences of the objective."""
        p, smooth = len(point), self._smooth
        gradient, information = np.zeros(p), np.zeros((p, p))
        scores = np.zeros((len(here.scores), p))
        gradient[smooth], scores[:, smooth] = here.gradient, here.scores
        information[np.ix_(smooth, smooth)] = here.information
        steps = LARGE_STEP * np.eye(p)
        sides = {j: [self._evaluated(point + sign * steps[j], smooth) for sign in (1.0, -1.0)] for j in self.rough}
        for j, (above, below) in sides.items():
            gradient[j] = (above.value - below.value) / (2 * LARGE_STEP)
            scores[:, j] = (above.part_values - below.part_values) / (2 * LARGE_STEP)
            row = (below.gradient - above.gradient) / (2 * LARGE_STEP)
            information[j, smooth] = information[smooth, j] = row
            curvature = (2 * here.value - above.value - below.value) / LARGE_STEP**2
            information[j, j] = max(curvature, 1e-3 * abs(curvature), 1e-6)
        for j, i in combinations(self.rough, 2):  # both move together: f(+, +) + f(-, -) has their mixed slope
            both = sum(self.value(point + sign * (steps[j] + steps[i])) for sign in (1.0, -1.0))
            apart = sum(side.value for k in (j, i) for side in sides[k])
            information[j, i] = information[i, j] = (apart - both - 2 * here.value) / (2 * LARGE_STEP**2)
        return here._replace(gradient=gradient, information=information, scores=scores)

    def _evaluated(self, point: np.ndarray, indices: Sequence[int]) -> Evaluation:
        """The sum over all runs, with derivatives by parameters with sensitivities."""
        self.evaluations += 1
        sums = [self._sums(*pair, point, indices) for pair in zip(self.parts, self._truths, strict=True)]
        blocks, matrices = (np.concatenate(of_all) for of_all in zip(*sums, strict=True))
        if self.objective == SCORE:
            blocks[:, 1:] *= 0.5
        values, scores = blocks[:, 0], blocks[:, 1:]
        value = float(values.sum())
        value = value if math.isfinite(value) else -math.inf
        return Evaluation(value, scores.sum(axis=0), matrices.sum(axis=0), scores, values)

    def information_of_runs(self, point: np.ndarray) -> np.ndarray:
        """Fisher's information in each of B runs, (B, p, p)."""
        pairs = zip(self.parts, self._truths, strict=True)
        return np.concatenate([self._sums(*pair, point, self._smooth)[1] for pair in pairs])

    def _sums(
        self, part: Part, truth: Truth | None, point: np.ndarray, indices: Sequence[int]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Values and gradients of the blocks of a part's runs, (blocks, 1 + p), and the runs' information."""
        runs, (model, slopes) = part.data_at(point), part.at(point, indices)
        if truth is not None and self.objective == SCORE:
            truth = truth._replace(weights=self._of_score(point, part, runs))
        if self.innovations is None:
            out, information = self._along(part, model, slopes, runs, truth)
            return out * self._weight(runs), information
        starts, variance = self.innovations.starts, kept_variance(self.gate)
        if variance < 1.0:  # a common factor on Q, R and P moves no estimate
            model = model.replace(**{name: variance * getattr(model, name) for name in COVARIANCES})
            slopes = slopes._replace(**{name: variance * getattr(slopes, name) for name in COVARIANCES})
            starts = None if starts is None else starts._replace(covs=variance * starts.covs)
        out, information = self._along(part, model, slopes, runs, truth, starts)
        factors = part.noise_factors(point)
        if variance < 1.0 or factors is not None:  # densities of all samples, not within the gate or of averages
            counts = self._counted(runs).reshape(len(out), -1)
            out[:, 0] += 0.5 * counts @ np.log(variance * (np.ones(model.m) if factors is None else factors))
        return out, information

    def _along(
        self,
        part: Part,
        model: StateSpaceModel,
        slopes: ModelSlopes,
        data: Data,
        truth: Truth | None,
        starts: Starts | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """What `_sums` returns, of a model with its slopes, but for factors.

        The lead-in of runs, in which the filter settles, is left out; so is what a run was padded with.
        """
        score, robust = OF_STATES.get(self.objective, differentiated.LIKELIHOOD), self.innovations
        moving = bool(slopes.constants.any()) or robust is not None
        wanted = differentiated.Wanted(self.informative, constants=moving, tails=robust is not None, score=score)
        density = None if robust is None else Density(float(robust.degrees), 1.0 - np.array(self.unseen))

        def of(runs: Data) -> tuple[np.ndarray, np.ndarray]:
            arguments = model, runs.seen.inputs, runs.seen.measurements, slopes, wanted
            begun = starts
            if begun is None and runs.begun is not None:
                count = len(runs.begun)
                begun = as_the_prior_says(model, count)._replace(free=np.ones(count, bool), means=runs.begun)
            out, information = derivatives(
                *arguments, density=density, blocks=self.blocks, starts=begun, truth=truth, used=part.used
            )
            return out.reshape(-1, out.shape[-1]), information

        result = of(data)
        if truth is not None or not (part.leads_in and data.first_scored):
            return result
        before = of(data.beginning)
        return result[0] - before[0], result[1] - before[1]

    def by_noise(self, choice: Choice) -> tuple[float, np.ndarray, np.ndarray]:
        """The sum over all runs at a choice, and its derivatives by the matrices Q, (t, t), and R, (m, m).

            d sum = tr(G_Q dQ) + tr(G_R dR),   G symmetric

        for every objective but the score, which is no sum over runs.
        """
        if self.objective == SCORE:
            raise ValueError(f"an objective whose slopes by matrices are known must not be {SCORE!r}")
        models = [part.model_of(choice) for part in self.parts]
        q, r = (symmetric_units(size) for size in (models[0].t, models[0].m))
        moves = {"process_noise_cov": np.concatenate([q, np.zeros((len(r), *q.shape[1:]))])}
        moves["measurement_noise_cov"] = np.concatenate([np.zeros((len(q), *r.shape[1:])), r])
        total = np.zeros(1 + len(q) + len(r))
        for part, truth, model in zip(self.parts, self._truths, models, strict=True):
            data, slopes = part.data, ModelSlopes.of(model, len(q) + len(r), **moves)
            blocks, _ = self._along(part, model, slopes, data, truth)
            total += self._weight(data) * blocks.sum(axis=0)
        value, *halves = np.split(total, [1, 1 + len(q)])
        halves = [np.tensordot(half, units, 1) for half, units in zip(halves, (q, r), strict=True)]
        by_q, by_r = (0.5 * (half + np.diag(np.diag(half))) for half in halves)
        return float(value[0]), by_q, by_r

    def moves_prior(self, point: np.ndarray) -> bool:
        """Whether some free parameter moves the prior of the first state, which is then what it says.

        A run of a model with rotations always begins where its first measurement says.
        """
        (part,) = self.parts
        model, slopes = part.at(point, self._smooth)
        if model.turns:
            return False
        steps = LARGE_STEP * np.eye(len(point))
        pairs = [[part.model_at(point + sign * steps[j]) for sign in (1.0, -1.0)] for j in self.rough]
        apart = [np.any(a.prior_mean != b.prior_mean) or np.any(a.prior_cov != b.prior_cov) for a, b in pairs]
        return bool(slopes.prior_mean.any() or slopes.prior_cov.any() or any(apart))

    def model_at(self, point: np.ndarray) -> StateSpaceModel:
        """The model of the first part at coordinates, as the filter runs on it."""
        return self.parts[0].model_at(point)

    def data_at(self, point: np.ndarray) -> Data:
        """The runs of the first part at coordinates."""
        return self.parts[0].data_at(point)

    def choice_at(self, point: np.ndarray) -> Choice:
        """The choice at coordinates."""
        return self.parts[0].choice_at(point)

    @property
    def untuned(self) -> np.ndarray:
        """The parameters before, (p,)."""
        return self.parts[0].untuned

    @property
    def start(self) -> np.ndarray:
        """Coordinates of these within their ranges, where a search begins."""
        return self.coordinates.clip(self.coordinates.of(self.untuned))

    @property
    def is_of_squares(self) -> bool:
        """Whether squared errors are minimised, in which the covariance does not count."""
        return self.objective in (SCORE, MSE)

    @property
    def is_large(self) -> bool:
        """Whether a model has so many states that a run takes long."""
        return any(is_array(part.states, part.states) for part in self.parts)

    @property
    def runs(self) -> int:
        """The most runs of a part."""
        return max(len(part.data.measurements) for part in self.parts)

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
        return self.steps / (len(self.parts) * int(data.scored_counts.sum()))

    def _truth(self, part: Part, data: Data) -> Truth | None:
        """The true states, NaN where the objective does not count them: those that the plant lacks, too."""
        if self.objective == LIKELIHOOD:
            return None
        if data.states is None or part.scale is None:
            raise ValueError(f"objective must be {LIKELIHOOD!r} without true states, but got {self.objective!r}")
        scale = np.asarray(part.scale, dtype=np.float64)
        known = data.states.shape[-1]
        counts = np.array(stored_of(np.isfinite(scale).tolist(), leading(part.turns, known), True))
        states = np.full((*data.states.shape[:2], part.states), np.nan)
        weights = np.zeros(part.states - len(part.turns))
        states[..., :known] = np.where(data.scored[..., None] & counts, data.states, np.nan)
        weights[: len(scale)] = 1.0 / np.square(scale)
        return Truth(states, weights)

    def _of_score(self, point: np.ndarray, part: Part, data: Data) -> np.ndarray:
        """The weights of squares that give the score, (n,), from the filter's mean square errors."""
        metrics = metrics_of_all(part.filter_at(point), data, nees=False, outputs=False)
        scale, weights = np.asarray(part.scale, dtype=np.float64), np.zeros(part.states - len(part.turns))
        deviations = np.sqrt(pooled_mean(np.asarray(metrics.mean_squares), metrics.weights))
        with np.errstate(divide="ignore"):
            weights[: len(scale)] = 1.0 / (np.isfinite(scale).sum() * scale * deviations)
        return weights

    def _counted(self, runs: Data) -> np.ndarray:
        """Number of samples of each run, block and channel that count, (B, blocks, m)."""
        count, rows, channels = runs.measurements.shape
        counted = ~np.isnan(runs.measurements)
        if self.starts is not None:
            counted &= (np.arange(rows) >= self.starts.counted_from[:, None])[..., None]
        counts = np.zeros((count, self.blocks, channels), dtype=np.int64)
        for block, rows_of in enumerate(np.arange(rows) * self.blocks // rows == np.arange(self.blocks)[:, None]):
            counts[:, block] = counted[:, rows_of].sum(axis=1)
        return counts


def symmetric_units(size: int) -> np.ndarray:
    """The symmetric matrices with one entry, or two mirrored ones, of 1: (n (n + 1) / 2, n, n)."""
    pairs = [(i, j) for i in range(size) for j in range(i + 1)]
    units = np.zeros((len(pairs), size, size))
    for unit, (i, j) in zip(units, pairs, strict=True):
        unit[i, j] = unit[j, i] = 1.0
    return units


def _checked_channels(predicted: Sequence[str], model: StateSpaceModel) -> list[bool]:
    """Which channels are only predicted; ValueError for an unknown one, or if all are."""
    symbols = [channel.symbol for channel in innovations_of(model)]
    for symbol in predicted:
        one_of("a predicted channel", symbol, symbols)
    unseen = [symbol in predicted for symbol in symbols]
    if all(unseen):
        raise ValueError(f"a filter must see some channel, but {', '.join(symbols)} are only predicted")
    return unseen
