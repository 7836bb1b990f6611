"""Checks of a filter's honesty: closed forms, naive computations, and data whose honesty is known."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import chi2, kstest, norm

from filters import (
    EnsembleKalmanFilter,
    ExtendedKalmanFilter,
    KalmanFilter,
    UnscentedKalmanFilter,
    affine_model,
    run,
    truth,
)
from filters.batch import Estimates
from filters.consistency.intervals import Interval, mean_interval, rmse_intervals, rmse_ratios
from filters.consistency.nees import check_squares, normalized_squares
from filters.consistency.report import consistency_report
from filters.consistency.scores import (
    covered,
    ensemble_crps,
    ensemble_ranks,
    expected_gaussian_crps,
    gaussian_crps,
)
from filters.consistency.uniformity import uniformity
from filters.consistency.verdicts import (
    comparison_sentence,
    confidence,
    coverage_sentence,
    crps_sentence,
    divergence_sentence,
    mean_sentence,
    ranks_verdict,
    remedy_sentence,
    rounded,
    sentences,
    whiteness_sentence,
)
from filters.consistency.whiteness import whiteness
from filters.ensembles.recording import Members, record_members
from thruster_env.compiled import interpreted
from thruster_env.streams import episode_keys
from tuning.consistency_figures import consistency_figure
from tuning.scenarios import find_scenario, held_out_seeds

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
        with pytest.raises(ValueError, match="the same runs and states"):
            rmse_ratios(a, b[1:])


class TestSquares:
    def test_an_honest_filter_passes(self):
        check = check_squares("NEES", *honest_errors(200, 300))
        assert check.dimension == 2 and check.mean.covers(2.0) and check.beyond.covers(0.05)
        assert 0.92 < check.share_inside < 0.98  # 300 steps: 0.95 and two and a half standard errors
        assert check.distribution.p_value > 0.01
        np.testing.assert_allclose(check.band[0], chi2.ppf([0.025, 0.975], 400) / 200, rtol=1e-9)

    @pytest.mark.parametrize("factor", [0.5, 2.0])
    def test_a_covariance_off_by_a_factor_is_found(self, factor):
        errors, covs = honest_errors(100, 100)
        honest, check = check_squares("NEES", errors, covs), check_squares("NEES", errors, factor * covs)
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
        check = check_squares("NIS", np.where(present, errors, 0.0), covs, present)
        counted = present.any(axis=-1)
        assert check.dimension == pytest.approx(present.sum() / counted.sum())
        assert check.mean.covers(check.dimension)
        assert np.isnan(check.step_means[7]) and np.isnan(check.band[7]).all()
        total, runs = present[:, 3].sum(), counted[:, 3].sum()
        np.testing.assert_allclose(check.band[3], chi2.ppf([0.025, 0.975], total) / runs, rtol=1e-9)
        assert 0.85 < check.share_inside <= 1.0

    def test_without_covariances_there_is_nothing_to_check(self):
        errors, covs = honest_errors(30, 40)
        check = check_squares("NEES", errors, 0.0 * covs)
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


class TestScores:
    @pytest.mark.parametrize(("error", "deviation"), [(0.0, 1.0), (1.3, 0.7), (-4.0, 2.0)])
    def test_the_gaussian_crps_is_its_integral(self, error, deviation):
        # forecast N(error, deviation^2), truth 0
        below, _ = quad(lambda x: norm.cdf(x, error, deviation) ** 2, -30, 0)
        above, _ = quad(lambda x: norm.sf(x, error, deviation) ** 2, 0, 30)
        assert gaussian_crps(np.array(error), np.array(deviation)) == pytest.approx(below + above, rel=1e-7)

    def test_of_a_right_forecast_it_is_the_deviation_over_the_root_of_pi(self):
        errors = np.random.default_rng(7).normal(0.0, 1.7, size=200_000)
        score = gaussian_crps(errors, np.full(errors.shape, 1.7))
        assert score.mean() == pytest.approx(expected_gaussian_crps(1.7), abs=4 * score.std() / np.sqrt(200_000))
        assert gaussian_crps(np.array(-2.5), np.array(0.0)) == 2.5

    @pytest.mark.parametrize("weighted", [False, True])
    def test_the_ensemble_crps_is_the_naive_double_sum(self, weighted):
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

    def test_the_fair_score_does_not_depend_on_the_size(self):
        rng = np.random.default_rng(9)
        for size in (3, 30):
            score = ensemble_crps(rng.normal(size=40_000), rng.normal(size=(40_000, size)), fair=True)
            assert score.mean() == pytest.approx(1 / np.sqrt(np.pi), abs=4 * score.std() / 200)

    def test_coverage_is_that_of_the_normal_distribution(self):
        errors = np.random.default_rng(10).normal(size=100_000)
        for level, deviation in ((0.95, 1.0), (0.95, 0.5), (0.5, 1.0)):
            expected = 2 * norm.cdf(deviation * norm.ppf(0.5 + level / 2)) - 1
            assert covered(errors, np.full(errors.shape, deviation), level).mean() == pytest.approx(
                expected, abs=0.007
            )
        assert np.isnan(covered(np.ones(1), np.zeros(1))).all()

    def test_ranks_count_the_members_below(self):
        members = np.array([[0.0, 1.0, 2.0], [5.0, 4.0, 6.0]])
        np.testing.assert_allclose(ensemble_ranks(np.array([1.5, 3.0]), members), [2.5 / 4, 0.5 / 4])
        equal = np.full((2, 3), 1 / 3)
        np.testing.assert_allclose(ensemble_ranks(np.array([1.5, 3.0]), members, equal), [2.5 / 4, 0.5 / 4])

    @pytest.mark.parametrize(
        ("spread", "shift", "word"),
        [(1.0, 0.0, "even"), (0.6, 0.0, "too close"), (1.7, 0.0, "too far"), (1.0, 0.7, "too high")],
    )
    def test_rank_histograms_tell_how_members_are_wrong(self, spread, shift, word):
        rng = np.random.default_rng(11)
        ranks = ensemble_ranks(rng.normal(size=(60, 50)), shift + spread * rng.normal(size=(60, 50, 10)))
        found = uniformity(ranks, steps=11)
        assert len(found.frequencies) == 11 and word in ranks_verdict(found)


def scalar(**changes):
    arguments = {
        "a": [[0.9]],
        "b": np.zeros((1, 0)),
        "c": [[1.0]],
        "process_noise_cov": [0.2],
        "measurement_noise_cov": [0.5],
        "prior_mean": [0.0],
        "prior_cov": [1.0],
    }
    return affine_model(**{**arguments, **changes})


@pytest.fixture(scope="module")
def scalar_truth():
    with interpreted():
        return truth.simulate(scalar(), episode_keys(range(40)), np.zeros((40, 150, 0)))


def scalar_report(drawn, **assumed):
    filter_ = KalmanFilter(model=scalar(**assumed))
    with interpreted():
        estimates = run(filter_, np.zeros((40, 2)), np.zeros((40, 150, 0)), drawn.measurements)
    return consistency_report(estimates, drawn.states, first_step=20)


@pytest.mark.parametrize(
    ("assumed", "remedy"),
    [
        ({}, ""),
        ({"process_noise_cov": [0.02]}, "To try: raise Q, or repair the model."),
        ({"process_noise_cov": [4.0]}, "To try: lower Q."),
        ({"measurement_noise_cov": [0.05]}, "To try: raise R."),
        ({"measurement_noise_cov": [6.0]}, "To try: lower R."),
        ({"process_noise_cov": [0.06], "measurement_noise_cov": [0.15]}, "To try: raise Q and R alike."),
        ({"process_noise_cov": [0.6], "measurement_noise_cov": [1.5]}, "To try: lower Q and R alike."),
    ],
)
def test_the_remedy_undoes_what_was_done(scalar_truth, assumed, remedy):
    assert remedy_sentence(scalar_report(scalar_truth, **assumed)) == remedy


def test_of_the_right_filter_every_sentence_is_good_news(scalar_truth):
    said = sentences(scalar_report(scalar_truth))
    assert len(said) == 8
    for sentence, beginning in zip(
        said, ("Consistent: mean NEES", "The distribution of NEES is that"), strict=False
    ):
        assert sentence.startswith(beginning)
    assert said[4].startswith("Innovations are white")
    assert said[5].endswith("as it should.") and said[-1] == "No run diverged."


def test_a_report_has_the_numbers_of_its_parts(scalar_truth):
    report = scalar_report(scalar_truth)
    with interpreted():
        estimates = run(
            KalmanFilter(model=scalar()), np.zeros((40, 2)), np.zeros((40, 150, 0)), scalar_truth.measurements
        )
    errors, covs = (estimates.means - scalar_truth.states)[:, 20:], estimates.covs[:, 20:]
    assert report.nees.mean.value == pytest.approx(normalized_squares(errors, covs).mean())
    deviations = np.sqrt(covs[..., 0, 0])
    assert report.coverage[0].value == pytest.approx((np.abs(errors[..., 0]) < 1.959964 * deviations).mean())
    assert report.coverage_by_level.shape == (19, 1)
    np.testing.assert_allclose(report.coverage_by_level[-1], report.coverage[0].value)
    assert report.crps[0].value == pytest.approx(gaussian_crps(errors[..., 0], deviations).mean())
    assert report.crps_ratio.shape == (131, 1) and report.crps_ratio.mean() == pytest.approx(1.0, abs=0.05)
    assert (report.runs, report.first_step, report.divergences, report.states) == (40, 20, 0, ("state 1",))


def test_missing_measurements_lower_the_right_mean_of_no_check(scalar_truth):
    measurements = scalar_truth.measurements.copy()
    measurements[np.random.default_rng(0).random(measurements.shape) < 0.4] = np.nan
    given = episode_keys(range(40)), np.zeros((40, 150, 0)), measurements
    with interpreted():
        estimates = run(KalmanFilter(model=scalar()), *given)
    report = consistency_report(estimates, scalar_truth.states, measurements)
    assert report.nis.dimension == 1 and report.nis.mean.covers(1.0) and report.whiteness.p_value > 0.01


def test_a_report_refuses_what_does_not_fit(scalar_truth):
    with interpreted():
        estimates = run(
            KalmanFilter(model=scalar()), np.zeros((40, 2)), np.zeros((40, 150, 0)), scalar_truth.measurements
        )
    with pytest.raises(ValueError, match="states must have the shape of the estimates"):
        consistency_report(estimates, scalar_truth.states[:, 1:])
    one = Estimates(*(part[:1] for part in estimates))
    with pytest.raises(ValueError, match="with at least two runs"):
        consistency_report(one, scalar_truth.states[:1])
    with pytest.raises(ValueError, match="names must be 1, one a state"):
        consistency_report(estimates, scalar_truth.states, names=("a", "b"))


def test_recorded_members_are_those_of_the_run(scalar_truth):
    filter_ = EnsembleKalmanFilter(model=scalar(), ensemble_size=8)
    given = episode_keys(range(3)), np.zeros((3, 20, 0)), scalar_truth.measurements[:3, :21]
    with interpreted():
        estimates, kept = run(filter_, *given), record_members(filter_, *given, first=2, every=5)
        with pytest.raises(ValueError, match="a filter with an ensemble, but got 'kf'"):
            record_members(KalmanFilter(model=scalar()), *given)
    np.testing.assert_array_equal(kept.steps, [2, 7, 12, 17])
    assert kept.members.shape == (3, 4, 1, 8) and kept.weights is None
    np.testing.assert_allclose(kept.members.mean(axis=-1), estimates.means[:, kept.steps], rtol=1e-12)
    np.testing.assert_allclose(kept.members.var(axis=-1, ddof=1)[..., 0], estimates.covs[:, kept.steps, 0, 0])


def exchangeable(size, runs=60, steps=80):
    """A report on ensembles whose members are drawn as the truth is, and whose innovations are right."""
    rng = np.random.default_rng(12)
    states, members = rng.normal(size=(runs, steps, 1)), rng.normal(size=(runs, steps, 1, size))
    estimates = Estimates(
        members.mean(axis=-1),
        members.var(axis=-1, ddof=1)[..., None],
        rng.normal(size=(runs, steps, 1)),
        np.ones((runs, steps, 1, 1)),
        np.zeros((runs, steps)),
        np.zeros(runs),
    )
    return consistency_report(estimates, states, members=Members(members, None, np.arange(steps)))


def test_a_small_ensemble_is_overconfident_though_its_members_are_right_and_is_told_to_grow():
    report = exchangeable(size=8)
    assert report.nees.mean.covers(7 / 5 * 9 / 8)  # Hotelling's T^2: (N - 1)/(N - 3) (1 + 1/N) for one state
    assert report.ensemble.size == 8 and len(report.ensemble.ranks[0].frequencies) == 9
    fair = 1 / np.sqrt(np.pi)
    assert report.ensemble.crps[0].covers(fair + fair / 8)  # that of N members is larger by the N-th part
    said = sentences(report)
    assert "that of the members themselves is 0.6" in said[6]
    assert said[7].startswith("Ranks of the truth among the 8 members, state 1: even")
    assert (
        said[-1] == "To try: more members; their ranks are right, it is their covariance that is a rough estimate."
    )


def test_sentences_follow_their_numbers():
    assert confidence(Interval(2.05, 1.95, 2.1), 2) == "consistent"
    assert confidence(Interval(2.2, 2.1, 2.3), 2) == "slightly overconfident"
    assert confidence(Interval(1.0, 0.9, 1.1), 2) == "underconfident"
    assert mean_sentence("NEES", Interval(5.1, 4.9, 5.3), 2) == (
        "Overconfident: mean NEES 5.1 [4.9, 5.3] where 2 is right."
    )
    assert mean_sentence("NIS", Interval(np.nan, np.nan, np.nan), 1).startswith("No NIS")
    assert coverage_sentence("x", Interval(0.9, 0.89, 0.91)).endswith("90.0 % [89.0, 91.0] of cases: too rarely.")
    assert coverage_sentence("x", Interval(0.98, 0.97, 0.99)).endswith("more often than it says.")
    assert crps_sentence("x [m]", Interval(0.6, 0.5, 0.7), 0.3) == (
        "CRPS of x [m]: 0.6 [0.5, 0.7], 2 times what the covariance promises."
    )
    assert comparison_sentence("x", "ekf", "kf", Interval(0.9, 0.8, 0.95)).endswith("ekf is better.")
    assert comparison_sentence("x", "ekf", "kf", Interval(1.0, 0.9, 1.1)).endswith("a tie.")
    assert divergence_sentence(5, 3, 200) == (
        "3 of 200 runs diverged and restarted from the prior, 5 times in all."
    )
    assert [rounded(value) for value in (3460.4, 0.012345, 2e9)] == ["3460", "0.0123", "2e+09"]


def test_the_sentence_on_whiteness_names_channels_and_lag():
    v = np.stack([correlated(40, 100, -0.5), correlated(40, 100, 0.0, seed=1)], axis=-1)
    said = whiteness_sentence(whiteness(v, np.broadcast_to(np.eye(2), (40, 100, 2, 2)), lags=3))
    assert said.startswith(
        "Innovations are not white, the filter follows the noise: the largest correlation is -0.5"
    )
    assert "from one step to the next, of channel 1 with channel 1" in said
    assert whiteness_sentence(whiteness(np.zeros((2, 30, 1)), np.zeros((2, 30, 1, 1)))).startswith("No test")


@pytest.fixture(scope="module")
def nominal():
    scenario = find_scenario("nominal")
    return scenario.model(), scenario.data(held_out_seeds(9, 200))


@pytest.mark.parametrize("kind", [ExtendedKalmanFilter, UnscentedKalmanFilter])
def test_on_the_thruster_a_filter_that_knows_the_plant_is_honest(nominal, kind):
    model, data = nominal
    estimates = run(kind(model=model), data.filter_keys, data.inputs, data.measurements)
    report = consistency_report(estimates, data.states, data.measurements, first_step=50)
    for check in (report.nees, report.nis):
        assert check.share_inside >= 0.9 and check.mean.covers(check.dimension)
    assert report.whiteness.p_value > 0.01
    for coverage in report.coverage:
        assert coverage.value == pytest.approx(0.95, abs=0.01)


def test_an_ensemble_s_overconfidence_shrinks_like_one_over_its_size(nominal):
    model, data = nominal
    sizes, excess = np.array([50, 100, 200]), []
    for size in sizes:
        filter_ = EnsembleKalmanFilter(model=model, ensemble_size=int(size))
        estimates = run(filter_, data.filter_keys, data.inputs, data.measurements)
        squares = normalized_squares((estimates.means - data.states)[:, 50:], estimates.covs[:, 50:])
        excess.append(mean_interval(squares).value - 2.0)
    assert 0.06 < excess[1] < 0.16  # about 2.11 at N = 100
    slope = np.polyfit(np.log(sizes), np.log(excess), 1)[0]
    assert -1.5 < slope < -0.7


@pytest.mark.parametrize("kind", ["exact", "ensemble", "without covariance"])
def test_the_figure_is_drawn(scalar_truth, kind, tmp_path):
    report = exchangeable(size=30, runs=20) if kind == "ensemble" else scalar_report(scalar_truth)
    if kind == "without covariance":
        nothing = Estimates(
            scalar_truth.states + 1.0,
            np.zeros((40, 151, 1, 1)),
            np.zeros((40, 151, 1)),
            np.zeros((40, 151, 1, 1)),
            np.zeros((40, 151)),
            np.zeros(40),
        )
        report = consistency_report(nothing, scalar_truth.states)
        assert sentences(report) == [
            "No NEES: the filter gives no covariance, or a singular one.",
            "No NIS: the filter gives no covariance, or a singular one.",
            "No test of whiteness: the filter gives no innovation covariance, or nothing was measured.",
            "No run diverged.",
        ]
        with pytest.raises(ValueError, match="needs something to draw"):
            consistency_figure(tmp_path / "none.png", report, "a title")
    ratios = {"one\nover other": rmse_ratios(np.ones((40, 1)), np.full((40, 1), 2.0))}
    path = consistency_figure(tmp_path / "new" / "honest.png", report, "a title", ratios)
    assert path.read_bytes().startswith(b"\x89PNG")
