"""What residuals say of a model, and of bursts of garbage in logs, which are left out."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import norm

import tuning
from filters.tuned_file import NOISE
from tests.linear_problem import LinearProblem
from tests.tuning.methods.problems import drawn, linear
from tests.tuning.test_log_problem import GUESS, MODEL, R, logs_of
from thruster_env.core.compiled import interpreted
from tuning.api.report import known_table
from tuning.evaluation.baselines import log_densities
from tuning.evaluation.held_out import evaluate_held_out, summarised, summary
from tuning.evaluation.residuals import estimated_from, heavy_tails, tails_of, uneven_nis
from tuning.evaluation.tuned import comparison_as_data
from tuning.evaluation.worth import uneven_sentence, warnings_of
from tuning.likelihood.identifiability import as_data, identify, sentences
from tuning.problems.find import find_problem
from tuning.problems.log_problem import LogProblem
from tuning.problems.model_problem import RunsProblem
from tuning.reporting.choice_words import MADE_UP, consistency_of, model_doubts, residual_sentences
from tuning.reporting.tuning_report import consistency_sentence
from tuning.search.plan import Plan
from tuning.search.space import Choice, untuned_choice


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
    problem = RunsProblem(
        runs, linear(a=np.eye(2), c=np.eye(2)).model(), held_out=[6, 7], scale=(1.0, 1.0), name="by turns"
    )
    assert "look like white noise" in residual_sentences(problem)[0]


def comparison_of(model, runs, filter_q=None):
    """A tuned filter on logs without truth: the model with a Q, beside its baselines."""
    problem = RunsProblem(
        [{"measurements": one["measurements"]} for one in runs], model, held_out=[6, 7], name="logs"
    )
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
    np.testing.assert_allclose(
        found[:, 1:], norm.logpdf(others[:, 1:], weights[0] + weights[1] * others[:, :-1], s), rtol=1e-6
    )
    np.testing.assert_allclose(found[:, 0], norm.logpdf(others[:, 0], z.mean(), z.std()), rtol=1e-9)
    missing = data._replace(
        measurements=np.where(np.arange(others.shape[1])[:, None] % 3 == 2, np.nan, data.measurements)
    )
    without = log_densities(training, missing, np.array([False]))[..., 0]
    assert np.isnan(without[:, 2::3]).all()
    held = norm.logpdf(
        others[:, 3::3], weights[0] + weights[1] * others[:, 1:-2:3][:, : others[:, 3::3].shape[1]], s
    )
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
    assert doubt == (
        f"Is this model the right one? With its own Q and R the mean NIS is 16.2 where 1 is right; a {regression}."
    )
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
    assert (
        f"{uneven.carrying} of {uneven.blocks} blocks carry the mean NIS" in said
        and "are of z_1, in run0 from 60" in said
    )
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
    assert "z_1 has a burst of outliers, 9" in remarks[0] and remarks[1].startswith(
        "Outliers are left out, as missing"
    )
    problem = LogProblem(dirty, GUESS, outliers="missing")
    burst = problem.logs[0].measurements[BURST, 0]
    assert np.isnan(burst[2:-2]).all() and np.isfinite(problem.logs[1].measurements).all()
    assert problem.digest != LogProblem(dirty, GUESS).digest
    with pytest.raises(ValueError, match="outliers must be one of kept, missing, but got 'cut'"):
        LogProblem(dirty, GUESS, outliers="cut")


def test_no_factor_is_stated_within_which_innovations_with_heavy_tails_determine_a_parameter(dirty, logs):
    problem = LogProblem(dirty, GUESS)
    plan = Plan("kf", (problem,), objectives=("likelihood",))
    known = identify(with_r(8.0), plan.scenarios, plan.training_data(), plan.space())
    (said,) = sentences(known)
    assert "is not stated" in said and "of z_1 lie beyond four robust standard deviations" in said
    assert all(row["known_within_a_factor_of"] is None for row in as_data(known).values())
    assert len(known_table(known).columns) == 3
    plan = plan._replace(scenarios=(LogProblem(logs, GUESS),))
    known = identify(with_r(1.0), plan.scenarios, plan.training_data(), plan.space())
    assert "within a factor of" in sentences(known)[0] and len(known_table(known).columns) == 5


def test_noise_estimation_calls_no_residuals_with_outliers_white():
    problem = LinearProblem()
    data = problem.data(problem.training_seeds(0, 32))
    model = problem.model(**untuned_choice("kf", problem).model)
    assert not estimated_from(model, data).tails and "look like white noise" in residual_sentences(problem)[0]
    z = data.measurements.copy()
    z[:, ::50, 0] += 30.0 * np.sqrt(model.measurement_noise_cov[0, 0])
    tails = estimated_from(model, data._replace(measurements=z)).tails
    assert list(tails) == [f"v of {model.measurements[0].symbol}"] and 0.01 < next(iter(tails.values())) < 0.03
