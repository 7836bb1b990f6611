"""A plant's parameters by maximum likelihood of a filter's innovations: identification, profiles, validation.

The search is from several starts. With a gate, samples with large innovations of a robust filter are outliers
and left out. A profile is the likelihood with one parameter held elsewhere. Validation compares the model's
prediction, simulation and likelihood on other runs before and after identification.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from filters.adaptive import RobustExtendedKalmanFilter
from filters.engine.batch import Estimates
from filters.starts import Starts, as_the_prior_says
from thruster_env.core.checks import at_least, one_of, short_repr
from thruster_env.core.files import BLUE, DARK, RUST, panels
from thruster_env.core.parallel import IN_PROCESS, TaskMap
from thruster_env.core.sources import as_value
from thruster_env.core.streams import START_POINTS, derived_generator
from thruster_env.core.text_tables import verbatim
from thruster_env.logs.log import Log
from thruster_env.model.simulate import inputs_until
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.model.turns import about_mean, differences_of, innovations_of, of_channels, readings
from tuning.likelihood.ascent import Ascent, climb
from tuning.likelihood.identifiability import SIGNIFICANT, TWO_SIDED
from tuning.likelihood.objective import Objective
from tuning.likelihood.recorded import estimates_of, likelihood_of, of_changed, recorded, runs_of, starts_of
from tuning.likelihood.result import (
    Identification,
    NullTest,
    Optimum,
    covariances_of,
    is_narrow,
    null_of,
    null_tests,
)
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


def identification_of(
    objective: Objective,
    first: np.ndarray,
    best: Ascent,
    optima: tuple[Optimum, ...],
    tests: Mapping[str, NullTest] | None = None,
    *,
    interrupted: bool,
    seconds: float,
) -> Identification:
    """The result at the best maximum, with standard errors and which parameters are determined."""
    coordinates, at = objective.coordinates, best.at
    width = coordinates.high - coordinates.low
    cov, _ = covariances_of(objective, best)
    errors = np.sqrt(np.diag(cov))
    ends = (at <= coordinates.low + 1e-6 * width) | (at >= coordinates.high - 1e-6 * width)
    natural, values = errors * np.abs(coordinates.slopes(at)), coordinates.values(at)
    narrow, not_zero = is_narrow(cov, coordinates), np.abs(values) > TWO_SIDED * natural
    names = coordinates.names

    def by_name(values) -> dict:
        return dict(zip(names, np.asarray(values).tolist(), strict=True))

    return Identification(
        names=names,
        values=coordinates.named(at),
        start=coordinates.named(first),
        standard_errors=by_name(natural),
        cov=cov,
        at=at,
        at_end=by_name(ends),
        determined=by_name(narrow & ~ends & not_zero),
        narrow=by_name(narrow),
        log_likelihood=best.found.value,
        start_log_likelihood=objective.value(first),
        optima=optima,
        objective=objective,
        interrupted=interrupted,
        seconds=seconds,
        null_tests=tests or {},
    )


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


HELD_AT = (0.75, 1.5, 2.5)  # standard errors at which a parameter is held
WIDE = 10.0  # ends of a range whose ratio is beyond this are told apart on a logarithmic axis alone
LEGS = 6  # iterations of the other parameters at each


class Profile(NamedTuple):
    """log L maximised over all other parameters, with one parameter held at several values."""

    name: str
    values: np.ndarray  # (count,), rising
    log_likelihoods: np.ndarray  # (count,)

    @property
    def interval(self) -> tuple[float, float]:
        """Where log L is within 1.92 of its maximum, a 95 % interval; infinite where no end was found."""
        falls = self.log_likelihoods.max() - self.log_likelihoods
        best = int(np.argmin(falls))
        ends = []
        for side in (slice(None, best + 1), slice(best, None)):
            fall, value = falls[side], self.values[side]
            order = np.argsort(fall)
            if fall.max() < SIGNIFICANT:
                ends.append(np.inf if side.stop is None else -np.inf)
            else:
                ends.append(float(np.interp(np.sqrt(SIGNIFICANT), np.sqrt(fall[order]), value[order])))
        return ends[0], ends[1]


def profiles(
    identification: Identification,
    names: Sequence[str] | None = None,
    *,
    reach: Sequence[float] = HELD_AT,
    progress: Callable[[str], None] = lambda name: None,
) -> list[Profile]:
    """Profile likelihoods of parameters; after Ctrl-C those that are done.

    Args:
        identification: from `identify`.
        names: names of the parameters; all if None.
        reach: distances in standard errors, to either side, at which a parameter is held, within its range.
        progress: called with the name of each parameter.

    Raises:
        ValueError: for an unknown name.

    Source: Raue et al. (2009), "Structural and practical identifiability analysis of partially observed dynamical
    models by exploiting the profile likelihood", Bioinformatics 25(15).
    """
    curves = []
    with stop_on_interrupt() as asked:
        for name in identification.names if names is None else names:
            index = identification.names.index(one_of("a parameter", name, identification.names))
            progress(name)
            points = [(identification.at[index], identification.log_likelihood)]
            for sign in (1.0, -1.0):
                points += _side(identification, index, [sign * part for part in reach], asked)
            if asked():
                break
            at, values = np.array(sorted(points)).T
            points_at = np.tile(identification.at, (len(at), 1))
            points_at[:, index] = at
            natural = np.array([identification.objective.coordinates.values(row)[index] for row in points_at])
            curves.append(Profile(name, natural, values))
    return curves


def _side(identification: Identification, index: int, reach: Sequence[float], asked) -> list[tuple[float, float]]:
    """Points outwards; the other parameters start in the direction of their correlation with this one."""
    coordinates, error = identification.objective.coordinates, np.sqrt(identification.cov[index, index])
    slope = identification.cov[:, index] / identification.cov[index, index]
    points: list[tuple[float, float]] = []
    fixed = np.arange(len(identification.at)) == index
    for part in reach:
        move = part * error
        at = coordinates.clip(identification.at + slope * move)
        if asked() or at[index] in [point for point, _ in points] or at[index] == identification.at[index]:
            break
        maximum = climb(identification.objective, at, fixed=fixed, iterations=LEGS, stop=asked)
        points.append((float(at[index]), maximum.found.value))
    return points


def profile_figure(identification: Identification, curves: Sequence[Profile]):
    """A panel for each profile: how far log L falls, the 95 % line, and the parabola of the standard error."""
    figure, axes = panels(len(curves), 3, (3.0, 2.2), 0.2)
    for axis, profile in zip(axes, curves, strict=True):
        falls = profile.log_likelihoods - identification.log_likelihood
        parameter = identification.objective.coordinates.free[identification.names.index(profile.name)]
        best, error = identification.values[profile.name], identification.standard_errors[profile.name]
        grid = np.linspace(profile.values[0], profile.values[-1], 100)
        axis.plot(grid, -0.5 * ((grid - best) / error) ** 2, color=RUST, linewidth=1, label="standard error")
        axis.plot(profile.values, falls, "o-", color=BLUE, linewidth=1.2, markersize=3, label="profile")
        axis.axhline(-SIGNIFICANT, color=DARK, linewidth=0.8, linestyle=":")
        if parameter.log and profile.values[-1] > WIDE * profile.values[0]:
            axis.set_xscale("log")
        axis.set_ylim(min(-4.0, falls.min() * 1.05), 0.3)
        axis.set_xlabel(verbatim(profile.name + (f" [{parameter.unit}]" if parameter.unit else "")))
        axis.set_ylabel("fall in log L")
    axes[0].legend(fontsize=7, frameon=False)
    return figure


class Validation(NamedTuple):
    """Metrics of a model on some runs, by the measurements' symbols, in their units."""

    log_likelihood: float  # of the innovations
    one_step: dict[str, float]  # RMSE of the one-step prediction
    simulation: dict[str, float]  # RMSE of the simulation, which uses no measurement
    fit: dict[str, float]  # 100 (1 - RMSE of the simulation / standard deviation of the measurement) [%]
    nis: float  # mean NIS over the number of channels; 1 for a consistent filter


def validation_of(
    model: StateSpaceModel, runs: Data, unseen: Sequence[bool] | None = None, starts: Starts | None = None
) -> Validation:
    """Metrics of a model on runs.

    The simulation is a filter without process noise and prior covariance, whose gain is zero. Of runs that do not
    begin as the prior says it begins where their first rows say, and these do not count.

    Args:
        model: the model of the filter.
        runs: inputs and measurements.
        unseen: (m,) which channels the filter only predicts: their errors are those of the estimate.
        starts: of the runs; None if all begin as the model's prior says.
    """
    symbols = [channel.symbol for channel in innovations_of(model)]
    hidden = np.zeros(model.m, dtype=bool) if unseen is None else np.asarray(unseen)
    starts = as_the_prior_says(model, len(runs.measurements)) if starts is None else starts
    counted = np.arange(runs.measurements.shape[1]) >= starts.counted_from[:, None]
    turns = model.measured_turns
    scored = ~np.isnan(readings(runs.measurements, turns)) & counted[..., None]
    visible = runs._replace(measurements=np.where(of_channels(hidden.tolist(), turns), np.nan, runs.measurements))
    estimates, nothing = estimates_of(model, visible, starts), np.zeros((model.t, model.t))
    known = starts._replace(covs=np.zeros_like(starts.covs))
    simulated = estimates_of(model.replace(process_noise_cov=nothing, prior_cov=nothing), visible, known)

    def rmse(estimates: Estimates) -> np.ndarray:
        errors = np.where(hidden, _less_predicted(model, runs, estimates, hidden), estimates.innovations)
        return np.sqrt((np.where(scored, errors, 0.0) ** 2).sum(axis=(0, 1)) / scored.sum(axis=(0, 1)))

    one_step, simulation = rmse(estimates), rmse(simulated)
    rows = np.where(counted[..., None], runs.measurements, np.nan).reshape(-1, model.channels)
    rows = about_mean(rows, turns, model.any_shape.measurement_angles)
    spread = np.array([rows[~np.isnan(rows[:, i]), i].std() for i in range(model.m)])
    fit = 100 * (1 - simulation / np.where(spread > 0, spread, np.nan))
    weighted = np.linalg.solve(estimates.innovation_covs, estimates.innovations[..., None])[..., 0]
    nis = (weighted * estimates.innovations)[counted].sum() / scored[..., ~hidden].sum()

    def by_symbol(values: np.ndarray) -> dict[str, float]:
        return dict(zip(symbols, map(float, values), strict=True))

    likelihood = float(estimates.log_likelihoods[counted].sum())
    return Validation(likelihood, by_symbol(one_step), by_symbol(simulation), by_symbol(fit), float(nis))


def validate(
    identification: Identification, data: Data | Log | Sequence[Data | Log] | None = None
) -> dict[str, Validation]:
    """The model at the start and at the identified values, "start" and "identified".

    Args:
        identification: from `identify`.
        data: held-out runs; None for those of the identification. If a free parameter moves the data, held-out
            runs must be given as a function of it, too.
    """
    objective = identification.objective
    if data is not None:
        objective = of_changed(objective, data=data, starts=None)
    points = {
        "start": objective.coordinates.of([identification.start[name] for name in identification.names]),
        "identified": identification.at,
    }
    unseen, starts = objective.unseen, objective.starts
    if data is not None:
        prior_moves = objective.moves_prior(identification.at)
        starts = (
            None
            if prior_moves
            else starts_of(objective.model_at(identification.at), objective.data_at(identification.at), unseen)
        )
    return {
        name: validation_of(objective.model_at(at), objective.data_at(at), unseen, starts)
        for name, at in points.items()
    }


def _less_predicted(model: StateSpaceModel, runs: Data, estimates: Estimates, hidden: np.ndarray) -> np.ndarray:
    """Measurements minus their prediction from the estimates, if some channels are hidden; else zeros."""
    if not hidden.any():
        return np.zeros((*runs.measurements.shape[:2], model.m))
    observe, c, fed = model.functions.observe, model.given_constants, model.any_shape.fed
    inputs = inputs_until(runs.inputs)
    predicted = [
        [observe(as_value(x), *fed(as_value(u)), c) for x, u in zip(*run, strict=True)]
        for run in zip(estimates.means.tolist(), inputs.tolist(), strict=True)
    ]
    return differences_of(model, runs.measurements, np.array(predicted))
