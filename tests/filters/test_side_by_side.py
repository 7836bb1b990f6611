"""Batches that work on many trajectories side by side give what each trajectory gives by itself."""

import numpy as np
import pytest

from filters import ExtendedKalmanFilter, SageHusaFilter, UnscentedKalmanFilter, run, thruster_model
from filters.engine.compile import GROUPS
from thruster_env.core.compiled import interpreted
from thruster_env.core.streams import episode_keys
from thruster_env.model import simulate
from thruster_env.model.shape import LANES

BLOCK = GROUPS * LANES
COUNTS = [1, LANES - 1, LANES, LANES + 1, BLOCK, BLOCK + 1, 3 * BLOCK + 5]


def simulated(count, steps=12):
    model = thruster_model()
    inputs = np.random.default_rng(4).uniform(-12, 12, size=(count, steps, 1))
    with interpreted():
        drawn = simulate.simulate(model, episode_keys(range(count)), inputs)
    return model, (np.zeros((count, 2)), inputs, drawn.measurements)


@pytest.mark.parametrize("kind", [ExtendedKalmanFilter, UnscentedKalmanFilter, SageHusaFilter])
def test_blocks_that_are_full_or_not_hold_the_same_estimates(kind):
    model, data = simulated(max(COUNTS))
    data[2][3, 5] = np.nan
    together = run(kind(model=model), *data)
    for count in COUNTS:
        for part, of_all in zip(run(kind(model=model), *(array[:count] for array in data)), together, strict=True):
            np.testing.assert_array_equal(part, of_all[:count])
    with interpreted():
        one_by_one = run(kind(model=model), *(array[:5] for array in data))
    for part, of_all in zip(one_by_one, together, strict=True):
        np.testing.assert_allclose(part, of_all[:5], rtol=1e-12, atol=1e-12)


def test_what_one_trajectory_loses_no_other_misses():
    model, (keys, inputs, z) = simulated(BLOCK)
    before = run(ExtendedKalmanFilter(model=model), keys, inputs, z)
    z[7, 4] = 1e200  # its innovation is as large, and the estimate overflows in the next step
    after = run(ExtendedKalmanFilter(model=model), keys, inputs, z)
    others = np.arange(BLOCK) != 7
    assert after.divergences[7] >= 1 and np.isfinite(after.means).all()
    for one, other in zip(before, after, strict=True):
        np.testing.assert_array_equal(one[others], other[others])


def test_noise_of_single_steps_is_that_of_every_trajectory():
    model, (keys, inputs, z) = simulated(BLOCK + 3)
    factors = np.random.default_rng(2).uniform(0.1, 10.0, size=(z.shape[1], 1, 1))
    noise = {
        "process_noise_covs": factors[1:] * model.process_noise_cov,
        "measurement_noise_covs": factors * model.measurement_noise_cov,
    }
    filter_ = ExtendedKalmanFilter(model=model)
    estimates = run(filter_, keys, inputs, z, **noise)
    r = noise["measurement_noise_covs"]
    for b in (0, BLOCK - 1, BLOCK + 2):
        belief, _ = filter_.update(filter_.init(), z[b, 0], measurement_noise_cov=r[0])
        for k, u in enumerate(inputs[b]):
            belief = filter_.predict(belief, u, process_noise_cov=noise["process_noise_covs"][k])
            belief, _ = filter_.update(belief, z[b, k + 1], measurement_noise_cov=r[k + 1])
        np.testing.assert_allclose(belief.mean, estimates.means[b, -1], rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(belief.cov, estimates.covs[b, -1], rtol=1e-12, atol=1e-12)
