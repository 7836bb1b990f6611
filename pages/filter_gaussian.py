"""Pictures of docs/filters.md: filters whose belief is a Gaussian or a sum of Gaussians."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from filters import (
    ExtendedKalmanFilter,
    GaussianSumFilter,
    KalmanFilter,
    make_filter,
    run,
    smooth,
    thruster_model,
)
from filters.posterior import posterior_bound
from pages.filter_runs import PUBLISHED_NOISE, RUNS, STYLES, deviations, errors_of, held_runs, rmse, runs_of, times
from pages.page import legend_below, log_ticks
from thruster_env.core.plots import BLUE, DARK, RUST, new_figure, save_figure, tidy
from thruster_env.thruster.plant import make_plant
from tuning.problems.data import FIRST_SCORED_STEP

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
    figure = new_figure((9.6, 3.6))
    left, right = figure.subplots(1, 2, width_ratios=(2, 3))
    tidy((left, right))
    for name, filter_ in filters.items():
        errors = [rmse(run(filter_, *runs.arguments), runs)[1] for runs in steady]
        left.plot(voltages, errors, label=names[name], **STYLES[name])
        estimate = run(filter_, *reversing.arguments).means[0, :, 1]
        right.plot(times(len(estimate)), estimate, **STYLES[name])
    right.plot(times(501), reversing.states[0, :, 1], **STYLES["truth"])
    left.plot([], [], label="truth", **STYLES["truth"])
    log_ticks(left.yaxis, (0.03, 0.05, 0.1, 0.2, 0.5))
    left.set_xlabel("constant voltage [V]")
    left.set_ylabel(FLOW_RMSE)
    right.set_xlabel("time [s]")
    right.set_ylabel(FLOW)
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
    figure = new_figure((9.6, 3.6))
    left, right = figure.subplots(1, 2)
    tidy((left, right))
    left.plot(flow, thrust, color=DARK, label="$T(\\omega_m, U_a)$ at 100 rad/s")
    left.axhspan(z - 0.5**0.5, z + 0.5**0.5, color=RUST, alpha=0.25, linewidth=0, label="measured, 1 std")
    left.plot(flow, z_at_mean + slope * (flow - mean), "--", color=BLUE, label="tangent at the mean")
    left.set_ylim(-30, 25)
    left.set_ylabel("thrust [N]")
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
    figure = new_figure((9.6, 3.8))
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    tidy((left, right))
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
    left.set_xlabel("time [s]")
    left.set_ylabel("error of $U_a$ [m/s]")
    stds = np.geomspace(0.02, 0.5**0.5, 10)
    ratios = np.array([_over_the_bound(names, std) for std in stds])
    for name, ratio in zip(names, ratios.T, strict=True):
        right.plot(stds, ratio, label=name, **STYLES[name])
    log_ticks(right.xaxis, (0.02, 0.05, 0.1, 0.2, 0.5))
    log_ticks(right.yaxis, (1, 2, 5))
    right.set_xlabel("noise of the flow, std a step [m/s]")
    right.set_ylabel("RMSE of $U_a$ over its bound [-]")
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
    figure = new_figure((9.6, 3.6))
    left, right = figure.subplots(1, 2, width_ratios=(2, 3))
    tidy((left, right))
    for label, (name, numbers, look) in kinds.items():
        filter_ = make_filter(name, model, **numbers)
        errors = [_smoothed_rmse(filter_, runs, lag) for lag in lags]
        left.plot(lags, errors, label=label, **look)
    left.set_ylim(bottom=0.038)
    left.set_xlabel("lag [steps]")
    left.set_ylabel(FLOW_RMSE)
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
    right.set_xlabel("time [s]")
    right.set_ylabel("error of $U_a$ and 95 % band [m/s]")
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
