"""Methods that search an objective, by gradients, simplex or samplers, and methods that run adaptive filters.

In order: L-BFGS-B along an objective's gradient from several starts; searches without a gradient; Optuna's
samplers; the mean Q and R of adaptive filters that ran until convergence; Anderson's adaptive inflation.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import optuna
from optuna.distributions import BaseDistribution

from filters import make_filter
from filters.engine.session import Session
from thruster_env.core.angles import difference
from tuning.evaluation.baselines import with_covariances
from tuning.evaluation.residuals import predicted
from tuning.likelihood.gradient import optimum, start_at, starts_of
from tuning.methods.task import Task
from tuning.problems.data import estimates_in_parts
from tuning.problems.problem import Coordinates
from tuning.search.parameters import FILTER_PARAMETERS
from tuning.search.space import Choice
from tuning.search.storage import quiet_optuna
from tuning.search.trials import make_sampler

HIDDEN_PART = 0.5  # of the times, at which `masked` hides all channels
INFLATION = "inflation"  # the parameter of a filter with an ensemble

# Of the simplex and of coordinate steps.
FORWARD, BACKWARD = math.log(1.1), math.log(0.5)  # steps in coordinates
ITERATIONS, LIMIT = 20, 0.1  # MATLAB's defaults: passes over all numbers, and the RMS error that is small enough
SIDE = math.log(10.0)  # of the first simplex, in coordinates
FEW = 4  # numbers, up to which the simplex has its first coefficients
CLOSE = 1e-3  # size of a simplex, in coordinates, and relative spread of its values, at which it ends

# Of samplers and of adaptive filters.
MOST_TRIALS = 10_000
SLOWER = 10  # steps from one measurement to the next at the second sample time: 0.1 s and 1 s in the source
FORGETTING = 0.995  # of Q and R a step

# Of Anderson's adaptive inflation.
DEVIATION = 0.1  # s at the beginning: how well lambda is known
LEAST_DEVIATION = 0.02  # below which s does not fall, so that lambda may go on to change
NEWTON = 8  # steps to the mode
SETTLED = 0.25  # part of a run whose lambdas do not count


def ascend(objective: str) -> Callable[[Task], None]:
    """The method that follows the gradient of an objective from the task's start, then from those of `starts_of`.

    It is what `tune_by_gradient` does, which adds standard errors.
    """

    def run(task: Task) -> None:
        goal = task.goal(objective)
        coordinates = goal.coordinates
        best = optimum(goal, goal.start)
        task.keep(goal.choice_at(coordinates.of(best.parameters)))
        for factors in starts_of(coordinates.free)[1:]:
            other = optimum(goal, coordinates.clip(start_at(goal, factors)))
            if other.value > best.value:
                best = other
            task.keep(goal.choice_at(coordinates.of(best.parameters)))

    return run


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
        left = difference(z, expected[:, data.late], model.any_shape.measurement_angles)
        left = np.where(hidden[first:last, data.late, None], left, np.nan)
        totals = totals + np.nansum(left**2, axis=(0, 1))
        counts = counts + (~np.isnan(left)).sum(axis=(0, 1))
        first = last
    return totals / np.maximum(counts, 1)


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


sage_husa = converged("sage-husa", {"forgetting_factor": FORGETTING, "process_forgetting_factor": FORGETTING})
vb = converged("vb", {"forgetting_factor": FORGETTING})


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
