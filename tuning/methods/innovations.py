"""Methods by innovations: Q and R from their covariances, and what filters find that adapt to them.

In order: autocovariances of a fixed gain's innovations, autocovariance least squares, Mehra's covariance matching;
Desroziers' diagnostics; Anderson's adaptive inflation; the mean Q and R of adaptive filters over all runs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from filters import make_filter
from filters.bounds import steady_state
from filters.engine.session import Session
from filters.tuned_file import NOISE as NOISE_OPTIONS
from tuning.evaluation.baselines import with_covariances
from tuning.likelihood.parametric import Family
from tuning.methods.task import (
    COVARIANCE,
    DIAGONAL,
    GRADIENT,
    INFLATION,
    LINEAR,
    MATRICES,
    NOISE,
    Stationary,
    Task,
    method,
    stationary,
)
from tuning.problems.data import Data, estimates_in_parts
from tuning.search.parameters import FILTER_PARAMETERS
from tuning.search.space import Choice

LAGS = 15
DROPPED = 100  # rows at the beginning, at most a fifth of a run
ITERATIONS = 3  # the gain of each is that of the Q and R found before
LEAST_DECAY = 1e-9  # of an error in a step
UNEXPLAINED = (
    1e-6  # part of Q or R that numbers may not stand for: slopes of a model's own numbers are differences
)

# Of autocovariance least squares.
LEAST = 1e-10  # part of the start's variances below which none falls, so that a gain exists
PRECISE, MOST = 1e-12, 400  # relative change of squares and roots that ends Gauss and Newton's steps; and how many

# Of Desroziers' diagnostics.
DESROZIERS_ITERATIONS = 30
CLOSE = 1e-3  # relative change that ends it
MOST_CHANGE = 10.0  # factor on Q or R in an iteration

# Of Anderson's adaptive inflation, and of adaptive filters.
DEVIATION = 0.1  # s at the beginning: how well lambda is known
LEAST_DEVIATION = 0.02  # below which s does not fall, so that lambda may go on to change
NEWTON = 8  # steps to the mode
SETTLED = 0.25  # part of a run whose lambdas do not count
FORGETTING = 0.995  # of Q and R a step


class Noise(NamedTuple):
    """Q and R as sums of numbers times units, and of what no number moves."""

    q: np.ndarray  # units, (p, n, n)
    r: np.ndarray  # (p, m, m)
    rest: tuple[np.ndarray, np.ndarray]


def by_lags(task: Task, name: str, equations: Callable[..., tuple[np.ndarray, np.ndarray]]) -> None:
    """Numbers not below zero that solve linear equations in the lagged covariances of innovations, three times.

    Args:
        task: what is tuned.
        name: of the method, for errors.
        equations: (linear, gain, covariances (lags, m, m), noise) returns the matrix (rows, p) and the right side.

    Raises:
        ValueError: of a model that is not linear, or whose Q and R are not linear in the numbers.
    """
    from scipy.optimize import nnls

    family = Family(task.start, task.problems[0], task.free, task.data[0])
    coordinates = family.coordinates
    if not coordinates.log.all():
        raise ValueError(
            f"method {name!r} needs Q and R linear in positive numbers, but a number is on a linear scale"
        )
    linear = stationary(task.model(task.start), task.problems[0].name, name)
    point = coordinates.clip(coordinates.of(task.values_of(task.start, task.free)))
    for _ in range(ITERATIONS):
        model, slopes = family.at(point)
        each = np.exp(point)
        units = [slope / each[:, None, None] for slope in (slopes.process_noise_cov, slopes.measurement_noise_cov)]
        of_model = model.process_noise_cov, model.measurement_noise_cov
        q, r = (of - np.tensordot(each, unit, 1) for of, unit in zip(of_model, units, strict=True))
        if any(abs(rest).max() > UNEXPLAINED * abs(of).max() for rest, of in zip((q, r), of_model, strict=True)):
            if not task.options.get("hold_r"):
                raise ValueError(
                    f"method {name!r} needs Q and R linear in the numbers that are tuned, but they are not"
                )
        gain, measured = observed(task, linear, *of_model)
        design, wanted = equations(linear, gain, measured, Noise(units[0], units[1], (q, r)))
        scale = np.maximum(abs(design).max(axis=0), 1e-300)
        solution, _ = nnls(design / scale, wanted)
        values = np.maximum(solution / scale, np.exp(coordinates.low))
        point = coordinates.clip(coordinates.of(values))
        task.keep(family.choice_at(point))


def observed(task: Task, linear: Stationary, q: np.ndarray, r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The gain (n, m) of a Q and R, and its innovations' lagged covariances (lags, m, m) on all runs: one pass."""
    gain, first = steady_gain(linear, q, r), task.model(task.start).prior_mean
    lags = min(LAGS, *(max(2, int(runs.rows.min()) // 4) for runs in task.data))
    measured = autocovariances([_innovations(linear, gain, runs, first) for runs in task.data], lags)
    task.charge(task.passes)
    return gain, measured


def steady_gain(linear: Stationary, q: np.ndarray, r: np.ndarray) -> np.ndarray:
    """The gain L (n, m) of the stationary Kalman filter."""
    rule = "methods by lagged covariances need a model with a stationary filter"
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
    runs, measurements = data.seen, data.measurements
    times = measurements.shape[1]
    means, innovations = np.tile(prior_mean, (len(measurements), 1)), np.empty(measurements.shape)
    for k in range(times):
        innovations[:, k] = measurements[:, k] - means @ linear.c.T - linear.zero
        if k < times - 1:
            after = means + np.nan_to_num(innovations[:, k]) @ gain.T
            means = after @ linear.a.T + runs.inputs[:, k] @ linear.b.T + linear.offset
    return [run[min(DROPPED, rows // 5) : rows] for run, rows in zip(innovations, data.rows.tolist(), strict=True)]


def autocovariances(parts: list[list[np.ndarray]], lags: int) -> np.ndarray:
    """Means of e_{k+j} e_k' over all times at which both were measured, (lags, m, m)."""
    runs = [run for part in parts for run in part]
    means = []
    for j in range(lags):
        pairs = [(run[j:], run[: len(run) - j]) for run in runs if len(run) > j]
        ahead, behind = (np.concatenate(side) for side in zip(*pairs, strict=True))
        present = np.isfinite(ahead)[:, :, None] & np.isfinite(behind)[:, None, :]
        products = np.nan_to_num(ahead)[:, :, None] * np.nan_to_num(behind)[:, None, :]
        means.append(products.sum(axis=0) / np.maximum(present.sum(axis=0), 1))
    return np.array(means)


@method(
    "als",
    "least squares of lagged covariances of a fixed gain's innovations, full Q and R semidefinite",
    "without true states, for a linear model on long stationary runs: a few passes",
    "Odelson, Rajamani, Rawlings (2006)",
    (GRADIENT, LINEAR),
    ("hold_r", "full_q", "full_r"),
)
def als(task: Task) -> None:
    """Least squares of lagged covariances of innovations, with variances not below zero; three times over.

        e_k = z_k - C x^_k,   x^' = A (x^ + L e),   C_j = E[e_{k+j} e_k'],   Ab = A - A L C
        b = (C x O)(I - Ab x Ab)^-1 [vec Q + (A L x A L) vec R] + (I x Gam) vec R,   b = vec(C_0; C_1; ...)
        O = (C; C Ab; ...),   Gam = (I; -C A L; -C Ab A L; ...),   x the product of Kronecker

    Q and R have to be linear in the numbers that are tuned, or are full matrices that stay positive semidefinite.
    The first gain is that of the start. It needs one pass of a filter an iteration. With more unknowns in Q than
    n m the answer is not unique.

    Source: Odelson, Rajamani, Rawlings (2006), "A new autocovariance least-squares method for estimating noise
    covariances", Automatica 42(2); Rajamani, Rawlings (2009), Automatica 45(1).
    """

    def equations(linear: Stationary, gain: np.ndarray, measured: np.ndarray, noise: Noise):
        lags = len(measured)
        design = [lagged(linear, gain, q, r, lags).ravel() for q, r in zip(noise.q, noise.r, strict=True)]
        return np.column_stack(design), (measured - lagged(linear, gain, *noise.rest, lags)).ravel()

    wanted = [bool(task.options.get(option)) for option in ("full_q", "full_r")]
    if any(wanted) and set(NOISE_OPTIONS) <= set(task.start.model):
        _matrices(task, *wanted)
    else:
        by_lags(task, "als", equations)


def _matrices(task: Task, full_q: bool, full_r: bool) -> None:
    """The same of Q, R or both in full; of what is not full the diagonal is found."""
    model, holds_r = task.model(task.start), bool(task.options.get("hold_r"))
    linear = stationary(model, task.problems[0].name, "als")
    first = q, r = model.process_noise_cov, model.measurement_noise_cov
    free = _free(q, full_q), _free(r, full_r) & (not holds_r)
    for _ in range(ITERATIONS):
        gain, measured = observed(task, linear, q, r)
        q, r = semidefinite(linear, gain, measured, first, free)
        task.keep(with_covariances(task.start, q, None if holds_r else r))


def semidefinite(
    linear: Stationary,
    gain: np.ndarray,
    measured: np.ndarray,
    first: tuple[np.ndarray, np.ndarray],
    free: tuple[np.ndarray, np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:
    """Q = S S' and R = T T' with the least squares of lagged covariances, over their triangular roots S and T.

        d b / d S_ik = 2 sum_j B_ij S_jk,   B_ij the lagged covariances of Q = (e_i e_j' + e_j e_i') / 2

    The squares are convex in Q and R, and roots with as many columns as rows have no minimum but theirs.

    Args:
        linear: the model.
        gain: L (n, m).
        measured: lagged covariances of its innovations, (lags, m, m).
        first: Q (n, n) and R (m, m), at whose diagonals the search begins; what has no free entry stays.
        free: which entries of their roots are free, (n, n) and (m, m) bool.

    Source: Burer, Monteiro (2005), "Local minima and convergence in low-rank semidefinite programming",
    Mathematical Programming 103(3).
    """
    from scipy.optimize import least_squares

    pairs = list(zip(first, free, strict=True))
    roots = [np.sqrt(np.diag(np.diag(cov))) if mask.any() else np.linalg.cholesky(cov) for cov, mask in pairs]
    parts = [root[mask] for root, mask in zip(roots, free, strict=True)]
    by = [_responses(linear, gain, len(measured), side, len(cov)) for side, cov in enumerate(first)]
    wanted, end = measured.ravel(), len(parts[0])

    def filled(point: np.ndarray) -> list[np.ndarray]:
        for root, mask, entries in zip(roots, free, (point[:end], point[end:]), strict=True):
            root[mask] = entries
        return roots

    def left(point: np.ndarray) -> np.ndarray:
        expected = [
            np.tensordot(response, root @ root.T) for response, root in zip(by, filled(point), strict=True)
        ]
        return expected[0] + expected[1] - wanted

    def slopes(point: np.ndarray) -> np.ndarray:
        pairs = zip(by, filled(point), free, strict=True)
        return np.concatenate([2.0 * (response @ root)[:, mask] for response, root, mask in pairs], axis=1)

    ends = {"ftol": PRECISE, "xtol": PRECISE, "gtol": None, "max_nfev": MOST}
    solution = least_squares(left, np.concatenate(parts), slopes, x_scale="jac", **ends)
    floors = (LEAST * np.diag(np.diag(cov)) for cov in first)
    q, r = (root @ root.T + floor for root, floor in zip(filled(solution.x), floors, strict=True))
    return q, r


def _free(cov: np.ndarray, full: bool) -> np.ndarray:
    """Which entries of a root are free, (n, n) bool: none of a state without noise."""
    noisy = np.diag(cov) > 0.0
    return np.tril(np.outer(noisy, noisy)) if full else np.diag(noisy)


def _responses(linear: Stationary, gain: np.ndarray, lags: int, side: int, size: int) -> np.ndarray:
    """Lagged covariances by each entry of Q, side 0, or of R, (lags m m, size, size), symmetric in the entries."""
    n, m = gain.shape
    responses = np.empty((lags * m * m, size, size))
    for i in range(size):
        for j in range(i + 1):
            noise = np.zeros((n, n)), np.zeros((m, m))
            noise[side][i, j] += 0.5
            noise[side][j, i] += 0.5
            responses[:, i, j] = responses[:, j, i] = lagged(linear, gain, *noise, lags).ravel()
    return responses


@method(
    "mehra",
    "P H', R and Q in turn from lagged covariances of the innovations of a fixed gain",
    "to compare: the ancestor of `als`, which scatters less",
    "Mehra (1970)",
    (GRADIENT, LINEAR),
    ("hold_r",),
)
def mehra(task: Task) -> None:
    """The equations of `mehra_equations`, for numbers that are not below zero; three times over.

    Q and R have to be linear in the numbers that are tuned, and A has to have an inverse.

    Source: Mehra (1970), "On the identification of variances and adaptive Kalman filtering", IEEE Transactions on
    Automatic Control 15(2), equations (20) to (29).
    """
    by_lags(task, "mehra", mehra_equations)


def mehra_equations(
    linear: Stationary, gain: np.ndarray, measured: np.ndarray, noise: Noise
) -> tuple[np.ndarray, np.ndarray]:
    """The matrix (rows, p) and the right side of equations in the numbers of Q and R.

        P C' = L C_0 + pinv(C A; C Ab A; ...) (C_1; C_2; ...; C_n),   Ab = A - A L C,   R = C_0 - C P C'
        sum_{j<k} C A^j Q A^(j-k)' C' = C P A^-k' C' - C A^k P C' - sum_{j<k} C A^j W A^(j-k)' C',   k = 1 ... n
        W = A (L C_0 L' - L C P - P C' L') A'

    P is the covariance of the predictions of the gain L.

    Args:
        linear: the model.
        gain: L (n, m).
        measured: lagged covariances of its innovations, (lags, m, m).
        noise: Q and R by the numbers.

    Raises:
        ValueError: if A has no inverse, or there are fewer lags than states.
    """
    a, c, n = linear.a, linear.c, len(linear.a)
    if len(measured) <= n or np.linalg.matrix_rank(a) < n:
        raise ValueError(f"method 'mehra' needs an A with an inverse and {n} lags, but one of them is missing")
    closed, power, rows = a - a @ gain @ c, np.eye(n), []
    for _ in range(n):
        rows.append(c @ power @ a)
        power = closed @ power
    crossed = gain @ measured[0] + np.linalg.pinv(np.concatenate(rows)) @ np.concatenate(
        measured[1 : n + 1]
    )  # P C'
    middle = gain @ measured[0] @ gain.T - gain @ crossed.T - crossed @ gain.T
    known = noise.rest[0] + a @ middle @ a.T
    forward = [np.linalg.matrix_power(a, k) for k in range(n + 1)]
    back = [np.linalg.solve(power, np.eye(n)) for power in forward]

    def lagged_sums(q: np.ndarray) -> np.ndarray:
        sums = [sum(c @ forward[j] @ q @ back[k - j].T @ c.T for j in range(k)) for k in range(1, n + 1)]
        return np.ravel(sums)

    ends = [crossed.T @ back[k].T @ c.T - c @ forward[k] @ crossed for k in range(1, n + 1)]
    of_r = np.column_stack([unit.ravel() for unit in noise.r])
    of_q = np.column_stack([lagged_sums(unit) for unit in noise.q])
    r = measured[0] - c @ crossed - noise.rest[1]
    return np.concatenate([of_r, of_q]), np.concatenate([r.ravel(), np.ravel(ends) - lagged_sums(known)])


@method(
    "desroziers",
    "R and one factor on Q from innovations before and after updates, repeated",
    "for ensembles, without true states: some thirty passes",
    "Desroziers, Berre, Chapnik, Poli (2005)",
    (COVARIANCE, NOISE),
    DIAGONAL,
)
def desroziers(task: Task) -> None:
    """Repeat until neither R nor a factor on Q changes.

        R_jj <- mean of (R S^-1 d d')_jj,   Q <- Q (mean of d'd - tr R) / mean of tr(H P H')

    d is the innovation and R S^-1 d = z - H x_a what an update leaves of it: E[d_a d'] = R if both covariances are
    right. An iteration is one pass of the filter, of an ensemble as of a Kalman filter; where a filter has an
    inflation, it stays. Only what acts on the measurements is told: the proportions within Q stay, too.

    Source: Desroziers, Berre, Chapnik, Poli (2005), "Diagnosis of observation, background and analysis-error
    statistics in observation space", Quarterly J. Royal Meteorological Society 131(613).
    """
    choice = task.start
    for _ in range(DESROZIERS_ITERATIONS):
        moments = _moments(task, choice)
        task.charge(task.passes)
        if moments is None:
            return
        left, squares, spread = moments
        model = task.model(choice)
        r, q = model.measurement_noise_cov, model.process_noise_cov
        before = np.diag(r)
        after = before if task.options.get("hold_r") else np.clip(left, before / MOST_CHANGE, before * MOST_CHANGE)
        grown = np.sqrt(after / before)
        factor = float(np.clip((squares - after.sum()) / spread, 1.0 / MOST_CHANGE, MOST_CHANGE))
        choice = with_covariances(choice, factor * q, r * np.outer(grown, grown))
        task.keep(choice)
        if max(abs(np.log(factor)), abs(np.log(after / before)).max()) < CLOSE:
            return


def _moments(task: Task, choice: Choice) -> tuple[np.ndarray, float, float] | None:
    """Means over scored steps of (R S^-1 d d')_jj, (m,), d'd and tr(H P H'); None unless these are finite."""
    left: list[np.ndarray] = []
    totals: Sequence[list[np.ndarray]] = ([], [])
    for i, (problem, data) in enumerate(zip(task.problems, task.data, strict=True)):
        r = task.model(choice, i).measurement_noise_cov
        for part, estimates in estimates_in_parts(choice.filter(problem), data):
            counted = part.scored & (~np.isnan(part.seen.measurements)).all(axis=-1)
            d, s = estimates.innovations[counted], estimates.innovation_covs[counted]
            whitened = np.linalg.solve(s, d[..., None])[..., 0]
            left.append((whitened @ r) * d)
            totals[0].append((d**2).sum(axis=-1))
            totals[1].append(np.trace(s - r, axis1=1, axis2=2))
    means = np.concatenate(left).mean(axis=0), *(float(np.concatenate(values).mean()) for values in totals)
    return means if all(np.isfinite(mean).all() for mean in means) and means[2] > 0 else None


@method(
    "anderson",
    "the inflation of an ensemble that its innovations imply, step by step, then its mean",
    "for ensembles, without true states, if Q and R are known: one pass",
    "Anderson (2007)",
    (COVARIANCE, INFLATION),
    ("hold_r",),
)
def anderson(task: Task) -> None:
    """Follow the factor lambda on the members' variance from innovation to innovation; then take its mean root.

        d ~ N(0, lambda p + R_jj),   p = (S_jj - R_jj) / lambda before,   lambda ~ N(l, s^2)
        l <- the mode of lambda given d,   1/s^2 <- the curvature of the log density there

    for one channel after the other. The next step has it. Q and R stay; a spread that is too small because Q is
    shows here, too. It needs one pass of the filter, step by step.

    Source: Anderson (2007), "An adaptive covariance inflation error correction algorithm for ensemble filters",
    Tellus A 59, with a lambda for all states alike; Anderson (2009), Tellus A 61.
    """
    parameter, levels_of_runs, start = (
        FILTER_PARAMETERS[INFLATION],
        [],
        1.0 + 1e-9,
    )  # so that there is one to change
    choice = task.start._replace(numbers={**task.start.numbers, INFLATION: start})
    for i, (problem, data) in enumerate(zip(task.problems, task.data, strict=True)):
        filter_, variances = choice.filter(problem), np.diag(task.model(choice, i).measurement_noise_cov)
        for run in range(len(data.seeds)):
            session, level, spread = Session(filter_), 1.0, DEVIATION
            inputs, z = data.seen.inputs[run], data.seen.measurements[run]
            session.start(data.filter_keys[run], z[0])
            levels = []
            for k in range(1, int(data.rows[run])):
                session.set_parameter(INFLATION, level**0.5)
                session.step(inputs[k - 1], z[k])
                plain = (np.diag(session.innovation_cov) - variances) / level
                for d, p, r in zip(session.innovation, plain, variances, strict=True):
                    if d == d and d != 0.0 and p > 0.0:
                        level, spread = updated(level, spread, d * d, p, r)
                levels.append(level)
            task.charge(1)
            levels_of_runs += levels[int(SETTLED * len(levels)) :]
    mean = float(np.clip(np.sqrt(levels_of_runs).mean(), parameter.low, parameter.high))
    task.keep(task.start._replace(numbers={**task.start.numbers, INFLATION: mean}))


def updated(level: float, spread: float, square: float, plain: float, noise: float) -> tuple[float, float]:
    """Mode and deviation of lambda after an innovation with this square, by Newton's method with safe steps.

    Args:
        level: mean of lambda before.
        spread: its standard deviation before.
        square: d^2.
        plain: variance p of what the members expect, without inflation.
        noise: variance of the measurement.
    """
    at, curvature = level, 1.0 / spread**2
    for _ in range(NEWTON):
        total = at * plain + noise
        slope = (level - at) / spread**2 + 0.5 * plain * (square - total) / total**2
        # The expected curvature: always positive, so that each step climbs.
        curvature = 1.0 / spread**2 + 0.5 * (plain / total) ** 2
        at = max(at + slope / curvature, 0.25 * at)
    return at, max(curvature**-0.5, LEAST_DEVIATION)


def converged(name: str, numbers: dict[str, float]) -> Callable[[Task], None]:
    """The method that runs an adaptive filter over each training run in turn, from the values of the last one.

    What a run finds is the mean over its second half of the filter's R, and of its Q where it learns that. In the
    end it is the mean over the second half of the runs.
    """

    def run(task: Task) -> None:
        model = task.model(task.start)
        q, r = model.process_noise_cov, model.measurement_noise_cov
        estimates: list[tuple[np.ndarray, np.ndarray]] = []
        for i, (_, data) in enumerate(zip(task.problems, task.data, strict=True)):
            for index in range(len(data.seeds)):
                try:
                    model = task.model(task.start, i).replace(process_noise_cov=q, measurement_noise_cov=r)
                    q, r = _means(make_filter(name, model, **numbers), data.one(index))
                except ValueError:  # a belief that is none
                    raise ValueError(
                        f"method {name!r} failed: its Q or R is no covariance after {len(estimates)} runs"
                    ) from None
                task.charge(1)
                estimates.append((q, r))
                half = estimates[len(estimates) // 2 :]
                means = (np.mean([estimate[side] for estimate in half], axis=0) for side in (0, 1))
                task.keep(with_covariances(task.start, *_diagonals(task, *means)))

    return run


def _means(filter_, data) -> tuple[np.ndarray, np.ndarray]:
    """Mean Q (n, n) and R (m, m) over the second half of a run."""
    belief, qs, rs = filter_.init(), [], []
    for k in range(data.measurements.shape[1]):
        if k:
            belief = filter_.predict(belief, data.inputs[0, k - 1])
        belief, _ = filter_.update(belief, data.measurements[0, k])
        if 2 * k >= data.measurements.shape[1]:
            rs.append(filter_.estimated_noise(belief))
            learns = hasattr(filter_, "estimated_process_noise")
            qs.append(filter_.estimated_process_noise(belief) if learns else filter_.model.process_noise_cov)
    return np.mean(qs, axis=0), np.mean(rs, axis=0)


def _diagonals(task: Task, q: np.ndarray, r: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Q and R without correlations, unless these are tuned."""
    q = q if task.options.get("full_q") or not task.start.model else np.diag(np.diag(q))
    if task.options.get("hold_r"):
        return q, None
    return q, r if task.options.get("full_r") else np.diag(np.diag(r))


method(
    "sage-husa",
    "Sage and Husa's adaptive filter over all runs, then its mean Q and R",
    "to compare: one pass, seldom near the optimum",
    "Sage, Husa (1969)",
    (GRADIENT, NOISE),
    MATRICES,
)(converged("sage-husa", {"forgetting_factor": FORGETTING, "process_forgetting_factor": FORGETTING}))
method(
    "vb",
    "the variational Bayesian filter over all runs, then its mean R; Q stays",
    "without true states, if Q is known and R is not: one pass",
    "Sarkka, Nummenmaa (2009)",
    (GRADIENT, NOISE),
    MATRICES,
)(converged("vb", {"forgetting_factor": FORGETTING}))
