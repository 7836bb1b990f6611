"""What is said of a filter's consistency and of residuals, of filters and models known to be right or wrong."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import norm

import tuning
from filters import EnsembleKalmanFilter, ExtendedKalmanFilter, KalmanFilter, UnscentedKalmanFilter, run
from filters.consistency import report as words
from filters.consistency.nees import Interval, gaussian_crps, mean_interval, normalized_squares, rmse_ratios
from filters.engine.batch import Estimates
from filters.ensembles.square_root import Members, record_members
from filters.tuned_file import NOISE
from tests.filters.checks import refused
from tests.linear_problem import LinearProblem
from tests.models import scalar_model
from tests.tuning.methods.problems import drawn, linear
from tests.tuning.test_log_problem import GUESS, MODEL, R, logs_of
from thruster_env.core.compiled import interpreted
from thruster_env.core.files import save_figure
from thruster_env.core.streams import episode_keys
from thruster_env.model import simulate
from tuning.api.held_out import comparison_sentence
from tuning.api.report import known_table
from tuning.evaluation.baselines import log_densities
from tuning.evaluation.held_out import evaluate_held_out, summarised, summary
from tuning.evaluation.residuals import estimated_from, heavy_tails, tails_of, uneven_nis
from tuning.evaluation.tuned import comparison_as_data
from tuning.evaluation.worth import uneven_sentence, warnings_of
from tuning.likelihood.identifiability import as_data, identify
from tuning.likelihood.identifiability import sentences as determined_sentences
from tuning.plants.thruster import find_scenario
from tuning.problems.data import held_out_seeds
from tuning.problems.find import find_problem
from tuning.problems.log_problem import LogProblem
from tuning.problems.model_problem import RunsProblem
from tuning.reporting.choice_words import MADE_UP, consistency_of, model_doubts, residual_sentences
from tuning.reporting.search_figures import draw_consistency
from tuning.reporting.tuning_report import consistency_sentence
from tuning.search.plan import Plan
from tuning.search.space import Choice, untuned_choice


def scalar(**changes):
    """A model without input, for any number of runs."""
    arguments = {"b": np.zeros((1, 0)), "c": [[1.0]], "prior_mean": [0.0], "prior_cov": [1.0]}
    noise = {"process_noise_cov": [0.2], "measurement_noise_cov": [0.5]}
    return scalar_model(**{**arguments, **noise, **changes})


@pytest.fixture(scope="module")
def scalar_truth():
    with interpreted():
        return simulate.simulate(scalar(), episode_keys(range(40)), np.zeros((40, 150, 0)))


def scalar_estimates(drawn, **assumed):
    with interpreted():
        return run(
            KalmanFilter(model=scalar(**assumed)), np.zeros((40, 2)), np.zeros((40, 150, 0)), drawn.measurements
        )


def scalar_report(drawn, **assumed):
    return words.consistency_report(scalar_estimates(drawn, **assumed), drawn.states, first_step=20)


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
    assert words.remedy_sentence(scalar_report(scalar_truth, **assumed)) == remedy


def test_where_errors_last_a_constant_as_a_state_comes_first_and_nothing_is_called_consistent(scalar_truth):
    report = scalar_report(scalar_truth, process_noise_cov=[0.02])
    assert report.nees.mean.low > 1 and report.whiteness.p_value < 0.05
    mild = report.whiteness._replace(correlations=0.1 * report.whiteness.correlations)
    expected = report.nis._replace(mean=report.nis.mean._replace(value=1.0))
    said = words.remedy_sentence(report._replace(nis=expected, whiteness=mild, constants=("outflow", "area")))
    assert said.startswith("To try: estimate a constant of the model that may be off (it has outflow, area) as")
    assert said.endswith("; or raise Q where nothing is measured, or repair the model there.")
    white = mild._replace(p_value=0.5)
    said = words.remedy_sentence(report._replace(nis=expected, whiteness=white))
    assert said.endswith("; the innovations are consistent.") and "constant" not in said


def test_of_the_right_filter_every_sentence_is_good_news(scalar_truth):
    said = words.sentences(scalar_report(scalar_truth))
    assert len(said) == 8
    assert said[0].startswith("Consistent: mean NEES") and said[1].startswith("The distribution of NEES is that")
    assert said[4].startswith("Innovations are white")
    assert said[5].endswith("as it should.") and said[-1] == "No run diverged."


def test_a_report_has_the_numbers_of_its_parts(scalar_truth):
    report = scalar_report(scalar_truth)
    estimates = scalar_estimates(scalar_truth)
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
    estimates = scalar_estimates(scalar_truth._replace(measurements=measurements))
    report = words.consistency_report(estimates, scalar_truth.states, measurements)
    assert report.nis.dimension == 1 and report.nis.mean.covers(1.0) and report.whiteness.p_value > 0.01


def test_a_report_refuses_what_does_not_fit(scalar_truth):
    estimates = scalar_estimates(scalar_truth)
    with pytest.raises(ValueError, match="states must have the shape of the estimates"):
        words.consistency_report(estimates, scalar_truth.states[:, 1:])
    one = Estimates(*(part[:1] for part in estimates))
    refused("at least two runs", words.consistency_report, one, scalar_truth.states[:1])
    refused(
        "names must be 1, one a state", words.consistency_report, estimates, scalar_truth.states, names=("a", "b")
    )


def test_recorded_members_are_those_of_the_run(scalar_truth):
    filter_ = EnsembleKalmanFilter(model=scalar(), ensemble_size=8)
    given = episode_keys(range(3)), np.zeros((3, 20, 0)), scalar_truth.measurements[:3, :21]
    with interpreted():
        estimates, kept = run(filter_, *given), record_members(filter_, *given, first=2, every=5)
        refused("a filter with an ensemble, but got 'kf'", record_members, KalmanFilter(model=scalar()), *given)
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
    return words.consistency_report(estimates, states, members=Members(members, None, np.arange(steps)))


def test_a_small_ensemble_is_overconfident_though_its_members_are_right_and_is_told_to_grow():
    report = exchangeable(size=8)
    assert report.nees.mean.covers(7 / 5 * 9 / 8)  # Hotelling's T^2: (N - 1)/(N - 3) (1 + 1/N) for one state
    assert report.ensemble.size == 8 and len(report.ensemble.ranks[0].frequencies) == 9
    fair = 1 / np.sqrt(np.pi)
    assert report.ensemble.crps[0].covers(fair + fair / 8)  # that of N members is larger by the N-th part
    said = words.sentences(report)
    assert "that of the members themselves is 0.6" in said[6]
    assert said[7].startswith("Ranks of the truth among the 8 members, state 1: even")
    assert said[-1] == "To try: more members; their ranks are right, but their covariance is a rough estimate."


def test_sentences_follow_their_numbers():
    assert words.confidence(Interval(2.05, 1.95, 2.1), 2) == "consistent"
    assert words.confidence(Interval(2.2, 2.1, 2.3), 2) == "slightly overconfident"
    assert words.confidence(Interval(1.0, 0.9, 1.1), 2) == "underconfident"
    said = words.mean_sentence("NEES", Interval(5.1, 4.9, 5.3), 2)
    assert said == "Overconfident: mean NEES 5.1 [4.9, 5.3] where 2 is right."
    assert words.mean_sentence("NIS", Interval(np.nan, np.nan, np.nan), 1).startswith("No NIS")
    assert words.coverage_sentence("x", Interval(0.9, 0.89, 0.91)).endswith(
        "90.0 % [89.0, 91.0] of cases: too rarely."
    )
    assert words.coverage_sentence("x", Interval(0.98, 0.97, 0.99)).endswith("more often than stated.")
    said = words.crps_sentence("x [m]", Interval(0.6, 0.5, 0.7), 0.3)
    assert said == "CRPS of x [m]: 0.6 [0.5, 0.7], 2 times its expected value under the covariance."
    assert comparison_sentence("x", "ekf", "kf", Interval(0.9, 0.8, 0.95)).endswith("ekf is better.")
    assert comparison_sentence("x", "ekf", "kf", Interval(1.0, 0.9, 1.1)).endswith("a tie.")
    said = words.divergence_sentence(5, 3, 200)
    assert said == "3 of 200 runs diverged and restarted from the prior, 5 times in all."
    assert [words.rounded(value) for value in (3460.4, 0.012345, 2e9)] == ["3460", "0.0123", "2e+09"]


@pytest.fixture(scope="module")
def nominal():
    scenario = find_scenario("nominal")
    return scenario.model(), scenario.data(held_out_seeds(9, 200))


@pytest.mark.parametrize("kind", [ExtendedKalmanFilter, UnscentedKalmanFilter])
def test_on_the_thruster_a_filter_that_knows_the_plant_is_honest(nominal, kind):
    model, data = nominal
    estimates = run(kind(model=model), data.filter_keys, data.inputs, data.measurements)
    report = words.consistency_report(estimates, data.states, data.measurements, first_step=50)
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
        steps, covs = np.zeros((40, 151)), np.zeros((40, 151, 1, 1))
        nothing = Estimates(scalar_truth.states + 1.0, covs, np.zeros((40, 151, 1)), covs, steps, np.zeros(40))
        report = words.consistency_report(nothing, scalar_truth.states)
        assert words.sentences(report) == [
            "No NEES: the filter gives no covariance, or a singular one.",
            "No NIS: the filter gives no covariance, or a singular one.",
            "No test of whiteness: the filter gives no innovation covariance, or nothing was measured.",
            "No run diverged.",
        ]
        refused("needs something to draw", draw_consistency, report, "a title")
    ratios = {"one\nover other": rmse_ratios(np.ones((40, 1)), np.full((40, 1), 2.0))}
    path = save_figure(draw_consistency(report, "a title", ratios), tmp_path / "new" / "calibrated.png")
    assert path.read_bytes().startswith(b"\x89PNG")


def test_a_model_that_is_right_has_white_residuals_and_one_that_is_wrong_has_not():
    (said,) = residual_sentences(find_problem("nominal"))
    assert "look like white noise" in said
    (said,) = residual_sentences(find_problem("mismatch"))
    assert "w of omega_m (" in said and "v of thrust (" in said and "The model is wrong there" in said
    assert residual_sentences(LinearProblem(truth=False)) == []
    comparison = SimpleNamespace(tuned=SimpleNamespace(has_truth=True), given=None, over_regression=None)
    assert model_doubts(find_problem("nominal"), comparison) == []
    (said,) = model_doubts(find_problem("mismatch"), comparison)
    assert "correlate with the next step: +0.85 (w of omega_m), +0.84 (v of thrust), where 0 is right" in said


def test_the_numbers_are_those_of_the_residuals():
    right, wrong = np.array([[1.0, 0.3], [0.0, 0.9]]), np.array([[1.0, 0.3], [0.0, 0.5]])
    runs = drawn(right, np.eye(2), np.eye(2), np.eye(2), np.eye(2), 100, 8, 1)
    model = linear(a=wrong, c=np.eye(2)).model()
    problem = RunsProblem(runs, model, held_out=[6, 7], scale=(1.0, 1.0), name="wrong")
    (said,) = residual_sentences(problem)
    data = problem.data(problem.training_seeds(0, 32))
    w = (data.states[:, 1:] - data.states[:, :-1] @ wrong.T)[..., 1]
    correlation = np.corrcoef(w[:, :-1].ravel(), w[:, 1:].ravel())[0, 1]
    assert f"({w.mean() / w.std(ddof=1):+.2g}; {correlation:+.2g})" in said and correlation > 0.1


def test_channels_that_are_never_measured_twice_in_a_row_have_no_memory():
    runs = drawn(np.eye(2), np.eye(2), np.eye(2), np.eye(2), np.eye(2), 600, 8, 1)
    for one in runs:
        one["measurements"][::2, 1] = np.nan
    model, options = linear(a=np.eye(2), c=np.eye(2)).model(), {"held_out": [6, 7], "scale": (1.0, 1.0)}
    problem = RunsProblem(runs, model, **options, name="by turns")
    assert "look like white noise" in residual_sentences(problem)[0]


def comparison_of(model, runs, filter_q=None):
    """A tuned filter on logs without truth: the model with a Q, beside its baselines."""
    without_truth = [{"measurements": one["measurements"]} for one in runs]
    problem = RunsProblem(without_truth, model, held_out=[6, 7], name="logs")
    q = model.process_noise_cov if filter_q is None else np.diag(filter_q)
    rows = tuple(map(tuple, q.tolist())), tuple(map(tuple, model.measurement_noise_cov.tolist()))
    choice = Choice("kf", dict(zip(NOISE, rows, strict=True)), {})
    with interpreted():
        return problem, evaluate_held_out(choice, problem, 0)


def test_a_regression_has_the_densities_of_least_squares():
    runs = drawn(np.array([[0.9]]), np.eye(1), np.eye(1), 1e-4 * np.eye(1), np.eye(1), 300, 8, 1)
    problem = RunsProblem(
        [{"measurements": one["measurements"]} for one in runs],
        linear(a=[[0.9]], c=np.eye(1), q=np.eye(1), r=np.eye(1), p0=np.eye(1)).model(),
        held_out=[6, 7],
        name="one state",
    )
    training, data = (problem.data(seeds(0, 8)) for seeds in (problem.training_seeds, problem.held_out_seeds))
    found = log_densities(training, data, np.array([False]))[..., 0]
    z, others = training.measurements[..., 0], data.measurements[..., 0]
    past = np.column_stack([np.ones(z[:, 8:].size), z[:, 7:-1].ravel()])  # BIC chooses the true order, 1
    weights, squares, *_ = np.linalg.lstsq(past, z[:, 8:].ravel(), rcond=None)
    s = np.sqrt(squares[0] / (z[:, 8:].size - 2))
    predicted = weights[0] + weights[1] * others[:, :-1]
    np.testing.assert_allclose(found[:, 1:], norm.logpdf(others[:, 1:], predicted, s), rtol=1e-6)
    np.testing.assert_allclose(found[:, 0], norm.logpdf(others[:, 0], z.mean(), z.std()), rtol=1e-9)
    gone = np.arange(others.shape[1])[:, None] % 3 == 2
    missing = data._replace(measurements=np.where(gone, np.nan, data.measurements))
    without = log_densities(training, missing, np.array([False]))[..., 0]
    assert np.isnan(without[:, 2::3]).all()
    before = others[:, 1:-2:3][:, : others[:, 3::3].shape[1]]
    held = norm.logpdf(others[:, 3::3], weights[0] + weights[1] * before, s)
    np.testing.assert_allclose(without[:, 3::3], held, rtol=1e-6)  # from the last value before the gap
    short = data._replace(measurements=data.measurements[:, :4], inputs=data.inputs[:, :3])  # fewer rows than lags
    np.testing.assert_allclose(log_densities(training, short, np.array([False]))[..., 0], found[:, :4], rtol=1e-9)
    assert np.isnan(log_densities(short, data, np.array([False]))).all()


def test_a_wrong_model_is_asked_for_and_never_called_consistent():
    oscillator = 0.98 * np.array([[np.cos(0.5), np.sin(0.5)], [-np.sin(0.5), np.cos(0.5)]])
    noise, c = 0.01 * np.eye(2), np.array([[1.0, 0.0]])
    runs = drawn(oscillator, c, noise, [[0.01]], noise, 200, 8, 4)
    right = linear(a=oscillator, c=c, q=noise, r=[[0.01]], p0=noise).model()
    problem, comparison = comparison_of(right, runs)
    assert model_doubts(problem, comparison) == [] and consistency_sentence(comparison).startswith("Consistent: ")
    assert -0.02 < comparison.over_regression.value < 0.2
    wrong = linear(a=0.5 * np.eye(2), c=c, q=1e-4 * np.eye(2), r=[[0.01]], p0=noise).model()
    problem, comparison = comparison_of(wrong, runs, filter_q=[0.08, 0.08])
    assert comparison.tuned.nis.covers(1.0)
    said = consistency_sentence(comparison)
    assert said.startswith("Made consistent by Q and R, not by the model: mean NIS") and "onsistent:" not in said
    (doubt,) = model_doubts(problem, comparison)
    higher = "0.39 [0.17, 0.61] higher a measurement"
    regression = f"linear regression on past rows predicts with a log-likelihood {higher}"
    assert doubt == f"Is this model the right one? A {regression}."
    own = comparison._replace(tuned=comparison.tuned._replace(nis=comparison.given.nis))
    (doubt,) = model_doubts(problem, own)
    begins = "Is this model the right one? With its own Q and R the mean NIS is 16.2 where 1 is right; a "
    assert doubt == f"{begins}{regression}."
    assert consistency_of(comparison)[-1] == MADE_UP
    stored = comparison_as_data(comparison)["over_regression"]
    assert stored == list(comparison.over_regression)


BURST = slice(600, 700)


@pytest.fixture(scope="module")
def logs():
    return logs_of(1200, 1200, 1200)


@pytest.fixture(scope="module")
def dirty(logs):
    """The same logs with 10 s of garbage in the first one."""
    z = logs[0].measurements.copy()
    z[BURST, 0] += 15.0 * np.random.default_rng(0).standard_normal(100)
    return [replace(logs[0], measurements=z), *logs[1:]]


def with_r(factor, filter_="kf"):
    """A filter whose R is so many times the right one."""
    return Choice(filter_, {"process_noise_cov": (0.04,), "measurement_noise_cov": factor * R}, {})


def test_normal_residuals_have_no_heavy_tails_whether_or_not_they_are_correlated():
    rng, heavy = np.random.default_rng(0), 0
    for count in (50, 300, 3000):
        for _ in range(200):
            white = rng.standard_normal(count + 1)
            slow = np.empty_like(white)
            slow[0] = white[0]
            for k in range(count):
                slow[k + 1] = 0.95 * slow[k] + np.sqrt(1.0 - 0.95**2) * white[k + 1]
            heavy += tails_of(white).are_heavy + tails_of(slow).are_heavy
    assert heavy <= 6  # of 1200 samples with 0.1 % each: 1.2 expected; level 1e-3


def test_outliers_and_bursts_are_heavy_tails_however_much_they_raise_the_variance():
    rng = np.random.default_rng(1)
    for share, size in ((0.01, 10.0), (0.05, 100.0)):
        residuals = rng.standard_normal((2000, 2))
        residuals[: int(2000 * share), 1] *= size
        tails = heavy_tails(residuals, ("a", "b"))
        assert set(tails) == {"b"} and 0.3 * share < tails["b"] <= share + 1e-3
    assert tails_of(rng.standard_t(4.0, 2000)).are_heavy
    assert not tails_of(np.zeros(100)).are_heavy and not tails_of(np.full(9, np.nan)).are_heavy


def test_a_mean_nis_that_a_burst_carries_is_said_with_log_times_and_channel(logs, dirty):
    problem, clean = LogProblem(dirty, MODEL), LogProblem(logs, MODEL)
    assert uneven_nis(with_r(1.0).filter(clean), clean) is None
    uneven = uneven_nis(with_r(8.0).filter(problem), problem)
    assert uneven.mean > 0.7 and uneven.rest < 0.25 and uneven.carrying <= 4 and uneven.blocks >= 70
    said = uneven_sentence(uneven, 1)
    assert f"{uneven.carrying} of {uneven.blocks} blocks carry the mean NIS" in said
    assert "are of z_1, in run0 from 60" in said
    assert "so that R or Q is too large for the others" in said and "--outliers missing" in said
    comparison = evaluate_held_out(with_r(8.0), problem, 0)
    assert comparison.tuned.uneven == uneven and said in warnings_of(comparison.tuned, problem)
    stored = json.loads(json.dumps(summary(comparison.tuned)))
    assert summarised(stored, problem).uneven == uneven
    assert "uneven" not in summary(comparison.untuned)


def test_outliers_of_logs_are_left_out_by_an_option_and_r_is_that_of_the_sensor(dirty):
    study = tuning.tune(tuning.read_logs(dirty, model=GUESS, outliers="missing"), "kf", trials=4, progress=False)
    assert study.choice.model["measurement_noise_cov"] == pytest.approx(R, rel=0.3)
    assert study.held_out.evaluation.uneven is None and study.held_out.evaluation.nis.covers(1.0)
    remarks = study.problem.remarks
    assert "z_1 has a burst of outliers, 9" in remarks[0]
    assert remarks[1].startswith("Outliers are left out, as missing")
    problem = LogProblem(dirty, GUESS, outliers="missing")
    burst = problem.logs[0].measurements[BURST, 0]
    assert np.isnan(burst[2:-2]).all() and np.isfinite(problem.logs[1].measurements).all()
    assert problem.digest != LogProblem(dirty, GUESS).digest
    refused("outliers must be one of kept, missing, but got 'cut'", LogProblem, dirty, GUESS, outliers="cut")


def test_no_factor_is_stated_within_which_innovations_with_heavy_tails_determine_a_parameter(dirty, logs):
    problem = LogProblem(dirty, GUESS)
    plan = Plan("kf", (problem,), objectives=("likelihood",))
    known = identify(with_r(8.0), plan.scenarios, plan.training_data(), plan.space())
    (said,) = determined_sentences(known)
    assert "is not stated" in said and "of z_1 lie beyond four robust standard deviations" in said
    assert all(row["known_within_a_factor_of"] is None for row in as_data(known).values())
    assert len(known_table(known).columns) == 3
    plan = plan._replace(scenarios=(LogProblem(logs, GUESS),))
    known = identify(with_r(1.0), plan.scenarios, plan.training_data(), plan.space())
    assert "within a factor of" in determined_sentences(known)[0] and len(known_table(known).columns) == 5


def test_noise_estimation_calls_no_residuals_with_outliers_white():
    problem = LinearProblem()
    data = problem.data(problem.training_seeds(0, 32))
    model = problem.model(**untuned_choice("kf", problem).model)
    assert not estimated_from(model, data).tails and "look like white noise" in residual_sentences(problem)[0]
    z = data.measurements.copy()
    z[:, ::50, 0] += 30.0 * np.sqrt(model.measurement_noise_cov[0, 0])
    tails = estimated_from(model, data._replace(measurements=z)).tails
    assert list(tails) == [f"v of {model.measurements[0].symbol}"] and 0.01 < next(iter(tails.values())) < 0.03
