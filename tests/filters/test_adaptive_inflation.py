"""Inflation that adapts: the mode by a search, its place in a step, and a model whose Q is too small."""

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.stats import multivariate_normal

from filters import make_filter, run
from tests.filters.test_localised import ring
from tests.models import KEY, plane_model, random_affine, simulated, state_space
from thruster_env.core.compiled import interpreted

DEVIATION = 0.3


def naive_factor(t, v, s, r):
    """The next factor: slopes by differences, the mode by a search."""

    def level(other):
        return multivariate_normal.logpdf(v, cov=other / t * (s - r) + r)

    return max(t + mode_of((level(t + 1e-5) - level(t - 1e-5)) / 2e-5), 1.0)


def mode_of(slope):
    """Where (1 + slope u) exp(-u^2/(2 deviation^2)) is largest."""

    def cost(u):
        return 0.5 * (u / DEVIATION) ** 2 - np.log(max(1.0 + slope * u, 1e-300))

    found = minimize_scalar(cost, bounds=(-DEVIATION, DEVIATION), method="bounded", options={"xatol": 1e-12})
    return found.x


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("name", ["enkf", "etkf", "ensrf", "ienkf", "enkf-n", "rhf", "letkf 2"])
def test_each_step_stretches_and_each_update_adapts(name):
    kind, _, radius = name.partition(" ")
    own = {"radius": float(radius)} if radius else {}
    model = ring() if radius else plane_model()
    plain = make_filter(kind, model, ensemble_size=8, **own)
    adaptive = make_filter(kind, model, ensemble_size=8, adaptive_inflation=DEVIATION, **own)
    _, z = simulated(model.replace(process_noise_cov=9.0 * model.process_noise_cov), 12)
    u, belief, seen = np.zeros(model.inputs), adaptive.init(KEY), []
    assert belief.extras == [1.0]
    z[0, 4, 0] = np.nan
    for k in range(12):
        factor, here = belief.extras[0], ~np.isnan(z[0, k])
        forecast = adaptive.predict(belief, u)
        other = plain.predict(belief._replace(extras=np.empty(0)), u)
        mean = other.members.mean(axis=1, keepdims=True)
        np.testing.assert_allclose(forecast.members, mean + factor**0.5 * (other.members - mean), rtol=1e-12)
        belief, innovation = adaptive.update(forecast, z[0, k])
        same, _ = plain.update(forecast._replace(extras=np.empty(0)), z[0, k])
        np.testing.assert_allclose(belief.members, same.members, rtol=1e-12)
        v, both = innovation.value[here], np.ix_(here, here)
        expected = naive_factor(factor, v, innovation.cov[both], model.measurement_noise_cov[both])
        assert belief.extras[0] == pytest.approx(expected, rel=1e-5)
        seen.append(belief.extras[0])
    assert max(seen) > 1.2 and len(set(seen)) > 4
    again, _ = adaptive.update(adaptive.predict(belief, u), np.full(model.m, np.nan))
    assert again.extras[0] == belief.extras[0]


def naive_factors(t, members, y, v, s, r, taper):
    """The next factor of each state: the likelihood of all channels, of which A is stretched where x_i shows."""
    found = []
    for i, factor in enumerate(t):
        c = np.array([taper[i, k] * abs(np.corrcoef(members[i], y[k])[0, 1]) for k in range(len(v))])

        def level(other, factor=factor, c=c):
            d = (1.0 + c * (other**0.5 - 1.0)) / (1.0 + c * (factor**0.5 - 1.0))
            return multivariate_normal.logpdf(v, cov=d[:, None] * (s - r) * d + r)

        slope = (level(factor + 1e-5) - level(factor - 1e-5)) / 2e-5
        found.append(max(factor + mode_of(slope), 1.0))
    return found


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("name", ["enkf", "etkf", "letkf 2", "denkf 2"])
def test_each_state_has_a_factor_of_its_own(name):
    kind, _, radius = name.partition(" ")
    own = {"radius": float(radius)} if radius else {}
    model = ring() if radius else plane_model()
    numbers = {"adaptive_inflation": DEVIATION, "inflation_by_state": 1}
    plain, adaptive = (make_filter(kind, model, ensemble_size=8, **own, **given) for given in ({}, numbers))
    _, z = simulated(model.replace(process_noise_cov=9.0 * model.process_noise_cov), 10)
    z[0, 4, 0] = np.nan
    u, belief, n = np.zeros(model.inputs), adaptive.init(KEY), model.n
    assert belief.extras.tolist() == [1.0] * n
    taper = adaptive.tapers["taper"] if radius else np.ones((n, model.m))
    for k in range(10):
        factors, here = belief.extras.copy(), ~np.isnan(z[0, k])
        forecast = adaptive.predict(belief, u)
        other = plain.predict(belief._replace(extras=np.empty(0)), u)
        mean = other.members.mean(axis=1, keepdims=True)
        stretched = mean + factors[:, None] ** 0.5 * (other.members - mean)
        np.testing.assert_allclose(forecast.members, stretched, rtol=1e-12)
        belief, innovation = adaptive.update(forecast, z[0, k])
        same, _ = plain.update(forecast._replace(extras=np.empty(0)), z[0, k])
        np.testing.assert_allclose(belief.members, same.members, rtol=1e-12)
        v, both = innovation.value[here], np.ix_(here, here)
        y = np.array([model.functions.observe(tuple(x), model.constants) for x in forecast.members.T]).T[here]
        r = model.measurement_noise_cov[both]
        expected = naive_factors(
            factors, forecast.members, y, v, innovation.cov[both], r, np.array(taper)[:, here]
        )
        np.testing.assert_allclose(belief.extras, expected, rtol=1e-5)
    assert len(set(belief.extras)) > 1
    again, _ = adaptive.update(adaptive.predict(belief, u), np.full(model.m, np.nan))
    np.testing.assert_array_equal(again.extras, belief.extras)


def walk(x, u, c):
    return (x[0] + 0.1 * x[1], 0.98 * x[1])


def place(x, c):
    return (x[0],)


def drifting(noise):
    """A body whose speed changes with a variance a step."""
    return state_space(walk, place, q=[1e-4, noise], r=[0.04], mean=[0.0, 0.0], cov=[0.04, 0.1], inputs=0)


@pytest.mark.usefixtures("as_python")
def test_it_makes_up_for_a_q_that_is_too_small_and_leaves_a_right_one():
    _, z = simulated(drifting(0.1), 150, count=6)

    def squares(believed, deviation):
        filter_ = make_filter("etkf", drifting(believed), ensemble_size=30, adaptive_inflation=deviation)
        found = run(filter_, None, None, z)
        return (found.innovations[..., 0] ** 2 / found.innovation_covs[..., 0, 0])[:, 30:].mean()

    assert squares(0.001, 0.0) > 4.0
    assert squares(0.001, 0.3) < 2.0
    assert abs(squares(0.1, 0.1) - 1.0) < 0.2


@pytest.mark.usefixtures("as_python")
def test_of_one_state_it_is_the_factor_of_all_however_many_channels_see_it():
    model = random_affine(1, 3, 1, seed=2)
    inputs, z = simulated(model.replace(process_noise_cov=9.0 * model.process_noise_cov), 20)
    own = {"ensemble_size": 8, "adaptive_inflation": DEVIATION}
    settings = {"inflation_by_state": 1}, {}, {"adaptive_inflation": 0.0}
    each, one, none = (run(make_filter("etkf", model, **own | given), None, inputs, z).covs for given in settings)
    np.testing.assert_allclose(each, one, rtol=1e-10)
    assert abs(none / one - 1.0).max() > 0.1


@pytest.mark.usefixtures("as_python")
def test_the_factor_grows_of_the_state_whose_q_is_too_small():
    """Two bodies that do not touch: the noise of the second is a hundred times what the filter believes."""

    def both(x, u, c):
        return (*walk(x[:2], u, c), *walk(x[2:], u, c))

    def places(x, c):
        return (x[0], x[2])

    def pair(noise):
        prior = {"mean": np.zeros(4), "cov": [0.04, 0.1, 0.04, 0.1]}
        return state_space(both, places, q=[1e-4, 0.001, 1e-4, noise], r=[0.04, 0.04], **prior, inputs=0)

    _, z = simulated(pair(0.1), 150, count=4)

    def squares(**own):
        filter_ = make_filter("etkf", pair(0.001), ensemble_size=30, adaptive_inflation=0.3, **own)
        found = run(filter_, None, None, z)
        s = np.einsum("bkii->bki", found.innovation_covs)
        return (found.innovations**2 / s)[:, 30:].mean(axis=(0, 1)), s[:, 30:, 0].mean()

    (_, second), spread = squares(inflation_by_state=1)
    (_, of_all), wide = squares()
    assert second < 2.0 and of_all < 2.5
    assert spread < 0.9 * wide  # the first body's forecast stays narrow


@pytest.mark.slow
@pytest.mark.parametrize("by_state", (0, 1))
def test_compiled_code_and_python_are_one(by_state):
    parameters = {"adaptive_inflation": 0.2, "rotations": 1 - by_state, "inflation_by_state": by_state}
    filter_ = make_filter("etkf", plane_model(), ensemble_size=9, **parameters)
    inputs, z = simulated(plane_model(), 20, count=2, missing=0.2)
    with interpreted():
        expected = run(filter_, None, inputs, z)
    for one, other in zip(run(filter_, None, inputs, z), expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9)


def test_wrong_numbers_are_refused():
    with pytest.raises(ValueError, match="adaptive_inflation must be zero or positive, but got -1"):
        make_filter("etkf", plane_model(), adaptive_inflation=-1)
    with pytest.raises(ValueError, match="with inflation_by_state must be positive, but got 0"):
        make_filter("etkf", plane_model(), inflation_by_state=1)
    with pytest.raises(ValueError, match="inflation_by_state must be 0 or 1, but got 2"):
        make_filter("etkf", plane_model(), adaptive_inflation=0.1, inflation_by_state=2)
