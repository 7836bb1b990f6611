"""Methods along gradients: maximum likelihood, a posteriori, expectation-maximisation, and least errors.

In order: L-BFGS-B along an objective's gradient from several starts, Fisher scoring and inverse Wishart priors;
expectation-maximisation without a smoother, as by Fisher's identity the slopes of the likelihood give its steps;
noise estimation, which needs no search, and OKF, which begins there: Adam on the Cholesky factors of Q and R by
batches of runs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from thruster_env.model.state_space import StateSpaceModel
from thruster_env.model.turns import readings
from tuning.evaluation.baselines import with_covariances
from tuning.evaluation.residuals import estimated_from
from tuning.likelihood.ascent import Evaluation, climb, lbfgs
from tuning.likelihood.gradient import objective_of, optimum, start_at, starts_of
from tuning.likelihood.objective import Objective
from tuning.methods.task import COVARIANCE, DIAGONAL, FEW, GRADIENT, MATRICES, NOISE, TRUTH, Task, method, way_out
from tuning.problems.data import Data
from tuning.search.parameters import MeasurementVariance, ProcessVariance
from tuning.search.plan import LIKELIHOOD, LOG_SCORE, MSE, SCORE
from tuning.search.space import Choice

ABBEEL = "Abbeel, Coates, Montemerlo, Ng, Thrun (2005)"
SCORING_STEPS = 100
PROMISED = 1e-8  # of the log-likelihood that a step of scoring is expected to gain, which ends it
WEAK = 2  # degrees of freedom beyond the size of a covariance, so that the prior's mean is the start

# Of expectation-maximisation.
EM_STEPS = 20_000
CLOSE = 1e-9  # largest relative change of a variance in a step that ends the search
ENOUGH, QUIET = 1e-8, 100  # log L rises by less in so many steps where a variance goes to zero: an end, too
LEAST = 0.1  # factor of a step; only those of a nonlinear filter could be smaller, or negative

# Of OKF.
RATE, HALVED_EVERY, CLIP = 1e-2, 150, 1.0  # of Adam: steps, and the largest norm of a gradient
BATCH, VALIDATION = 10, 0.15  # runs of a step, and the part of all runs that chooses among steps
LOOKED_EVERY, PATIENCE = 30, 8  # steps between validations, and those without gain that end it
OKF_STEPS = 600
RIDGE = 1e-6  # added to the variances of the first Q and R
MEAN, SQUARE, TINY = 0.9, 0.999, 1e-8  # of Adam's moments


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


method(
    LIKELIHOOD,
    "maximum likelihood of the innovations by L-BFGS with exact gradients",
    "without true states; and with few runs",
    "Gupta, Mehra (1974)",
    (GRADIENT,),
)(ascend(LIKELIHOOD))


@method(
    "scoring",
    "maximum likelihood of the innovations by Fisher scoring with the exact information",
    "to compare: from a good start it ends where `likelihood` ends, in fewer steps",
    "Gupta, Mehra (1974)",
    (GRADIENT,),
)
def scoring(task: Task) -> None:
    """Maximum likelihood by damped Fisher scoring, within the ranges (`tuning.likelihood.ascent.climb`).

    Source: Gupta, Mehra (1974), "Computational aspects of maximum likelihood estimation and reduction in
    sensitivity function calculations", IEEE Transactions on Automatic Control 19(6); damped: Marquardt (1963).
    """
    goal = task.goal(LIKELIHOOD, information=True)
    climb(goal, goal.start, iterations=SCORING_STEPS, enough=PROMISED)


method(
    LOG_SCORE,
    "the best log density of the true states by L-BFGS with exact gradients",
    "with true states, if both estimate and covariance count",
    ABBEEL,
    (TRUTH, GRADIENT),
)(ascend(LOG_SCORE))
method(
    MSE,
    "the least sum of mean square errors over scale squared by L-BFGS with exact gradients",
    "with true states, if the estimate alone counts",
    ABBEEL,
    (TRUTH, GRADIENT),
)(ascend(MSE))
method(
    SCORE,
    "the least score, mean RMSE over scale, by L-BFGS with exact gradients",
    "with true states, if the estimate alone counts, each state alike",
    "this package",
    (TRUTH, GRADIENT),
)(ascend(SCORE))


@method(
    "map",
    "the likelihood with inverse Wishart priors about the start, by L-BFGS",
    "without true states, if the start is plausible and the data are few",
    "Gelman, Carlin, Stern, Dunson, Vehtari, Rubin (2013)",
    (GRADIENT, NOISE),
)
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


@method(
    "em",
    "expectation-maximisation, by slopes of the likelihood in place of a smoother",
    "to compare: it ends where `likelihood` ends, later",
    "Shumway, Stoffer (1982)",
    (GRADIENT, NOISE),
    MATRICES,
)
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
    for _ in range(EM_STEPS):
        after, _ = _step(goal, point, counts)
        if abs(after - point).max() < CLOSE:
            return None
        point = after
    return None


@method(
    "squarem",
    "expectation-maximisation with extrapolated steps",
    "to compare: em in a tenth of its steps",
    "Varadhan, Roland (2008)",
    (GRADIENT, NOISE),
    DIAGONAL,
)
def squarem(task: Task) -> None:
    """The same with two steps extrapolated to a long one, where that is likelier; of diagonals.

        r = EM(p) - p,  v = EM(EM(p)) - EM(p) - r,  a = -max(1, |r|/|v|),  p <- EM(p - 2 a r + a^2 v)

    Source: Varadhan, Roland (2008), "Simple and globally convergent methods for accelerating the convergence of
    any EM algorithm", Scandinavian J. Statistics 35(2).
    """
    goal = task.goal(LIKELIHOOD)
    point, counts = _start(task, goal)
    level, quiet = -np.inf, 0
    for _ in range(EM_STEPS):
        once, before = _step(goal, point, counts)
        twice, _ = _step(goal, once, counts)
        r, v = once - point, twice - once - (once - point)
        quiet = 0 if before > level + ENOUGH else quiet + 1
        level = level if quiet else before
        if abs(twice - once).max() < CLOSE or quiet == QUIET:
            return
        a = -max(1.0, float(np.sqrt((r @ r) / max(v @ v, 1e-300))))
        far = goal.coordinates.clip(point - 2.0 * a * r + a * a * v)
        after, value = _step(goal, far, counts)
        point = after if value >= before else twice


def _start(task: Task, goal: Objective) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates of the start, and of how many terms each variance is the mean, (p,)."""
    transitions, measured, _ = counts_of(task)
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


def counts_of(task: Task) -> tuple[int, np.ndarray, int]:
    """Numbers of transitions, of measured values of each channel, (m,), and of times with a measurement."""
    transitions, measured, times = 0, np.zeros(task.problems[0].model().m), 0
    for problem, data in zip(task.problems, task.data, strict=True):
        first = data.first_scored if problem.leads_in else 0
        transitions += int(np.maximum(data.rows - max(first, 1), 0).sum())
        turns = problem.model().measured_turns
        known = ~np.isnan(readings(data.seen.measurements[:, first:], turns))
        measured, times = measured + known.sum(axis=(0, 1)), times + int(known.any(axis=-1).sum())
    return transitions, measured, times


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
    transitions, _, measured = counts_of(task)
    choice, best = task.start, -np.inf
    for _ in range(EM_STEPS):
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


@method(
    "noise-estimation",
    "sample covariances of the residuals of the model on true states and measurements",
    "with true states and a model that is right: nothing is better or faster",
    ABBEEL,
    (TRUTH, COVARIANCE, NOISE),
    MATRICES,
)
def noise_estimation(task: Task) -> None:
    """Q = cov(x' - f(x, u)), R = cov(z - h(x)), full matrices; of several problems their means by runs.

    It is the only method without a search, and the best one if the model is right.

    Source: Abbeel, Coates, Montemerlo, Ng, Thrun (2005), "Discriminative training of Kalman filters", Robotics:
    Science and Systems, where it is the likelihood of states and measurements together.
    """
    estimates = []
    for problem, data in zip(task.problems, task.data, strict=True):
        estimate = estimated_from(problem.model(**problem.untuned), data)
        if estimate.process_cov is None or estimate.measurement_cov is None:
            raise ValueError(f"method 'noise-estimation' needs residuals on {problem.name}, but {estimate.reason}")
        estimates.append((estimate.process_cov, estimate.measurement_cov))
    task.charge(task.passes)
    weights = [len(runs.seeds) for runs in task.data]
    q, r = (np.average(np.array(covs), axis=0, weights=weights) for covs in zip(*estimates, strict=True))
    task.keep(with_covariances(task.start, q, None if task.options.get("hold_r") else r))


@method(
    "okf",
    "Adam on Cholesky factors of full Q and R, by batches, on the mean square error",
    "to compare: `mse` with full Q and R ends lower, sooner",
    "Greenberg, Yannay, Mannor (2023), arXiv 2310.00675",
    (TRUTH, GRADIENT, NOISE),
    MATRICES,
)
def okf(task: Task) -> None:
    """Minimise the mean square error over L_Q and L_R, Q = L_Q L_Q', with exp(d) on the diagonals, by Adam.

    The start is noise estimation. A step is on a batch of ten runs; every 30 steps 15 % of the runs, which no
    step sees, say whether it has become better. The authors make one epoch of 700 runs or more; of fewer runs
    this makes as many epochs as it takes.

    Source: Greenberg, Yannay, Mannor (2023), "Optimization or architecture: how to hack Kalman filtering",
    NeurIPS; settings of their package. Kingma, Ba (2015), "Adam: a method for stochastic optimization", ICLR.
    """
    noise_estimation(task)
    order = [task.generator.permutation(len(runs.seeds)) for runs in task.data]
    held_out = [max(1, round(VALIDATION * len(indices))) if len(indices) > 1 else 0 for indices in order]
    validation = [
        data.select(indices[:count]) for data, indices, count in zip(task.data, order, held_out, strict=True)
    ]
    validation = [picked if picked.seeds else data for picked, data in zip(validation, task.data, strict=True)]
    learn = [indices[count:] for indices, count in zip(order, held_out, strict=True)]
    held_r = bool(task.options.get("hold_r"))
    few = task.goal(MSE, keeps=False).of_few(FEW)
    price = task.price("slopes of squares by Q and R", lambda: few.by_noise(task.best))
    least, waited = np.inf, 0
    for step, (choice, done) in enumerate(_adam(task, learn, held_r, price)):
        if step % LOOKED_EVERY == 0 or done:
            value = -_goal(task, choice, validation).by_noise(choice)[0]
            task.charge(price * sum(len(runs.seeds) for runs in validation))
            waited = waited + 1
            if value < least:
                least, waited = value, 0
                task.keep(choice)
            if waited > PATIENCE or done:
                return


def _adam(task: Task, learn: Sequence[np.ndarray], held_r: bool, price: float):
    """The choice before each step, and whether it is the last one."""
    model = task.model(task.best)
    factors = Factors(model.process_noise_cov, model.measurement_noise_cov)
    point = factors.first
    mean, square, queue = np.zeros_like(point), np.zeros_like(point), [np.zeros(0, dtype=int) for _ in learn]
    for step in range(OKF_STEPS + 1):
        q, r = factors.matrices(point)
        choice = with_covariances(task.best if step else task.start, q, None if held_r else r)
        yield choice, step == OKF_STEPS
        pairs = zip(queue, learn, strict=True)
        queue = [left if len(left) else task.generator.permutation(runs) for left, runs in pairs]
        batch = [data.select(indices[:BATCH]) for data, indices in zip(task.data, queue, strict=True)]
        queue = [indices[BATCH:] for indices in queue]
        goal = _goal(task, choice, batch)
        _, by_q, by_r = goal.by_noise(choice)
        task.charge(price * sum(len(runs.seeds) for runs in batch))
        slope = -factors.slopes(point, by_q, np.zeros_like(by_r) if held_r else by_r) / goal.steps
        norm = float(np.linalg.norm(slope))
        if not np.isfinite(norm):
            return
        slope *= min(1.0, CLIP / max(norm, 1e-300))
        mean, square = MEAN * mean + (1 - MEAN) * slope, SQUARE * square + (1 - SQUARE) * slope**2
        corrected = mean / (1 - MEAN ** (step + 1)), square / (1 - SQUARE ** (step + 1))
        rate = RATE * 0.5 ** (step // HALVED_EVERY)
        point = point - rate * corrected[0] / (np.sqrt(corrected[1]) + TINY)


class Factors:
    """Q and R as functions of the entries of their Cholesky factors, with logarithms on the diagonals."""

    def __init__(self, q: np.ndarray, r: np.ndarray):
        """Begin at some Q and R."""
        self._sizes = len(q), len(r)
        self.first = np.concatenate(
            [_entries(np.linalg.cholesky(cov + RIDGE * np.eye(len(cov)))) for cov in (q, r)]
        )

    def matrices(self, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Q and R."""
        q, r = (factor @ factor.T for factor in self._factors(point))
        return q, r

    def slopes(self, point: np.ndarray, by_q: np.ndarray, by_r: np.ndarray) -> np.ndarray:
        """Derivatives by the entries from those by the matrices: dJ = tr(G dQ), so dJ/dL = 2 G L."""
        parts = []
        for factor, by in zip(self._factors(point), (by_q, by_r), strict=True):
            by_factor = 2.0 * by @ factor
            np.fill_diagonal(by_factor, np.diag(by_factor) * np.diag(factor))
            parts.append(by_factor[np.tril_indices(len(factor))])
        return np.concatenate(parts)

    def _factors(self, point: np.ndarray) -> list[np.ndarray]:
        factors, first = [], 0
        for size in self._sizes:
            factor, count = np.zeros((size, size)), size * (size + 1) // 2
            factor[np.tril_indices(size)] = point[first : first + count]
            np.fill_diagonal(factor, np.exp(np.diag(factor)))
            factors.append(factor)
            first += count
        return factors


def _entries(factor: np.ndarray) -> np.ndarray:
    entries = factor.copy()
    np.fill_diagonal(entries, np.log(np.diag(factor)))
    return entries[np.tril_indices(len(factor))]


def _goal(task: Task, choice: Choice, data: Sequence[Data]) -> Objective:
    return objective_of(choice, task.problems, data, task.free, MSE)
