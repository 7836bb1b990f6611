"""Reports of runs with few scored steps, and bounds of large models whose runs differ in length."""

import numpy as np
import pytest

import tuning
from filters import affine_model, bounds, make_filter
from filters.bounds import posterior_variances
from tests.linear_problem import LinearProblem
from tuning.evaluation.evaluate import check_consistency
from tuning.problems.data import Data, mask_of
from tuning.problems.model_problem import average_bound


@pytest.mark.parametrize(("scored", "lags"), [(40, 20), (21, 20), (11, 10), (2, 1), (1, 1)])
def test_a_consistency_report_has_as_many_lags_as_its_steps_allow(scored, lags):
    problem = LinearProblem(steps=60, first_scored=61 - scored)
    found = check_consistency(make_filter("kf", problem.model()), problem.data(range(6)))
    assert len(found.whiteness.correlations) == lags and np.isnan(found.whiteness.p_value) == (scored == 1)


@pytest.mark.slow
def test_the_page_of_runs_of_sixty_steps_is_written(tmp_path):
    problem = LinearProblem(steps=60, first_scored=50)
    study = tuning.tune(problem, "kf", trials=3, progress=False)
    page = tuning.report(study, tmp_path / "short.html").page
    assert "Is the covariance consistent?" in page.read_text()


def chain(n):
    """A stable chain of n states, the first of which is measured."""
    a = 0.9 * np.eye(n) + 0.05 * np.eye(n, k=1)
    return affine_model(
        a=a, b=np.ones((n, 1)), c=np.eye(n)[:1], process_noise_cov=0.1 * np.eye(n), measurement_noise_cov=[0.2],
        prior_mean=np.zeros(n), prior_cov=np.eye(n),
    )  # fmt: skip


@pytest.mark.parametrize("same", [True, False])
def test_the_bound_of_a_large_model_is_over_the_scored_steps_of_the_sequences_taken(monkeypatch, same):
    lengths, model, rng = (20, 12, 31, 17), chain(13), np.random.default_rng(0)
    monkeypatch.setattr(bounds, "MOST_WORK", 2 * 2 * 30 * 13**3)
    inputs = np.zeros((4, 30, 1)) if same else rng.normal(size=(4, 30, 1))
    counted = mask_of(lengths, 31)
    data = Data((0, 1, 2, 3), inputs, np.zeros((4, 31, 1)), np.zeros((4, 2)), 5, counted=counted)
    found = average_bound(model, data, truths=2)
    each = posterior_variances(model, data.seen.inputs, truths=2)  # a linear model's do not follow from inputs
    assert len(each) == (1 if same else 2)
    taken = range(4) if same else (0, 2)
    rows = np.concatenate([each[0, 5 : lengths[place]] for place in taken])
    np.testing.assert_allclose(found, np.sqrt(rows.mean(axis=0)), rtol=1e-9)
