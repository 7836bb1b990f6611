"""Q, R and other numbers of a model from their posterior: its mode, or its mean over draws.

`maximum_a_posteriori` finds the mode; the mean is that of a random walk (`posterior`) or of the no-U-turn sampler
(`nuts`).
"""

from __future__ import annotations

import math
import warnings

import numpy as np

from thruster_env.model.state_space import StateSpaceModel
from tuning.likelihood.ascent import DIVERGED, Evaluation, lbfgs
from tuning.methods.task import Spent, Task
from tuning.problems.problem import Coordinates
from tuning.search.objectives import LIKELIHOOD

DRAWS, WARM_UP = 2000, 500
DEVIATION = math.log(10.0)  # of the prior, in coordinates: a factor of ten, or a tenth of a linear range
AIM_OF_ONE, AIM = 0.44, 0.234  # accepted part of the proposals, of one number and of many
WEAK = 2  # degrees of freedom beyond the size of a covariance, so that the prior's mean is the start
NUTS_WARM_UP, NUTS_DRAWS = 300, 500
EDGE = 1e-3  # part of a range that a start keeps from its ends
LEAST_SHARE = 1e-300  # below which s (1 - s) has no logarithm


def posterior(task: Task) -> None:
    """The mean over a Metropolis random walk of p(theta | z) in coordinates, with normal priors about the start.

        theta' = theta + s N(0, C),   accepted with min(1, p(z | theta') p(theta') / (p(z | theta) p(theta)))

    C is that of the draws so far, from 100 on, times 2.38^2/p; s follows the accepted part during the warm-up,
    which does not count. It needs no gradient, so it works for every filter with a likelihood.

    Sources: Haario, Saksman, Tamminen (2001), "An adaptive Metropolis algorithm", Bernoulli 7(2); Roberts,
    Rosenthal (2001), "Optimal scaling for various Metropolis-Hastings algorithms", Statistical Science 16(4).
    """
    coordinates = Coordinates(task.free)
    centre = coordinates.clip(coordinates.of(task.values_of(task.start, task.free)))
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

    def with_prior(point: np.ndarray) -> Evaluation:
        nonlocal best
        here = goal(point)
        value, gradient = here.value, here.gradient
        model, slopes = goal.parts[0].at(point)
        for name, option in matrices:
            prior, by = _log_prior(first, model, getattr(slopes, name), name, bool(task.options.get(option)))
            value, gradient = value + prior, gradient + by
        if value > best:
            best = value
            task.keep(goal.choice_at(point))
        return here._replace(value=value, gradient=gradient)

    task.keep(goal.choice_at(lbfgs(with_prior, goal.start, coordinates.low, coordinates.high).x))


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
    centre = goal.start
    p, draws, evaluated = len(centre), list[np.ndarray](), set[bytes]()

    def point_at(y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        s = 0.5 * (1.0 + np.tanh(0.5 * y))
        return low + (high - low) * s, s

    def density(y: np.ndarray) -> tuple[float, np.ndarray]:
        point, s = point_at(y)
        try:
            task.check()
            here, away = goal(point), (point - centre) / DEVIATION**2
            evaluated.add(y.tobytes())
        except Spent:  # an exception would end the process: the other draws are of something cheap, and not kept
            return -0.5 * float(y @ y), -y
        except ValueError:  # the filter diverges
            return -DIVERGED, np.zeros(p)
        value = here.value - 0.5 * (point - centre) @ away + np.log(np.maximum(s * (1.0 - s), LEAST_SHARE)).sum()
        by_point = here.gradient - away
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
