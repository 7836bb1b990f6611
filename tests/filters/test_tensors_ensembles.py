"""Ensembles on tensors: the estimates of `run` from the same keys, and derivatives of one realisation."""

import math
import pickle

import numpy as np
import pytest
import torch

import filters
from filters import make_filter, run, thruster_model
from filters.ensembles.ensemble import EnsembleFilter
from filters.registry import FILTERS
from tests.filters.test_c import ENSEMBLES, made
from tests.filters.test_ensemble_pages import PartlyFilter
from tests.filters.test_pages import wide_pendulum
from tests.filters.test_tensors import Drag, assert_same, one_thread  # noqa: F401 - a fixture
from tests.models import lonely_model, random_affine, scalar_model, simulated, wide_model
from tests.slow import slow_but
from thruster_env.core.streams import episode_keys

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
    """Those of a grid of trajectories, and one for several."""
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
    assert torch.autograd.gradcheck(score, zeros, eps=1e-6, atol=1e-6, rtol=1e-5)
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
    with pytest.raises(ValueError, match="a number of a filter must be one of process_noise_cov, .*inflation"):
        changed.replace(ensemble_size=3)


@pytest.mark.usefixtures("as_python")
def test_rotations_are_refused():
    with pytest.raises(ValueError, match="no random rotations, but got rotations=1"):
        filters.torch(make_filter("etkf", scalar_model(), rotations=1))
