"""Scores of a filter's distribution, coverage and ranks against their closed forms and naive sums."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from filters.consistency.nees import (
    covered,
    ensemble_crps,
    ensemble_ranks,
    gaussian_crps,
    uniformity,
)
from filters.consistency.report import ranks_verdict


@pytest.mark.parametrize(("error", "deviation"), [(0.0, 1.0), (1.3, 0.7), (-4.0, 2.0)])
def test_the_gaussian_crps_is_its_integral(error, deviation):
    # forecast N(error, deviation^2), truth 0
    below, _ = quad(lambda x: norm.cdf(x, error, deviation) ** 2, -30, 0)
    above, _ = quad(lambda x: norm.sf(x, error, deviation) ** 2, 0, 30)
    assert gaussian_crps(np.array(error), np.array(deviation)) == pytest.approx(below + above, rel=1e-7)


def test_of_a_right_forecast_it_is_the_deviation_over_the_root_of_pi():
    errors = np.random.default_rng(7).normal(0.0, 1.7, size=200_000)
    score = gaussian_crps(errors, np.full(errors.shape, 1.7))
    assert score.mean() == pytest.approx(1.7 / np.sqrt(np.pi), abs=4 * score.std() / np.sqrt(200_000))
    assert gaussian_crps(np.array(-2.5), np.array(0.0)) == 2.5


@pytest.mark.parametrize("weighted", [False, True])
def test_the_ensemble_crps_is_the_naive_double_sum(weighted):
    rng = np.random.default_rng(8)
    truth_, members = rng.normal(size=6), rng.normal(size=(6, 9))
    weights = rng.dirichlet(np.ones(9), size=6) if weighted else None
    w = np.full((6, 9), 1 / 9) if weights is None else weights
    between = np.abs(members[:, :, None] - members[:, None, :])
    expected = (w * np.abs(members - truth_[:, None])).sum(1) - 0.5 * np.einsum("bi,bj,bij->b", w, w, between)
    np.testing.assert_allclose(ensemble_crps(truth_, members, weights), expected, rtol=1e-12)
    if not weighted:
        fair = np.abs(members - truth_[:, None]).mean(1) - between.sum((1, 2)) / (2 * 9 * 8)
        np.testing.assert_allclose(ensemble_crps(truth_, members, fair=True), fair, rtol=1e-12)
    else:
        with pytest.raises(ValueError, match="members without weights"):
            ensemble_crps(truth_, members, weights, fair=True)


def test_the_fair_score_does_not_depend_on_the_size():
    rng = np.random.default_rng(9)
    for size in (3, 30):
        score = ensemble_crps(rng.normal(size=40_000), rng.normal(size=(40_000, size)), fair=True)
        assert score.mean() == pytest.approx(1 / np.sqrt(np.pi), abs=4 * score.std() / 200)


def test_coverage_is_that_of_the_normal_distribution():
    errors = np.random.default_rng(10).normal(size=100_000)
    for level, deviation in ((0.95, 1.0), (0.95, 0.5), (0.5, 1.0)):
        expected = 2 * norm.cdf(deviation * norm.ppf(0.5 + level / 2)) - 1
        assert covered(errors, np.full(errors.shape, deviation), level).mean() == pytest.approx(
            expected, abs=0.007
        )
    assert np.isnan(covered(np.ones(1), np.zeros(1))).all()


def test_ranks_count_the_members_below():
    members = np.array([[0.0, 1.0, 2.0], [5.0, 4.0, 6.0]])
    np.testing.assert_allclose(ensemble_ranks(np.array([1.5, 3.0]), members), [2.5 / 4, 0.5 / 4])
    equal = np.full((2, 3), 1 / 3)
    np.testing.assert_allclose(ensemble_ranks(np.array([1.5, 3.0]), members, equal), [2.5 / 4, 0.5 / 4])


@pytest.mark.parametrize(
    ("spread", "shift", "word"),
    [(1.0, 0.0, "even"), (0.6, 0.0, "too close"), (1.7, 0.0, "too far"), (1.0, 0.7, "too high")],
)
def test_rank_histograms_tell_how_members_are_wrong(spread, shift, word):
    rng = np.random.default_rng(11)
    ranks = ensemble_ranks(rng.normal(size=(60, 50)), shift + spread * rng.normal(size=(60, 50, 10)))
    found = uniformity(ranks, steps=11)
    assert len(found.frequencies) == 11 and word in ranks_verdict(found)
