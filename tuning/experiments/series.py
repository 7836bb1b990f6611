"""One run of each linear system at each noise level over time: truth, Kalman and ensemble Kalman filter."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from filters import EnsembleKalmanFilter, KalmanFilter
from filters.engine.batch import run
from filters.ensembles.ensemble import LARGEST_ENSEMBLE
from filters.logs.figure import TRUTH, plot_style
from thruster_env.core.checks import at_least
from thruster_env.core.plots import new_figure, save_figure, tidy
from thruster_env.model.simulate import simulate
from thruster_env.thruster.linear.analysis import STATES
from thruster_env.thruster.linear.published import SAMPLE_TIME
from tuning.experiments.comparison import MEMBERS, discrete_model, keys_of
from tuning.experiments.published import NOISE_LEVELS, STEPS, SYSTEMS

LINES = {
    "truth": TRUTH,
    "KF": plot_style("kf") | {"linewidth": 1.2},
    "EnKF": plot_style("enkf") | {"linewidth": 1.2, "linestyle": (0, (3, 2))},  # in whose gaps the other is seen
}


class Series(NamedTuple):
    """The first run of a comparison; states are (omega_m [rad/s], U_a [m/s])."""

    case: str
    q: float
    time: np.ndarray  # (101,) [s]
    measurements: np.ndarray  # (101, 1) [N]
    truth: np.ndarray  # (101, 2)
    kf: np.ndarray  # (101, 2)
    enkf: np.ndarray  # (101, 2)

    def rmse(self, filter_: str) -> np.ndarray:
        """RMSE (2,) over steps 1 to 100 of "kf" or "enkf", as in the papers' tables."""
        errors = getattr(self, filter_) - self.truth
        return np.sqrt((errors[1:] ** 2).mean(axis=0))


def series(case: str, q: float, *, members: int = MEMBERS, seed: int = 0) -> Series:
    """The first of the runs that `comparison.compare` makes with the same seed; its arguments and errors."""
    members, seed = at_least("members", members, 2, LARGEST_ENSEMBLE), at_least("seed", seed, 0)
    model = discrete_model(case, q)
    keys, _ = keys_of(case, q, 1, seed)
    inputs = np.zeros((1, STEPS, model.inputs))
    truth = simulate(model, keys, inputs)
    kf, enkf = (
        run(filter_, keys, inputs, truth.measurements).means[0]
        for filter_ in (KalmanFilter(model=model), EnsembleKalmanFilter(model=model, ensemble_size=members))
    )
    time = SAMPLE_TIME * np.arange(STEPS + 1)
    return Series(case, q, time, truth.measurements[0], truth.states[0], kf, enkf)


def all_series(*, members: int = MEMBERS, seed: int = 0) -> list[Series]:
    """`series` for every case and noise level, in the order of `comparison.compare_all`."""
    return [series(case, q, members=members, seed=seed) for case in SYSTEMS for q in NOISE_LEVELS]


def series_figure(path: str | Path, runs: list[Series], members: int) -> Path:
    """Truth, KF and EnKF over time as PNG: a column for each noise level, a row for each case and state."""
    cases, levels = list(dict.fromkeys(one.case for one in runs)), list(dict.fromkeys(one.q for one in runs))
    figure = new_figure((3.3 * len(levels) + 0.6, 2.15 * 2 * len(cases) + 0.6))
    axes = figure.subplots(2 * len(cases), len(levels), sharex=True, sharey="row", squeeze=False)
    tidy(axes.flat)
    for one in runs:
        first, column = 2 * cases.index(one.case), levels.index(one.q)
        errors = one.rmse("kf"), one.rmse("enkf")
        for state, (label, unit) in enumerate(STATES):
            axis = axes[first + state, column]
            for (name, line), values in zip(LINES.items(), (one.truth, one.kf, one.enkf), strict=True):
                axis.plot(one.time, values[:, state], label=name, **line)
            said = f"RMSE: KF {errors[0][state]:.3f}, EnKF {errors[1][state]:.3f} {unit}"
            axis.set_title(f"q = {one.q:g}\n{said}" if first + state == 0 else said, fontsize=9)
            if column == 0:
                axis.set_ylabel(f"{one.case}\n{label}\n[{unit}]")
    for axis in axes[-1]:
        axis.set_xlabel("time [s]")
    figure.align_ylabels(axes[:, 0])
    handles, labels = axes[0, 0].get_legend_handles_labels()
    labels = [f"{name}, {members} members" if name == "EnKF" else name for name in labels]
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False)
    figure.suptitle("One run of the published linear systems, Q = R = q I", fontsize=11)
    return save_figure(figure, path)
