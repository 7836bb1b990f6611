"""The report on a filter: its numbers and sentences, and what it says of filters known to be right or wrong."""

import numpy as np
import pytest

from filters import EnsembleKalmanFilter, ExtendedKalmanFilter, KalmanFilter, UnscentedKalmanFilter, run
from filters.consistency.nees import Interval, gaussian_crps, mean_interval, normalized_squares, rmse_ratios
from filters.consistency.report import (
    confidence,
    consistency_report,
    coverage_sentence,
    crps_sentence,
    divergence_sentence,
    mean_sentence,
    remedy_sentence,
    rounded,
    sentences,
)
from filters.engine.batch import Estimates
from filters.ensembles.square_root import Members, record_members
from tests.models import scalar_model
from thruster_env.core.compiled import interpreted
from thruster_env.core.files import save_figure
from thruster_env.core.streams import episode_keys
from thruster_env.model import simulate
from tuning.api.held_out import comparison_sentence
from tuning.plants.thruster import find_scenario
from tuning.problems.data import held_out_seeds
from tuning.reporting.search_figures import draw_consistency


def scalar(**changes):
    """A model without input, for any number of runs."""
    arguments = {"b": np.zeros((1, 0)), "c": [[1.0]], "prior_mean": [0.0], "prior_cov": [1.0]}
    noise = {"process_noise_cov": [0.2], "measurement_noise_cov": [0.5]}
    return scalar_model(**{**arguments, **noise, **changes})


@pytest.fixture(scope="module")
def scalar_truth():
    with interpreted():
        return simulate.simulate(scalar(), episode_keys(range(40)), np.zeros((40, 150, 0)))


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


def test_where_errors_last_a_constant_as_a_state_comes_first_and_nothing_is_called_consistent(scalar_truth):
    report = scalar_report(scalar_truth, process_noise_cov=[0.02])
    assert report.nees.mean.low > 1 and report.whiteness.p_value < 0.05
    mild = report.whiteness._replace(correlations=0.1 * report.whiteness.correlations)
    expected = report.nis._replace(mean=report.nis.mean._replace(value=1.0))
    said = remedy_sentence(report._replace(nis=expected, whiteness=mild, constants=("outflow", "area")))
    assert said.startswith("To try: estimate a constant of the model that may be off (it has outflow, area) as")
    assert said.endswith("; or raise Q where nothing is measured, or repair the model there.")
    white = mild._replace(p_value=0.5)
    said = remedy_sentence(report._replace(nis=expected, whiteness=white))
    assert said.endswith("; the innovations are consistent.") and "constant" not in said


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
    with pytest.raises(ValueError, match="at least two runs"):
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
    assert said[-1] == "To try: more members; their ranks are right, but their covariance is a rough estimate."


def test_sentences_follow_their_numbers():
    assert confidence(Interval(2.05, 1.95, 2.1), 2) == "consistent"
    assert confidence(Interval(2.2, 2.1, 2.3), 2) == "slightly overconfident"
    assert confidence(Interval(1.0, 0.9, 1.1), 2) == "underconfident"
    assert mean_sentence("NEES", Interval(5.1, 4.9, 5.3), 2) == (
        "Overconfident: mean NEES 5.1 [4.9, 5.3] where 2 is right."
    )
    assert mean_sentence("NIS", Interval(np.nan, np.nan, np.nan), 1).startswith("No NIS")
    assert coverage_sentence("x", Interval(0.9, 0.89, 0.91)).endswith("90.0 % [89.0, 91.0] of cases: too rarely.")
    assert coverage_sentence("x", Interval(0.98, 0.97, 0.99)).endswith("more often than stated.")
    assert crps_sentence("x [m]", Interval(0.6, 0.5, 0.7), 0.3) == (
        "CRPS of x [m]: 0.6 [0.5, 0.7], 2 times its expected value under the covariance."
    )
    assert comparison_sentence("x", "ekf", "kf", Interval(0.9, 0.8, 0.95)).endswith("ekf is better.")
    assert comparison_sentence("x", "ekf", "kf", Interval(1.0, 0.9, 1.1)).endswith("a tie.")
    assert divergence_sentence(5, 3, 200) == (
        "3 of 200 runs diverged and restarted from the prior, 5 times in all."
    )
    assert [rounded(value) for value in (3460.4, 0.012345, 2e9)] == ["3460", "0.0123", "2e+09"]


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
            save_figure(draw_consistency(report, "a title"), tmp_path / "none.png")
    ratios = {"one\nover other": rmse_ratios(np.ones((40, 1)), np.full((40, 1), 2.0))}
    path = save_figure(draw_consistency(report, "a title", ratios), tmp_path / "new" / "calibrated.png")
    assert path.read_bytes().startswith(b"\x89PNG")
