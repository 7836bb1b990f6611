"""`View`: a filter's estimates with their bands, innovations, consistency over time, and figures.

In order: the data of a bench, which are runs of a plant or whole logs; the view; the disturbances of a plant as
numbers; the numbers that one may change, with their ranges and known values; and one figure of a view.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from filters.consistency.nees import LAGS, band_of_means, whiteness
from filters.engine.batch import Estimates
from filters.filter import Filter
from thruster_env.core.checks import at_least, between
from thruster_env.core.streams import filter_keys
from thruster_env.logs.log import seen_by
from thruster_env.model.quantities import Quantity
from tuning.evaluation.evaluate import Evaluation, compute_metrics
from tuning.evaluation.runs import RunMetrics, metrics_by_run, metrics_of_all
from tuning.problems.check import data_of
from tuning.problems.data import Data, estimates_on, mask_of, only, padded
from tuning.problems.log_problem import LogProblem
from tuning.problems.problem import Parameter, Problem, score_label
from tuning.problems.scenario import PlantScenario, plain
from tuning.search.parameters import PRIOR, Correlation, FilterParameter, MeasurementVariance, ProcessVariance, Q
from tuning.search.space import Choice, everything_of, neutral, parameters, parameters_of

if TYPE_CHECKING:
    import matplotlib.figure
    from matplotlib.axes import Axes

    from tuning.exploring.bench import Bench

WITHIN_95 = 1.959963984540054  # standard normal deviates
MOST_STATES, MOST_INNOVATIONS = 4, 2
INK, ESTIMATE = "#1b1f24", "#0b6bb8"
LOWER, HIGHER, NEAR = "lower", "higher", "near"  # what is better in a figure
SENSORS, AMPLIFIER = "sensors", "amplifier"  # fields of a scenario that hold effects
SIGMA = "sigma"  # unit of what is said in standard deviations of the sensor's noise
GROUPS = ("Q", "R", "model", "filter", "prior", "correlations", "disturbances")


class PageData(NamedTuple):
    """What is drawn, and what is counted: the same runs, unless they are logs."""

    drawn: Data  # of a plant the runs of some seeds; of logs each log as a whole
    counted: Data  # of a plant the same; of logs the training blocks
    held_out: Data | None  # of logs the held-out blocks; None of a plant


@lru_cache(maxsize=8)
def page_data(problem: Problem, seeds: int, seed: int, held_out: bool) -> PageData:
    """The data of a problem for a bench.

    Args:
        problem: what makes the data.
        seeds: number of seeds; logs are shown whole.
        seed: of the study whose training seeds, or held-out seeds, these are.
        held_out: whether they are those on which a study's choice is evaluated, as `thruster evaluate` does it.
    """
    if isinstance(problem, LogProblem):
        blocks = [
            data_of(problem, choose(seed, seeds)) for choose in (problem.training_seeds, problem.held_out_seeds)
        ]
        return PageData(_whole(problem), *blocks)
    choose = problem.held_out_seeds if held_out else problem.training_seeds
    data = data_of(problem, choose(seed, seeds))
    return PageData(data, data, None)


def _whole(problem: LogProblem) -> Data:
    """Each log from its first row to its last, with the random numbers of `thruster estimate`."""
    logs, model = problem.logs, problem.model()
    rows = max(len(log.measurements) for log in logs)
    data = Data(
        tuple(range(len(logs))),
        padded([log.inputs[: len(log.measurements) - 1] for log in logs], rows - 1, None),
        padded([seen_by(model, log.measurements) for log in logs], rows),
        np.repeat(filter_keys([0]), len(logs), axis=0),
        problem.first_scored_step,
        counted=mask_of([len(log.measurements) for log in logs], rows),
    )
    if problem.scale is None:
        return data.read_only()
    states = padded([truth for log in logs if (truth := log.true_states(model)) is not None], rows)
    known = only(data.counted, ~np.isnan(states).any(axis=-1))
    return data._replace(states=states, counted=known).read_only()


class Figure(NamedTuple):
    """A figure that sums up what is seen."""

    value: float
    unit: str
    better: str  # "lower", "higher", or "near" its target
    target: float | None = None  # the expected value of NEES and NIS


class View(NamedTuple):
    """A filter on S runs of K rows: of a plant one a seed, of logs one a log; NaN where there is nothing."""

    time: np.ndarray  # (S, K), [s], or steps where there is no sample time
    truth: np.ndarray | None  # (S, K, n), None where it is unknown
    estimate: np.ndarray  # (S, K, n)
    deviation: np.ndarray  # (S, K, n), standard deviations; half of the 95 % band is 1.96 of it
    innovation: np.ndarray  # (S, K, m), NaN where nothing was measured
    innovation_deviation: np.ndarray  # (S, K, m)
    nees: np.ndarray | None  # (S, K), NaN where a step is not scored; None without truth
    nis: np.ndarray  # (S, K), likewise
    nees_band: tuple[np.ndarray, np.ndarray] | None  # (K,) each: where the mean over the runs lies with 95 %
    nis_band: tuple[np.ndarray, np.ndarray]  # likewise
    autocorrelation: np.ndarray  # (m, L), of each channel's whitened innovations with themselves, lags 1 to L
    autocorrelation_band: float  # of white ones it lies within plus and minus this with 95 %
    figures: Mapping[str, Figure]


def view_of(filter_: Filter, page_data: PageData, problem: Problem) -> View:
    """A filter on the data of a bench."""
    data = page_data.drawn
    estimates = estimates_on(filter_, data)
    runs = metrics_by_run(filter_, estimates, data, outputs=False, scale=problem.scale)
    measured, n = ~np.isnan(data.seen.measurements), len(problem.quantities.states)
    white = _whiteness(estimates, data)
    truth = data.states is not None
    return View(
        time=_times(filter_, data, 1.0 if problem.dt is None else problem.dt),
        truth=data.known_states if truth else None,
        estimate=_there(data, estimates.means[..., :n]),
        deviation=_there(data, _deviations(estimates.covs)[..., :n]),
        innovation=np.where(measured, estimates.innovations, np.nan),
        innovation_deviation=np.where(measured, _deviations(estimates.innovation_covs), np.nan),
        nees=_padded_scores(runs.nees, data) if truth and runs.nees is not None else None,
        nis=_padded_scores(runs.nis, data),
        nees_band=_band(np.where(data.scored, float(n), 0.0)) if truth else None,
        nis_band=_band(np.where(data.scored, measured.sum(axis=-1), 0).astype(np.float64)),
        autocorrelation=white[0],
        autocorrelation_band=white[1],
        figures=_figures(filter_, page_data, runs, problem),
    )


def _times(filter_: Filter, data: Data, dt: float) -> np.ndarray:
    """Times (S, K) of all rows; of logs on their own stamps the last input says how many dt a step is."""
    runs, even = data.inputs.shape[0], dt * np.arange(data.steps + 1)
    if not filter_.model.shape.step_ratio:
        return np.broadcast_to(even, (runs, len(even)))
    return dt * np.concatenate([np.zeros((runs, 1)), np.cumsum(data.inputs[..., -1], axis=1)], axis=1)


def _figures(filter_: Filter, page_data: PageData, runs: RunMetrics, problem: Problem) -> dict[str, Figure]:
    """The figures of a bench: those of `tuning.evaluation`, without intervals."""
    data, scale = page_data.counted, problem.scale
    evaluation = _summed(filter_, data, scale, runs if data is page_data.drawn else None)
    figures = {**_of_states(evaluation, problem), **_of_innovations(evaluation)}
    if page_data.held_out is not None:
        held_out = _summed(filter_, page_data.held_out, scale)
        held_out_figures = {**_of_states(held_out, problem), **_of_innovations(held_out)}
        figures |= {f"held-out {name}": figure for name, figure in held_out_figures.items() if name != "restarts"}
    return figures


def _summed(filter_: Filter, data: Data, scale, runs: RunMetrics | None = None) -> Evaluation:
    """An evaluation without intervals and derived outputs, of metrics that are there or to be found."""
    metrics = metrics_of_all(filter_, data, outputs=False, scale=scale) if runs is None else runs
    return compute_metrics(filter_, metrics, data, scale, intervals=False, variances=False)


def _of_states(evaluation: Evaluation, problem: Problem) -> dict[str, Figure]:
    if not evaluation.has_truth:
        return {}
    rmse = {
        f"RMSE {state.symbol}": Figure(error.value, state.unit, LOWER)
        for state, error in zip(evaluation.states, evaluation.rmse, strict=True)
    }
    score = {score_label([problem]).partition(" [")[0]: Figure(evaluation.score.value, "-", LOWER)}
    nees = Figure(evaluation.nees.value, "-", NEAR, float(len(evaluation.rmse)))
    rest = {"NEES": nees, "log score": Figure(evaluation.log_score.value, "nat", HIGHER)}
    return {**rmse, **score, **{name: figure for name, figure in rest.items() if not np.isnan(figure.value)}}


def _of_innovations(evaluation: Evaluation) -> dict[str, Figure]:
    restarts = {"restarts": Figure(float(evaluation.divergences), "-", LOWER)}
    if np.isnan(evaluation.log_likelihood):
        return restarts
    nis = Figure(evaluation.nis.value, "-", NEAR, evaluation.expected_nis)
    return {"NIS": nis, "log-likelihood": Figure(evaluation.log_likelihood, "nat", HIGHER), **restarts}


def _padded_scores(late: np.ndarray, data: Data) -> np.ndarray:
    """Values (S, T) of late steps as those of all steps, NaN before."""
    values = np.full(data.measurements.shape[:2], np.nan)
    values[:, data.late] = late
    return values


def _there(data: Data, values: np.ndarray) -> np.ndarray:
    """Values (S, K, n), NaN in the padding of shorter runs."""
    if (data.rows == data.steps + 1).all():
        return values
    return np.where((np.arange(data.steps + 1) < data.rows[:, None])[..., None], values, np.nan)


def _band(freedom: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    low, high = band_of_means(freedom).T
    return low, high


def _deviations(covs: np.ndarray) -> np.ndarray:
    """Standard deviations (S, K, d) of covariances (S, K, d, d); zero without a covariance."""
    return np.sqrt(np.maximum(np.einsum("...ii->...i", covs), 0.0))


def _whiteness(estimates: Estimates, data: Data) -> tuple[np.ndarray, float]:
    """Autocorrelations (m, L) of the scored innovations, and the half-width of their band."""
    late = data.late
    present = ~np.isnan(data.late_scored(data.measurements))
    result = whiteness(
        estimates.innovations[:, late],
        estimates.innovation_covs[:, late],
        present,
        min(LAGS, present.shape[1] - 1),
    )
    widths = np.einsum("lii->il", result.half_widths)
    informative = widths[
        widths < 1.0
    ]  # of slow sensors some lags have no pairs, and any correlation lies within theirs
    return np.einsum("lii->il", result.correlations).copy(), float(informative.max(initial=0.0)) or 1.0


class Disturbance(NamedTuple):
    """One number of an effect, which is there where the number is positive."""

    name: str
    label: str
    effect: str  # by which `plants.disturbances` or the plant's own effects know it
    argument: str  # of the effect
    high: float
    unit: str
    start: float  # where the scenario has no such effect
    others: tuple[tuple[str, float], ...] = ()  # further arguments of an effect that the scenario does not have
    place: str = SENSORS

    @property
    def adds(self) -> bool:
        """Whether the number brings the effect with it; else it changes one that is there."""
        return self.start == 0.0


DISTURBANCES = (
    Disturbance("outliers", "share of outliers", "outliers", "probability", 0.5, "", 0.0, (("std", 20.0),)),
    Disturbance("outlier_size", "size of outliers", "outliers", "std", 100.0, SIGMA, 20.0),
    Disturbance("dropout", "share of missing measurements", "dropout", "probability", 0.95, "", 0.0),
    Disturbance("bias", "sensor bias", "bias", "std", 20.0, SIGMA, 0.0),
    Disturbance("dead_band", "dead band of the amplifier", "dead-band", "width", 4.0, "V", 0.0, place=AMPLIFIER),
)


@lru_cache(maxsize=32)
def disturbances_of(problem: Problem) -> dict[Disturbance, float]:
    """The disturbances that a problem's plant may have, with their present values; none without a plant."""
    if not isinstance(problem, PlantScenario):
        return {}
    return {
        disturbance: _present(disturbance, problem)
        for disturbance in DISTURBANCES
        if hasattr(problem, disturbance.place)
    }


def disturbed(problem: Problem, values: Mapping[str, float]) -> Problem:
    """The problem with other disturbances, under another name if any differs.

    Args:
        problem: on which it is based; its effects keep all arguments that are not among the values.
        values: by name of the disturbance: sizes in standard deviations of the sensor's noise.
    """
    present = disturbances_of(problem)
    wanted = {disturbance: values.get(disturbance.name, value) for disturbance, value in present.items()}
    if not isinstance(problem, PlantScenario) or all(
        _same(wanted[disturbance], value) for disturbance, value in present.items()
    ):
        return problem
    changes: dict[str, Any] = {}
    deviations = _sensor_deviations(problem)
    if any(
        not _same(wanted[disturbance], present[disturbance])
        for disturbance in present
        if disturbance.place == SENSORS
    ):
        changes[SENSORS] = {
            channel: _with(effects, wanted, present, SENSORS, deviation)
            for (channel, effects), deviation in zip(_sensors(problem).items(), deviations, strict=True)
        }
    if any(
        not _same(wanted[disturbance], present[disturbance])
        for disturbance in present
        if disturbance.place == AMPLIFIER
    ):
        changes[AMPLIFIER] = _with(_amplifier(problem), wanted, present, AMPLIFIER, 1.0)
    return problem.replace(name=f"{problem.name} (changed)", **changes)


def _same(value: float, other: float) -> bool:
    return math.isclose(value, other, rel_tol=1e-9, abs_tol=1e-12)


def _with(effects: list[dict], wanted: Mapping, present: Mapping, component: str, deviation: float) -> list[dict]:
    """A chain of effects with the wanted numbers."""
    chain = {effect["name"]: dict(effect) for effect in effects}
    for disturbance, value in wanted.items():
        if disturbance.place != component or (not disturbance.adds and disturbance.effect not in chain):
            continue
        if disturbance.adds and value <= 0.0:
            chain.pop(disturbance.effect, None)
            continue
        unit = deviation if disturbance.unit == SIGMA else 1.0
        if disturbance.effect not in chain:
            sizes = {key: number * deviation for key, number in disturbance.others}
            chain[disturbance.effect] = {"name": disturbance.effect, **sizes}
        elif _same(value, present[disturbance]):
            continue  # to the last digit, and of each channel its own
        chain[disturbance.effect][disturbance.argument] = value * unit
    return list(chain.values())


def _present(disturbance: Disturbance, problem: PlantScenario) -> float:
    """The number as the scenario has it, of the first channel that has the effect."""
    if disturbance.place == AMPLIFIER:
        chains = [(_amplifier(problem), 1.0)]
    else:
        chains = list(zip(_sensors(problem).values(), _sensor_deviations(problem), strict=True))
    for effects, deviation in chains:
        for effect in effects:
            if effect["name"] == disturbance.effect:
                value = effect.get(disturbance.argument, disturbance.start)
                return float(value / deviation if disturbance.unit == SIGMA else value)
    return disturbance.start


def _sensors(problem: Any) -> dict[str, list[dict]]:
    sensors = plain(problem.sensors)
    by_channel = sensors if isinstance(sensors, Mapping) else {}
    return {channel: list(by_channel.get(channel, [])) for channel in problem.plant.channels}


def _amplifier(problem: Any) -> list[dict]:
    return list(plain(problem.amplifier))


def _sensor_deviations(problem: Any) -> list[float]:
    noise_cov = problem.measurement_noise_cov
    variances = noise_cov if isinstance(noise_cov, list | tuple) else [noise_cov]
    return [math.sqrt(variance) for variance in variances]


class Knob(NamedTuple):
    """A number that one may change."""

    name: str  # that of a trial's parameter, or of a disturbance
    label: str
    unit: str
    low: float
    high: float
    log: bool
    integer: bool
    group: str  # one of `GROUPS`
    marks: Mapping[str, float]  # where baselines and the tuned filter have it

    def checked(self, value) -> float:
        """The value; ValueError unless it is a number within the range, of whole numbers a whole one."""
        number = between(self.name, value, self.low, self.high, self.unit)
        return at_least(self.name, value, int(self.low)) if self.integer else number


def knobs_of(name: str, problem: Problem, marks: Mapping[str, Mapping[str, float]]) -> tuple[Knob, ...]:
    """All numbers of a filter that a study may choose, and the disturbances of the plant.

    A variance has the part of a study's range in which its search begins, and what is marked.

    Args:
        name: of the filter.
        problem: what it is on.
        marks: values of knobs, by name, for each label.
    """
    knobs = []
    for parameter in parameters(name, problem, **everything_of(problem)):
        marked = {label: values[parameter.name] for label, values in marks.items() if parameter.name in values}
        low, high = parameter.first or (parameter.low, parameter.high)
        low, high = min([low, *marked.values()]), max([high, *marked.values()])
        label, group = _called(parameter, problem)
        knobs.append(
            Knob(parameter.name, label, parameter.unit, low, high, parameter.log, parameter.integer, group, marked)
        )
    for disturbance, value in disturbances_of(problem).items():
        what, high = disturbance, max(disturbance.high, value)
        knobs.append(Knob(what.name, what.label, what.unit, 0.0, high, False, False, "disturbances", {}))
    return tuple(knobs)


def _called(parameter: Parameter, problem: Problem) -> tuple[str, str]:
    position, quantities = parameter.place, problem.quantities
    if isinstance(position, ProcessVariance):
        return f"Q of the {problem.errors[position.index].name}", "Q"
    if isinstance(position, MeasurementVariance):
        return f"R of the {quantities.measurements[position.index].name}", "R"
    if isinstance(position, Correlation):
        return (
            f"correlation in {'Q' if position.covariance == Q else 'R'}, {parameter.name.rpartition('_')[2]}",
            "correlations",
        )
    if position == PRIOR:
        return "factor on the prior covariance", "prior"
    if isinstance(position, FilterParameter):
        return position.name.replace("_", " "), "filter"
    return parameter.name.replace("_", " "), "model"


def start_of(knobs: Sequence[Knob], problem: Problem, choice: Choice) -> dict[str, float]:
    """The value of each knob for a choice on a problem."""
    chosen = parameters_of(choice)
    plant = {disturbance.name: value for disturbance, value in disturbances_of(problem).items()}
    values = {}
    for knob in knobs:
        value = plant.get(knob.name, chosen.get(knob.name, neutral(knob.name)))
        values[knob.name] = knob.low if value is None else value
    return values


def figure_of(bench: Bench, view: View, run: int = 0, title: str | None = None) -> matplotlib.figure.Figure:
    """One run's states in their bands and its innovations; NIS, NEES and autocorrelation of all runs."""
    import matplotlib.figure

    run = min(run, len(view.estimate) - 1)
    panels: list[Callable[[Axes], None]] = []
    for i, named in enumerate(bench.states[:MOST_STATES]):
        panels.append(partial(_state, view=view, run=run, i=i, named=named))
    for i, named in enumerate(bench.measurements[:MOST_INNOVATIONS]):
        panels.append(partial(_innovation, view=view, run=run, i=i, named=named))
    panels.append(lambda ax: _level(ax, view.time[run], view.nis, view.nis_band, "NIS"))
    if view.nees is not None and view.nees_band is not None:
        nees, band = view.nees, view.nees_band
        panels.append(lambda ax: _level(ax, view.time[run], nees, band, "NEES"))
    panels.append(lambda ax: _lags(ax, view))
    rows = -(-len(panels) // 2)
    figure = matplotlib.figure.Figure(figsize=(9.0, 1.5 * rows + 0.6), layout="constrained")
    numbers = ",  ".join(
        f"{name} {figure_.value:.3g} {figure_.unit}".rstrip() for name, figure_ in view.figures.items()
    )
    figure.suptitle(f"{title or bench.title}\n{numbers}", fontsize=8)
    axes = figure.subplots(rows, 2, squeeze=False).ravel()
    for ax, draw in zip(axes, panels, strict=False):
        draw(ax)
        ax.tick_params(labelsize=7)
        ax.xaxis.label.set_size(7)
        ax.yaxis.label.set_size(7)
        ax.spines[["top", "right"]].set_visible(False)
        ax.margins(x=0.01)
    for ax in axes[len(panels) :]:
        ax.set_visible(False)
    return figure


def _state(ax: Axes, view: View, run: int, i: int, named: Quantity) -> None:
    mean, half = view.estimate[run, :, i], WITHIN_95 * view.deviation[run, :, i]
    ax.fill_between(view.time[run], mean - half, mean + half, color=ESTIMATE, alpha=0.2, linewidth=0)
    if view.truth is not None:
        ax.plot(view.time[run], view.truth[run, :, i], color=INK, linewidth=0.8)
    ax.plot(view.time[run], mean, color=ESTIMATE, linewidth=1.0)
    ax.set_ylabel(_labelled(named))


def _innovation(ax: Axes, view: View, run: int, i: int, named: Quantity) -> None:
    half = WITHIN_95 * view.innovation_deviation[run, :, i]
    ax.fill_between(view.time[run], -half, half, color=ESTIMATE, alpha=0.2, linewidth=0)
    ax.plot(*present(view.time[run], view.innovation[run, :, i]), color=ESTIMATE, linewidth=0.7)
    ax.set_ylabel(f"innovation {_labelled(named)}")


def _level(
    ax: Axes, time: np.ndarray, values: np.ndarray, band: tuple[np.ndarray, np.ndarray], label: str
) -> None:
    ax.fill_between(time, *band, color=ESTIMATE, alpha=0.2, linewidth=0)
    ax.semilogy(*present(time, mean_of_runs(values)), color=ESTIMATE, linewidth=0.7)
    ax.set_ylabel(label)


def _lags(ax: Axes, view: View) -> None:
    ax.axhspan(-view.autocorrelation_band, view.autocorrelation_band, color=ESTIMATE, alpha=0.2, linewidth=0)
    for channel in np.asarray(view.autocorrelation):
        ax.vlines(np.arange(1, len(channel) + 1), 0.0, channel, color=ESTIMATE)
    ax.set_ylim(-1.0, 1.0)
    ax.set_xlabel("lag [steps]")
    ax.set_ylabel("autocorrelation")


def _labelled(named: Quantity) -> str:
    return f"{named.name} [{named.unit}]" if named.unit else named.name


def present(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Times and values where there is one: between two others that are missing, a line would show none."""
    known = ~np.isnan(values)
    return time[known], values[known]


def mean_of_runs(values: np.ndarray) -> np.ndarray:
    """The mean over runs (S, K) -> (K,) of what is finite; NaN where nothing is."""
    known = np.isfinite(values)
    total = np.where(known, values, 0.0).sum(axis=0)
    return np.where(known.any(axis=0), total / np.maximum(known.sum(axis=0), 1), np.nan)
