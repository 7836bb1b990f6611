"""Runs of the thruster for docs/filters.md, and pictures of filters whose belief is Gaussian."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from docs.scripts import about, digits, legend_below, log_ticks, subplots
from filters import (
    Estimates,
    ExtendedKalmanFilter,
    FuzzyKalmanFilter,
    GaussianSumFilter,
    KalmanFilter,
    StateSpaceModel,
    make_filter,
    run,
    smooth,
    thruster_model,
)
from filters.bounds import posterior_bound
from filters.consistency.nees import normalized_squares, rmse_ratios
from filters.filter import Filter
from filters.gaussian.mixtures import BLENDINGS
from filters.logs.findings import TRUTH, plot_style
from filters.registry import FILTERS
from thruster_env.core.files import BLUE, DARK, MUSTARD, RUST, SKY, save_figure
from thruster_env.core.streams import episode_keys, filter_keys
from thruster_env.core.text_tables import markdown_table
from thruster_env.thruster.analysis import steady_state
from thruster_env.thruster.equations import simulate
from thruster_env.thruster.parameters import PRESETS
from thruster_env.thruster.plant import Plant, make_plant
from tuning.problems.data import FIRST_SCORED_STEP
from tuning.problems.excitation import held_levels

SEED, RUNS, STEPS, AMPLITUDE, HOLD, DT = 1, 60, 500, 12.0, 25, 0.01
PUBLISHED_NOISE = {"process_noise_cov": (0.5, 0.5), "measurement_noise_cov": 0.5}

# Those of the page alone beside those that filters have everywhere.
STYLES = {name: plot_style(name) for name in FILTERS} | {
    "truth": TRUTH,
    "scheduled": {"color": MUSTARD, "linestyle": "-."},
}


class Runs(NamedTuple):
    """Keys, inputs and measurements of B runs of K steps, and the true states."""

    keys: np.ndarray  # (B, 2), the filters'
    inputs: np.ndarray  # (B, K, 1) [V]
    measurements: np.ndarray  # (B, K + 1, m), NaN where missing
    states: np.ndarray  # (B, K + 1, 2)

    @property
    def arguments(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The arguments of `filters.run`."""
        return self.keys, self.inputs, self.measurements


def runs_of(plant: Plant, voltages: np.ndarray) -> Runs:
    """Runs of a plant under voltages (B, K), with the seeds 0, 1, ..."""
    seeds = range(len(voltages))
    simulated = simulate(plant, episode_keys(seeds), voltages)
    measurements = np.where(simulated.valid, simulated.measurements, np.nan)
    return Runs(filter_keys(seeds), voltages[..., None], measurements, simulated.states)


def held_runs(runs: int = RUNS, amplitude: float = AMPLITUDE, centre: float = 0.0, **plant) -> Runs:
    """Runs of `make_plant(**plant)` under levels about a centre [V], each held for a quarter of a second."""
    levels = held_levels(episode_keys(range(runs)), amplitude, HOLD, STEPS)
    return runs_of(make_plant(**plant), centre + levels)


def rmse(estimates: Estimates, runs: Runs) -> np.ndarray:
    """RMSE of (omega_m [rad/s], U_a [m/s]) from step 50 on, over all runs."""
    errors = estimates.means[..., :2] - runs.states
    return np.sqrt((errors[:, FIRST_SCORED_STEP:] ** 2).mean(axis=(0, 1)))


def nees(estimates: Estimates, runs: Runs) -> float:
    """Mean NEES of (omega_m, U_a) from step 50 on; 2 is right. NaN without a covariance."""
    errors = (estimates.means[..., :2] - runs.states)[:, FIRST_SCORED_STEP:]
    squares = normalized_squares(errors, estimates.covs[:, FIRST_SCORED_STEP:, :2, :2])
    regular = squares[~np.isnan(squares)]  # singular covariances are left out
    return float(regular.mean()) if regular.size else float("nan")


def errors_of(filter_: Filter, runs: Runs) -> tuple[float, float, float]:
    """RMSE of omega_m [rad/s], RMSE of U_a [m/s] and mean NEES of a filter."""
    estimates = run(filter_, *runs.arguments)
    return (*rmse(estimates, runs), nees(estimates, runs))


def deviations(estimates: Estimates, state: int) -> np.ndarray:
    """Standard deviations (B, K + 1) that a filter claims for a state."""
    return np.sqrt(estimates.covs[..., state, state])


def times(count: int) -> np.ndarray:
    """Times [s] of so many steps, from 0 on."""
    return DT * np.arange(count)


FLOW = "flow velocity $U_a$ [m/s]"
FLOW_RMSE = "RMSE of $U_a$ [m/s]"


def kalman(path: Path) -> Path:
    """Kalman filters about one and several operating points, over the voltage and in a run that reverses."""
    model = thruster_model()
    filters = {
        "kf": KalmanFilter(model=model),
        "scheduled": KalmanFilter(model=model, schedule=9),
        "ekf": ExtendedKalmanFilter(model=model),
    }
    names = {"kf": "kf about 12 V", "scheduled": "kf, schedule of 9 points", "ekf": "ekf"}
    voltages = np.arange(1.0, 24.5, 0.5)
    steady = [runs_of(make_plant(), np.full((20, 200), voltage)) for voltage in voltages]
    reversing = held_runs(1)
    figure, (left, right) = subplots((9.6, 3.6), 1, 2, width_ratios=(2, 3))
    for name, filter_ in filters.items():
        errors = [rmse(run(filter_, *runs.arguments), runs)[1] for runs in steady]
        left.plot(voltages, errors, label=names[name], **STYLES[name])
        estimate = run(filter_, *reversing.arguments).means[0, :, 1]
        right.plot(times(len(estimate)), estimate, **STYLES[name])
    right.plot(times(501), reversing.states[0, :, 1], **STYLES["truth"])
    left.plot([], [], label="truth", **STYLES["truth"])
    log_ticks(left.yaxis, (0.03, 0.05, 0.1, 0.2, 0.5))
    left.set(xlabel="constant voltage [V]", ylabel=FLOW_RMSE)
    right.set(xlabel="time [s]", ylabel=FLOW)
    right.set_title("levels within $\\pm$12 V, each for 0.25 s", fontsize=10)
    left.set_title("constant voltage", fontsize=10)
    legend_below(figure, left)
    return save_figure(figure, path)


def one_update(path: Path) -> Path:
    """Each filter's update at a point where the thrust hardly depends on U_a."""
    motor, mean, deviation, z = 100.0, 0.3, 0.7, 3.0
    model = thruster_model(measurement_noise_cov=0.5).replace(
        prior_mean=[motor, mean], prior_cov=[1e-6, deviation**2]
    )
    flow = np.linspace(-2.0, 4.5, 651)
    thrust = np.array([model.observe((motor, u), model.constants)[0] for u in flow])
    prior = np.exp(-0.5 * ((flow - mean) / deviation) ** 2)
    posterior = prior * np.exp(-0.5 * (z - thrust) ** 2 / 0.5)
    step = flow[1] - flow[0]
    z_at_mean = model.observe((motor, mean), model.constants)[0]
    slope = model.observe_jacobian((motor, mean), model.constants)[0][1]
    figure, (left, right) = subplots((9.6, 3.6), 1, 2)
    left.plot(flow, thrust, color=DARK, label="$T(\\omega_m, U_a)$ at 100 rad/s")
    left.axhspan(z - 0.5**0.5, z + 0.5**0.5, color=RUST, alpha=0.25, linewidth=0, label="measured, 1 std")
    left.plot(flow, z_at_mean + slope * (flow - mean), "--", color=BLUE, label="tangent at the mean")
    left.set(ylim=(-30, 25), ylabel="thrust [N]")
    right.fill_between(flow, posterior / posterior.sum() / step, color=DARK, alpha=0.2, label="exact posterior")
    right.plot(flow, prior / prior.sum() / step, color=DARK, linestyle=":", label="prior")
    for name in ("ekf", "iekf", "ukf"):
        belief, _ = make_filter(name, model).update(make_filter(name, model).init(), [z])
        right.plot(flow, _density(flow, belief.mean[1], belief.cov[1, 1]), label=name, **STYLES[name])
    sums = GaussianSumFilter(model=model)
    means, covs, weights = sums.part_estimates(sums.update(sums.init(), [z])[0])
    density = sum(w * _density(flow, x[1], p[1, 1]) for w, x, p in zip(weights, means, covs, strict=True))
    right.plot(flow, density, label="gsf, its parts", **STYLES["gsf"])
    right.set_ylabel("density [s/m]")
    left.plot([mean], [z_at_mean], "o", color=BLUE, markersize=5)
    for axis in (left, right):
        axis.set_xlabel(FLOW)
        axis.legend(fontsize=8, frameon=False)
    return save_figure(figure, path)


def sigma_points(path: Path) -> Path:
    """A run at the published noise, and errors over the bound as the noise of the flow grows."""
    names = ("ekf", "iekf", "ukf", "ckf", "gsf")
    figure, (left, right) = subplots((9.6, 3.8), 1, 2, width_ratios=(3, 2))
    runs, model, window = held_runs(1, **PUBLISHED_NOISE), thruster_model(**PUBLISHED_NOISE), slice(50, 201)
    for name in ("ekf", "ukf", "gsf"):
        estimates = run(make_filter(name, model), *runs.arguments)
        error, spread = (part[0, window] for part in (estimates.means[..., 1], deviations(estimates, 1)))
        error = error - runs.states[0, window, 1]
        left.plot(times(501)[window], error, **(STYLES[name] | {"linewidth": 1.2}))
        if name == "ekf":
            edges = -1.96 * spread, 1.96 * spread
            left.fill_between(times(501)[window], *edges, color=BLUE, alpha=0.15, linewidth=0)
    left.set_title("noise of the flow 0.71 m/s a step; band: 95 % as the ekf believes", fontsize=10)
    left.set(xlabel="time [s]", ylabel="error of $U_a$ [m/s]")
    stds = np.geomspace(0.02, 0.5**0.5, 10)
    ratios = np.array([_over_the_bound(names, std) for std in stds])
    for name, ratio in zip(names, ratios.T, strict=True):
        right.plot(stds, ratio, label=name, **STYLES[name])
    log_ticks(right.xaxis, (0.02, 0.05, 0.1, 0.2, 0.5))
    log_ticks(right.yaxis, (1, 2, 5))
    right.set(xlabel="noise of the flow, std a step [m/s]", ylabel="RMSE of $U_a$ over its bound [-]")
    legend_below(figure, right, 5)
    return save_figure(figure, path)


def smoothers(path: Path) -> Path:
    """Errors over the lag, and a gap in the measurements seen forwards and backwards."""
    model, runs = thruster_model(), held_runs()
    kinds = {
        "ekf": ("ekf", {}, STYLES["ekf"]),
        "enkf, N = 20": ("enkf", {"ensemble_size": 20}, STYLES["enkf"]),
        "enkf, N = 200": ("enkf", {"ensemble_size": 200}, STYLES["enkf"] | {"linestyle": "--"}),
    }
    lags = (0, 1, 2, 3, 5, 7, 10, 15, 20, 30, 50)
    figure, (left, right) = subplots((9.6, 3.6), 1, 2, width_ratios=(2, 3))
    for label, (name, numbers, look) in kinds.items():
        filter_ = make_filter(name, model, **numbers)
        errors = [_smoothed_rmse(filter_, runs, lag) for lag in lags]
        left.plot(lags, errors, label=label, **look)
    left.set_ylim(bottom=0.038)
    left.set(xlabel="lag [steps]", ylabel=FLOW_RMSE)
    left.legend(fontsize=8, frameon=False)
    gap, window = runs.measurements[:1].copy(), slice(230, 331)
    gap[:, 260:300] = np.nan
    arguments = runs.keys[:1], runs.inputs[:1], gap
    filter_ = ExtendedKalmanFilter(model=model)
    drawn = {"filter": (run(filter_, *arguments), BLUE), "smoother": (smooth(filter_, *arguments), RUST)}
    truth, time = runs.states[0, window, 1], times(501)[window]
    for label, (estimates, colour) in drawn.items():
        error, spread = estimates.means[0, window, 1] - truth, deviations(estimates, 1)[0, window]
        right.plot(time, error, color=colour, label=label)
        for edge in (-1.96 * spread, 1.96 * spread):
            right.plot(time, edge, color=colour, linewidth=0.8, linestyle=":")
    right.axvspan(2.6, 2.99, color=DARK, alpha=0.1, linewidth=0, label="nothing measured")
    right.set(xlabel="time [s]", ylabel="error of $U_a$ and 95 % band [m/s]")
    right.legend(fontsize=8, frameon=False)
    return save_figure(figure, path)


def _density(x: np.ndarray, mean: float, variance: float) -> np.ndarray:
    return np.exp(-0.5 * (x - mean) ** 2 / variance) / np.sqrt(2 * np.pi * variance)


def _over_the_bound(names: tuple[str, ...], std: float) -> list[float]:
    """RMSE of U_a over its bound, for the published noise but for the flow's."""
    noise = PUBLISHED_NOISE | {"process_noise_cov": (0.5, std**2)}
    runs, model = held_runs(RUNS, **noise), thruster_model(**noise)
    bound = posterior_bound(model, runs.inputs)[:, FIRST_SCORED_STEP:, 1, 1].mean() ** 0.5
    return [errors_of(make_filter(name, model), runs)[1] / bound for name in names]


def _smoothed_rmse(filter_, runs, lag: int) -> float:
    errors = smooth(filter_, *runs.arguments, lag=lag).means[..., 1] - runs.states[..., 1]
    return float((errors[:, FIRST_SCORED_STEP:] ** 2).mean() ** 0.5)


CENTRE = 12.0  # [V]
SHOWN_WIDTH = 12.0  # [V], of the run that is drawn
WIDTHS = (1.0, 2.0, 4.0, 6.0, 9.0, SHOWN_WIDTH, 16.0, 20.0, 24.0)  # [V]
TABLE_WIDTHS = (2.0, 6.0)  # [V]
BLENDING_LOOKS = {
    "weights": STYLES["fuzzy"],
    "moments": {"color": SKY},
    "output": {"color": DARK, "linestyle": ":"},
}


def blendings(path: Path) -> Path:
    """The fuzzy filters over the width of the range that their rules span, and a run."""
    figure, (left, right) = subplots((9.6, 3.8), 1, 2, width_ratios=(2, 3))
    looks = {f"fuzzy, {blending}": look for blending, look in BLENDING_LOOKS.items()}
    looks |= {name: STYLES[name] for name in ("kf", "ekf")}
    errors = {label: [] for label in looks}
    for width in WIDTHS:
        model, runs = _about_the_centre(width, 20)
        filters = {f"fuzzy, {blending}": _fuzzy(model, width, blending=blending) for blending in BLENDINGS}
        filters |= {name: make_filter(name, model) for name in ("kf", "ekf")}
        for label, filter_ in filters.items():
            errors[label].append(errors_of(filter_, runs)[1])
            if width == SHOWN_WIDTH:
                estimate = run(filter_, *runs.arguments).means[0, :, 1]
                right.plot(times(len(estimate)), estimate, **looks[label])
        if width == SHOWN_WIDTH:
            right.plot(times(501), runs.states[0, :, 1], **STYLES["truth"])
    for label, values in errors.items():
        left.plot(WIDTHS, values, label=label, **looks[label])
    left.plot([], [], label="truth", **STYLES["truth"])
    log_ticks(left.yaxis, (0.03, 0.1, 0.3, 1, 3, 10))
    left.set(xlabel="width of the voltages' range about 12 V [V]", ylabel=FLOW_RMSE)
    right.set_title("levels from 6 to 18 V", fontsize=10)
    right.set(xlabel="time [s]", ylabel=FLOW)
    legend_below(figure, left, 6)
    return save_figure(figure, path)


def fuzzy() -> str:
    """The blendings on the same runs: RMSE, over that of the sources' recursion, and NEES."""
    rows = []
    for width in TABLE_WIDTHS:
        model, runs = _about_the_centre(width)
        low, high = CENTRE - width / 2, CENTRE + width / 2
        filters = {f"`{blending}`": _fuzzy(model, width, blending=blending) for blending in BLENDINGS}
        filters["`weights`, no offsets"] = _fuzzy(model, width, blending="weights", offsets=False)
        rows += _rows(f"{low:g} to {high:g} V", model, runs, filters)
    model, runs = thruster_model(), held_runs()
    filters = {f"`{blending}`": FuzzyKalmanFilter(model=model, blending=blending) for blending in BLENDINGS}
    filters["`weights`, no offsets"] = FuzzyKalmanFilter(model=model, offsets=False)
    rows += _rows("-12 to 12 V", model, runs, filters)
    over = "over `weights`"
    return markdown_table(["levels", "filter", "omega_m [rad/s]", over, "U_a [m/s]", over, "NEES"], rows)


def _rows(name: str, model: StateSpaceModel, runs: Runs, filters: dict[str, Filter]) -> list[list[str]]:
    filters = filters | {f"`{other}`": make_filter(other, model) for other in ("kf", "ekf")}
    rows, first = [], None
    for label, filter_ in filters.items():
        estimates = run(filter_, *runs.arguments)
        errors = (estimates.means - runs.states)[:, FIRST_SCORED_STEP:]
        squares = (errors**2).mean(axis=1)  # of each run, (B, 2)
        cells = [name if first is None else "", label]
        ratios = ("", "") if first is None else map(about, rmse_ratios(squares, first))
        for rmse, ratio in zip(np.sqrt(squares.mean(axis=0)), ratios, strict=True):
            cells += [digits(rmse), ratio]
        rows.append([*cells, digits(nees(estimates, runs))])
        first = squares if first is None else first
    return rows


def _about_the_centre(width: float, *count: int) -> tuple[StateSpaceModel, Runs]:
    """A model and runs whose levels span a width [V] about the centre, from its steady state on."""
    start = {"voltage": CENTRE}
    runs = held_runs(*count, amplitude=width / 2, centre=CENTRE, initial_state=start)
    return thruster_model(initial_state=start), runs


def _fuzzy(model: StateSpaceModel, width: float, **choices) -> FuzzyKalmanFilter:
    low, high = (steady_state(PRESETS["tunnel"], CENTRE + sign * width / 2)[:2] for sign in (-1, 1))
    return FuzzyKalmanFilter(model=model, low=low, high=high, **choices)


PICTURES = {"kalman": kalman, "update": one_update, "points": sigma_points, "fuzzy": blendings}
PICTURES["smoothers"] = smoothers
