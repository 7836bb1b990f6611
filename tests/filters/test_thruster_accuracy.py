"""Filters on the thruster: on the bound with its own noise; much better with parts where noise is large."""

import math
from functools import partial

import numpy as np
import pytest
from scipy.stats import chi2

from filters import (
    AuxiliaryParticleFilter,
    ExtendedKalmanFilter,
    GaussianSumFilter,
    ParticleFilter,
    make_filter,
    run,
    thruster_model,
)
from filters.consistency.nees import normalized_squares
from tests.models import held_voltages
from thruster_env.core.streams import episode_keys, filter_keys
from thruster_env.model import simulate
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


PUBLISHED = 30


@pytest.fixture(scope="module")
def published():
    """The model, inputs and truths; voltages are held for 0.25 s."""
    model, inputs = (
        thruster_model(process_noise_cov=[0.5, 0.5], measurement_noise_cov=0.5),
        held_voltages(PUBLISHED, 10),
    )
    return model, inputs, simulate.simulate(model, episode_keys(range(PUBLISHED)), inputs)


@pytest.mark.parametrize(
    "kind",
    [
        pytest.param(GaussianSumFilter, id="gsf"),
        pytest.param(partial(ParticleFilter, ensemble_size=1000), id="pf"),
        pytest.param(partial(AuxiliaryParticleFilter, ensemble_size=1000), id="apf", marks=pytest.mark.slow),
    ],
)
def test_it_halves_the_extended_filter_s_error_of_the_flow(published, kind):
    model, inputs, drawn = published
    squares = []
    for filter_ in (ExtendedKalmanFilter(model=model), kind(model=model)):
        estimates = run(filter_, filter_keys(range(PUBLISHED)), inputs, drawn.measurements)
        assert (estimates.divergences == 0).all()
        squares.append(((estimates.means - drawn.states)[:, 50:, 1] ** 2).mean(axis=1))
    gain = 0.25 * squares[0] - squares[1]  # positive on average if the RMSE is below half
    assert gain.mean() > 1.96 * gain.std(ddof=1) / math.sqrt(PUBLISHED)
