"""Inflation and relaxation of an ensemble's spread: naive formulas, neutral values, units of time and state."""

import numpy as np
import pytest

from filters import FILTERS, make_filter, run
from filters.ensembles.ensemble import EnsembleFilter
from tests.models import KEY, plane_model, rescaled, simulated
from tests.oracles import each_close, each_equal
from thruster_env.core.streams import filter_keys

NAMES = [name for name, kind in FILTERS.items() if issubclass(kind, EnsembleFilter)]
STEPS = 12

pytestmark = pytest.mark.usefixtures("as_python")


def far_plane(**changes):
    """The model of the plane, driven away from zero: stretching about the mean is not stretching about zero."""
    return plane_model(**{"state_offset": [30.0, -0.2], **changes})


def filters_of(name, model, *choices):
    """Filters that differ in their inflation and relaxation only."""
    return [make_filter(name, model, ensemble_size=10, **choice) for choice in choices]


def stretched(members, factor):
    mean = members.mean(axis=1, keepdims=True)
    return mean + np.reshape(factor, (-1, 1)) * (members - mean)


def spread(members):
    return members.std(axis=1, ddof=1)


@pytest.fixture(params=NAMES)
def name(request):
    return request.param


@pytest.mark.parametrize("factor", [1.05, 2.0, 0.9])
def test_each_step_stretches_the_forecast_about_its_mean(name, factor):
    plain, inflated = filters_of(name, far_plane(), {}, {"inflation": factor})
    belief = plain.init(KEY)
    one, other = plain.predict(belief, [0.5]), inflated.predict(belief, [0.5])
    each_close((other.members, other.mean), (stretched(one.members, factor), one.mean), rtol=1e-13)
    np.testing.assert_allclose(other.cov, factor**2 * one.cov, rtol=1e-12)
    after, same = inflated.update(other, [30.0, 0.2])[0], plain.update(other, [30.0, 0.2])[0]
    np.testing.assert_allclose(after.members, same.members, rtol=1e-13)


@pytest.mark.parametrize("part", [0.3, 1.0])
@pytest.mark.parametrize("z", [[30.0, 0.2], [np.nan, 0.2]])
def test_each_update_gives_back_part_of_the_spread_of_each_state(name, part, z):
    plain, relaxed = filters_of(name, far_plane(), {}, {"relaxation": part})
    belief = plain.predict(plain.init(KEY), [0.5])
    after, found = plain.update(belief, z)[0], relaxed.update(belief, z)[0]
    b, a = spread(belief.members), spread(after.members)
    expected = stretched(after.members, 1 + part * (b - a) / a)
    np.testing.assert_allclose(found.members, expected, rtol=1e-12)
    np.testing.assert_allclose(found.mean, after.mean, rtol=1e-13)
    each_close((found.cov, spread(found.members)), (np.cov(expected), part * b + (1 - part) * a), rtol=1e-12)
    np.testing.assert_array_equal(relaxed.predict(belief, [0.5]).members, plain.predict(belief, [0.5]).members)


def test_without_a_measurement_there_is_nothing_to_give_back(name):
    plain, both = filters_of(name, far_plane(), {}, {"inflation": 1.1, "relaxation": 0.5})
    belief = both.predict(plain.init(KEY), [0.5])
    after, _ = both.update(belief, [np.nan, np.nan])
    np.testing.assert_allclose(after.members, belief.members, rtol=1e-14)
    np.testing.assert_allclose(spread(belief.members), 1.1 * spread(plain.predict(plain.init(KEY), [0.5]).members))


def test_a_state_without_spread_keeps_none_and_stays_finite(name):
    model = far_plane(
        a=[[0.9, 0.3], [0.0, 1.0]], prior_cov=[1.0, 0.0], process_noise_cov=[0.3, 0.0], state_offset=[0.0, 0.25]
    )
    (filter_,) = filters_of(name, model, {"inflation": 1.5, "relaxation": 0.5})
    belief = filter_.predict(filter_.init(KEY), [0.5])
    after, _ = filter_.update(belief, [0.3, 0.2])
    assert spread(after.members)[0] > 0.1
    each_equal((after.members[1], after.cov[1]), (np.full(10, -0.5), [0.0, 0.0]))


def test_inflation_for_half_a_step_is_its_root(name):
    """The factor is per step of the model's dt: two half steps of its root are one step of it."""
    still = {"a": np.eye(2), "process_noise_cov": [0.0, 0.0], "state_offset": [0.0, 0.0]}
    whole, half = filters_of(name, far_plane(**still), {"inflation": 1.1}, {"inflation": 1.1**0.5})
    belief = whole.init(KEY)
    once, twice = whole.predict(belief, [0.0]), half.predict(half.predict(belief, [0.0]), [0.0])
    np.testing.assert_allclose(once.members, twice.members, rtol=1e-13)


def some_data(model):
    inputs, measurements = simulated(model, STEPS)
    measurements[0, 3], measurements[0, 6, 0] = np.nan, np.nan
    return filter_keys(range(1)), inputs, measurements


def test_next_to_nothing_is_nothing(name):
    data = some_data(far_plane())
    plain, controlled = filters_of(name, far_plane(), {}, {"inflation": 1.0, "relaxation": 1e-300})
    assert plain.kernels() is not controlled.kernels() or name == "rhf"  # which has one kind of kernels
    each_close(run(plain, *data), run(controlled, *data), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("states", [(1000.0, 0.01), (2.0**20, 2.0**-9)])
def test_a_change_of_units_changes_no_estimate(name, states):
    model, channels = far_plane(), (60.0, 1e-3)
    other = rescaled(model, states, channels)
    keys, inputs, measurements = some_data(model)
    choice = {"inflation": 1.05, "relaxation": 0.4}
    before = run(*filters_of(name, model, choice), keys, inputs, measurements)
    after = run(*filters_of(name, other, choice), keys, inputs, measurements * channels)
    np.testing.assert_allclose(after.means / states, before.means, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(after.covs / np.outer(states, states), before.covs, rtol=1e-9, atol=1e-9)
