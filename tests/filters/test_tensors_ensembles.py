"""Ensembles and states that turn on tensors: the estimates of `run` from the same keys, and its slopes."""

import math
import pickle

import numpy as np
import pytest
import torch

import filters
from filters import make_filter, run, thruster_model
from filters.ensembles.ensemble import EnsembleFilter
from filters.registry import FILTERS
from tests.filters.checks import refused
from tests.filters.test_c import ENSEMBLES, made
from tests.filters.test_ensemble_pages import PartlyFilter
from tests.filters.test_measured_rotations import tracked, tracker_model
from tests.filters.test_pages import wide_pendulum
from tests.filters.test_tensors import Drag, assert_same, one_thread  # noqa: F401 - a fixture
from tests.models import lonely_model, random_affine, scalar_model, simulated, wide_model
from tests.slow import slow_but
from thruster_env.core.streams import episode_keys, filter_keys
from thruster_env.model.quantities import Quantity
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.model.turns import Direction, Pose

MODELS = {
    "thruster": thruster_model,
    "pendulum": wide_pendulum,
    "affine": wide_model,
    "no input": lonely_model,
    "channels": lambda: random_affine(5, 4, 1),
}


def test_all_ensembles_are_tried():
    names = {name.split()[0] for name in ENSEMBLES}
    assert names == {name for name, kind in FILTERS.items() if issubclass(kind, EnsembleFilter)} - {"rhf"}


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("name", ENSEMBLES)
@pytest.mark.parametrize("which", MODELS)
def test_estimates_are_those_of_run(name, which):
    model = MODELS[which]()
    inputs, z = simulated(model, 12, count=3, level=1.0, missing=0.3)
    filter_ = made(name, model)
    assert_same(filters.torch(filter_).run(inputs, z), run(filter_, None, inputs, z))
    keys = episode_keys([5, 6, 7])
    assert_same(filters.torch(filter_).run(inputs, z, keys), run(filter_, keys, inputs, z))


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("name", ["enkf", "etkf"])
def test_steps_are_those_of_the_filter_with_its_members(name):
    model, key = wide_pendulum(), (3, 4294967295)
    filter_, (inputs, z) = made(name, model), simulated(model, 3)
    tensors = filters.torch(filter_)
    belief, beliefs = filter_.init(key), tensors.init(5, key)
    assert beliefs.mean.shape == (5, 2) and beliefs.extras["members"].shape == beliefs.anomalies.shape == (
        5,
        2,
        13,
    )
    for u, seen in zip(inputs[0], z[0, 1:], strict=True):
        belief, beliefs = filter_.predict(belief, u), tensors.predict(beliefs, u)
        assert_same([beliefs.mean[-1], beliefs.cov[-1]], [belief.mean, belief.cov])
        (belief, told), (beliefs, of_tensors) = filter_.update(belief, seen), tensors.update(beliefs, seen)
        assert_same([one[-1] for one in of_tensors], list(map(np.asarray, told)))
    members = belief.members
    assert_same([beliefs.extras["members"][2]], [members])
    assert_same([beliefs.anomalies[2]], [members - members.mean(axis=1, keepdims=True)])


@pytest.mark.usefixtures("as_python")
def test_a_key_for_each_trajectory():
    model = wide_model()
    inputs, z = simulated(model, 6, count=6)
    filter_, keys = made("enkf", model), episode_keys(range(6))
    grid = filters.torch(filter_).run(inputs.reshape(2, 3, 6, 2), z.reshape(2, 3, 7, 2), keys.reshape(2, 3, 2))
    expected = run(filter_, keys, inputs, z)
    assert_same([grid.means.reshape(6, 7, 3)], [expected.means])
    assert_same(filters.torch(filter_).run(inputs, z, keys[1]), run(filter_, keys[[1] * 6], inputs, z))
    with pytest.raises(ValueError, match="a key must be two whole numbers"):
        filters.torch(filter_).init((), 3)


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize(
    ("name", "make"),
    slow_but(
        [(name, wide_pendulum) for name in ENSEMBLES] + [("etkf", wide_model), ("ensrf", wide_model)],
        [(name, wide_pendulum) for name in ("enkf", "etkf", "denkf")],
    ),
)
def test_everything_that_is_a_tensor_has_derivatives(name, make):
    """By central differences, in units of each number, with the random numbers as they are."""
    model = make(**({"start": 0.5, "spread": 0.2} if make is wide_pendulum else {}))
    inputs, z = map(torch.tensor, simulated(model, 2, count=2, level=0.3))
    z[0, 1, 1] = math.nan
    plain = filters.torch(made(name, model))
    covs = "process_noise_cov", "measurement_noise_cov", "prior_cov"
    numbers = {key: getattr(plain, key) for key in (*covs, "prior_mean", "constants")}
    numbers |= {
        key: torch.tensor(one, dtype=torch.float64) for key, one in (("inflation", 1.03), ("relaxation", 0.2))
    }

    def moved(key, change):
        if key not in covs:
            return numbers[key] + change
        stds = numbers[key].diagonal().sqrt()
        return numbers[key] + 0.5 * (change + change.mT) * stds * stds[:, None]

    def score(u, seen, *changes):
        changed = {key: moved(key, one) for key, one in zip(numbers, changes, strict=True)}
        found = plain.replace(**changed).run(inputs + u, z + seen)
        return found.log_likelihoods.sum(), found.means[:, -1], found.covs[:, -1]

    zeros = [torch.zeros_like(one).requires_grad_() for one in (inputs, z, *numbers.values())]
    assert torch.autograd.gradcheck(score, zeros, eps=1e-6, atol=1e-6, rtol=1e-5, fast_mode=True)
    slopes = torch.autograd.grad(score(*zeros)[0], zeros)
    assert all(abs(one).max() > 1e-6 for one in slopes if one.numel())


@pytest.mark.usefixtures("as_python")
def test_own_parameters_as_tensors_are_those_of_the_filter():
    model = wide_model()
    inputs, z = simulated(model, 8, count=3)
    expected = run(made("denkf", model).__class__(model=model, ensemble_size=13, inflation=1.2), None, inputs, z)
    changed = filters.torch(made("denkf", model)).replace(inflation=1.2)
    assert_same(changed.run(inputs, z), expected)
    assert_same(pickle.loads(pickle.dumps(changed)).run(inputs, z), expected)
    several = changed.replace(inflation=torch.tensor([1.0, 1.2, 1.3], dtype=torch.float64)).run(inputs, z)
    assert_same([several.means[1]], [expected.means[1]])
    user = PartlyFilter(model=model, ensemble_size=9, part=0.7)
    assert_same(filters.torch(user).run(inputs, z), run(user, None, inputs, z))
    refused("a number of a filter must be one of process_noise_cov, .*inflation", changed.replace, ensemble_size=3)


@pytest.mark.usefixtures("as_python")
def test_rotations_are_refused():
    with pytest.raises(ValueError, match="no random rotations, but got rotations=1"):
        filters.torch(make_filter("etkf", scalar_model(), rotations=1))


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
