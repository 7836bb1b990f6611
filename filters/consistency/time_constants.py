"""How long a filter remembers: time constants of its gain, and the process noise by which it forgets sooner."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from filters.engine.batch import Estimates, run
from filters.filter import Filter
from thruster_env.core.sources import as_value
from thruster_env.model.affine import AffineModel, slopes_of_step
from thruster_env.model.shape import observation_slopes
from thruster_env.model.state_space import StateSpaceModel

STEPS = 24  # up to each of the places in a run, at which slopes are taken ...
SAMPLES = 8  # ... or more steps, so that the channel that is measured most rarely has about so many of them
FRACTIONS = (0.75, 1.0)  # of a run, by which filters have settled
BLIND = 1e-10  # eigenvalue of the observability Gramian's correlations, below which nothing is observed
DOUBLINGS = 60  # of a path, at most: then even slow covariances have settled
SETTLED = 1e-12  # relative change of a covariance that has settled
LARGEST = 1e100  # a transition that is larger has settled, too
FACTORS = 40  # powers of two, up and down, within which the factor on a floor is searched ...
STRIDE = 4  # ... upwards by so many
WITHIN = 1e-3  # relative tolerance of that factor
SHARE = 0.2  # of a run: a filter with a longer time constant sleeps
Run = tuple[np.ndarray, np.ndarray, np.ndarray]  # keys (1, 2), inputs (1, K, p), measurements (1, K + 1, m)


class Path(NamedTuple):
    """A model's slopes along estimates, at L steps.

    Attributes:
        transitions: F = df/dx over a whole step, (L, n, n).
        observations: H = dh/dx at the predicted mean, (L, m, n); rows of zeros where a channel is missing.
        covs: P of the estimates before these steps, (L, n, n).
        innovation_covs: S of the steps, (L, m, m).
        q_factors: factors on Q, (L,): 1, or the ratio of a step's length to the model's.
    """

    transitions: np.ndarray
    observations: np.ndarray
    covs: np.ndarray
    innovation_covs: np.ndarray
    q_factors: np.ndarray

    def of_states(self, indices: np.ndarray) -> Path:
        """The path of some states where all others are known."""
        rows = indices[:, None]
        return self._replace(
            transitions=self.transitions[:, rows, indices],
            observations=self.observations[..., indices],
            covs=self.covs[:, rows, indices],
        )


class TimeConstants(NamedTuple):
    """Time constants of a filter's gain in steps, of the observable part of its state without constants.

    Attributes:
        steps: the longest first; infinite where an error never fades.
        slowest: index of the state with the largest part in the longest one, in units of its deviation.
        uptake: steps within which updates follow 63 % of a step in the channel with the largest gain; infinite
            for a gain of zero.
        unobservable: indices of states that measurements do not determine, whatever the gain.
        length: steps of the shortest run.
        oracle: the longest one and the uptake of the same filter with the plant's own Q and R; None if not
            computed.
        advised: a longest time constant [s] that a larger Q reaches; None if none does, or if not computed.
    """

    steps: tuple[float, ...]
    slowest: int
    uptake: float
    unobservable: tuple[int, ...]
    length: int
    oracle: tuple[float, float] | None = None
    advised: float | None = None

    @property
    def is_slow(self) -> bool:
        """Whether an error lasts for more than a fifth of a run."""
        return bool(self.steps) and self.steps[0] > SHARE * self.length

    @property
    def has_no_gain(self) -> bool:
        """Whether updates need more than a run to follow the measurements: the gain is practically zero."""
        return bool(self.steps) and self.uptake > self.length


class RaisedNoise(NamedTuple):
    """A process noise covariance, raised so that a filter forgets sooner.

    Attributes:
        cov: Q (n, n).
        steps: the longest time constant with it.
    """

    cov: np.ndarray
    steps: float


def time_constants(filter_: Filter, runs: Sequence[Run], constants: Sequence[int] = ()) -> TimeConstants | None:
    """How long an error of a filter's estimate lasts on some runs.

        A = (I - K H) F,   K = (F P F' + Q) H' S^-1,   tau = -1 / log|lambda(A)| steps
        uptake = -1 / log(1 - kappa),   kappa the largest eigenvalue of the mean of H K

    P and S are the filter's covariances of state and innovation (of its members, for an ensemble), at steps just
    before three quarters and before the end of each run. |lambda| is the mean growth of errors in a step along the
    runs; with the steady gain of a linear model these are the moduli of A's eigenvalues.

    Args:
        filter_: the filter.
        runs: arguments of `filters.run`, with one run each.
        constants: indices of states that are meant to be remembered; time constants are those of the other states,
            with these known.

    Returns:
        None for a filter without a covariance, a model with rotations, and where no estimate is finite.

    Source: Anderson, Moore (1979), Optimal Filtering, section 4.4; Benettin, Galgani, Giorgilli, Strelcyn (1980),
    "Lyapunov characteristic exponents for smooth dynamical systems", for the mean growth.
    """
    if not filter_.has_covariance or filter_.kernel_model.turns or filter_.kernel_model.measured_turns:
        return None
    path = slopes_along(filter_, runs)
    if path is None or not _is_regular(path):
        return None
    model, n = filter_.kernel_model, filter_.kernel_model.n
    scales = _scales(model, path)
    closed, removed = np.empty_like(path.transitions), np.zeros((model.m, model.m))
    for i, (f, h, p, s, factor) in enumerate(zip(*path, strict=True)):
        measured = h.any(axis=1)
        h, s = h[measured], s[np.ix_(measured, measured)]
        with np.errstate(over="ignore", invalid="ignore"):  # of a filter that has lost its state
            predicted = f @ p @ f.T + factor * model.process_noise_cov
            gain = np.linalg.solve(s, h @ predicted).T
            closed[i] = (np.eye(n) - gain @ h) @ f
            removed[np.ix_(measured, measured)] += h @ gain / len(closed)
    if not (np.abs(closed) < LARGEST).all():
        return None
    observable, blind = observable_part(path, scales, model.measurement_noise_cov)
    rest = _others(n, constants)
    if len(constants):
        closed, scales = closed[:, rest[:, None], rest], scales[rest]
        observable, _ = observable_part(path.of_states(rest), scales, model.measurement_noise_cov)
    closed = observable.T @ (closed / scales[:, None] * scales) @ observable
    growth, direction = _growth(closed)
    kappa = min(float(np.linalg.eigvals(removed).real.max(initial=0.0)), 1.0)
    slowest = int(rest[np.abs(observable @ direction).argmax()]) if len(growth) else 0
    length = min(inputs.shape[1] for _, inputs, _ in runs)
    return TimeConstants(tuple(map(_steps_of, growth)), slowest, _steps_of(1.0 - kappa), blind, length)


def slopes_along(filter_: Filter, runs: Sequence[Run]) -> Path | None:
    """Slopes of a filter's model along its estimates, at consecutive steps late in each run; None if lost."""
    model, parts, constant = filter_.kernel_model, [], None
    functions = model.functions
    slopes = observation_slopes(functions, model.shape)
    for keys, inputs, measurements in runs:
        estimates: Estimates = run(filter_, keys, inputs, measurements)
        ends, count = (int(fraction * inputs.shape[1]) for fraction in FRACTIONS), _steps_to_take(measurements[0])
        for k in sorted({k for end in ends for k in range(max(end - count, 0) + 1, end + 1)}):
            x, p, s = estimates.means[0, k - 1], estimates.covs[0, k - 1], estimates.innovation_covs[0, k]
            if constant is None or not isinstance(model, AffineModel):
                f, _, after = slopes_of_step(model, x, inputs[0, k - 1], functions=functions)
                fed = model.shape.fed(as_value(inputs[0, k - 1]))
                h = np.array(slopes(as_value(after), as_value(model.scales), *fed, model.given_constants))
                constant = f, h.reshape(model.m, model.n)
            f, h = constant[0], constant[1].copy()
            h[np.isnan(measurements[0, k])] = 0.0
            if all(np.isfinite(part).all() for part in (f, h, p, s)):
                factor = inputs[0, k - 1, -1] if model.shape.step_ratio else 1.0
                parts.append((f, h, p, s, factor))
    return Path(*map(np.array, zip(*parts, strict=True))) if parts else None


def _steps_to_take(measurements: np.ndarray) -> int:
    """The number of consecutive steps of measurements (K + 1, m) in which each channel has its usual share."""
    measured = (~np.isnan(measurements[1:])).mean(axis=0)
    rarest = measured[measured > 0.0].min(initial=1.0)
    return max(STEPS, round(SAMPLES / rarest))


def observable_part(path: Path, scales: np.ndarray, r: np.ndarray) -> tuple[np.ndarray, tuple[int, ...]]:
    """An orthonormal basis (n, o) of the observable part of a state in units of scales, and states outside it.

    The rest is the null space of the observability Gramian of the path, sum over steps of Phi' H' R^-1 H Phi.
    """
    n = len(scales)
    gramian, phi = np.zeros((n, n)), np.eye(n)
    for f, h in zip(path.transitions, path.observations, strict=True):
        for _ in range(n if len(path.transitions) == 1 else 1):
            phi = (f / scales[:, None] * scales) @ phi
            phi /= max(np.abs(phi).max(), 1.0)
            observed = h * scales @ phi
            gramian += observed.T @ np.linalg.solve(r, observed)
    roots = np.sqrt(gramian.diagonal())
    visible = roots > 0.0
    correlations = gramian[np.ix_(visible, visible)] / roots[visible, None] / roots[visible]
    values, vectors = np.linalg.eigh(correlations)
    null = np.zeros((n, n - int(visible.sum()) + int((values < BLIND).sum())))
    null[~visible, : n - int(visible.sum())] = np.eye(n - int(visible.sum()))
    null[visible, n - int(visible.sum()) :] = vectors[:, values < BLIND] / roots[visible, None]
    basis = np.linalg.qr(null, mode="complete")[0]
    count = null.shape[1]
    outside = np.abs(basis[:, :count]).max(axis=1, initial=0.0) > 1e-6
    return basis[:, count:], tuple(np.flatnonzero(outside).tolist())


def forgetting_noise(
    path: Path,
    model: StateSpaceModel,
    steps: float,
    slowest: Callable[[np.ndarray], float] | None = None,
    constants: Sequence[int] = (),
) -> RaisedNoise:
    """Q of a model plus the least multiple of a floor for which no time constant exceeds `steps`.

        Q + c (1 - alpha^-2) mean of F P F',   alpha = exp(1 / steps)

    P is the steady covariance of the filter with fading memory, in whose prediction F is alpha F: as its gain
    makes alpha (I - K H) F stable, errors fade faster than exp(-k / steps). Where F and H are constant the floor
    is the noise with which a Kalman filter has this gain, and c at most 1: it is the least sufficient factor. If
    no multiple is sufficient, it is the one with the shortest time constant of those tried.

    Args:
        path: slopes of the model, from `slopes_along`.
        model: its Q and R.
        steps: the longest time constant that is allowed.
        slowest: the longest time constant with a Q (n, n); by default that of the steady gain along the path,
            repeated endlessly, of the observable part of the state.
        constants: indices of states that are meant to be remembered; their variances stay.

    Raises:
        ValueError: if nothing is observable.

    Source: Anderson, Moore (1979), Optimal Filtering, section 6.2 (exponential data weighting).
    """
    rest, r = _others(model.n, constants), model.measurement_noise_cov
    block, scales, path = np.ix_(rest, rest), _scales(model, path)[rest], path.of_states(rest)
    basis, _ = observable_part(path, scales, r)
    if not basis.shape[1]:
        rule = "a filter that forgets (--forget) must observe a state"
        raise ValueError(f"{rule}, but its measurements tell of none")
    root = np.linalg.cholesky(r)
    f = basis.T @ (path.transitions / scales[:, None] * scales) @ basis
    h = np.linalg.solve(root, path.observations * scales) @ basis
    q = basis.T @ (model.process_noise_cov[block] / scales[:, None] / scales) @ basis

    def steady(lift: np.ndarray) -> float:
        a, p, j = _steady(f, h, q + lift, path.q_factors)
        growth = np.abs(np.linalg.eigvals(np.linalg.solve(np.eye(len(p)) + j @ p, a.T).T)).max()
        return _steps_of(growth ** (1.0 / len(f)))

    def cov(lift: np.ndarray) -> np.ndarray:
        raised = model.process_noise_cov.copy()
        raised[block] += basis @ lift @ basis.T * scales[:, None] * scales
        return 0.5 * (raised + raised.T)

    reached = steady if slowest is None else lambda lift: slowest(cov(lift))
    first = reached(0.0 * q)
    if first <= steps * (1.0 + (WITHIN if slowest is None else 0.0)):
        return RaisedNoise(model.process_noise_cov, first)
    alpha = math.exp(1.0 / steps)
    floor = _floor(alpha * f, h, q, path.q_factors) * (1.0 - alpha**-2)
    tried: dict[float, float] = {}  # time constants by the logarithm of the factor on the floor
    for power in range(0, FACTORS + 1, STRIDE):
        tried[power] = reached(2.0**power * floor)
        if tried[power] <= steps:
            break
    low, high = -float(FACTORS), float(min(tried, key=lambda power: tried[power]))
    while tried[high] <= steps and high - low > WITHIN:
        middle = 0.5 * (low + high)
        tried[middle] = reached(2.0**middle * floor)
        low, high = (low, middle) if tried[middle] <= steps else (middle, high)
    return RaisedNoise(cov(2.0**high * floor), tried[high])


def _floor(f: np.ndarray, h: np.ndarray, q: np.ndarray, factors: np.ndarray) -> np.ndarray:
    """The mean of F P F' along a path, (n, n), P the steady covariance after each update."""
    p, total = _steady(f, h, q, factors)[1], np.zeros_like(q)
    for transition, observation, factor in zip(f, h, factors, strict=True):
        propagated = transition @ p @ transition.T
        total += propagated / len(f)
        predicted = propagated + factor * q
        gain = np.linalg.solve(
            np.eye(len(observation)) + observation @ predicted @ observation.T, observation @ predicted
        ).T
        left = np.eye(len(q)) - gain @ observation
        p = left @ predicted @ left.T + gain @ gain.T
    return 0.5 * (total + total.T)


def _steady(f: np.ndarray, h: np.ndarray, q: np.ndarray, factors: np.ndarray) -> tuple[np.ndarray, ...]:
    """For an endlessly repeated path: A of one pass, the steady covariance P at its end, and J of one pass.

    A pass takes P to A (I + P J)^-1 P A' + C. The function composes its steps by pairs, then doubles the pass.

    Source: Sarkka, Garcia-Fernandez (2021), "Temporal parallelization of Bayesian smoothers", IEEE TAC 66(1).
    """
    noise, unit = factors[:, None, None] * q, np.eye(len(q))
    s = np.eye(h.shape[1]) + h @ noise @ h.transpose(0, 2, 1)
    weighted = np.linalg.solve(s, h)  # S^-1 H
    left = unit - noise @ h.transpose(0, 2, 1) @ weighted
    observed = h @ f
    part: tuple[np.ndarray, ...] = (
        left @ f,
        left @ noise,
        observed.transpose(0, 2, 1) @ np.linalg.solve(s, observed),
    )
    while len(part[0]) > 1:
        half = len(part[0]) // 2
        rest = [stack[2 * half :] for stack in part]
        pairs = _composed([stack[: 2 * half : 2] for stack in part], [stack[1 : 2 * half : 2] for stack in part])
        part = tuple(np.concatenate([stack, more]) for stack, more in zip(pairs, rest, strict=True))
    a, c, j = (stack[0] for stack in part)
    first, p = (a, j), unit
    for _ in range(DOUBLINGS):
        before, p = p, a @ np.linalg.solve(unit + j, a.T) + c  # from the identity
        if np.abs(p - before).max() <= SETTLED * np.abs(p).max() or np.abs(a).max() > LARGEST:
            break
        a, c, j = (stack[0] for stack in _composed(*[(a[None], c[None], j[None])] * 2))
    return first[0], 0.5 * (p + p.T), first[1]


def _composed(first: Sequence[np.ndarray], second: Sequence[np.ndarray]) -> tuple[np.ndarray, ...]:
    (a, c, j), (b, d, k) = first, second
    through = np.linalg.solve(np.eye(a.shape[-1]) + k @ c, b.swapaxes(1, 2)).swapaxes(1, 2)  # B (I + C K)^-1
    inner = np.linalg.solve(np.eye(a.shape[-1]) + k @ c, k @ a)
    joined = through @ c @ b.swapaxes(1, 2) + d, a.swapaxes(1, 2) @ inner + j
    return through @ a, *(0.5 * (part + part.swapaxes(1, 2)) for part in joined)


def _is_regular(path: Path) -> bool:
    """Whether S of all channels that were measured can be solved for."""
    measured = path.observations.any(axis=2)
    variances = np.einsum("kii->ki", path.innovation_covs)
    return bool((variances[measured] > 0.0).all())


def _growth(steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean growth factors (n,) along steps (L, n, n), the largest first, and the direction of the largest."""
    values, vectors = np.linalg.eig(steps.mean(axis=0))
    q = np.linalg.qr(vectors[:, np.argsort(-np.abs(values))])[0]
    total = np.zeros(len(values))
    with np.errstate(divide="ignore"):
        for a in steps:
            q, upper = np.linalg.qr(a @ q)
            total += np.log(np.abs(upper.diagonal()))
    order = np.argsort(-total)
    return np.exp(total[order] / len(steps)), q[:, order[0]] if len(order) else np.zeros(0)


def _steps_of(growth: float) -> float:
    if growth <= 0.0:
        return 0.0
    return -1.0 / math.log(growth) if growth < 1.0 - SETTLED else math.inf


def _others(n: int, constants: Sequence[int]) -> np.ndarray:
    return np.delete(np.arange(n), np.asarray(constants, dtype=int))


def _scales(model: StateSpaceModel, path: Path) -> np.ndarray:
    """Deviations of the states along a path; the model's scales of states that have none."""
    deviations = np.sqrt(np.einsum("kii->ki", path.covs).clip(min=0.0).mean(axis=0))
    return np.where(deviations > 0.0, deviations, model.scales)
