"""Q and R by maximum likelihood: the innovations say how large the noise is, and a gradient finds it."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from filters.likelihood import likelihood
from filters.registry import make_filter
from numerics.checks import one_of
from tuning.likelihood.identifiability import KNOWN_WITHIN, TWO_SIDED
from tuning.problems.data import Data
from tuning.problems.problem import Problem
from tuning.search.space import Choice, distributions, untuned_choice

DIFFERENTIABLE = ("kf", "ekf")
BAD_START = (1.0, 1e-2, 1e2)  # factors on the untuned Q11, Q22 and R
STARTS = ((1.0, 1.0, 1.0), BAD_START, (0.1, 0.1, 10.0))
STEP = 1e-3  # in the logarithms, of the differences of gradients that give the Hessian
FLAT = 1e-12  # curvature over the largest one, below which there is none
DIVERGED = 1e12  # stands in for -log L where the filter diverges
EQUAL_LOGARITHMS = 0.02  # optima this close in every logarithm are one


class Optimum(NamedTuple):
    """Where one start led."""

    start: tuple[float, ...]  # factors on the untuned variances
    variances: np.ndarray  # (n + m,), the diagonals of Q, then of R
    log_likelihood: float  # of all training runs
    evaluations: int  # of log-likelihood and gradient
    converged: bool


class GradientResult(NamedTuple):
    """A maximum of the likelihood, and how well the data determine it."""

    choice: Choice
    names: tuple[str, ...]  # of the variances
    best: Optimum
    optima: tuple[Optimum, ...]  # one for each start
    standard_errors: np.ndarray  # (n + m,), of the variances' logarithms, from the scatter between runs
    identified: np.ndarray  # (n + m,) whether a variance's 95 % interval is within a factor of ten
    agree: bool  # whether all starts led to the same place, in the identified variances
    seconds: float


def maximise_likelihood(
    filter_name: str, scenario: Problem, data: Data, starts: Sequence[Sequence[float]] = STARTS
) -> GradientResult:
    """Find the diagonal Q and R under which a Kalman filter's innovations are most likely.

    Works on the logarithms of the variances, by L-BFGS-B with the gradient of `filters.likelihood`, within the
    same ranges as an Optuna study. With the Hessian H of -log L and the gradients g_b of B independent runs, the
    errors are the roots of the diagonal of H^-1 (sum_b g_b g_b') H^-1, which holds for a wrong model, too.

    Args:
        filter_name: "kf" or "ekf".
        scenario: says what the filter assumes of the plant and what the untuned variances are.
        data: the runs to learn from.
        starts: factors on the untuned variances, (Q11, Q22, R).

    Raises:
        ValueError: for another filter.

    Source: Huber (1967), "The behavior of maximum likelihood estimates under nonstandard conditions".
    """
    from scipy.optimize import minimize

    one_of("filter", filter_name, DIFFERENTIABLE)
    begin = time.perf_counter()
    untuned = untuned_choice(filter_name, scenario)
    model = make_filter(filter_name, scenario.model(**untuned.model)).kernel_model
    n, m = model.n, model.m
    reference = np.append(np.diag(model.process_noise_cov), np.diag(model.measurement_noise_cov))

    def slopes(logarithms: np.ndarray) -> tuple[float, np.ndarray]:
        """Log-likelihood of each run (B,), and its gradients (B, n + m) in the logarithms."""
        variances = np.exp(logarithms)
        q, r = np.diag(variances[:n]), np.diag(variances[n:])
        q_slopes, r_slopes = np.zeros((n + m, n, n)), np.zeros((n + m, m, m))
        q_slopes[range(n), range(n), range(n)] = variances[:n]
        r_slopes[range(n, n + m), range(m), range(m)] = variances[n:]
        changed = model.replace(process_noise_cov=q, measurement_noise_cov=r)
        return likelihood(changed, data.inputs, data.measurements, q_slopes, r_slopes)

    def negative(logarithms: np.ndarray) -> tuple[float, np.ndarray]:
        found = slopes(logarithms)
        value, gradient = -found.values.sum(), -found.gradients.sum(axis=0)
        if np.isfinite(value) and np.isfinite(gradient).all():
            return value, gradient
        return DIVERGED, np.zeros_like(gradient)  # the line search takes a shorter step

    space = distributions(filter_name, scenario)
    names = [f"Q{i}{i}" for i in range(1, n + 1)] + ["R"]
    bounds = [tuple(np.log([space[name].low, space[name].high])) for name in names]
    optima = []
    for start in starts:
        first = np.log(reference * np.asarray(start, dtype=np.float64))
        found = minimize(negative, first, jac=True, bounds=bounds, method="L-BFGS-B", options={"ftol": 1e-13})
        optima.append(Optimum(tuple(start), np.exp(found.x), -found.fun, found.nfev, bool(found.success)))
    best = max(optima, key=lambda optimum: optimum.log_likelihood)
    errors = _standard_errors(slopes, np.log(best.variances))
    inside = np.array(
        [low < value < high for value, (low, high) in zip(np.log(best.variances), bounds, strict=True)]
    )
    identified = inside & (errors * TWO_SIDED < KNOWN_WITHIN)
    apart = [np.abs(np.log(o.variances / best.variances))[identified] for o in optima]
    return GradientResult(
        choice=_choice(filter_name, best.variances, n, m),
        names=tuple(names),
        best=best,
        optima=tuple(optima),
        standard_errors=errors,
        identified=identified,
        agree=all((distances < EQUAL_LOGARITHMS).all() for distances in apart),
        seconds=time.perf_counter() - begin,
    )


def _standard_errors(slopes: Callable, logarithms: np.ndarray) -> np.ndarray:
    """Of the maximum's logarithms, (n + m,): those from the scatter between runs, or from the Hessian if larger.

    Along a direction in which the likelihood is flat both scatter and Hessian vanish, and the Hessian tells.
    """
    count = len(logarithms)
    hessian = np.empty((count, count))
    for i, step in enumerate(STEP * np.eye(count)):
        above, below = (slopes(logarithms + sign * step).gradients.sum(axis=0) for sign in (1, -1))
        hessian[i] = (below - above) / (2 * STEP)
    values, axes = np.linalg.eigh((hessian + hessian.T) / 2)
    values = np.maximum(values, FLAT * abs(values).max())
    scores = slopes(logarithms).gradients @ axes / values
    scores -= scores.mean(axis=0)
    scatter = axes @ (scores.T @ scores) @ axes.T * len(scores) / (len(scores) - 1)
    return np.sqrt(np.maximum(np.diag(scatter), np.diag(axes / values @ axes.T)))


def _choice(filter_name: str, variances: np.ndarray, n: int, m: int) -> Choice:
    numbers = [float(v) for v in variances]
    model = {
        "process_noise_cov": tuple(numbers[:n]),
        "measurement_noise_cov": numbers[n] if m == 1 else tuple(numbers[n:]),
    }
    return Choice(filter_name, model, {})
