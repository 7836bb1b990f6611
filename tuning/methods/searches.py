"""Methods that search without a gradient, and the mean of the posterior, by random walk or no-U-turn sampler.

In order: draws from the posterior; the downhill simplex and coordinate steps; Optuna's samplers.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable

import numpy as np
import optuna
from optuna.distributions import BaseDistribution

from thruster_env.model.turns import differences_of
from tuning.evaluation.residuals import predicted
from tuning.likelihood.ascent import DIVERGED
from tuning.methods.task import (
    COVARIANCE,
    GAUSSIAN,
    GRADIENT,
    HANSEN,
    MODEL,
    NUTPIE,
    TPE,
    TRUTH,
    UNIFORM,
    Spent,
    Task,
    method,
)
from tuning.problems.data import estimates_in_parts
from tuning.problems.problem import Coordinates
from tuning.search.plan import LIKELIHOOD
from tuning.search.space import Choice
from tuning.search.storage import quiet_optuna
from tuning.search.trials import make_sampler

CHEN = "Chen, Heckman, Julier, Ahmed (2018), arXiv 1807.08855"

# Of draws from the posterior.
DRAWS, WARM_UP = 2000, 500
DEVIATION = math.log(10.0)  # of the prior, in coordinates: a factor of ten, or a tenth of a linear range
AIM_OF_ONE, AIM = 0.44, 0.234  # accepted part of the proposals, of one number and of many
NUTS_WARM_UP, NUTS_DRAWS = 300, 500
EDGE = 1e-3  # part of a range that a start keeps from its ends
LEAST_SHARE = 1e-300  # below which s (1 - s) has no logarithm

# Of the simplex and of coordinate steps.
HIDDEN_PART = 0.5  # of the times, at which `masked` hides all channels
FORWARD, BACKWARD = math.log(1.1), math.log(0.5)  # steps in coordinates
ITERATIONS = 20  # MATLAB's default of passes over all numbers
SIDE = math.log(10.0)  # of the first simplex, in coordinates
FEW = 4  # numbers, up to which the simplex has its first coefficients
CLOSE = 1e-3  # size of a simplex, in coordinates, and relative spread of its values, at which it ends

# Of samplers.
MOST_TRIALS = 10_000
SLOWER = 10  # steps from one measurement to the next at the second sample time: 0.1 s and 1 s in the source


@method(
    "posterior",
    "the mean of the posterior by a Metropolis random walk",
    "without true states and with few runs, if time does not count",
    "Haario, Saksman, Tamminen (2001)",
    (COVARIANCE, MODEL),
)
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


@method(
    "nuts",
    "the same mean by the no-U-turn sampler with exact gradients, of the package nutpie",
    "like `posterior`, from six parameters on",
    "Hoffman, Gelman (2014)",
    (GRADIENT, NUTPIE),
)
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


@method(
    "masked",
    "the downhill simplex on the error of measurements withheld from the filter",
    "without true states, if no likelihood can be trusted",
    "Barratt, Boyd (2020)",
    (COVARIANCE,),
)
def masked(task: Task) -> None:
    """Nelder and Mead's simplex on the error of predicted measurements, half of which the filter does not see.

        J = sum over channels of mean (z - h(x^))^2 / var(z - h(x^)) of the start,  at the times left out

    It determines Q against R and no common factor on both, as every error does.

    Source: Barratt, Boyd (2020), "Fitting a Kalman smoother to data", American Control Conference, where a
    smoother takes the place of the filter.
    """
    hidden = [task.generator.random(runs.measurements.shape[:2]) < HIDDEN_PART for runs in task.data]
    scales: list[np.ndarray] = []

    def error(choice: Choice) -> float:
        squares = np.mean([_squares(task, choice, i, mask) for i, mask in enumerate(hidden)], axis=0)
        task.charge(task.passes)
        if not scales:
            scales.append(np.where(squares > 0, squares, 1.0))
        value = float((squares / scales[0]).sum())
        return value if math.isfinite(value) else math.inf

    with task.uncounted():
        _squares(task, task.start, 0, hidden[0])
    nelder_mead(task, error)


def _squares(task: Task, choice: Choice, index: int, hidden: np.ndarray) -> np.ndarray:
    """Mean squares (m,) of predicted measurements at scored times that are hidden."""
    problem, data = task.problems[index], task.data[index]
    filter_, model = choice.filter(problem), task.model(choice, index)
    blind = data._replace(measurements=np.where(hidden[..., None], np.nan, data.measurements))
    totals, counts, first = 0.0, 0, 0
    for part, estimates in estimates_in_parts(filter_, blind):
        last = first + len(part.seeds)
        _, expected = predicted(model, estimates.means, part.seen.inputs)
        z = part.late_scored(data.measurements[first:last])
        left = differences_of(model, z, expected[:, data.late])
        left = np.where(hidden[first:last, data.late, None], left, np.nan)
        totals = totals + np.nansum(left**2, axis=(0, 1))
        counts = counts + (~np.isnan(left)).sum(axis=(0, 1))
        first = last
    return totals / np.maximum(counts, 1)


class Descent:
    """An objective over the coordinates of what is searched, whose least value is kept."""

    def __init__(self, task: Task, evaluate: Callable[[Choice], float]):
        """Begin at the task's start."""
        self.task, self.coordinates, self._evaluate = task, Coordinates(task.searched), evaluate
        start = self.coordinates.of(task.values_of(task.start, task.searched))
        self.first = self.coordinates.clip(start)
        self.least = math.inf

    def __call__(self, point: np.ndarray) -> float:
        """The value at coordinates, which are put within the box."""
        point = self.coordinates.clip(point)
        choice = self.task.with_values(self.coordinates.values(point), self.task.searched)
        value = self._evaluate(choice)
        if value < self.least:
            self.least = value
            self.task.keep(choice)
        return value


@method(
    "nelder-mead",
    "the downhill simplex on the objective",
    "for any filter, with up to six parameters",
    "Powell (2002)",
)
def nelder_mead(task: Task, evaluate: Callable[[Choice], float] | None = None) -> None:
    """The downhill simplex in coordinates, begun once more at its end; of many numbers with adapted coefficients.

    Sources: Nelder, Mead (1965), "A simplex method for function minimization", Computer J. 7(4); Gao, Han (2012),
    "Implementing the Nelder-Mead simplex algorithm with adaptive parameters", Comput. Optim. Appl. 51; for a
    filter T. D. Powell (2002), "Automated tuning of an extended Kalman filter using the downhill simplex
    algorithm", J. Guidance, Control, Dynamics 25(5).
    """
    from scipy.optimize import minimize

    descent = Descent(task, evaluate or task.value)
    point, p = descent.first, len(descent.first)
    for _ in range(2):
        corners = np.vstack([point, point + SIDE * np.eye(p)])
        over = corners > descent.coordinates.high
        corners = np.where(over, 2.0 * point - corners, corners)
        options = {"initial_simplex": corners, "adaptive": p > FEW, "xatol": CLOSE, "fatol": CLOSE * CLOSE}
        options |= {"maxiter": 200 * p, "maxfev": 400 * p}
        point = np.clip(
            minimize(descent, point, method="Nelder-Mead", options=options).x,
            descent.coordinates.low,
            descent.coordinates.high,
        )


@method(
    "coordinate-steps",
    "one parameter at a time, a step up or half of it, on the objective",
    "to compare: what MATLAB's tune documents",
    "The MathWorks, `tune`",
)
def coordinate_steps(task: Task) -> None:
    """Each number in turn times 1.1, or else times 0.5, wherever the objective falls; twenty times over all.

    Of numbers on linear scales the steps are as long in coordinates. It ends where no step helps.

    Source: the documented defaults of `tune` and `tunerconfig` of MATLAB's Sensor Fusion and Tracking Toolbox
    (StepForward 1.1, StepBackward 0.5, MaxIterations 20); their order is our reading of them.
    """
    descent = Descent(task, task.value)
    point = descent.first
    least = descent(point)
    for _ in range(ITERATIONS):
        before = least
        for i in range(len(point)):
            for step in (FORWARD, BACKWARD):
                other = descent.coordinates.clip(point + step * np.eye(len(point))[i])
                value = descent(other)
                if value < least:
                    point, least = other, value
                    break
        if least == before:
            return


def sample(sampler: str, objective: str | None = None, slower: int | None = None) -> Callable[[Task], None]:
    """The method that minimises an objective, by default the task's, over trials of a sampler, from the start on.

    Every trial has the same runs, so that the differences between trials are not those of noise. With a second
    sample time, slower by so many steps, each trial is measured at both, and the larger value counts.
    """

    def run(task: Task) -> None:
        rates = [task.data] if slower is None else [task.data, [runs.every(slower) for runs in task.data]]
        space: dict[str, BaseDistribution] = {
            parameter.name: parameter.distribution for parameter in task.searched
        }
        with task.uncounted(), quiet_optuna():  # packages are loaded
            optuna_sampler = make_sampler(sampler, task.seed, 0, space)
            study = optuna.create_study(sampler=optuna_sampler)
        start = dict(zip(space, task.values_of(task.start, task.searched), strict=True))
        study.enqueue_trial(
            {
                parameter.name: min(max(start[parameter.name], parameter.low), parameter.high)
                for parameter in task.searched
            }
        )
        least = math.inf
        for _ in range(MOST_TRIALS):
            with quiet_optuna():
                trial = study.ask(space)
            choice = task.with_values([trial.params[name] for name in space], task.searched)
            value = max(task.value(choice, objective, data) for data in rates)
            study.tell(trial, value)
            if value < least:
                least = value
                task.keep(choice)

    return run


method(
    "tpe-only",
    "Optuna's tree-structured Parzen estimator on the objective, without baselines, band and validation",
    "to compare with the study `tpe`",
    TPE,
    by_trials=True,
)(sample("tpe"))
method(
    "gp-only",
    "Optuna's Gaussian process on the objective, alone",
    "to compare with the study `gp`",
    GAUSSIAN,
    by_trials=True,
)(sample("gp"))
method(
    "cma-es-only",
    "covariance matrix adaptation on the objective, alone",
    "to compare with the study `cma-es`",
    HANSEN,
    by_trials=True,
)(sample("cma-es"))
method(
    "random-only", "independent draws alone", "to compare: every search has to beat it", UNIFORM, by_trials=True
)(sample("random"))
method(
    "nis",
    "trials that minimise abs(log(mean NIS / m)), by the sampler tpe",
    "to compare: it is zero on a curve, whatever the error",
    CHEN,
    (COVARIANCE,),
    by_trials=True,
)(sample("tpe", "nis"))
method(
    "c-nis",
    "the same of mean and variance of the NIS",
    "to compare",
    "Chen, Biggie, Ahmed, Julier, Heckman, arXiv 2306.07225",
    (COVARIANCE,),
    by_trials=True,
)(sample("tpe", "c-nis"))
method(
    "c-nis-two-rates",
    "the larger one of c-nis at the sample time and at one ten times as long",
    "to compare: two sample times separate Q and R, one leaves a curve of zeros",
    "Chen, Biggie, Ahmed, Julier, Heckman, arXiv 2306.07225",
    (COVARIANCE,),
    by_trials=True,
)(sample("tpe", "c-nis", SLOWER))
method(
    "nees",
    "trials that minimise abs(log(mean NEES / n)), by the sampler tpe",
    "to compare",
    CHEN,
    (TRUTH, COVARIANCE),
    by_trials=True,
)(sample("tpe", "nees"))
method(
    "c-nees",
    "the same of mean and variance of the NEES",
    "to compare",
    "Chen, Biggie, Ahmed, Julier, Heckman, arXiv 2306.07225",
    (TRUTH, COVARIANCE),
    by_trials=True,
)(sample("tpe", "c-nees"))
