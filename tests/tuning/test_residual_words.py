"""What residuals of true states say of a model."""

from types import SimpleNamespace

import numpy as np
from scipy.stats import norm

from filters.tuned_file import NOISE
from tests.linear_problem import LinearProblem
from tests.tuning.methods.problems import drawn, linear
from thruster_env.core.compiled import interpreted
from tuning.evaluation.baselines import log_densities
from tuning.evaluation.held_out import evaluate_held_out
from tuning.evaluation.tuned import comparison_as_data
from tuning.problems.find import find_problem
from tuning.problems.model_problem import RunsProblem
from tuning.reporting.choice_words import MADE_UP, consistency_of, model_doubts, residual_sentences
from tuning.reporting.tuning_report import consistency_sentence
from tuning.search.space import Choice


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
    higher = "0.39 [0.36, 0.41] higher a measurement"
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
