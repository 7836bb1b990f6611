"""The ways by name."""

from __future__ import annotations

from thruster_env.core.checks import one_of
from tuning.search.objectives import LIKELIHOOD, LOG_SCORE, MSE, SCORE
from tuning.ways.adaptive import anderson, sage_husa, vb
from tuning.ways.correlations import als, desroziers, mehra
from tuning.ways.em import em, squarem
from tuning.ways.okf import masked, okf
from tuning.ways.posterior import maximum_a_posteriori, nuts, posterior
from tuning.ways.scoring import noise_estimation, scoring
from tuning.ways.searches import SLOWER, ascend, coordinate_steps, nelder_mead, sample
from tuning.ways.way import COVARIANCE, GRADIENT, INFLATION, LINEAR, MODEL, NOISE, NUTPIE, TRUTH, Way

ABBEEL = "Abbeel, Coates, Montemerlo, Ng, Thrun (2005)"
CHEN = "Chen, Heckman, Julier, Ahmed (2018), arXiv 1807.08855"
DIAGONAL = ("hold_r", "prior")
MATRICES = (*DIAGONAL, "full_q", "full_r")  # of ways that find matrices as a whole, and know no relations

WAYS = {
    LIKELIHOOD: Way(
        "maximum likelihood of the innovations by L-BFGS with exact gradients",
        "without true states; and with few runs",
        ascend(LIKELIHOOD),
        "Gupta, Mehra (1974)",
        (GRADIENT,),
    ),
    "scoring": Way(
        "maximum likelihood of the innovations by Fisher scoring with the exact information",
        "to compare: from a good start it ends where `likelihood` ends, in fewer steps",
        scoring,
        "Gupta, Mehra (1974)",
        (GRADIENT,),
    ),
    LOG_SCORE: Way(
        "the best log density of the true states by L-BFGS with exact gradients",
        "with true states, if both estimate and covariance count",
        ascend(LOG_SCORE),
        ABBEEL,
        (TRUTH, GRADIENT),
    ),
    MSE: Way(
        "the least sum of mean square errors over scale squared by L-BFGS with exact gradients",
        "with true states, if the estimate alone counts",
        ascend(MSE),
        ABBEEL,
        (TRUTH, GRADIENT),
    ),
    SCORE: Way(
        "the least score, mean RMSE over scale, by L-BFGS with exact gradients",
        "with true states, if the estimate alone counts, each state alike",
        ascend(SCORE),
        "this package",
        (TRUTH, GRADIENT),
    ),
    "map": Way(
        "the likelihood with inverse Wishart priors about the start, by L-BFGS",
        "without true states, if the start is worth something and the data are few",
        maximum_a_posteriori,
        "Gelman, Carlin, Stern, Dunson, Vehtari, Rubin (2013)",
        (GRADIENT, NOISE),
    ),
    "em": Way(
        "expectation-maximisation, by slopes of the likelihood in place of a smoother",
        "to compare: it ends where `likelihood` ends, later",
        em,
        "Shumway, Stoffer (1982)",
        (GRADIENT, NOISE),
        MATRICES,
    ),
    "squarem": Way(
        "expectation-maximisation with extrapolated steps",
        "to compare: em in a tenth of its steps",
        squarem,
        "Varadhan, Roland (2008)",
        (GRADIENT, NOISE),
        DIAGONAL,
    ),
    "noise-estimation": Way(
        "sample covariances of what the model leaves of true states and measurements",
        "with true states and a model that is right: nothing is better or faster",
        noise_estimation,
        ABBEEL,
        (TRUTH, COVARIANCE, NOISE),
        MATRICES,
    ),
    "okf": Way(
        "Adam on Cholesky factors of full Q and R, by batches, on the mean square error",
        "to compare: `mse` with full Q and R ends lower, sooner",
        okf,
        "Greenberg, Yannay, Mannor (2023), arXiv 2310.00675",
        (TRUTH, GRADIENT, NOISE),
        MATRICES,
    ),
    "als": Way(
        "least squares of lagged covariances of a fixed gain's innovations, full Q and R semidefinite",
        "without true states, of a linear model on long stationary runs: a few passes",
        als,
        "Odelson, Rajamani, Rawlings (2006)",
        (GRADIENT, LINEAR),
        ("hold_r", "full_q", "full_r"),
    ),
    "mehra": Way(
        "P H', R and Q in turn from lagged covariances of the innovations of a fixed gain",
        "to compare: the ancestor of `als`, which scatters less",
        mehra,
        "Mehra (1970)",
        (GRADIENT, LINEAR),
        ("hold_r",),
    ),
    "desroziers": Way(
        "R and one factor on Q from innovations before and after updates, repeated",
        "of ensembles, without true states: some thirty passes",
        desroziers,
        "Desroziers, Berre, Chapnik, Poli (2005)",
        (COVARIANCE, NOISE),
        DIAGONAL,
    ),
    "anderson": Way(
        "the inflation of an ensemble that its innovations ask for, step by step, then its mean",
        "of ensembles, without true states, if Q and R are known: one pass",
        anderson,
        "Anderson (2007)",
        (COVARIANCE, INFLATION),
        ("hold_r",),
    ),
    "sage-husa": Way(
        "Sage and Husa's adaptive filter over all runs, then its mean Q and R",
        "to compare: one pass, seldom near",
        sage_husa,
        "Sage, Husa (1969)",
        (GRADIENT, NOISE),
        MATRICES,
    ),
    "vb": Way(
        "the variational Bayesian filter over all runs, then its mean R; Q stays",
        "without true states, if Q is known and R is not: one pass",
        vb,
        "Sarkka, Nummenmaa (2009)",
        (GRADIENT, NOISE),
        MATRICES,
    ),
    "posterior": Way(
        "the mean of the posterior by a Metropolis random walk",
        "without true states and with few runs, if time does not count",
        posterior,
        "Haario, Saksman, Tamminen (2001)",
        (COVARIANCE, MODEL),
    ),
    "nuts": Way(
        "the same mean by the no-U-turn sampler with exact gradients, of the package nutpie",
        "like `posterior`, from six numbers on",
        nuts,
        "Hoffman, Gelman (2014)",
        (GRADIENT, NUTPIE),
    ),
    "masked": Way(
        "the downhill simplex on the error of measurements that the filter is not shown",
        "without true states, if no likelihood is to be trusted",
        masked,
        "Barratt, Boyd (2020)",
        (COVARIANCE,),
    ),
    "nelder-mead": Way(
        "the downhill simplex on the objective",
        "of any filter, with up to six numbers",
        nelder_mead,
        "Powell (2002)",
    ),
    "coordinate-steps": Way(
        "one number at a time, a step up or half of it, on the objective",
        "to compare: what MATLAB's tune documents",
        coordinate_steps,
        "The MathWorks, `tune`",
    ),
    "tpe": Way(
        "Optuna's tree-structured Parzen estimator on the objective",
        "of any filter and objective; with up to ten numbers",
        sample("tpe"),
        "Bergstra, Bardenet, Bengio, Kegl (2011)",
        by_trials=True,
    ),
    "gp": Way(
        "Optuna's Gaussian process on the objective",
        "of any filter, if a pass takes seconds",
        sample("gp"),
        "Optuna's GPSampler",
        by_trials=True,
    ),
    "cma-es": Way(
        "covariance matrix adaptation on the objective",
        "of any filter, with hundreds of trials",
        sample("cma-es"),
        "Hansen (2016), arXiv 1604.00772",
        by_trials=True,
    ),
    "random": Way(
        "independent draws",
        "to compare: every search has to beat it",
        sample("random"),
        "Bergstra, Bengio (2012)",
        by_trials=True,
    ),
    "nis": Way(
        "trials that minimise abs(log(mean NIS / m)), by the sampler tpe",
        "to compare: it is zero on a curve, and says nothing of error",
        sample("tpe", "nis"),
        CHEN,
        (COVARIANCE,),
        by_trials=True,
    ),
    "c-nis": Way(
        "the same of mean and variance of the NIS",
        "to compare",
        sample("tpe", "c-nis"),
        "Chen, Biggie, Ahmed, Julier, Heckman, arXiv 2306.07225",
        (COVARIANCE,),
        by_trials=True,
    ),
    "c-nis-two-rates": Way(
        "the larger one of c-nis at the sample time and at one ten times as long",
        "to compare: two sample times tell Q from R where one leaves a curve of zeros",
        sample("tpe", "c-nis", SLOWER),
        "Chen, Biggie, Ahmed, Julier, Heckman, arXiv 2306.07225",
        (COVARIANCE,),
        by_trials=True,
    ),
    "nees": Way(
        "trials that minimise abs(log(mean NEES / n)), by the sampler tpe",
        "to compare",
        sample("tpe", "nees"),
        CHEN,
        (TRUTH, COVARIANCE),
        by_trials=True,
    ),
    "c-nees": Way(
        "the same of mean and variance of the NEES",
        "to compare",
        sample("tpe", "c-nees"),
        "Chen, Biggie, Ahmed, Julier, Heckman, arXiv 2306.07225",
        (TRUTH, COVARIANCE),
        by_trials=True,
    ),
}


def find_way(name: str) -> Way:
    """A way by its name; ValueError for an unknown one."""
    return WAYS[one_of("way", name, tuple(WAYS))]
