"""Packages of 2026 and ours at the same work: two states, one channel, equal means and covariances."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import partial
from importlib.metadata import version
from importlib.util import find_spec
from time import perf_counter
from types import ModuleType
from typing import NamedTuple

import numpy as np

import filters
from benchmarks.timing import Measure, Row, alone, side_by_side
from thruster_env.model.state_space import StateSpaceModel

STEPS, LOGS, DT = 1000, 100, 0.1  # steps of a log [-], logs of a batch [-], time step [s]
GRAVITY, FRICTION = 9.81, 0.2  # of the pendulum, 1/s^2 and 1/s
F, H = np.array([[1.0, DT], [0.0, 1.0]]), np.array([[1.0, 0.0]])
Q, R, X0, P0 = np.diag([1e-4, 1e-2]), np.array([[0.25]]), np.array([0.3, 0.0]), np.diag([0.1, 0.5])
EQUAL = 1e-7  # of means and covariances
Moments = tuple[np.ndarray, np.ndarray]  # mean and covariance after the last step; of each log of a batch


class Peer(NamedTuple):
    """A filter of a package, and ours that does the same."""

    kind: str
    how: str  # steps are called
    package: str  # its name on PyPI
    module: str
    call: Callable[[np.ndarray], Callable[[], Moments]]  # of measurements (K, 1), or of a batch (B, K, 1)
    update_first: bool = False  # whether the first measurement updates the prior, which the others predict first
    backend: str = ""

    @property
    def batch(self) -> bool:
        return self.how.endswith(" logs")


def pendulum(m: ModuleType, array: Callable) -> tuple[Callable, ...]:
    """The pendulum's f, h and their Jacobians in the functions of a module, as arrays."""

    def f(x, dt=DT):
        return array([x[0] + DT * x[1], x[1] - DT * (GRAVITY * m.sin(x[0]) + FRICTION * x[1])])

    def h(x):
        return array([m.sin(x[0])])

    def f_x(x, dt=DT):
        return array([[1.0, DT], [-DT * GRAVITY * m.cos(x[0]), 1.0 - DT * FRICTION]])

    def h_x(x):
        return array([[m.cos(x[0]), 0.0]])

    return f, h, f_x, h_x


def _fast_kalman(kind: str, z: np.ndarray) -> Callable[[], Moments]:
    """Its `update_many` returns the last state alone."""
    import kalman

    x, p, a, c, q, r = (part.ravel().tolist() for part in (X0, P0, F, H, Q, R))
    f, h, f_x, h_x = pendulum(math, list)
    values = z.tolist()

    def call() -> Moments:
        if kind == "ekf":
            filter_ = kalman.ExtendedKalmanFilter(2, 1, x, p, q, r)
            filter_.update_many(z, f, lambda x: sum(f_x(x), []), h, lambda x: h_x(x)[0])
        elif kind == "ukf":
            filter_ = kalman.UnscentedKalmanFilter(2, 1, x, p, q, r, alpha=1.0)
            filter_.update_many(z, f, h)
        else:
            filter_ = kalman.LinearKalmanFilter(2, 1, x, p, a, q, c, r)
            if kind == "kf":
                filter_.update_many(z)
            for value in values if kind == "step" else ():
                filter_.predict()
                filter_.correct(value)
        return np.array(filter_.x), np.reshape(filter_.P, (2, 2))

    return call


def _kalman_py(kind: str, backend: str, z: np.ndarray) -> Callable[[], Moments]:
    import kalman_py

    if backend == "jax":
        numbers = _jax().numpy
        f, h, f_x, h_x = pendulum(numbers, numbers.array)
    else:
        f, h, f_x, h_x = pendulum(math, np.array)
    time = {} if kind == "kf" else {"dt": DT}
    if kind == "kf":
        filter_ = kalman_py.KalmanFilter(F, H, Q, R, X0, P0)
    elif kind == "ekf":
        filter_ = kalman_py.ExtendedKalmanFilter(f, h, Q, R, X0, P0, jac_f=f_x, jac_h=h_x)
    else:
        filter_ = kalman_py.UnscentedKalmanFilter(f, h, Q, R, X0, P0)

    def call() -> Moments:
        result = filter_.filter(z, **time, backend=backend)
        return np.asarray(result.means)[-1], np.asarray(result.covs)[-1]

    return call


def _kalbee(kind: str, z: np.ndarray) -> Callable[[], Moments]:
    """A step at a time; logs of a batch together. Its EKF is left out: it takes f's Jacobian where f has led."""
    import kalbee

    f, h, *_ = pendulum(np, np.array)  # of columns
    x0, functions = X0[:, None], (f, h)
    columns = np.moveaxis(z, -2, 0)[..., None]

    def call() -> Moments:
        if kind == "kf":
            filter_ = kalbee.KalmanFilter(x0, P0, F, Q, H, R)
        elif kind == "batch":
            x, p = (np.repeat(part[None], len(z), axis=0) for part in (x0, P0))
            filter_ = kalbee.VectorizedKalmanFilter(x, p, F, Q, H, R)
        elif kind == "ukf":
            filter_ = kalbee.UnscentedKalmanFilter(x0, P0, Q, R, *functions, alpha=1.0)
        else:
            filter_ = kalbee.CubatureKalmanFilter(x0, P0, Q, R, *functions)
        for column in columns:
            filter_.predict(DT)
            filter_.update(column)
        return filter_.state[..., 0], filter_.covariance

    return call


def _smcx(kind: str, z: np.ndarray) -> Callable[[], Moments]:
    jax = _jax()
    import smcx

    f, h, f_x, h_x = pendulum(jax.numpy, jax.numpy.array)
    x0, p0, a, q, c, r = map(jax.numpy.asarray, (X0, P0, F, Q, H, R))
    run = {
        "kf": lambda z: smcx.kalman_filter(x0, p0, a, q, c, r, z),
        "ekf": lambda z: smcx.extended_kalman_filter(x0, p0, f, f_x, q, h, h_x, r, z),
        "ukf": lambda z: smcx.unscented_kalman_filter(x0, p0, f, q, h, r, z),
    }[kind]
    compiled = jax.jit(run)

    def call() -> Moments:
        posterior = compiled(z)
        return np.asarray(posterior.filtered_means)[-1], np.asarray(posterior.filtered_covariances)[-1]

    return call


def _turbo_ckf(kind: str, z: np.ndarray) -> Callable[[], Moments]:
    import turbo_ckf

    f, h, *_ = pendulum(np, np.array)  # of the transposed rows of all points

    def call() -> Moments:
        if kind == "kf":
            means, covs, _ = turbo_ckf.TurboCKF.batch_filter(X0, P0, z, F, H, Q, R)
            return means[-1], covs[-1]
        filter_ = turbo_ckf.TurboCKF(2, 1, DT, lambda x: h(x.T).T, lambda x, dt: f(x.T).T)
        filter_.x, filter_.P, filter_.Q, filter_.R = X0, P0, Q, R
        result = filter_.run(z)
        return result.xs[-1], result.Ps[-1]

    return call


def _torch_kf(z: np.ndarray) -> Callable[[], Moments]:
    import torch
    from torch_kf import GaussianState, KalmanFilter

    x0, p0, *matrices, rows = map(torch.as_tensor, (X0[:, None], P0, F, H, Q, R, np.moveaxis(z, -2, 0)[..., None]))
    filter_, batch = KalmanFilter(*matrices), (len(z), -1, -1)

    def call() -> Moments:
        state = GaussianState(x0.expand(batch), p0.expand(batch))
        state = filter_.filter(state, rows, update_first=False, return_all=True)
        return state.mean[-1, ..., 0].numpy(), state.covariance[-1].numpy()

    return call


def _jax() -> ModuleType:
    import jax

    jax.config.update("jax_platforms", "cpu")
    jax.config.update("jax_enable_x64", True)
    return jax


PEERS = (
    Peer("kf", "a log", "fast-kalman", "kalman", partial(_fast_kalman, "kf")),
    Peer("kf", "a log", "turbo-ckf", "turbo_ckf", partial(_turbo_ckf, "kf")),
    Peer("kf", "a log", "kalman-py", "kalman_py", partial(_kalman_py, "kf", "numpy"), backend=", NumPy"),
    Peer("kf", "a log", "kalman-py", "kalman_py", partial(_kalman_py, "kf", "jax"), backend=", JAX"),
    Peer("kf", "a log", "smcx", "smcx", partial(_smcx, "kf"), update_first=True),
    Peer("kf", "step by step", "fast-kalman", "kalman", partial(_fast_kalman, "step")),
    Peer("kf", "step by step", "kalbee", "kalbee", partial(_kalbee, "kf")),
    Peer("kf", f"{LOGS} logs", "kalbee", "kalbee", partial(_kalbee, "batch")),
    Peer("kf", f"{LOGS} logs", "torch-kf", "torch_kf", _torch_kf),
    Peer("ekf", "a log", "fast-kalman", "kalman", partial(_fast_kalman, "ekf")),
    Peer("ekf", "a log", "kalman-py", "kalman_py", partial(_kalman_py, "ekf", "numpy"), backend=", NumPy"),
    Peer("ekf", "a log", "kalman-py", "kalman_py", partial(_kalman_py, "ekf", "jax"), backend=", JAX"),
    Peer("ekf", "a log", "smcx", "smcx", partial(_smcx, "ekf"), update_first=True),
    Peer("ukf", "a log", "fast-kalman", "kalman", partial(_fast_kalman, "ukf")),
    Peer("ukf", "a log", "kalman-py", "kalman_py", partial(_kalman_py, "ukf", "numpy"), backend=", NumPy"),
    Peer("ukf", "a log", "kalman-py", "kalman_py", partial(_kalman_py, "ukf", "jax"), backend=", JAX"),
    Peer("ukf", "a log", "smcx", "smcx", partial(_smcx, "ukf"), update_first=True),
    Peer("ukf", "step by step", "kalbee", "kalbee", partial(_kalbee, "ukf")),
    Peer("ckf", "a log", "turbo-ckf", "turbo_ckf", partial(_turbo_ckf, "ckf")),
    Peer("ckf", "step by step", "kalbee", "kalbee", partial(_kalbee, "ckf")),
)


def rows(seed: int, quick: bool) -> Iterator[Row]:
    """Packages of 2026 on two states and one channel, whose last mean and covariance must be ours.

    Raises:
        ValueError: if a package computes something else.
    """
    z = np.sin(0.05 * np.arange(STEPS)) + 0.5 * np.random.default_rng(seed).standard_normal((LOGS, STEPS))
    for peer in PEERS:
        logs = z[..., None] if peer.batch else z[0, :, None]
        ours, what = _ours(peer, logs), f"{peer.kind.upper()}, {peer.how}"
        if find_spec(peer.module) is None:
            yield Row(what, f"{peer.package} is not installed", alone(_a_step(ours, logs.size), 2))
            continue
        theirs = peer.call(logs)
        for name, expected, computed in zip(("mean", "covariance"), ours(), theirs(), strict=True):
            if not np.allclose(computed, expected, rtol=EQUAL, atol=EQUAL):
                raise ValueError(f"{what}: the {name} of {peer.package} must be {expected}, but is {computed}")
        rounds = 2 if quick else 15
        timing = side_by_side(_a_step(ours, logs.size), _a_step(theirs, logs.size), rounds)
        yield Row(what, f"{peer.package} {version(peer.package)}{peer.backend}", timing)


def _a_step(call: Callable[[], Moments], steps: int) -> Measure:
    def measure() -> float:
        begin = perf_counter()
        call()
        return (perf_counter() - begin) / steps

    return measure


def _ours(peer: Peer, z: np.ndarray) -> Callable[[], Moments]:
    if peer.kind == "kf":
        model = filters.affine_model(F=F, H=H, Q=Q, R=R, x0=X0, P0=P0)
    else:
        moments = {"process_noise_cov": Q, "measurement_noise_cov": R, "prior_mean": X0, "prior_cov": P0}
        model = StateSpaceModel(transition=_swing, observe=_displacement, **moments)
    filter_ = filters.make_filter(peer.kind, model)

    def run() -> Moments:
        estimates = filters.run(filter_, z, update_first=peer.update_first, dt=DT)
        return estimates.means[..., -1, :], estimates.covs[..., -1, :, :]

    session, values = filter_.session(), z.tolist()

    def step_by_step() -> Moments:
        session.start()
        for value in values:
            session.predict([])
            session.update(value)
        return session.mean, session.cov

    return step_by_step if peer.how == "step by step" else run


def _swing(x, u, c):
    return x[0] + DT * x[1], x[1] - DT * (GRAVITY * math.sin(x[0]) + FRICTION * x[1])


def _displacement(x, c):
    return (math.sin(x[0]),)
