"""Runs of the thruster for docs/filters.md, and its pictures but those of unknown noise, which `filters` has."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from docs.scripts import about, digits, log_ticks, subplots
from filters import (
    Estimates,
    ExtendedKalmanFilter,
    FuzzyKalmanFilter,
    GaussianSumFilter,
    InteractingMultipleModelFilter,
    KalmanFilter,
    ParticleFilter,
    StateSpaceModel,
    affine_model,
    make_filter,
    run,
    smooth,
    thruster_model,
)
from filters.bounds import posterior_bound
from filters.consistency.nees import normalized_squares, rmse_ratios
from filters.ensembles.square_root import record_members
from filters.filter import Filter
from filters.gaussian.mixtures import BLENDINGS
from filters.logs.findings import TRUTH, plot_style
from filters.registry import FILTERS
from thruster_env.core.files import BLUE, DARK, MUSTARD, PALE, RUST, legend_below, save_figure
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
    legend_below(figure, [left])
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
    legend_below(figure, [right])
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
TABLE_WIDTHS = (2.0, 6.0)  # [V]


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


SIGNLESS = {"sensors": ["speed-magnitude"], "process_noise_cov": (4.0, 4e-4), "measurement_noise_cov": [0.25]}


def signless_runs(count: int) -> Runs:
    """Runs with a tachometer without a sign; the voltage swings slowly within plus and minus 0.3 V."""
    voltage = 0.3 * np.sin(2 * np.pi * times(500) / 2.5)
    return runs_of(make_plant(**SIGNLESS), np.tile(voltage, (count, 1)))


def ensembles(path: Path) -> Path:
    """Errors and NEES over the size of an ensemble; what inflation and relaxation do to a small one."""
    runs, model = held_runs(), thruster_model()
    sizes = (5, 8, 12, 20, 30, 50, 100, 200, 400)
    figure, axes = subplots((9.6, 3.6), 1, 3)
    for name in ("enkf", "etkf", "denkf", "enkf-n"):
        results = [errors_of(make_filter(name, model, ensemble_size=size), runs) for size in sizes]
        for axis, values in zip(axes, list(zip(*results, strict=True))[1:], strict=False):
            axis.plot(sizes, values, label=name, **STYLES[name])
    _, error, _ = errors_of(make_filter("ekf", model), runs)
    axes[0].axhline(error, label="ekf", **STYLES["ekf"])
    axes[1].axhline(2.0, color=DARK, linestyle=":", label="2 is right")
    controls = {
        "inflation": ((1.0, 1.02, 1.05, 1.1, 1.2), RUST, "o-"),
        "relaxation": ((0.0, 0.25, 0.5, 0.75, 0.9), DARK, "s--"),
    }
    for control, (values, colour, marks) in controls.items():
        points = [errors_of(make_filter("enkf", model, ensemble_size=8, **{control: v}), runs)[1:] for v in values]
        axes[2].plot(*zip(*points, strict=True), marks, color=colour, markersize=4, linewidth=1.2, label=control)
        for value, (x, y) in zip(values, points, strict=True):
            offset, side = ((5, 3), "left") if control == "inflation" else ((-6, -3), "right")
            text = {"textcoords": "offset points", "fontsize": 7, "color": colour, "ha": side}
            axes[2].annotate(f"{value:g}", (x, y), offset, **text)
    for axis, label in zip(axes, ("RMSE of $U_a$ [m/s]", "mean NEES [-]"), strict=False):
        log_ticks(axis.xaxis, (5, 10, 20, 50, 100, 200, 400))
        axis.set(xlabel="members N", ylabel=label)
    log_ticks(axes[1].yaxis, (2, 3, 5, 10))
    axes[2].set_xlim(0.045, 0.092)
    axes[2].set_title("enkf, N = 8", fontsize=10)
    axes[2].set(xlabel="RMSE of $U_a$ [m/s]", ylabel="mean NEES [-]")
    for axis in axes:
        axis.legend(fontsize=8, frameon=False)
    return save_figure(figure, path)


def modes(path: Path) -> Path:
    """A belief with two modes over time, and errors over the number of particles at the published noise."""
    model, runs, window = thruster_model(**SIGNLESS), signless_runs(1), slice(90, 171)
    figure, (left, right) = subplots((9.6, 3.8), 1, 2, width_ratios=(3, 2))
    recorded = record_members(ParticleFilter(model=model, ensemble_size=20_000), *runs.arguments)
    edges, steps = np.linspace(-12, 12, 97), range(window.start, window.stop)
    density = np.array(
        [np.histogram(recorded.members[0, k, 0], edges, weights=recorded.weights[0, k])[0] for k in steps]
    )
    between = times(501)[window]
    cells = (*(np.append(between, between[-1] + 0.01) - 0.005,), edges)
    left.pcolormesh(*cells, np.sqrt(density.T), cmap="Greys", rasterized=True)
    looks = {
        "ekf": STYLES["ekf"],
        "pf": STYLES["pf"],
        "truth": {"color": RUST, "linestyle": "none", "marker": "o", "markersize": 3},
    }
    for name in looks:
        mean = runs.states[0, :, 0] if name == "truth" else _mean(make_filter(name, model), runs)
        left.plot(between, mean[window], label=name, **looks[name])
    left.set_title("$|\\omega_m|$ is measured; grey: the particles", fontsize=10)
    left.set(xlabel="time [s]", ylabel="motor speed [rad/s]")
    left.grid(visible=False)
    left.legend(fontsize=8, frameon=False, loc="upper right")
    runs, model = held_runs(20, **PUBLISHED_NOISE), thruster_model(**PUBLISHED_NOISE)
    sizes = (20, 50, 100, 200, 500, 1000, 2000)
    for name in ("pf", "enkf", "ienkf"):
        errors = [errors_of(make_filter(name, model, ensemble_size=size), runs)[1] for size in sizes]
        right.plot(sizes, errors, label=name, **STYLES[name])
    for name in ("ekf", "gsf"):
        look = STYLES[name] | {"linestyle": ":"}
        right.axhline(errors_of(make_filter(name, model), runs)[1], label=name, **look)
    log_ticks(right.xaxis, (20, 50, 100, 200, 500, 1000, 2000))
    right.set_ylim(0.15, 0.56)
    right.set_title("published noise, thrust measured", fontsize=10)
    right.set(xlabel="members or particles N", ylabel="RMSE of $U_a$ [m/s]")
    right.legend(fontsize=8, frameon=False, ncols=3)
    return save_figure(figure, path)


def _mean(filter_, runs: Runs) -> np.ndarray:
    return run(filter_, *runs.arguments).means[0, :, 0]


LOST_FROM, LOST_TO, LEVEL = 150, 350, 12.0  # steps; [V]


def half_lost(model: StateSpaceModel) -> StateSpaceModel:
    """The same thruster with half of its thrust."""
    names = [name for name in model.constants._fields if name.startswith("thrust_")]
    return model.replace(
        constants=model.constants._replace(**{k: 0.5 * getattr(model.constants, k) for k in names})
    )


def run_that_switches(intact: StateSpaceModel, seed: int = 2) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States (K + 1, 2), thrusts (K + 1, 1), voltages (K, 1) of a run that loses half of its thrust."""
    generator, steps = np.random.default_rng(seed), np.arange(STEPS + 1)
    inputs = np.repeat(generator.uniform(-LEVEL, LEVEL, STEPS // 25), 25)[:, None]
    is_lost = (steps >= LOST_FROM) & (steps < LOST_TO)
    return *followed([intact, half_lost(intact)], is_lost.astype(int), inputs, generator), inputs


def followed(
    models: Sequence[StateSpaceModel], modes: np.ndarray, inputs: np.ndarray, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """States (K + 1, n) and measurements (K + 1, m) of a plant that is models[modes[k]] at step k."""
    first, states, measured = models[modes[0]], [], []
    x = generator.multivariate_normal(first.prior_mean, first.prior_cov)
    for k, mode in enumerate(modes):
        model = models[mode]
        if k:
            for _ in range(model.substeps):
                x = np.array(model.transition(tuple(x), tuple(inputs[k - 1]), model.constants))
            x = x + generator.multivariate_normal(np.zeros(len(x)), model.process_noise_cov)
        measured.append(
            generator.multivariate_normal(model.observe(tuple(x), model.constants), model.measurement_noise_cov)
        )
        states.append(x)
    return np.array(states), np.array(measured)


def several(path: Path) -> Path:
    """The probability of a mode, and errors with and without it."""
    intact = thruster_model()
    states, measured, inputs = run_that_switches(intact)
    imm = InteractingMultipleModelFilter(model=intact, modes=[intact, half_lost(intact)], stay=0.98)
    figure, (left, right) = subplots((9.6, 3.6), 1, 2)
    probabilities = []
    for filter_ in (imm, make_filter("ekf", intact)):
        belief, means = filter_.init(), []
        for k, z in enumerate(measured):
            belief, _ = filter_.update(filter_.predict(belief, inputs[k - 1]) if k else belief, z)
            means.append(belief.mean)
            if filter_ is imm:
                probabilities.append(imm.mode_probabilities(belief)[1])
        right.plot(
            times(STEPS + 1), np.array(means)[:, 1] - states[:, 1], label=filter_.name, **STYLES[filter_.name]
        )
    left.plot(times(STEPS + 1), probabilities, **STYLES["imm"])
    for axis in (left, right):
        axis.axvspan(
            *times(STEPS + 1)[[LOST_FROM, LOST_TO]], color=PALE, alpha=0.3, label="half of the thrust is lost"
        )
        axis.set_xlabel("time [s]")
    left.set_ylabel("probability that it is lost")
    right.set_ylabel("error of $U_a$ [m/s]")
    right.legend(fontsize=8, frameon=False)
    return save_figure(figure, path)


def point() -> StateSpaceModel:
    """A point whose position is measured, R = 1; its acceleration is noise of variance 0.01, to the filters."""
    f, g = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[0.5], [1.0]])
    noise = {"process_noise_cov": 0.01 * g @ g.T, "measurement_noise_cov": [1.0]}
    return affine_model(a=f, b=g, c=[[1.0, 0.0]], prior_mean=[0.0, 0.0], prior_cov=[1.0, 0.1], **noise)


def swung(frequencies: np.ndarray, steps: int = 4000) -> np.ndarray:
    """States (B, K + 1, 2) of points that accelerate by 0.1 sin(w k)."""
    a, b, *_ = point().matrices()
    states = np.zeros((len(frequencies), steps + 1, 2))
    for k in range(steps):
        states[:, k + 1] = states[:, k] @ a.T + 0.1 * np.sin(frequencies * (k + 1))[:, None] * b.T
    return states


def weighted(path: Path) -> Path:
    """Errors over the frequency of a disturbance that is no white noise; the worst beside those by noise."""
    model, frequencies = point(), np.logspace(-2.5, 0.4, 25)
    states = swung(frequencies)
    noise, inputs = (
        np.random.default_rng(0).normal(size=(1, states.shape[1], 1)),
        np.zeros((1, states.shape[1] - 1, 1)),
    )

    def errors(filter_: Filter) -> tuple[np.ndarray, float]:
        differences = run(filter_, None, np.repeat(inputs, len(states), axis=0), states[..., :1]).means - states
        by_noise = run(filter_, None, inputs, noise).means
        return np.sqrt(np.mean(differences[:, 2000:, 0] ** 2, axis=1)), float(by_noise[0, 2000:, 0].std())

    families = {
        "kf": [make_filter("kf", model)],
        "fading": [make_filter("fading", model, fading=a) for a in (1.02, 1.05, 1.1, 1.15, 1.2)],
        "h-infinity": [
            make_filter("h-infinity", model, theta=theta, scale=[1.0, 1e6]) for theta in (0.05, 0.1, 0.2, 0.3, 0.4)
        ],
    }
    figure, (left, right) = subplots((9.6, 3.6), 1, 2)
    for name, filters in families.items():
        points = [errors(filter_) for filter_ in filters]
        index = min(3, len(filters) - 1)
        label = {"fading": "fading, a = 1.15", "h-infinity": "h-infinity, theta = 0.3"}.get(name, name)
        left.plot(frequencies, points[index][0], label=label, **STYLES[name])
        right.plot(
            [noise for _, noise in points],
            [errors.max() for errors, _ in points],
            marker="o",
            ms=4,
            **STYLES[name],
        )
    left.set(xscale="log", xlabel="frequency of the acceleration [rad/step]", ylabel="RMS error of the position")
    left.legend(fontsize=8, frameon=False)
    right.set(xlabel="RMS error by measurement noise alone", ylabel="error at the worst frequency")
    return save_figure(figure, path)


PICTURES = {
    **{"kalman": kalman, "update": one_update, "points": sigma_points, "smoothers": smoothers},
    **{"ensembles": ensembles, "modes": modes, "weighted": weighted, "several": several},
}
