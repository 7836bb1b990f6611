"""Checks of squares, innovations, distributions and ranks against closed forms, on data whose truth is known."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import chi2, kstest, norm

from filters.consistency.nees import (
    check_whitened,
    covered,
    ensemble_crps,
    ensemble_ranks,
    gaussian_crps,
    mean_interval,
    rmse_intervals,
    rmse_ratios,
    uniformity,
    whitened,
    whiteness,
)
from filters.consistency.report import (
    HEAVY,
    STUCK,
    longest_stretches,
    ranks_verdict,
    sentences,
    whiteness_sentence,
)
from tests.filters.checks import refused
from tests.linear_problem import LinearProblem
from tuning.evaluation.baselines import noise_estimated
from tuning.evaluation.evaluate import check_consistency
from tuning.plants.thruster import find_scenario
from tuning.search.space import oracle_choice

COV = np.array([[2.0, 0.6], [0.6, 0.5]])


def correlated(runs, steps, memory, seed=0):
    """Standard normals (runs, steps) whose correlation over l steps is memory^l."""
    e = np.random.default_rng(seed).normal(size=(runs, steps))
    x = e.copy()
    for k in range(1, steps):
        x[:, k] = memory * x[:, k - 1] + np.sqrt(1 - memory**2) * e[:, k]
    return x


def honest_errors(runs, steps, seed=0):
    """Errors with covariance COV, (runs, steps, 2), and these covariances."""
    errors = np.random.default_rng(seed).normal(size=(runs, steps, 2)) @ np.linalg.cholesky(COV).T
    return errors, np.broadcast_to(COV, (runs, steps, 2, 2))


class TestIntervals:
    def test_the_mean_s_interval_is_that_of_runs_and_not_of_steps(self):
        values = np.repeat(np.random.default_rng(0).normal(size=(400, 1)), 50, axis=1)  # steps repeat one another
        found = mean_interval(values)
        assert found.value == pytest.approx(values.mean())
        assert (found.high - found.low) / (2 * 1.96 * values[:, 0].std() / 20) == pytest.approx(1.0, abs=0.1)

    @pytest.mark.parametrize("runs", [2, 3, 5, 9])
    def test_few_runs_cover_the_right_mean_and_ratio_as_often_as_stated(self, runs):
        """As the exact interval does, which is Student's, within its 95 % and what chance leaves of 500 draws."""
        rng = np.random.default_rng(runs)
        means = [mean_interval(rng.normal(size=runs)) for _ in range(500)]
        pairs = rng.gamma(3.0, size=(500, 2, runs, 1))
        ratios = [rmse_ratios(a, b)[0] for a, b in pairs]
        for intervals, right in ((means, 0.0), (ratios, 1.0)):
            assert 0.90 < np.mean([found.covers(right) for found in intervals]) < 0.985
        assert all(0.0 < found.low < found.value < found.high for found in ratios)

    def test_an_interval_of_few_runs_is_within_what_a_mean_can_be(self):
        assert mean_interval(np.array([0.9, 1.0]), within=(0.0, 1.0)).high == 1.0
        assert mean_interval(np.array([0.9, 1.0])).high > 1.1
        assert mean_interval(np.array([7.0])) == (7.0, 7.0, 7.0)

    def test_missing_numbers_are_left_out(self):
        values = np.array([[1.0, np.nan, 3.0], [np.nan] * 3, [5.0, 5.0, 5.0]])
        assert mean_interval(values).value == pytest.approx(19 / 5)
        assert np.isnan(mean_interval(np.full((4, 3), np.nan))).all()

    def test_pairing_cancels_what_is_hard_for_both(self):
        rng = np.random.default_rng(1)
        hardness = rng.lognormal(size=(100, 1))
        a, b = (hardness * factor * rng.uniform(0.99, 1.01, size=(100, 2)) for factor in (1.21, 1.0))
        ratio = rmse_ratios(a, b)[0]
        assert ratio.low < 1.1 < ratio.high and ratio.high - ratio.low < 0.01
        alone = rmse_intervals(a)[0]
        assert alone.value == pytest.approx(np.sqrt(a[:, 0].mean())) and alone.high / alone.low > 1.15
        assert rmse_ratios(a, a) == ((1.0, 1.0, 1.0),) * 2
        refused("the same runs and states", rmse_ratios, a, b[1:])


class TestSquares:
    def test_an_honest_filter_passes(self):
        check = check_whitened("NEES", whitened(*honest_errors(200, 300)))
        assert check.dimension == 2 and check.mean.covers(2.0) and check.beyond.covers(0.05)
        assert 0.92 < check.share_inside < 0.98  # 300 steps: 0.95 and two and a half standard errors
        assert check.distribution.p_value > 0.01
        np.testing.assert_allclose(check.band[0], chi2.ppf([0.025, 0.975], 400) / 200, rtol=1e-9)

    @pytest.mark.parametrize("factor", [0.5, 2.0])
    def test_a_covariance_off_by_a_factor_is_found(self, factor):
        errors, covs = honest_errors(100, 100)
        honest, check = (check_whitened("NEES", whitened(errors, scale * covs)) for scale in (1.0, factor))
        np.testing.assert_allclose(check.mean, np.array(honest.mean) / factor)
        assert check.share_inside == 0.0 and check.distribution.p_value < 0.001
        expected = chi2.sf(chi2.ppf(0.95, 2) * factor, 2)  # e' P^-1 e has to exceed the point times the factor
        assert check.beyond.covers(expected)

    def test_missing_channels_have_no_degrees_of_freedom(self):
        errors, covs = honest_errors(300, 80)
        covs = np.broadcast_to(np.diag([2.0, 0.5]), covs.shape)
        errors = np.random.default_rng(2).normal(size=errors.shape) * np.sqrt([2.0, 0.5])
        present = np.random.default_rng(3).random(errors.shape) > 0.3
        present[:, 7] = False
        check = check_whitened("NIS", whitened(np.where(present, errors, 0.0), covs), present)
        counted = present.any(axis=-1)
        assert check.dimension == pytest.approx(present.sum() / counted.sum())
        assert check.mean.covers(check.dimension)
        assert np.isnan(check.step_means[7]) and np.isnan(check.band[7]).all()
        total, runs = present[:, 3].sum(), counted[:, 3].sum()
        np.testing.assert_allclose(check.band[3], chi2.ppf([0.025, 0.975], total) / runs, rtol=1e-9)
        assert 0.85 < check.share_inside <= 1.0

    def test_without_covariances_there_is_nothing_to_check(self):
        errors, covs = honest_errors(30, 40)
        check = check_whitened("NEES", whitened(errors, 0.0 * covs))
        assert np.isnan(check.mean.value) and np.isnan(check.share_inside) and np.isnan(check.distribution.p_value)


class TestUniformity:
    def test_the_distance_is_that_of_kolmogorov_and_smirnov(self):
        values = np.random.default_rng(4).beta(1.3, 1.0, size=(40, 200))
        found = uniformity(values)
        assert found.distance == pytest.approx(kstest(values.ravel(), "uniform").statistic, abs=1 / 200)
        assert found.p_value < 0.001
        assert found.frequencies.mean() == pytest.approx(1.0)
        assert (found.frequency_band[:, 0] <= found.frequencies).all()

    def test_correlation_within_runs_does_not_fool_it(self):
        samples = [norm.cdf(correlated(40, 100, 0.9, seed)) for seed in range(100)]
        found = np.array([uniformity(sample).p_value for sample in samples])
        rejected = (found < 0.05).sum()
        assert rejected <= 13  # binomial(100, 0.05): more with probability 0.0005
        naive = sum(kstest(sample.ravel(), "uniform").pvalue < 0.05 for sample in samples)
        assert naive > 50  # as if all steps were independent

    def test_few_runs_give_no_probability_and_no_values_nothing(self):
        assert np.isnan(uniformity(np.full((5, 10), 0.5)).p_value)
        assert np.isnan(uniformity(np.full((30, 10), np.nan)).distance)


class TestWhiteness:
    def test_one_run_and_channel_is_ljung_and_box(self):
        v = np.random.default_rng(5).normal(size=300)
        found = whiteness(v[None, :, None], np.full((1, 300, 1, 1), 1.0), lags=10)
        rho = np.array([(v[:-lag] * v[lag:]).sum() / (v**2).sum() for lag in range(1, 11)])
        statistic = 300 * 302 * (rho**2 / (300 - np.arange(1, 11))).sum()
        assert found.statistic == pytest.approx(statistic) and found.p_value == pytest.approx(
            chi2.sf(statistic, 10)
        )

    def test_white_innovations_pass_as_often_as_they_should(self):
        root = np.linalg.cholesky(COV)
        rng, rejected, inside = np.random.default_rng(6), 0, []
        for _ in range(200):
            e = rng.normal(size=(5, 60, 2)) @ root.T
            found = whiteness(e, np.broadcast_to(COV, (5, 60, 2, 2)), rng.random(e.shape) > 0.2, lags=5)
            rejected += found.p_value < 0.05
            inside.append(found.share_inside)
        assert 2 <= rejected <= 22  # binomial(200, 0.05): outside with probability 0.001
        assert np.mean(inside) == pytest.approx(0.95, abs=0.01)

    def test_correlations_are_found_with_their_size_and_sign(self):
        v = np.stack([correlated(50, 200, 0.6), correlated(50, 200, -0.3, seed=1)], axis=-1)
        covs = np.broadcast_to(np.diag([9.0, 4.0]), (50, 200, 2, 2))
        found = whiteness(v * [3.0, 2.0], covs, lags=4)
        for channel, memory in enumerate((0.6, -0.3)):
            np.testing.assert_allclose(
                found.correlations[:, channel, channel], memory ** np.arange(1, 5), atol=0.03
            )
        np.testing.assert_allclose(found.correlations[:, 0, 1], 0.0, atol=0.04)
        assert found.p_value < 1e-6 and found.half_widths[0, 0, 0] == pytest.approx(
            1.96 / np.sqrt(50 * 199), rel=1e-2
        )

    def test_there_must_be_more_steps_than_lags(self):
        with pytest.raises(ValueError, match="more steps than lags, but got 20 steps and 20 lags"):
            whiteness(np.zeros((2, 20, 1)), np.ones((2, 20, 1, 1)))

    def test_the_sentence_on_whiteness_names_channels_and_lag(self):
        v = np.stack([correlated(40, 100, -0.5), correlated(40, 100, 0.0, seed=1)], axis=-1)
        said = whiteness_sentence(whiteness(v, np.broadcast_to(np.eye(2), (40, 100, 2, 2)), lags=3))
        assert said.startswith(
            "Innovations are not white, the filter follows the noise: the largest correlation is -0.5"
        )
        assert "from one step to the next, of channel 1 with channel 1" in said
        assert whiteness_sentence(whiteness(np.zeros((2, 30, 1)), np.zeros((2, 30, 1, 1)))).startswith("No test")


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
        refused("members without weights", ensemble_crps, truth_, members, weights, fair=True)


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


def _said(problem, choice, data):
    return sentences(check_consistency(choice.filter(problem), data))[-1]


def test_outliers_name_the_robust_filter_and_no_constant_to_estimate():
    problem = find_scenario("outliers")
    said = _said(problem, noise_estimated("ekf", problem), problem.data(range(20)))
    assert "ekf-robust" in said and "--gate" in said and "--augment" not in said


def test_a_stuck_channel_is_named_and_a_normal_one_is_not():
    problem = LinearProblem(steps=200)
    data = problem.data(range(4))
    choice = oracle_choice("kf", problem)
    fine = check_consistency(choice.filter(problem), data)
    assert max(fine.repeats) < STUCK and max(fine.tails) < HEAVY
    stuck = data.measurements.copy()
    stuck[0, 60:150, 1] = stuck[0, 59, 1] if np.isfinite(stuck[0, 59, 1]) else 0.3
    said = _said(problem, choice, data._replace(measurements=stuck))
    assert "look at speed [m/s], which has 9" in said and "equal readings in a row" in said


def test_a_stretch_of_equal_readings_is_counted_and_missing_ones_are_not_equal():
    values = np.array([[[1.0], [1.0], [1.0], [np.nan], [np.nan], [2.0]]])
    assert longest_stretches(values).tolist() == [[3]]


def test_the_sample_time_is_no_constant_to_estimate():
    problem = find_scenario("nominal").replace(steps=200)
    report = check_consistency(oracle_choice("ekf", problem).filter(problem), problem.data(range(3)))
    changed = report._replace(constants=("dt", "lift"), whiteness=report.whiteness._replace(p_value=0.0))
    nees = changed.nees._replace(mean=changed.nees.mean._replace(value=9.0, low=8.0, high=10.0))
    said = sentences(changed._replace(nees=nees, tails=()))[-1]
    assert "it has lift)" in said and "dt" not in said
