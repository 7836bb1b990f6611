"""Turning targets seen by a lidar: noise in range and bearing, for a Kalman filter whose R is in Cartesian axes.

    x' = x + v + a/2,   v' = v + a,   z = (r + 2 m n_1)(cos, sin)(theta + 1.5 deg n_2)

A target begins within +-600 m at 30 to 90 m/s; four to six intervals of 5 to 8 steps have each one acceleration,
N(0, 2^2) along the path and uniform within +-15 across it. Only positions count.

Source: the example of I. Greenberg, N. Yannay, S. Mannor (2023), "Optimization or architecture: how to hack Kalman
filtering", NeurIPS, arXiv 2310.00675, in their package Optimized-Kalman-Filter; written anew.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from filters import affine_model
from tuning.problems.runs_problem import RunsProblem

RANGE, BEARING = 2.0, np.deg2rad(1.5)  # deviations [m, rad]
FIELD, SPEEDS = 600.0, (30.0, 90.0)  # [m], [m/s]
INTERVALS, STEPS = (4, 7), (5, 9)  # from, and up to but without
ALONG, ACROSS = 2.0, 15.0  # [m/s^2]
PRIOR = 1000.0  # variance of each state before the first measurement, whose position is taken
A = np.eye(4) + np.eye(4, k=2)
C = np.eye(2, 4)


class Run(NamedTuple):
    """A target, and where it was seen."""

    states: np.ndarray  # (K + 1, 4), position and velocity
    measurements: np.ndarray  # (K + 1, 2)


def drawn(count: int, seed: int = 0) -> list[Run]:
    """Some targets."""
    rng, found = np.random.default_rng([seed, count]), []
    for _ in range(count):
        speed, course = rng.uniform(*SPEEDS), rng.uniform(0.0, 2.0 * np.pi)
        states = [np.array([*rng.uniform(-FIELD, FIELD, 2), speed * np.cos(course), speed * np.sin(course)])]
        for _ in range(rng.integers(*INTERVALS)):
            along, across = rng.normal(0.0, ALONG), rng.uniform(-ACROSS, ACROSS)
            for _ in range(rng.integers(*STEPS)):
                x, v = states[-1][:2], states[-1][2:]
                ahead = v / np.hypot(*v)
                a = along * ahead + across * np.array([-ahead[1], ahead[0]])
                states.append(np.concatenate([x + v + a / 2.0, v + a]))
        path = np.array(states)
        distance = np.hypot(path[:, 0], path[:, 1]) + rng.normal(0.0, RANGE, len(path))
        angle = np.arctan2(path[:, 1], path[:, 0]) + rng.normal(0.0, BEARING, len(path))
        found.append(Run(path, distance[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])))
    return found


def lidar_problem(runs: list[Run], held_out: int) -> RunsProblem:
    """The problem of OKF's own filter: it begins where the first measurement is, with P_0 = 1000 I.

    Its model does not know where the origin is, so each run is seen from its first measurement: the prior's mean
    is zero, and so is the first innovation.

    Args:
        runs: the last of them are held out.
        held_out: how many.
    """
    seen = []
    for one in runs:
        first = one.measurements[0]
        states = one.states - np.concatenate([first, [0.0, 0.0]])
        seen.append({"measurements": one.measurements - first, "states": states})
    g = np.vstack([0.5 * np.eye(2), np.eye(2)])
    model = affine_model(
        a=A,
        b=np.zeros((4, 0)),
        c=C,
        process_noise_cov=25.0 * g @ g.T,
        measurement_noise_cov=[400.0, 400.0],
        prior_mean=[0.0] * 4,
        prior_cov=[PRIOR] * 4,
        states=[("easting", "x", "m"), ("northing", "y", "m"), ("speed", "v_x", "m/s"), ("speed", "v_y", "m/s")],
        measurements=[("measured easting", "z_x", "m"), ("measured northing", "z_y", "m")],
    )
    start = {"process_noise_cov": (25.0, 25.0, 100.0, 100.0), "measurement_noise_cov": (400.0, 400.0)}
    return RunsProblem(
        seen,
        model,
        held_out=range(len(runs) - held_out, len(runs)),
        scale=(1.0, 1.0, np.inf, np.inf),
        untuned=start,
        name="lidar",
        about="turning targets seen by a lidar; noise in range and bearing, R in Cartesian axes",
    )
