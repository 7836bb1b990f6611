"""Lagged covariances of a fixed gain's innovations: what they are, what they should be, and what they tell."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from filters.bounds import steady_state
from thruster_env.model.affine import linearize
from thruster_env.model.state_space import StateSpaceModel
from tuning.likelihood.family import Family
from tuning.problems.data import Data
from tuning.ways.task import Task

LAGS = 15
DROPPED = 100  # rows at the beginning, at most a fifth of a run
ITERATIONS = 3  # the gain of each is that of the Q and R found before
LEAST_DECAY = 1e-9  # of an error in a step
ALIKE = 1e-9  # relative difference, up to which two linearisations are the same
LINEAR = 1e-6  # part of Q or R that numbers may not stand for: slopes of a model's own numbers are differences


class Stationary(NamedTuple):
    """A linear model x' = A x + B u + a, z = C x + d."""

    a: np.ndarray
    b: np.ndarray
    offset: np.ndarray
    c: np.ndarray
    zero: np.ndarray


class Noise(NamedTuple):
    """Q and R as sums of numbers times units, and of what no number moves."""

    q: np.ndarray  # units, (p, n, n)
    r: np.ndarray  # (p, m, m)
    rest: tuple[np.ndarray, np.ndarray]


def by_lags(task: Task, name: str, equations: Callable[..., tuple[np.ndarray, np.ndarray]]) -> None:
    """Numbers not below zero that solve linear equations in the lagged covariances of innovations, three times.

    Args:
        task: what is tuned.
        name: of the way, for errors.
        equations: (linear, gain, covariances (lags, m, m), noise) returns the matrix (rows, p) and the right side.

    Raises:
        ValueError: of a model that is not linear, or whose Q and R are not linear in the numbers.
    """
    from scipy.optimize import nnls

    family = Family(task.start, task.problems[0], task.free)
    coordinates = family.coordinates
    if not coordinates.log.all():
        raise ValueError(
            f"way {name!r} needs Q and R linear in positive numbers, but a number is on a linear scale"
        )
    model = task.model(task.start)
    linear = stationary(model, task.problems[0].name, name)
    point = np.clip(coordinates.of(task.values_of(task.start, task.free)), coordinates.low, coordinates.high)
    for _ in range(ITERATIONS):
        model, slopes = family.at(point)
        each = np.exp(point)
        units = [one / each[:, None, None] for one in (slopes.process_noise_cov, slopes.measurement_noise_cov)]
        of_model = model.process_noise_cov, model.measurement_noise_cov
        q, r = (of - np.tensordot(each, one, 1) for of, one in zip(of_model, units, strict=True))
        if any(abs(one).max() > LINEAR * abs(of).max() for one, of in zip((q, r), of_model, strict=True)):
            if not task.options.get("hold_r"):
                raise ValueError(
                    f"way {name!r} needs Q and R linear in the numbers that are tuned, but they are not"
                )
        gain, seen = observed(task, linear, *of_model)
        design, wanted = equations(linear, gain, seen, Noise(units[0], units[1], (q, r)))
        scale = np.maximum(abs(design).max(axis=0), 1e-300)
        found, _ = nnls(design / scale, wanted)
        values = np.maximum(found / scale, np.exp(coordinates.low))
        point = np.clip(coordinates.of(values), coordinates.low, coordinates.high)
        task.keep(family.choice_at(point))


def observed(task: Task, linear: Stationary, q: np.ndarray, r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The gain (n, m) of a Q and R, and its innovations' lagged covariances (lags, m, m) on all runs: one pass."""
    gain, first = steady_gain(linear, q, r), task.model(task.start).prior_mean
    lags = min(LAGS, *(max(2, int(one.rows.min()) // 4) for one in task.data))
    seen = autocovariances([_innovations(linear, gain, one, first) for one in task.data], lags)
    task.charge(task.passes)
    return gain, seen


def stationary(model: StateSpaceModel, name: str, way: str) -> Stationary:
    """The matrices of a linear model; ValueError for another one."""
    about = np.zeros(model.n), np.zeros(model.inputs)
    away = np.ones(model.n) * model.scales, np.ones(model.inputs)
    found, other = (linearize(model, *one).matrices() for one in (about, away))
    pairs = zip(found, other, strict=True)
    if not all(
        np.allclose(one, two, rtol=ALIKE, atol=ALIKE * max(abs(one).max(initial=0), 1.0)) for one, two in pairs
    ):
        raise ValueError(
            f"way {way!r} needs a linear model, such as that of the filter kf, but {name} has another one"
        )
    return Stationary(*found)


def steady_gain(linear: Stationary, q: np.ndarray, r: np.ndarray) -> np.ndarray:
    """The gain L (n, m) of the stationary Kalman filter."""
    rule = "ways by lagged covariances need a model with a stationary filter"
    try:
        gain = steady_state(linear.a, linear.c, q, r)[1]
    except np.linalg.LinAlgError as error:
        raise ValueError(f"{rule}, but {error}") from None
    radius = float(abs(np.linalg.eigvals(linear.a - linear.a @ gain @ linear.c)).max())
    if radius >= 1.0 - LEAST_DECAY:
        raise ValueError(
            f"{rule}, but an eigenvalue of A - A L C is {radius:.9g}: its errors do not decay; "
            "give Q noise in each state that does not decay by itself"
        )
    return gain


def lagged(linear: Stationary, gain: np.ndarray, q: np.ndarray, r: np.ndarray, lags: int) -> np.ndarray:
    """C_0, C_1, ..., C_{N-1} of a gain's innovations, under a Q and R, (lags, m, m)."""
    from scipy.linalg import solve_discrete_lyapunov

    a, c = linear.a, linear.c
    through = a @ gain
    closed = a - through @ c
    p = solve_discrete_lyapunov(closed, q + through @ r @ through.T)
    blocks, power = [c @ p @ c.T + r], np.eye(len(a))
    for _ in range(1, lags):
        blocks.append(c @ (closed @ power @ p @ c.T - power @ through @ r))
        power = closed @ power
    return np.array(blocks)


def _innovations(linear: Stationary, gain: np.ndarray, data: Data, prior_mean: np.ndarray) -> list[np.ndarray]:
    """The innovations of each run, (rows, m), without those of the beginning."""
    seen, measurements = data.seen, data.measurements
    times = measurements.shape[1]
    means, found = np.tile(prior_mean, (len(measurements), 1)), np.empty(measurements.shape)
    for k in range(times):
        found[:, k] = measurements[:, k] - means @ linear.c.T - linear.zero
        if k < times - 1:
            after = means + np.nan_to_num(found[:, k]) @ gain.T
            means = after @ linear.a.T + seen.inputs[:, k] @ linear.b.T + linear.offset
    return [run[min(DROPPED, rows // 5) : rows] for run, rows in zip(found, data.rows.tolist(), strict=True)]


def autocovariances(parts: list[list[np.ndarray]], lags: int) -> np.ndarray:
    """Means of e_{k+j} e_k' over all times at which both were measured, (lags, m, m)."""
    runs = [run for part in parts for run in part]
    found = []
    for j in range(lags):
        pairs = [(run[j:], run[: len(run) - j]) for run in runs if len(run) > j]
        ahead, behind = (np.concatenate(side) for side in zip(*pairs, strict=True))
        there = np.isfinite(ahead)[:, :, None] & np.isfinite(behind)[:, None, :]
        products = np.nan_to_num(ahead)[:, :, None] * np.nan_to_num(behind)[:, None, :]
        found.append(products.sum(axis=0) / np.maximum(there.sum(axis=0), 1))
    return np.array(found)
