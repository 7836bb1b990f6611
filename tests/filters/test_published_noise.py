"""With the noise of the published study, filters of many parts are much better than the extended one."""

import math
from functools import partial

import pytest

from filters import (
    AuxiliaryParticleFilter,
    ExtendedKalmanFilter,
    GaussianSumFilter,
    ParticleFilter,
    run,
    thruster_model,
)
from tests.models import held_voltages
from thruster_env.core.streams import episode_keys, filter_keys
from thruster_env.model import simulate

RUNS = 30


@pytest.fixture(scope="module")
def published():
    """The model, inputs and truths; voltages are held for 0.25 s."""
    model, inputs = (
        thruster_model(process_noise_cov=[0.5, 0.5], measurement_noise_cov=0.5),
        held_voltages(RUNS, 10),
    )
    return model, inputs, simulate.simulate(model, episode_keys(range(RUNS)), inputs)


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
        estimates = run(filter_, filter_keys(range(RUNS)), inputs, drawn.measurements)
        assert (estimates.divergences == 0).all()
        squares.append(((estimates.means - drawn.states)[:, 50:, 1] ** 2).mean(axis=1))
    gain = 0.25 * squares[0] - squares[1]  # positive on average if the RMSE is below half
    assert gain.mean() > 1.96 * gain.std(ddof=1) / math.sqrt(RUNS)
