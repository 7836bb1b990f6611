"""Pictures of docs/filters.md: ensembles, particles, and beliefs with several modes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from filters import ParticleFilter, make_filter, run, thruster_model
from filters.ensembles.rank_histogram import record_members
from pages.filter_runs import PUBLISHED_NOISE, STYLES, Runs, errors_of, held_runs, runs_of, times
from pages.page import log_ticks
from thruster_env.core.plots import DARK, RUST, new_figure, save_figure, tidy
from thruster_env.thruster.plant import make_plant

SIGNLESS = {"sensors": ["speed-magnitude"], "process_noise_cov": (4.0, 4e-4), "measurement_noise_cov": [0.25]}


def signless_runs(count: int) -> Runs:
    """Runs with a tachometer without a sign; the voltage swings slowly within plus and minus 0.3 V."""
    voltage = 0.3 * np.sin(2 * np.pi * times(500) / 2.5)
    return runs_of(make_plant(**SIGNLESS), np.tile(voltage, (count, 1)))


def ensembles(path: Path) -> Path:
    """Errors and NEES over the size of an ensemble; what inflation and relaxation do to a small one."""
    runs, model = held_runs(), thruster_model()
    sizes = (5, 8, 12, 20, 30, 50, 100, 200, 400)
    figure = new_figure((9.6, 3.6))
    axes = figure.subplots(1, 3)
    tidy(axes)
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
        axis.set_xlabel("members N")
        axis.set_ylabel(label)
    log_ticks(axes[1].yaxis, (2, 3, 5, 10))
    axes[2].set_xlim(0.045, 0.092)
    axes[2].set_title("enkf, N = 8", fontsize=10)
    axes[2].set_xlabel("RMSE of $U_a$ [m/s]")
    axes[2].set_ylabel("mean NEES [-]")
    for axis in axes:
        axis.legend(fontsize=8, frameon=False)
    return save_figure(figure, path)


def modes(path: Path) -> Path:
    """A belief with two modes over time, and errors over the number of particles at the published noise."""
    model, runs, window = thruster_model(**SIGNLESS), signless_runs(1), slice(90, 171)
    figure = new_figure((9.6, 3.8))
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    tidy((left, right))
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
    left.set_xlabel("time [s]")
    left.set_ylabel("motor speed [rad/s]")
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
    right.set_xlabel("members or particles N")
    right.set_ylabel("RMSE of $U_a$ [m/s]")
    right.legend(fontsize=8, frameon=False, ncols=3)
    return save_figure(figure, path)


def _mean(filter_, runs: Runs) -> np.ndarray:
    return run(filter_, *runs.arguments).means[0, :, 0]
