"""Pictures of docs/filters.md: a thruster that switches between models, and filters for a model that is wrong."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from filters import InteractingMultipleModelFilter, affine_model, make_filter, run, thruster_model
from filters.filter import Filter
from pages.filter_runs import STYLES, times
from thruster_env.core.plots import PALE, new_figure, save_figure, tidy
from thruster_env.model.state_space import StateSpaceModel

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
    figure = new_figure((9.6, 3.6))
    left, right = figure.subplots(1, 2)
    tidy((left, right))
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
    figure = new_figure((9.6, 3.6))
    left, right = figure.subplots(1, 2)
    tidy((left, right))
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
    left.set_xscale("log")
    left.set_xlabel("frequency of the acceleration [rad/step]")
    left.set_ylabel("RMS error of the position")
    left.legend(fontsize=8, frameon=False)
    right.set_xlabel("RMS error by measurement noise alone")
    right.set_ylabel("error at the worst frequency")
    return save_figure(figure, path)
