"""Attainable accuracy: Riccati covariances, steady-state and along a path, and the posterior Cramer-Rao bound.

The posterior bound holds for any estimate and is computed from simulated true trajectories under each input. A
wrapped error of an angle is at most half a turn, so a bound on its plain error is converted (`wrapped_variances`).
"""

from __future__ import annotations

import hashlib
import importlib
from collections.abc import Callable, Sequence
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from filters.engine.batch import run
from filters.gaussian.extended import ExtendedKalmanFilter
from thruster_env.core.checks import as_floats, at_least, correlations, covariance_root, with_progress
from thruster_env.core.compiled import function_fingerprint, is_interpreting
from thruster_env.core.derivatives import step_growth, step_of
from thruster_env.core.matrices import multiplier, quadratic_form
from thruster_env.core.parallel import cores, spread
from thruster_env.core.sources import Source, matrix_reader, vector_reader, vector_writer
from thruster_env.core.streams import GROUP
from thruster_env.model.affine import AffineModel
from thruster_env.model.shape import (
    Functions,
    Shape,
    constants_reader,
    for_any_input,
    observation_slopes,
    padded,
    transition_slopes,
)
from thruster_env.model.simulate import noise_step, simulate, truth_steps
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.model.traced import called_function
from thruster_env.model.turns import (
    slopes_of_stored,
    slopes_of_tangent,
    tangent_of,
)

if TYPE_CHECKING:
    from thruster_env.graphs.loops import Loops

STIFF = 1e8  # S over R, from which an update of covariances loses half of their digits: roots keep them

DOUBLINGS, FORGOTTEN = 50, 1e-12  # rounds at most, and what is left of the first state in the end

# Of wrapped variances.
SMALL = 0.1  # variance [rad^2] up to which half a turn is so far away that nothing changes in float64
TERMS, POINTS = 24, 400  # of the Fourier series; of the curve
LEAST, MOST = 5e-3, 1e4  # multipliers mu [rad^4] of the curve's ends but for the last, mu = infinity

# Of the posterior bound.
ALL_UP_TO = 12  # states, for which the matrices of every sequence cost nothing that counts
MOST_WORK = 2e10  # truths x steps x n^3, of all sequences of a larger model together
MOST_STEPS = 3e7  # truths x steps x substeps, of all sequences of any model together
WORK_AT_ONCE = 2e9  # of the same, some seconds: Ctrl-C is heard in between
SINGULAR = 1e-13  # least eigenvalue of Q with unit variances, within rounding: Q has no inverse
ROUNDING = 8 * 2.0**-52  # of slopes by central differences, relative to (|x_i| + s_i)/h_j
MOST_BYTES, MATRICES = 2**28, 8  # of so many matrices (n, n) a sequence and step at once


def riccati_covariances(model: AffineModel) -> tuple[np.ndarray, np.ndarray]:
    """Steady-state covariances of the Kalman filter, predicted (before) and posterior (after the update).

    P solves the discrete algebraic Riccati equation P = A P A' - A P C' (C P C' + R)^-1 C P A' + Q; the
    posterior is P - P C' (C P C' + R)^-1 C P. Source: Anderson and Moore (1979), Optimal Filtering, ch. 4.
    """
    a, _, _, c, _ = model.matrices()
    predicted, gain = steady_state(a, c, model.process_noise_cov, model.measurement_noise_cov)
    posterior = predicted - gain @ (c @ predicted @ c.T + model.measurement_noise_cov) @ gain.T
    return predicted, (posterior + posterior.T) / 2


def steady_state(a: np.ndarray, c: np.ndarray, q: np.ndarray, r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The predicted covariance (n, n) that solves Riccati's equation, and the gain (n, m), in any units.

    It is solved in units of R's deviations and of those that Q gives the states in n steps.

    Raises numpy.linalg.LinAlgError if there is no stabilising solution.
    """
    reached, power = np.zeros_like(q), np.eye(len(a))
    for _ in range(len(a)):
        reached, power = reached + power @ q @ power.T, a @ power
    states, channels = correlations(reached)[1], correlations(r)[1]
    a, c = a / states[:, None] * states, c / channels[:, None] * states
    q, r = q / states[:, None] / states, r / channels[:, None] / channels
    predicted = _doubled(a, c, q, r)
    gain = np.linalg.solve(c @ predicted @ c.T + r, c @ predicted).T
    return predicted * states[:, None] * states, gain * states[:, None] / channels


def _doubled(a: np.ndarray, c: np.ndarray, q: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Riccati's solution by doubling: round k propagates the covariance from zero through 2^k steps.

    If that does not forget where it began, as of a growing state without noise, it is SciPy's solution.
    Source: Chu, Fan, Lin, Wang (2004), "Structure-preserving algorithms for periodic discrete-time algebraic
    Riccati equations".
    """
    f, g, p, unit = a.T, c.T @ np.linalg.solve(r, c), q, np.eye(len(a))
    for _ in range(DOUBLINGS):
        if not np.abs(f).max() < 1.0 / FORGOTTEN:
            break
        of_f, of_g = np.split(np.linalg.solve(unit + g @ p, np.hstack([f, g])), 2, axis=1)
        g, more, f = g + f @ of_g @ f.T, f.T @ p @ of_f, f @ of_f
        g, p = (g + g.T) / 2, p + (more + more.T) / 2
        if np.abs(f).max() < FORGOTTEN and np.abs(more).max() <= 1e-17 * np.abs(p).max():
            return p
    from scipy.linalg import solve_discrete_are  # which takes half a second to import

    p = solve_discrete_are(a.T, c.T, q, r)
    return (p + p.T) / 2


def path_bound(model: StateSpaceModel, inputs: np.ndarray, missing: np.ndarray | None = None) -> np.ndarray:
    """Riccati covariance along the noise-free path of each input sequence, a reference for small noise.

    With F and H at the states that follow from the prior mean without any noise,

        P = F P F' + Q,  K = P H' (H P H' + R)^-1,  P = (I - K H) P

    It is the covariance of an extended Kalman filter on the path, and optimal for a linear model. It is not a
    bound where noise moves the state so far that F or H differ. But it can be used where `posterior_bound` cannot:
    for a singular Q, and for a state with hardly any process noise, for which E[F' Q^-1 F] mistakes the smallest
    differences of F between simulated states for information.

    Args:
        model: the model that draws the truth.
        inputs: (B, K, p), one sequence a row.
        missing: whether each measurement is missing, (B, K + 1, channels); none if None.

    Returns:
        P_k for every sequence and step, (B, K + 1, n, n), of rotations (B, K + 1, t, t) in their tangent; index 0
        is after the first measurement. NaN for a sequence along which it is too large for float64.
    """
    inputs = np.ascontiguousarray(as_floats(inputs))
    keys, nothing = np.zeros((len(inputs), 2)), np.zeros((model.t, model.t))
    rounding = 1e-30 * model.measurement_noise_cov  # none at all is no covariance of a measurement
    calm = model.replace(process_noise_cov=nothing, prior_cov=nothing, measurement_noise_cov=rounding)
    measured = simulate(calm, keys, inputs).measurements
    if missing is not None:
        measured = np.where(missing, np.nan, measured)
    # Measurements that are right leave the estimate on the path.
    estimates = run(ExtendedKalmanFilter(model=model), keys, inputs, measured)
    expected = np.einsum("bkii->bki", estimates.innovation_covs) / np.diag(model.measurement_noise_cov)
    if (expected < STIFF).all() and not estimates.divergences.any():
        return estimates.covs
    estimates = run(ExtendedKalmanFilter(model=model, form="square-root"), keys, inputs, measured)
    return np.where((estimates.divergences > 0)[:, None, None, None], np.nan, estimates.covs)


def wrapped_variances(variances: np.ndarray, angles: Sequence[bool]) -> np.ndarray:
    """Bounds (..., n) on mean squares of wrapped errors, from posterior Cramér-Rao bounds P on plain ones.

    A density f of an error e on the circle, whose information is at most J = 1/P, has at least the mean square

        v(J) = min E[e^2]  over periodic f on (-pi, pi] with E[(d log f/de)^2] <= J

    A posterior density has no more information after it is wrapped, or after other states are integrated out, and
    v is convex, so the mean of v over measurements is at least v of the mean information: v(1/P) is a bound. With
    f = psi^2 it is the ground state of -4 mu psi'' + e^2 psi = lambda psi, v = lambda - mu J. Far from the cut psi
    is a Gaussian and v = P; so it is up to P = 0.1 rad^2 (18 degrees). For large P it tends to pi^2/3, the mean
    square of a completely unknown angle.

    Args:
        variances: P of n states [rad^2 where they are angles].
        angles: (n,), which states are angles.

    Source: Van Trees (1968), Detection, Estimation, and Modulation Theory I, section 2.4, for P.
    """
    if not any(angles):
        return variances
    bounded = np.array(variances)
    for i in np.flatnonzero(angles):
        large = bounded[..., i] > SMALL
        bounded[large, i] = _curve()(bounded[large, i] ** -0.5)
    return bounded


@cache
def _curve() -> Callable:
    """V as a function of sqrt(J): cubic between points, where dv/dJ = -mu is known."""
    from scipy.interpolate import CubicHermiteSpline

    multipliers = np.geomspace(MOST, LEAST, POINTS)
    points = np.array([_ground_state(mu) for mu in multipliers])
    roots = np.sqrt(points[:, 0])
    # For little information v = pi^2/3 - 2 sqrt(2 J), by perturbation of the uniform density.
    ends = np.append(0.0, roots), np.append(np.pi**2 / 3.0, points[:, 1])
    return CubicHermiteSpline(*ends, np.append(-2.0 * np.sqrt(2.0), -2.0 * multipliers * roots))


def _ground_state(mu: float) -> tuple[float, float]:
    """J and v of a multiplier mu, from psi as a sum of cos(k e), k = 0, 1, ..."""
    k = np.arange(TERMS)
    square = _means(np.add.outer(k, k)) + _means(np.subtract.outer(k, k))
    unit = np.where(k == 0, np.sqrt(0.5), 1.0)  # the constant has twice the mean square of a cosine
    square *= np.outer(unit, unit)
    psi = np.linalg.eigh(square + np.diag(4.0 * mu * k**2))[1][:, 0]
    return float(4.0 * k**2 @ psi**2), float(psi @ square @ psi)


def _means(order: np.ndarray) -> np.ndarray:
    return np.where(order == 0, np.pi**2 / 3.0, 2.0 * np.where(order % 2, -1.0, 1.0) / np.maximum(order**2, 1))


def posterior_bound(model: StateSpaceModel, inputs: np.ndarray, *, truths: int = 100, seed: int = 0) -> np.ndarray:
    """Posterior Cramer-Rao bound on the covariance of any estimate, conditional on each input sequence.

    With F = df/dx and H = dh/dx at states simulated under this input sequence ("truths"), and P = J^-1,

        J_0 = P_0^-1 + E[H' R^-1 H],  D11 = E[F' Q^-1 F],  D12 = -E[F'] Q^-1,
        J_{k+1} = Q^-1 + E[H' R^-1 H] - D12' (J_k + D11)^-1 D12

    written with P in place of J, so that P_0 may be singular, and with C = E[(F - E[F])' Q^-1 (F - E[F])]:

        P_{k+1} = (G_k^-1 + E[H' R^-1 H])^-1,  G_k = Q + E[F] (P_k^-1 + C)^-1 E[F]'

    which loses no digits where Q is small beside F P F'. Expectations are over truths of one sequence: with
    Jacobians pooled over different inputs, the result would not be a bound. It bounds squares of plain errors: of
    a state that is an angle, `filters.bounds.wrapped_variances` of it bounds those of wrapped ones. With rotations
    F, H and P are of the tangent (t, t) at the truth, which leaves out its curvature: a bound of small errors, up
    to some 20 degrees.

    Args:
        model: the model that draws the truth; Q must be positive definite.
        inputs: (B, K, p), one sequence a row.
        truths: truths drawn for each sequence.
        seed: of the truths.

    Returns:
        Bound P_k for every sequence and step, (B, K + 1, n, n); index 0 is after the first measurement. It is
        not finite from the step on at which numbers are too large for float64.

    Raises:
        ValueError: if Q is singular: then the recursion's Q^-1 does not exist.

    Source: Tichavsky, Muravchik, Nehorai (1998), "Posterior Cramer-Rao bounds for discrete-time nonlinear
    filtering", IEEE Trans. Signal Processing 46(5), eqs. 21 and 34-36.
    """
    inputs = np.ascontiguousarray(as_floats(inputs))
    return _posterior_bound(model, inputs, _truth_keys(len(inputs), truths, seed))


def posterior_variances(
    model: StateSpaceModel, inputs: np.ndarray, *, truths: int = 100, seed: int = 0
) -> np.ndarray:
    """Diagonals of `posterior_bound` without its matrices; fewer sequences for large or long models.

    Those of angles are bounds on the squares of wrapped errors (`filters.bounds.wrapped_variances`).

    As many sequences are taken, spread evenly over those given, as 3e7 substeps of truths allow, and of a model
    with more than twelve states no more than 2e10 of truths x steps x n^3 allow: at least one, and one alone where
    all are the same, for its bound is that of all. The number of truths is never reduced.

    Args:
        model: the model that draws the truth; Q must be positive definite.
        inputs: (B, K, p), one sequence a row.
        truths: truths drawn for each sequence.
        seed: of the truths.

    Returns:
        Variances for every sequence that is taken and every step, (B or fewer, K + 1, n).

    Raises:
        ValueError: if Q is singular.
    """
    inputs, keys = as_floats(inputs), _truth_keys(len(inputs), truths, seed)
    rows = sequences_taken(inputs, truths, model)
    inputs, keys = np.ascontiguousarray(inputs[rows], dtype=np.float64), np.ascontiguousarray(keys[rows])
    count, steps = inputs.shape[:2]
    most = max(MOST_BYTES // (8 * MATRICES * (steps + 1) * model.n**2), cores())
    variances = np.empty((count, steps + 1, model.t))
    parts = [slice(first, min(first + most, count)) for first in range(0, count, most)]
    for part in with_progress("posterior bound", parts, [len(inputs[part]) for part in parts]):
        variances[part] = np.einsum("bkii->bki", _posterior_bound(model, inputs[part], keys[part]))
    return wrapped_variances(variances, [quantity.angle for quantity in tangent_of(model)])


def gathering_code(model: StateSpaceModel) -> tuple[Loops, str]:
    """What sums up Jacobians for the bound of a model, and a hash of all code that determines the bound."""
    functions = model.functions
    fingerprint = function_fingerprint(*(function for function in functions if function is not None))
    return _gatherer(functions, model.any_shape, is_interpreting()), fingerprint + _sources_hash()


def sources_hash(*packages: str) -> str:
    """Hash of all source files of packages."""
    digest = hashlib.sha256()
    for package in packages:
        for path in sorted(Path(importlib.import_module(package).__path__[0]).rglob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()


@cache
def _sources_hash() -> str:
    return sources_hash("thruster_env.core", "thruster_env.graphs", "thruster_env.model", "filters")


def sequences_taken(inputs: np.ndarray, truths: int, model: StateSpaceModel) -> np.ndarray:
    """Indices of the sequences that `posterior_variances` of a model uses."""
    count, steps, _ = inputs.shape
    large = model.n > ALL_UP_TO
    if large and count and (inputs == inputs[:1]).all():
        return np.arange(1)
    most = MOST_STEPS / (truths * steps * model.substeps)
    if large:
        most = min(most, MOST_WORK / (truths * steps * model.n**3))
    most = min(max(int(most), 1), count)
    return np.arange(most) * count // most if count else np.arange(0)


def _truth_keys(count: int, truths: int, seed: int) -> np.ndarray:
    size = count, at_least("truths", truths, 2), 2
    return np.random.default_rng(seed).integers(0, 2**32, size=size).astype(np.float64)


def _posterior_bound(model: StateSpaceModel, inputs: np.ndarray, keys: np.ndarray) -> np.ndarray:
    """The bound of `posterior_bound` from the truths of these keys, by square roots S S' = P."""
    if not has_bound(model.process_noise_cov):
        raise ValueError(f"the bound needs a positive definite Q, but got {model.process_noise_cov.tolist()}")
    (count, steps, _), n = inputs.shape, model.t
    f_mean, spread_of_f, information = (np.zeros((count, steps + 1, n, n)) for _ in range(3))
    q_inverse, r_inverse = _inverse(model.process_noise_cov), _inverse(model.measurement_noise_cov)
    weights, sums = (q_inverse.ravel(), r_inverse.ravel()), (f_mean, spread_of_f, information)
    fixed = np.ascontiguousarray(inputs), model.numbers, *weights, *sums
    add, done = _gatherer(model.functions, model.any_shape, is_interpreting()), 0
    # Some truths at a time, in the same order: Ctrl-C is heard in between.
    size = max(int(WORK_AT_ONCE / (max(count, 1) * (steps + 1) * n**3)), 1)
    parts = [np.ascontiguousarray(keys[:, first : first + size]) for first in range(0, keys.shape[1], size)]
    for batch in with_progress("truths", parts, [part.shape[1] for part in parts]):
        spread(partial(add, batch, done, *fixed), count)
        done += batch.shape[1]
    spread_of_f /= done
    information /= done

    bound = np.empty((count, steps + 1, n, n))
    prior, noise = (covariance_root(cov) for cov in (model.prior_cov, model.process_noise_cov))
    noises = np.broadcast_to(noise.T, (count, n, n))
    root = _informed(np.broadcast_to(prior, (count, n, n)), information[:, 0])
    bound[:, 0] = _square(root)
    for k in range(steps):
        propagated = f_mean[:, k] @ _informed(root, spread_of_f[:, k])
        rows = np.concatenate([np.swapaxes(propagated, -1, -2), noises], axis=-2)
        root = _informed(np.swapaxes(np.linalg.qr(rows, mode="r"), -1, -2), information[:, k + 1])
        bound[:, k + 1] = _square(root)
    return bound


def has_bound(process_noise_cov: np.ndarray) -> bool:
    """Whether a Q has a posterior bound: the recursion needs its inverse, which rounding must not make up."""
    if not np.diag(process_noise_cov).all():
        return False
    return bool(np.linalg.eigvalsh(correlations(process_noise_cov)[0])[0] > SINGULAR)


def _inverse(cov: np.ndarray) -> np.ndarray:
    """The inverse of a covariance of any magnitude, which enters the recursion as a weight."""
    scaled, deviations = correlations(cov)
    return np.linalg.inv(scaled) / deviations / deviations[:, None]


@np.errstate(all="ignore")  # numbers too large for float64 are NaN in the end
def _informed(root: np.ndarray, information: np.ndarray) -> np.ndarray:
    """A root of (P^-1 + information)^-1, P = root root' of any rank: root (I + root' information root)^-1/2."""
    gained = np.swapaxes(root, -1, -2) @ information @ root
    lost = ~np.isfinite(gained).all(axis=(-1, -2), keepdims=True)
    gained = np.where(lost, 0.0, (gained + np.swapaxes(gained, -1, -2)) / 2)
    lower = np.linalg.cholesky(np.eye(root.shape[-1]) + gained)
    return np.where(lost, np.nan, np.swapaxes(np.linalg.solve(lower, np.swapaxes(root, -1, -2)), -1, -2))


@np.errstate(all="ignore")
def _square(root: np.ndarray) -> np.ndarray:
    return root @ np.swapaxes(root, -1, -2)


@lru_cache(maxsize=64)
def _gatherer(functions: Functions, shape: Shape, interpreting: bool):
    n, t, m, transition = shape.n, shape.t, shape.m, functions.transition
    transition_matrix = transition_slopes(functions, shape)
    observation_matrix = _of_innovations(functions, shape)
    (begin, _, _), disturb = truth_steps(functions, shape), noise_step(shape)
    state, store_state = vector_reader(n), vector_writer(n)
    control, constants = vector_reader(shape.inputs), constants_reader(shape)
    scales, substeps = vector_reader(n, shape.offsets.scales), shape.offsets.substeps
    room, times, identity = padded(max(n, m), GROUP), multiplier(n, n, n), matrix_reader(n, n)
    read_weight_n, read_weight_m = matrix_reader(t, t), matrix_reader(m, m)
    quadratic_n, quadratic_m = quadratic_form(t, t), quadratic_form(m, t)
    accumulate = _into("out[b, k, {i}, {j}] += weight * a[{i}][{j}]", t)
    move_mean = _into("out[b, k, {i}, {j}] += weight * (a[{i}][{j}] - out[b, k, {i}, {j}])", t)
    less_mean = _from_mean(t, functions.transition_jacobian is None)
    columns, rows, tangent = _on_tangent(shape)

    def whole_step(x, u, numbers, c, eye):
        f = identity(eye)
        for _ in range(int(numbers[substeps])):
            f = times(transition_matrix(x, scales(numbers), u, c), f)
            x = transition(x, u, c)
        return f, x

    def gather(keys, before, inputs, numbers, q_inverse, r_inverse, f_mean, spread_of_f, information, first, last):
        x, u, draws, eye = np.zeros(n), np.zeros(inputs.shape[2]), np.zeros(room), np.zeros(n * n)
        for i in range(n):
            eye[i * (n + 1)] = 1.0
        c, s = constants(numbers), scales(numbers)
        weight_q, weight_r = read_weight_n(q_inverse), read_weight_m(r_inverse)
        for b in range(first, last):
            for truth in range(keys.shape[1]):
                key_0, key_1 = keys[b, truth, 0], keys[b, truth, 1]
                share = 1.0 / (before + truth + 1.0)  # of this truth in the mean, as Welford (1962) has it
                begin(x, draws, key_0, key_1, numbers)
                for i in range(u.shape[0]):
                    u[i] = 0.0
                for k in range(f_mean.shape[1]):
                    measured = quadratic_m(
                        columns(observation_matrix(state(x), s, control(u), c), state(x)), weight_r
                    )
                    accumulate(information, b, k, measured, 1.0)
                    if k == inputs.shape[1]:
                        break
                    for i in range(u.shape[0]):
                        u[i] = inputs[b, k, i]
                    f, predicted = whole_step(state(x), control(u), numbers, c, eye)
                    of_errors = rows(f, state(x), predicted)
                    apart = quadratic_n(
                        less_mean(of_errors, f_mean, b, k, tangent(state(x)), tangent(s)), weight_q
                    )
                    accumulate(spread_of_f, b, k, apart, 1.0 - share)
                    move_mean(f_mean, b, k, of_errors, share)
                    store_state(x, predicted)
                    disturb(x, draws, k + 1, key_0, key_1, numbers)

    from thruster_env.graphs.loops import Loops

    matrices, weights = [(None, None, t, t)] * 3, ((t * t,), (m * m,))
    shapes = (None, None, 2), None, (None, None, None), (None,), *weights, *matrices, None, None
    return Loops(gather, shapes)


def _of_innovations(functions: Functions, shape: Shape):
    """The function of x, scales, u and c: H (m, n), of measured rotations on their tangent at h(x)."""
    slopes, turns = for_any_input(observation_slopes(functions, shape), shape, "x, scales"), shape.measured_turns
    if not turns:
        return slopes

    def back(y, c):
        return tuple(map(tuple, slopes_of_tangent(y, turns)))

    m, channels, observe = shape.m, shape.channels, for_any_input(functions.observe, shape)
    by_tangent = called_function(back, "y, c", (channels, 0), 0, (m, channels))
    on_tangent = multiplier(m, channels, shape.n)

    def of_innovations(x, scales, u, c):
        return on_tangent(by_tangent(observe(x, u, c), ()), slopes(x, scales, u, c))

    return of_innovations


def _same(x):
    return x


def _first_of_two(h, x):
    return h


def _first_of_three(f, x, y):
    return f


def _on_tangent(shape: Shape):
    """Functions of H and x, of F, x and f(x), and of a vector (n,): these on the tangent, as P has it.

    At the true states, so that errors of the body are in the axes of the truth; for small errors.
    """
    n, t, m, turns = shape.n, shape.t, shape.m, shape.turns
    if not turns:
        return _first_of_two, _first_of_three, _same

    def stored(x, c):
        return tuple(map(tuple, slopes_of_stored(x, turns)))

    def back(x, c):
        return tuple(map(tuple, slopes_of_tangent(x, turns)))

    by_stored = called_function(stored, "x, c", (n, 0), 0, (n, t))
    by_tangent = called_function(back, "x, c", (n, 0), 0, (t, n))
    of_h, of_columns, of_rows = multiplier(m, n, t), multiplier(n, n, t), multiplier(t, n, t)
    numbers = np.delete(np.arange(n), [turn.stored for turn in turns]).tolist()
    source = Source("tangent", "x", result=(t,), x=(n,))

    def columns(h, x):
        return of_h(h, by_stored(x, ()))

    def rows(f, x, y):
        return of_rows(by_tangent(y, ()), of_columns(f, by_stored(x, ())))

    return columns, rows, source.function(source.vector(t, lambda i: f"x[{numbers[i]}]"))


def _into(line: str, n: int):
    """Return `add(out, b, k, a, weight)`, the line for each entry i, j of a matrix a (n, n)."""
    source = Source("add", "out, b, k, a, weight", a=(n, n))
    for i in source.range(n):
        for j in source.range(n):
            source.line(line.format(i=i, j=j))
    return source.function()


def _from_mean(n: int, by_differences: bool):
    """Return `less_mean(f, means, b, k, x, s)`: F - E[F]; 0 where that is rounding of differences.

    A tiny Q would take that for information.
    """

    def entry(i, j):
        apart = f"f[{i}][{j}] - means[b, k, {i}, {j}]"
        if not by_differences:
            return apart
        noise = f"{ROUNDING} * (abs(x[{i}]) + s[{i}]) / step_of(x[{j}], s[{j}], far)"
        return f"({apart} if abs({apart}) > {noise} else 0.0)"

    source = Source("less_mean", "f, means, b, k, x, s", result=(n, n), f=(n, n), x=(n,), s=(n,))
    source.line("far = step_growth(x, s)")
    return source.function(source.entries((n, n), entry), step_of=step_of, step_growth=step_growth(n))
