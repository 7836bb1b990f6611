"""Q and R by expectation-maximisation without a smoother.

By Fisher's identity the slopes of the likelihood give the steps of expectation-maximisation.
"""

from __future__ import annotations

import numpy as np

from tuning.evaluation.baselines import with_covariances
from tuning.likelihood.objective import Objective
from tuning.methods.task import FEW, Task, way_out
from tuning.search.objectives import LIKELIHOOD
from tuning.search.parameters import MeasurementVariance, ProcessVariance

MOST = 20_000  # steps
CLOSE = 1e-9  # largest relative change of a variance in a step that ends the search
ENOUGH, PATIENCE = 1e-8, 100  # log L rises by less in so many steps where a variance goes to zero: an end, too
LEAST = 0.1  # factor of a step; only those of a nonlinear filter could be smaller, or negative


def em(task: Task) -> None:
    """Expectation-maximisation of the diagonals of Q and R, or of full matrices.

        q <- q (1 + (2/T_w) dlog L/dq q),   r <- r (1 + (2/T_v) dlog L/dr r)
        Q <- Q + (2/T_w) Q (dlog L/dQ) Q,   R <- R + (2/T_v) R (dlog L/dR) R

    with T_w the number of transitions and T_v that of measurements. These are the steps of the smoother's sums of
    squares: the slope of log L is the mean of that of the complete data's. The prior and all else stays.

    Source: Shumway, Stoffer (1982), "An approach to time series smoothing and forecasting using the EM algorithm",
    J. Time Series Analysis 3(4); Fisher's identity: Cappe, Moulines, Ryden (2005), "Inference in hidden Markov
    models", section 10.1.
    """
    goal = task.goal(LIKELIHOOD)
    if task.options.get("full_q") or task.options.get("full_r"):
        return _full(task, goal)
    point, counts = _start(task, goal)
    for _ in range(MOST):
        after, _ = _step(goal, point, counts)
        if abs(after - point).max() < CLOSE:
            return None
        point = after
    return None


def squarem(task: Task) -> None:
    """The same with two steps extrapolated to a long one, where that is likelier; of diagonals.

        r = EM(p) - p,  v = EM(EM(p)) - EM(p) - r,  a = -max(1, |r|/|v|),  p <- EM(p - 2 a r + a^2 v)

    Source: Varadhan, Roland (2008), "Simple and globally convergent methods for accelerating the convergence of
    any EM algorithm", Scandinavian J. Statistics 35(2).
    """
    goal = task.goal(LIKELIHOOD)
    point, counts = _start(task, goal)
    level, quiet = -np.inf, 0
    for _ in range(MOST):
        once, before = _step(goal, point, counts)
        twice, _ = _step(goal, once, counts)
        r, v = once - point, twice - once - (once - point)
        quiet = 0 if before > level + ENOUGH else quiet + 1
        level = level if quiet else before
        if abs(twice - once).max() < CLOSE or quiet == PATIENCE:
            return
        a = -max(1.0, float(np.sqrt((r @ r) / max(v @ v, 1e-300))))
        far = goal.coordinates.clip(point - 2.0 * a * r + a * a * v)
        after, value = _step(goal, far, counts)
        point = after if value >= before else twice


def _start(task: Task, goal: Objective) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates of the start, and of how many terms each variance is the mean, (p,)."""
    transitions, measured = counts_of(task)
    counts: list[float] = []
    for parameter in goal.coordinates.free:
        if isinstance(parameter.place, ProcessVariance):
            counts.append(transitions)
        elif isinstance(parameter.place, MeasurementVariance):
            counts.append(measured[parameter.place.index])
        else:
            raise ValueError(
                f"EM tunes only variances in Q and R, but {parameter.name} is tuned, too{way_out(parameter.name)}"
            )
    return goal.start, np.array(counts, dtype=np.float64)


def counts_of(task: Task) -> tuple[int, np.ndarray]:
    """Numbers of transitions, and of values measured in each channel, (m,), that a likelihood has."""
    transitions, measured = 0, np.zeros(task.data[0].measurements.shape[-1])
    for problem, data in zip(task.problems, task.data, strict=True):
        first = data.first_scored if problem.leads_in else 0
        transitions += int(np.maximum(data.rows - max(first, 1), 0).sum())
        measured = measured + (~np.isnan(data.seen.measurements[:, first:])).sum(axis=(0, 1))
    return transitions, measured


def _step(goal: Objective, point: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, float]:
    """Coordinates after a step, which are logarithms, and log L before it; a variance of no terms stays."""
    here = goal(point)
    factors = 1.0 + np.divide(2.0 * here.gradient, counts, out=np.zeros_like(counts), where=counts > 0)
    after = point + np.log(np.maximum(factors, LEAST))
    return goal.coordinates.clip(after), here.value


def _full(task: Task, goal: Objective) -> None:
    """Steps of matrices: of Q, R or both in full, else of their diagonals."""
    few = goal.of_few(FEW)
    price = task.price("slopes by Q and R", lambda: few.by_noise(task.start))
    transitions, _ = counts_of(task)
    measured = _times_measured(task)
    choice, best = task.start, -np.inf
    for _ in range(MOST):
        model = task.model(choice)
        value, by_q, by_r = goal.by_noise(choice)
        task.charge(price * task.passes)
        if value > best:
            best = value
            task.keep(choice)
        q, r = model.process_noise_cov, model.measurement_noise_cov
        after_q = _moved(q, by_q, transitions, bool(task.options.get("full_q")))
        after_r = r if task.options.get("hold_r") else _moved(r, by_r, measured, bool(task.options.get("full_r")))
        choice = with_covariances(choice, after_q, after_r)
        if max(_change(q, after_q), _change(r, after_r)) < CLOSE:
            return


def _moved(cov: np.ndarray, slope: np.ndarray, count: int, full: bool) -> np.ndarray:
    if not count:
        return cov
    step = 2.0 / count * (cov @ slope @ cov if full else np.diag(np.diag(cov) ** 2 * np.diag(slope)))
    after = cov + 0.5 * (step + step.T)
    floor = LEAST * np.diag(cov)
    return after if (np.diag(after) >= floor).all() else cov + 0.5 * (after - cov)


def _change(before: np.ndarray, after: np.ndarray) -> float:
    scale = np.sqrt(np.outer(np.diag(before), np.diag(before)))
    return float((abs(after - before) / np.where(scale > 0, scale, 1.0)).max())


def _times_measured(task: Task) -> int:
    count = 0
    for problem, data in zip(task.problems, task.data, strict=True):
        first = data.first_scored if problem.leads_in else 0
        count += int((~np.isnan(data.seen.measurements[:, first:])).any(axis=-1).sum())
    return count
