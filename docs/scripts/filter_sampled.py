"""Pictures of docs/filters.md: ensembles, particles, horizons, and several models."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from docs.scripts import legend_below, log_ticks, subplots
from docs.scripts.filter_gaussian import PUBLISHED_NOISE, STYLES, Runs, errors_of, held_runs, runs_of, times
from docs.scripts.ranking import POSITIVE, SETTLED, assumed, batches
from filters import InteractingMultipleModelFilter, ParticleFilter, affine_model, make_filter, run, thruster_model
from filters.ensembles.square_root import record_members
from filters.filter import Filter
from thruster_env.core.files import BLUE, DARK, PALE, RUST, save_figure
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.thruster.plant import make_plant
from tuning.experiments import mixed_linear

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


SIZES = (20, 50, 100, 200, 500, 1000, 2000, 5000)
PARTICLE_RUNS = 200
SENSORS = ((0.1, "R = 0.1"), (1e-3, "R = 0.001"))
KINDS = {
    "pf": ("pf", {}, STYLES["pf"]),
    "pf, optimal proposal": ("pf", {"proposal": "optimal"}, {"color": BLUE, "linestyle": "-"}),
    "pf, gaussian": (
        "pf",
        {"resampling": "gaussian", "resampling_threshold": 1.0},
        {"color": BLUE, "linestyle": "--"},
    ),
    "rbpf": ("rbpf", {}, STYLES["rbpf"] | {"linestyle": "-"}),
}


def particles(path: Path) -> Path:
    """RMSE of s over N on the model that is linear where s is known, with poor and with accurate sensors."""
    figure, axes = subplots((9.6, 3.6), 1, 2)
    for axis, (variance, title) in zip(axes, SENSORS, strict=True):
        problem = mixed_linear.problem_of(mixed_linear.model(variance))
        data, model = problem.data(range(PARTICLE_RUNS)), problem.model()

        def error(filter_, data=data) -> float:
            estimates = run(filter_, data.filter_keys, data.inputs, data.measurements)
            return float(np.sqrt(np.square((estimates.means - data.states)[:, data.late, 0]).mean()))

        for label, (name, numbers, look) in KINDS.items():
            errors = [error(make_filter(name, model, ensemble_size=size, **numbers)) for size in SIZES]
            axis.plot(SIZES, errors, label=label, **look)
        axis.axhline(error(make_filter("ukf", model)), color=DARK, linestyle=":", label="ukf")
        log_ticks(axis.xaxis, SIZES)
        axis.set_title(title, fontsize=10)
        axis.set_xlabel("particles N")
    axes[0].set(ylabel="RMSE of s [-]", ylim=(0.44, 0.62))
    axes[1].set_ylim(0.13, 0.26)
    axes[0].legend(fontsize=8, frameon=False)
    return save_figure(figure, path)


BATCHES, LENGTHS = 50, (1, 2, 5, 10, 20, 30)


def reactor(path: Path) -> Path:
    """The pressure that is not measured in one batch, and its error over the horizon."""
    arguments, states = batches(BATCHES)
    figure, (left, right) = subplots((9.6, 3.6), 1, 2)
    free, within = assumed(), assumed(bounds=POSITIVE, bounded_by="projection")
    filters = {
        "ekf": ("ekf", make_filter("ekf", free)),
        "ukf, bounded": ("ukf", make_filter("ukf", within)),
        "mhe, bounded": ("mhe", make_filter("mhe", within)),
    }
    for label, (name, filter_) in filters.items():
        left.plot(run(filter_, *arguments).means[0, :, 0], label=label, **STYLES[name])
    left.plot(states[0, :, 0], label="truth", **STYLES["truth"])
    left.set(xlabel="step", ylabel="pressure of A")

    def error(filter_) -> float:
        errors = run(filter_, *arguments).means[:, SETTLED:, 0] - states[:, SETTLED:, 0]
        return float(np.sqrt(np.square(errors).mean()))

    by_length = [error(make_filter("mhe", within, horizon=length)) for length in LENGTHS]
    right.plot(LENGTHS, by_length, **STYLES["mhe"])
    for name, filter_ in list(filters.values())[:2]:
        right.axhline(error(filter_), **STYLES[name])
    log_ticks(right.yaxis, (0.01, 0.03, 0.1, 0.3, 1.0, 3.0))
    right.set(xlabel="horizon L of mhe [steps]", ylabel="RMSE from step 20 on")
    legend_below(figure, left)
    return save_figure(figure, path)


LOST_FROM, LOST_TO, STEPS, LEVEL = 150, 350, 500, 12.0  # steps; [V]


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
    **{"ensembles": ensembles, "modes": modes, "particles": particles, "horizon": reactor},
    **{"weighted": weighted, "several": several},
}
