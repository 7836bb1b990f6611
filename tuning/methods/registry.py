"""The methods of tuning by name, each with its function, its needs, its source and when to use it."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from typing import NamedTuple

from filters.registry import filter_type
from thruster_env.core.checks import one_of
from thruster_env.core.modules import to_install
from tuning.likelihood.parametric import check_gradient
from tuning.methods.correlations import als, desroziers, mehra, stationary
from tuning.methods.em import em, squarem
from tuning.methods.okf import okf
from tuning.methods.posterior import maximum_a_posteriori, nuts, posterior
from tuning.methods.scoring import noise_estimation, scoring
from tuning.methods.searches import (
    INFLATION,
    SLOWER,
    anderson,
    ascend,
    coordinate_steps,
    masked,
    nelder_mead,
    sage_husa,
    sample,
    vb,
)
from tuning.methods.task import Spent, Task, way_out
from tuning.search.objectives import LIKELIHOOD, LOG_SCORE, MSE, SCORE
from tuning.search.parameters import Q, R
from tuning.search.space import has_search_space

ABBEEL = "Abbeel, Coates, Montemerlo, Ng, Thrun (2005)"
CHEN = "Chen, Heckman, Julier, Ahmed (2018), arXiv 1807.08855"
DIAGONAL = ("hold_r", "prior")
MATRICES = (*DIAGONAL, "full_q", "full_r")  # of methods that find matrices as a whole, and know no relations

TPE = "Bergstra, Bardenet, Bengio, Kegl (2011)"
HANSEN = "Hansen (2016), arXiv 1604.00772"
GAUSSIAN = "Optuna's GPSampler"
UNIFORM = "Bergstra, Bengio (2012)"
GRADIENT_METHOD = "gradient"
DEFAULT = "tpe"
ONLY = "-only"  # behind a sampler: without what a study does besides

# What a method may need; INFLATION is that of an ensemble.
TRUTH = "truth"  # true states
GRADIENT = "gradient"  # a Kalman filter with derivatives
COVARIANCE = "covariance"  # a filter with a covariance
LINEAR = "linear"  # a linear model with a stationary filter
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
ALONE = {
    LIKELIHOOD: Method(
        "maximum likelihood of the innovations by L-BFGS with exact gradients",
        "without true states; and with few runs",
        ascend(LIKELIHOOD),
        "Gupta, Mehra (1974)",
        (GRADIENT,),
    ),
    "scoring": Method(
        "maximum likelihood of the innovations by Fisher scoring with the exact information",
        "to compare: from a good start it ends where `likelihood` ends, in fewer steps",
        scoring,
        "Gupta, Mehra (1974)",
        (GRADIENT,),
    ),
    LOG_SCORE: Method(
        "the best log density of the true states by L-BFGS with exact gradients",
        "with true states, if both estimate and covariance count",
        ascend(LOG_SCORE),
        ABBEEL,
        (TRUTH, GRADIENT),
    ),
    MSE: Method(
        "the least sum of mean square errors over scale squared by L-BFGS with exact gradients",
        "with true states, if the estimate alone counts",
        ascend(MSE),
        ABBEEL,
        (TRUTH, GRADIENT),
    ),
    SCORE: Method(
        "the least score, mean RMSE over scale, by L-BFGS with exact gradients",
        "with true states, if the estimate alone counts, each state alike",
        ascend(SCORE),
        "this package",
        (TRUTH, GRADIENT),
    ),
    "map": Method(
        "the likelihood with inverse Wishart priors about the start, by L-BFGS",
        "without true states, if the start is plausible and the data are few",
        maximum_a_posteriori,
        "Gelman, Carlin, Stern, Dunson, Vehtari, Rubin (2013)",
        (GRADIENT, NOISE),
    ),
    "em": Method(
        "expectation-maximisation, by slopes of the likelihood in place of a smoother",
        "to compare: it ends where `likelihood` ends, later",
        em,
        "Shumway, Stoffer (1982)",
        (GRADIENT, NOISE),
        MATRICES,
    ),
    "squarem": Method(
        "expectation-maximisation with extrapolated steps",
        "to compare: em in a tenth of its steps",
        squarem,
        "Varadhan, Roland (2008)",
        (GRADIENT, NOISE),
        DIAGONAL,
    ),
    "noise-estimation": Method(
        "sample covariances of the residuals of the model on true states and measurements",
        "with true states and a model that is right: nothing is better or faster",
        noise_estimation,
        ABBEEL,
        (TRUTH, COVARIANCE, NOISE),
        MATRICES,
    ),
    "okf": Method(
        "Adam on Cholesky factors of full Q and R, by batches, on the mean square error",
        "to compare: `mse` with full Q and R ends lower, sooner",
        okf,
        "Greenberg, Yannay, Mannor (2023), arXiv 2310.00675",
        (TRUTH, GRADIENT, NOISE),
        MATRICES,
    ),
    "als": Method(
        "least squares of lagged covariances of a fixed gain's innovations, full Q and R semidefinite",
        "without true states, for a linear model on long stationary runs: a few passes",
        als,
        "Odelson, Rajamani, Rawlings (2006)",
        (GRADIENT, LINEAR),
        ("hold_r", "full_q", "full_r"),
    ),
    "mehra": Method(
        "P H', R and Q in turn from lagged covariances of the innovations of a fixed gain",
        "to compare: the ancestor of `als`, which scatters less",
        mehra,
        "Mehra (1970)",
        (GRADIENT, LINEAR),
        ("hold_r",),
    ),
    "desroziers": Method(
        "R and one factor on Q from innovations before and after updates, repeated",
        "for ensembles, without true states: some thirty passes",
        desroziers,
        "Desroziers, Berre, Chapnik, Poli (2005)",
        (COVARIANCE, NOISE),
        DIAGONAL,
    ),
    "anderson": Method(
        "the inflation of an ensemble that its innovations imply, step by step, then its mean",
        "for ensembles, without true states, if Q and R are known: one pass",
        anderson,
        "Anderson (2007)",
        (COVARIANCE, INFLATION),
        ("hold_r",),
    ),
    "sage-husa": Method(
        "Sage and Husa's adaptive filter over all runs, then its mean Q and R",
        "to compare: one pass, seldom near the optimum",
        sage_husa,
        "Sage, Husa (1969)",
        (GRADIENT, NOISE),
        MATRICES,
    ),
    "vb": Method(
        "the variational Bayesian filter over all runs, then its mean R; Q stays",
        "without true states, if Q is known and R is not: one pass",
        vb,
        "Sarkka, Nummenmaa (2009)",
        (GRADIENT, NOISE),
        MATRICES,
    ),
    "posterior": Method(
        "the mean of the posterior by a Metropolis random walk",
        "without true states and with few runs, if time does not count",
        posterior,
        "Haario, Saksman, Tamminen (2001)",
        (COVARIANCE, MODEL),
    ),
    "nuts": Method(
        "the same mean by the no-U-turn sampler with exact gradients, of the package nutpie",
        "like `posterior`, from six parameters on",
        nuts,
        "Hoffman, Gelman (2014)",
        (GRADIENT, NUTPIE),
    ),
    "masked": Method(
        "the downhill simplex on the error of measurements withheld from the filter",
        "without true states, if no likelihood can be trusted",
        masked,
        "Barratt, Boyd (2020)",
        (COVARIANCE,),
    ),
    "nelder-mead": Method(
        "the downhill simplex on the objective",
        "for any filter, with up to six parameters",
        nelder_mead,
        "Powell (2002)",
    ),
    "coordinate-steps": Method(
        "one parameter at a time, a step up or half of it, on the objective",
        "to compare: what MATLAB's tune documents",
        coordinate_steps,
        "The MathWorks, `tune`",
    ),
    "tpe-only": Method(
        "Optuna's tree-structured Parzen estimator on the objective, without baselines, band and validation",
        "to compare with the study `tpe`",
        sample("tpe"),
        TPE,
        by_trials=True,
    ),
    "gp-only": Method(
        "Optuna's Gaussian process on the objective, alone",
        "to compare with the study `gp`",
        sample("gp"),
        GAUSSIAN,
        by_trials=True,
    ),
    "cma-es-only": Method(
        "covariance matrix adaptation on the objective, alone",
        "to compare with the study `cma-es`",
        sample("cma-es"),
        HANSEN,
        by_trials=True,
    ),
    "random-only": Method(
        "independent draws alone",
        "to compare: every search has to beat it",
        sample("random"),
        UNIFORM,
        by_trials=True,
    ),
    "nis": Method(
        "trials that minimise abs(log(mean NIS / m)), by the sampler tpe",
        "to compare: it is zero on a curve, whatever the error",
        sample("tpe", "nis"),
        CHEN,
        (COVARIANCE,),
        by_trials=True,
    ),
    "c-nis": Method(
        "the same of mean and variance of the NIS",
        "to compare",
        sample("tpe", "c-nis"),
        "Chen, Biggie, Ahmed, Julier, Heckman, arXiv 2306.07225",
        (COVARIANCE,),
        by_trials=True,
    ),
    "c-nis-two-rates": Method(
        "the larger one of c-nis at the sample time and at one ten times as long",
        "to compare: two sample times separate Q and R, one leaves a curve of zeros",
        sample("tpe", "c-nis", SLOWER),
        "Chen, Biggie, Ahmed, Julier, Heckman, arXiv 2306.07225",
        (COVARIANCE,),
        by_trials=True,
    ),
    "nees": Method(
        "trials that minimise abs(log(mean NEES / n)), by the sampler tpe",
        "to compare",
        sample("tpe", "nees"),
        CHEN,
        (TRUTH, COVARIANCE),
        by_trials=True,
    ),
    "c-nees": Method(
        "the same of mean and variance of the NEES",
        "to compare",
        sample("tpe", "c-nees"),
        "Chen, Biggie, Ahmed, Julier, Heckman, arXiv 2306.07225",
        (TRUTH, COVARIANCE),
        by_trials=True,
    ),
}


METHODS = STUDIES | ALONE


def find_method(name: str) -> Method:
    """A method by its name; ValueError for an unknown one."""
    return METHODS[one_of("method", name, tuple(METHODS))]
