"""Inflation whose factor has an inverse gamma prior: its posterior by search, by differences and by quadrature."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import minimize_scalar
from scipy.stats import invgamma, multivariate_normal

from filters import make_filter, run
from filters.ensembles.ensemble import relative_move, width_of
from tests.filters.test_adaptive_inflation import drifting
from tests.models import KEY, plane_model, simulated
from thruster_env.core.compiled import interpreted

OWN = {"ensemble_size": 8, "adaptive_inflation": 0.3, "least_deviation": 0.05}


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


def slopes_of(factors, members, y, v, s, r, by_state):
    """Slopes of the log-likelihood by differences, of one factor or of each state's."""
    found = []
    for i, factor in enumerate(factors):
        c = np.array([abs(np.corrcoef(members[i], one)[0, 1]) for one in y]) if by_state else np.ones(len(v))

        def level(other, factor=factor, c=c):
            d = (1.0 + c * (other**0.5 - 1.0)) / (1.0 + c * (factor**0.5 - 1.0))
            return multivariate_normal.logpdf(v, cov=d[:, None] * (s - r) * d + r)

        found.append((level(factor + 1e-5) - level(factor - 1e-5)) / 2e-5)
    return found


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("by_state", [0, 1])
def test_each_update_takes_factors_and_widths_to_the_posterior(by_state):
    model = plane_model()
    filter_ = make_filter("etkf", model, **OWN, inflation_by_state=by_state)
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
        y = [*np.array([model.functions.observe(tuple(x), model.constants) for x in forecast.members.T]).T]
        seen = innovation.value, innovation.cov, model.measurement_noise_cov
        slopes = slopes_of(factors, forecast.members, y, *seen, by_state)
        expected = np.array([naive_update(*one) for one in zip(factors, widths, slopes, strict=True)]).T
        limited = [np.maximum(expected[0], 1.0), np.clip(expected[1], narrowest, widest)]
        np.testing.assert_allclose(belief.extras.reshape(2, count), limited, rtol=1e-4)
    assert (belief.extras[count:] != widest).any()


@pytest.mark.usefixtures("as_python")
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


@pytest.mark.slow
def test_compiled_code_and_python_are_one():
    filter_ = make_filter("etkf", plane_model(), **OWN, inflation_by_state=1)
    inputs, z = simulated(plane_model(), 20, count=2, missing=0.2)
    with interpreted():
        expected = run(filter_, None, inputs, z)
    for one, other in zip(run(filter_, None, inputs, z), expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9)


def test_wrong_numbers_are_refused():
    with pytest.raises(ValueError, match="least_deviation must be at most adaptive_inflation, 0.3, but got 0.4"):
        make_filter("etkf", plane_model(), adaptive_inflation=0.3, least_deviation=0.4)
    with pytest.raises(ValueError, match="least_deviation must be zero or positive, but got -1"):
        make_filter("etkf", plane_model(), adaptive_inflation=0.3, least_deviation=-1)
