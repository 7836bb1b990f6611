"""Fisher scoring: Newton's method with the expected information in place of the Hessian.

`Method`: a method of tuning, as a value.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from filters.registry import filter_type
from thruster_env.core.modules import to_install
from tuning.evaluation.baselines import with_covariances
from tuning.evaluation.residuals import estimated_from
from tuning.likelihood.family import check_gradient
from tuning.methods.correlations import stationary
from tuning.methods.task import Spent, Task, way_out
from tuning.search.objectives import LIKELIHOOD
from tuning.search.parameters import Q, R
from tuning.search.space import has_search_space

MOST_STEPS = 100
CLOSE = 1e-8  # of the log-likelihood that a step is expected to gain, which ends it
DAMPING, LEAST, MOST = 1e-3, 1e-9, 1e9  # parts of the diagonal that are added to the information


def scoring(task: Task) -> None:
    """Maximum likelihood by damped Fisher scoring, within the ranges.

        (I + d diag I) step = g,   I = E[g g'],   d a tenth after a step that gains, else ten times as large

    Numbers at an end of their range, which the gradient would drive beyond it, stay there.

    Source: Gupta, Mehra (1974), "Computational aspects of maximum likelihood estimation and reduction in
    sensitivity function calculations", IEEE Transactions on Automatic Control 19(6); damped: Marquardt (1963).
    """
    goal = task.goal(LIKELIHOOD)
    low, high = goal.coordinates.low, goal.coordinates.high
    point, damping = np.clip(goal.coordinates.of(goal.untuned), low, high), DAMPING
    few = goal.of_few(32)
    price = task.price("information", lambda: few.information(point))
    value, gradient = _of(goal(point))
    for _ in range(MOST_STEPS):
        information = goal.information(point)
        task.charge(price * task.passes)
        inside = ~(((point <= low) & (gradient < 0)) | ((point >= high) & (gradient > 0)))
        part, slope = information[np.ix_(inside, inside)], gradient[inside]
        while damping < MOST and inside.any():
            step = np.zeros_like(point)
            damped = part + damping * np.diag(np.maximum(np.diag(part), 1e-12))
            step[inside] = np.linalg.solve(damped, slope)
            trial = np.clip(point + step, low, high)
            if gradient @ (trial - point) < CLOSE:
                return
            after, slopes = _of(goal(trial))
            if np.isfinite(after) and after > value and np.isfinite(slopes).all():
                point, value, gradient, damping = trial, after, slopes, max(0.1 * damping, LEAST)
                break
            damping *= 10.0
        else:
            return


def _of(likelihood) -> tuple[float, np.ndarray]:
    return float(likelihood.values.sum()), likelihood.gradients.sum(axis=0)


# Noise estimation from true states: the only method without a search, and the best one for a model that is right.


def noise_estimation(task: Task) -> None:
    """Q = cov(x' - f(x, u)), R = cov(z - h(x)), full matrices; of several problems their means by runs.

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


TRUTH = "truth"  # true states
GRADIENT = "gradient"  # a Kalman filter with derivatives
COVARIANCE = "covariance"  # a filter with a covariance
LINEAR = "linear"  # a linear model with a stationary filter
INFLATION = "inflation"  # an ensemble
NUTPIE = "nutpie"  # the package
NOISE = "noise"  # that Q and R are tuned, and not a model's own parameters
MODEL = "model"  # that some number of the model is tuned


class Method(NamedTuple):
    """A method that finds a filter's numbers."""

    about: str  # what it does, in one sentence
    when: str  # when to use it
    function: Callable[[Task], None]  # keeps choices of a task until it is done, or the task raises Spent
    source: str
    needs: tuple[str, ...] = ()  # of the above
    # Options of the model's numbers with which it can work.
    options: tuple[str, ...] = ("hold_r", "full_q", "full_r", "prior", "where")
    by_trials: bool = False  # whether it ends after a number of trials; others have their own criterion
    sampler: str = ""  # of a study; empty if the method runs alone

    @property
    def is_study(self) -> bool:
        """Whether it is a study, which draws its runs, tries the baselines and validates its best trials."""
        return bool(self.sampler)

    def check(self, name: str, task: Task) -> None:
        """Raise ValueError if a task lacks what the method needs."""
        if not has_search_space(task.filter):
            raise ValueError(f"filter must be one that has something to tune, but got {task.filter!r}")
        if GRADIENT in self.needs:
            check_gradient(task.filter, f"a filter for method {name!r}")
        if COVARIANCE in self.needs and not filter_type(task.filter).has_covariance:
            raise ValueError(f"method {name!r} needs a filter with a covariance, but got {task.filter!r}")
        if INFLATION in self.needs and INFLATION not in filter_type(task.filter).numbers:
            raise ValueError(f"method {name!r} tunes the inflation of an ensemble, but {task.filter!r} has none")
        if TRUTH in self.needs and not task.has_truth:
            pairs = zip(task.problems, task.data, strict=True)
            lacking = next(problem.name for problem, data in pairs if problem.scale is None or data.states is None)
            raise ValueError(f"method {name!r} needs true states, but {lacking} has none")
        if NOISE in self.needs and not {Q, R} <= set(task.start.model):
            raise ValueError(
                f"method {name!r} tunes Q and R, but {task.problems[0].name} has parameters of its own"
            )
        if MODEL in self.needs and not task.free:
            raise ValueError(
                f"method {name!r} tunes the model, but {task.problems[0].name} has no free parameter of it"
            )
        if LINEAR in self.needs:
            stationary(task.model(task.start), task.problems[0].name, name)
        if NUTPIE in self.needs and importlib.util.find_spec(NUTPIE) is None:
            raise ValueError(f"method {name!r} needs {NUTPIE}, which is not installed: {to_install('nuts')}")
        unable = [option for option, wanted in task.options.items() if wanted and option not in self.options]
        if unable:
            rest = f": P0 is tuned{way_out('P0')}" if "prior" in unable else ""
            raise ValueError(f"method {name!r} must come without {', '.join(unable)}{rest}")

    def run(self, name: str, task: Task, guarded: bool = True) -> None:
        """Run the method until it is done or the budget spent; ValueError if the task lacks what it needs.

        The answer is `task.best`; `task.answers` holds those for smaller budgets. If the answer is worse than the
        start or the model's own numbers, these replace it (`task.refused`).
        """
        self.check(name, task)
        try:
            self.function(task)
        except Spent:
            pass
        if guarded and not task.stop():  # whoever asks for an end waits for no more
            task.refuse_worse()
