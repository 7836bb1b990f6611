"""A Kalman filter and a smoother in NumPy, of random linear models whose steps have lengths of their own."""

from __future__ import annotations

from collections import namedtuple
from typing import Any

import numpy as np

from filters import StateSpaceModel, make_filter

# Filters that are the Kalman filter on a linear model, with the numbers that make them so, and how nearly.
LIKE_KALMAN: dict[str, tuple[str, dict[str, Any], float]] = {
    "ekf": ("ekf", {}, 1e-9),
    "square-root": ("ekf", {"form": "square-root"}, 1e-9),
    "ud": ("ekf", {"form": "ud"}, 1e-9),
    "iekf": ("iekf", {}, 1e-9),
    "ukf": ("ukf", {}, 1e-7),
    "ckf": ("ckf", {}, 1e-8),
    "fading": ("fading", {"fading": 1.0}, 1e-9),
    "schmidt": ("schmidt", {}, 1e-9),
    "sage-husa": ("sage-husa", {"forgetting_factor": 1.0}, 1e-9),
    "mhe 1": ("mhe", {"horizon": 1, "loss": "quadratic", "iterations": 1}, 1e-8),
    "mhe 4": ("mhe", {"horizon": 4, "loss": "quadratic", "iterations": 2}, 1e-8),
    "mhe 30": ("mhe", {"horizon": 30, "loss": "quadratic", "iterations": 1}, 1e-8),
    "mhe far": ("mhe", {"horizon": 4, "loss": "huber", "threshold": 1e6}, 1e-8),
}


def covariance_of(rng: np.random.Generator, n: int, scale: float = 1.0) -> np.ndarray:
    """A random covariance (n, n)."""
    root = rng.normal(size=(n, n))
    return scale * (root @ root.T / n + 0.1 * np.eye(n))


class LinearModel:
    """x' = x + step (A x + B u), s times; z = (C + step D) x + e: a step is a part of dt, one or 1/s."""

    def __init__(self, rng: np.random.Generator, n: int = 3, m: int = 2, p: int = 1, substeps: int = 1, dt=0.1):
        """Draw the numbers."""
        self.n, self.m, self.p, self.substeps, self.dt = n, m, p, substeps, dt
        self.a = (rng.normal(size=(n, n)) - 1.5 * np.eye(n)) / (10.0 * dt)
        self.b, self.c = rng.normal(size=(n, p)) / dt, rng.normal(size=(m, n))
        self.d, self.e = rng.normal(size=(m, n)) / dt, rng.normal(size=m)
        self.q, self.r = covariance_of(rng, n, 0.3), covariance_of(rng, m, 0.5)
        self.mean, self.cov = rng.normal(size=n), covariance_of(rng, n)

    def model(self, **changes) -> StateSpaceModel:
        """The same for filters, whose functions are loops over numbers."""
        a, b, c, d, e = (part.tolist() for part in (self.a, self.b, self.c, self.d, self.e))
        name = "dt" if self.substeps == 1 else "substep"
        form = namedtuple("Constants", [name, "unused"])

        def product(row, x):
            return sum(g * v for g, v in zip(row, x, strict=True))

        def transition(x, u, constants):
            step = constants[0]
            rates = (product(a[i], x) + product(b[i], u) for i in range(len(a)))
            return tuple(one + step * rate for one, rate in zip(x, rates, strict=True))

        def observe(x, constants):
            step = constants[0]
            return tuple(product(c[i], x) + step * product(d[i], x) + e[i] for i in range(len(c)))

        arguments = {
            "transition": transition,
            "observe": observe,
            "process_noise_cov": self.q,
            "measurement_noise_cov": self.r,
            "prior_mean": self.mean,
            "prior_cov": self.cov,
            "inputs": self.p,
            "substeps": self.substeps,
            "constants": form(self.dt / self.substeps, 0.0),
            "measurements": [f"z{i}" for i in range(self.m)],
        }
        return StateSpaceModel(**{**arguments, **changes})

    def filter(self, kind: str):
        """One of `LIKE_KALMAN` for it."""
        name, numbers, _ = LIKE_KALMAN[kind]
        return make_filter(name, self.model(), **numbers)

    def motion(self, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """F and G of x' = F x + G u over a step."""
        f, g, once = np.eye(self.n), np.zeros((self.n, self.p)), np.eye(self.n) + dt / self.substeps * self.a
        for _ in range(self.substeps):
            f, g = once @ f, once @ g + dt / self.substeps * self.b
        return f, g

    def sight(self, dt: float) -> np.ndarray:
        """H after a step of dt."""
        return self.c + dt / self.substeps * self.d


class KalmanByHand:
    """The Kalman filter of a `LinearModel`, by the information of each measurement."""

    def __init__(self, of: LinearModel):
        """Begin with the prior."""
        self.of, self.x, self.P = of, of.mean, of.cov

    def predict(self, u, dt: float, q) -> None:
        """A step of dt with its Q."""
        f, g = self.of.motion(dt)
        self.x, self.P = f @ self.x + g @ np.reshape(u, -1), f @ self.P @ f.T + q

    def update(self, z, dt: float, r) -> None:
        """A measurement with its R, NaN where missing, after a step of dt."""
        seen = ~np.isnan(z)
        if not seen.any():
            return
        h, r = self.of.sight(dt)[seen], r[np.ix_(seen, seen)]
        s = h @ self.P @ h.T + r
        gain = np.linalg.solve(s, h @ self.P).T
        self.x = self.x + gain @ (z[seen] - h @ self.x - self.of.e[seen])
        self.P = self.P - gain @ s @ gain.T
        self.P = 0.5 * (self.P + self.P.T)


def close(found, expected, tolerance: float, given: str = "") -> None:
    """Raise AssertionError unless arrays agree, in terms of the largest number."""
    found, expected = np.asarray(found), np.asarray(expected)
    off = np.abs(found - expected).max(initial=0.0) / max(1.0, np.abs(expected).max(initial=0.0))
    assert off <= tolerance, f"off by {off:.2g} {given}"


def smoothed_by_hand(of: LinearModel, inputs, measurements, qs, rs) -> tuple[np.ndarray, np.ndarray]:
    """Means and covariances of the smoother of Rauch, Tung and Striebel, with Q and R of each step."""
    hand, filtered, predicted = KalmanByHand(of), [], []
    hand.update(measurements[0], of.dt, rs[0])
    filtered.append((hand.x, hand.P))
    for u, z, q, r in zip(inputs, measurements[1:], qs, rs[1:], strict=True):
        hand.predict(u, of.dt, q)
        predicted.append((hand.x, hand.P))
        hand.update(z, of.dt, r)
        filtered.append((hand.x, hand.P))
    f, _ = of.motion(of.dt)
    found = [filtered[-1]]
    for (x, P), (next_x, next_P) in zip(filtered[-2::-1], predicted[::-1], strict=True):
        gain = np.linalg.solve(next_P, f @ P).T
        later_x, later_P = found[0]
        found.insert(0, (x + gain @ (later_x - next_x), P + gain @ (later_P - next_P) @ gain.T))
    return np.array([x for x, _ in found]), np.array([P for _, P in found])
