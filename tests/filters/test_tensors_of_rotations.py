"""Filters of states and measurements that turn, on tensors: the estimates of `run`, and its slopes."""

import numpy as np
import pytest
import torch

import filters
from tests.filters.test_measured_rotations import tracked, tracker_model
from tests.slow import slow_but
from thruster_env.core.streams import filter_keys
from thruster_env.model.quantities import Quantity
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.model.turns import Direction, Pose

OTHERS = "iekf", "ckf", "ekf square-root", "ekf-robust", "enkf", "etkf"
NAMES = slow_but([*OTHERS, "ekf", "ukf"], ["ekf", "ukf", "enkf"])
RUNS = 2


def batch(steps=8):
    """Two runs of gyroscope and star tracker, of which one misses a quaternion, the other a number of one."""
    gyro, z = tracked(20.0)
    z = np.array([z[: steps + 1], z[10 : steps + 11]])
    z[0, 3], z[1, 5, 2] = np.nan, np.nan
    return np.array([gyro[:steps], gyro[10 : steps + 10]]), z


def filter_of(name, model):
    kind, *form = name.split()
    arguments = {"form": form[0]} if form else {"ensemble_size": 8} if kind in ("enkf", "etkf") else {}
    return filters.make_filter(kind, model, **arguments)


def assert_same_as_run(tensors, filter_, inputs, measurements):
    estimates = tensors.run(inputs, measurements)
    expected = filters.run(filter_, inputs=inputs, measurements=measurements)
    for field in ("means", "covs", "innovations", "innovation_covs", "log_likelihoods"):
        ours = getattr(estimates, field).detach().numpy()
        np.testing.assert_allclose(ours, getattr(expected, field), rtol=1e-10, atol=1e-10)
    assert not estimates.divergences.any()
    return estimates


@pytest.mark.parametrize("side", ["body", "world"])
@pytest.mark.parametrize("name", NAMES)
def test_estimates_and_slopes_are_those_of_run(name, side):
    """Slopes along Q and R beside differences of `filters.run`; missing quaternions have none."""
    inputs, z = batch()
    model = tracker_model(side, side, degrees=20.0)
    q, r = (
        torch.tensor(cov, requires_grad=True) for cov in (model.process_noise_cov, model.measurement_noise_cov)
    )
    tensors = filters.torch(filter_of(name, model)).replace(process_noise_cov=q, measurement_noise_cov=r)
    estimates = assert_same_as_run(tensors, filter_of(name, model), inputs, z)
    slopes = torch.autograd.grad(estimates.log_likelihoods.sum(), (q, r))

    def level(by, factor):
        changed = model.replace(**{by: factor * getattr(model, by)})
        keys = filter_keys(range(RUNS))
        found = filters.run(filter_of(name, changed), keys=keys, inputs=inputs, measurements=z)
        return found.log_likelihoods.sum()

    for by, cov, slope in zip(("process_noise_cov", "measurement_noise_cov"), (q, r), slopes, strict=True):
        difference = (level(by, 1.0 + 1e-5) - level(by, 1.0 - 1e-5)) / 2e-5
        assert (slope * cov).sum().item() == pytest.approx(difference, rel=1e-5, abs=1e-6)


def test_directions_and_poses():
    """A direction of a body that turns about it, and a pose that is measured whole."""
    rng = np.random.default_rng(0)
    noise = {"process_noise_cov": [1e-3] * 2, "measurement_noise_cov": [1e-2] * 2, "prior_cov": [0.1] * 2}
    model = StateSpaceModel(
        transition=lambda x, u, c: (x[0] + 0.1 * x[1], x[1] - 0.1 * x[0], x[2]),
        observe=lambda x, c: x,
        states=(Direction("n"),),
        measurements=(Direction("seen", "s"),),
        prior_mean=[0.6, 0.0, 0.8],
        **noise,
    )
    z = rng.normal(size=(RUNS, 6, 3)) * 0.1 + [0.6, 0.0, 0.8]
    z /= np.linalg.norm(z, axis=-1, keepdims=True)
    filter_ = filters.make_filter("ekf", model)
    assert_same_as_run(filters.torch(filter_), filter_, None, z)

    pose = StateSpaceModel(
        transition=lambda x, u, c: x,
        observe=lambda x, c: x[:7],
        states=(Pose("pose"), Quantity("bias", "b")),
        measurements=(Pose("fix", "f"),),
        prior_mean=[1.0] + [0.0] * 7,
        process_noise_cov=[1e-3] * 7,
        measurement_noise_cov=[1e-2] * 6,
        prior_cov=[0.1] * 7,
    )
    z = 0.1 * rng.normal(size=(RUNS, 6, 7)) + np.eye(7)[0]
    z[..., :4] /= np.linalg.norm(z[..., :4], axis=-1, keepdims=True)
    filter_ = filters.make_filter("ukf", pose)
    assert_same_as_run(filters.torch(filter_), filter_, None, z)
