"""The methods of tuning by name: studies, and those that run alone, which register themselves."""

from __future__ import annotations

from thruster_env.core.checks import one_of
from tuning.methods import gradients, innovations, searches  # noqa: F401 - their methods register themselves
from tuning.methods.searches import GAUSSIAN, HANSEN, TPE, UNIFORM
from tuning.methods.task import ALONE, GRADIENT, Method, Task

GRADIENT_METHOD = "gradient"
DEFAULT = "tpe"
ONLY = "-only"  # behind a sampler: without what a study does besides


def study(task: Task) -> None:
    """Trials of the objective, of the ensemble size, too, with the mean NIS in a band.

    The first trials are the baselines and the maximum-likelihood values. The best trials then meet the baselines
    on validation seeds, and the best baseline is chosen unless one of them is significantly better
    (docs/appendix/tuning.md).
    """
    raise ValueError("a study must be run by tuning.tune or thruster tune, but got a task")


def gradient(task: Task) -> None:
    """The maximum of log L, or the least score, mse or log-score if that is the objective, with standard errors.

    A study by `tpe` runs beside it. The optimum meets the baselines on validation seeds, as trials do.
    """
    study(task)


STUDIES = {
    DEFAULT: Method(
        "the default: a study by Optuna's tree-structured Parzen estimator, its best trials validated",
        "for any filter and objective, also for an ensemble's size and among filters",
        study,
        TPE,
        sampler="tpe",
    ),
    "gp": Method(
        "the same study by Optuna's Gaussian process",
        "for any filter, if a trial takes seconds",
        study,
        GAUSSIAN,
        sampler="gp",
    ),
    "cma-es": Method(
        "the same study by covariance matrix adaptation",
        "for any filter, with hundreds of trials",
        study,
        HANSEN,
        sampler="cma-es",
    ),
    "nsga-ii": Method(
        "the same study by a genetic algorithm",
        "with two objectives, for a Pareto front",
        study,
        "Deb, Pratap, Agarwal, Meyarivan (2002)",
        sampler="nsga-ii",
    ),
    "random": Method(
        "the same study by independent draws",
        "to compare: every sampler has to beat it",
        study,
        UNIFORM,
        sampler="random",
    ),
    "grid": Method(
        "the same study over five values of each parameter, in random order",
        "with up to three parameters, to see the whole range",
        study,
        UNIFORM,
        sampler="grid",
    ),
    GRADIENT_METHOD: Method(
        "`likelihood` with standard errors, or `score`, `mse` or `log-score` if that is the objective, validated; "
        "a study by `tpe` runs beside it",
        "for Kalman filters, if the accuracy of Q and R counts, too",
        gradient,
        "Gupta, Mehra (1974)",
        (GRADIENT,),
        sampler="tpe",
    ),
}

METHODS = STUDIES | ALONE


def find_method(name: str) -> Method:
    """A method by its name; ValueError for an unknown one."""
    return METHODS[one_of("method", name, tuple(METHODS))]
