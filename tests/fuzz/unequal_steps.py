"""Attacks on steps of unequal length and noises that are set, against a Kalman filter by hand."""

from __future__ import annotations

import copy
import time
from collections import Counter

import numpy as np

from filters import run, smooth
from filters.logs.estimate import by_the_clock
from tests.kalman_by_hand import LIKE_KALMAN, KalmanByHand, LinearModel, close, covariance_of, smoothed_by_hand
from thruster_env.core.compiled import interpreted
from thruster_env.logs.log import Log

SMOOTHED = ("ekf", "iekf", "ukf", "ckf", "square-root")


def unequal_steps_and_set_noises(rng: np.random.Generator, seconds: float) -> str:
    """Sessions, pure functions, batches, real clocks, logs and smoothers give the numbers of the recursion."""
    end, counts = time.monotonic() + seconds, Counter()
    paths = (_session, _pure, _batch, _live, _log, _smoother)
    with interpreted():
        while not counts or time.monotonic() < end:
            seed = int(rng.integers(2**32))
            for path in paths:
                once = np.random.default_rng(seed)
                of = _model(once)
                kind = str(once.choice(SMOOTHED if path is _smoother else list(LIKE_KALMAN)))
                path(once, of, kind, f"in {path.__name__} of {kind}, n {of.n}, m {of.m}, seed {seed}")
                counts[path.__name__[1:]] += 1
    return "unequal steps: " + ", ".join(f"{count} of a {name}" for name, count in counts.items())


def _model(rng: np.random.Generator) -> LinearModel:
    n, m, p = int(rng.integers(1, 5)), int(rng.integers(1, 4)), int(rng.integers(0, 3))
    return LinearModel(rng, n, m, p, int(rng.choice([1, 1, 2, 3])), float(10.0 ** rng.uniform(-3, 1)))


def _seen(rng: np.random.Generator, of: LinearModel, missing: float = 0.2) -> np.ndarray:
    z = 2.0 * rng.normal(size=of.m)
    return np.where(rng.random(of.m) < missing, np.nan, z)


def _session(rng, of: LinearModel, kind: str, given: str) -> None:
    """Lengths, Q and R change now and then; the session is copied or pickled on the way."""
    tolerance = LIKE_KALMAN[kind][2]
    filter_ = of.filter(kind)
    session, hand, fixed = filter_.session(), KalmanByHand(of), filter_.fixed_noise
    dt, q, r, z = of.dt, of.q, of.r, _seen(rng, of)
    session.start((0, 0), z)
    hand.update(z, dt, r)
    for k in range(12):
        if rng.random() < 0.5:
            dt = float(of.dt * 10.0 ** rng.uniform(-2, 0.3))
            session.set_dt(dt)
        if rng.random() < 0.3:
            q = covariance_of(rng, of.n, 10.0 ** rng.uniform(-3, 1))
            session.set_noise(process_noise_cov=q)
        elif rng.random() < 0.3:
            factor = float(10.0 ** rng.uniform(-2, 1))
            q = factor * of.q
            session.scale_process_noise(factor)
        if rng.random() < 0.3 and "R" not in fixed:
            r = covariance_of(rng, of.m, 10.0 ** rng.uniform(-3, 1))
            session.set_noise(measurement_noise_cov=r)
        if rng.random() < 0.2:
            session = copy.deepcopy(session)
        u, z = rng.normal(size=of.p), _seen(rng, of)
        session.step(u, z)
        hand.predict(u, dt, q)
        hand.update(z, dt, r)
        close(session.mean, hand.x, tolerance, f"at step {k} {given}")
        close(session.cov, hand.P, tolerance, f"at step {k} {given}")


def _pure(rng, of: LinearModel, kind: str, given: str) -> None:
    """Noise of single calls; a step may have several measurements, or none."""
    tolerance = LIKE_KALMAN[kind][2]
    filter_ = of.filter(kind)
    belief, hand = filter_.init(), KalmanByHand(of)
    for _ in range(8):
        for _ in range(int(rng.choice([0, 1, 1, 2, 3]))):
            z, r = _seen(rng, of), covariance_of(rng, of.m) if "R" not in filter_.fixed_noise else None
            belief, _ = filter_.update(belief, z, measurement_noise_cov=r)
            hand.update(z, of.dt, of.r if r is None else r)
        close(belief.mean, hand.x, tolerance, given)
        close(belief.cov, hand.P, tolerance, given)
        u, q = rng.normal(size=of.p), covariance_of(rng, of.n, 0.1) if rng.random() < 0.5 else None
        belief = filter_.predict(belief, u, process_noise_cov=q)
        hand.predict(u, of.dt, of.q if q is None else q)


def _noises(rng: np.random.Generator, of: LinearModel, steps: int) -> tuple[np.ndarray, np.ndarray]:
    q = np.array([covariance_of(rng, of.n, 10.0 ** rng.uniform(-2, 1)) for _ in range(steps)])
    return q, np.array([covariance_of(rng, of.m, 10.0 ** rng.uniform(-2, 1)) for _ in range(steps + 1)])


def _batch(rng, of: LinearModel, kind: str, given: str) -> None:
    """Q and R of each step, if the filter takes both; else it says so."""
    tolerance, steps, count = LIKE_KALMAN[kind][2], 10, 3
    filter_ = of.filter(kind)
    q, r = _noises(rng, of, steps)
    u = rng.normal(size=(count, steps, of.p))
    z = np.array([[_seen(rng, of) for _ in range(steps + 1)] for _ in range(count)])
    try:
        found = run(filter_, None, u, z, process_noise_covs=q, measurement_noise_covs=r)
    except ValueError:
        assert filter_.fixed_noise, given
        r = np.array([of.r] * (steps + 1))
        found = run(filter_, None, u, z, process_noise_covs=q)
    for b in range(count):
        hand = KalmanByHand(of)
        for k in range(steps + 1):
            if k:
                hand.predict(u[b, k - 1], of.dt, q[k - 1])
            hand.update(z[b, k], of.dt, r[k])
            close(found.means[b, k], hand.x, tolerance, f"at step {k} {given}")
            close(found.covs[b, k], hand.P, tolerance, f"at step {k} {given}")


def _go(hand: KalmanByHand, time: float, to: float, u: np.ndarray, length: float) -> float:
    """Equal steps of at most the model's; returns how long they were."""
    if to <= time:
        return length
    of = hand.of
    count = max(1, int(np.ceil((to - time) / of.dt - 1e-6)))
    for _ in range(count):
        hand.predict(u, (to - time) / count, of.q * ((to - time) / count / of.dt))
    return (to - time) / count


def _live(rng, of: LinearModel, kind: str, given: str) -> None:
    """Sensors at times of their own, which may be equal, and late; the monitor sees them in the right order."""
    tolerance, ticks = LIKE_KALMAN[kind][2], np.cumsum(of.dt * 10.0 ** rng.uniform(-1, 0.5, size=10))
    events, names = [], [f"z{i}" for i in range(of.m)]  # stamp, arrival, channel, value
    for tick in ticks:
        for _ in range(int(rng.integers(0, 4))):
            stamp = tick if rng.random() < 0.5 else float(rng.uniform(0.0, tick))
            i = int(rng.integers(of.m))
            value = float(rng.choice([0.0, rng.normal(), 20.0 * rng.normal()]))
            events.append((stamp, tick, i, value))
    live = of.filter(kind).live(late=float(ticks[-1]), monitor={"steps_between": 100, "stuck": 2, "missing": 3})
    live.start(0.0)
    us = rng.normal(size=(len(ticks), of.p))
    for tick, u in zip(ticks.tolist(), us, strict=True):
        live.predict_to(tick, u)
        for stamp, _, i, value in (one for one in events if one[1] == tick):
            live.update(stamp, names[i], value)
    hand, watch, time, length = KalmanByHand(of), live._watch.monitor.watch(of.m), 0.0, of.dt
    nothing = np.full(of.m, np.nan)
    health = watch.step(np.zeros(of.m), of.r, nothing)
    later = sorted(events, key=lambda one: one[0])  # stable: by arrival where stamps are equal
    for tick, u in zip(ticks.tolist(), us, strict=True):
        for stamp, _, i, value in (one for one in later if one[0] <= tick):
            length, time = _go(hand, time, stamp, u, length), stamp
            z, h = nothing.copy(), of.sight(length)
            z[i] = value
            s = h @ hand.P @ h.T + of.r
            v = np.where(np.isnan(z), 0.0, z - h @ hand.x - of.e)
            health = watch.step(v, s, z)
            hand.update(z, length, of.r)
        later = [one for one in later if one[0] > tick]
        length, time = _go(hand, time, tick, u, length), tick
    close(live.mean, hand.x, 10 * tolerance, given)
    close(live.cov, hand.P, 10 * tolerance, given)
    close(live._watch._state, watch._state, 1e-5, f"in the monitor's memory {given}")
    assert live.health is None or live.health.ok == health.ok, f"health {given}"


def _log(rng, of: LinearModel, kind: str, given: str) -> None:
    """A log on its own stamps, since 1970 for instance."""
    steps, filter_ = 12, of.filter(kind)
    start = float(rng.choice([0.0, 0.3, 1.7e9]))
    lengths = of.dt * rng.choice([1.0, 1.0, 0.5, 2.0, 2.7, rng.uniform(0.1, 3)], steps)
    stamps = start + np.append(0.0, np.cumsum(lengths))
    u, z = rng.normal(size=(steps, of.p)), np.array([_seen(rng, of) for _ in range(steps + 1)])
    model = of.model()
    log = Log(
        "log", of.dt, u, z, model.input_quantities, model.measurements, start=start, stamps=stamps - stamps[0]
    )
    found = by_the_clock(filter_, np.zeros(2), log, None)[0]
    hand, length = KalmanByHand(of), of.dt
    hand.update(z[0], of.dt, of.r)
    for k in range(steps):
        apart = float(log.times[k + 1] - log.times[k])
        count = max(1, int(np.ceil(apart / of.dt - max(1e-6, 4.0 * np.spacing(stamps[-1]) / of.dt))))
        for _ in range(count):
            hand.predict(u[k], apart / count, of.q * (apart / count / of.dt))
        length = apart / count
        hand.update(z[k + 1], length, of.r)
        close(found.means[0, k + 1], hand.x, 10 * LIKE_KALMAN[kind][2], f"at row {k} {given}")


def _smoother(rng, of: LinearModel, kind: str, given: str) -> None:
    """Q and R of each step of a smoother, at any lag."""
    steps, filter_ = 8, of.filter(kind)
    q, r = _noises(rng, of, steps)
    u = rng.normal(size=(2, steps, of.p))
    z = np.array([[_seen(rng, of) for _ in range(steps + 1)] for _ in range(2)])
    lag = None if rng.random() < 0.5 else int(rng.integers(0, steps + 2))
    found = smooth(filter_, None, u, z, lag, process_noise_covs=q, measurement_noise_covs=r)
    for b in range(2):
        for k in range(steps + 1):
            last = steps if lag is None else min(k + lag, steps)
            x, P = smoothed_by_hand(of, u[b, :last], z[b, : last + 1], q[:last], r[: last + 1])
            close(found.means[b, k], x[k], 1e-6, f"at step {k}, lag {lag} {given}")
            close(found.covs[b, k], P[k], 1e-6, f"at step {k}, lag {lag} {given}")
