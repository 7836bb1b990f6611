"""The tables of docs/appendix/filters.md, and pictures of unknown noise, wrong models and missing measurements."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from docs.scripts import by_name, log_ticks, subplots
from docs.scripts.filter_pictures import (
    FLOW_RMSE,
    PICTURES,
    RUNS,
    SEED,
    STYLES,
    Runs,
    errors_of,
    fuzzy,
    held_runs,
    times,
)
from filters import (
    FILTERS,
    ExtendedKalmanFilter,
    SageHusaFilter,
    VariationalBayesFilter,
    make_filter,
    run,
    thruster_model,
)
from filters.registry import filter_type
from thruster_env.core.compiled import interpreted
from thruster_env.core.files import BLUE, DARK, MUSTARD, RUST, save_figure
from thruster_env.core.text_tables import markdown_table

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
    figure, (left, right) = subplots((9.6, 3.6), 1, 2)
    left.plot(times(501), stds, label="truth", **STYLES["truth"])
    for filter_ in (VariationalBayesFilter(model=model), SageHusaFilter(model=model)):
        learnt = np.sqrt([_learnt_noise(filter_, runs, run_) for run_ in range(len(runs.keys))])
        left.plot(times(501), learnt.mean(axis=0), label=filter_.name, **STYLES[filter_.name])
        left.fill_between(
            times(501), *np.quantile(learnt, (0.1, 0.9), axis=0), alpha=0.2, color=STYLES[filter_.name]["color"]
        )
    left.set(xlabel="time [s]", ylabel="std of the sensor's noise [N]")
    left.legend(fontsize=8, frameon=False, loc="upper left")
    shares = (0.0, 0.02, 0.05, 0.1, 0.2, 0.4, 0.6)
    for name in ("ekf", "sage-husa", "vb", "ekf-robust"):
        errors = [
            errors_of(make_filter(name, thruster_model()), held_runs(**outliers(share)))[1] for share in shares
        ]
        right.plot([100 * share for share in shares], errors, label=name, **STYLES[name])
    right.set(xlabel="measurements that are off by 10 N [%]", ylabel=FLOW_RMSE, ylim=(0.04, 0.12))
    right.legend(fontsize=8, frameon=False)
    return save_figure(figure, path)


def varying(path: Path) -> Path:
    """R that is known step by step, and measurements that are missing or held."""
    model, burst = thruster_model(), np.ones(501, dtype=bool)
    burst[:200], burst[300:] = False, False
    stds = np.where(burst, LOUD, QUIET)
    runs = noisy(held_runs(RUNS), stds)
    figure, (left, right) = subplots((9.6, 3.6), 1, 2)
    covs = (stds**2)[:, None, None]
    known = run(ExtendedKalmanFilter(model=model), *runs.arguments, measurement_noise_covs=covs)
    fixed = run(ExtendedKalmanFilter(model=model), *runs.arguments)
    for label, estimates, colour, dashes in (("R of each step", known, BLUE, "-"), ("one R", fixed, RUST, "--")):
        squares = ((estimates.means[..., 1] - runs.states[..., 1]) ** 2).mean(axis=0)
        smooth = np.sqrt(np.convolve(squares, np.ones(10) / 10, "same"))
        left.plot(times(501)[20:480], smooth[20:480], color=colour, linestyle=dashes, label=label)
    left.axvspan(2.0, 2.99, color=DARK, alpha=0.1, linewidth=0, label="noise of 2 N, else 0.5 N")
    left.set(xlabel="time [s]", ylabel="RMSE of $U_a$ over 10 steps [m/s]")
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
    right.set(xlabel="measurements missing, in runs of 20 [%]", ylabel=FLOW_RMSE)
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


class Words(NamedTuple):
    """Properties of a filter that are not computed."""

    assumes: str  # beyond known Q and R
    belief: str
    ratio: str  # time of a step in a batch over that of "ekf", rounded; `make bench` measures times
    fails: str


WORDS_TEXT = Path(__file__).with_suffix(".txt").read_text(encoding="utf-8")
WORDS = {name: Words(*cells) for name, *cells in (line.split(" | ") for line in WORDS_TEXT.splitlines()[1:])}


def kinds() -> str:
    """All filters: assumptions, belief, calls of the model in a step, and when they fail."""
    header = ["name", "class", "assumes", "belief", "f, h a step", "time", "fails"]
    rows = []
    for name, kind in FILTERS.items():
        words = WORDS[name]
        row = [f"`{name}`", f"`{kind.__name__}`", words.assumes, words.belief]
        rows.append([*row, calls(name), words.ratio, words.fails])
    return markdown_table(header, rows)


def calls(name: str) -> str:
    """How often a filter calls the model's f and h, or their Jacobians, in a step without substeps."""
    members, count = 16, Counter()  # whole vector registers, so that no member is padding

    def counted(letter: str, function: Callable) -> Callable:
        def call(*arguments):
            int(arguments[0][0])  # so that it cannot be traced: it is called
            count[letter] += 1
            return function(*arguments)

        return call

    model = thruster_model()
    functions = {"f": ("transition", "transition_jacobian"), "h": ("observe", "observe_jacobian")}
    fields = [(letter, field) for letter, both in functions.items() for field in both]
    counting = {field: counted(letter, getattr(model, field)) for letter, field in fields}
    sized = filter_type(name).has_ensemble
    filter_ = make_filter(
        name, model.replace(**counting, substeps=1), **({"ensemble_size": members} if sized else {})
    )
    with interpreted():
        belief, _ = filter_.update(filter_.init(), [0.1])
        for _ in range(getattr(filter_, "horizon", 0)):  # until its window is full
            belief, _ = filter_.update(filter_.predict(belief, [12.0]), [0.1])
        count.clear()
        filter_.update(filter_.predict(belief, [12.0]), [0.1])
    if not count:
        return "none: matrices"
    each = [count[letter] // (members if sized else 1) for letter in "fh"]
    return ", ".join(("N" if times == 1 else f"{times} N") if sized else str(times) for times in each)


FIGURES = {
    **{f"filters_{name}.png": draw for name, draw in PICTURES.items()},
    **{f"filters_{draw.__name__}.png": draw for draw in (adaptive, varying)},
}
TABLES = by_name(kinds, fuzzy)
