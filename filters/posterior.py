"""The posterior Cramer-Rao bound on any estimate, from simulated true trajectories under each input."""

from __future__ import annotations

from functools import cache, partial

import numpy as np

from numerics.checks import at_least
from numerics.compiled import CompiledOrPython, function_fingerprint, inlined, is_interpreting
from numerics.matrices import multiplier, quadratic_form
from numerics.progress import told
from numerics.sources import Source, entrywise
from numerics.streams import GROUP
from numerics.threads import cores, spread
from numerics.tuples import matrix_reader, vector_reader
from plants.layout import constants_reader, number_places, padded
from plants.shape import Functions, Shape, observation_slopes, transition_slopes
from plants.simulate import truth_steps
from plants.state_space import StateSpaceModel

ALL_UP_TO = 12  # states, for which the bound is that of every sequence
MOST_WORK = 2e10  # truths x steps x n^3, of all sequences of a larger model together
WORK_AT_ONCE = 2e9  # of the same, some seconds: Ctrl-C is heard in between
SINGULAR, STIFF = 1e-13, 1e-4  # least eigenvalue of Q with unit variances: of none within rounding; of few digits
MOST_BYTES, MATRICES = 2**28, 8  # of so many matrices (n, n) a sequence and step at once


def posterior_bound(model: StateSpaceModel, inputs: np.ndarray, *, truths: int = 100, seed: int = 0) -> np.ndarray:
    """Posterior Cramer-Rao bound on the covariance of any estimate, conditional on each input sequence.

    With F = df/dx and H = dh/dx at states simulated under this input sequence ("truths"), and P = J^-1,

        J_0 = P_0^-1 + E[H' R^-1 H],  D11 = E[F' Q^-1 F],  D12 = -E[F'] Q^-1,
        J_{k+1} = Q^-1 + E[H' R^-1 H] - D12' (J_k + D11)^-1 D12

    written with P in place of J, so that P_0 may be singular. Expectations are over truths of one sequence: with
    Jacobians pooled over different inputs, the result would not be a bound.

    Args:
        model: the model that draws the truth; Q must be positive definite.
        inputs: (B, K, p), one sequence a row.
        truths: truths drawn for each sequence.
        seed: of the truths.

    Returns:
        Bound P_k for every sequence and step, (B, K + 1, n, n); index 0 is after the first measurement.

    Raises:
        ValueError: if Q is singular: then the recursion's Q^-1 does not exist.

    Source: Tichavsky, Muravchik, Nehorai (1998), "Posterior Cramer-Rao bounds for discrete-time nonlinear
    filtering", IEEE Trans. Signal Processing 46(5), eqs. 21 and 34-36.
    """
    inputs = np.ascontiguousarray(inputs, dtype=np.float64)
    return _posterior_bound(model, inputs, _truth_keys(len(inputs), truths, seed))


def posterior_variances(
    model: StateSpaceModel, inputs: np.ndarray, *, truths: int = 100, seed: int = 0
) -> np.ndarray:
    """Diagonals of `posterior_bound` without its matrices of every step, and of a large model for fewer sequences.

    Up to twelve states they are those of all sequences. Beyond, a sequence is truths x steps x n^3 of work, and
    as many sequences are taken, spread evenly over those given, as 2e10 of it allow: at least one, and one alone
    where all are the same, for its bound is that of all. Truths are never fewer.

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
    keys = _truth_keys(len(inputs), truths, seed)
    some = _taken(np.asarray(inputs, dtype=np.float64), truths, model.n)
    inputs, keys = np.ascontiguousarray(inputs[some], dtype=np.float64), np.ascontiguousarray(keys[some])
    count, steps = inputs.shape[:2]
    most = max(MOST_BYTES // (8 * MATRICES * (steps + 1) * model.n**2), cores())
    variances = np.empty((count, steps + 1, model.n))
    parts = [slice(first, min(first + most, count)) for first in range(0, count, most)]
    for part in told("posterior bound", parts, [len(inputs[part]) for part in parts]):
        variances[part] = np.einsum("bkii->bki", _posterior_bound(model, inputs[part], keys[part]))
    return variances


def _taken(inputs: np.ndarray, truths: int, n: int) -> np.ndarray:
    """Places of the sequences of which `posterior_variances` are made."""
    count, steps, _ = inputs.shape
    if n <= ALL_UP_TO or not count:
        return np.arange(count)
    if (inputs == inputs[:1]).all():
        return np.arange(1)
    most = min(max(int(MOST_WORK / (truths * steps * n**3)), 1), count)
    return np.arange(most) * count // most


def _truth_keys(count: int, truths: int, seed: int) -> np.ndarray:
    """Keys of the truths of each sequence, (count, truths, 2)."""
    size = count, at_least("truths", truths, 2), 2
    return np.random.default_rng(seed).integers(0, 2**32, size=size).astype(np.float64)


def _posterior_bound(model: StateSpaceModel, inputs: np.ndarray, keys: np.ndarray) -> np.ndarray:
    """The bound of `posterior_bound` from the truths of these keys.

    Where Q is nearly singular, Q^-1 - D12' (J + D11)^-1 D12 loses all its digits. Then D11 is summed about the
    mean, C = E[(F - E[F])' Q^-1 (F - E[F])], and the same is (Q + E[F] (J + C)^-1 E[F]')^-1.
    """
    if not has_bound(model.process_noise_cov):
        raise ValueError(f"the bound needs a positive definite Q, but got {model.process_noise_cov.tolist()}")
    (count, steps, _), (_, truths, _) = inputs.shape, keys.shape
    n = model.n
    q_inverse = np.linalg.inv(model.process_noise_cov)  # enters the recursion itself, as a weight
    r_inverse = np.linalg.inv(model.measurement_noise_cov)
    f_mean, d11, information = (np.zeros((count, steps + 1, n, n)) for _ in range(3))
    fixed = inputs, model.numbers, q_inverse.ravel(), r_inverse.ravel()
    sums = f_mean, d11, information
    # Some truths at a time, in the same order: Ctrl-C is heard in between.
    size = max(int(WORK_AT_ONCE / (max(count, 1) * (steps + 1) * n**3)), 1)
    parts = [np.ascontiguousarray(keys[:, first : first + size]) for first in range(0, truths, size)]

    def gather(about_mean: bool) -> None:
        add = _gatherer(model.functions, model.shape, about_mean, is_interpreting())
        for some in told("truths", parts, [part.shape[1] for part in parts]):
            spread(partial(add, some, *fixed, *sums), count)

    gather(False)
    for part in sums:
        part /= truths
    stiff = _least_direction(model.process_noise_cov) < STIFF
    if stiff:
        d11[:] = 0.0
        gather(True)
        d11 /= truths

    bound = np.empty((count, steps + 1, n, n))
    prior = np.broadcast_to(model.prior_cov, (count, n, n))
    bound[:, 0] = _less_information(prior, information[:, 0])
    for k in range(steps):
        if stiff:
            moved = f_mean[:, k] @ _less_information(bound[:, k], d11[:, k]) @ np.swapaxes(f_mean[:, k], -1, -2)
            bound[:, k + 1] = _less_information(model.process_noise_cov + moved, information[:, k + 1])
            continue
        d12 = -np.swapaxes(f_mean[:, k], -1, -2) @ q_inverse
        kept = _less_information(bound[:, k], d11[:, k])  # (J_k + D11)^-1
        j = q_inverse + information[:, k + 1] - np.swapaxes(d12, -1, -2) @ kept @ d12
        bound[:, k + 1] = np.linalg.inv((j + np.swapaxes(j, -1, -2)) / 2)
    return bound


def has_bound(process_noise_cov: np.ndarray) -> bool:
    """Whether a Q has a posterior bound: the recursion needs its inverse, which rounding must not make up."""
    return _least_direction(process_noise_cov) > SINGULAR


def _least_direction(q: np.ndarray) -> float:
    """The least eigenvalue of Q, its variances scaled to 1; 0 if one of these is 0."""
    deviations = np.sqrt(np.diag(q))
    return float(np.linalg.eigvalsh(q / np.outer(deviations, deviations))[0]) if deviations.all() else 0.0


def _less_information(p: np.ndarray, information: np.ndarray) -> np.ndarray:
    """(P^-1 + information)^-1 for a P that may be singular: (I + P information)^-1 P."""
    result = np.linalg.solve(np.eye(p.shape[-1]) + p @ information, p)
    return (result + np.swapaxes(result, -1, -2)) / 2


@cache
def _gatherer(functions: Functions, shape: Shape, about_mean: bool, interpreting: bool):
    n, m, transition = shape.n, shape.m, functions.transition
    transition_matrix, observation_matrix = (
        transition_slopes(functions, shape),
        observation_slopes(functions, shape),
    )
    begin, advance, _ = truth_steps(functions, shape)
    state, control, constants = vector_reader(n), vector_reader(shape.inputs), constants_reader(shape)
    scales = vector_reader(n, number_places(n, m).scales)
    substeps, room = number_places(n, m).substeps, padded(max(n, m), GROUP)
    times, identity = multiplier(n, n, n), matrix_reader(n, n)
    read_weight_n, read_weight_m = matrix_reader(n, n), matrix_reader(m, m)
    quadratic_n, quadratic_m = quadratic_form(n, n), quadratic_form(m, n)
    adder = Source("accumulate", "out, b, k, a", a=(n, n))
    for i in adder.range(n):
        for j in adder.range(n):
            adder.line(f"out[b, k, {i}, {j}] += a[{i}][{j}]")
    accumulate = adder.function()
    less_mean = entrywise(
        "less_mean", "f, means, b, k", (n, n), lambda i, j: f"f[{i}][{j}] - means[b, k, {i}, {j}]", f=(n, n)
    )
    fingerprint = function_fingerprint(transition, transition_matrix, observation_matrix, within=__name__)

    @inlined
    def whole_step_matrix(x, u, numbers, c, eye):
        f = identity(eye)
        for _ in range(int(numbers[substeps])):
            f = times(transition_matrix(x, scales(numbers), u, c), f)
            x = transition(x, u, c)
        return f

    def gather(keys, inputs, numbers, q_inverse, r_inverse, f_mean, d11, information, first, last):
        fingerprint  # noqa: B018 - part of the cache's key
        x, u, draws, eye = np.zeros(n), np.zeros(inputs.shape[2]), np.zeros(room), np.eye(n).ravel()
        c = constants(numbers)
        weight_q, weight_r = read_weight_n(q_inverse), read_weight_m(r_inverse)
        for b in range(first, last):
            for truth in range(keys.shape[1]):
                key_0, key_1 = keys[b, truth, 0], keys[b, truth, 1]
                begin(x, draws, key_0, key_1, numbers)
                for k in range(f_mean.shape[1]):
                    if not about_mean:
                        accumulate(
                            information,
                            b,
                            k,
                            quadratic_m(observation_matrix(state(x), scales(numbers), c), weight_r),
                        )
                    if k == inputs.shape[1]:
                        break
                    for i in range(u.shape[0]):
                        u[i] = inputs[b, k, i]
                    f = whole_step_matrix(state(x), control(u), numbers, c, eye)
                    if about_mean:
                        accumulate(d11, b, k, quadratic_n(less_mean(f, f_mean, b, k), weight_q))
                    else:
                        accumulate(d11, b, k, quadratic_n(f, weight_q))
                        accumulate(f_mean, b, k, f)
                    advance(x, u, draws, k + 1, key_0, key_1, numbers)

    return CompiledOrPython(gather)
