"""Filters over many trajectories at once, on all cores; the ensemble filter beside one written in JAX."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from importlib.util import find_spec
from math import gcd

import numpy as np

from benchmarks.batches import shared
from benchmarks.jax_enkf import jax_filter
from benchmarks.rates import arithmetic_limit, step_of_filter, times
from benchmarks.timing import Row, alone, side_by_side
from filters import run
from filters.filter import Filter
from thruster_env.core.threads import cores
from tuning.problems.data import Data
from tuning.problems.seeds import training_seeds
from tuning.search.space import oracle_choice
from tuning.thruster.scenario import find_scenario

TRAJECTORIES, ENSEMBLE_SIZE = 256, 100
AGREEMENT = 0.03  # how far the RMSE of two filters that differ in their random numbers alone may lie apart
ALONE = (("ekf", 2.6), ("ukf", 2.5))  # filters without an ensemble, and the most of the limit that a step may be
LIMIT_GOAL = 1.9  # of the ensemble filter


def rows(seed: int, quick: bool) -> Iterator[Row]:
    """Measure, one row after the other."""
    scenario = find_scenario("nominal")
    count = TRAJECTORIES // 4 if quick else TRAJECTORIES
    data, steps = scenario.data(training_seeds(seed, count)), count * scenario.steps
    for name, goal in ALONE:
        filter_ = oracle_choice(name, scenario).filter(scenario)
        measure = shared(partial(estimates, filter_, data), steps)
        timing = alone(measure, 5 if quick else 40)
        limit = arithmetic_limit(step_of_filter(filter_), cores=cores())
        yield Row(f"{name.upper()} batch, a step", None, timing, limit=limit, limit_goal=goal)

    filter_ = oracle_choice("enkf", scenario).with_size(ENSEMBLE_SIZE).filter(scenario)
    ours = shared(partial(estimates, filter_, data), steps * ENSEMBLE_SIZE)
    rounds, what = 2 if quick else 10, f"EnKF batch, N = {ENSEMBLE_SIZE}"
    limit = arithmetic_limit(times(step_of_filter(filter_), 1 / ENSEMBLE_SIZE), cores=cores())
    yield Row(what, None, alone(ours, 5 * rounds), limit=limit, limit_goal=LIMIT_GOAL)
    if find_spec("jax") is None:
        yield Row(what, "JAX is not installed", alone(ours, rounds), limit=limit)
        return
    arrays = data.inputs[..., 0], data.measurements[..., 0]
    parts = gcd(cores(), count)
    for devices, name, goal in ((1, "JAX", 1 / 7), (parts, f"JAX, {parts} devices", None)):
        estimate = partial(jax_filter(scenario.plant, ENSEMBLE_SIZE, seed, devices), *arrays)
        check_agreement(estimates(filter_, data), estimate()[0], data.states)
        peer = shared(estimate, steps * ENSEMBLE_SIZE)
        yield Row(what, name, side_by_side(ours, peer, rounds, warm_up=False), ratio_goal=goal, limit=limit)


def estimates(filter_: Filter, data: Data) -> np.ndarray:
    """The means that a filter finds, (B, K + 1, n)."""
    return run(filter_, data.filter_keys, data.inputs, data.measurements).means


def check_agreement(ours: np.ndarray, theirs: np.ndarray, states: np.ndarray) -> None:
    """Raise ValueError unless two filters' estimates (B, K + 1, n) are equally accurate, so that times compare."""
    ratio = np.sqrt(np.mean((ours - states) ** 2, axis=(0, 1)) / np.mean((theirs - states) ** 2, axis=(0, 1)))
    if np.any(np.abs(ratio - 1.0) > AGREEMENT):
        raise ValueError(f"two ensemble filters must have the same RMSE within {AGREEMENT:.0%}, but got {ratio}")
