"""With the true noise on the nominal scenario, Gaussian filters sit on the bound and know how sure they may be."""

import numpy as np
import pytest
from scipy.stats import chi2

from filters import make_filter, run
from filters.consistency.nees import normalized_squares
from tuning.evaluation.evaluate import evaluate
from tuning.plants.thruster import find_scenario
from tuning.problems.data import FIRST_SCORED_STEP, held_out_seeds

RUNS = 200


@pytest.fixture(scope="module")
def nominal():
    scenario = find_scenario("nominal")
    data = scenario.data(held_out_seeds(5, RUNS))
    return scenario, data, scenario.bound(data)


@pytest.fixture(params=["ekf", "iekf", "ukf", "ckf"])
def filter_(request, nominal):
    scenario, _, _ = nominal
    return make_filter(request.param, scenario.model(**scenario.true))


def test_errors_are_within_five_per_cent_of_the_bound(nominal, filter_):
    scenario, data, bound = nominal
    evaluation = evaluate(filter_, data, scenario.scale)
    for rmse, limit in zip(evaluation.rmse, bound, strict=True):
        assert 0.98 * limit < rmse.value < 1.05 * limit  # 200 runs give an RMSE to about 1 %
    assert evaluation.divergences == 0
    assert evaluation.nees.low < 2.0 < evaluation.nees.high
    assert evaluation.nis.low < 1.0 < evaluation.nis.high


def test_nine_tenths_of_the_steps_have_their_squares_inside_the_band(nominal, filter_):
    _, data, _ = nominal
    estimates = run(filter_, data.filter_keys, data.inputs, data.measurements)
    parts = (
        (data.states - estimates.means, estimates.covs, 2),
        (estimates.innovations, estimates.innovation_covs, 1),
    )
    for errors, covs, dimension in parts:
        late = normalized_squares(errors, covs)[:, FIRST_SCORED_STEP:].mean(axis=0)
        low, high = chi2.ppf([0.025, 0.975], RUNS * dimension) / RUNS
        assert np.mean((low < late) & (late < high)) > 0.9
