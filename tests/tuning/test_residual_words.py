"""What residuals of true states say of a model."""

import numpy as np

from tests.linear_problem import LinearProblem
from tests.tuning.ways.problems import drawn, linear
from tuning.problems.find import find_problem
from tuning.problems.runs_problem import RunsProblem
from tuning.reporting.residual_words import residual_sentences


def test_a_model_that_is_right_has_white_residuals_and_one_that_is_wrong_has_not():
    (said,) = residual_sentences(find_problem("nominal"))
    assert "nothing speaks against the model" in said
    (said,) = residual_sentences(find_problem("mismatch"))
    assert "w of omega_m (" in said and "v of thrust (" in said and "the model is wrong there" in said
    assert residual_sentences(LinearProblem(truth=False)) == []


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
    assert "nothing speaks against the model" in residual_sentences(problem)[0]
