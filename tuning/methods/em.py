"""Q and R by expectation-maximisation without a smoother, and from their posterior.

By Fisher's identity the slopes of the likelihood give the steps of expectation-maximisation. The posterior mean is
that of a random walk (`posterior`) or of the no-U-turn sampler (`nuts`); `maximum_a_posteriori` finds the mode.
"""

from __future__ import annotations

import math
import warnings

import numpy as np

from thruster_env.model.state_space import StateSpaceModel
from tuning.evaluation.baselines import with_covariances
from tuning.likelihood.gradient import DIVERGED, Goal, minimum_within
from tuning.methods.task import FEW, Spent, Task, way_out
from tuning.problems.problem import Coordinates
from tuning.search.objectives import LIKELIHOOD
from tuning.search.parameters import MeasurementVariance, ProcessVariance

MOST = 20_000  # steps
CLOSE = 1e-9  # largest relative change of a variance in a step that ends the search
ENOUGH, PATIENCE = 1e-8, 100  # log L rises by less in so many steps where a variance goes to zero: an end, too
LEAST = 0.1  # factor of a step; only those of a nonlinear filter could be smaller, or negative

# Of posteriors.
DRAWS, WARM_UP = 2000, 500
DEVIATION = math.log(10.0)  # of the prior, in coordinates: a factor of ten, or a tenth of a linear range
AIM_OF_ONE, AIM = 0.44, 0.234  # accepted part of the proposals, of one number and of many
WEAK = 2  # degrees of freedom beyond the size of a covariance, so that the prior's mean is the start
NUTS_WARM_UP, NUTS_DRAWS = 300, 500
EDGE = 1e-3  # part of a range that a start keeps from its ends
LEAST_SHARE = 1e-300  # below which s (1 - s) has no logarithm


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
        far = np.clip(point - 2.0 * a * r + a * a * v, goal.coordinates.low, goal.coordinates.high)
        after, value = _step(goal, far, counts)
        point = after if value >= before else twice


def _start(task: Task, goal: Goal) -> tuple[np.ndarray, np.ndarray]:
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
    first = np.clip(goal.coordinates.of(goal.untuned), goal.coordinates.low, goal.coordinates.high)
    return first, np.array(counts, dtype=np.float64)


def counts_of(task: Task) -> tuple[int, np.ndarray]:
    """Numbers of transitions, and of values measured in each channel, (m,), that a likelihood has."""
    transitions, measured = 0, np.zeros(task.data[0].measurements.shape[-1])
    for problem, data in zip(task.problems, task.data, strict=True):
        first = data.first_scored if problem.leads_in else 0
        transitions += int(np.maximum(data.rows - max(first, 1), 0).sum())
        measured = measured + (~np.isnan(data.seen.measurements[:, first:])).sum(axis=(0, 1))
    return transitions, measured


def _step(goal: Goal, point: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, float]:
    """Coordinates after a step, which are logarithms, and log L before it; a variance of no terms stays."""
    likelihood = goal(point)
    slopes = likelihood.gradients.sum(axis=0)
    factors = 1.0 + np.divide(2.0 * slopes, counts, out=np.zeros_like(slopes), where=counts > 0)
    after = point + np.log(np.maximum(factors, LEAST))
    return np.clip(after, goal.coordinates.low, goal.coordinates.high), float(likelihood.values.sum())


def _full(task: Task, goal: Goal) -> None:
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


def posterior(task: Task) -> None:
    """The mean over a Metropolis random walk of p(theta | z) in coordinates, with normal priors about the start.

        theta' = theta + s N(0, C),   accepted with min(1, p(z | theta') p(theta') / (p(z | theta) p(theta)))

    C is that of the draws so far, from 100 on, times 2.38^2/p; s follows the accepted part during the warm-up,
    which does not count. It needs no gradient, so it works for every filter with a likelihood.

    Sources: Haario, Saksman, Tamminen (2001), "An adaptive Metropolis algorithm", Bernoulli 7(2); Roberts,
    Rosenthal (2001), "Optimal scaling for various Metropolis-Hastings algorithms", Statistical Science 16(4).
    """
    coordinates = Coordinates(task.free)
    centre = np.clip(coordinates.of(task.values_of(task.start, task.free)), coordinates.low, coordinates.high)
    runs = task.passes / len(task.problems)  # the likelihood objective is the mean of a run and of problems
    p, generator = len(centre), task.generator

    def density(point: np.ndarray) -> float:
        if (point < coordinates.low).any() or (point > coordinates.high).any():
            return -math.inf
        choice = task.with_values(coordinates.values(point), task.free)
        return -len(task.problems) * runs * task.value(choice, LIKELIHOOD) - 0.5 * float(
            ((point - centre) ** 2).sum() / DEVIATION**2
        )

    point, here = centre, density(centre)
    spread, size, draws = 0.1 * np.eye(p), 1.0, []
    aim = AIM_OF_ONE if p == 1 else AIM
    for step in range(WARM_UP + DRAWS):
        root = np.linalg.cholesky(spread + 1e-12 * np.eye(p))
        other = point + size * root @ generator.standard_normal(p)
        proposed = density(other)
        chance = math.exp(min(proposed - here, 0.0))
        if generator.random() < chance:
            point, here = other, proposed
        draws.append(point)
        if step < WARM_UP:
            size *= math.exp((chance - aim) / math.sqrt(step + 1.0))
            if step >= 100 and step % 50 == 0:
                spread = 2.38**2 / p * np.atleast_2d(np.cov(np.array(draws[step // 2 :]), rowvar=False))
                size = 1.0
        if step % 100 == 99:
            counted = draws[WARM_UP:] if step >= WARM_UP else draws[len(draws) // 2 :]
            task.keep(task.with_values(coordinates.values(np.mean(counted, axis=0)), task.free))


# The likeliest Q and R with a prior: maximum a posteriori with inverse Wishart distributions.


def maximum_a_posteriori(task: Task) -> None:
    """L-BFGS-B on log L + log p(Q) + log p(R), from the task's start, which is the prior's mean.

        Q ~ IW(nu, Psi):  log p = -1/2 (nu + n + 1) log det Q - 1/2 tr(Psi Q^-1),   nu = n + 2,  Psi = Q_0

    of full matrices; else of each variance alone, with n = 1. It is the mode of the density of Q and R themselves.

    Source: Gelman, Carlin, Stern, Dunson, Vehtari, Rubin (2013), "Bayesian data analysis", 3rd ed., section 3.6.
    """
    goal = task.goal(LIKELIHOOD, keeps=False)
    coordinates, first = goal.coordinates, task.model(task.start)
    matrices = ("process_noise_cov", "full_q"), ("measurement_noise_cov", "full_r")
    best = -np.inf

    def negative(point: np.ndarray) -> tuple[float, np.ndarray]:
        nonlocal best
        likelihood = goal(point)
        value, gradient = likelihood.values.sum(), likelihood.gradients.sum(axis=0)
        model, slopes = goal.model_at(point)
        for name, option in matrices:
            prior, by = _log_prior(first, model, getattr(slopes, name), name, bool(task.options.get(option)))
            value, gradient = value + prior, gradient + by
        if value > best:
            best = value
            task.keep(goal.choice_at(point))
        return -value, -gradient

    start = np.clip(coordinates.of(goal.untuned), coordinates.low, coordinates.high)
    task.keep(goal.choice_at(minimum_within(coordinates, negative, start).x))


def _log_prior(
    first: StateSpaceModel, model: StateSpaceModel, slopes: np.ndarray, name: str, full: bool
) -> tuple[float, np.ndarray]:
    """The logarithm of a covariance's prior, but for a constant, and its slopes along p coordinates, (p,)."""
    centre, cov = getattr(first, name), getattr(model, name)
    if not full:
        variances, before = np.diag(cov), np.diag(centre)
        noisy = variances > 0  # a state without noise has no prior
        v, c, by = variances[noisy], before[noisy], np.diagonal(slopes, axis1=1, axis2=2)[:, noisy]
        power = (1 + WEAK) + 1 + 1
        return float(-0.5 * (power * np.log(v) + c / v).sum()), by @ (-0.5 * (power / v - c / v**2))
    power = (len(cov) + WEAK) + len(cov) + 1
    ratio = np.linalg.solve(cov, centre)
    value = -0.5 * power * np.linalg.slogdet(cov)[1] - 0.5 * np.trace(ratio)
    relative = np.linalg.solve(cov, slopes)
    gradient = -0.5 * power * np.trace(relative, axis1=1, axis2=2)
    return float(value), gradient + 0.5 * np.einsum("pij,ji->p", relative, ratio)


# The posterior of a model's numbers by the no-U-turn sampler, along the exact gradient of the likelihood.


def nuts(task: Task) -> None:
    """The mean of p(theta | z) in coordinates, with normal priors about the start, by Hamiltonian dynamics.

        theta = low + (high - low) s(y),   s(y) = 1 / (1 + exp(-y))
        log p(y | z) = log p(z | theta) - |theta - theta_0|^2 / (2 d^2) + sum log s(y) (1 - s(y)),   d = log 10

    It is the posterior of `posterior`, from fewer draws, each of which takes several gradients. Draws of the
    warm-up count until others are there. The sampler is nutpie's.

    Source: Hoffman, Gelman (2014), "The No-U-Turn Sampler", J. Machine Learning Research 15.
    """
    with task.uncounted(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the packages that it imports
        import nutpie
        from nutpie.compiled_pyfunc import from_pyfunc

    goal = task.goal(LIKELIHOOD, keeps=False)
    low, high = goal.coordinates.low, goal.coordinates.high
    centre = np.clip(goal.coordinates.of(goal.untuned), low, high)
    p, draws, evaluated = len(centre), list[np.ndarray](), set[bytes]()

    def point_at(y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        s = 0.5 * (1.0 + np.tanh(0.5 * y))
        return low + (high - low) * s, s

    def density(y: np.ndarray) -> tuple[float, np.ndarray]:
        point, s = point_at(y)
        try:
            task.check()
            likelihood, away = goal(point), (point - centre) / DEVIATION**2
            evaluated.add(y.tobytes())
        except Spent:  # an exception would end the process: the other draws are of something cheap, and not kept
            return -0.5 * float(y @ y), -y
        except ValueError:  # the filter diverges
            return -DIVERGED, np.zeros(p)
        value = (
            likelihood.values.sum()
            - 0.5 * (point - centre) @ away
            + np.log(np.maximum(s * (1.0 - s), LEAST_SHARE)).sum()
        )
        by_point = likelihood.gradients.sum(axis=0) - away
        slope = by_point * (high - low) * s * (1.0 - s) + 1.0 - 2.0 * s
        if not (np.isfinite(value) and np.isfinite(slope).all()):
            return -DIVERGED, np.zeros(p)
        return float(value), slope

    def keep(y: np.ndarray) -> dict[str, np.ndarray]:
        if y.tobytes() in evaluated:  # within the budget: it comes from another thread, which may be late
            draws.append(point_at(y)[0])
            counted = draws[NUTS_WARM_UP:] or draws[len(draws) // 2 :]
            task.keep(goal.choice_at(np.mean(counted, axis=0)), late=True)
        return {"y": y}

    inside = np.clip((centre - low) / (high - low), EDGE, 1.0 - EDGE)
    first = np.log(inside / (1.0 - inside))  # nutpie itself would begin within factors of a thousand about it
    form = [np.dtype(np.float64)], [(p,)], ["y"]
    model = from_pyfunc(p, lambda: density, lambda *_: keep, *form, make_initial_point_fn=lambda seed: first)
    settings = {"draws": NUTS_DRAWS, "tune": NUTS_WARM_UP, "chains": 1, "seed": task.seed, "progress_bar": False}
    nutpie.sample(model, return_raw_trace=True, **settings)
