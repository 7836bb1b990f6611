"""A plant's parameters by maximum likelihood of a filter's innovations, from several starts.

With a gate, samples with large innovations of a robust filter are outliers and left out.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np

from filters.adaptive import RobustExtendedKalmanFilter
from filters.starts import Starts
from thruster_env.core.checks import at_least, short_repr
from thruster_env.core.parallel import IN_PROCESS, TaskMap
from thruster_env.core.streams import START_POINTS, derived_generator
from thruster_env.logs.log import Log
from thruster_env.model.state_space import StateSpaceModel
from tuning.identification.objective import likelihood_of, of_changed, recorded
from tuning.identification.result import (
    Identification,
    NullTest,
    Optimum,
    covariances_of,
    identification_of,
    null_of,
    null_tests,
)
from tuning.identification.starts import estimates_of, runs_of, starts_of
from tuning.likelihood.ascent import Ascent, climb
from tuning.likelihood.objective import Objective
from tuning.problems.data import Data
from tuning.problems.problem import Coordinates, Parameter
from tuning.search.study import stop_on_interrupt

ROUNDS = 30  # of leaving out and identifying again, at most; a narrow gate takes many
STARTS = 4  # the given one, and others drawn about it
MOST_STARTS = 1000
START_ROUNDS = 3  # of finding further runs that begin elsewhere, at most
LEAST_GATE = 2.0  # one sample of 22 is beyond it without any outlier; the filter then misses too many
NEARER = 5  # largest number of times that a start without a likelihood is moved halfway to the first
REACH = 0.25  # fraction of a range, to either side of the start, within which other starts are drawn
Progress = Callable[[int, float, dict[str, float]], None]


def outliers_of(model: StateSpaceModel, runs: Data, gate: float, starts: Starts | None = None) -> np.ndarray:
    """Which samples are outliers, (B, K + 1, m): innovations of more than `gate` standard deviations.

    The filter is an extended Kalman filter with Student-t noise (`filters.adaptive`): the normal one
    follows outliers, so that their neighbours would look like outliers, too.

    Args:
        model: the model of the filter.
        runs: inputs and measurements.
        gate: number of standard deviations.
        starts: of the runs, if some do not begin as the prior says.
    """
    estimates = estimates_of(model, runs, starts, RobustExtendedKalmanFilter)
    spread = np.sqrt(np.einsum("bkii->bki", estimates.innovation_covs))
    return np.abs(estimates.innovations) > gate * spread


class WithoutOutliers:
    """Data, or a function of parameters that returns them, without some samples."""

    def __init__(self, data: Data | Callable, outliers: np.ndarray, model: StateSpaceModel):
        """Take data and model of an `Objective`, and a mask (B, K + 1, m) of the samples to leave out."""
        self._data, self.outliers, self._model = data, outliers, model
        self.parameters = getattr(data, "parameters", ())
        noise_factors = getattr(data, "noise_factors", None)
        if noise_factors is not None:
            self.noise_factors = noise_factors

    def __call__(self, **values: float) -> Data:
        """The runs, NaN where a sample is left out."""
        runs = runs_of(self._data(**values) if callable(self._data) else self._data, self._model)
        return runs._replace(measurements=np.where(self.outliers, np.nan, runs.measurements))


def without_outliers(objective: Objective, outliers: np.ndarray, gate: float) -> Objective:
    """The same objective without the outliers, which are those beyond a gate."""
    runs = recorded(objective)
    return of_changed(objective, data=WithoutOutliers(runs.data, outliers, runs.first_model), gate=gate)


def from_nothing(objective: Objective, start: np.ndarray, stop, tell) -> Ascent | None:
    """The maximum that is found from that with all effects left out that may be zero; None without any.

    So a further parameter never lowers the log-likelihood.
    """
    coordinates = objective.coordinates
    nulls = [null_of(coordinates, index, start) for index in range(len(start))]
    fixed = np.array([is_zero for _, is_zero in nulls])
    if not fixed.any() or fixed.all():
        return None
    at = np.where(fixed, [null for null, _ in nulls], start)
    without = climb(objective, at, fixed=fixed, stop=stop)
    return climb(objective, without.at, stop=stop, progress=tell)


def identify(
    data: Data | Log | Sequence[Data | Log] | Callable,
    model: Callable[..., StateSpaceModel],
    free: Sequence[Parameter],
    *,
    filter: str = "ekf",
    start: Mapping[str, float] | None = None,
    starts: int | Sequence[Mapping[str, float]] = STARTS,
    seed: int = 0,
    degrees: float = math.inf,
    predicted: Sequence[str] = (),
    gate: float = math.inf,
    simulation_first: bool = True,
    against: bool = True,
    progress: Progress | None = None,
    tasks: TaskMap = IN_PROCESS,
) -> Identification:
    """Find the values of free parameters under which a filter's innovations are most likely.

    The search is Fisher scoring (`tuning.likelihood.ascent.climb`) in logarithms of positive parameters and parts
    of the range of others, with gradients by the filter's sensitivities to constants, Q, R and prior, in any
    combination. For parameters that move the data, or change the model's functions, differences of the likelihood
    are used.

    The first start is `start`; the others are drawn uniformly (in coordinates) within a quarter of each range to
    either side of it; one at which the filter does not stay finite is moved halfway to the first, repeatedly. With
    `simulation_first` each start is first moved to where the model, simulated without process noise, is closest to
    the measurements, if that is more likely: innovations are small even for a model that is far off, as long as
    its filter follows the measurements.

    Runs that begin elsewhere than the model's prior says begin where their first rows say, and these do not count
    (`starts.starts_of`); unless a free parameter moves the prior.

    Args:
        data: `Data`, a `Log`, a sequence of these, or a function of some of the parameters (its arguments) that
            returns these.
        model: `model(**values)` of the other parameters.
        free: the free parameters, with ranges; the search starts at `default`.
        filter: "ekf", or "kf" for affine models and models with an operating point.
        start: values at which to start, in place of the defaults.
        starts: number of starts, or the other starts themselves.
        seed: seed of the draws.
        degrees: degrees of freedom of Student-t innovations, for logs with outliers; infinite for normal ones.
            With predicted channels, those of their errors alone.
        predicted: symbols of channels that the filter predicts, but never uses, such as a load cell that will not
            be there later. Without them the model is identified for the best one-step prediction of the
            measurements; with them, for the best prediction of these channels, whose R is that of the whole error.
        gate: leave out samples whose innovations exceed so many standard deviations of a robust filter, and
            identify again, until the samples stay the same; infinite to keep all. Squares of what is left are
            divided by their share of the variance (`kept_variance`), so that Q and R do not shrink. (With
            Student-t innovations alone the scale is robust, but the filter still follows outliers, and constants
            get a bias.)
        simulation_first: see above.
        against: whether each parameter is tested against leaving it out (`null_tests.null_tests`), and the search
            begins once more without effects that may be zero.
        progress: called with the number of the start, the log-likelihood and the values, after every rise, of
            starts that run elsewhere at their end.
        tasks: what runs each start.

    Returns:
        `Identification`. After Ctrl-C, the best so far, with `interrupted`.

    Raises:
        ValueError: for parameters, starts or data that do not fit each other, or if no start has a likelihood.
        KeyboardInterrupt: after Ctrl-C before any start.

    Source: Astrom (1980), "Maximum likelihood and prediction error methods", Automatica 16(5).
    """
    begin = time.perf_counter()
    if not gate > 0:
        raise ValueError(f"gate must be positive, but got {gate}")
    if gate < LEAST_GATE:
        raise ValueError(f"gate must be at least {LEAST_GATE:g} standard deviations, but got {gate}")
    coordinates = Coordinates(free)
    objective = likelihood_of(data, model, coordinates, filter=filter, degrees=degrees, predicted=predicted)
    first = coordinates.start(dict(start or {}))
    points = [first, *_others(coordinates, first, starts, seed)]
    with stop_on_interrupt() as asked:

        def tell(at, evaluation, number=0):
            if progress is not None:
                progress(number, evaluation.value, coordinates.named(at))

        objective = _with_starts(objective, first, simulation_first, asked, tell)
        from_one = from_start if tasks.is_remote else partial(from_start, stop=asked, tell=tell)
        ends: dict[int, tuple[np.ndarray, Ascent]] = {}
        begins = [(objective, number, point, first, simulation_first) for number, point in enumerate(points)]
        for number, (point, ascent, evaluations) in tasks(from_one, begins, asked):
            ends[number] = point, ascent
            if tasks.is_remote:
                objective.evaluations += evaluations
                tell(ascent.at, ascent.found, number)
        ascents = [ends[number][1] for number in sorted(ends)]
        if not ascents:
            raise KeyboardInterrupt
        if not any(math.isfinite(ascent.found.value) for ascent in ascents):
            raise ValueError(
                "the filter must stay finite on all runs from at least one start, but it does from none of "
                f"{short_repr([coordinates.named(ends[number][0]) for number in sorted(ends)])}"
            )
        optima = tuple(
            Optimum(
                coordinates.named(point),
                coordinates.named(ascent.at),
                ascent.found.value,
                ascent.iterations,
                ascent.converged,
            )
            for point, ascent in (ends[number] for number in sorted(ends))
        )
        plain = from_nothing(objective, first, asked, tell) if against and not asked() else None
        best = max([*ascents, *([] if plain is None else [plain])], key=lambda ascent: ascent.found.value)
        objective, best = _checked_starts(objective, best, asked, tell)
        if gate < math.inf:
            objective, best = _gated(objective, best, gate, asked, tell)
        tests: Mapping[str, NullTest] = {}
        if against and not asked():
            best, tests = null_tests(objective, best, first, partial(covariances_of, objective), asked)
        return identification_of(
            objective, first, best, optima, tests, interrupted=asked(), seconds=time.perf_counter() - begin
        )


def _with_starts(objective: Objective, first: np.ndarray, simulation_first: bool, stop, tell) -> Objective:
    """The objective in which runs that do not begin as the model's prior says begin where their first rows say.

    At the start of the search a run may seem not to: the model may be far off there. So the model is identified
    with free starts of these runs, and whether they are needed is asked again.
    """
    if recorded(objective).first_model.turns:
        return objective.with_changes(starts=_starts_at(objective, first))
    if not math.isfinite(objective.value(first)) or objective.moves_prior(first):
        return objective
    if not _starts_at(objective, first).free.any():
        return objective
    free = objective.with_changes(starts=_starts_at(objective, first))
    ascent = _climb_from(free, first, simulation_first, stop, tell)
    at = ascent.at if math.isfinite(ascent.found.value) else first
    return _spent(objective, free, objective.with_changes(starts=_starts_at(objective, at)))


def _checked_starts(objective: Objective, best: Ascent, stop, tell) -> tuple[Objective, Ascent]:
    """The objective and its maximum, with free starts of runs that need them by the model that was found, too."""
    if objective.moves_prior(best.at):
        return objective, best
    for _ in range(START_ROUNDS):
        further_starts, before = _starts_at(objective, best.at), objective.starts
        known = np.zeros_like(further_starts.free) if before is None else before.free
        if stop() or not (further_starts.free & ~known).any():
            break
        if before is not None:
            further_starts = Starts(
                further_starts.free | before.free,
                np.where(before.free[:, None], before.means, further_starts.means),
                np.where(before.free[:, None, None], before.covs, further_starts.covs),
                np.where(before.free, before.leads, further_starts.leads),
            )
        further = objective.with_changes(starts=further_starts)
        best = climb(further, best.at, stop=stop, progress=tell)
        objective = _spent(objective, further)
    return objective, best


def _starts_at(objective: Objective, at: np.ndarray) -> Starts:
    return starts_of(objective.model_at(at), objective.data_at(at), objective.unseen)


def _spent(*objectives: Objective) -> Objective:
    """The last objective, with the evaluations of all."""
    objectives[-1].evaluations = sum(objective.evaluations for objective in objectives)
    return objectives[-1]


def _gated(objective: Objective, best: Ascent, gate: float, stop, tell) -> tuple[Objective, Ascent]:
    """The objective without outliers, and its maximum: repeated until the outliers stay the same."""
    ungated, left_out, spent = objective, None, objective.evaluations
    for _ in range(ROUNDS):
        outliers = outliers_of(ungated.model_at(best.at), ungated.data_at(best.at), gate, ungated.starts)
        if stop() or (left_out is not None and np.array_equal(outliers, left_out)):
            break
        left_out, objective = outliers, without_outliers(ungated, outliers, gate)
        best = climb(objective, best.at, stop=stop, progress=tell)
        spent += objective.evaluations
    objective.evaluations = spent
    return objective, best


def from_start(
    objective: Objective,
    number: int,
    point: np.ndarray,
    first: np.ndarray,
    simulation_first: bool,
    stop: Callable[[], bool] = lambda: False,
    tell: Callable[..., None] = lambda *_, **__: None,
) -> tuple[np.ndarray, Ascent, int]:
    """The start as it was used, the end of the search from it, and the number of evaluations."""
    before = objective.evaluations
    point = _finite_start(objective, point, first)
    ascent = _climb_from(objective, point, simulation_first, stop, partial(tell, number=number))
    return point, ascent, objective.evaluations - before


def _climb_from(objective: Objective, point, simulation_first: bool, stop, tell) -> Ascent:
    is_attitude = bool(recorded(objective).first_model.turns)  # without a filter's correction attitudes drift
    if simulation_first and not is_attitude:
        simulation = of_changed(objective, simulation=True)
        nearest = climb(simulation, point, stop=stop, iterations=15)
        objective.evaluations += simulation.evaluations
        if objective.value(nearest.at) > objective.value(point):
            point = nearest.at
    return climb(objective, point, stop=stop, progress=tell)


def _finite_start(objective: Objective, point: np.ndarray, first: np.ndarray) -> np.ndarray:
    """The point, moved towards the first start until the filter stays finite on all runs."""
    for _ in range(NEARER):
        if point is first or math.isfinite(objective.value(point)):
            break
        point = (point + first) / 2
    return point


def _others(coordinates: Coordinates, first: np.ndarray, starts, seed: int) -> list[np.ndarray]:
    if not isinstance(starts, (int, np.integer)):
        return [coordinates.start(dict(start)) for start in starts]
    rng, width = derived_generator(seed, START_POINTS), REACH * (coordinates.high - coordinates.low)
    drawn = [
        first + width * rng.uniform(-1, 1, len(first))
        for _ in range(at_least("starts", starts, 1, MOST_STARTS) - 1)
    ]
    return list(map(coordinates.clip, drawn))
