"""The density of Optuna's Parzen estimator, for all candidates and kernels in one go.

Optuna evaluates the normal distribution function one number at a time in Python, which took a tenth of a study
of a cheap filter. Which kernels there are, which candidates are drawn and which one is taken stays Optuna's.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import optuna
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution
from optuna.samplers._tpe.parzen_estimator import _ParzenEstimator
from scipy.special import ndtr

HALF_LOG_TWO_PI = 0.5 * float(np.log(2.0 * np.pi))
EQUAL = 1e-9  # relative difference from Optuna's own log-density, above which its estimator is another one
TRIED: dict[str, tuple[BaseDistribution, list[float]]] = {  # parameters of each kind, with observations
    "Q": (FloatDistribution(1e-3, 10.0, log=True), [0.02, 0.5, 3.0]),
    "inflation": (FloatDistribution(1.0, 1.3), [1.0, 1.1, 1.25]),
    "N": (IntDistribution(5, 200, log=True), [5, 5, 60]),
    "iterations": (IntDistribution(1, 8), [2, 3, 8]),
    "filter": (CategoricalDistribution(("ekf", "enkf", "ukf")), [0, 2, 2]),
}


class ParzenEstimator(_ParzenEstimator):
    """Optuna's mixture of products of truncated normal, discretised and categorical kernels."""

    def log_pdf(self, samples_dict: dict[str, np.ndarray]) -> np.ndarray:
        """Log-density at samples of each parameter, one array (S,) by name.

        log p(x) = log sum_k w_k prod_i p_ki(x_i), where p_ki is a normal density over its mass within the range,
        or for whole numbers the mass of their interval over it.
        """
        mixture: Any = self._mixture_distribution
        samples = self._transform(samples_dict)
        constants = np.log(mixture.weights)  # (kernels,)
        total = np.zeros((len(samples), len(constants)))
        for x, kernels in zip(samples.T, mixture.distributions, strict=True):
            if not hasattr(kernels, "sigma"):  # categorical: a weight for each choice
                total += np.log(kernels.weights[:, x.astype(int)]).T
                continue
            mean, precision = kernels.mu, 1.0 / kernels.sigma
            ends = kernels.adapted_low, kernels.adapted_high
            constants = constants - _log_mass(*((end - mean) * precision for end in ends))
            if kernels.step:
                few, places = np.unique(x, return_inverse=True)
                edges = few - kernels.step / 2, few + kernels.step / 2
                logarithms = [np.log(edge) if kernels.is_log else edge for edge in edges]
                total += _log_mass(*((edge[:, None] - mean) * precision for edge in logarithms))[places]
            else:
                distances = ((np.log(x) if kernels.is_log else x)[:, None] - mean) * precision
                total -= 0.5 * distances**2
                constants += np.log(precision) - HALF_LOG_TWO_PI
        total += constants
        largest = total.max(axis=1)
        if not np.isfinite(largest).all():  # a kernel of an enqueued trial, so far outside that no mass is left
            return super().log_pdf(samples_dict)
        return np.log(np.exp(total - largest[:, None]).sum(axis=1)) + largest


def _log_mass(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Logarithm of the mass of a standard normal distribution between two points, accurate in both tails."""
    right = low > 0
    with np.errstate(divide="ignore"):  # -inf, of a kernel so far away that the broad one of the prior decides
        return np.log(ndtr(np.where(right, -low, high)) - ndtr(np.where(right, -high, low)))


@cache
def is_optunas() -> bool:
    """Whether this version of Optuna has the estimator whose densities `ParzenEstimator` gives.

    It is private to Optuna, so both are evaluated once; where they differ, samplers keep to Optuna's own.
    """
    space = {name: distribution for name, (distribution, _) in TRIED.items()}
    seen = {name: np.array(values, dtype=np.float64) for name, (_, values) in TRIED.items()}
    try:
        sampler: Any = optuna.samplers.TPESampler(seed=0)
        if sampler._parzen_estimator_cls is not _ParzenEstimator:
            return False
        mine, own = (
            kind(seen, space, sampler._parzen_estimator_parameters) for kind in (ParzenEstimator, _ParzenEstimator)
        )
        samples = own.sample(np.random.RandomState(0), 8)
        return bool(np.allclose(mine.log_pdf(samples), own.log_pdf(samples), rtol=EQUAL, atol=EQUAL))
    except (AttributeError, TypeError, ValueError, KeyError, IndexError):
        return False
