"""Pictures of docs/filters.md: what is not known of the noise or the model, and what is not measured."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from filters import (
    ExtendedKalmanFilter,
    SageHusaFilter,
    Unknown,
    VariationalBayesFilter,
    augmented_model,
    make_filter,
    run,
    thruster_model,
)
from pages.filter_runs import RUNS, SEED, STYLES, Runs, deviations, errors_of, held_runs, times
from pages.page import legend_below, log_ticks
from thruster_env.core.plots import BLUE, DARK, MUSTARD, RUST, new_figure, save_figure, tidy

FLOW = "flow velocity $U_a$ [m/s]"
FLOW_RMSE = "RMSE of $U_a$ [m/s]"
QUIET, LOUD = 0.5, 2.0  # standard deviations [N] of a sensor whose noise changes
OUTLIER = 10.0  # [N]


def outliers(share: float) -> dict:
    """Argument of a plant: so many of the measurements are off by a normal variate of 10 N."""
    return {"sensors": {"thrust": [{"name": "outliers", "std": OUTLIER, "probability": share}]}}


def noisy(runs: Runs, stds: np.ndarray) -> Runs:
    """Runs with new measurement noise of standard deviations (K + 1,) [N]."""
    thrust = thruster_model().output("T", runs.states)
    draws = np.random.default_rng(SEED).normal(size=thrust.shape)
    return runs._replace(measurements=(thrust + stds * draws)[..., None])


def adaptive(path: Path) -> Path:
    """Estimates of R after the sensor has changed, and errors over the share of outliers."""
    model = thruster_model(measurement_noise_cov=QUIET**2)
    stds = np.where(np.arange(501) < 200, QUIET, LOUD)
    runs = noisy(held_runs(20), stds)
    figure = new_figure((9.6, 3.6))
    left, right = figure.subplots(1, 2)
    tidy((left, right))
    left.plot(times(501), stds, label="truth", **STYLES["truth"])
    for filter_ in (VariationalBayesFilter(model=model), SageHusaFilter(model=model)):
        learnt = np.sqrt([_learnt_noise(filter_, runs, run_) for run_ in range(len(runs.keys))])
        left.plot(times(501), learnt.mean(axis=0), label=filter_.name, **STYLES[filter_.name])
        left.fill_between(
            times(501), *np.quantile(learnt, (0.1, 0.9), axis=0), alpha=0.2, color=STYLES[filter_.name]["color"]
        )
    left.set_xlabel("time [s]")
    left.set_ylabel("std of the sensor's noise [N]")
    left.legend(fontsize=8, frameon=False, loc="upper left")
    shares = (0.0, 0.02, 0.05, 0.1, 0.2, 0.4, 0.6)
    for name in ("ekf", "sage-husa", "vb", "ekf-robust"):
        errors = [
            errors_of(make_filter(name, thruster_model()), held_runs(**outliers(share)))[1] for share in shares
        ]
        right.plot([100 * share for share in shares], errors, label=name, **STYLES[name])
    right.set_xlabel("measurements that are off by 10 N [%]")
    right.set_ylabel(FLOW_RMSE)
    right.set_ylim(0.04, 0.12)
    right.legend(fontsize=8, frameon=False)
    return save_figure(figure, path)


def baselines(path: Path) -> Path:
    """Baselines beside the extended filter, in still water and in a flow that nobody knows of."""
    figure = new_figure((9.6, 3.8))
    axes = figure.subplots(1, 2, sharey=True)
    tidy(axes)
    for axis, flow in zip(axes, (0.0, 1.0), strict=True):
        runs, window = held_runs(1, ambient_velocity=flow), slice(100, 251)
        for name in ("inversion", "low-pass", "open-loop", "ekf"):
            estimate = run(make_filter(name, thruster_model()), *runs.arguments).means[0, window, 1]
            axis.plot(times(501)[window], estimate, label=name, **STYLES[name])
        axis.plot(times(501)[window], runs.states[0, window, 1], label="truth", **STYLES["truth"])
        axis.set_title(f"ambient flow {flow:g} m/s, believed to be 0", fontsize=10)
        axis.set_xlabel("time [s]")
    axes[0].set_ylabel(FLOW)
    legend_below(figure, axes[0], 5)
    return save_figure(figure, path)


def augmented(path: Path) -> Path:
    """The ambient flow as a third state: where it is found, where not, and what that is worth."""
    joint = augmented_model(thruster_model(), {"ambient_velocity": Unknown(std=0.5)})
    figure = new_figure((9.6, 3.6))
    left, right = figure.subplots(1, 2)
    tidy((left, right))
    examples = {
        "levels within $\\pm$12 V": (12.0, {}, BLUE),
        "0 V, from rest": (0.0, {"initial_state": [0.0, 0.0]}, RUST),
    }
    for label, (amplitude, start, colour) in examples.items():
        runs = held_runs(1, amplitude, ambient_velocity=0.6, **start)
        estimates = run(ExtendedKalmanFilter(model=joint), *runs.arguments)
        mean, spread = estimates.means[0, :, 2], deviations(estimates, 2)[0]
        left.plot(times(501), mean, color=colour, label=label)
        left.fill_between(
            times(501), mean - 1.96 * spread, mean + 1.96 * spread, color=colour, alpha=0.15, linewidth=0
        )
    left.axhline(0.6, label="truth", **STYLES["truth"])
    left.set_xlabel("time [s]")
    left.set_ylabel("ambient flow and 95 % band [m/s]")
    left.legend(fontsize=8, frameon=False, loc="lower right")
    flows = np.linspace(-1.0, 1.0, 9)
    errors = {"ignored": [], "a third state": [], "known": []}
    for flow in flows:
        runs = held_runs(20, ambient_velocity=flow)
        models = (thruster_model(), joint, thruster_model(ambient_velocity=flow))
        for values, model in zip(errors.values(), models, strict=True):
            values.append(errors_of(ExtendedKalmanFilter(model=model), runs)[1])
    for (label, values), look in zip(errors.items(), ((RUST, "--"), (BLUE, "-"), (DARK, ":")), strict=True):
        right.plot(flows, values, color=look[0], linestyle=look[1], label=f"flow {label}")
    right.set_ylim(bottom=0.03)
    right.set_xticks(flows[::2])
    right.set_xlabel("ambient flow [m/s]")
    right.set_ylabel(FLOW_RMSE)
    right.legend(fontsize=8, frameon=False)
    return save_figure(figure, path)


def varying(path: Path) -> Path:
    """R that is known step by step, and measurements that are missing or held."""
    model, burst = thruster_model(), np.ones(501, dtype=bool)
    burst[:200], burst[300:] = False, False
    stds = np.where(burst, LOUD, QUIET)
    runs = noisy(held_runs(RUNS), stds)
    figure = new_figure((9.6, 3.6))
    left, right = figure.subplots(1, 2)
    tidy((left, right))
    covs = (stds**2)[:, None, None]
    known = run(ExtendedKalmanFilter(model=model), *runs.arguments, measurement_noise_covs=covs)
    fixed = run(ExtendedKalmanFilter(model=model), *runs.arguments)
    for label, estimates, colour, dashes in (("R of each step", known, BLUE, "-"), ("one R", fixed, RUST, "--")):
        squares = ((estimates.means[..., 1] - runs.states[..., 1]) ** 2).mean(axis=0)
        smooth = np.sqrt(np.convolve(squares, np.ones(10) / 10, "same"))
        left.plot(times(501)[20:480], smooth[20:480], color=colour, linestyle=dashes, label=label)
    left.axvspan(2.0, 2.99, color=DARK, alpha=0.1, linewidth=0, label="noise of 2 N, else 0.5 N")
    left.set_xlabel("time [s]")
    left.set_ylabel("RMSE of $U_a$ over 10 steps [m/s]")
    left.set_ylim(bottom=0.0)
    left.legend(fontsize=8, frameon=False)
    shares = (0.0, 0.1, 0.25, 0.5, 0.75, 0.9)
    errors = {"NaN, so left out": [], "held, as if measured": [], "open loop": []}
    for share in shares:
        dropout = [{"name": "dropout", "probability": share, "mean_length": 20.0}] if share else []
        runs = held_runs(sensors={"thrust": dropout})
        filled = runs._replace(measurements=_last_valid(runs.measurements))
        cases = ((ExtendedKalmanFilter, runs), (ExtendedKalmanFilter, filled))
        for values, (kind, data) in zip(errors.values(), cases, strict=False):
            values.append(errors_of(kind(model=model), data)[1])
        errors["open loop"].append(errors_of(make_filter("open-loop", model), runs)[1])
    looks = ((BLUE, "-"), (RUST, "--"), (MUSTARD, ":"))
    for (label, values), (colour, dashes) in zip(errors.items(), looks, strict=True):
        right.plot([100 * share for share in shares], values, color=colour, linestyle=dashes, label=label)
    log_ticks(right.yaxis, (0.05, 0.1, 0.2, 0.5, 1))
    right.set_xlabel("measurements missing, in runs of 20 [%]")
    right.set_ylabel(FLOW_RMSE)
    right.legend(fontsize=8, frameon=False)
    return save_figure(figure, path)


def _learnt_noise(filter_, runs: Runs, number: int) -> list[float]:
    """R that a filter estimates after each measurement of a run."""
    belief, noises = filter_.init(), []
    inputs = [None, *runs.inputs[number]]
    for u, z in zip(inputs, runs.measurements[number], strict=True):
        belief, _ = filter_.update(belief if u is None else filter_.predict(belief, u), z)
        noises.append(filter_.estimated_noise(belief)[0, 0])
    return noises


def _last_valid(measurements: np.ndarray) -> np.ndarray:
    """Measurements (B, K + 1, 1) with the last valid one, 0 at first, where one is missing."""
    measured = ~np.isnan(measurements)
    last = np.maximum.accumulate(np.where(measured, np.arange(measurements.shape[1])[None, :, None], -1), axis=1)
    values = np.take_along_axis(measurements, np.maximum(last, 0), axis=1)
    return np.where(last < 0, 0.0, values)
