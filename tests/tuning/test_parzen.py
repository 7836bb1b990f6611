"""The densities of Parzen estimators as arrays: those of Optuna, so that the same seed gives the same study."""

import numpy as np
import optuna
import pytest
from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution
from optuna.samplers._tpe.parzen_estimator import _ParzenEstimator

from tuning.search import parzen
from tuning.search.parzen import ParzenEstimator
from tuning.search.samplers import make_sampler

SPACE = {
    "Q11": FloatDistribution(1e-5, 1e3, log=True),
    "inflation": FloatDistribution(1.0, 1.3),
    "N": IntDistribution(5, 200, log=True),
    "iterations": IntDistribution(1, 8),
    "filter": CategoricalDistribution(("ekf", "enkf")),
}


def seen(rng, count):
    """Observations all over the ranges, with equal ones and ends among them."""
    return {
        "Q11": np.exp(rng.uniform(np.log(1e-5), np.log(1e3), count)),
        "inflation": np.append(rng.normal(1.01, 1e-4, count - 1).clip(1.0, 1.3), 1.3),
        "N": rng.integers(5, 201, count).astype(float),
        "iterations": rng.integers(1, 3, count).astype(float),
        "filter": rng.integers(0, 2, count).astype(float),
    }


@pytest.mark.parametrize("count", [1, 4, 150])
def test_the_densities_are_optunas(count):
    given = seen(np.random.default_rng(count), count)
    parameters = optuna.samplers.TPESampler()._parzen_estimator_parameters
    mine, own = (kind(given, SPACE, parameters) for kind in (ParzenEstimator, _ParzenEstimator))
    others = seen(np.random.default_rng(7), 40)  # far from the kernels, too
    for samples in (own.sample(np.random.RandomState(1), 24), others):
        assert mine.log_pdf(samples) == pytest.approx(own.log_pdf(samples), rel=1e-12, abs=1e-12)


def test_far_outside_a_range_they_are_optunas_too():
    space, given = {"inflation": SPACE["inflation"]}, {"inflation": np.array([1.1, 301.0])}
    parameters = optuna.samplers.TPESampler()._parzen_estimator_parameters
    mine, own = (kind(given, space, parameters) for kind in (ParzenEstimator, _ParzenEstimator))
    samples = {"inflation": np.linspace(1.0, 1.3, 7)}
    expected = own.log_pdf(samples)
    assert np.isfinite(expected).all() and np.array_equal(mine.log_pdf(samples), expected)


def test_a_study_takes_them_from_this_version_of_optuna():
    assert parzen.is_optunas()
    assert make_sampler("tpe", 0, 0, {})._parzen_estimator_cls is ParzenEstimator


def test_another_version_of_optuna_keeps_its_own(monkeypatch):
    monkeypatch.setattr(
        ParzenEstimator, "log_pdf", lambda self, samples: 1.0 + _ParzenEstimator.log_pdf(self, samples)
    )
    parzen.is_optunas.cache_clear()
    try:
        assert make_sampler("tpe", 0, 0, {})._parzen_estimator_cls is _ParzenEstimator
    finally:
        parzen.is_optunas.cache_clear()


def test_proposals_are_optunas():
    def proposed(sampler):
        study = optuna.create_study(sampler=sampler)
        study.optimize(lambda trial: (trial.suggest_float("x", 1e-3, 1.0, log=True) - 0.1) ** 2, n_trials=14)
        return [trial.params["x"] for trial in study.trials]

    seed = int(np.random.SeedSequence([5, 0, 0]).generate_state(1)[0])
    assert proposed(make_sampler("tpe", 5, 0, {})) == proposed(optuna.samplers.TPESampler(seed=seed))
