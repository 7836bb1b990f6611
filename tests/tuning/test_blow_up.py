"""A model that diverges between samples is told its substeps and dt, by a study and on its page, not Q or R."""

import numpy as np
import pytest

import tuning
from filters import make_filter
from filters.consistency.nees import blow_up_sentence, root_mean_square
from filters.consistency.report import sentences
from thruster_env.model.affine import affine_model
from tuning.evaluation.evaluate import check_consistency
from tuning.problems.model_problem import RunsProblem
from tuning.reporting.tuning_report import as_json, report


def model(factor, r=1e9):
    return affine_model(
        a=[[factor]], b=[[1.0]], c=[[1.0]], process_noise_cov=[1e-2], measurement_noise_cov=[r],
        prior_mean=[0.0], prior_cov=[1.0], measurements=[("log speed", "z", "m/s")],
    )  # fmt: skip


def problem(factor):
    rng, runs = np.random.default_rng(0), []
    for _ in range(9):
        u, x = np.sign(rng.normal(size=80)), np.zeros(81)
        for k in range(80):
            x[k + 1] = 0.9 * x[k] + u[k]
        runs.append((u, x[:, None] + 0.1 * rng.normal(size=(81, 1))))
    return RunsProblem(runs, model(factor), dt=0.1, first_scored_step=5)


def test_a_study_of_a_model_that_blows_up_names_substeps_and_dt_and_not_more_trials():
    study = tuning.tune(problem(-3e4), "kf", trials=3, progress=False, consistent=False)
    said = " ".join(one for one in report(study) if isinstance(one, str))
    assert "diverges between samples" in said and "more substeps" in said and "dt = 0.1 s" in said
    assert "More trials" not in said and "What may help" not in said
    assert as_json(study)["blows_up"][0].startswith("The model diverges between samples: its prediction of")


@pytest.mark.parametrize("factor", [-3e4, 0.9])
def test_the_advice_of_the_page_is_substeps_where_it_blows_up_and_noise_elsewhere(factor):
    mine = problem(factor)
    data = mine.data(range(9))
    said = sentences(check_consistency(make_filter("kf", model(factor, 1e-4)), data, mine.dt))[-1]
    assert ("more substeps" in said and "dt = 0.1 s" in said and "raise" not in said) == (factor < 0)
    assert ("raise R" in said or "raise Q" in said) == (factor > 0)


def test_a_prediction_a_thousand_spreads_off_is_a_blow_up_and_numbers_beyond_all_too():
    z = np.array([[1.0], [-1.0], [np.nan]])
    for off, told in ((999.0, False), (1001.0, True), (1e300, True), (np.inf, True)):
        assert bool(blow_up_sentence(np.array([[off], [off], [np.nan]]), z, ["speed"])) == told
    assert root_mean_square(np.array([3e200, 4e200, np.nan])) == pytest.approx(12.5**0.5 * 1e200)
    assert blow_up_sentence(np.full((3, 1), np.nan), z, ["speed"], 0.1) == ""
