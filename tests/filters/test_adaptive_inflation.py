"""Inflation that adapts: modes by a search, widths by quadrature, and a model whose Q is too small."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import minimize_scalar
from scipy.stats import invgamma, multivariate_normal

from filters import make_filter, run
from filters.ensembles.ensemble import relative_move, width_of
from tests.filters.test_localised import ring
from tests.models import KEY, plane_model, random_affine, simulated, state_space

pytestmark = pytest.mark.usefixtures("as_python")

DEVIATION = 0.3
OWN = {"ensemble_size": 8, "adaptive_inflation": DEVIATION}


def mode_of(slope):
    """Where (1 + slope u) exp(-u^2/(2 deviation^2)) is largest."""

    def cost(u):
        return 0.5 * (u / DEVIATION) ** 2 - np.log(max(1.0 + slope * u, 1e-300))

    return minimize_scalar(cost, bounds=(-DEVIATION, DEVIATION), method="bounded", options={"xatol": 1e-12}).x


def slopes_of(factors, forecast, innovation, model, here, taper=None):
    """Slopes of the log-likelihood of the channels `here` by differences: of one factor, or of each state's.

    A factor stretches A where x_i shows: by the correlation of x_i and y_k, and the taper.
    """
    members, both, found = forecast.members, np.ix_(here, here), []
    y = np.array([model.functions.observe(tuple(x), model.constants) for x in members.T]).T[here]
    v, s, r = innovation.value[here], innovation.cov[both], model.measurement_noise_cov[both]
    for i, factor in enumerate(factors):
        c = np.ones(len(v))
        if len(factors) == model.n:
            c = np.array([abs(np.corrcoef(members[i], row)[0, 1]) for row in y])
            c = c if taper is None else c * np.array(taper)[i, here]

        def level(other, factor=factor, c=c):
            d = (1.0 + c * (other**0.5 - 1.0)) / (1.0 + c * (factor**0.5 - 1.0))
            return multivariate_normal.logpdf(v, cov=d[:, None] * (s - r) * d + r)

        found.append((level(factor + 1e-5) - level(factor - 1e-5)) / 2e-5)
    return found


OF_ALL = ["enkf", "etkf", "ensrf", "ienkf", "enkf-n", "rhf", "letkf 2"]
OF_EACH = ["enkf", "etkf", "letkf 2", "denkf 2"]


@pytest.mark.parametrize(("name", "by_state"), [*((name, 0) for name in OF_ALL), *((name, 1) for name in OF_EACH)])
def test_each_step_stretches_and_each_update_adapts(name, by_state):
    kind, _, radius = name.partition(" ")
    own = {"radius": float(radius)} if radius else {}
    model = ring() if radius else plane_model()
    plain = make_filter(kind, model, ensemble_size=8, **own)
    adaptive = make_filter(kind, model, **OWN, **own, inflation_by_state=by_state)
    _, z = simulated(model.replace(process_noise_cov=9.0 * model.process_noise_cov), 12)
    z[0, 4, 0] = np.nan
    u, belief, seen = np.zeros(model.inputs), adaptive.init(KEY), []
    assert belief.extras.tolist() == [1.0] * (model.n if by_state else 1)
    taper = adaptive.tapers["taper"] if radius else None
    for k in range(12):
        factors, here = belief.extras.copy(), ~np.isnan(z[0, k])
        forecast = adaptive.predict(belief, u)
        other = plain.predict(belief._replace(extras=np.empty(0)), u).members
        mean = other.mean(axis=1, keepdims=True)
        np.testing.assert_allclose(forecast.members, mean + factors[:, None] ** 0.5 * (other - mean), rtol=1e-12)
        belief, innovation = adaptive.update(forecast, z[0, k])
        same, _ = plain.update(forecast._replace(extras=np.empty(0)), z[0, k])
        np.testing.assert_allclose(belief.members, same.members, rtol=1e-12)
        slopes = slopes_of(factors, forecast, innovation, model, here, taper)
        expected = [max(factor + mode_of(slope), 1.0) for factor, slope in zip(factors, slopes, strict=True)]
        np.testing.assert_allclose(belief.extras, expected, rtol=1e-5)
        seen.append(max(belief.extras))
    assert max(seen) > 1.2 and len(set(seen)) > 4 and len(set(belief.extras)) > by_state
    again, _ = adaptive.update(adaptive.predict(belief, u), np.full(model.m, np.nan))
    np.testing.assert_array_equal(again.extras, belief.extras)


def walk(x, u, c):
    return (x[0] + 0.1 * x[1], 0.98 * x[1])


def place(x, c):
    return (x[0],)


def drifting(noise):
    """A body whose speed changes with a variance a step."""
    return state_space(walk, place, q=[1e-4, noise], r=[0.04], mean=[0.0, 0.0], cov=[0.04, 0.1], inputs=0)


def test_it_makes_up_for_a_q_that_is_too_small_and_leaves_a_right_one():
    _, z = simulated(drifting(0.1), 150, count=6)

    def squares(believed, deviation):
        filter_ = make_filter("etkf", drifting(believed), ensemble_size=30, adaptive_inflation=deviation)
        found = run(filter_, None, None, z)
        return (found.innovations[..., 0] ** 2 / found.innovation_covs[..., 0, 0])[:, 30:].mean()

    assert squares(0.001, 0.0) > 4.0
    assert squares(0.001, 0.3) < 2.0
    assert abs(squares(0.1, 0.1) - 1.0) < 0.2


def test_of_one_state_it_is_the_factor_of_all_however_many_channels_see_it():
    model = random_affine(1, 3, 1, seed=2)
    inputs, z = simulated(model.replace(process_noise_cov=9.0 * model.process_noise_cov), 20)
    settings = {"inflation_by_state": 1}, {}, {"adaptive_inflation": 0.0}
    each, one, none = (run(make_filter("etkf", model, **OWN | given), None, inputs, z).covs for given in settings)
    np.testing.assert_allclose(each, one, rtol=1e-10)
    assert abs(none / one - 1.0).max() > 0.1


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


def prior(mode, width):
    """Inverse gamma density of a factor."""
    return invgamma(1.0 / width - 1.0, scale=mode / width)


def posterior(mode, width, slope):
    """The log of prior times linear likelihood, and the ends of where it is positive."""
    ends = sorted([mode - 1.0 / slope, 0.0 if slope < 0.0 else 20.0])
    return lambda t: prior(mode, width).logpdf(t) + np.log1p(slope * (t - mode)), max(ends[0], 1e-3), ends[1]


def naive_update(mode, width, slope):
    """Mode and width of the inverse gamma density with the posterior's mode and its curvature there."""
    level, low, high = posterior(mode, width, slope)
    inside = low + 1e-9, min(high - 1e-9, 4.0 * mode)
    found = minimize_scalar(lambda t: -level(t), bounds=inside, method="bounded", options={"xatol": 1e-11}).x
    step = 1e-4 * found
    curvature = (level(found + step) - 2.0 * level(found) + level(found - step)) / step**2
    return found, -1.0 / (curvature * found**2)


@pytest.mark.parametrize("deviation", [1e-5, 0.02, 0.1, 0.6])
def test_a_width_is_that_of_the_density_with_this_deviation_over_its_mode(deviation):
    assert prior(3.0, width_of(deviation)).std() == pytest.approx(3.0 * deviation, rel=1e-6)


@pytest.mark.parametrize("slope", [-3.0, -1.0, 0.5, 3.0, 10.0])
def test_mode_and_deviation_are_those_of_the_posterior_by_quadrature(slope):
    mode, width = 1.6, width_of(0.1)
    level, low, high = posterior(mode, width, slope / mode)
    e = relative_move(slope, width)
    found, new_width = naive_update(mode, width, slope / mode)
    assert mode * (1.0 + e) == pytest.approx(found, rel=1e-6)

    def moment(power, about):
        return quad(lambda t: np.exp(level(t)) * (t - about) ** power, low, min(high, 8.0), points=[mode])[0]

    mean = moment(1, 0.0) / moment(0, 0.0)
    deviation = (moment(2, mean) / moment(0, 0.0)) ** 0.5
    assert prior(found, new_width).std() == pytest.approx(deviation, rel=0.05)


@pytest.mark.parametrize("by_state", [0, 1])
def test_each_update_takes_factors_and_widths_to_the_posterior(by_state):
    model = plane_model()
    filter_ = make_filter("etkf", model, **OWN, least_deviation=0.05, inflation_by_state=by_state)
    _, z = simulated(model.replace(process_noise_cov=9.0 * model.process_noise_cov), 12)
    z[0, 4] = np.nan
    belief, u, widest, narrowest = filter_.init(KEY), np.zeros(model.inputs), width_of(0.3), width_of(0.05)
    count = model.n if by_state else 1
    np.testing.assert_allclose(belief.extras, [1.0] * count + [widest] * count)
    for k in range(12):
        factors, widths = belief.extras.reshape(2, count)
        forecast = filter_.predict(belief, u)
        belief, innovation = filter_.update(forecast, z[0, k])
        if np.isnan(z[0, k]).all():
            np.testing.assert_array_equal(belief.extras, forecast.extras)
            continue
        slopes = slopes_of(factors, forecast, innovation, model, ~np.isnan(z[0, k]))
        expected = np.array([naive_update(*one) for one in zip(factors, widths, slopes, strict=True)]).T
        limited = [np.maximum(expected[0], 1.0), np.clip(expected[1], narrowest, widest)]
        np.testing.assert_allclose(belief.extras.reshape(2, count), limited, rtol=1e-4)
    assert (belief.extras[count:] != widest).any()


def test_where_the_model_s_error_is_steady_the_deviation_shrinks_and_the_factor_comes_to_rest():
    _, z = simulated(drifting(0.1), 300, count=1)
    seen = {}
    for least in (0.0, 0.1):
        own = {"ensemble_size": 20, "adaptive_inflation": 0.3, "least_deviation": least}
        filter_ = make_filter("etkf", drifting(0.001), **own)
        belief, factors = filter_.init(KEY), []
        for one in z[0]:
            belief, _ = filter_.update(filter_.predict(belief, []), one)
            factors.append(belief.extras[0])
        seen[least] = np.mean(factors[100:]), np.std(factors[100:])
    assert width_of(0.1) <= belief.extras[1] < 0.6 * width_of(0.3)
    assert seen[0.1][0] == pytest.approx(seen[0.0][0], rel=0.05) and seen[0.1][0] > 1.2
    assert seen[0.1][1] < 0.75 * seen[0.0][1]
